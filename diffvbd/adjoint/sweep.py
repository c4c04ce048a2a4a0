"""The sweeps of a step as autograd functions: forward, and the same sweeps transposed as its backward."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from typing import Any

import torch
from torch import Tensor

from .. import ops
from .._common.context import replaced
from ..ops import distinct, no_transforms
from ..ops.regimes import BLOCK, FEW_LANES, THREAD

_FAILED_ALLOCATION = (
    "out of memory", "can't allocate memory", "bad_alloc", "Storage size calculation overflowed", '"aten::new_'
)  # fmt: skip


def is_out_of_memory(error: BaseException) -> bool:
    """Whether an allocation failed. On the CPU an operator can only say which of torch's functions gave up."""
    text = str(error)
    return any(part in text for part in _FAILED_ALLOCATION)


@contextlib.contextmanager
def backward_memory(x: Tensor, settings: ops.SweepSettings, tape_policy: int) -> Iterator[None]:
    """Says what to change where the backward of a step does not fit."""
    try:
        yield
    except (RuntimeError, MemoryError) as error:
        if not is_out_of_memory(error):
            raise
        rows = ops.tape_rows(ops.FULL_TAPE, settings.energies) if tape_policy == ops.NO_TAPE else 0
        made = x.shape[0] * settings.sweeps * settings.sizes[0] * rows * x.element_size()
        bytes_wanted = f", which runs the step again with a tape of {made} bytes" if made else ""
        native = f" ({error})" if x.is_cuda else ""
        raise torch.OutOfMemoryError(
            f"{x.device.type.upper()} out of memory in the backward of a step{bytes_wanted}{native}: use fewer sweeps "
            'or scenes, a smaller tape (VBD(tape="compact"), then "recompute") or more checkpoints'
        ) from error


def _scenes_first(settings: ops.SweepSettings) -> ops.SweepSettings:
    """The same sweeps with a tape that can be split and repeated by scenes, for vmap."""
    if settings.launch[:1] != (THREAD,):
        return settings
    return replaced(settings, launch=(BLOCK, BLOCK, FEW_LANES, FEW_LANES))


_FIELDS = len(ops.SweepFields._fields)
_STEP_FIELDS = len(ops.StepFields._fields)


def _wants(names: Sequence[str], fields: Sequence[str], needs: Sequence[bool]) -> dict[str, bool]:
    needed = dict(zip(fields, needs, strict=True))
    return {name: needed[name] for name in names}


def _run(*args: Any) -> tuple[Tensor, ...]:
    return ops.sweep(ops.SweepFields(*args[:_FIELDS]), *args[_FIELDS:])


def _reverse(bars: Sequence[Tensor | None], saved: Sequence[Any], rest: tuple, needs: Sequence[bool]) -> list[Any]:
    """The same sweeps transposed in reverse order."""
    fields, (packed_rest, plan, x, tape, corrections, limits) = ops.SweepFields(*saved[:_FIELDS]), saved[_FIELDS:]
    settings, tape_policy, x_bar = *rest[:2], bars[0]
    assert x_bar is not None
    wants = _wants(ops.SWEEP_ADJOINTS, fields._fields, needs)
    with backward_memory(x, settings, tape_policy):
        out = ops.sweep_backward(x_bar, x, tape, corrections, limits, fields, packed_rest, plan, settings, tape_policy,
                                 wants)  # fmt: skip
    return [out.get(name) for name in fields._fields]


def _vmap(apply: Any, info: Any, in_dims: tuple, *args: Any) -> tuple[tuple[Tensor, ...], tuple[int | None, ...]]:
    fields = ops.SweepFields(*args[:_FIELDS])
    _plain(fields)
    scenes = _scenes(fields, in_dims)
    folded: list[Any] = [_folded(t, d, info.batch_size, scenes) for t, d in zip(fields, in_dims, strict=False)]
    full = (info.batch_size * scenes, *folded[0].shape[1:])
    folded[:3] = [t.expand(full).contiguous() for t in folded[:3]]
    packed_rest, plan, settings, *others = args[_FIELDS:]
    x, tape, limits, none = apply(*folded, packed_rest, plan, _scenes_first(settings), *others)
    return (x.unflatten(0, (-1, scenes)), tape.unflatten(0, (-1, scenes)), limits, none), (0, 0, None, None)


def _vmap_reverse(apply: Any, info: Any, in_dims: tuple, *args: Any) -> tuple[tuple[Tensor, ...], tuple[int, ...]]:
    x_bar, *saved, (settings, tape_policy, *others), needs = args
    if settings.launch[:1] == (THREAD,):  # its tape has scenes last: run again, with one that does not
        settings, tape_policy, saved[-3] = _scenes_first(settings), ops.NO_TAPE, x_bar.new_empty((0,))
    fields = ops.SweepFields(*saved[:_FIELDS])
    _plain(fields)
    scenes, size = _scenes((x_bar, *fields), in_dims), info.batch_size
    folded: list[Any] = [_folded(t, d, size, scenes) for t, d in zip(fields, in_dims[1:], strict=False)]
    packed_rest, plan, x, tape, corrections, limits = saved[_FIELDS:]
    x, tape = (
        t if t.numel() == 0 else t.expand(size * scenes, *t.shape[1:]).contiguous()
        for t in (_folded(t, d, size, scenes) for t, d in zip((x, tape), in_dims[_FIELDS + 3 :], strict=False))
    )
    full = (size * scenes, *x_bar.shape[-2:])
    # shared inputs get a gradient for each member of the batch: give every differentiated one its own scenes
    spread: list[Any] = [t.expand(size * scenes, *t.shape[1:]).contiguous() if t is not None and need else t
              for t, need in zip(folded, needs, strict=True)]  # fmt: skip
    spread[:3] = [t.expand(full).contiguous() for t in spread[:3]]
    out = apply(_folded(x_bar, in_dims[0], size, scenes).expand(full), *spread, packed_rest, plan, x, tape, corrections,
                limits, (settings, tape_policy, *others), needs)  # fmt: skip
    out = out if isinstance(out, tuple) else (out,)
    needed = [(t, d) for t, d, need in zip(fields, in_dims[1:], needs, strict=False) if t is not None and need]
    shapes = [t.shape[0] if d is None else t.movedim(d, 0).shape[1] for t, d in needed]
    result = tuple(
        o.unflatten(0, (size, scenes)) if n == scenes else _member_sum(o.unflatten(0, (size, scenes)))
        for o, n in zip(out, shapes, strict=True)
    )
    return result, (0,) * len(result)


def _plain(fields: ops.SweepFields) -> None:
    if fields.center is not None:
        no_transforms()
    if fields.corners_prev is not None:
        raise NotImplementedError("diffvbd: torch.func transforms of a law that reads x_prev are not supported")
    if fields.coarse_plan is not None:
        raise NotImplementedError("diffvbd: torch.func transforms of coarse corrections are not supported")


def _folded(t: Any, dim: int | None, size: int, scenes: int) -> Any:
    return t if t is None or t.numel() == 0 else ops.fold_scenes(t, dim, size, scenes)


def _member_sum(values: Tensor) -> Tensor:
    """[N, B, ...] -> [N, 1, ...]: what the scenes of each member add to an input that they share."""
    return ops.sum_to(values, (values.shape[0], 1, *values.shape[2:]))


def _scenes(tensors: Sequence[Tensor | None], in_dims: tuple) -> int:
    sizes = [1]
    for t, d in zip(tensors, in_dims, strict=False):
        if t is not None and t.numel() > 0:
            sizes.append((t if d is None else t.movedim(d, 0)[0]).shape[0])
    return max(sizes)


# Fields, packed_rest, plan; settings, tape_policy, debug_step, checked.
_sweep = ops.Differentiable(
    _run, _reverse, arguments=_FIELDS + 6, inputs=_FIELDS, tensors=_FIELDS + 2,
    saved=lambda inputs, made: (*inputs[: _FIELDS + 2], made[0], made[1], made[3], made[2]),
    vmap=_vmap, vmap_reverse=_vmap_reverse, batched=True,
)  # fmt: skip


def sweep(fields: ops.SweepFields, packed_rest: Tensor, plan: Tensor, settings: ops.SweepSettings, *, tape_policy: int,
          debug_step: int = -1, checked: bool = True) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """Positions after the sweeps [B, V, 3]; with contact the exponents of limits, uint8 [B, K, V], of contact/limit.h;
    and what coarse corrections did [B, corrections, n]: 3 numbers a function, each body's length, with a floor where it
    began.

    Args:
        fields: See SweepFields; differentiable in those of SWEEP_ADJOINTS.
        packed_rest: The Model's own rest shape [1, slots, 4, lanes], where fields have none.
        tape_policy: What is kept for the backward; ops.NO_TAPE runs the step again there.
    """
    x, _, limits, corrections = _sweep(*distinct(*fields), packed_rest, plan, settings, tape_policy, debug_step,
                                       checked)  # fmt: skip
    return x, limits, corrections


def _run_fused(*args: Any) -> tuple[Tensor, Tensor, Tensor]:
    return ops.fused_step(ops.StepFields(*args[:_STEP_FIELDS]), *args[_STEP_FIELDS:])


def _reverse_fused(bars: Sequence[Tensor | None], saved: Sequence[Any], rest: tuple, needs: Sequence[bool]
                   ) -> list[Any]:  # fmt: skip
    fields, (packed_rest, plan, x_end, tape) = ops.StepFields(*saved[:_STEP_FIELDS]), saved[_STEP_FIELDS:]
    settings, tape_policy = rest
    wants = _wants(ops.STEP_ADJOINTS, fields._fields, needs)
    with backward_memory(fields.x, settings, tape_policy):
        out = ops.fused_step_backward(bars[0], bars[1], x_end, tape, fields, packed_rest, plan, settings, tape_policy,
                                      wants)  # fmt: skip
    return [out[name] for name in fields._fields]


# A whole step on CUDA: predictor, sweeps, velocity. Not for torch.func, which has the parts.
# Fields, packed_rest, plan; settings, tape_policy.
_fused_step = ops.Differentiable(
    _run_fused, _reverse_fused, arguments=_STEP_FIELDS + 4, inputs=_STEP_FIELDS, outputs=2, tensors=_STEP_FIELDS + 2,
    saved=lambda inputs, made: (*inputs[: _STEP_FIELDS + 2], made[0], made[2]), batched=True,
)  # fmt: skip


def fused_step(fields: ops.StepFields, packed_rest: Tensor, plan: Tensor, settings: ops.SweepSettings, *,
               tape_policy: int) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Positions and velocities [B, V, 3] after a step on CUDA whose only energy is that of the tets; as sweep()."""
    x, v, _ = _fused_step(*distinct(*fields), packed_rest, plan, settings, tape_policy)
    return x, v
