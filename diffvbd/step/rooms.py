"""Trust regions: how far bodies may move until pairs are found again, and how far sweeps may move each vertex."""

from __future__ import annotations

import torch
from torch import Tensor

from ..contact.barrier import PairBarrier
from ..contact.start import PartStart
from ..contact.surface import ContactSurface
from ..ops.contact import RoomsOfBodies, contact_rooms, sweep_rooms
from .motion import Motion

ROOM = 1.5  # how far a vertex may go, over how far the farthest of its body wants to
LEAST_ROOM = 1.0  # of dhat, beside that: as far as a barrier that starts compressed may push


@torch.no_grad()
def rooms(motion: Motion, surface: ContactSurface, barrier: PairBarrier, x: Tensor, origin: Tensor, mass: Tensor,
          was: Tensor, now: Tensor, floor: Tensor | None, any_direction: bool) -> RoomsOfBodies:  # fmt: skip
    """Trust-region radii of bodies until pairs are found again. Index data.

    Args:
        motion: Where each vertex wants to go.  x, origin: As the sweeps take them.  mass: [1 | B, V] [kg].
        was, now: Collider points [B, Vc, 3] [m].  floor: Data of the FloorBarrier, or None.
        any_direction: Whether the floor has planes across the axes, along which a translation may be turned.
    """
    s, dhat = surface, barrier.dhat
    floor = x.new_empty((0,)) if floor is None else floor.detach().contiguous()
    return contact_rooms(
        x.detach(), origin, mass.detach().contiguous(), motion.move.detach().contiguous(), s.held, s.body_order,
        s.body_ptr, motion.ways, floor, was.detach(), now.detach(), s.planes, s.body, s.radius, s.most_room,
        s.most_room_alone, s.most_own_room, s.least_own_room, dhat, ROOM, LEAST_ROOM * dhat, any_direction,
        barrier.self_contact,
    )  # fmt: skip


@torch.no_grad()
def rooms_of_sweeps(motion: Motion, surface: ContactSurface, barrier: PairBarrier, start: PartStart, x: Tensor,
                    begin: Tensor) -> Tensor:  # fmt: skip
    """Largest displacement of a vertex by the sweeps [B, V] [m]: as far as a barrier pushes, weight
    pulls, elasticity takes back what bodies deform by on the way and, of what pairs have held up, all; the most of a
    scene, since bodies push one another. Index data.

    Args:
        motion: What the part wanted.  start: Its start, whose rooms bound the whole way.
        x, begin: Where the sweeps begin, and where the part began, [B, V, 3] [m].
    """
    s, none = surface, x.new_empty((0,))
    own_center, own_room = start.own or (none, none)
    x, led, begin, move, fall = (t.detach().contiguous() for t in (x, start.x, begin, motion.move, motion.fall))
    return sweep_rooms(
        x, led, begin, move, fall, motion.apart, motion.stretched, start.center, start.room, own_center, own_room,
        s.held, s.body_order, s.body_ptr, ROOM, LEAST_ROOM * barrier.dhat,
    )  # fmt: skip
