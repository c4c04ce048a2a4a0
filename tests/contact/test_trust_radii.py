"""Claim: the rooms of bodies, compiled, are those that follow when every pass is written down in torch."""

from __future__ import annotations

from typing import NamedTuple

import pytest
import torch
from torch import Tensor

import diffvbd as dv
from diffvbd._contact.surface import ContactSurface
from diffvbd.ops import contact as ops_detect
from diffvbd.ops.contact import TrustRadii
from diffvbd.ops.fields import DISPLACEMENTS
from diffvbd.step.contact import LEAST_RADIUS, RADIUS_FACTOR, Motion, motion_of, trust_radii
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
    gravity_move: Tensor
    was: Tensor
    now: Tensor
    floor: Tensor | None

    def motion(self) -> Motion:
        return motion_of(self.surface, self.x, self.origin, self.mass, self.move, self.gravity_move)

    def found(self) -> TrustRadii:
        s, barrier, *rest, floor = self
        x, origin, mass, _, _, was, now = rest
        return trust_radii(self.motion(), s, barrier, x, origin, mass, was, now, floor, False)


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
    gravity_move = torch.zeros_like(x) - 0.1 * speed * x.new_tensor([0.0, 1.0, 0.0])
    data = x.new_tensor([[0.0, 1.0, 0.0, 0.05, 1e3, DHAT, 0.0]]) if floor else None
    return Given(surface, barrier, x, x.new_empty((0,)), model.mass[None].contiguous(), move, gravity_move, was,
                 was + 0.2 * speed, data)  # fmt: skip


def of_bodies(g: Given, lengths: Tensor, start: float, reduction: str) -> Tensor:
    body = g.surface.body[: g.x.shape[1]].long()
    out = lengths.new_full((g.x.shape[0], g.surface.bodies), start)
    return out.scatter_reduce(1, body.expand(lengths.shape), lengths, reduction)


def longest(g: Given, displacement: Tensor) -> Tensor:
    free = ~g.surface.pinned[: g.x.shape[1]]
    return of_bodies(g, torch.where(free, displacement.norm(dim=-1), 0.0), 0.0, "amax")


def left_by(g: Given, planes: Tensor, displacement: Tensor) -> Tensor:
    """What planes [B, P, 7] leave of the ways of bodies that go as wholes."""
    body, pinned = g.surface.body[: g.x.shape[1]].long(), g.surface.pinned[: g.x.shape[1]]
    shift, least = (
        torch.zeros((2, g.surface.bodies, 3)).to(displacement),
        torch.ones((2, g.surface.bodies)).to(displacement),
    )
    for normal, height, dhat in zip(planes[..., :3].unbind(1), planes[..., 3].T, planes[..., 5].T, strict=True):
        gap = ((g.x * normal[:, None]).sum(-1) - height[:, None]).clamp(min=0)
        deep, toward = DEEP * dhat[:, None], -(displacement * normal[:, None]).sum(-1)
        trust_radius = KEPT * (gap - deep).clamp(min=0) + KEPT_DEEP * torch.minimum(gap, deep)
        closes = (toward > trust_radius) & ~pinned
        excess = of_bodies(g, torch.where(closes, toward - trust_radius, 0.0), 0.0, "amax")
        shift = shift + excess[..., None] * normal[:, None]
        fraction = torch.where(closes, trust_radius / torch.where(closes, toward, 1.0), 1.0)
        least = torch.minimum(least, of_bodies(g, fraction, 1.0, "amin"))
    good = torch.ones_like(least, dtype=torch.bool)
    for normal, height, dhat in zip(planes[..., :3].unbind(1), planes[..., 3].T, planes[..., 5].T, strict=True):
        gap = ((g.x * normal[:, None]).sum(-1) - height[:, None]).clamp(min=0)
        deep, toward = DEEP * dhat[:, None], -(displacement * normal[:, None]).sum(-1)
        trust_radius = KEPT * (gap - deep).clamp(min=0) + KEPT_DEEP * torch.minimum(gap, deep)
        over = toward - (shift[:, body] * normal[:, None]).sum(-1) - trust_radius
        good &= of_bodies(g, torch.where(pinned, -1.0, over), -1.0, "amax") <= tolerance("sums_of_bodies")
    good = good[:, body, None]
    return torch.where(good, 1.0, least[:, body, None]) * displacement + torch.where(good, shift[:, body], 0.0)


def by_torch(g: Given) -> TrustRadii:
    """As written down."""
    s, motion = g.surface, g.motion()
    body = s.body[: g.x.shape[1]].long()
    displacement = dict(zip(DISPLACEMENTS, motion.displacements.longest, strict=True))
    gravity_moves = 2 * displacement["gravity"] + LEAST_RADIUS * DHAT
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
    stopped = torch.minimum(longest(g, g.move - left_by(g, every, g.move)), s.max_deformation_radius)
    bent = longest(g, g.move - left_by(g, every, motion.rigid))

    def radius_of(beside: Tensor, most: Tensor) -> Tensor:
        asked = RADIUS_FACTOR * beside + displacement["bends"] + gravity_moves + stopped + 2 * DHAT
        return torch.maximum(torch.minimum(asked, most), displacement["driven"]) + pushed

    def last(trust_radius: Tensor) -> Tensor:
        return torch.cat([trust_radius, trust_radius.amax(1, keepdim=True)], 1)

    def islands(trust_radius: Tensor) -> Tensor:
        return ops_detect.contact_islands(g.x, g.origin, g.move, g.mass, g.was, g.now, s.planes, s.body, s.body_order,
                                          s.body_ptr, s.pinned, s.radius, last(trust_radius), s.bodies,
                                          DHAT)  # fmt: skip

    island = islands(radius_of(displacement["bends"], s.max_trust_radius_alone)).long()
    alone = (island >= 0) & ((island[:, :, None] == island[:, None]).sum(-1) == 1)
    most = torch.where(alone, s.max_trust_radius_alone, s.max_trust_radius.expand(2, -1))
    trust_radius = radius_of(displacement["bends"], most)
    for _ in range(3):  # whom a body meets gets room as well
        island = islands(trust_radius).long()
        same = ((island[:, :, None] == island[:, None]) & (island >= 0)[:, None]).to(g.x)
        joined = same @ motion.displacements.sums
        u = torch.where((island >= 0)[..., None], joined[..., :3] / joined[..., 3:].clamp(min=1e-300), 0.0)
        beside = longest(g, g.move - u[:, body])
        trust_radius = torch.maximum(trust_radius, radius_of(beside, most))
    wanted = beside + RADIUS_FACTOR * displacement["stretched"]
    pending = wanted + (RADIUS_FACTOR - 1) * beside + displacement["bends"] + gravity_moves + stopped
    over = torch.maximum(wanted / most, (pending / most).clamp(max=2))
    own = torch.zeros_like(trust_radius)
    if g.barrier.self_contact:
        own = torch.minimum((RADIUS_FACTOR + 1) * (bent + displacement["stretched"]) + gravity_moves,
                            s.max_deformation_radius)  # fmt: skip
        own = torch.maximum(torch.maximum(own, torch.minimum(trust_radius, s.min_deformation_radius)),
                            displacement["driven"])  # fmt: skip
    island = islands(trust_radius)
    trust_radius = torch.where(island >= 0, trust_radius - pushed, trust_radius)  # which no collider comes near
    return TrustRadii(island, last(trust_radius), last(own), over)


def check(g: Given) -> None:
    got, again = g.found(), g.found()
    for name, one, expected, same in zip(got._fields, got, by_torch(g), again, strict=True):
        if name == "over":  # up to 1 it makes no difference, and the CPU does not look whether a body is alone
            one, expected, same = (value.clamp(min=1) for value in (one, expected, same))
        torch.testing.assert_close(one, expected, rtol=tolerance("sums_of_bodies"), atol=0.0,
                                   msg=lambda text, name=name: f"{name}: {text}")  # fmt: skip
        assert torch.equal(one, same)
    assert (got.trust_radius > 0).all() and bool((got.deformation_radius > 0).all()) == g.barrier.self_contact


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
    assert found.trust_radius[0].isfinite().all() and found.island[1, 3] == -1
    assert found.trust_radius[1, 3:].isnan().all() and found.over[1, 3].isnan()
