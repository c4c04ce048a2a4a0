"""Start of a substep with contact: translations of islands, what the floor lets through, how far all may go
at once."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from .._contact.surface import ContactSurface
from ..ops import contact as ops_contact
from ..ops.contact import Decided, PartBodies, Whole, ways_above_floor
from ..ops.fields import ASKS


class PartStart(NamedTuple):
    """Start of the sweeps of a substep."""

    x: Tensor  # [B, V, 3] [m]
    center: Tensor  # [B, V, 3]  from where each vertex has its room [m]; a number, not a function of the start
    room: Tensor  # [B, V]  how far from there it may go [m]
    own: tuple  # the same beside the rigid motion of its body; empty where bodies have no pairs of their own
    frames: Tensor | None  # [B, bodies]: share that pairs let each body go of its rigid motion above the floor
    short: Tensor  # [B, V] bool: pairs have held up more than a hundredth of its way
    stuck: Tensor  # [1] int64: pairs that hinder what is prescribed
    shares: tuple[Tensor, Tensor]  # how much of each of its two ways a vertex went, [B, V] each


def start_between_planes(x: Tensor, move: Tensor, fall: Tensor, mass: Tensor, was: Tensor, now: Tensor,
                         planes: Tensor | None, origin: Tensor, detection: Any, surface: ContactSurface,
                         rigid: Tensor, stretch: Tensor, raises: Callable[[Tensor, Tensor], Tensor], own_pairs: bool,
                         falls: bool) -> PartStart:  # fmt: skip
    """Every vertex as far along its way as pairs and floor let all go at once: by ``rigid`` each body as a whole, then
    by what is left of ``move``, then by ``fall``. A way of its own bends a body. A free one that a floor stops does not
    go it; one of which pairs hold some up, or that with self-contact takes much of the room in which the sweeps may
    take it back, goes it only where that does not raise its potential.

    Args:
        x, move, fall: [B, V, 3] [m].  mass: [1 | B, V] [kg].
        was, now: Collider points before and during the sweeps, [B, Vc, 3] [m].
        planes: Data of the FloorBarrier [1 | B, 7 planes], or None; differentiable as x, move, fall and mass.
        origin: [B, V, 3] or empty.  detection: of the step.
        rigid: Where rigid motions of bodies would take their vertices, as a way [B, V, 3] [m], differentiable.
        stretch: By how much the straight ways of that stretch each body, and what sweeps need to take it back
            [B, bodies] [m].
        raises: Of two states [B, V, 3], which vertices are of a body whose potential is higher in the second [B, V].
        own_pairs: Whether bodies have pairs of their own, and rooms for them.
        falls: Whether ``fall`` may be other than zero.
    """
    none = x.new_empty((0,))
    floor = none if planes is None else planes.contiguous()
    order, ptr = surface.body_order, surface.body_ptr
    x, move, fall, rigid = (t.contiguous() for t in (x, move, fall, rigid))
    was, now = was.detach(), now.detach()
    u = ops_contact.island_translation(move, mass.contiguous(), x, floor, origin, surface.held, surface.body, order,
                                       ptr, detection.island, detection.lowest)  # fmt: skip
    left, stopped = ops_contact.ways_above_floor(x, u, rigid, floor, origin, surface.held, order, ptr)
    bodies = PartBodies(surface.held, surface.held_bodies, surface.body, order, ptr)
    listed = detection.listed
    listed = (listed.pairs, listed.constants, listed.ptr, listed.entry)
    own_room = detection.own_room if own_pairs else none
    stuck: list[Tensor] = []

    def advance(at: Tensor, way: Tensor, by: Tensor, center: Tensor, **options: Any) -> Tensor:
        """Shares of a way; colliders and what is prescribed go in the first."""
        share, hindered = ops_contact.advance(at, way, by, center, origin, now if stuck else was, now,
                                                    surface.held, surface.body, room, listed, **options)  # fmt: skip
        stuck.append(hindered)
        return share

    def any_asks(state: Tensor) -> bool:
        return state.is_cuda or (state.numel() > 0 and int(state.max()) == ASKS)  # on CUDA to know would mean to wait

    with torch.no_grad():
        # bodies first, each as a whole
        limit, ways, center, room, own_rooms = ops_contact.frames(
            x, move, u, rigid, left, stretch, detection.room, own_room, bodies
        )
        frames, still = limit * advance(x, ways, u, x, whole=True), torch.zeros_like(u)
        whole = Whole(x, move, u, left, frames, floor, origin, bodies)
        # then vertices toward their wishes
        base, target, way, state = ops_contact.bends(whole, limit, stopped, own_room)
        own = (base, own_rooms) if own_pairs else ()
        if own_pairs and any_asks(state):
            way, state = ops_contact.hold(way, state, raises(base, target))
        share = advance(base, way, still, center, own=own)
        to, state = ops_contact.held_up(base, way, share, state, bodies)
        if any_asks(state):
            way, state = ops_contact.hold(way, state, raises(base, to))
            if any_asks(state):
                stuck.pop()  # once more, with those at rest: what let the others pass may have been their motion
                share = advance(base, way, still, center, own=own)
        # then all by their fall
        share, at, way = ops_contact.falls(whole, fall, share, state)
        shares = share, advance(at, way, still, center, own=own) if falls else torch.ones_like(share)
    decided = Decided(frames, shares, stopped, origin, bodies)
    start, short = ops_contact.part_start(x, move, fall, u, left, floor, decided)
    return PartStart(start, center, room, own, frames, short, sum(stuck[1:], stuck[0]), shares)


# --- displacements of whole bodies as floors limit them, differentiable -----------------------------------------------


def above_floor(x: Tensor, u: Tensor, way: Tensor, planes: Tensor, origin: Tensor, held: Tensor, order: Tensor,
                ptr: Tensor) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Displacements of whole bodies as a floor limits them, less u [B, V, 3] [m], and which bodies it stops [B,
    bodies]: they are shifted along its normals until no vertex closes more than a part of its gap, which leaves sliding
    and turning as they are. Differentiable, evenly where several vertices decide. docs/method.md, section 12.

    Args:
        x, way: [B, V, 3] [m].  u: [B, bodies, 3] [m], part of the way, which the floor lets pass; or empty.
        planes: Data of a FloorBarrier [1 | B, 7 planes], or empty.  origin: [B, V, 3] [m] or empty.
        held: [V] bool, whether something else moves a vertex.
        order, ptr: Vertices by body [V], and the first of each [bodies + 1], int32.
    """
    return ways_above_floor(x.contiguous(), u, way.contiguous(), planes.contiguous(), origin, held, order, ptr)
