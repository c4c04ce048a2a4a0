"""Claim: islands, their translations and the trust-region radii of bodies, compiled, are those that follow when every
pass is written down in torch."""

from __future__ import annotations

from typing import Any, NamedTuple

import pytest
import torch
from helpers.marks import slow
from torch import Tensor

import diffvbd as dv
from diffvbd._contact.surface import LEAST_CAPACITY, ContactSurface
from diffvbd.ops.contact import Found
from diffvbd.ops.fields import DISPLACEMENTS
from diffvbd.step.contact import LEAST_RADIUS, RADIUS_FACTOR, find
from diffvbd.testing import generator, tolerance

DHAT = 0.02
GRID = 0.125  # of dhat, see csrc/contact/trust_region.h


class TrustRadii(NamedTuple):
    """These of Found."""

    island: Tensor
    u: Tensor
    trust_radius: Tensor
    deformation_radius: Tensor


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
    floor: Tensor

    def found(self) -> Found:
        return find(*self, LEAST_CAPACITY)


def given(device: str, *, speed: float, pinned: bool, plane: bool, self_contact: bool, apart: float = 1.3,
          bodies: int = 4, points: int = 2) -> Given:  # fmt: skip
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
    data = x.new_tensor([[0.0, 1.0, 0.0, 0.05, 1e3, DHAT, 0.0]])
    return Given(surface, barrier, x, x.new_empty((0,)), model.mass[None].contiguous(), move, gravity_move, was,
                 was + 0.2 * speed, data)  # fmt: skip


def of_bodies(g: Given, lengths: Tensor, start: float, reduction: str) -> Tensor:
    body = g.surface.body[: g.x.shape[1]].long()
    out = lengths.new_full((g.x.shape[0], g.surface.bodies), start)
    return out.scatter_reduce(1, body.expand(lengths.shape), lengths, reduction)


def longest(g: Given, displacement: Tensor) -> Tensor:
    free = ~g.surface.pinned[: g.x.shape[1]]
    return of_bodies(g, torch.where(free, displacement.norm(dim=-1), 0.0), 0.0, "amax")


def planes_of(g: Given) -> Tensor:
    """Planes of the colliders, as they are during the sweeps, and of the floor [B, P, 4]: normal, height that a body's
    box reaches."""
    scenes, first = len(g.x), g.surface.planes.long() - g.x.shape[1]
    out = [g.x.new_zeros((scenes, 0, 4))]
    for corners in first:
        a, b, c = g.now[:, corners].unbind(1)
        n = torch.linalg.cross(b - a, c - a)
        n = n / n.norm(dim=-1, keepdim=True)
        out.append(torch.cat([n, (n * a).sum(-1, keepdim=True) + DHAT / 2], -1)[:, None])
    if g.floor.numel():
        rows = g.floor.reshape(len(g.floor), -1, 7)
        height = rows[..., 3] + rows[..., 5] / 2
        out.append(torch.cat([rows[..., :3], height[..., None]], -1).expand(scenes, -1, -1))
    return torch.cat(out, 1)


def boxes(at: Tensor, groups: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Corners [count, 3] of the boxes around the points [n, 3] of each group."""
    index, far = groups[:, None].expand_as(at), at.new_full((count, 3), torch.inf)
    return (far.scatter_reduce(0, index, at, "amin"), (-far).scatter_reduce(0, index, at, "amax"))


def overlap(a: tuple[Tensor, Tensor], b: tuple[Tensor, Tensor]) -> Tensor:
    """Which boxes overlap which others, bool [n, m]."""
    return (a[0][:, None] <= b[1]).all(-1) & (b[0] <= a[1][:, None]).all(-1)


class Swept(NamedTuple):
    """One scene, and the mass and momentum of its bodies."""

    bodies: int
    mass: Tensor  # [bodies, 1]
    momentum: Tensor  # [bodies, 3]
    rest: tuple[Tensor, Tensor]  # boxes of bodies
    margin: Tensor  # [bodies, 1]
    things: tuple[Tensor, Tensor]  # boxes of colliders
    planes: Tensor  # [P, 4]

    def sweep(self, label: Tensor, stays: Tensor) -> tuple[tuple[Tensor, Tensor], Tensor]:
        """Box of each body while its island translates, and the bodies that must stay."""
        same = label[:, None] == label
        blocked = (same & stays).any(1)
        u = (same.to(self.mass) @ self.momentum) / (same.to(self.mass) @ self.mass).clamp(min=1e-300)
        u = torch.where(blocked[:, None], 0.0, u)
        lo, hi = self.rest
        box = (torch.minimum(lo, lo + u) - self.margin, torch.maximum(hi, hi + u) + self.margin)
        reached = overlap(box, self.things).any(1)
        for n, height in zip(self.planes[:, :3], self.planes[:, 3], strict=True):
            reached = reached | ((torch.where(n < 0, box[1], box[0]) * n).sum(-1) < height)
        return box, stays | reached

    def join(self, label: Tensor, box: tuple[Tensor, Tensor]) -> Tensor:
        near = overlap(box, box) | (label[:, None] == label)
        for _ in range(self.bodies):
            label = torch.where(near, label, self.bodies).amin(1)
        return label

    def islands(self, stays: Tensor) -> Tensor:
        label = torch.arange(self.bodies, device=stays.device)
        for _ in range(4):
            box, stays = self.sweep(label, stays)
            label = self.join(label, box)
        box, stays = self.sweep(label, stays)
        if not torch.equal(self.join(label, box), label):
            label = torch.zeros_like(label)
            _, stays = self.sweep(label, stays)
        return torch.where(((label[:, None] == label) & stays).any(1), -1, label)


def islands_of(g: Given, trust_radius: Tensor) -> Tensor:
    """Islands of bodies [B, bodies], by their definition: the smallest body of each; -1: it must stay."""
    s, bodies, vertices = g.surface, g.surface.bodies, g.x.shape[1]
    body, pinned, planes = s.body[:vertices].long(), s.pinned[:vertices], planes_of(g)
    flat = s.body[s.planes.long()].flatten().long() - bodies  # points of a plane span it and bound nothing
    of, reach = s.body[vertices:].long() - bodies, s.radius[vertices:, None] + DHAT / 2
    out = []
    for b in range(len(g.x)):
        at = g.x[b] if g.origin.numel() == 0 else g.x[b] + g.origin[b]
        weight = torch.where(pinned, 0.0, g.mass[b % len(g.mass)])[:, None]
        mass, momentum = (
            at.new_zeros((bodies, m.shape[1])).index_add(0, body, m) for m in (weight, weight * g.move[b])
        )
        stays = at.new_zeros(bodies).index_add(0, body, (pinned | ~(at + g.move[b]).isfinite().all(-1)).to(at)) > 0
        path = torch.cat([g.was[b] - reach, g.was[b] + reach, g.now[b] - reach, g.now[b] + reach])
        lo, hi = boxes(path, of.repeat(4), int(of.max()) + 1)
        things = (lo.index_fill(0, flat, torch.inf), hi.index_fill(0, flat, -torch.inf))
        margin = (trust_radius[b] + DHAT / 2)[:, None]
        scene = Swept(bodies, mass, momentum, boxes(at, body, bodies), margin, things, planes[b])
        out.append(scene.islands(stays))
    return torch.stack(out)


def by_torch(g: Given) -> TrustRadii:
    """As written down."""
    s, wanted = g.surface, g.found()
    body = s.body[: g.x.shape[1]].long()
    displacement = dict(zip(DISPLACEMENTS, wanted.longest, strict=True))
    gravity_moves = 2 * displacement["gravity"] + LEAST_RADIUS * DHAT
    pushed = (g.now - g.was).norm(dim=-1).amax(1, keepdim=True)

    def radius_of(relative: Tensor) -> Tensor:
        wished = torch.minimum(RADIUS_FACTOR * relative + gravity_moves, s.max_trust_radius)
        return torch.maximum(wished, displacement["driven"]) + pushed

    def last(trust_radius: Tensor) -> Tensor:
        return torch.cat([trust_radius, trust_radius.amax(1, keepdim=True)], 1)

    def translations(island: Tensor) -> Tensor:
        same = ((island[:, :, None] == island[:, None]) & (island >= 0)[:, None]).to(g.x)
        joined = same @ wanted.sums
        cells = joined[..., :3] / joined[..., 3:].clamp(min=1e-300) / (GRID * DHAT)
        return torch.where((island >= 0)[..., None], GRID * DHAT * cells.trunc(), 0.0)

    trust_radius = radius_of(displacement["bends"])
    island = islands_of(g, trust_radius)
    relative = longest(g, g.move - translations(island)[:, body])
    trust_radius = torch.maximum(trust_radius, radius_of(relative))
    island = islands_of(g, trust_radius)
    own = torch.zeros_like(trust_radius)
    if g.barrier.self_contact:
        own = (RADIUS_FACTOR + 1) * (displacement["apart"] + displacement["stretched"]) + gravity_moves
        own = torch.maximum(torch.minimum(own, s.max_deformation_radius), displacement["driven"])
    trust_radius = torch.where(island >= 0, trust_radius - pushed, trust_radius)  # no collider reaches these
    return TrustRadii(island.to(torch.int32), translations(island), last(trust_radius), last(own))


def check(g: Given) -> None:
    got, again = g.found(), g.found()
    for name, expected in by_torch(g)._asdict().items():
        one, same = getattr(got, name), getattr(again, name)
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
@pytest.mark.parametrize(("bodies", "points"), [(1, 2), (12, 2), (40, 2), (2, 7), slow(2, 14)])
def test_in_scenes_of_other_sizes(device: str, bodies: int, points: int) -> None:
    check(given(device, speed=0.5, pinned=True, plane=True, self_contact=True, bodies=bodies, points=points))


def test_a_body_that_is_not_finite_has_no_radius(device: str) -> None:
    g = given(device, speed=0.03, pinned=False, plane=True, self_contact=True)
    move = g.move.clone()
    move[1, -1, 0] = torch.nan
    found = g._replace(move=move).found()
    assert found.trust_radius[0].isfinite().all() and found.island[1, 3] == -1
    assert found.trust_radius[1, 3:].isnan().all()


def placed(places: list[tuple[float, float, float]], colliders: Any = (), fall: float = 1.0) -> Given:
    """Unit cubes with these lower corners that fall together."""
    mesh = dv.mesh.join([dv.mesh.cube(2, 1.0).translate(place) for place in places])
    energies = (dv.StableNeoHookean(), dv.PairBarrier(1e3, DHAT, self_contact=False))
    model = dv.Model(mesh, energies=energies, colliders=colliders)
    surface, barrier = model.surface_of_contact, model.contact
    assert surface is not None and barrier is not None
    x, points = model.rest_points[None], surface.collider_points[None]
    move = x.new_tensor([0.0, -fall, 0.0]).expand_as(x).contiguous()
    return Given(surface, barrier, x, x.new_empty((0,)), model.mass[None], move, 0 * x, points, points,
                 x.new_empty((0,)))  # fmt: skip


def test_bodies_that_fall_side_by_side_are_one_island() -> None:
    found = placed([(0, 0, 0), (1.001, 0, 0), (5, 0, 0), (6.001, 0.5, 0), (0, 3, 0)]).found()
    assert found.island.tolist() == [[0, 0, 2, 2, 4]]
    down = found.u.new_tensor([0.0, -1.0, 0.0])
    assert (found.u - down).abs().max() < GRID * DHAT and (found.u[..., 1] >= -1.0).all()  # toward zero


@pytest.mark.parametrize("collider", ["plane", "sphere", "capsule", "obstacle"])
@pytest.mark.parametrize(("gap", "expected"), [(0.02, -1), (0.2, 0)])
def test_what_reaches_a_collider_stays(collider: str, gap: float, expected: int) -> None:
    """A body that falls by 1 m toward one that is 1 m and a gap below it, with a radius of dhat."""
    top = -1.0 - gap
    slab = dv.mesh.box(2, (1.0, 1.0, 1.0)).translate((0.0, top - 1.0, 0.0))
    things = {
        "plane": dv.colliders.Plane((0.0, top, 0.0)),
        "sphere": dv.colliders.Sphere((0.5, top - 0.3, 0.5), 0.3),
        "capsule": dv.colliders.Capsule((-2.0, top - 0.1, 0.3), (2.0, top - 0.1, 0.4), 0.1),
        "obstacle": dv.colliders.Obstacle(slab.points, slab.surface),
    }
    found = placed([(0, 0, 0)], [things[collider]]).found()
    assert found.island.tolist() == [[expected]] and bool((found.u == 0).all()) == (expected < 0)
