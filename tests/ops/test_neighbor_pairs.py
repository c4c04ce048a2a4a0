"""Claim: the search finds exactly the pairs that a loop over all pairs finds, each once, in order, on any cloud."""

import itertools

import numpy as np
import pytest
import torch
from torch import Tensor

from diffvbd import ops
from diffvbd.ops.contact import neighbor_pairs

DTYPES = [torch.float64, torch.float32]


def all_pairs(points: Tensor, radius: float) -> Tensor:
    """What neighbor_pairs finds, by plain torch."""
    limit = torch.tensor(radius, dtype=points.dtype, device=points.device) ** 2
    rows = []
    for scene, p in enumerate(points):
        x, y, z = (p[:, None] - p[None]).unbind(-1)
        ij = torch.triu(x * x + y * y + z * z < limit, diagonal=1).nonzero()
        rows.append(torch.nn.functional.pad(ij, (1, 0), value=scene))
    return torch.cat(rows).to(torch.int32) if rows else torch.zeros(0, 3, dtype=torch.int32, device=points.device)


def cloud(rng: np.random.Generator, *shape: int, dtype: torch.dtype, device: str, size: float = 1.0) -> Tensor:
    return torch.from_numpy(size * rng.uniform(-1, 1, (*shape, 3))).to(device, dtype)


def check(points: Tensor, radius: float, least: int = 0) -> None:
    expected = all_pairs(points, radius)
    assert len(expected) >= least, "nothing is compared"
    pairs, count = neighbor_pairs(points, radius, len(expected))
    assert pairs.dtype == torch.int32 and count.tolist() == [len(expected)]
    assert torch.equal(pairs, expected)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("scenes, n, radius", [(0, 5, 1.0), (1, 0, 1.0), (1, 1, 1.0), (3, 2, 0.9), (2, 50, 0.4),
                                               (1, 2000, 0.15), (1, 2000, 0.04), (7, 300, 0.3)])  # fmt: skip
def test_random_clouds(
    scenes: int, n: int, radius: float, dtype: torch.dtype, device: str, rng: np.random.Generator
) -> None:
    check(cloud(rng, scenes, n, dtype=dtype, device=device), radius, least=20 if n >= 50 else 0)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("axes", [(0,), (1,), (2,), (0, 1), (0, 2), (1, 2), (0, 1, 2)])
def test_lines_planes_and_boxes(
    axes: tuple[int, ...], dtype: torch.dtype, device: str, rng: np.random.Generator
) -> None:
    """Cells hash to buckets by their coordinates: none may get lost, or come twice, in a cloud of any extent."""
    points = cloud(rng, 2, 1500, dtype=dtype, device=device, size=1500 ** (1 / len(axes)))
    flat = torch.zeros_like(points)
    flat[..., list(axes)] = points[..., list(axes)]
    check(flat, 2.0, least=1000)


def test_coincident_points(device: str) -> None:
    """Distance 0 is below any radius; a distance that equals the radius is not."""
    points = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [0, 0, 0], [1, 0, 0], [3, 0, 0], [0, 0, 0]]], device=device)
    pairs, _ = neighbor_pairs(points, 1.0, 10)
    assert pairs.tolist() == [[0, 0, 2], [0, 0, 5], [0, 1, 3], [0, 2, 5]]
    check(points, 1e-6, least=4)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("exponent", range(-3, 20, 2))
def test_far_away_with_a_small_radius(exponent: int, dtype: torch.dtype, device: str, rng: np.random.Generator) -> None:
    """At 1e19 radii numbers are further apart than the radius; somewhere before, cells are no longer told apart."""
    near = cloud(rng, 1, 200, dtype=torch.float64, device=device, size=3.0)
    far = near + 10.0**exponent * torch.tensor([1.0, -0.7, 0.3], dtype=torch.float64, device=device)
    check(torch.cat([near, far, far], 1).to(dtype), 1.0, least=200)


@pytest.mark.parametrize("power", [-100, -20, 0, 30, 100])
def test_scale_invariance(power: int, device: str, rng: np.random.Generator) -> None:
    points, scale = cloud(rng, 1, 200, dtype=torch.float64, device=device), 2.0**power
    expected, _ = neighbor_pairs(points, 0.25, 2000)
    assert len(expected) > 100
    assert torch.equal(neighbor_pairs(points * scale, 0.25 * scale, 2000)[0], expected)


def test_scenes_do_not_see_each_other(device: str, rng: np.random.Generator) -> None:
    points = cloud(rng, 1, 40, dtype=torch.float64, device=device)
    one, _ = neighbor_pairs(points, 0.5, 1000)
    two, _ = neighbor_pairs(points.expand(2, -1, -1), 0.5, 1000)
    assert len(one) > 10 and len(two) == 2 * len(one)
    assert torch.equal(two[: len(one)], one)
    assert torch.equal(two[len(one) :, 1:], one[:, 1:]) and bool((two[len(one) :, 0] == 1).all())


def test_any_number_of_threads_gives_the_same(rng: np.random.Generator) -> None:
    points, threads = cloud(rng, 2, 6000, dtype=torch.float64, device="cpu"), torch.get_num_threads()
    results = []
    try:
        for count in (1, 3):
            torch.set_num_threads(count)
            results.append(neighbor_pairs(points, 0.1, 100_000)[0])
    finally:
        torch.set_num_threads(threads)
    assert len(results[0]) > 10_000 and torch.equal(*results)


@pytest.mark.cuda
@pytest.mark.parametrize("dtype", DTYPES)
def test_cuda_finds_what_the_cpu_finds(dtype: torch.dtype, rng: np.random.Generator) -> None:
    points = cloud(rng, 2, 50_000, dtype=dtype, device="cpu")
    expected = neighbor_pairs(points, 0.05, 2_000_000)[0]
    assert len(expected) > 100_000
    for _ in range(3):
        assert torch.equal(neighbor_pairs(points.cuda(), 0.05, 2_000_000)[0].cpu(), expected)


# --- room and bad input -----------------------------------------------------------------------------------------------


def test_too_many_pairs_raise_with_their_number(device: str, rng: np.random.Generator) -> None:
    points = cloud(rng, 2, 200, dtype=torch.float64, device=device)
    needed = len(all_pairs(points, 0.5))
    for room in (0, 1, needed // 2, needed - 1):
        with pytest.raises(ValueError, match=rf"max_pairs: expected room for {needed} pairs .* got {room}$"):
            neighbor_pairs(points, 0.5, room)
        pairs, count = ops.raw.neighbor_pairs(points, 0.5, room)
        assert pairs.shape == (room, 3) and int(count) == needed and bool((pairs == -1).all())
    pairs, count = ops.raw.neighbor_pairs(points, 0.5, needed + 7)
    assert bool((pairs[:needed] >= 0).all()) and bool((pairs[needed:] == -1).all()) and int(count) == needed


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_points_that_are_not_finite_raise(value: float, dtype: torch.dtype, device: str) -> None:
    for scene, point, axis in itertools.product((0, 1), (0, 9), (0, 1, 2)):
        points = torch.zeros(2, 10, 3, dtype=dtype, device=device)
        points[scene, point, axis] = value
        with pytest.raises(ValueError, match=rf"points: expected finite values, got .* at \[{scene}, {point}, {axis}"):
            neighbor_pairs(points, 1.0, 1000)
