"""A step of a Model, and the same in two calls that hand over its tape."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NoReturn

import torch
from torch import Tensor

from .._common.checks import check_tensor, fail, to_float, where_it_is
from .._common.context import refuse_refinement, refuse_transforms
from ..adjoint.routes import Adjoint, TapedSweep, check_adjoint
from ..model.model import Model
from ..model.solver import BDF2, VBD, ImplicitEuler
from .advance import advance
from .arguments import check_prescribed, check_staged, check_state, given_of, prepare
from .damping import damped
from .integrators import take
from .warnings import notice_loss, system_for, warn_of_sweeps


def step(
    model: Model, x: Tensor, v: Tensor, solver: VBD, *, adjoint: Adjoint | None = None, **inputs: Any
) -> tuple[Tensor, Tensor]:
    """One implicit step by Vertex Block Descent, differentiable, by default by the exact reverse sweep.

    Args:
        model: The scene; x, v and the other tensors must have its dtype and device.
        x: Positions [m], shape [..., V, 3]; leading dimensions are scenes over one mesh, which do not mix. (A
            PairBarrier without a number of detections has the same number for all scenes of a step.)
        v: Velocities [m/s], shape of x.
        solver: How it is stepped: time step, sweeps and the rest.
        adjoint: How the backward is computed: ReverseSweep(), which None stands for, Unrolled() or GlobalAdjoint().
        inputs: What the Model declares; ``model.inputs`` prints names, shapes, units and defaults. All are
            differentiable. Among them:
            mu, lam: Lame parameters [Pa], broadcast to x.shape[:-2] + (T,); a value per scene is [B, 1]. mu >= 0 and
            mu + lam >= 0 (lam >= 0 with block="paper"). Or young [Pa] and poisson [-] (:func:`diffvbd.lame`).
            force: External forces [N], broadcasts to x.shape.
            gravity: Acceleration [m/s^2], 3 numbers, or a tensor that broadcasts to x.shape.
            prescribed: Positions of pinned vertices at the end of the step [m], broadcasts to x.shape; None keeps them
            where x has them. Where a vertex is not pinned it must have x, the Model's rest_points or NaN.
            colliders: Corner points of the Model's colliders at the end of the step [m], broadcasts to
            x.shape[:-2] + (Vc, 3). None: the Model's collider_points. colliders_before: At its start; None: they rest.
            rest_points: Rest positions [m], broadcasts to x.shape. They enter through rest metric and mass.
            density: [kg/m^3], broadcasts to x.shape[:-2] + (T,).
            stress_free: Deformation G of each tet's rest shape [-], broadcasts to x.shape[:-2] + (T, 3, 3), of positive
            determinant: growth, prestrain, muscles (:func:`diffvbd.fibre_contraction`).
            viscosity, volume_viscosity: Of shear and of volume [Pa s], broadcast to x.shape[:-2] + (T,). drag: Force
            against the velocity over mass [1/s], broadcasts to x.shape[:-1]. All >= 0 and implicit.
            With SDIRK2, prescribed and colliders move evenly to where they end, or are a tuple of two, at the end of
            each of its solves.

    Returns:
        Positions and velocities after the step, shape of x. Arguments are untouched.

    Raises:
        ValueError, TypeError: Naming the argument, what was expected and what came, before any work. With contact also
            for surfaces that touch at the start, for prescribed motion that leaves bodies no way, and with BDF2, whose
            history lives in rollouts.
        RuntimeError: Where more pairs are near than the PairBarrier has capacity for.
        NotImplementedError: For forward mode; with GlobalAdjoint for contact, for rigid bodies and inside torch.func
            transforms; in the backward for second derivatives (which Unrolled has).

    Source: paper, eqs. 1-3 and section 3; docs/method.md.
    """
    refuse_refinement("dv.step")
    lead, system = check_state(model, x, v), system_for(model, solver)
    adjoint = TapedSweep(solver.tape) if adjoint is None else check_adjoint(adjoint, solver.tape)
    scheme = solver.integrator
    if isinstance(scheme, BDF2):
        fail("solver", "ImplicitEuler() or SDIRK2() in a step: BDF2() needs the step before, which dv.rollout keeps",
             "BDF2()")  # fmt: skip
    given = given_of(system, inputs)
    check_staged(scheme, given.loads)
    prepared = prepare(system, lead, given, time_step=solver.time_step, sweeps=solver.sweeps, adjoint=adjoint)
    prescribed = given.loads["prescribed"]
    for value in prescribed if isinstance(prescribed, tuple) else (prescribed,):
        check_prescribed(system, value, x)
    warn_of_sweeps(system, prepared, scheme)
    if isinstance(scheme, ImplicitEuler):
        prepared = prepared if prepared.damping is None else damped(system, prepared, x)
        x_end, v_end = advance(system, x, v, prepared, adjoint=adjoint, **given.loads)
    else:
        taken = take(scheme, system, x, v, None, prepared, given.loads, partial(advance, adjoint=adjoint))
        x_end, v_end = taken.x, taken.v
    notice_loss(system, prepared, scheme, v, given.loads["force"], x_end)
    return x_end, v_end


@dataclass(frozen=True)
class Tape:
    """Record of one step that :func:`diffvbd.step_backward` needs; opaque.

    Holds the arguments of ``wrt`` and the step's x', v' [m, m/s], shape [..., V, 3], with their graph. A graph cannot
    be copied or stored, so a tape cannot: keep the states, and run step_forward again.
    """

    inputs: dict[str, Tensor]
    outputs: tuple[Tensor, Tensor]
    constant: bool = False  # a step that nothing of ``inputs`` moves: no graph, and gradients of zero

    def __reduce_ex__(self, protocol: Any) -> NoReturn:  # of copy, deepcopy, pickle and torch.save
        raise TypeError(
            "Tape: expected to stay as it is, got a copy or pickle of it: it holds torch's graph of its step, which is "
            "lost there. Keep the states (x, v and the inputs) and run step_forward again"
        )


def step_forward(
    model: Model, x: Tensor, v: Tensor, solver: VBD, *, wrt: Sequence[str] = ("x", "v"), **inputs: Any
) -> tuple[Tensor, Tensor, Tape]:
    """One step and its tape, for code that keeps its own backward.

    The step is that of :func:`diffvbd.step`, recorded by torch.autograd whether or not gradients are enabled around the
    call. The tape keeps that graph, with the tapes of the sweeps in it, until it is dropped.

    Args:
        model, x, v, solver, inputs: As in :func:`diffvbd.step`, ``adjoint`` among them; works under torch.no_grad().
        wrt: Names of what to differentiate: x, v and inputs that are given. Only these leave a tape.

    Returns:
        Positions, velocities (both detached) and the tape.

    Raises:
        ValueError, TypeError: As step; also for a name in ``wrt`` that is no given tensor.
        NotImplementedError: Inside torch.func.grad, vmap and the like.
    """
    wrt = (wrt,) if isinstance(wrt, str) else wrt
    if not isinstance(wrt, Sequence) or not all(isinstance(name, str) for name in wrt):
        raise TypeError(f"wrt: expected names of arguments, got {wrt!r}")
    refuse_transforms("dv.step_forward, which keeps a graph of its own (dv.step has them)")
    check_state(model, x, v)
    values: dict[str, Any] = {"x": x, "v": v, **inputs}
    for name in ("rest_points", "density"):
        if name in wrt and values.get(name) is None:
            values[name] = getattr(model, name)
    leaves: dict[str, Tensor] = {}
    for name in wrt:
        value = values.get(name) if name != "adjoint" else None
        if isinstance(value, (int, float)) and not isinstance(value, bool):
            value = torch.tensor(to_float(name, value), dtype=model.dtype, device=model.device)
        if not isinstance(value, Tensor):
            known = [k for k, v in values.items() if isinstance(v, (Tensor, float)) or type(v) is int]
            what = f"which is {type(value).__name__}" if name in values else "which is not given"
            meant = "" if name in values or name in model.inputs else where_it_is(name, (*values, *model.inputs))
            fail("wrt", f"names of given tensors ({', '.join(known)})", f"{name!r}, {what}{meant}")
        check_tensor(name, value, model._mass)
        values[name] = leaves[name] = value.detach().requires_grad_()
    with torch.enable_grad():
        x_end, v_end = step(model, solver=solver, **values)
    constant = not (x_end.requires_grad or v_end.requires_grad)
    return x_end.detach(), v_end.detach(), Tape(leaves, (x_end, v_end), constant)


def step_backward(tape: Tape, grad_x: Tensor | None = None, grad_v: Tensor | None = None) -> dict[str, Tensor]:
    """Gradients of grad_x . x' + grad_v . v' with respect to the arguments named in ``wrt``.

    Runs the tape's graph by torch.autograd.grad and keeps it. The gradients are detached.

    Args:
        tape: From :func:`step_forward`; may be used again.
        grad_x, grad_v: Adjoints of the returned positions and velocities, shape of x; None: zero.

    Returns:
        A dict keyed by argument, each of the argument's shape.

    Raises:
        TypeError: Another thing than a Tape; an adjoint that is no tensor, or of another dtype.
        ValueError: An adjoint of another shape or device.
        RuntimeError: A tape without the graph of its step.
    """
    if not isinstance(tape, Tape):
        raise TypeError(f"tape: expected a Tape of step_forward, got {type(tape).__name__}")
    if tape.inputs and not tape.constant and not any(out.requires_grad for out in tape.outputs):
        raise RuntimeError("tape: expected one with the graph of its step, got one without: run step_forward again")
    pairs = []
    for name, out, grad in zip(("grad_x", "grad_v"), tape.outputs, (grad_x, grad_v), strict=True):
        if grad is None:
            continue
        if not isinstance(grad, Tensor):
            raise TypeError(f"{name}: expected a tensor like x or None, got {type(grad).__name__}")
        check_tensor(name, grad, out, owner="that of x")
        if grad.shape != out.shape:
            fail(name, f"shape {list(out.shape)} (that of x)", f"shape {list(grad.shape)}")
        if out.requires_grad:
            pairs.append((out, grad))
    if not pairs:
        return {n: torch.zeros_like(t) for n, t in tape.inputs.items()}
    outs, adjoints = zip(*pairs, strict=True)
    grads = torch.autograd.grad(outs, list(tape.inputs.values()), adjoints, retain_graph=True, allow_unused=True,
                                materialize_grads=True)  # fmt: skip
    return dict(zip(tape.inputs, grads, strict=True))
