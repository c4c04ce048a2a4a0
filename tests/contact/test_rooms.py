"""Claim: the rooms of bodies, compiled, are those that follow when every pass is written down in torch."""

from __future__ import annotations

from typing import NamedTuple

import pytest
import torch
from torch import Tensor

import diffvbd as dv
from diffvbd._contact.surface import ContactSurface
from diffvbd.ops import contact as ops_detect
from diffvbd.ops.contact import RoomsOfBodies
from diffvbd.ops.fields import WAYS
from diffvbd.step.contact import LEAST_ROOM, ROOM, Motion, motion_of, rooms
from diffvbd.testing import generator, tolerance

DHAT = 0.02
KEPT, KEPT_DEEP, DEEP = 0.9, 0.1, 0.1  # of a gap above a plane, see csrc/contact/above_floor.h


class Given(NamedTuple):
    surface: ContactSurface
    barrier: dv.PairBarrier
    x: Tensor
    origin: Tensor
    mass: Tensor
    move: Tensor
    fall: Tensor
    was: Tensor
    now: Tensor
    floor: Tensor | None

    def motion(self) -> Motion:
        return motion_of(self.surface, self.x, self.origin, self.mass, self.move, self.fall)

    def found(self) -> RoomsOfBodies:
        s, barrier, *rest, floor = self
        x, origin, mass, _, _, was, now = rest
        return rooms(self.motion(), s, barrier, x, origin, mass, was, now, floor, False)


def given(device: str, *, speed: float, pinned: bool, plane: bool, self_contact: bool, floor: bool = True,
          apart: float = 1.3, bodies: int = 4, points: int = 2) -> Given:  # fmt: skip
    """Two scenes of boxes beside each other, each with a motion of its own."""
    rng = generator("rooms", speed, pinned, plane)
    box = dv.mesh.box(points, 1.0)
    mesh = dv.mesh.join([box.translate([apart * k, 0.3 + 0.1 * k, 0]) for k in range(bodies)])
    things = (dv.colliders.Plane(point=(0, -0.1, 0), normal=(0, 1, 0)),) if plane else ()
    things = (*things, dv.colliders.Sphere((-2.0, 0.5, 0), 0.3))
    energies = (dv.StableNeoHookean(), dv.PairBarrier(1e3, DHAT, self_contact=self_contact))
    model = dv.Model(mesh, density=1000.0, energies=energies, colliders=things, pinned=[0] if pinned else None,
                     device=device)  # fmt: skip
    surface, barrier = model.surface_of_contact, model.contact
    assert surface is not None and barrier is not None
    x = model.rest_points.expand(2, -1, -1).contiguous()
    body = model.body
    of_body = torch.as_tensor(rng.standard_normal((2, bodies, 3)), dtype=x.dtype, device=device)
    own = torch.as_tensor(rng.standard_normal(x.shape), dtype=x.dtype, device=device)
    turn = torch.as_tensor(rng.standard_normal((2, bodies, 3)), dtype=x.dtype, device=device)
    move = speed * (of_body[:, body] + torch.linalg.cross(turn[:, body], x) + 0.1 * own)
    was = surface.collider_points.expand(2, -1, -1).contiguous()
    fall = torch.zeros_like(x) - 0.1 * speed * x.new_tensor([0.0, 1.0, 0.0])
    data = x.new_tensor([[0.0, 1.0, 0.0, 0.05, 1e3, DHAT, 0.0]]) if floor else None
    return Given(surface, barrier, x, x.new_empty((0,)), model.mass[None].contiguous(), move, fall, was,
                 was + 0.2 * speed, data)  # fmt: skip


def of_bodies(g: Given, lengths: Tensor, start: float, reduction: str) -> Tensor:
    body = g.surface.body[: g.x.shape[1]].long()
    out = lengths.new_full((g.x.shape[0], g.surface.bodies), start)
    return out.scatter_reduce(1, body.expand(lengths.shape), lengths, reduction)


def longest(g: Given, way: Tensor) -> Tensor:
    free = ~g.surface.held[: g.x.shape[1]]
    return of_bodies(g, torch.where(free, way.norm(dim=-1), 0.0), 0.0, "amax")


def left_by(g: Given, planes: Tensor, way: Tensor) -> Tensor:
    """What planes [B, P, 7] leave of the ways of bodies that go as wholes."""
    body, held = g.surface.body[: g.x.shape[1]].long(), g.surface.held[: g.x.shape[1]]
    shift, least = torch.zeros((2, g.surface.bodies, 3)).to(way), torch.ones((2, g.surface.bodies)).to(way)
    for normal, height, dhat in zip(planes[..., :3].unbind(1), planes[..., 3].T, planes[..., 5].T, strict=True):
        gap = ((g.x * normal[:, None]).sum(-1) - height[:, None]).clamp(min=0)
        deep, toward = DEEP * dhat[:, None], -(way * normal[:, None]).sum(-1)
        room = KEPT * (gap - deep).clamp(min=0) + KEPT_DEEP * torch.minimum(gap, deep)
        closes = (toward > room) & ~held
        excess = of_bodies(g, torch.where(closes, toward - room, 0.0), 0.0, "amax")
        shift = shift + excess[..., None] * normal[:, None]
        share = torch.where(closes, room / torch.where(closes, toward, 1.0), 1.0)
        least = torch.minimum(least, of_bodies(g, share, 1.0, "amin"))
    good = torch.ones_like(least, dtype=torch.bool)
    for normal, height, dhat in zip(planes[..., :3].unbind(1), planes[..., 3].T, planes[..., 5].T, strict=True):
        gap = ((g.x * normal[:, None]).sum(-1) - height[:, None]).clamp(min=0)
        deep, toward = DEEP * dhat[:, None], -(way * normal[:, None]).sum(-1)
        room = KEPT * (gap - deep).clamp(min=0) + KEPT_DEEP * torch.minimum(gap, deep)
        over = toward - (shift[:, body] * normal[:, None]).sum(-1) - room
        good &= of_bodies(g, torch.where(held, -1.0, over), -1.0, "amax") <= tolerance("sums_of_bodies")
    good = good[:, body, None]
    return torch.where(good, 1.0, least[:, body, None]) * way + torch.where(good, shift[:, body], 0.0)


def by_torch(g: Given) -> RoomsOfBodies:
    """As written down."""
    s, motion = g.surface, g.motion()
    body = s.body[: g.x.shape[1]].long()
    way = dict(zip(WAYS, motion.ways.longest, strict=True))
    falls = 2 * way["falls"] + LEAST_ROOM * DHAT
    pushed = (g.now - g.was).norm(dim=-1).amax(1, keepdim=True)
    first = s.planes.long() - g.x.shape[1]
    planes = []
    for a, b, c in (g.now[:, corners].unbind(1) for corners in first):
        n = torch.linalg.cross(b - a, c - a)
        n = n / n.norm(dim=-1, keepdim=True)
        height, rest = (n * a).sum(-1, keepdim=True), torch.zeros_like(n[:, :1])
        planes.append(torch.cat([n, height, rest, rest + DHAT, rest], -1))
    floors = [] if g.floor is None else [g.floor.reshape(1, -1, 7).expand(2, -1, -1)]
    every = torch.cat([*(p[:, None] for p in planes), *floors], 1) if planes or floors else g.x.new_zeros((2, 0, 7))
    stopped = torch.minimum(longest(g, g.move - left_by(g, every, g.move)), s.most_own_room)
    bent = longest(g, g.move - left_by(g, every, motion.rigid))

    def room_of(beside: Tensor, most: Tensor) -> Tensor:
        asked = ROOM * beside + way["bends"] + falls + stopped + 2 * DHAT
        return torch.maximum(torch.minimum(asked, most), way["driven"]) + pushed

    def last(room: Tensor) -> Tensor:
        return torch.cat([room, room.amax(1, keepdim=True)], 1)

    def islands(room: Tensor) -> Tensor:
        return ops_detect.contact_islands(g.x, g.origin, g.move, g.mass, g.was, g.now, s.planes, s.body, s.body_order,
                                          s.body_ptr, s.held, s.radius, last(room), s.bodies, DHAT)  # fmt: skip

    island = islands(room_of(way["bends"], s.most_room_alone)).long()
    alone = (island >= 0) & ((island[:, :, None] == island[:, None]).sum(-1) == 1)
    most = torch.where(alone, s.most_room_alone, s.most_room.expand(2, -1))
    room = room_of(way["bends"], most)
    for _ in range(3):  # whom a body meets gets room as well
        island = islands(room).long()
        same = ((island[:, :, None] == island[:, None]) & (island >= 0)[:, None]).to(g.x)
        joined = same @ motion.ways.sums
        u = torch.where((island >= 0)[..., None], joined[..., :3] / joined[..., 3:].clamp(min=1e-300), 0.0)
        beside = longest(g, g.move - u[:, body])
        room = torch.maximum(room, room_of(beside, most))
    wanted = beside + ROOM * way["stretched"]
    asks = wanted + (ROOM - 1) * beside + way["bends"] + falls + stopped
    over = torch.maximum(wanted / most, (asks / most).clamp(max=2))
    own = torch.zeros_like(room)
    if g.barrier.self_contact:
        own = torch.minimum((ROOM + 1) * (bent + way["stretched"]) + falls, s.most_own_room)
        own = torch.maximum(torch.maximum(own, torch.minimum(room, s.least_own_room)), way["driven"])
    island = islands(room)
    room = torch.where(island >= 0, room - pushed, room)  # which no collider comes near
    return RoomsOfBodies(island, last(room), last(own), over)


def check(g: Given) -> None:
    got, again = g.found(), g.found()
    for name, one, expected, same in zip(got._fields, got, by_torch(g), again, strict=True):
        if name == "over":  # up to 1 it makes no difference, and the CPU does not look whether a body is alone
            one, expected, same = (value.clamp(min=1) for value in (one, expected, same))
        torch.testing.assert_close(one, expected, rtol=tolerance("sums_of_bodies"), atol=0.0,
                                   msg=lambda text, name=name: f"{name}: {text}")  # fmt: skip
        assert torch.equal(one, same)
    assert (got.room > 0).all() and bool((got.own_room > 0).all()) == g.barrier.self_contact


@pytest.mark.parametrize("speed", [1e-4, 0.03, 0.5, 3.0])
@pytest.mark.parametrize("pinned", [False, True])
@pytest.mark.parametrize("plane", [False, True])
@pytest.mark.parametrize("self_contact", [False, True])
def test_as_plain_torch_says(device: str, speed: float, pinned: bool, plane: bool, self_contact: bool) -> None:
    check(given(device, speed=speed, pinned=pinned, plane=plane, self_contact=self_contact))


# one body; more than a CUDA block has warps, and more than it takes; bodies larger than a warp takes, and scenes larger
# than a block does
@pytest.mark.parametrize(("bodies", "points"), [(1, 2), (12, 2), (40, 2), (2, 7), (2, 14)])
def test_in_scenes_of_other_sizes(device: str, bodies: int, points: int) -> None:
    check(given(device, speed=0.5, pinned=True, plane=True, self_contact=True, bodies=bodies, points=points))


def test_what_is_not_finite_does_not_pass_for_a_room(device: str) -> None:
    g = given(device, speed=0.03, pinned=False, plane=True, self_contact=True)
    move = g.move.clone()
    move[1, -1, 0] = torch.nan
    found = g._replace(move=move).found()
    assert found.room[0].isfinite().all() and found.island[1, 3] == -1
    assert found.room[1, 3:].isnan().all() and found.over[1, 3].isnan()
