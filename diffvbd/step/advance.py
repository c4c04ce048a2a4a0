"""One implicit Euler solve: beginning (predictor, start, first correction), sweeps, correction, velocity.

Beginning, sweeps and correction are compiled operators; with pairs so are detection, islands, the start of a part and
the sweeps of contact, R times a step. Where one operator can do all of it on CUDA, it does. What is left to torch are
small sums: loads to accelerations, rest shape to masses, packing of energies, the velocity of bodies not corrected."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from .. import ops
from ..adjoint.implicit import global_sweep
from ..adjoint.routes import Adjoint, GlobalAdjoint, TapedSweep, check_adjoint
from ..adjoint.sweep import fused_step, sweep
from ..model.system import System
from ..scopes import checking, recorders
from ..tuples import replaced
from .arguments import (
    Prepared,
    acceleration_of,
    broadcastable,
    collider_state,
    named,
)
from .check import check_on_cpu
from .coarse import lengths_of, with_corrections
from .contact import run_contact
from .memory import out_of_memory_named
from .predict import Begun, begin


def advance(
    model: System,
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
    """One solve; ``index`` is the number of its step in a rollout, for debug_checks()."""
    adjoint = check_adjoint(adjoint)
    gravity = acceleration_of(gravity, x)
    where = collider_state(model, x, colliders, colliders_before)
    if isinstance(adjoint, TapedSweep) and x.is_cuda and _fuses(model, force, gravity):
        prescribed = None if prescribed is None else broadcastable("prescribed", prescribed, x)
        return _fused(model, x, v, gravity, prescribed, prepared, adjoint)
    begun = begin(model, x, v, prepared, force, gravity, prescribed)
    given = {"x": x, "v": v, "force": force, "gravity": gravity, "prescribed": prescribed, "colliders": colliders,
             "colliders_before": colliders_before}  # fmt: skip
    if prepared.unrolled is not None:
        with torch.no_grad():  # for what it raises: the values are looked at even by no sweep
            count = prepared.settings.sweeps if checking() else 0
            looked_at = replaced(prepared, settings=replaced(prepared.settings, sweeps=count), coarse=None)
            swept(model, begun.detached(), looked_at, given, index=index)
        return prepared.unrolled(*prepared.time_step_and_sweeps, prepared.chord)(x, v, force, gravity, prescribed)
    x_end = swept(model, begun, prepared, given, adjoint, index, where)
    # GlobalAdjoint corrects before it takes the end as the solution
    x_end, v_end = begun.finish(x_end, model, prepared, corrects=not isinstance(adjoint, GlobalAdjoint))
    return x_end.reshape(x.shape), v_end.reshape(x.shape)


def swept(
    model: System,
    begun: Begun,
    prepared: Prepared,
    given: dict[str, Any],
    adjoint: Adjoint | None = None,
    index: int = 0,
    colliders: tuple[Tensor, Tensor] | None = None,
) -> Tensor:
    """Positions after the sweeps, with the backward of an adjoint route. ``given``: arguments that errors may name;
    ``colliders``: where they are at the start and at the end, of a Model with contact."""
    fields, settings, adjoint = begun.fields(model, prepared), prepared.settings, check_adjoint(adjoint)
    if prepared.coarse is not None and colliders is None:  # contact makes corrections of its own
        fields = with_corrections(model, prepared.coarse, fields, settings.numbers.time_step)
    more = (*(colliders or ()), *prepared.parameters.values())
    policy = _tape_policy(model, (*fields, *more), settings, adjoint)
    debug_step = index if checking() else -1
    try:
        if colliders is not None:
            with out_of_memory_named(model, begun.x_start, settings, policy):
                return run_contact(model, begun, prepared, *colliders, policy, debug_step)
        if checking() and begun.y.is_cuda:
            check_on_cpu(model, fields, settings, index)
        with out_of_memory_named(model, begun.x_start, settings, policy):
            if isinstance(adjoint, GlobalAdjoint):
                return global_sweep(model, fields, settings, adjoint, debug_step,
                                    lambda x: begun.corrected(x, model, prepared))  # fmt: skip
            end, _, corrections = sweep(fields, model._packed_rest, model._plan, settings, tape_policy=policy,
                                        debug_step=debug_step)  # fmt: skip
            if corrections.numel():
                for found in recorders("subspace"):
                    found.append(lengths_of(model, corrections))
            return end
    except ValueError as error:
        raise named(model, error, given) from None  # the frames of operators say nothing to who gave the argument


def _fuses(model: System, force: Tensor | None, gravity: Tensor) -> bool:
    """Whether one operator can do the whole step on CUDA. Forces, vertex energies, float32's local origin, function
    transforms and checks take the parts."""
    simple = force is None and not model.vertex_energies and not model.touches and model.dtype == torch.float64
    simple = (
        simple
        and not model.corrects
        and model.coarse is None
        and model.starts_from == "predictor"
        and not ops.TET_READS_X_PREV
    )
    if not simple or checking() or torch.compiler.is_compiling() or gravity.dim() > 1:
        return False
    return torch._C._functorch.peek_interpreter_stack() is None  # pyright: ignore[reportAttributeAccessIssue]


def _fused(
    model: System,
    x: Tensor,
    v: Tensor,
    gravity: Tensor,
    prescribed: Tensor | None,
    prepared: Prepared,
    adjoint: TapedSweep,
) -> tuple[Tensor, Tensor]:
    shape, flat = x.shape, (math.prod(x.shape[:-2]), *x.shape[-2:])
    prescribed = None if prescribed is None else ops.broadcast(prescribed, shape).reshape(flat)
    acceleration = ops.broadcast(gravity, (1, 1, 3))
    x, v = x.reshape(flat), v.reshape(flat)
    fields = ops.StepFields(x, v, acceleration, prescribed, prepared.mu, prepared.lam, prepared.mass, prepared.rest)
    policy = _tape_policy(model, fields, prepared.settings, adjoint)
    with out_of_memory_named(model, x, prepared.settings, policy):
        x_end, v_end = fused_step(fields, model._packed_rest, model._plan, prepared.settings, tape_policy=policy)
    return x_end.reshape(shape), v_end.reshape(shape)


def _is_differentiated(tensors: Sequence[Tensor | None]) -> bool:
    return torch.is_grad_enabled() and any(t is not None and t.requires_grad for t in tensors)


def _tape_policy(model: System, tensors: Sequence[Tensor | None], settings: ops.SweepSettings, adjoint: Adjoint) -> int:
    if not (isinstance(adjoint, TapedSweep) and _is_differentiated(tensors)):
        return ops.NO_TAPE
    x = tensors[0]
    assert x is not None
    scalars = x.shape[0] * settings.sweeps * model.num_active
    return adjoint.policy(scalars, x.element_size(), model.energy_mask, x.device)
