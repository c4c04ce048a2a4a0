"""The sweeps of a step, and whole steps on CUDA, as autograd functions: forward, and the same sweeps transposed. With
what belongs to them: plans and packed rest shapes."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from typing import Any

import torch
from torch import Tensor

from .._common.context import replaced
from .autograd import Differentiable, distinct, fold_scenes, folded, no_transforms, sum_to
from .fields import (
    FULL_TAPE,
    NO_TAPE,
    PLAN_HEADER,
    STEP_ADJOINTS,
    SWEEP_ADJOINTS,
    StepFields,
    SweepFields,
    SweepSettings,
    as_list,
    tape_rows,
)
from .laws import library_of, plain
from .regimes import BLOCK, FEW_LANES, THREAD


def plan_order(plan: Tensor, lanes: int) -> Tensor:
    """The vertex at each position of the sweep order [blocks lanes], -1: none; see csrc/core/plan_views.h."""
    colors, blocks = plan[3:5].tolist()
    return plan.narrow(0, PLAN_HEADER + colors + 1 + 4 * (blocks + 1), blocks * lanes).cpu()


def pack_rest(rest: Tensor, plan: Tensor, sizes: tuple[int, ...], energies: int = 0) -> Tensor:
    """Rest scalars of the tets [B, T, 7] -> as their vertices see them [B, slots, 4, lanes]. Not differentiable."""
    return library_of(energies).pack_rest(rest.contiguous(), plan, sizes)


def listed(fields: SweepFields | StepFields, packed_rest: Tensor, plan: Tensor, settings: SweepSettings
           ) -> list[Tensor]:  # fmt: skip
    """Fields as the operators take them, with the rest shape packed."""
    rest = packed_rest if fields.rest is None else pack_rest(fields.rest, plan, settings.sizes, settings.energies)
    return as_list(replaced(fields, rest=rest), fields.mass)


# --- what a backward says that does not fit the memory ----------------------------------------------------------------

_FAILED_ALLOCATION = (
    "out of memory", "can't allocate memory", "bad_alloc", "Storage size calculation overflowed", '"aten::new_'
)  # fmt: skip


def is_out_of_memory(error: BaseException) -> bool:
    """Whether an allocation failed. On the CPU an operator can only say which of torch's functions gave up."""
    text = str(error)
    return any(part in text for part in _FAILED_ALLOCATION)


@contextlib.contextmanager
def backward_memory(x: Tensor, settings: SweepSettings, tape_policy: int) -> Iterator[None]:
    """Says what to change where the backward of a step does not fit."""
    try:
        yield
    except (RuntimeError, MemoryError) as error:
        if not is_out_of_memory(error):
            raise
        rows = tape_rows(FULL_TAPE, settings.energies) if tape_policy == NO_TAPE else 0
        made = x.shape[0] * settings.sweeps * settings.sizes[0] * rows * x.element_size()
        bytes_wanted = f", which runs the step again with a tape of {made} bytes" if made else ""
        native = f" ({error})" if x.is_cuda else ""
        raise torch.OutOfMemoryError(
            f"{x.device.type.upper()} out of memory in the backward of a step{bytes_wanted}{native}: use fewer sweeps "
            'or scenes, a smaller tape (VBD(tape="compact"), then "recompute") or more checkpoints'
        ) from error


# --- the sweeps -------------------------------------------------------------------------------------------------------


def _scenes_first(settings: SweepSettings) -> SweepSettings:
    """The same sweeps with a tape that can be split and repeated by scenes, for vmap."""
    if settings.launch[:1] != (THREAD,):
        return settings
    return replaced(settings, launch=(BLOCK, BLOCK, FEW_LANES, FEW_LANES))


_FIELDS = len(SweepFields._fields)
_STEP_FIELDS = len(StepFields._fields)


def _wants(names: Sequence[str], fields: Sequence[str], needs: Sequence[bool]) -> dict[str, bool]:
    needed = dict(zip(fields, needs, strict=True))
    return {name: needed[name] for name in names}


def run_sweep(*args: Any) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """x [B, V, 3], tape, with contact the exponents of limits, uint8 [B, K, V], and what coarse corrections did.

    args: The fields, then packed_rest, plan, settings, tape_policy, debug_step, checked.
    """
    packed_rest, plan, settings, *options = args[_FIELDS:]
    given = listed(SweepFields(*args[:_FIELDS]), packed_rest, plan, settings)
    return library_of(settings.energies).sweep(*given, plan, *plain(settings), *options)


def sweep_backward(x_bar: Tensor, x: Tensor, tape: Tensor, corrections: Tensor, limits: Tensor, fields: SweepFields,
                   packed_rest: Tensor, plan: Tensor, settings: SweepSettings, tape_policy: int, wants: dict[str, bool]
                   ) -> dict[str, Tensor]:  # fmt: skip
    """Adjoints of the fields by name; an empty tape: the sweeps run again. ``wants``: of SWEEP_ADJOINTS."""
    given, raw = listed(fields, packed_rest, plan, settings), library_of(settings.energies)
    if tape_policy == NO_TAPE:
        tape_policy = FULL_TAPE
        x, tape, limits, corrections = raw.sweep(*given, plan, *plain(settings), tape_policy, -1, False)
    material = wants["mu"] or wants["lam"]
    flags = [material, wants["mass"], wants["rest"], wants["energy_data"], wants["coarse_factor"]]
    bars = raw.sweep_backward(
        *given, x_bar.contiguous(), x, tape, corrections, limits, plan, *plain(settings), tape_policy, flags
    )
    return dict(zip(SWEEP_ADJOINTS, bars, strict=True))


def _reverse(bars: Sequence[Tensor | None], saved: Sequence[Any], rest: tuple, needs: Sequence[bool]) -> list[Any]:
    """The same sweeps transposed in reverse order."""
    fields, (packed_rest, plan, x, tape, corrections, cut) = SweepFields(*saved[:_FIELDS]), saved[_FIELDS:]
    settings, tape_policy, x_bar = *rest[:2], bars[0]
    assert x_bar is not None
    wants = _wants(SWEEP_ADJOINTS, fields._fields, needs)
    with backward_memory(x, settings, tape_policy):
        out = sweep_backward(x_bar, x, tape, corrections, cut, fields, packed_rest, plan, settings, tape_policy,
                             wants)  # fmt: skip
    return [out.get(name) for name in fields._fields]


def _vmap(apply: Any, info: Any, in_dims: tuple, *args: Any) -> tuple[tuple[Tensor, ...], tuple[int | None, ...]]:
    fields = SweepFields(*args[:_FIELDS])
    _plain(fields)
    tensors, scenes = folded(info.batch_size, tuple(fields), in_dims, 3)
    packed_rest, plan, settings, *others = args[_FIELDS:]
    x, tape, cut, none = apply(*tensors, packed_rest, plan, _scenes_first(settings), *others)
    return (x.unflatten(0, (-1, scenes)), tape.unflatten(0, (-1, scenes)), cut, none), (0, 0, None, None)


def _vmap_reverse(apply: Any, info: Any, in_dims: tuple, *args: Any) -> tuple[tuple[Tensor, ...], tuple[int, ...]]:
    x_bar, *saved, (settings, tape_policy, *others), needs = args
    if settings.launch[:1] == (THREAD,):  # its tape has scenes last: run again, with one that does not
        settings, tape_policy, saved[-3] = _scenes_first(settings), NO_TAPE, x_bar.new_empty((0,))
    fields = SweepFields(*saved[:_FIELDS])
    _plain(fields)
    scenes, size = _scenes((x_bar, *fields), in_dims), info.batch_size
    given = [_folded(t, d, size, scenes) for t, d in zip(fields, in_dims[1:], strict=False)]
    packed_rest, plan, x, tape, corrections, cut = saved[_FIELDS:]
    x, tape = (
        t if t.numel() == 0 else t.expand(size * scenes, *t.shape[1:]).contiguous()
        for t in (_folded(t, d, size, scenes) for t, d in zip((x, tape), in_dims[_FIELDS + 3 :], strict=False))
    )
    full = (size * scenes, *x_bar.shape[-2:])
    # shared inputs get a gradient for each member of the batch: give every differentiated one its own scenes
    spread: list[Any] = [t.expand(size * scenes, *t.shape[1:]).contiguous() if t is not None and need else t
              for t, need in zip(given, needs, strict=True)]  # fmt: skip
    spread[:3] = [t.expand(full).contiguous() for t in spread[:3]]
    out = apply(_folded(x_bar, in_dims[0], size, scenes).expand(full), *spread, packed_rest, plan, x, tape, corrections,
                cut, (settings, tape_policy, *others), needs)  # fmt: skip
    out = out if isinstance(out, tuple) else (out,)
    needed = [(t, d) for t, d, need in zip(fields, in_dims[1:], needs, strict=False) if t is not None and need]
    shapes = [t.shape[0] if d is None else t.movedim(d, 0).shape[1] for t, d in needed]
    result = tuple(
        o.unflatten(0, (size, scenes)) if n == scenes else _member_sum(o.unflatten(0, (size, scenes)))
        for o, n in zip(out, shapes, strict=True)
    )
    return result, (0,) * len(result)


def _plain(fields: SweepFields) -> None:
    if fields.center is not None:
        no_transforms()
    if fields.coarse_plan is not None:
        raise NotImplementedError("diffvbd: torch.func transforms of coarse corrections are not supported")


def _folded(t: Any, dim: int | None, size: int, scenes: int) -> Any:
    return t if t is None or t.numel() == 0 else fold_scenes(t, dim, size, scenes)


def _member_sum(values: Tensor) -> Tensor:
    """[N, B, ...] -> [N, 1, ...]: what the scenes of each member add to an input that they share."""
    return sum_to(values, (values.shape[0], 1, *values.shape[2:]))


def _scenes(tensors: Sequence[Tensor | None], in_dims: tuple) -> int:
    sizes = [1]
    for t, d in zip(tensors, in_dims, strict=False):
        if t is not None and t.numel() > 0:
            sizes.append((t if d is None else t.movedim(d, 0)[0]).shape[0])
    return max(sizes)


# Fields, packed_rest, plan; settings, tape_policy, debug_step, checked.
_sweep = Differentiable(
    run_sweep, _reverse, arguments=_FIELDS + 6, inputs=_FIELDS, tensors=_FIELDS + 2,
    saved=lambda inputs, made: (*inputs[: _FIELDS + 2], made[0], made[1], made[3], made[2]),
    vmap=_vmap, vmap_reverse=_vmap_reverse, batched=True,
)  # fmt: skip


def sweep(fields: SweepFields, packed_rest: Tensor, plan: Tensor, settings: SweepSettings, *, tape_policy: int,
          debug_step: int = -1, checked: bool = True) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """Positions after the sweeps [B, V, 3]; with contact the exponents of limits, uint8 [B, K, V], of contact/limit.h;
    and what coarse corrections did [B, corrections, n]: 3 numbers a function, each body's length, with a floor where it
    began.

    Args:
        fields: See SweepFields; differentiable in those of SWEEP_ADJOINTS.
        packed_rest: The Model's own rest shape [1, slots, 4, lanes], where fields have none.
        tape_policy: What is kept for the backward; NO_TAPE runs the step again there.
    """
    x, _, cut, corrections = _sweep(*distinct(*fields), packed_rest, plan, settings, tape_policy, debug_step,
                                          checked)  # fmt: skip
    return x, cut, corrections


# --- a whole step on CUDA ---------------------------------------------------------------------------------------------


def _run_fused(*args: Any) -> tuple[Tensor, Tensor, Tensor]:
    packed_rest, plan, settings, tape_policy = args[_STEP_FIELDS:]
    given = listed(StepFields(*args[:_STEP_FIELDS]), packed_rest, plan, settings)
    return library_of(settings.energies).fused_step(*given, plan, *plain(settings), tape_policy)


def _reverse_fused(bars: Sequence[Tensor | None], saved: Sequence[Any], rest: tuple, needs: Sequence[bool]
                   ) -> list[Any]:  # fmt: skip
    """As _reverse(), of STEP_ADJOINTS."""
    fields, (packed_rest, plan, x, tape) = StepFields(*saved[:_STEP_FIELDS]), saved[_STEP_FIELDS:]
    settings, tape_policy = rest
    wants = _wants(STEP_ADJOINTS, fields._fields, needs)
    flags = [wants[name] for name in ("x", "v", "acceleration", "prescribed")]
    flags += [wants["mu"] or wants["lam"], wants["mass"], wants["rest"]]
    with backward_memory(fields.x, settings, tape_policy):
        given, raw = listed(fields, packed_rest, plan, settings), library_of(settings.energies)
        if tape_policy == NO_TAPE:
            tape_policy = FULL_TAPE
            x, _, tape = raw.fused_step(*given, plan, *plain(settings), tape_policy)
        states = [fields.x.new_empty((0,)) if bar is None else bar.contiguous() for bar in bars]
        out = raw.fused_step_backward(*given, *states, x, tape, plan, *plain(settings), tape_policy, flags)
    by_name = dict(zip(STEP_ADJOINTS, out, strict=True))
    return [by_name[name] for name in fields._fields]


# A whole step on CUDA: predictor, sweeps, velocity. Not for torch.func, which has the parts.
# Fields, packed_rest, plan; settings, tape_policy.
_fused_step = Differentiable(
    _run_fused, _reverse_fused, arguments=_STEP_FIELDS + 4, inputs=_STEP_FIELDS, outputs=2, tensors=_STEP_FIELDS + 2,
    saved=lambda inputs, made: (*inputs[: _STEP_FIELDS + 2], made[0], made[2]), batched=True,
)  # fmt: skip


def fused_step(fields: StepFields, packed_rest: Tensor, plan: Tensor, settings: SweepSettings, *,
               tape_policy: int) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Positions and velocities [B, V, 3] after a step on CUDA whose only energy is that of the tets; as sweep()."""
    x, v, _ = _fused_step(*distinct(*fields), packed_rest, plan, settings, tape_policy)
    return x, v
