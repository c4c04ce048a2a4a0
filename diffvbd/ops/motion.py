"""The compiled operators of how bodies want to move, and how far they may. Raw and functional, as in sweep.py; sizes as
in detect.py."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from .functions import raw_backward, shapes_of
from .load import direct as raw

WAYS = ("bends", "driven", "apart", "stretched", "falls")  # twins of Way in csrc/contact/motion.h


class Ways(NamedTuple):
    """How the vertices of each body want to go."""

    rigid: Tensor  # [B, V, 3] [m]  the rigid motion with the body's momentum, as a way; zero where a vertex is held
    longest: Tensor  # [5, B, NB] [m]  the longest ways of a vertex, of the kinds of WAYS
    sums: Tensor  # [B, NB, 4]  momentum times the time [kg m] and mass [kg] of the vertices that are free


def contact_motion(x: Tensor, origin: Tensor, mass: Tensor, move: Tensor, fall: Tensor, held: Tensor,
                   held_bodies: Tensor, order: Tensor, ptr: Tensor) -> Ways:  # fmt: skip
    """The rigid motion that has each body's linear and angular momentum, and the longest ways.

    Longest ways of a body are, of the vertices that are free, beside their mean way (bends), beside the rigid motion
    (apart) and by ``fall`` (falls); of those that are held (driven); and how far the straight way of a turn ends from
    the turned body (stretched). NaN where one is NaN. They are not differentiated; results repeat to the bit.

    Args:
        x, origin: As for :func:`diffvbd.ops.detect.contact_detect`.  mass: [1 | B, V] [kg].
        move, fall: [B, V, 3] [m]; fall may be empty.
        held, held_bodies: [V] or more, [NB] bool: what something else moves, and which bodies have such a vertex.
        order, ptr: Vertices by body [V], and the first of each body [NB + 1].

    Raises:
        ValueError: A tensor with the wrong shape, dtype or device.
    """
    return Ways(*raw.contact_motion(x, origin, mass, move, fall, held, held_bodies, order, ptr))


def contact_motion_backward(bar: Tensor, x: Tensor, origin: Tensor, mass: Tensor, move: Tensor, held: Tensor,
                            held_bodies: Tensor, order: Tensor, ptr: Tensor
                            ) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """Adjoints of x [B, V, 3], of mass [B, V] and of move [B, V, 3], from that of the rigid motion."""
    return raw.contact_motion_backward(bar, x, origin, mass, move, held, held_bodies, order, ptr)


def contact_coast(x: Tensor, mass: Tensor, move: Tensor, held: Tensor, held_bodies: Tensor, order: Tensor, ptr: Tensor,
                  chord: float) -> Tensor:  # fmt: skip
    """``move`` [B, V, 3] [m], of free bodies without the stretch of straight lines: their shape goes on by what is not
    a turn, and the turn is one of the whole body.

    Args:
        x: [B, V, 3] [m].  mass: [1 | B, V] [kg].  move, held, held_bodies, order, ptr: As for :func:`contact_motion`.
        chord: How far back along its way a vertex is taken to have been, over that way.

    Raises:
        ValueError: A tensor with the wrong shape, dtype or device, or a chord of 0.
    """
    return raw.contact_coast(x, mass, move, held, held_bodies, order, ptr, chord)


def contact_coast_backward(bar: Tensor, x: Tensor, mass: Tensor, move: Tensor, held: Tensor, held_bodies: Tensor,
                           order: Tensor, ptr: Tensor, chord: float) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """Adjoints of x [B, V, 3], of mass [B, V] and of move [B, V, 3]."""
    return raw.contact_coast_backward(bar, x, mass, move, held, held_bodies, order, ptr, chord)


class RoomsOfBodies(NamedTuple):
    """How far the vertices of bodies may go until pairs are found again. Index data."""

    island: Tensor  # of each body [B, NB] int32, see contact_islands
    room: Tensor  # beside the island's translation, and the largest of the scene [B, NB + 1] [m]
    own_room: Tensor  # beside the rigid motion of their own body, [B, NB + 1] [m]
    over: Tensor  # how far they want to go, or up to 2 what they ask for, over the most room they get [B, NB]


def contact_rooms(x: Tensor, origin: Tensor, mass: Tensor, move: Tensor, held: Tensor, order: Tensor, ptr: Tensor,
                  ways: Ways, floor: Tensor, collider: Tensor, collider_next: Tensor, planes: Tensor, body: Tensor,
                  radius: Tensor, most: Tensor, most_alone: Tensor, most_own: Tensor, least_own: Tensor, dhat: float,
                  share: float, least: float, any_direction: bool, self_contact: bool) -> RoomsOfBodies:  # fmt: skip
    """Rooms follow from where a body wants to go: pairs that could meet within them are listed, and what does not want
    to move relative to its neighbours lists few. Not differentiable; results repeat to the bit.

    Args:
        x, origin, mass, move, held, order, ptr: As for :func:`contact_motion`, held [N].  ways: What that returned.
        floor: Data of the FloorBarrier [1 | B, 7 planes], or empty.
        collider, collider_next, planes, body, radius, any_direction: As for contact_islands.
        most, most_alone, most_own, least_own: Bounds of the rooms of each body [NB] [m], see ContactSurface.
        dhat: [m].  share, least: What a room is over a body's way beside its island, and beside that [m].
        self_contact: Whether bodies have pairs, and so rooms, of their own.

    Raises:
        ValueError: A tensor with the wrong shape, dtype or device.
    """
    return RoomsOfBodies(
        *raw.contact_rooms(
            x, origin, mass, move, held, order, ptr, *ways, floor, collider, collider_next, planes, body, radius, most,
            most_alone, most_own, least_own, dhat, share, least, any_direction, self_contact,
        )
    )  # fmt: skip


@shapes_of("contact_motion")
def _(x, origin, mass, move, fall, held, held_bodies, order, ptr):
    b, bodies = x.shape[0], ptr.shape[0] - 1
    return torch.empty_like(x), x.new_empty((len(WAYS), b, bodies)), x.new_empty((b, bodies, 4))


@shapes_of("contact_motion_backward")
def _(bar, x, origin, mass, move, held, held_bodies, order, ptr):
    return torch.empty_like(x), x.new_empty(x.shape[:2]), torch.empty_like(x)


@shapes_of("contact_coast")
def _(x, mass, move, held, held_bodies, order, ptr, chord):
    return torch.empty_like(x)


@shapes_of("contact_coast_backward")
def _(bar, x, mass, move, held, held_bodies, order, ptr, chord):
    return torch.empty_like(x), x.new_empty(x.shape[:2]), torch.empty_like(x)


@shapes_of("contact_rooms")
def _(x, origin, mass, move, held, order, ptr, rigid, ways, sums, floor, collider, collider_next, planes, body, radius,
      most, most_alone, most_own, least_own, dhat, share, least, any_direction, self_contact):  # fmt: skip
    b, bodies = x.shape[0], ptr.shape[0] - 1
    island = x.new_empty((b, bodies), dtype=torch.int32)
    return island, *(x.new_empty((b, bodies + 1)) for _ in range(2)), x.new_empty((b, bodies))


for _name in ("contact_motion", "contact_motion_backward", "contact_coast", "contact_coast_backward", "contact_rooms"):
    torch.library.register_autograd(f"diffvbd::{_name}", raw_backward)
