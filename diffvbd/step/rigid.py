"""The rigid correction of a step: every free body moved, as a whole, to where the step's potential is least.

    min over (R, t)   1/2 sum m |R r + t - y|^2 + the energies of single vertices,      r = x - center of mass

A rigid motion leaves the energy of the tets as it is, so this costs sums over vertices alone, and it is what few sweeps
do worst: they see neighbours, not the body. Away from planes and anchors the minimum is closed (means and a polar
factor); else it is Newton's method in six unknowns, differentiated as executed. docs/method.md, section 14.
"""

# pyright: reportIncompatibleMethodOverride=false
from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.autograd import Function

from .. import ops
from ..model.bodies import Bodies, OtherBodies
from ..ops import distinct, no_second_derivative, of_inputs, one_by_one
from ..ops import rigid as ops_rigid

_TENSORS = 5  # differentiable fields: x, x_prev, y, mass, energy_data, all [1 | B, ...]
_FIELDS = len(ops.RigidFields._fields)


class _Correct(Function):
    @staticmethod
    def forward(x, x_prev, y, mass, energy_data, origin, order, ptr, spread, other, groups, data_count, time_step):
        # torch.compile counts these arguments: *args would get the context as well
        fields = ops.RigidFields(x, x_prev, y, mass, energy_data, origin, order, ptr, spread, other)
        return ops.raw.rigid(*ops.as_list(fields, x), groups, data_count, time_step)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: tuple[Tensor, Tensor]) -> None:
        ctx.save_for_backward(*inputs[:_FIELDS])
        ctx.options = inputs[_FIELDS:]
        ctx.set_materialize_grads(False)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor | None) -> tuple:
        needs = ctx.needs_input_grad[:_TENSORS]
        if grads[0] is None and grads[1] is None:
            return (None,) * len(ctx.needs_input_grad)
        saved = ctx.saved_tensors  # read once, as torch's checkpoints want
        x_bar = torch.zeros_like(saved[0]) if grads[0] is None else grads[0]
        v_bar = saved[0].new_empty((0,)) if grads[1] is None else grads[1]
        out = _CorrectBackward.apply(x_bar, v_bar, *saved, ctx.options, needs)
        return of_inputs(out, needs, len(ctx.needs_input_grad) - _TENSORS)

    @staticmethod
    def vmap(info: Any, in_dims: tuple, *args: Any) -> tuple[tuple[Tensor, Tensor], tuple[int, int]]:
        tensors, scenes = folded(info.batch_size, args[: _TENSORS + 1], in_dims, 3)
        x, v = _Correct.apply(*tensors, *args[_TENSORS + 1 :])
        return (x.unflatten(0, (-1, scenes)), v.unflatten(0, (-1, scenes))), (0, 0)


class _CorrectBackward(Function):
    @staticmethod
    def forward(x_bar, v_bar, x, x_prev, y, mass, energy_data, origin, order, ptr, spread, other, options, needs):
        fields = ops.RigidFields(x, x_prev, y, mass, energy_data, origin, order, ptr, spread, other)
        groups, data_count, time_step = options
        x_out, x_prev_out, y_out, mass_out, shared, own = ops.raw.rigid_backward(
            *ops.as_list(fields, x), x_bar.contiguous(), v_bar.contiguous(), groups, data_count, time_step, needs[4]
        )
        if not x_prev_out.numel():
            x_prev_out = torch.zeros_like(x_prev)
        data_out = ops_rigid.join_data(shared, own, data_count) if needs[4] else energy_data
        return needed((x_out, x_prev_out, y_out, mass_out, data_out), fields, needs)

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


def needed(bars: Sequence[Tensor], fields: Sequence[Tensor | None], needs: Sequence[bool]) -> tuple[Tensor, ...]:
    """The adjoints of those first fields that need one, each in its field's shape."""
    return tuple(ops.sum_to(bar, t.shape) for bar, t, need in zip(bars, fields, needs, strict=False)
                 if need and t is not None)  # fmt: skip


def folded(size: int, tensors: tuple, in_dims: tuple, full: int) -> tuple[list[Any], int]:
    """Tensors of vmap with its dimension folded into that of scenes, and the scenes of a member. The first ``full``
    have the shape of positions afterwards."""
    given = [(t, d) for t, d in zip(tensors, in_dims, strict=False)]
    counts = [(t if d is None else t.movedim(d, 0)[0]).shape[0] for t, d in given if t is not None and t.numel() > 0]
    scenes = max(counts, default=1)
    out: list[Any] = [t if t is None or t.numel() == 0 else ops.fold_scenes(t, d, size, scenes) for t, d in given]
    shape = (size * scenes, *out[0].shape[1:])
    out[:full] = [t.expand(shape).contiguous() for t in out[:full]]
    return out, scenes


def correct(
    x: Tensor, x_prev: Tensor, y: Tensor, mass: Tensor, energy_data: Tensor, origin: Tensor | None, bodies: Bodies,
    others: OtherBodies, data_count: tuple[int, ...], time_step: float,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Positions after every listed body was moved rigidly to the least potential, and the velocities (x - x_prev) / h,
    [B, V, 3]; differentiable in the first five tensors, whose shapes are those of ops.SweepFields."""
    tensors = distinct(x, x_prev, y, mass, energy_data, origin)
    listed = (bodies.order, bodies.ptr, bodies.spread, others.of)
    return _Correct.apply(*tensors, *listed, bodies.groups, data_count, time_step)


ops.ready_signature(_Correct, _CorrectBackward)
