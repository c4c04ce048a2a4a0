"""How far the bodies of a scene may go until pairs are found again, and how far contact lets them fall."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ..contact import detection as search
from ..contact.above_floor import above_floor
from ..contact.barrier import PairBarrier
from ..contact.surface import ContactSurface
from ..ops import broadcast
from ..ops import detect as ops_contact
from ..ops.segments import of_segments, sum_segments

ROOM = 1.5  # how far a vertex may go, over how far the farthest of its body wants to
LEAST_ROOM = 1.0  # of dhat, beside that: as far as a barrier that starts compressed may push


LEAST_INERTIA = 1e-9  # added to the inertia of a body, over its trace, lest one collapsed to a line has none across it


def _tiny(x: Tensor) -> float:
    return torch.finfo(x.dtype).tiny


def _by_body(values: Tensor, surface: ContactSurface) -> Tensor:
    """Sums over the vertices of each body, [B, V, n] -> [B, bodies, n]."""
    return sum_segments(values, surface.body_order, surface.body_ptr, surface.body[: values.shape[1]].long())


class Motion:
    """The ways [B, V, 3] [m] that vertices want to go, and what of them is a shift and a turn of each body;
    differentiable.

    x, origin: As the sweeps take them.  mass: [1 | B, V] [kg].
    """

    def __init__(self, surface: ContactSurface, x: Tensor, origin: Tensor, mass: Tensor, move: Tensor) -> None:
        self.surface, self.move = surface, move
        self.scenes, vertices = x.shape[:2]
        self.body, self.held = surface.body[:vertices].long(), surface.held[:vertices]
        self.free = ~self.held
        self.order = (surface.body_order, surface.body_ptr, self.body)
        self.weight = torch.where(self.free, broadcast(mass, (self.scenes, vertices)), 0.0)[..., None]
        at = x + origin if origin.numel() else x
        self.sums = _by_body(torch.cat([self.weight * move, self.weight, self.weight * at], -1), surface)
        whole = self.sums[..., 3:4].clamp(min=_tiny(x))
        self.mean, self.arm = self.sums[..., :3] / whole, at - self.of_vertices(self.sums[..., 4:] / whole)

    def of_vertices(self, values: Tensor) -> Tensor:
        """Values of bodies [B, bodies, n] for their vertices [B, V, n]."""
        return of_segments(values, *self.order)

    def largest(self, way: Tensor, beside: Tensor | None = None) -> Tensor:
        """The longest way [B, V, 3] of a free vertex of each body [B, bodies], beside one of the body [B, bodies, 3].
        Index data."""
        return self._longest(way, self.free, beside)

    def driven(self) -> Tensor:
        """The longest way of a vertex that is held [B, bodies]. Index data."""
        return self._longest(self.move, self.held)

    def _longest(self, way: Tensor, counts: Tensor, beside: Tensor | None = None) -> Tensor:
        way, beside = way.detach().contiguous(), None if beside is None else beside.detach().contiguous()
        return ops_contact.longest_ways(way, counts, *self.order[:2], beside)

    def rigid(self) -> Tensor:
        """Where t + w x r takes each vertex, as a way [B, V, 3] [m], with the body's linear and angular momentum: it
        brings no two points closer, nor does a share of it. Zero for bodies of which something is held."""
        arm, (scenes, bodies) = self.arm, self.mean.shape[:2]
        moment = torch.cat([torch.linalg.cross(arm, self.move), (arm[..., None] * arm[..., None, :]).flatten(-2)], -1)
        sums = _by_body(self.weight * moment, self.surface)
        # over its size, since the determinant of an inertia in kg m^2 may be no number in single precision
        size = sums[..., 3::4].sum(-1, keepdim=True)
        sums = sums / torch.where(size > 0, size, 1.0)
        eye = torch.eye(3, dtype=arm.dtype, device=arm.device)
        least = max(LEAST_INERTIA, torch.finfo(arm.dtype).eps)
        a, b, c = ((1 + least) * eye - sums[..., 3:].unflatten(-1, (3, 3))).unbind(-2)  # of the inertia: symmetric
        adjugate = torch.stack([torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)], -2)
        determinant = (a * adjugate[..., 0, :]).sum(-1, keepdim=True)
        turn = (adjugate * sums[..., :3, None]).sum(-2) / determinant.clamp(min=_tiny(arm))
        keep = (~self.surface.held_bodies & (determinant[..., 0] > 0) & (size[..., 0] > 0)).reshape(scenes, bodies, 1)
        turn, mean = self.of_vertices(torch.where(keep, torch.cat([turn, self.mean], -1), 0.0)).split(3, -1)
        return mean + torch.linalg.cross(turn, arm)

    def stretched(self, rigid: Tensor) -> Tensor:
        """How far the ways of a turn, which are straight, bring a vertex of each body [B, bodies] away from the turned
        body: by r (sqrt(1 + angle^2) - 1) at a distance r from the axis. rigid: of rigid(), or a share of it. Index
        data."""
        rigid, arm, mean = (a.detach().contiguous() for a in (rigid, self.arm, self.mean))
        turn, angle = ops_contact.longest_turns(rigid, arm, self.free, *self.order[:2], mean)
        return turn * angle / (1 + (1 + angle * angle).sqrt())


def _plane_colliders(surface: ContactSurface, points: Tensor, dhat: float) -> Tensor:
    """Plane colliders as data of a FloorBarrier, [B, 7 planes]. points: Of all colliders [B, Vc, 3] [m]."""
    first = surface.planes.long() - surface.body_order.shape[0]
    a, b, c = (points[:, corner] for corner in first.unbind(1))
    normal = torch.linalg.cross(b - a, c - a)
    normal = normal / normal.square().sum(-1, keepdim=True).sqrt().clamp(min=_tiny(points))
    rest = torch.zeros_like(normal[..., :1])
    return torch.cat([normal, (normal * a).sum(-1, keepdim=True), rest, rest + dhat, rest], -1).flatten(1)


class Rooms(NamedTuple):
    """How far the vertices of bodies may go until pairs are found again."""

    island: Tensor  # of each body [B, bodies] int32
    room: Tensor  # beside the island's translation, and the largest of the scene [B, bodies + 1] [m]
    own_room: Tensor  # beside the rigid motion of their own body, [B, bodies + 1] [m]
    over: Tensor  # how far they want to go, or up to 2 what they ask for, over the most room they get [B, bodies]


@torch.no_grad()
def rooms(motion: Motion, barrier: PairBarrier, x: Tensor, origin: Tensor, mass: Tensor, was: Tensor, now: Tensor,
          fall: Tensor, rigid: Tensor, floor: Tensor | None, any_direction: bool) -> Rooms:  # fmt: skip
    """Rooms follow from where a body wants to go: pairs that could meet within them are listed, and what does not want
    to move relative to its neighbours lists few. Index data.

    Args:
        x, origin: As the sweeps take them.  mass: [1 | B, V].  was, now: Collider points [B, Vc, 3] [m].
        motion, fall: Where each vertex wants to go.  rigid: Motion.rigid(), [B, V, 3] [m].
        floor: Data of the FloorBarrier, or None.  any_direction: As for detection.islands.
    """
    x, mass, was, now, rigid = (t.detach() for t in (x, mass, was, now, rigid))
    surface, move, sums = motion.surface, motion.move.detach(), motion.sums
    # The sweeps may take back all that the start has let fall and bent.
    falls = 2 * motion.largest(fall) + LEAST_ROOM * barrier.dhat
    bends = motion.largest(move, motion.mean)

    # What is prescribed goes where it goes: pairs with it are listed however far that is.
    driven = motion.driven()
    pushed = driven.new_zeros((motion.scenes, 1))
    if was.shape[1]:
        pushed = (now - was).square().sum(-1).sqrt().amax(1, keepdim=True)

    def with_largest(room: Tensor) -> Tensor:
        most = room.amax(1, keepdim=True) if surface.bodies else room.new_zeros((motion.scenes, 1))
        return torch.cat([room, most], 1)

    # What a plane stops on its way is left to the sweeps: they press and bend it.
    planes = torch.cat([_plane_colliders(surface, now, barrier.dhat), *([] if floor is None else [
        broadcast(floor.detach(), (motion.scenes, floor.shape[1]))])], 1)  # fmt: skip
    left, left_rigid = (
        above_floor(planes, origin, x, way, ~motion.free, motion.order, surface.bodies).way(way, motion.order)
        for way in (move, rigid)
    )
    stopped = motion.largest(move - left).clamp(max=surface.most_own_room)

    def asked(beside: Tensor) -> Tensor:
        return ROOM * beside + bends + falls + stopped

    def room_of(beside: Tensor, most: Tensor) -> Tensor:
        return torch.maximum(torch.minimum(asked(beside), most), driven) + pushed

    def islands(room: Tensor) -> Tensor:
        return search.islands(
            x, origin, move, mass.contiguous(), was, now, surface, barrier.dhat, with_largest(room), any_direction
        )

    def together(room: Tensor) -> tuple[Tensor, Tensor]:
        island = islands(room).long()
        return island, (island[:, :, None] == island[:, None]) & (island >= 0)[:, None]

    # A body that meets nothing in a larger room has it: it costs no pairs.
    most = surface.most_room.expand(motion.scenes, -1)
    wish = room_of(bends, surface.most_room_alone)
    if x.is_cuda or bool((wish > room_of(bends, most)).any()):
        island, same = together(wish)
        most = torch.where((island >= 0) & (same.sum(-1) == 1), surface.most_room_alone, most)

    # Islands depend on the rooms, and rooms on what an island leaves of a motion: hence twice.
    room = room_of(bends, most)
    island, same = together(room)
    joined = same.to(x.dtype) @ sums[..., :4]
    u = joined[..., :3] / joined[..., 3:].clamp(min=_tiny(x))
    u = torch.where((island >= 0)[..., None], u, 0.0)
    beside, stretched = motion.largest(move, u), motion.stretched(rigid)
    room = torch.maximum(room, room_of(beside, most))
    way, wanted = beside + ROOM * stretched, asked(beside) + ROOM * stretched
    over = torch.maximum(way / most, (wanted / most).clamp(max=2.0))  # which makes two parts, a longer way more
    own = torch.zeros_like(room)
    if barrier.self_contact:
        least = room.clamp(max=surface.least_own_room)
        own = (ROOM + 1) * (motion.largest(move - left_rigid) + stretched) + falls
        own = own.clamp(max=surface.most_own_room)
        own = torch.maximum(torch.maximum(own, least), driven)
    return Rooms(islands(room), with_largest(room), with_largest(own), over)
