"""A step in two calls, for code that keeps its own backward: a forward that returns a tape, and a backward that takes
one. torch.autograd is inside: a tape holds the graph of its one step, and the backward runs it. Around the two calls
there is none: what they return is detached, and both work under torch.no_grad()."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NoReturn

import torch
from torch import Tensor

from ..checks import check_tensor, fail, to_float
from ..model.model import Model
from ..scopes import refuse_transforms
from ..tuples import replaced
from .arguments import check_state
from .integrators import History
from .step import step

_ARGUMENTS = ("x", "v", "mu", "lam", "young", "poisson", "force", "gravity", "prescribed", "rest_points", "density",
              "colliders", "colliders_before")  # fmt: skip


@dataclass(frozen=True)
class Tape:
    """What :func:`step_backward` needs of one step; opaque.

    Holds the arguments of ``wrt`` and the step's x', v' [m, m/s], shape [..., V, 3], with their graph. A graph cannot
    be copied or stored, so a tape cannot: keep the states, and run step_forward again.
    """

    inputs: dict[str, Tensor]
    outputs: tuple[Tensor, Tensor]
    constant: bool = False  # a step that nothing of ``inputs`` moves: no graph, and gradients of zero
    history: History | None = None  # with BDF2(), detached: what the next step takes

    def __reduce_ex__(self, protocol: Any) -> NoReturn:  # of copy, deepcopy, pickle and torch.save
        raise TypeError(
            "Tape: expected to stay as it is, got a copy or pickle of it: it holds torch's graph of its step, which is "
            "lost there. Keep the states (x, v and the other arguments) and run step_forward again"
        )


def step_forward(
    model: Model, x: Tensor, v: Tensor, *, wrt: Sequence[str] = ("x", "v"), **options: Any
) -> tuple[Tensor, Tensor, Tape]:
    """One step and its tape, for code that keeps its own backward.

    The step is that of :func:`diffvbd.step`, recorded by torch.autograd whether or not gradients are enabled around the
    call. The tape keeps that graph, with the tapes of the sweeps in it, until it is dropped.

    Args:
        model, x, v, options: As in :func:`diffvbd.step`; works under torch.no_grad() too.
        wrt: Names of the arguments to differentiate: x, v, mu, lam, young, poisson, force, gravity, prescribed,
            rest_points, density, colliders, colliders_before, history.moved, history.v, or a name in ``parameters``.
            Only these leave a tape.

    Returns:
        Positions, velocities (both detached) and the tape, which with BDF2() has the history for the next step: its
        ``moved`` is x' - x and its ``v`` is v.

    Raises:
        ValueError, TypeError: As step; also for a name in ``wrt`` that is no given tensor.
        NotImplementedError: Inside torch.func.grad, vmap and the like.
    """
    wrt = (wrt,) if isinstance(wrt, str) else wrt
    if not isinstance(wrt, Sequence) or not all(isinstance(name, str) for name in wrt):
        raise TypeError(f"wrt: expected names of arguments, got {wrt!r}")
    refuse_transforms("dv.step_forward, which keeps a graph of its own (dv.step has them)")
    check_state(model, x, v)
    if not isinstance(options.get("parameters"), dict | None):
        got = type(options["parameters"]).__name__
        raise TypeError(f"parameters: expected a dict of tensors by name, got {got}")
    values: dict[str, Any] = {"x": x, "v": v, **options}
    parameters = dict(options.get("parameters") or {})
    if "rest_points" in wrt and values.get("rest_points") is None:
        values["rest_points"] = model.rest_points
    if "density" in wrt and values.get("density") is None:
        values["density"] = model.density
    inputs: dict[str, Tensor] = {}
    history = values.get("history")
    before: dict[str, Any] = {k: getattr(history, k) for k in ("moved", "v")} if isinstance(history, History) else {}
    for full in wrt:
        of_history = full.startswith("history.")
        name = full.removeprefix("history.")
        place = before if of_history else values if name in _ARGUMENTS else parameters
        value = place.get(name)
        if isinstance(value, (int, float)) and not isinstance(value, bool):
            value = torch.tensor(to_float(name, value), dtype=model.dtype, device=model.device)
        if not isinstance(value, Tensor):
            named = {**{k: values[k] for k in _ARGUMENTS if k in values}, **parameters}
            known = [k for k, v in named.items() if isinstance(v, (Tensor, float)) or type(v) is int]
            known += [f"history.{k}" for k, v in before.items() if isinstance(v, Tensor)]
            fail("wrt", f"names of given tensors ({', '.join(known)})", f"{full!r}, which is {type(value).__name__}")
        check_tensor(full, value, model._mass)
        place[name] = inputs[full] = value.detach().requires_grad_()
    values["parameters"] = parameters or None
    if isinstance(history, History):
        values["history"] = replaced(history, **before)
    with torch.enable_grad():
        x_end, v_end, *more = step(model, **values)
    constant = not (x_end.requires_grad or v_end.requires_grad)
    after = replaced(more[0], moved=more[0].moved.detach(), v=more[0].v.detach()) if more else None
    return x_end.detach(), v_end.detach(), Tape(inputs, (x_end, v_end), constant, after)


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
        raise TypeError(f"tape: expected a diffvbd.Tape of step_forward, got {type(tape).__name__}")
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
    names, leaves = list(tape.inputs), list(tape.inputs.values())
    if not pairs:
        return {n: torch.zeros_like(t) for n, t in tape.inputs.items()}
    grads = torch.autograd.grad(
        [p[0] for p in pairs],
        leaves,
        [p[1] for p in pairs],
        retain_graph=True,
        allow_unused=True,
        materialize_grads=True,
    )
    return dict(zip(names, grads, strict=True))
