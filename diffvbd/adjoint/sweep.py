"""The sweeps of a step as autograd functions: forward, and the same sweeps transposed as its backward."""

# pyright: reportIncompatibleMethodOverride=false
from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple, NoReturn

import torch
from torch import Tensor
from torch.autograd import Function

from .. import ops
from ..ops import distinct, no_second_derivative, of_inputs, one_by_one, ready_signature
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
            'or scenes, a smaller tape (ReverseSweep(tape="compact"), then "recompute") or more checkpoints'
        ) from error


def _scenes_first(settings: ops.SweepSettings) -> ops.SweepSettings:
    """The same sweeps with a tape that can be split and repeated by scenes, for vmap."""
    return settings._replace(launch=(BLOCK, FEW_LANES, FEW_LANES)) if settings.launch[:1] == (THREAD,) else settings


_TENSORS = 8  # x_start, x_prev, y, mu, lam, mass, rest, energy_data: the differentiable inputs, all [1 | B, ...]


class _Sweep(Function):
    """K sweeps of block updates and, as its backward, the same sweeps transposed in reverse order."""

    @staticmethod
    def forward(x_start, x_prev, y, mu, lam, mass, rest, energy_data, origin, packed_rest, plan, settings, tape_policy,
                debug_step, checked):  # fmt: skip
        if rest is not None:
            packed_rest = ops.pack_rest(rest, plan, settings.sizes)
        return ops.raw.sweep(x_start, x_prev, y, mu, lam, mass, packed_rest, energy_data, origin, plan, *settings,
                          tape_policy, debug_step, checked)  # fmt: skip

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: tuple[Tensor, Tensor]) -> None:
        *tensors, origin, packed_rest, plan, settings, tape_policy, _, _ = inputs
        ctx.save_for_backward(*tensors, origin, packed_rest, plan, *output)
        ctx.settings, ctx.tape_policy = settings, tape_policy
        ctx.mark_non_differentiable(output[1])
        ctx.set_materialize_grads(False)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple:
        if grads[0] is None:
            return (None,) * (_TENSORS + 7)
        needs = ctx.needs_input_grad[:_TENSORS]
        out = _SweepBackward.apply(grads[0], *ctx.saved_tensors, ctx.settings, ctx.tape_policy, needs)
        return of_inputs(out, needs, 7)

    @staticmethod
    def vmap(info: Any, in_dims: tuple, *args: Any) -> tuple[tuple[Tensor, Tensor], tuple[int, int]]:
        tensors: tuple[Any, ...] = args[: _TENSORS + 1]
        scenes = _scenes(tensors, in_dims)
        folded: list[Any] = [
            t if t is None or t.numel() == 0 else ops.fold_scenes(t, d, info.batch_size, scenes)
            for t, d in zip(tensors, in_dims, strict=False)
        ]
        full = (info.batch_size * scenes, *folded[0].shape[1:])
        folded[:3] = [t.expand(full).contiguous() for t in folded[:3]]
        packed_rest, plan, settings, *rest = args[_TENSORS + 1 :]
        x, tape = _Sweep.apply(*folded, packed_rest, plan, _scenes_first(settings), *rest)
        return (x.unflatten(0, (-1, scenes)), tape.unflatten(0, (-1, scenes))), (0, 0)


class _SweepBackward(Function):
    @staticmethod
    def forward(x_bar, x_start, x_prev, y, mu, lam, mass, rest, energy_data, origin, packed_rest, plan, x, tape,
                settings, tape_policy, needs):  # fmt: skip
        with backward_memory(x, settings, tape_policy):
            if rest is not None:
                packed_rest = ops.pack_rest(rest, plan, settings.sizes)
            inputs = (x_prev, y, mu, lam, mass, packed_rest, energy_data, origin)
            if tape_policy == ops.NO_TAPE:
                tape_policy = ops.FULL_TAPE
                x, tape = ops.raw.sweep(x_start, *inputs, plan, *settings, tape_policy, -1, False)
            wants = (needs[3] or needs[4], needs[5], needs[6], needs[7])
            bars = ops.raw.sweep_backward(x_bar.contiguous(), x, *inputs, tape, plan, *settings, tape_policy, wants)
        given: tuple[Any, ...] = (x_start, x_prev, y, mu, lam, mass, rest, energy_data)
        return tuple(ops.sum_to(bar, t.shape) for bar, t, need in zip(bars, given, needs, strict=True) if need)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: tuple[Tensor, ...]) -> None:
        ctx.count = len(inputs)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> NoReturn:
        no_second_derivative()

    @staticmethod
    def vmap(info: Any, in_dims: tuple, *args: Any) -> tuple[tuple[Tensor, ...], tuple[int, ...]]:
        x_bar, *saved, settings, tape_policy, needs = args
        if settings.launch[:1] == (THREAD,):  # its tape has scenes last: run again, with one that does not
            settings, tape_policy, saved[-1] = _scenes_first(settings), ops.NO_TAPE, x_bar.new_empty((0,))
        tensors: tuple[Any, ...] = (x_bar, *saved[: _TENSORS + 1])
        scenes = _scenes(tensors, in_dims)
        size = info.batch_size

        def fold(t: Tensor | None, d: int | None) -> Any:
            return t if t is None or t.numel() == 0 else ops.fold_scenes(t, d, size, scenes)

        folded: list[Any] = [fold(t, d) for t, d in zip(tensors, in_dims, strict=False)]
        packed_rest, plan, x, tape = saved[_TENSORS + 1 :]
        x, tape = (
            t if t.numel() == 0 else t.expand(size * scenes, *t.shape[1:]).contiguous()
            for t in (fold(t, d) for t, d in zip((x, tape), in_dims[_TENSORS + 4 :], strict=False))
        )
        full = (size * scenes, *x_bar.shape[-2:])
        # shared inputs get a gradient for each member of the batch: give every differentiated one its own scenes
        spread: list[Any] = [t.expand(size * scenes, *t.shape[1:]).contiguous() if t is not None and need else t
                  for t, need in zip(folded[1 : _TENSORS + 1], needs, strict=True)]  # fmt: skip
        spread[:3] = [t.expand(full).contiguous() for t in spread[:3]]
        out = _SweepBackward.apply(folded[0].expand(full), *spread, folded[-1], packed_rest, plan, x, tape, settings,
                                   tape_policy, needs)  # fmt: skip
        out = out if isinstance(out, tuple) else (out,)
        shapes = [t.shape[0] if d is None else t.movedim(d, 0).shape[1]
                  for t, d, need in zip(saved[:_TENSORS], in_dims[1:], needs, strict=False) if need]  # fmt: skip
        result = tuple(
            o.unflatten(0, (size, scenes)) if n == scenes else _member_sum(o.unflatten(0, (size, scenes)))
            for o, n in zip(out, shapes, strict=True)
        )
        return result, (0,) * len(result)


def _member_sum(values: Tensor) -> Tensor:
    """[N, B, ...] -> [N, 1, ...]: what the scenes of each member add to an input that they share."""
    return ops.sum_to(values, (values.shape[0], 1, *values.shape[2:]))


def _scenes(tensors: Sequence[Tensor | None], in_dims: tuple) -> int:
    sizes = [1]
    for t, d in zip(tensors, in_dims, strict=False):
        if t is not None and t.numel() > 0:
            sizes.append((t if d is None else t.movedim(d, 0)[0]).shape[0])
    return max(sizes)


class SweepTensors(NamedTuple):
    """The first arguments of :func:`sweep`, with their shapes there."""

    x_start: Tensor
    x_prev: Tensor
    y: Tensor
    mu: Tensor
    lam: Tensor
    mass: Tensor
    rest: Tensor | None
    energy_data: Tensor
    origin: Tensor


def sweep(
    x_start, x_prev, y, mu, lam, mass, rest, energy_data, origin, packed_rest, plan, settings: ops.SweepSettings, *,
    tape_policy: int, debug_step: int = -1, checked: bool = True,
) -> Tensor:  # fmt: skip
    """Positions after the sweeps, [B, V, 3], differentiable in the first eight tensors.

    Args:
        x_start, x_prev, y: Start of the sweep, start of the step, predictor [m], [B, V, 3].
        mu, lam: [1 | B, 1 | T] [Pa]; mass: [1 | B, V] [kg].
        rest: [1 | B, T, 7], or None for the Model's own ``packed_rest`` [1, slots, 4, lanes].
        energy_data: [1 | B, n], see VertexEnergy.pack; origin: [B, V, 3] or empty.
        tape_policy: What is kept for the backward; ops.NO_TAPE runs the step again there.
    """
    tensors = distinct(x_start, x_prev, y, mu, lam, mass, rest, energy_data, origin)
    x, _ = _Sweep.apply(*tensors, packed_rest, plan, settings, tape_policy, debug_step, checked)
    return x


class _FusedStep(Function):
    """A whole step on CUDA: predictor, sweeps, velocity. Not for torch.func, which has the parts."""

    @staticmethod
    def forward(x, v, acceleration, held, mu, lam, mass, rest, packed_rest, plan, settings, tape_policy):
        if rest is not None:
            packed_rest = ops.pack_rest(rest, plan, settings.sizes)
        return ops.raw.fused_step(x, v, acceleration, held, mu, lam, mass, packed_rest, plan, *settings, tape_policy)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: tuple[Tensor, Tensor, Tensor]) -> None:
        *tensors, settings, tape_policy = inputs
        ctx.save_for_backward(*tensors, output[0], output[2])
        ctx.settings, ctx.tape_policy = settings, tape_policy
        ctx.mark_non_differentiable(output[2])
        ctx.set_materialize_grads(False)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple:
        if grads[0] is None and grads[1] is None:
            return (None,) * (_TENSORS + 4)
        needs = ctx.needs_input_grad[:_TENSORS]
        out = _FusedBackward.apply(*grads[:2], *ctx.saved_tensors, ctx.settings, ctx.tape_policy, needs)
        return of_inputs(out, needs, 4)


class _FusedBackward(Function):
    @staticmethod
    def forward(x_bar, v_bar, x, v, acceleration, held, mu, lam, mass, rest, packed_rest, plan, x_end, tape, settings,
                tape_policy, needs):  # fmt: skip
        with backward_memory(x, settings, tape_policy):
            if rest is not None:
                packed_rest = ops.pack_rest(rest, plan, settings.sizes)
            inputs = (x, v, acceleration, held, mu, lam, mass, packed_rest)
            if tape_policy == ops.NO_TAPE:
                tape_policy = ops.FULL_TAPE
                x_end, _, tape = ops.raw.fused_step(*inputs, plan, *settings, tape_policy)
            bars = [x.new_empty((0,)) if bar is None else bar.contiguous() for bar in (x_bar, v_bar)]
            wants = (*needs[:4], needs[4] or needs[5], *needs[6:])
            out = ops.raw.fused_step_backward(*bars, x_end, *inputs, tape, plan, *settings, tape_policy, wants)
        given: tuple[Any, ...] = (x, v, acceleration, held, mu, lam, mass, rest)
        return tuple(ops.sum_to(bar, t.shape) for bar, t, need in zip(out, given, needs, strict=True) if need)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: tuple[Tensor, ...]) -> None:
        ctx.count = len(inputs)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> NoReturn:
        no_second_derivative()

    @staticmethod
    def vmap(info: Any, in_dims: tuple, *args: Any) -> tuple[tuple[Tensor, ...], tuple[int, ...]]:
        """Several adjoints of one step, one after another (the forward is no fused step under vmap)."""
        return one_by_one(_FusedBackward, info.batch_size, in_dims, args)


def fused_step(x, v, acceleration, held, mu, lam, mass, rest, packed_rest, plan, settings: ops.SweepSettings, *,
               tape_policy: int) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Positions and velocities after a step on CUDA whose only energy is that of the tets, [B, V, 3].

    Args:
        x, v: State [m, m/s], [B, V, 3]; acceleration: [1 | B, 1 | V, 3] [m/s^2].
        held: Where pinned vertices go [m], [1 | B, V, 3], or empty: they stay.
        mu, lam, mass, rest, packed_rest, tape_policy: As in :func:`sweep`.
    """
    tensors = distinct(x, v, acceleration, held, mu, lam, mass, rest)
    x_end, v_end, _ = _FusedStep.apply(*tensors, packed_rest, plan, settings, tape_policy)
    return x_end, v_end


ready_signature(_Sweep, _SweepBackward, _FusedStep, _FusedBackward)
