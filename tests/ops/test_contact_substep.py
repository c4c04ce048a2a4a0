"""Claim: the operators of the start of a part do what plain torch says, and their adjoints are its derivatives, also
where several vertices or planes decide alike."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
import torch
from torch import Tensor

from diffvbd._contact.start import above_floor
from diffvbd.ops import contact as ops_start
from diffvbd.ops.contact import SubstepBodies, Whole
from diffvbd.ops.fields import PENDING
from diffvbd.testing import generator, relative_error, tolerance

TRUNCATED, BENT, DEEP_BENT = 0.99, 0.1, 0.5
SIDE, DHAT = 0.25, 0.125
PLANES = {
    "none": (),
    "flat": (((0.0, 1.0, 0.0), -0.0625),),
    "valley": (((0.6, 0.8, 0.0), -0.1), ((-0.8, 0.6, 0.0), -0.2)),
    "slit": (((1.0, 0.0, 0.0), -0.125), ((-1.0, 0.0, 0.0), -0.875), ((0.0, 1.0, 0.0), -2.0)),
}


class Case(NamedTuple):
    x: Tensor
    u: Tensor
    displacement: Tensor
    planes: Tensor
    origin: Tensor
    bodies: SubstepBodies

    @property
    def body(self) -> Tensor:
        return self.bodies.body.long()

    @property
    def pinned(self) -> Tensor:
        return self.bodies.pinned

    def leaves(self) -> Case:
        names = ("x", "u", "displacement", "planes")
        return self._replace(**{k: getattr(self, k).clone().requires_grad_() for k in names})

    def by_operator(self) -> tuple[Tensor, Tensor]:
        c = self
        return above_floor(c.x, c.u, c.displacement, c.planes, c.origin, c.pinned, c.bodies.order, c.bodies.ptr)


def case(name: str, device: str, dtype: torch.dtype = torch.float64, scenes_of_planes: int = 1) -> Case:
    """Two scenes of four cubes of 27 vertices and a lone one. The first cube goes straight, so that its sides decide
    alike; the second turns as well, as does the third, of which something is held; the last goes nowhere."""
    rng = generator("part", name)
    axis = np.arange(3) * SIDE / 2
    cube = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    x = np.concatenate([cube + (0.25, 0.0625 * n, n) for n in range(4)] + [np.array([[0.5, 0.25, 5.0]])])
    body = np.array([0, 1, 2, 3]).repeat(27).tolist() + [4]
    push = -1.0 if name != "slit" else 0.0
    straight = np.array([[-0.75, push, 0.125], [0.5, push, 0.0], [-0.5, push, 0.25], [0.0, 0.0, 0.0], [0.5, push, 0.5]])
    displacement = straight[body]
    turns = np.isin(body, (1, 2))[:, None] * rng.normal(size=(3,)) * 0.4
    displacement = displacement + np.cross(turns, x - x.mean(0))
    if name == "slit":  # against both sides at once: no shift suits
        displacement[:27, 0] = np.where(x[:27, 0] < 0.375, -1.0, 1.0) * (x[:27, 0] != 0.375)
    pinned = np.array(body) == 2
    pinned &= np.arange(len(body)) % 3 == 0
    planes = [[*n, h - 0.03125 * s, 1e3, DHAT, 0.0] for s in range(scenes_of_planes) for n, h in PLANES[name]]
    origin = np.zeros((2, len(x), 3)) if name == "flat" else np.zeros((0,))
    u = rng.normal(size=(2, 5, 3)) * (0.0625 if name == "valley" else 0.0)
    order = rng.permutation(len(x))
    order = order[np.argsort(np.array(body)[order], kind="stable")]
    index = (np.cumsum([0, 27, 27, 27, 27, 1]), order, body)
    ptr, order, of = (torch.tensor(np.asarray(a), dtype=torch.int32, device=device) for a in index)
    real = [np.stack([x, x]), u, np.stack([displacement, 0.75 * displacement]),
            np.reshape(planes, (scenes_of_planes, -1)), origin]  # fmt: skip
    pinned_bodies = torch.tensor([False, False, True, False, False], device=device)
    bodies = SubstepBodies(torch.tensor(pinned, device=device), pinned_bodies, of, order, ptr)
    return Case(*(torch.tensor(a, dtype=dtype, device=device) for a in real), bodies)


def of_bodies(values: Tensor, body: Tensor, reduction: str) -> Tensor:
    """The largest ("amax", at least 0) or the least ("amin", at most 1) of each body; values [B, V, ...]."""
    index = body.reshape(-1, *(1,) * (values.dim() - 2)).expand(values.shape)
    start = values.new_full((len(values), 5, *values.shape[2:]), 0.0 if reduction == "amax" else 1.0)
    return start.scatter_reduce(1, index, values, reduction)


def by_torch(c: Case) -> tuple[Tensor, Tensor]:
    """What a floor leaves of ways of bodies, and which it stops."""
    carried = c.u[:, c.body]
    at, displacement, pinned = (
        c.x + carried + (c.origin if c.origin.numel() else 0.0),
        c.displacement - carried,
        c.pinned[:, None],
    )
    eps = 8 * torch.finfo(c.x.dtype).eps
    if not c.planes.numel():
        return displacement, torch.zeros(c.u.shape[:2], dtype=torch.bool, device=c.x.device)
    planes = c.planes.reshape(len(c.planes), 1, -1, 7)
    normal, height = planes[:, 0, :, :3], planes[..., 3]
    size = (at.abs() @ normal.abs().mT + height.abs()).detach()
    gap, deep, toward = (
        (at @ normal.mT - height - eps * size).clamp(min=0),
        0.1 * planes[..., 5],
        -(displacement @ normal.mT),
    )
    trust_radius = 0.9 * (gap - deep).clamp(min=0) + 0.1 * torch.minimum(gap, deep)
    closes = (toward > trust_radius) & ~pinned
    shift = of_bodies(torch.where(closes, toward - trust_radius, 0.0), c.body, "amax") @ normal
    fraction = of_bodies(
        torch.where(closes, trust_radius / torch.where(closes, toward, 1.0), 1.0), c.body, "amin"
    ).amin(-1)
    rounding = eps * (toward.abs() + shift.abs().sum(-1, keepdim=True)[:, c.body])
    clears = (toward - (shift @ normal.mT)[:, c.body] <= trust_radius + rounding) | pinned
    good = (of_bodies(clears.to(c.x.dtype), c.body, "amin").amin(-1) > 0)[..., None]
    kept, shifted = torch.where(good, 1.0, fraction[..., None])[:, c.body], torch.where(good, shift, 0.0)[:, c.body]
    return kept * displacement + shifted, fraction < TRUNCATED


@pytest.mark.parametrize("scenes_of_planes", (1, 2))
@pytest.mark.parametrize("name", PLANES)
def test_what_a_floor_leaves_of_bodies(device: str, name: str, scenes_of_planes: int) -> None:
    given = case(name, device, scenes_of_planes=scenes_of_planes)
    (body_move, stopped), (expected, stops) = given.by_operator(), by_torch(given)
    assert relative_error(body_move, expected) <= tolerance("formula") and torch.equal(stopped, stops)
    assert stopped[:, :2].all() == (name != "none") and not stopped[:, 3].any()
    beside = body_move - (given.displacement - given.u[:, given.body])
    assert name == "none" or (beside[:, :54].abs().amax(-1) > 0).any()
    shifted = (beside[0, :27] - beside[0, :1]).abs().max() <= tolerance("formula")
    assert shifted == (name != "slit")  # where the first cube is stopped by a share of its way


@pytest.mark.parametrize("name", PLANES)
def test_the_adjoint_of_that(device: str, name: str) -> None:
    given = case(name, device)
    weight = torch.tensor(generator("weights", name).normal(size=given.x.shape), device=device)
    leaves = [given.leaves() for _ in range(2)]
    grads = []
    for c, (body_move, _) in zip(leaves, (leaves[0].by_operator(), by_torch(leaves[1])), strict=True):
        wanted = [c.x, c.u, c.displacement, *([c.planes] if name != "none" else [])]
        grads.append(torch.autograd.grad((weight * body_move).sum(), wanted, materialize_grads=True))
    for own, expected in zip(*grads, strict=True):
        assert relative_error(own, expected) <= tolerance("adjoint")
    assert name == "none" or all(g.abs().max() > 0 for g in grads[0])
    none = given.x.new_empty((0,))
    without = above_floor(
        given.x, none, given.displacement, given.planes, given.origin, given.pinned, *given.bodies[3:]
    )[0]
    still = given._replace(u=torch.zeros_like(given.u))
    assert relative_error(without, by_torch(still)[0]) <= tolerance("formula")


def fraction_within(displacement: Tensor, stretch: Tensor, trust_radius: Tensor) -> Tensor:
    return (
        2
        * trust_radius
        / (displacement + (displacement * displacement + 4 * stretch * trust_radius).sqrt()).clamp(
            min=torch.finfo(displacement.dtype).tiny
        )
    ).clamp(max=1)


@pytest.mark.parametrize("own_pairs", (False, True))
def test_how_far_bodies_go_and_who_asks(device: str, own_pairs: bool) -> None:
    """Decisions of random motions, in the order in which a part takes them."""
    rng, c = generator("decisions", own_pairs), case("valley", device)
    body, pinned, n = c.body, c.pinned, c.x.shape[1]
    move, body_move, gravity_move = (torch.tensor(0.1 * rng.normal(size=c.x.shape), device=device) for _ in range(3))
    stretch = torch.tensor(rng.uniform(0, 0.1, size=(2, 5)), device=device)
    trust_radius, deformation_radius = (
        torch.tensor(rng.uniform(0.2, 2.0, size=(2, 6)), device=device) for _ in range(2)
    )
    none = c.x.new_empty((0,))
    limit, displacements, center, trust_radii, deformation_radii = ops_start.rigid_moves(
        c.x, move, c.u, c.displacement, body_move, stretch, trust_radius, deformation_radius if own_pairs else none,
        c.bodies,
    )  # fmt: skip
    length = torch.where(pinned, 0.0, (c.displacement - c.u[:, body]).square().sum(-1).sqrt())
    within = fraction_within(of_bodies(length, body, "amax"), stretch, trust_radius[:, :-1])
    if own_pairs:
        within = torch.minimum(within, fraction_within(torch.zeros_like(stretch), stretch, deformation_radius[:, :-1]))
        assert torch.equal(deformation_radii, deformation_radius[:, body])
    assert relative_error(limit, within) <= tolerance("formula") and 0 < (limit < TRUNCATED).sum() < limit.numel()
    carried = c.u[:, body]
    expected = torch.where(pinned[:, None], move, carried + limit[:, body, None] * body_move)
    assert relative_error(displacements, expected) <= tolerance("formula")
    assert torch.equal(trust_radii, trust_radius[:, body])
    assert torch.equal(center, torch.where(pinned[:, None], c.x, c.x + carried))

    rigid_fraction = torch.tensor(rng.choice([1.0, 0.5], size=(2, 5)), device=device)
    stopped = torch.tensor([[False] * 5, [True, False, False, False, False]], device=device)
    whole = Whole(c.x, move, c.u, body_move, rigid_fraction, c.planes, c.origin, c.bodies)
    deformation_radius = deformation_radius * 0.3
    base, target, displacement, state = ops_start.deformations(whole, limit, stopped,
                                                               deformation_radius if own_pairs else none)  # fmt: skip
    free = ~c.bodies.pinned_bodies
    largest = of_bodies((target - base).square().sum(-1).sqrt(), body, "amax")
    rests = free & (stopped | (limit < TRUNCATED))
    if own_pairs:
        rests |= free & (largest > DEEP_BENT * deformation_radius[:, :-1]) & (rigid_fraction < TRUNCATED)
    pending = free & ~rests & (largest > BENT * deformation_radius[:, :-1]) & own_pairs
    assert torch.equal(state.long(), torch.where(rests, 1, torch.where(pending, PENDING, 0))[:, body])
    assert rests.any() and pending.any() == own_pairs and (~rests & ~pending).any()
    assert torch.equal(displacement, torch.where(rests[:, body, None], 0.0, target - base))

    increases = torch.tensor(rng.uniform(size=(2, n)) < 0.5, device=device)
    kept, held_back = displacement, (state == PENDING) & increases
    displacement, state = ops_start.freeze(displacement, state, increases)
    assert torch.equal(displacement, torch.where(held_back[..., None], 0.0, kept))
    assert torch.equal(state == PENDING, held_back)

    fraction = torch.tensor(rng.choice([1.0, 0.25], p=[0.96, 0.04], size=(2, n)), device=device)
    to, asked = ops_start.blocked(base, displacement, fraction, state, c.bodies)
    went = torch.where(state > 0, 0.0, fraction)
    bent = (free & (of_bodies(went, body, "amin") < TRUNCATED))[:, body] & (state == 0)
    assert torch.equal(asked.long(), torch.where(state > 0, 1, torch.where(bent, PENDING, 0))) and bent.any()
    assert relative_error(to, base + went[..., None] * displacement) <= tolerance("formula")

    shared, at, last = ops_start.gravity_moves(whole, gravity_move, fraction, asked)
    went = torch.where(asked > 0, 0.0, fraction)
    ends = [
        ops_start.start(whole, gravity_move, went, s, stopped)[0]
        for s in (torch.zeros_like(went), torch.ones_like(went))
    ]
    free_of_floor = ~pinned[:, None]
    assert torch.equal(shared, went)
    assert relative_error(torch.where(free_of_floor, at, 0.0), torch.where(free_of_floor, ends[0], 0.0)) == 0
    assert relative_error(at + last, ends[1]) <= tolerance("formula")
