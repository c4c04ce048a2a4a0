"""Claim: how far sweeps may carry each vertex is what plain torch says."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
import torch
from torch import Tensor

from diffvbd.ops import contact as sweep_radii
from diffvbd.testing import generator, tolerance

MORE, LEAST = 1.5, 0.02
SIZES = [[0, 3, 0, 1], [1] * 40, [300, 20, 0], [8] * 300, [6000], [0], []]


class Case(NamedTuple):
    x: Tensor
    start: Tensor
    begin: Tensor
    move: Tensor
    gravity_move: Tensor
    apart: Tensor
    stretched: Tensor
    center: Tensor
    trust_radius: Tensor
    deformation_center: Tensor
    deformation_radius: Tensor
    pinned: Tensor
    order: Tensor
    ptr: Tensor

    def trust_radii(self) -> Tensor:
        return sweep_radii.sweep_radii(*self, MORE, LEAST)


def case(sizes: list[int], device: str, dtype: torch.dtype = torch.float64, scenes: int = 2, own: bool = True) -> Case:
    """Bodies of these sizes with any ways, and rooms of which some are left; a third of the vertices is held."""
    rng, n = generator("rooms", *sizes), sum(sizes)
    points = [0.02 * rng.standard_normal((scenes, n, 3)) for _ in range(7)]
    of_bodies = [0.02 * rng.random((scenes, len(sizes))) for _ in range(2)]
    trust_radii = [scale * rng.random((scenes, n)) for scale in (1.0, 0.5)]
    (
        x,
        start,
        begin,
        move,
        gravity_move,
        center,
        deformation_center,
        apart,
        stretched,
        trust_radius,
        deformation_radius,
    ) = (torch.as_tensor(a, dtype=dtype, device=device) for a in (*points, *of_bodies, *trust_radii))
    if not own:
        deformation_center = deformation_radius = x.new_empty((0,))
    index = [rng.permutation(n).astype(np.int32), np.cumsum([0, *sizes]).astype(np.int32)]
    return Case(x, start, begin, move, gravity_move, apart, stretched, center, trust_radius,
                deformation_center, deformation_radius,
                torch.as_tensor(rng.random(n + 4) < 1 / 3, device=device),  # and of colliders
                *(torch.as_tensor(a, device=device) for a in index))  # fmt: skip


def by_torch(c: Case) -> Tensor:
    """As written down."""
    scenes, vertices, bodies = *c.x.shape[:2], len(c.ptr) - 1
    body = torch.empty_like(c.order, dtype=torch.int64)
    body[c.order.long()] = torch.repeat_interleave(torch.arange(bodies, device=c.ptr.device), c.ptr.diff())
    free = ~c.pinned[:vertices]

    def length(displacement: Tensor) -> Tensor:
        return displacement.square().sum(-1).sqrt()

    def largest(displacement: Tensor) -> Tensor:
        of_vertices, index = torch.where(free, length(displacement), 0.0), body.expand(scenes, vertices)
        return displacement.new_zeros((scenes, bodies)).scatter_reduce(1, index, of_vertices, "amax")

    held_up = largest(c.begin + c.move + c.gravity_move - c.start)
    wish = largest(c.gravity_move) + c.apart + MORE * held_up + largest(c.x - c.start) + MORE * c.stretched
    wish = LEAST + (wish.amax(1, keepdim=True).expand_as(wish) if bodies else wish)
    left = c.trust_radius - length(c.x - c.center)
    if c.deformation_radius.numel():
        left = torch.minimum(left, c.deformation_radius - length(c.x - c.deformation_center))
    return torch.where(free, torch.minimum(left, wish[:, body]).clamp(min=0), 0.0)


def check(c: Case) -> Tensor:
    """The rooms: but for roundings, on the scale of the rooms, those of torch."""
    got, scale = c.trust_radii(), torch.finfo(c.x.dtype).eps / torch.finfo(torch.float64).eps
    torch.testing.assert_close(got, by_torch(c), rtol=0.0, atol=tolerance("ulps") * scale, equal_nan=True)
    assert got.is_contiguous() and torch.equal(got.nan_to_num(), c.trust_radii().nan_to_num())
    return got


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("own", [False, True])
@pytest.mark.parametrize("sizes", SIZES, ids=lambda sizes: f"{len(sizes)}-{sum(sizes)}")
def test_as_plain_torch_says(device: str, sizes: list[int], own: bool, dtype: torch.dtype) -> None:
    for scenes in (0, 1, 3):
        check(case(sizes, device, dtype, scenes, own))


def test_all_that_bounds_a_room_does(device: str) -> None:
    """What is left of either room, what bodies want, and nothing where more than a room is taken or one is held."""
    c = case([300, 20, 400], device)
    got, vertices = check(c), c.x.shape[1]
    left = (c.trust_radius - (c.x - c.center).norm(dim=-1),
            c.deformation_radius - (c.x - c.deformation_center).norm(dim=-1))  # fmt: skip
    free = ~c.pinned[:vertices].expand_as(got)
    most = got[0].max()
    assert bool(((left[0] < 0) & free).any()) and bool((got[free & (left[0] < 0)] == 0).all())
    assert bool((got[~free] == 0).all()) and bool((got[free] > 0).any())
    for bound in left:
        assert bool(((got - bound).abs() < tolerance("ulps")).any())
    assert int((got[0] == most).sum()) > 1  # those that have room for all that bodies want
    check(c._replace(pinned=torch.ones_like(c.pinned)))
    check(c._replace(pinned=torch.zeros_like(c.pinned)))
