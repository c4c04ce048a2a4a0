"""The rigid correction of a step: every free body moved, as a whole, to where the step's potential is least.

    min over (R, t)   1/2 sum m |R r + t - y|^2 + the energies of single vertices,      r = x - center of mass

A rigid motion leaves the energy of the tets as it is, so this costs sums over vertices alone, and it is what few sweeps
do worst: they see neighbours, not the body. Away from planes and anchors the minimum is closed (means and a polar
factor); else it is Newton's method in six unknowns, differentiated as executed. docs/method.md, section 14.
"""

# pyright: reportIncompatibleMethodOverride=false
from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd import Function

from . import ops, ops_rigid
from .ops_rigid import Bodies
from .safeguards import FILTER_ETA, GUARD_ULPS
from .sweeps import distinct, no_second_derivative, of_inputs, one_by_one

_TENSORS = 5  # x, x_prev, y, mass, data: the differentiable inputs, all [1 | B, ...]


class _Correct(Function):
    @staticmethod
    def forward(x, x_prev, y, mass, data, origin, order, ptr, spread, groups, data_count, time_step):
        bodies = (order, ptr, spread, groups)
        return ops_rigid.correct(x, x_prev, y, mass, data, origin, bodies, data_count, time_step)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: Tensor) -> None:
        *tensors, ctx.groups, ctx.data_count, ctx.time_step = inputs
        ctx.save_for_backward(*tensors)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple:
        needs = ctx.needs_input_grad[:_TENSORS]
        out = _CorrectBackward.apply(grads[0], *ctx.saved_tensors, ctx.groups, ctx.data_count, ctx.time_step, needs)
        return of_inputs(out, needs, 7)

    @staticmethod
    def vmap(info: Any, in_dims: tuple, *args: Any) -> tuple[Tensor, int]:
        folded, scenes = _folded(info.batch_size, args[: _TENSORS + 1], in_dims)
        return _Correct.apply(*folded, *args[_TENSORS + 1 :]).unflatten(0, (-1, scenes)), 0


class _CorrectBackward(Function):
    @staticmethod
    def forward(x_bar, x, x_prev, y, mass, data, origin, order, ptr, spread, groups, data_count, time_step, needs):
        bodies = (order, ptr, spread, groups)
        x_out, x_prev_out, y_out, mass_out, shared, own = ops_rigid.correct_backward(
            x_bar.contiguous(), x, x_prev, y, mass, data, origin, bodies, data_count, time_step, needs[4]
        )
        if not x_prev_out.numel():
            x_prev_out = torch.zeros_like(x_prev)
        data_out = ops_rigid.join_data(shared, own, data_count) if needs[4] else data
        out = (x_out, x_prev_out, y_out, mass_out, data_out)
        given = (x, x_prev, y, mass, data)
        return tuple(ops.sum_to(bar, t.shape) for bar, t, need in zip(out, given, needs, strict=True) if need)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: tuple[Tensor, ...]) -> None:
        pass

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Any:
        no_second_derivative()

    @staticmethod
    def vmap(info: Any, in_dims: tuple, *args: Any) -> tuple[tuple[Tensor, ...], tuple[int, ...]]:
        """Several adjoints, one after another."""
        return one_by_one(_CorrectBackward, info.batch_size, in_dims, args)


def _folded(size: int, tensors: tuple, in_dims: tuple) -> tuple[list[Tensor], int]:
    """Tensors of vmap with its dimension folded into that of scenes, and the scenes of a member."""
    counts = [(t if d is None else t.movedim(d, 0)[0]).shape[0] for t, d in zip(tensors, in_dims, strict=False)
              if t.numel() > 0]  # fmt: skip
    scenes = max(counts, default=1)
    out = [t if t.numel() == 0 else ops.fold_scenes(t, d, size, scenes) for t, d in zip(tensors, in_dims, strict=False)]
    full = (size * scenes, *out[0].shape[1:])
    out[:3] = [t.expand(full).contiguous() for t in out[:3]]
    return out, scenes


def correct(
    x: Tensor, x_prev: Tensor, y: Tensor, mass: Tensor, data: Tensor, origin: Tensor, bodies: Bodies,
    data_count: tuple[int, ...], time_step: float,
) -> Tensor:  # fmt: skip
    """Positions [B, V, 3] after every listed body was moved rigidly to the least potential; differentiable in the first
    five tensors, whose shapes are those of sweeps.sweep. ``origin`` is empty where positions are absolute."""
    tensors = distinct(x, x_prev, y, mass, data, origin)
    return _Correct.apply(*tensors, *bodies.arguments, data_count, time_step)


def coast(x: Tensor, step: Tensor, planes: Tensor, origin: Tensor | None, bodies: Bodies) -> Tensor:
    """The share of a step that each body may take together, toward planes: filtered vertex by vertex it would arrive
    deformed, and few sweeps do not undo that.

    Args:
        x: Positions above every plane [m], [B, V, 3].  step: Wanted moves [m], [B, V, 3].
        planes: Data of a FloorBarrier [1 | B, 7 planes].  origin: [B, V, 3] or None.

    Returns:
        Positions [B, V, 3]: no vertex comes nearer to a plane within dhat, or closes more than FILTER_ETA of the way to
        there. Of vertices in no body nothing is said.
    """
    data = planes.reshape(planes.shape[0], 1, -1, 7)
    n, height, dhat = data[..., :3], data[..., 3], data[..., 5]
    local = height if origin is None else height - (n * origin[:, :, None]).sum(-1)
    gap = (n * x[:, :, None]).sum(-1) - local  # [B, V, P]
    room = FILTER_ETA * (gap - dhat).clamp(min=0)
    closing = -(n * step[:, :, None]).sum(-1)
    with torch.no_grad():  # a motion along a plane is none toward it, however it rounds
        slack = 8 * torch.finfo(x.dtype).eps * step.norm(dim=-1, keepdim=True)
        over = closing > room + slack
    share = torch.where(over, room / torch.where(over, closing, torch.ones_like(closing)), torch.ones_like(room))
    share = _least(share.amin(-1), bodies)
    with torch.no_grad():  # rounding must not close a gap
        moved = x + share[..., None] * step
        world = moved if origin is None else moved + origin
        guard = (n * world[:, :, None]).abs().sum(-1) + height.abs()
        good = (n * moved[:, :, None]).sum(-1) - local > GUARD_ULPS * torch.finfo(x.dtype).eps * guard
        safe = _least(good.all(-1).to(x.dtype), bodies) > 0
    return x + torch.where(safe, share, torch.zeros_like(share))[..., None] * step


def _least(values: Tensor, bodies: Bodies) -> Tensor:
    """For each vertex the least value [B, V] of its body."""
    start = values.new_ones((values.shape[0], bodies.number + 1))
    index = bodies.member.expand(values.shape)
    return start.scatter_reduce(1, index, values, "amin").gather(1, index)


ops.ready_signature(_Correct, _CorrectBackward)
