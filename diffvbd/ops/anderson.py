"""The compiled operators of Anderson's method: the combination of iterates, and the potential of two states."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from .fields import SweepFields
from .functions import raw_backward, shapes_of
from .load import raw


def anderson_combine(states: Tensor, mass: Tensor, order: Tensor, ptr: Tensor, regularization: float, noise: float
                     ) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """The combination of iterates [B, V, 3], not differentiable; the inverse of each body's system [B, bodies, window,
    window], and its solution gamma [B, bodies, window]. CPU only.

    Args:
        states: [2, window + 1, B, V, 3], where the last cycles began and where they ended [m].
        mass: [1 | B, V] [kg].
        order, ptr: Vertices that move, body by body, int32.
        regularization: Share of a system's diagonal that is added to it.
        noise: Differences of residuals of at most that share of the positions leave a body without numbers.
    """
    return raw.anderson_combine(states, mass, order, ptr, regularization, noise)


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


@shapes_of("anderson_combine")
def _(states, mass, order, ptr, regularization, noise):
    (window, scenes), bodies = states.shape[1:3], ptr.shape[0] - 1
    window -= 1
    return (states.new_empty(states.shape[2:]), states.new_empty((scenes, bodies, window, window)),
            states.new_empty((scenes, bodies, window)))  # fmt: skip


for _name in ("anderson_combine", "potential_rise"):
    torch.library.register_autograd(f"diffvbd::{_name}", raw_backward)
