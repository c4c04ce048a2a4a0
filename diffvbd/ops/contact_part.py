"""The compiled operators of the start of a part that go over bodies or vertices once, as in sweep.py."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ..safeguards import FILTER_ETA
from .functions import raw_backward, shapes_of
from .load import direct as raw

ASKS = 2  # state of a vertex that rests unless the potential of its body lets it go; kAsks in csrc/contact/part.h


class PartBodies(NamedTuple):
    """The bodies of a scene, as these operators take them."""

    held: Tensor  # [V] bool, and perhaps of colliders
    held_bodies: Tensor  # [bodies] bool: a vertex of it is held
    body: Tensor  # [V] int32, and perhaps of colliders
    order: Tensor  # [V] int32, vertices by body
    ptr: Tensor  # [bodies + 1] int32


class Whole(NamedTuple):
    """Where bodies go as wholes, and what a floor takes from all ways."""

    x: Tensor  # [B, V, 3] [m]
    move: Tensor  # [B, V, 3] [m], where each vertex wants to go from there
    u: Tensor  # [B, bodies, 3] [m], translation of its island
    left: Tensor  # [B, V, 3] [m], what a floor leaves of the way of its body beside that
    frames: Tensor  # [B, bodies], share of that way
    planes: Tensor  # [1 | B, 7 planes] data of a FloorBarrier, or empty
    origin: Tensor  # [B, V, 3] [m], or empty
    bodies: PartBodies


def above_floor(x: Tensor, u: Tensor, way: Tensor, planes: Tensor, origin: Tensor, held: Tensor, order: Tensor,
                ptr: Tensor) -> tuple[Tensor, Tensor]:  # fmt: skip
    """What a floor leaves of ways of bodies as wholes, less u [B, V, 3] [m], and which bodies it stops [B, bodies].

    Args:
        x, way: [B, V, 3] [m].  u: [B, bodies, 3] [m], part of the way, which the floor lets pass; or empty.
        planes, origin: As of Whole.  held: [V] bool, whether something else moves a vertex.
        order, ptr: Vertices by body [V], and the first of each [bodies + 1], int32.

    Raises:
        ValueError: A tensor with the wrong shape, dtype or device.
    """
    return raw.contact_above_floor(x, u, way, planes, origin, held, order, ptr)


def above_floor_backward(bar: Tensor, x: Tensor, u: Tensor, way: Tensor, planes: Tensor, origin: Tensor, held: Tensor,
                         order: Tensor, ptr: Tensor, wants_planes: bool) -> tuple[Tensor, ...]:  # fmt: skip
    """Adjoints of x [B, V, 3], u [B, bodies, 3], way [B, V, 3] and planes [B, bodies, 7 planes or 0]."""
    return raw.contact_above_floor_backward(bar, x, u, way, planes, origin, held, order, ptr, wants_planes)


def frames(x: Tensor, move: Tensor, u: Tensor, way: Tensor, left: Tensor, stretch: Tensor, room: Tensor,
           own_room: Tensor, bodies: PartBodies) -> tuple[Tensor, ...]:  # fmt: skip
    """As far as rooms let bodies go as wholes. Not differentiable.

    Args:
        x, move, u, left: As of Whole.  way: Rigid motions of bodies [B, V, 3] [m].
        stretch: By how much the straight ways of that stretch each body [B, bodies] [m].
        room, own_room: Of bodies, and of all [B, bodies + 1] [m]; own_room may be empty.

    Returns:
        limit [B, bodies], share of ``left``; the ways that vertices go with it, and from where they have their rooms
        [B, V, 3] [m]; rooms and own rooms of vertices [B, V] [m].
    """
    return raw.contact_frames(x, move, u, way, left, stretch, room, own_room, *bodies)


def bends(at: Whole, limit: Tensor, stopped: Tensor, own_room: Tensor) -> tuple[Tensor, ...]:
    """Where bodies have come as wholes, where vertices want to be, their ways there [B, V, 3] [m], and their state
    [B, V] uint8: 0 goes, 1 rests, ASKS. Not differentiable.

    limit [B, bodies], stopped [B, bodies] bool: of frames() and above_floor().  own_room: [B, bodies + 1] [m] or empty.
    """
    return raw.contact_bends(*at[:5], limit, stopped, own_room, *at[5:7], *at.bodies, FILTER_ETA)


def hold(way: Tensor, state: Tensor, rises: Tensor) -> tuple[Tensor, Tensor]:
    """Ways and state once those that ask are told whether their potential ``rises`` [B, V] bool: then they rest, and
    their state remains. Not differentiable."""
    return raw.contact_hold(way, state, rises)


def held_up(base: Tensor, way: Tensor, share: Tensor, state: Tensor, bodies: PartBodies) -> tuple[Tensor, Tensor]:
    """Where vertices come by shares [B, V] of their ways [B, V, 3], and their state: those ask of whose body pairs hold
    some up. Not differentiable."""
    return raw.contact_held_up(base, way, share, state, *bodies)


def falls(at: Whole, fall: Tensor, share: Tensor, state: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Shares [B, V], 0 of those that rest, where vertices come by them, and their ways from there by ``fall``
    [B, V, 3] [m], of which a floor takes what would come too close. Not differentiable."""
    return raw.contact_falls(*at[:2], fall, *at[2:5], share, state, *at[5:7], *at.bodies, FILTER_ETA)


def start(at: Whole, fall: Tensor, share: Tensor, last_share: Tensor, stopped: Tensor) -> tuple[Tensor, Tensor]:
    """Where the part starts [B, V, 3] [m], by shares [B, V] of the way toward the wish and of the fall; and of which
    vertices that are not stopped pairs have held up more than a hundredth of a way [B, V] bool."""
    return raw.contact_start(*at[:2], fall, *at[2:5], share, last_share, stopped, *at[5:7], *at.bodies, FILTER_ETA)


def start_backward(bar: Tensor, at: Whole, fall: Tensor, share: Tensor, last_share: Tensor, wants_planes: bool
                   ) -> tuple[Tensor, ...]:  # fmt: skip
    """Adjoints of x, move, fall, u (for each vertex) and left [B, V, 3], planes [B, V, 7 planes or 0]."""
    return raw.contact_start_backward(bar, *at[:2], fall, *at[2:5], share, last_share, *at[5:7], *at.bodies, FILTER_ETA,
                                      wants_planes)  # fmt: skip


# --- shapes without execution, no autograd ----------------------------------------------------------------------------


def _of_planes(planes: Tensor, wanted: bool) -> int:
    return planes.shape[-1] if wanted and planes.numel() else 0


@shapes_of("contact_above_floor")
def _(x, u, way, planes, origin, held, order, ptr):
    return torch.empty_like(x), x.new_empty((x.shape[0], ptr.shape[0] - 1), dtype=torch.bool)


@shapes_of("contact_above_floor_backward")
def _(bar, x, u, way, planes, origin, held, order, ptr, wants_planes):
    scenes, bodies = x.shape[0], ptr.shape[0] - 1
    of_bodies = x.new_empty((scenes if u.numel() else 0, bodies, 3))
    of_planes = x.new_empty((scenes, bodies, _of_planes(planes, wants_planes)))
    return torch.empty_like(x), of_bodies, torch.empty_like(x), of_planes


@shapes_of("contact_frames")
def _(x, move, u, way, left, stretch, room, own_room, held, held_bodies, body, order, ptr):
    own = x.new_empty((x.shape[0] if own_room.numel() else 0, x.shape[1]))
    return torch.empty_like(stretch), torch.empty_like(x), torch.empty_like(x), x.new_empty(x.shape[:2]), own


@shapes_of("contact_bends")
def _(x, move, u, left, frames, limit, stopped, own_room, planes, origin, held, held_bodies, body, order, ptr,
      filter_eta):  # fmt: skip
    return *(torch.empty_like(x) for _ in range(3)), x.new_empty(x.shape[:2], dtype=torch.uint8)


@shapes_of("contact_hold")
def _(way, state, rises):
    return torch.empty_like(way), torch.empty_like(state)


@shapes_of("contact_held_up")
def _(base, way, share, state, held, held_bodies, body, order, ptr):
    return torch.empty_like(base), torch.empty_like(state)


@shapes_of("contact_falls")
def _(x, move, fall, u, left, frames, share, state, planes, origin, held, held_bodies, body, order, ptr, filter_eta):
    return torch.empty_like(share), torch.empty_like(x), torch.empty_like(x)


@shapes_of("contact_start")
def _(x, move, fall, u, left, frames, share, last_share, stopped, planes, origin, held, held_bodies, body, order, ptr,
      filter_eta):  # fmt: skip
    return torch.empty_like(x), torch.empty_like(share, dtype=torch.bool)


@shapes_of("contact_start_backward")
def _(bar, x, move, fall, u, left, frames, share, last_share, planes, origin, held, held_bodies, body, order, ptr,
      filter_eta, wants_planes):  # fmt: skip
    own = x.new_empty((*x.shape[:2], _of_planes(planes, wants_planes)))
    return *(torch.empty_like(x) for _ in range(5)), own


_WITH_ADJOINT = ("above_floor", "start")
for _name in ("frames", "bends", "hold", "held_up", "falls", *_WITH_ADJOINT):
    for _end in ("", "_backward") if _name in _WITH_ADJOINT else ("",):
        torch.library.register_autograd(f"diffvbd::contact_{_name}{_end}", raw_backward)
