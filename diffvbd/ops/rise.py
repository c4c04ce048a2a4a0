"""The compiled operator of the rise of the potentials of bodies."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from .fields import SweepFields
from .functions import raw_backward, shapes_of
from .load import raw


def potential_rise(fields: SweepFields, x: Tensor, to: Tensor, material: Tensor, rest: Tensor, index: Sequence[Tensor],
                   data_count: Sequence[int], time_step: float) -> Tensor:  # fmt: skip
    """By how much the potential of each body rises from x to ``to`` [kg m^2, times h^2], and the sum of the sizes of
    its terms, float64 [B, bodies, 2]; infinite where a vertex would lose more of a gap than a step may.

    Args:
        fields: Of the step; where its sweeps start does not enter.
        x, to: Positions [m], [B, V, 3].
        material, rest: [1 | B, blocks, 2 | 7, 8], of the tets by body.
        index: order, ptr, of the OtherBodies (of no meaning here), corner and block_ptr of MovingBodies, int32.
    """
    absent = x.new_empty((0,))
    origin = absent if fields.origin is None else fields.origin
    return raw.potential_rise(x, to, fields.x_prev, fields.y, fields.mass, fields.energy_data, origin, material, rest,
                              *index, list(data_count), time_step)  # fmt: skip


@shapes_of("potential_rise")
def _(x, to, x_prev, y, mass, energy_data, origin, material, rest, order, ptr, *others):
    return x.new_empty((x.shape[0], ptr.shape[0] - 1, 2), dtype=torch.float64)


torch.library.register_autograd("diffvbd::potential_rise", raw_backward)
