"""Claim: the fraction of a motion that pairs admit keeps their gaps, and is a whole one where nothing is in the way."""

import torch

from diffvbd._contact.pair_forces import NearPairs, safe_fraction
from diffvbd.reference.distance import distance

CLOSED = 0.8


def random_pairs(count: int, seed: int) -> tuple[NearPairs, torch.Tensor, torch.Tensor]:
    """Pairs of all kinds in two scenes, each with corner points of its own; and motions as large as they are."""
    rng = torch.Generator().manual_seed(seed)
    points = torch.randn(2, 4 * count, 3, generator=rng, dtype=torch.float64)
    corners = torch.arange(4 * count).reshape(count, 4).repeat(2, 1)
    kind, scene = torch.arange(2 * count) % 2, torch.arange(2).repeat_interleave(count)
    none = torch.zeros(2 * count, dtype=torch.float64)
    move = 2 * torch.randn(points.shape, generator=rng, dtype=torch.float64)
    return NearPairs(corners, kind, scene, none, none, none), points, move


def test_no_gap_closes_on_the_way() -> None:
    truncated = 0
    for seed in range(15):
        pairs, points, move = random_pairs(3, seed)
        fraction = safe_fraction(pairs, points, move, CLOSED)
        truncated += int((fraction < 1).sum())
        assert bool((fraction > 0).all())
        gap = distance(pairs.kind, pairs.positions(points))
        for t in torch.linspace(0, 1, 21, dtype=torch.float64):
            there = points + (t * fraction)[:, None, None] * move
            assert bool((distance(pairs.kind, pairs.positions(there)) >= (1 - CLOSED - 1e-9) * gap).all())
    assert truncated > 10


def test_a_motion_that_keeps_every_gap_is_whole() -> None:
    pairs, points, _ = random_pairs(3, 0)
    shift = points.new_tensor([[[5.0, -3.0, 1.0]]]).expand(points.shape)  # of all together
    assert bool((safe_fraction(pairs, points, shift, CLOSED) == 1).all())
    point, triangle = [[0.0, 0.1, 0.0]], [[-1.0, 0.0, -1.0], [1.0, 0.0, -1.0], [0.0, 0.0, 1.0]]
    above = torch.tensor([point + triangle], dtype=torch.float64)
    one = NearPairs(*(t[:1] for t in pairs))
    for height, expected in ((10.0, 1.0), (-0.04, 1.0), (-0.2, 0.4)):  # away, within four fifths, beyond
        move = torch.zeros_like(above)
        move[0, 0, 1] = height
        assert abs(float(safe_fraction(one, above, move, CLOSED)) - expected) < 0.01
