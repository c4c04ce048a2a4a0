"""The rigid correction of a step: every free body moved, as a whole, to where the step's potential is least.

    min over (R, t)   1/2 sum m |R r + t - y|^2 + the energies of single vertices,      r = x - center of mass

A rigid motion leaves the energy of the tets as it is, so this costs sums over vertices alone, and it is what few sweeps
do worst: they see neighbours, not the body. Away from planes and anchors the minimum is closed (means and a polar
factor); else it is Newton's method in six unknowns, differentiated as executed. docs/method.md, section 14.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from .. import ops
from ..model.bodies import Bodies, OtherBodies
from ..ops import distinct
from ..ops.contact import join_data

_TENSORS = 5  # differentiable fields: x, x_prev, y, mass, energy_data, all [1 | B, ...]
_FIELDS = len(ops.RigidFields._fields)


def _run(*args: Any) -> tuple[Tensor, Tensor]:
    return ops.direct.rigid(*ops.as_list(ops.RigidFields(*args[:_FIELDS]), args[0]), *args[_FIELDS:])


def _reverse(bars: Sequence[Tensor | None], saved: Sequence[Any], rest: tuple, needs: Sequence[bool]) -> list[Any]:
    x, data_count = saved[0], rest[1]
    x_bar = torch.zeros_like(x) if bars[0] is None else bars[0]
    v_bar = x.new_empty((0,)) if bars[1] is None else bars[1]
    *out, shared, own = ops.direct.rigid_backward(
        *ops.as_list(ops.RigidFields(*saved), x), x_bar, v_bar, *rest, needs[4]
    )
    return [*out, join_data(shared, own, data_count) if needs[4] else None]


def _vmap(apply: Any, info: Any, in_dims: tuple, *args: Any) -> tuple[tuple[Tensor, Tensor], tuple[int, int]]:
    tensors, scenes = ops.folded(info.batch_size, args[: _TENSORS + 1], in_dims, 3)
    x, v = apply(*tensors, *args[_TENSORS + 1 :])
    return (x.unflatten(0, (-1, scenes)), v.unflatten(0, (-1, scenes))), (0, 0)


# Fields; groups, data_count, time_step.
_correct = ops.Differentiable(_run, _reverse, arguments=_FIELDS + 3, inputs=_TENSORS, outputs=2, tensors=_FIELDS,
                              vmap=_vmap, batched=True)  # fmt: skip


def correct(
    x: Tensor, x_prev: Tensor, y: Tensor, mass: Tensor, energy_data: Tensor, origin: Tensor | None, bodies: Bodies,
    others: OtherBodies, data_count: tuple[int, ...], time_step: float,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Positions after every listed body was moved rigidly to the least potential, and the velocities (x - x_prev) / h,
    [B, V, 3]; differentiable in the first five tensors, whose shapes are those of ops.SweepFields."""
    tensors = distinct(x, x_prev, y, mass, energy_data, origin)
    listed = (bodies.order, bodies.ptr, bodies.spread, others.of)
    return _correct(*tensors, *listed, bodies.groups, data_count, time_step)
