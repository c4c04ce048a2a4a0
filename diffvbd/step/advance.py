"""One implicit Euler solve: beginning (predictor, start, first correction), sweeps, correction, velocity.

Beginning, sweeps and correction are compiled operators; with pairs so are detection, islands, the start of a part and
the sweeps of contact, R times a step. Where one operator can do all of it on CUDA, it does. What is left to torch are
small sums: loads to accelerations, rest shape to masses, packing of energies, the velocity of bodies not corrected."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor

from .. import ops
from .._common.constants import VERTEX_ENERGIES
from .._common.context import checking, recorders, replaced
from ..adjoint.implicit import global_sweep
from ..adjoint.routes import Adjoint, GlobalAdjoint, TapedSweep
from ..model.system import System
from ..ops import regimes
from ..ops.fields import TILE, WORKSPACE_BUDGET
from ..ops.sweep import fused_step, is_out_of_memory, sweep
from .arguments import (
    Prepared,
    acceleration_of,
    broadcastable,
    collider_state,
    named,
)
from .coarse import lengths_of, with_corrections
from .contact import run_contact
from .couplings import row_of
from .predict import Begun, begin, energy_data
from .renewed import sweep_renewed

TAPED = TapedSweep()


def advance(
    model: System,
    x: Tensor,
    v: Tensor,
    prepared: Prepared,
    *,
    force: Tensor | None,
    gravity: Sequence[float] | Tensor,
    prescribed: Tensor | None,
    adjoint: Adjoint = TAPED,
    colliders: Tensor | None = None,
    colliders_before: Tensor | None = None,
    index: int = 0,
) -> tuple[Tensor, Tensor]:
    """One solve; ``index`` is the number of its step in a rollout, for debug_checks()."""
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
        return prepared.unrolled(*prepared.time_step_and_sweeps, prepared.lookback)(x, v, force, gravity, prescribed)
    x_end = swept(model, begun, prepared, given, adjoint, index, where)
    # GlobalAdjoint corrects before it takes the end as the solution
    x_end, v_end = begun.finish(x_end, model, prepared, corrects=not isinstance(adjoint, GlobalAdjoint))
    return x_end.reshape(x.shape), v_end.reshape(x.shape)


def swept(
    model: System,
    begun: Begun,
    prepared: Prepared,
    given: dict[str, Any],
    adjoint: Adjoint = TAPED,
    index: int = 0,
    colliders: tuple[Tensor, Tensor] | None = None,
) -> Tensor:
    """Positions after the sweeps, with the backward of an adjoint route. ``given``: arguments that errors may name;
    ``colliders``: where they are at the start and at the end, of a Model with contact."""
    fields, settings = begun.fields(model, prepared), prepared.settings
    if prepared.coarse is not None and colliders is None:  # contact makes corrections of its own
        fields = with_corrections(model, prepared.coarse, fields, settings.numbers.time_step)
    more = (*(colliders or ()), *prepared.parameters.values())
    policy = _tape_policy(model, (*fields, *more), settings, adjoint)
    debug_step = index if checking() else -1
    try:
        if colliders is not None:
            with out_of_memory_named(model, begun.x_start, settings, policy):
                return run_contact(model, begun, prepared, *colliders, policy, debug_step)
        if checking() and begun.y.is_cuda and not begun.renews:
            check_on_cpu(model, fields, settings, index)
        with out_of_memory_named(model, begun.x_start, settings, policy):
            run = partial(_run, model, begun, prepared, fields, policy, debug_step)
            if isinstance(adjoint, GlobalAdjoint):
                return of_equation(model, begun, prepared, adjoint, lambda: begun.corrected(run(), model, prepared))
            return run()
    except ValueError as error:
        # the frames of operators say nothing to who gave the argument
        raise named(model, error, {**given, **prepared.parameters}) from None


def _run(model: System, begun: Begun, prepared: Prepared, fields: ops.SweepFields, policy: int, debug_step: int
         ) -> Tensor:  # fmt: skip
    if begun.renews:
        end, found = sweep_renewed(model, begun, prepared, fields, policy, debug_step)
        corrections = torch.cat([end.new_empty((len(end), 0, 0)), *found][bool(found) :], 1)
    else:
        end, _, corrections = sweep(fields, model._packed_rest, model._plan, prepared.settings, tape_policy=policy,
                                    debug_step=debug_step)  # fmt: skip
    if corrections.numel():
        for found in recorders("subspace"):
            found.append(lengths_of(model, corrections))
    return end


def of_equation(model: System, begun: Begun, prepared: Prepared, adjoint: GlobalAdjoint, run: Callable[[], Tensor]
                ) -> Tensor:  # fmt: skip
    """Positions where ``run`` ends the step [B, V, 3], with the derivative of the step's equation there."""
    data = energy_data(model, prepared, begun.origin)  # without the bound of couplings
    fields = replaced(begun.fields(model, prepared), energy_data=data)
    return global_sweep(model, fields, prepared.averaged, row_of(model, prepared.parameters, len(begun.y)),
                        prepared.settings.numbers.time_step, adjoint, run)  # fmt: skip


def _fuses(model: System, force: Tensor | None, gravity: Tensor) -> bool:
    """Whether one operator can do the whole step on CUDA. Forces, vertex energies, float32's local origin, function
    transforms and checks take the parts."""
    simple = force is None and not model.vertex_energies and not model.touches and model.dtype == torch.float64
    simple = simple and not model._renews
    simple = simple and not model.corrects and model.coarse is None and model.starts_from == "predictor"
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
    if torch.is_grad_enabled():
        for t in tensors:  # not any(), whose generator is called for each
            if t is not None and t.requires_grad:
                return True
    return False


def _tape_policy(model: System, tensors: Sequence[Tensor | None], settings: ops.SweepSettings, adjoint: Adjoint) -> int:
    if not (isinstance(adjoint, TapedSweep) and _is_differentiated(tensors)):
        return ops.NO_TAPE
    x = tensors[0]
    assert x is not None
    scalars = x.shape[0] * settings.sweeps * model.num_active
    return adjoint.policy(scalars, x.element_size(), model.energy_mask, x.device)


# --- what a step does where debug_checks() is on ----------------------------------------------------------------------


def check_on_cpu(model: System, fields: ops.SweepFields, settings: ops.SweepSettings, index: int) -> None:
    """The CPU repeats a step and names what is wrong with it."""
    twin = model._on_cpu()
    settings = replaced(settings, sizes=twin._sizes, launch=())
    with torch.no_grad():
        here = ops.SweepFields(*(t if t is None else t.detach().cpu() for t in fields))  # pyright: ignore
        if settings.coarse:
            plan = twin._coarse_plan  # whose positions are those of the CPU
            settings = replaced(settings, coarse=replaced(plan.sizes, begun=settings.coarse.begun))
            here = replaced(here, coarse_plan=plan.plan, coarse_weights=plan.weights)
        sweep(here, twin._packed_rest, twin._plan, settings, tape_policy=ops.NO_TAPE, debug_step=index)


# --- what a step needs of memory on cuda, and what it says where that is not there ------------------------------------


@contextlib.contextmanager
def out_of_memory_named(model: System, x: Tensor, settings: ops.SweepSettings, policy: int) -> Iterator[None]:
    """Says of a step that does not fit the memory how much it wanted, and which tape would fit a CUDA device."""
    try:
        yield
    except (RuntimeError, MemoryError) as error:
        if not is_out_of_memory(error) or isinstance(error, torch.OutOfMemoryError) and not x.is_cuda:
            raise
        scalars = x.shape[0] * settings.sweeps * model.num_active * x.element_size()
        base = 2 * x.numel() * x.element_size()
        base += cuda_scratch(model, x.shape[0], reverse=False) if x.is_cuda else 0
        wanted = {name: base + scalars * ops.tape_rows(code, model.energy_mask) for name, code in _POLICIES.items()}
        chosen = next(name for name, code in _POLICIES.items() if code == policy)
        if not x.is_cuda:
            smaller = [f'"{name}" {size} bytes' for name, size in wanted.items() if size < wanted[chosen]]
            advice = f", or a smaller VBD(tape=...): {', '.join(smaller)}" if smaller else ""
            raise torch.OutOfMemoryError(
                f'CPU out of memory: a step of {settings.sweeps} sweeps with tape="{chosen}" wanted {wanted[chosen]} '
                f"bytes; use fewer sweeps or scenes{advice}"
            ) from error
        free, _ = torch.cuda.mem_get_info(x.device)
        free += torch.cuda.memory_reserved(x.device) - torch.cuda.memory_allocated(x.device)
        fits = [f'"{name}" ({bytes_wanted} bytes)' for name, bytes_wanted in wanted.items() if bytes_wanted <= free]
        advice = f"VBD(tape=...) that fits: {', '.join(fits)}" if fits else "no tape policy fits: fewer scenes"
        raise torch.OutOfMemoryError(
            f'CUDA out of memory: a step with tape="{chosen}" wanted {wanted[chosen]} bytes, {free} are free; {advice}'
        ) from error


_POLICIES = {"full": ops.FULL_TAPE, "compact": ops.COMPACT_TAPE, "recompute": ops.NO_TAPE}


def cuda_scratch(model: System, scenes: int, *, reverse: bool, material: bool = True, rest: bool = False) -> int:
    """Bytes of workspace of one step on CUDA, as carved in csrc/cuda/run.cuh (a material per tet)."""
    corrects, launch = model.coarse is not None, model.launch(scenes)
    if launch[0] == regimes.THREAD:
        return 0
    _, _, slots, _, _, blocks, edge_slots, *_ = model._sizes
    lanes = ops.LANES["cuda"]
    positions, pairs = blocks * lanes, slots * lanes
    one = 8 * positions + (6 * positions if model.floor else 0) + 2 * pairs
    one += 3 * positions if model.dtype == torch.float32 else 0  # local origins
    if reverse:
        one += 4 * (edge_slots * lanes + 1) + 8 * positions
        one += (2 * pairs if material or rest else 0) + (4 * pairs if rest else 0)
    if model.touches:
        one += ((6 if reverse else 4) + (0 if launch[2] == regimes.MANY_LANES else 9)) * positions
    if corrects:
        sizes = model._coarse_plan.sizes
        one += 8 * positions + 3 * sizes.functions + (0 if reverse else 6 * sizes.parts)
        if model.energy_mask & VERTEX_ENERGIES and not model.touches:  # in float64: blocks, matrices, their inversion
            double, tile = 8 // model._mass.element_size(), sizes.functions * 6 + TILE * sizes.bodies
            one += double * (6 * positions + 9 * sizes.cells + TILE * tile)
            one += 9 * sizes.cells + (4 * positions if reverse else 0)
    one *= model._mass.element_size()
    return one * min(scenes, max(1, WORKSPACE_BUDGET // max(1, one)))
