"""Claim: an Embedding places points by weights of vertices: exactly in tets, closest on surfaces, differentiably."""

import pickle
import warnings

import numpy as np
import pytest
import torch

import diffvbd as dv
from diffvbd.testing import generator, relative_error, tolerance

MESH = dv.mesh.blob(5)
POINTS = generator("embedding").uniform(-0.22, 0.22, (300, 3))
X = torch.from_numpy(MESH.points.copy())


def test_points_inside_and_outside_stay_where_they_were_given() -> None:
    points = dv.Embedding.of_points(MESH, POINTS)
    assert relative_error(points.at(X), torch.from_numpy(POINTS)) < tolerance("geometry")
    assert torch.allclose(points.weights.sum(1), torch.ones(300, dtype=torch.float64), rtol=tolerance("geometry"))
    inside = points.weights.min(1).values >= 0
    assert 10 < int(inside.sum()) < 290
    corners = MESH.points[MESH.tets]  # each point has a tet with weights >= 0, or there is none
    edges = (corners[:, 1:] - corners[:, :1]).swapaxes(1, 2)
    others = np.linalg.solve(edges[None], (POINTS[:, None] - corners[None, :, 0])[..., None])[..., 0]
    least = np.minimum(others.min(-1), 1 - others.sum(-1)).max(1)
    assert np.array_equal(least >= 0, inside.numpy())


def test_points_far_outside_are_warned_of() -> None:
    with pytest.warns(UserWarning, match=r"points: 1 of 2 lie farther outside .* is point 1 at \[3.0, 0.0, 0.0\]"):
        dv.Embedding.of_points(MESH, [[0.01, 0.0, 0.0], [3.0, 0.0, 0.0]])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        dv.Embedding.of_points(MESH, [[3.0, 0.0, 0.0]], surface=True)


def test_points_on_the_surface_are_the_closest_ones() -> None:
    points = dv.Embedding.of_points(MESH, POINTS, surface=True)
    assert bool((points.weights >= 0).all()) and points.weights.shape == (300, 3)
    distance = (points.at(X) - torch.from_numpy(POINTS)).norm(dim=-1).numpy()
    weights = generator("dirichlet").dirichlet((1, 1, 1), 400)
    samples = np.concatenate([(weights @ MESH.points[MESH.surface]).reshape(-1, 3), MESH.points[MESH.surface[:, 0]]])
    for point, found in zip(POINTS[:60], distance[:60], strict=True):
        nearest = np.linalg.norm(samples - point, axis=1).min()
        assert found - 1e-12 <= nearest <= found + 0.01


def test_at_is_linear_and_differentiable(device: str) -> None:
    points, x = dv.Embedding.of_points(MESH, POINTS), torch.stack([X, 2 * X]).to(device).requires_grad_()
    out = points.at(x)
    assert out.shape == (2, 300, 3) and torch.equal(out[1], 2 * out[0])
    weights = torch.from_numpy(generator("weights").standard_normal((2, 300, 3))).to(device)
    (grad,) = torch.autograd.grad((out * weights).sum(), x, retain_graph=True)
    (again,) = torch.autograd.grad((out * weights).sum(), x)
    assert torch.equal(grad, again)
    dense = torch.zeros(300, MESH.num_vertices, dtype=torch.float64)
    dense.scatter_add_(1, points.vertices, points.weights)
    assert relative_error(grad, dense.T @ weights.cpu()) < tolerance("sum")
    single = points.at(x.detach().float())
    assert single.dtype == torch.float32 and relative_error(single, out) < tolerance("float32_forward")


def test_vertices_copies_and_shapes() -> None:
    points = dv.Embedding.of_vertices([3, 1, 3])
    assert torch.equal(points.at(X), X[[3, 1, 3]]) and len(points) == 3 and "3 points" in repr(points)
    assert torch.equal(pickle.loads(pickle.dumps(points)).at(X), X[[3, 1, 3]])
    assert points.at(X[None, None]).shape == (1, 1, 3, 3)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: dv.Embedding([[0.5]], [[1.0]]), "vertices: expected integers, got dtype float64"),
        (lambda: dv.Embedding([0, 1], [1.0, 1.0]), r"vertices: expected shape \[\*, \*\], got \[2\]"),
        (lambda: dv.Embedding([[0, 1]], [[1.0]]), r"weights: expected shape \[1, 2\], that of vertices, got"),
        (lambda: dv.Embedding([[-1]], [[1.0]]), "vertices: expected indices >= 0, got -1"),
        (lambda: dv.Embedding([[0]], [[np.nan]]), "weights: expected finite numbers"),
        (lambda: dv.Embedding(np.zeros((0, 1), int), np.zeros((0, 1))), "vertices: expected at least one vertex"),
        (lambda: dv.Embedding([[0]], torch.ones(1, 1, requires_grad=True)), "weights: .* requires grad"),
        (lambda: dv.Embedding.of_points(MESH, [[0.0, 0.0]]), r"points: expected shape \[\*, 3\]"),
        (lambda: dv.Embedding.of_points(MESH, [[0.0, 0.0, np.inf]]), "points: expected finite numbers"),
        (lambda: dv.Embedding.of_points(X, POINTS), "mesh: expected a diffvbd.TetMesh"),
        (lambda: dv.Embedding.of_points(MESH, POINTS, surface=1), "surface: expected a bool"),
        (lambda: dv.Embedding.of_points(dv.mesh.join([]), POINTS), "mesh: expected at least one tet, got none"),
        (lambda: dv.Embedding.of_vertices([9]).at(X[:4]), r"x: this Embedding: expected vertices in \[0, 4\), got 9"),
        (lambda: dv.Embedding.of_vertices([0]).at(X[:, 0]), r"x: expected shape \[..., V, 3\]"),
        (lambda: dv.Embedding.of_vertices([0]).at([1.0]), "x: expected a tensor"),
    ],
)
def test_wrong_input_is_named(make, message: str) -> None:
    with pytest.raises((ValueError, TypeError), match=message):
        make()
