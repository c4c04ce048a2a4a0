"""Claim: the faces of a surface count so that a point has the barrier of its distance to the surface, once."""

import numpy as np
import pytest
import torch

import diffvbd as dv
from diffvbd._contact.faces import faces_of, sharp_edges, vertex_areas
from diffvbd.reference.distance import POINT_TRIANGLE, distance
from diffvbd.testing import generator, tolerance

SQUARE = np.array([[0, 1, 2], [0, 2, 3]])


def edges_of(triangles: np.ndarray) -> np.ndarray:
    return np.unique(np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)


def surface(name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points, triangles and edges."""
    if name == "axis of a capsule":
        return np.array([[0.0, 0, 0], [0.4, 0, 0]]), np.zeros((0, 3), int), np.array([[0, 1]])
    if name == "sheet":
        return np.array([[0.0, 0, 0], [1, 0, 0], [1, 0, 1], [0, 0, 1]]), SQUARE, edges_of(SQUARE)
    mesh = dv.mesh.box(4, (0.5, 0.4, 0.3)) if name == "box" else dv.mesh.cube(3, size=0.4)
    return mesh.points, mesh.surface, edges_of(mesh.surface)


@pytest.mark.parametrize("name", ["box", "cube", "sheet", "axis of a capsule"])
def test_a_point_outside_has_one_barrier(name: str) -> None:
    points, triangles, edges = surface(name)
    faces, counts = faces_of(triangles, edges)
    low, high = points.min(0), points.max(0)
    p = generator("outside", name).uniform(low - 0.2, high + 0.2, (400, 3))
    away = np.linalg.norm(p - p.clip(low, high), axis=1)  # all are boxes
    p, away = p[away > 1e-3], away[away > 1e-3]
    corners = np.concatenate([np.repeat(p, len(faces), 0)[:, None], np.tile(points[faces], (len(p), 1, 1))], 1)
    kind = torch.full((len(corners),), POINT_TRIANGLE)
    d = distance(kind, torch.from_numpy(corners)).reshape(len(p), -1)
    assert np.allclose(d.amin(1), away, atol=1e-12)
    # what is in reach of a point is one piece without holes: less than the way around
    barrier = [(0.25 - of).clamp(min=0) ** 2 for of in (d, torch.from_numpy(away))]
    assert torch.allclose((barrier[0] * torch.from_numpy(counts)).sum(1), barrier[1], rtol=0, atol=tolerance("formula"))
    assert barrier[1].count_nonzero() > 100
    assert (np.isin(counts, (-1, 1))).all()


def test_faces_of_a_closed_surface() -> None:
    """Triangles and vertices count once, edges -1; a border and its vertices are parts of one triangle: not at all."""
    _, triangles, edges = surface("cube")
    faces, counts = faces_of(triangles, edges)
    assert [int((counts[[len(set(f)) == n for f in faces.tolist()]]).sum()) for n in (3, 2, 1)] == [48, -72, 26]
    faces, counts = faces_of(SQUARE, edges_of(SQUARE))
    assert faces.tolist() == [[0, 1, 2], [0, 2, 3], [0, 2, 2]] and counts.tolist() == [1, 1, -1]


@pytest.mark.parametrize(("angle", "sharp"), [(-20, True), (-10, False), (0, False), (14, False), (16, True)])
def test_edges_are_sharp_from_fifteen_degrees_on(angle: float, sharp: bool) -> None:
    turn = np.radians(angle)
    points = np.array([[0.0, 0, 0], [0, 0, 1], [1, 0, 0.5], [-np.cos(turn), -np.sin(turn), 0.5]])
    triangles = np.array([[0, 1, 2], [1, 0, 3]])
    edges = edges_of(triangles)
    found = sharp_edges(points, triangles, edges)
    assert found[edges.tolist().index([0, 1])] == sharp and found.sum() == 4 + sharp  # the border is


def test_edges_of_bodies() -> None:
    """The 12 edges of a box, in three parts each, and none of a ball."""
    points, triangles, edges = surface("box")
    assert sharp_edges(points, triangles, edges).sum() == 36
    ball = dv.mesh.blob(20)
    assert not sharp_edges(ball.points, ball.surface, edges_of(ball.surface)).any()


def test_a_vertex_bears_for_the_side_that_it_presses_with() -> None:
    """Of a box: a cell of the mesh inside a side, half of one at its edge, a quarter at its corner."""
    mesh = dv.mesh.box((5, 4, 3), (0.4, 0.6, 0.5))
    area = vertex_areas(mesh.points, mesh.surface)
    cell, at = (
        np.array([0.1, 0.2, 0.25]),
        np.stack([mesh.points - mesh.points.min(0), mesh.points.max(0) - mesh.points]),
    )
    ends = (np.abs(at) < 1e-9).any(0)  # [V, 3]: on a side across each axis
    for v in np.unique(mesh.surface):
        sides = [np.prod(np.where(ends[v], cell / 2, cell)[np.arange(3) != axis]) for axis in np.flatnonzero(ends[v])]
        assert area[v] == pytest.approx(max(sides), rel=tolerance("formula"))
    assert (area[np.setdiff1d(np.arange(len(area)), mesh.surface)] == 0).all()


def test_cells_of_any_triangles_add_up_to_their_area() -> None:
    points = generator("cells").standard_normal((40, 3))
    for triangle in generator("corners").integers(0, 40, (30, 3)):
        if len(set(triangle.tolist())) == 3:
            a, b, c = points[triangle]
            cells = vertex_areas(points, triangle[None])
            assert cells.sum() == pytest.approx(np.linalg.norm(np.cross(b - a, c - a)) / 2, rel=1e-12)
            assert (cells[triangle] > 0).all()


def test_a_finer_body_rests_at_the_same_gap() -> None:
    """On a table of tets, with a stiffness per area; with one per vertex 25 vertices rest higher than 9."""
    gaps: dict[str, list[float]] = {"kappa": [], "kappa_per_area": []}
    for unit, size in (("kappa", 100.0), ("kappa_per_area", 4e4)):
        for n in (3, 5):
            cube = dv.mesh.cube(n, size=0.1).translate((0.033, 0.008, 0.041))
            bodies = dv.mesh.join([cube, dv.mesh.box((4, 2, 4), (0.2, 0.05, 0.2)).translate((0, -0.05, 0))])
            barrier = dv.PairBarrier(dhat=0.01, self_contact=False, **{unit: size})
            model = dv.Model(bodies, pinned=bodies.points[:, 1] < 1e-9, energies=(dv.StableNeoHookean(), barrier))
            x = model.rest_points
            end = dv.rollout(
                model, x, 0 * x, dv.VBD(0.01, 20), steps=60, young=1e7, poisson=0.3, drag=20.0, save="last"
            )
            gaps[unit].append(float(end.x[-1, : n**3][cube.points[:, 1] < 0.008 + 1e-9, 1].mean()))
    assert abs(gaps["kappa_per_area"][1] / gaps["kappa_per_area"][0] - 1) < 0.05
    assert gaps["kappa"][1] / gaps["kappa"][0] > 1.2


def test_one_of_two_units() -> None:
    with pytest.raises(ValueError, match="kappa_per_area: expected None, or kappa None, got 1 beside kappa = 2"):
        dv.PairBarrier(kappa=2.0, kappa_per_area=1.0)


def test_a_fitted_barrier_goes_along() -> None:
    """With a finer mesh it is fitted anew, and a change of another field keeps it."""
    given = dv.PairBarrier(kappa_per_area=4e4, dhat=0.01, capacity=4)
    models = [dv.Model(dv.mesh.cube(3, size=0.1), energies=(dv.StableNeoHookean(), given))]
    models += [
        dv.Model(dv.mesh.cube(5, size=0.1), energies=energies) for energies in ((given,), models[0].energies[1:])
    ]
    kappas = [model.contact.kappa for model in models if model.contact is not None]
    assert kappas[1] == kappas[2] and kappas[0] > 2 * kappas[1]
    dv.contact.reserve(models[0], 100)
    assert models[0].contact is not None and models[0].contact.kappa == kappas[0]


@pytest.mark.parametrize("places", [(1e-2, 3e-4), (3e-4, 3e-4)])
def test_edges_that_cross_at_their_ends_in_float32(places: tuple[float, float]) -> None:
    """Their energy is too small for an inverse."""
    dhat, (a, b) = 1e-3, (5e-4 * place for place in places)
    gap = dhat * (1 - 1e-5)
    low = np.array([[-a, 0, 0], [0.1, 0, 0], [0.05, -0.1, 0.05], [0.05, -0.1, -0.05]])
    high = np.array([[0, gap, -b], [0, gap, 0.1], [0.05, gap + 0.1, 0.05], [-0.05, gap + 0.1, 0.05]])
    bodies = dv.mesh.join([dv.TetMesh(part, np.array([[0, 1, 2, 3]]), orient=True) for part in (low, high)])
    barrier = dv.PairBarrier(kappa=1e4, dhat=dhat, self_contact=False)
    model = dv.Model(bodies, energies=(dv.StableNeoHookean(), barrier), dtype=torch.float32)
    x = model.rest_points.clone().requires_grad_()
    out, _ = dv.step(model, x, 0 * x, dv.VBD(1e-3, 1, subspace=None), mu=1e4, lam=1e4)
    (grad,) = torch.autograd.grad(out.square().sum(), x)
    assert torch.isfinite(out).all() and torch.isfinite(grad).all() and grad.any()
