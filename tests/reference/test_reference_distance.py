"""Claim: the reference's distances are those of the closest points, whatever features these lie on, gradients too."""

import pytest
import torch
from torch import Tensor

from diffvbd.reference import distance
from diffvbd.testing import generator, tolerance


def sampled(kind: int, corners: Tensor, n: int = 240) -> float:
    """Distance of the closest samples on two primitives."""
    t = torch.linspace(0, 1, n + 1, dtype=torch.float64)[:, None]
    if kind == distance.EDGE_EDGE:
        first, second = (a + t * (b - a) for a, b in corners.unflatten(0, (2, 2)))
    else:
        u, v = torch.meshgrid(t[:, 0], t[:, 0], indexing="ij")
        inside = u + v <= 1 + 1e-9
        u, v = u[inside][:, None], v[inside][:, None]
        first, second = corners[:1], corners[1] + u * (corners[2] - corners[1]) + v * (corners[3] - corners[1])
    return float(torch.cdist(first, second).min())


def random_pairs(kind: int, count: int) -> Tensor:
    """Corners [count, 4, 3] of edges of some meters, as far apart."""
    return torch.as_tensor(generator("pairs", kind).standard_normal((count, 4, 3)))


@pytest.mark.parametrize(
    ("kind", "features"),
    [
        (distance.POINT_TRIANGLE, {distance.TO_POINT, distance.TO_EDGE, distance.TO_FACE}),
        (distance.EDGE_EDGE, {distance.TO_POINT, distance.TO_EDGE, distance.BETWEEN_EDGES}),
    ],
)
def test_distance_of_every_feature(kind: int, features: set[int]) -> None:
    corners = random_pairs(kind, 60)
    kinds = torch.full((60,), kind)
    feature, _ = distance.closest_features(kinds, corners)
    assert set(feature.tolist()) == features
    d = distance.distance(kinds, corners)
    for value, pair in zip(d, corners, strict=True):
        expected = sampled(kind, pair)
        # a sample is off by half a spacing s along each primitive, which costs at most s^2 / (2 d), or s
        spacing = float((pair[1:] - pair[:-1]).norm(dim=-1).max()) / 240 * 3
        assert -tolerance("geometry") <= expected - value <= min(spacing, spacing**2 / (2 * float(value)))
    atol = tolerance("gradcheck_of_a_distance")
    assert torch.autograd.gradcheck(lambda c: distance.distance(kinds, c), corners.requires_grad_(), atol=atol)


def test_gradient_of_the_distance_is_weights_times_normal() -> None:
    """Forces of a pair sum to zero, without torque, and those on one primitive sum to a unit vector."""
    for kind in range(3):
        corners = random_pairs(kind, 100)
        kinds = torch.full((100,), kind)
        d, slope = distance.with_gradient(lambda c, kinds=kinds: distance.distance(kinds, c), corners)
        assert not d.requires_grad and not slope.requires_grad
        assert slope.sum(1).abs().max() <= tolerance("sum")
        assert torch.linalg.cross(corners, slope).sum(1).abs().max() <= tolerance("geometry")
        normal = slope[:, 0] + (slope[:, 1] if kind == distance.EDGE_EDGE else 0)
        assert (normal.norm(dim=-1) - 1).abs().max() <= tolerance("geometry")
        along = (slope * normal[:, None]).sum(-1, keepdim=True)
        assert (slope - along * normal[:, None]).abs().max() <= tolerance("geometry")


def test_plane_has_a_side() -> None:
    plane = [[0.0, 0, 0], [0, 0, 1], [1, 0, 0]]
    corners = torch.tensor([[[5.0, 0.3, -7.0], *plane], [[5.0, -0.3, 2.0], *plane]])
    d = distance.distance(torch.tensor([distance.POINT_PLANE] * 2), corners)
    assert torch.allclose(d, torch.tensor([0.3, -0.3]))


def test_pairs_without_one_closest_point_are_finite() -> None:
    """Parallel edges, an edge and a triangle without extent."""
    edges = [[[0.0, 0, 0], [1, 0, 0], [a, 0.1, 0], [b, 0.1, 0]] for a, b in ((0.2, 0.7), (0.3, 0.3))]
    sliver = [[[0.5, 0.1, 0], [0.0, 0, 0], [1, 0, 0], [2, 0, 0]]]
    kinds = torch.tensor([distance.EDGE_EDGE] * 2 + [distance.POINT_TRIANGLE])
    corners = torch.tensor(edges + sliver, dtype=torch.float64)
    d, slope = distance.with_gradient(lambda c: distance.distance(kinds, c), corners)
    assert torch.allclose(d, torch.full((3,), 0.1, dtype=torch.float64))
    assert torch.isfinite(slope).all()
