"""The compiled operator of the rooms of sweeps, as in sweep.py."""

from __future__ import annotations

import torch
from torch import Tensor

from .functions import raw_backward, shapes_of
from .load import direct as raw


def sweep_rooms(x: Tensor, start: Tensor, begin: Tensor, move: Tensor, fall: Tensor, apart: Tensor, stretched: Tensor,
                center: Tensor, room: Tensor, own_center: Tensor, own_room: Tensor, held: Tensor, body_order: Tensor,
                body_ptr: Tensor, more: float, least: float) -> Tensor:  # fmt: skip
    """How far sweeps may carry each vertex from x, [B, V] [m]; 0 where one is held, NaN where what it follows from is.

    A body wants as far as its vertices fall and go apart, a correction has moved them, and ``more`` times what pairs
    have held up and it was stretched. A vertex has ``least`` and the most that a body of its scene wants, but no more
    than what is left of its rooms. Not differentiable; results repeat to the bit.

    Args:
        x, start: [B, V, 3] [m], where sweeps begin, and where the start of the part led.
        begin, move, fall: [B, V, 3] [m], where the part began, and what of its way each vertex wanted.
        apart, stretched: [B, bodies] [m], longest way beside the rigid motion, and what straight ways stretch it by.
        center, room, own_center, own_room: [B, V, 3] and [B, V] [m], how far from where a vertex may go, and the same
            beside the rigid motion of its body; the latter empty where bodies have no pairs of their own.
        held: [V] or more, bool.  body_order, body_ptr: Vertices by body [V], and the first of each [bodies + 1].

    Raises:
        ValueError: A tensor with the wrong shape, dtype or device.
    """
    return raw.contact_sweep_rooms(x, start, begin, move, fall, apart, stretched, center, room, own_center, own_room,
                                   held, body_order, body_ptr, more, least)  # fmt: skip


@shapes_of("contact_sweep_rooms")
def _(x, start, begin, move, fall, apart, stretched, center, room, own_center, own_room, held, body_order, body_ptr,
      more, least):  # fmt: skip
    return x.new_empty(x.shape[:2])


torch.library.register_autograd("diffvbd::contact_sweep_rooms", raw_backward)
