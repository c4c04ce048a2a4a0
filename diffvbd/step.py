"""One implicit time step: predictor, rigid correction, sweeps, rigid correction, velocity. Sweeps and corrections are
operators of ours; the rest is torch."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from . import ops
from .adjoints import Adjoint, GlobalAdjoint, ReverseSweep, check_adjoint
from .arguments import (
    GRAVITY,
    Prepared,
    acceleration_of,
    broadcastable,
    check_prescribed,
    check_state,
    collider_state,
    name_argument,
    prepare,
)
from .contact_step import run_contact
from .debug import check_on_cpu, looks_at
from .global_adjoint import global_sweep
from .mask import ELASTIC
from .memory import out_of_memory_named
from .model import Model
from .model_warnings import warn_of_thin_tets
from .rigid import correct
from .scopes import checking
from .start import begin as start_of
from .sweeps import SweepTensors, fused_step, sweep


def step(
    model: Model,
    x: Tensor,
    v: Tensor,
    *,
    mu: float | Tensor | None = None,
    lam: float | Tensor | None = None,
    young: float | Tensor | None = None,
    poisson: float | Tensor | None = None,
    time_step: float,
    sweeps: int,
    force: Tensor | None = None,
    gravity: Sequence[float] | Tensor = GRAVITY,
    prescribed: Tensor | None = None,
    colliders: Tensor | None = None,
    colliders_before: Tensor | None = None,
    rest_points: Tensor | None = None,
    density: float | Tensor | None = None,
    parameters: dict[str, Any] | None = None,
    adjoint: Adjoint | None = None,
) -> tuple[Tensor, Tensor]:
    """One implicit Euler step by Vertex Block Descent, differentiable, by default by the exact reverse sweep.

    Args:
        model: The scene; x, v and the other tensors must have its dtype and device.
        x: Positions [m], shape [..., V, 3]; leading dimensions are scenes over one mesh, which never mix.
        v: Velocities [m/s], shape of x.
        mu: Shear modulus [Pa], broadcasts to x.shape[:-2] + (T,); a value per scene is [B, 1].
        lam: First Lame parameter [Pa], likewise. mu >= 0 and mu + lam >= 0 (lam >= 0 with block="paper").
        young, poisson: Young's modulus [Pa] and Poisson's ratio [-] in place of mu and lam, likewise
            (:func:`diffvbd.lame`).
        time_step: h [s] > 0.
        sweeps: K >= 0, the number of colored sweeps that are executed (and differentiated).
        force: External forces [N], broadcasts to x.shape.
        gravity: Acceleration [m/s^2], 3 numbers, or a tensor that broadcasts to x.shape.
        prescribed: Positions of pinned vertices at the end of the step [m], broadcasts to x.shape; None holds
            them where x has them. Where a vertex is not pinned it must have x, the Model's rest_points or NaN.
        colliders: Corner points of the Model's colliders at the end of the step [m], broadcasts to
            x.shape[:-2] + (Vc, 3). None: the Model's collider_points.
        colliders_before: The same at the start of the step, where they move. None: they rest.
        rest_points: Rest positions [m], broadcasts to x.shape; None: the Model's. Enter through rest metric and mass.
        density: [kg/m^3], broadcasts to x.shape[:-2] + (T,); None: the Model's.
        parameters: Energy parameters by name, as {"floor_barrier.kappa": tensor}; each broadcasts to
            x.shape[:-2] + its own shape.
        adjoint: How the backward is computed: ReverseSweep(), which None stands for, Unrolled() or GlobalAdjoint().

    Returns:
        Positions and velocities after the step, shape of x. Inputs are untouched.

    Raises:
        ValueError, TypeError: Naming the argument, what was expected and what came, before any work. With contact also
            for surfaces that touch at the start, and for prescribed motion above the bounds.
        RuntimeError: Where more pairs are near than the PairBarrier has capacity for.
        NotImplementedError: In the backward, for second derivatives and forward mode (which Unrolled has).

    Source: paper, eqs. 1-3 and section 3; docs/method.md.
    """
    lead, adjoint = check_state(model, x, v), check_adjoint(adjoint)
    prepared = prepare(model, lead, mu=mu, lam=lam, young=young, poisson=poisson, time_step=time_step, sweeps=sweeps,
                       rest_points=rest_points, density=density, parameters=parameters, adjoint=adjoint)  # fmt: skip
    check_prescribed(model, prescribed, x)
    if looks_at(prepared.mu) and looks_at(prepared.lam):
        warn_of_thin_tets(model, prepared.mu, prepared.lam, *prepared.time_step_and_sweeps)
    return advance(model, x, v, prepared, force=force, gravity=gravity, prescribed=prescribed, colliders=colliders,
                   colliders_before=colliders_before, adjoint=adjoint)  # fmt: skip


def _energy_data(model: Model, prepared: Prepared, origin: Tensor | None) -> Tensor:
    """The energies' data [1 | B, n]: the Model's constants unless a parameter or an origin changes them."""
    if not prepared.parameters and origin is None:
        return model._energy_data
    packed = []
    for energy in model.vertex_energies:
        values = {k: v[None] for k, v in model.constants(energy).items()}
        values.update({k: prepared.parameters[f"{energy.name}.{k}"] for k in values
                       if f"{energy.name}.{k}" in prepared.parameters})  # fmt: skip
        packed.append(energy.pack(values, origin))
    if not packed:
        return model._energy_data
    scenes = max([p.shape[0] for p in packed])
    return torch.cat([ops.broadcast(p, (scenes, p.shape[1])) for p in packed], -1)


class Begun(NamedTuple):
    """What the sweeps of a step start from; positions [B, V, 3], relative to ``origin`` where there is one."""

    x_start: Tensor  # as far as planes let it go
    x_prev: Tensor  # the state before the step
    y: Tensor  # the predictor
    data: Tensor  # [1 | B, n], of the energies
    origin: Tensor | None

    def detached(self) -> Begun:
        origin = None if self.origin is None else self.origin.detach()
        return Begun(self.x_start.detach(), self.x_prev.detach(), self.y.detach(), self.data.detach(), origin)

    def tensors(self, prepared: Prepared) -> SweepTensors:
        """The arguments of sweeps.sweep."""
        origin = self.y.new_empty((0,)) if self.origin is None else self.origin
        return SweepTensors(self.x_start, self.x_prev, self.y, prepared.mu, prepared.lam, prepared.mass, prepared.rest,
                            self.data, origin)  # fmt: skip

    def corrected(self, x: Tensor, model: Model, prepared: Prepared) -> Tensor:
        """x [B, V, 3] after the rigid correction, where the Model has one."""
        return self._correct(x, model, prepared)[0] if model.corrects else x

    def _correct(self, x: Tensor, model: Model, prepared: Prepared) -> tuple[Tensor, Tensor]:
        origin, settings = self.y.new_empty((0,)) if self.origin is None else self.origin, prepared.settings
        return correct(x, self.x_prev, self.y, prepared.mass, self.data, origin, model._bodies, model._other_bodies,
                       settings.data_count, settings.numbers[0])  # fmt: skip

    def finish(self, end: Tensor, model: Model, prepared: Prepared, corrects: bool = True) -> tuple[Tensor, Tensor]:
        """Positions and velocities after the step whose sweeps ended at ``end``."""
        if corrects and model.corrects:
            end, velocity = self._correct(end, model, prepared)
        else:
            velocity = (end - self.x_prev) / prepared.settings.numbers[0]
        return end if self.origin is None else end + self.origin, velocity


def begin(
    model: Model, x: Tensor, v: Tensor, prepared: Prepared, force: Any, gravity: Tensor, prescribed: Any
) -> Begun:
    """Predictor, local origin, data of the energies and start of the sweeps."""
    h = prepared.settings.numbers[0]
    shape, flat = x.shape, (math.prod(x.shape[:-2]), *x.shape[-2:])
    start, velocity = x.reshape(flat), v.reshape(flat)
    if gravity.dim() == 1 and force is None:
        acceleration = gravity[None, None]
    else:
        acceleration = ops.broadcast(gravity, shape).reshape(flat)
    if force is not None:
        total = ops.broadcast(broadcastable("force", force, x), shape).reshape(flat)
        # A pinned vertex is moved by no force, whatever stands there.
        total = torch.where(model._pinned[:, None], torch.zeros_like(total), total)
        weight = ops.broadcast(prepared.mass, (flat[0], flat[1]))[..., None]
        # A vertex without mass is isolated and pinned: no force moves it.
        acceleration = acceleration + total / torch.where(weight > 0, weight, torch.ones_like(weight))
    # float32 computes about a point of each body, where positions are small and their spacing fine
    origin = None
    if model.dtype == torch.float32 and model.num_vertices:
        origin = start.detach()[:, model._first_of_body]
        start = start - origin
    none = start.new_empty((0,))
    held = none
    if prescribed is not None:
        held = ops.broadcast(broadcastable("prescribed", prescribed, x), shape).reshape(flat)
        held = held if origin is None else held - origin
    data = _energy_data(model, prepared, origin)
    rest = none
    if model.starts_from == "auto" and model.energy_mask & ELASTIC:
        rest = model.rest_scalars if prepared.rest is None else prepared.rest
    x_start, y = start_of(
        start, velocity, acceleration, held, prepared.mass, data, none if origin is None else origin, prepared.mu,
        prepared.lam, rest, model._pinned, model._bodies, model._other_bodies, prepared.settings.data_count, h,
        start=model.starts_from, filters=model.floor is not None and model.contact is None,
    )  # fmt: skip
    return Begun(x_start, start, y, data, origin)


def advance(
    model: Model,
    x: Tensor,
    v: Tensor,
    prepared: Prepared,
    *,
    force: Tensor | None,
    gravity: Sequence[float] | Tensor,
    prescribed: Tensor | None,
    adjoint: Adjoint | None,
    colliders: Tensor | None = None,
    colliders_before: Tensor | None = None,
    index: int = 0,
) -> tuple[Tensor, Tensor]:
    """The step itself; ``index`` is its number in a rollout, for debug_checks()."""
    adjoint = check_adjoint(adjoint)
    gravity = acceleration_of(gravity, x)
    where = collider_state(model, x, colliders, colliders_before)
    if isinstance(adjoint, ReverseSweep) and x.is_cuda and _fuses(model, force, gravity):
        held = None if prescribed is None else broadcastable("prescribed", prescribed, x)
        return _fused(model, x, v, gravity, held, prepared, adjoint)
    begun = begin(model, x, v, prepared, force, gravity, prescribed)
    given = {"x": x, "v": v, "force": force, "gravity": gravity, "prescribed": prescribed, "colliders": colliders,
             "colliders_before": colliders_before}  # fmt: skip
    if prepared.unrolled is not None:
        with torch.no_grad():  # for what it raises: the values are looked at even by no sweep
            count = prepared.settings.sweeps if checking() else 0
            looked_at = prepared._replace(settings=prepared.settings._replace(sweeps=count))
            swept(model, begun.detached(), looked_at, given, index=index)
        return prepared.unrolled(x, v, force, gravity, prescribed)
    x_end = swept(model, begun, prepared, given, adjoint, index, where)
    # GlobalAdjoint corrects before it takes the end as the solution
    x_end, v_end = begun.finish(x_end, model, prepared, corrects=not isinstance(adjoint, GlobalAdjoint))
    return x_end.reshape(x.shape), v_end.reshape(x.shape)


def swept(
    model: Model,
    begun: Begun,
    prepared: Prepared,
    given: dict[str, Any],
    adjoint: Adjoint | None = None,
    index: int = 0,
    colliders: tuple[Tensor, Tensor] | None = None,
) -> Tensor:
    """Positions after the sweeps, with the backward of an adjoint route. ``given``: arguments that errors may name;
    ``colliders``: where they are at the start and at the end, of a Model with contact."""
    tensors, settings, adjoint = begun.tensors(prepared), prepared.settings, check_adjoint(adjoint)
    more = (*(colliders or ()), *prepared.parameters.values())
    policy = _tape_policy(model, (*tensors, *more), settings, adjoint)
    debug_step = index if checking() else -1
    try:
        if colliders is not None:
            with out_of_memory_named(model, begun.x_start, settings, policy):
                moves = given.get("prescribed") is not None
                return run_contact(model, begun, prepared, *colliders, moves, policy, debug_step)
        if checking() and begun.y.is_cuda:
            check_on_cpu(model, tensors, settings, index)
        with out_of_memory_named(model, begun.x_start, settings, policy):
            if isinstance(adjoint, GlobalAdjoint):
                return global_sweep(model, tensors, settings, adjoint, debug_step,
                                    lambda x: begun.corrected(x, model, prepared))  # fmt: skip
            return sweep(*tensors, model._packed_rest, model._plan, settings, tape_policy=policy, debug_step=debug_step)
    except ValueError as error:
        name_argument(model, error, given)
        raise


def _fuses(model: Model, force: Tensor | None, gravity: Tensor) -> bool:
    """Whether one operator can do the whole step on CUDA. Forces, vertex energies, float32's local origin, function
    transforms and checks take the parts."""
    simple = force is None and not model.vertex_energies and not model.touches and model.dtype == torch.float64
    simple = simple and not model.corrects and model.starts_from == "predictor"
    if not simple or checking() or torch.compiler.is_compiling() or gravity.dim() > 1:
        return False
    return torch._C._functorch.peek_interpreter_stack() is None  # pyright: ignore[reportAttributeAccessIssue]


def _fused(
    model: Model,
    x: Tensor,
    v: Tensor,
    gravity: Tensor,
    held: Tensor | None,
    prepared: Prepared,
    adjoint: ReverseSweep,
) -> tuple[Tensor, Tensor]:
    shape, flat = x.shape, (math.prod(x.shape[:-2]), *x.shape[-2:])
    held = x.new_empty((0,)) if held is None else ops.broadcast(held, shape).reshape(flat)
    acceleration = ops.broadcast(gravity, (1, 1, 3))
    x, v = x.reshape(flat), v.reshape(flat)
    tensors = (x, v, acceleration, held, prepared.mu, prepared.lam, prepared.mass, prepared.rest)
    policy = _tape_policy(model, tensors, prepared.settings, adjoint)
    with out_of_memory_named(model, x, prepared.settings, policy):
        x_end, v_end = fused_step(*tensors, model._packed_rest, model._plan, prepared.settings, tape_policy=policy)
    return x_end.reshape(shape), v_end.reshape(shape)


def _tape_policy(model: Model, tensors: Sequence[Tensor | None], settings: ops.SweepSettings, adjoint: Adjoint) -> int:
    if not isinstance(adjoint, ReverseSweep):
        return ops.NO_TAPE
    if not (torch.is_grad_enabled() and any(t is not None and t.requires_grad for t in tensors)):
        return ops.NO_TAPE
    x = tensors[0]
    assert x is not None
    return adjoint.policy(x.shape[0] * settings.sweeps * model.num_active, x.element_size(), model.energy_mask)
