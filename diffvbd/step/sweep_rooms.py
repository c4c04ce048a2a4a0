"""How far the sweeps of a part may carry each vertex."""

from __future__ import annotations

import torch
from torch import Tensor

from ..contact.barrier import PairBarrier
from ..contact.start import PartStart
from ..ops import sweep_rooms
from .rooms import LEAST_ROOM, ROOM, Motion


@torch.no_grad()
def rooms_of_sweeps(motion: Motion, barrier: PairBarrier, start: PartStart, x: Tensor, begin: Tensor, fall: Tensor,
                    rigid: Tensor) -> Tensor:  # fmt: skip
    """How far the sweeps may carry a vertex from where they find it [B, V] [m]: as far as a barrier pushes, weight
    pulls, elasticity takes back what bodies deform by on the way and, of what pairs have held up, all; the most of a
    scene, since bodies push one another. Index data.

    Args:
        motion, fall: What the part wanted.  start: Its start, whose rooms bound the whole way.
        x, begin: Where the sweeps begin, and where the part began.  rigid: Motion.rigid(). All [B, V, 3] [m].
    """
    surface, none = motion.surface, x.new_empty((0,))
    own_center, own_room = start.own or (none, none)
    x, led, begin, move, fall = (t.detach().contiguous() for t in (x, start.x, begin, motion.move, fall))
    return sweep_rooms.sweep_rooms(
        x, led, begin, move, fall, motion.largest(move - rigid), motion.stretched(rigid), start.center, start.room,
        own_center, own_room, surface.held, surface.body_order, surface.body_ptr, ROOM, LEAST_ROOM * barrier.dhat,
    )  # fmt: skip
