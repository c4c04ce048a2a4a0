"""Claim: `contact_intersections` finds the edges that cross triangles as the reference does, less those that contact
does not keep apart, and the points behind planes; and a rollout refuses to start from them."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from helpers.detection_scenes import Scene, Surface, capsule, mixed_scene, plane, solid, soup, sphere
from helpers.two_boxes import STEP

import diffvbd as dv
from diffvbd import colliders, results
from diffvbd.ops import contact as ops_contact
from diffvbd.reference import intersections
from diffvbd.testing import debug_checks
from diffvbd.testing.scenes import generator

DTYPES = (torch.float64, torch.float32)


def arguments(s: Scene, device: str, dtype: torch.dtype, capacity: int) -> tuple:
    given = s.arguments(device, dtype, capacity)
    surface = given[6]
    triangles = torch.as_tensor(triangles_of(s), device=device)
    return (*given[:3], *surface[:2], triangles, *surface[3:8], *given[7:10], capacity)


def triangles_of(s: Scene) -> np.ndarray:
    """Without the faces that are edges and vertices."""
    return s.triangles[s.triangles[:, 1] != s.triangles[:, 2]]


def find(s: Scene, device: str = "cpu", dtype: torch.dtype = torch.float64, capacity: int = 5000) -> Any:
    found = ops_contact.contact_intersections(*arguments(s, device, dtype, capacity))
    return found._replace(**{name: value.cpu() for name, value in found._asdict().items()})


def expected(s: Scene, dtype: torch.dtype = torch.float64) -> list[list[int]]:
    """Rows (scene, edge, triangle) by the reference, and the rules for what is tested at all."""
    x, origin, collider = (t.double() for t in s.arguments("cpu", dtype)[:3])
    x = x + origin if origin.numel() else x
    edges, triangles = s.edges, triangles_of(s)
    group = np.minimum(s.body, s.mesh_bodies)
    rows = []
    for scene, points in enumerate(torch.cat([x, collider], 1)):
        for edge, triangle in intersections(points, triangles, edges).tolist():
            one, other = group[edges[edge][0]], group[triangles[triangle][0]]
            mesh = max(one, other) < s.mesh_bodies
            ignored = one == s.mesh_bodies if one == other and not mesh else False
            ignored |= mesh and not (s.self_contact if one == other else s.between_bodies)
            held = s.pinned[[*edges[edge], *triangles[triangle]]].all()
            if not ignored and not held:
                rows.append([scene, edge, triangle])
    return rows


def tangled(scenes: int = 3, **options: Any) -> Scene:
    """Bodies and colliders that overlap and are crumpled, differently in each scene, some vertices held."""
    rng = generator("tangled")
    bodies = [solid(dv.mesh.cube(4, 0.4)), soup(rng, 30), solid(dv.mesh.cube(3, 0.4).translate((0.31, 0.13, 0.07)))]
    s = Scene.of(bodies, [soup(rng, 10), capsule((0, 0.1, 0.2), (0.9, 0.3, 0.1), 0.1), soup(rng, 5)], scenes, **options)
    s.x += 0.03 * rng.standard_normal(s.x.shape)
    s.pinned[: s.x.shape[1]] |= rng.random(s.x.shape[1]) < 0.3
    return s


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize(("self_contact", "between"), [(True, True), (False, True), (True, False), (False, False)])
def test_random_surfaces(device: str, dtype: torch.dtype, self_contact: bool, between: bool) -> None:
    s = tangled(self_contact=self_contact, between_bodies=between)
    rows = expected(s, dtype)
    assert len(rows) > 20
    found = find(s, device, dtype)
    assert found.pairs[: len(rows)].tolist() == rows and (found.pairs[len(rows) :] == -1).all()
    for b in range(len(s.x)):
        own = [row[1:] for row in rows if row[0] == b]
        assert found.counts[b].tolist() == [len(own), 0]
        assert found.first[b].tolist() == [own[0], [-1, -1]]


@pytest.mark.parametrize("dtype", DTYPES)
def test_origins_are_added_in_double_precision(device: str, dtype: torch.dtype) -> None:
    """Bodies that overlap by less than a float32 can say of where they are."""
    s = tangled(1)
    near = find(s, device, dtype)
    far = replace(s, origin=np.full_like(s.x, 4096.0), x=s.x + 4096, collider=s.collider + 4096)
    rows = expected(far, dtype)
    assert find(far, device, dtype).pairs[: len(rows)].tolist() == rows
    assert len(rows) > 20 and int(near.counts[0, 0]) > 20


def test_places_that_coincide_at_rest_do_not_cross(device: str) -> None:
    """A crack: the two triangles of a square share no vertex, and one border is doubled."""
    points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])
    s = Scene.of([Surface.of(points, np.array([[0, 1, 2], [3, 5, 4]]))])
    s.x[0, 3:] += [[-0.2, -0.1, 0.1], [-0.2, -0.1, -0.1], [0, 0, 0.3]]
    assert find(s, device).counts.tolist() == [[0, 0]]
    apart = s.rest.copy()
    apart[3:, 0] += 0.1  # were they two places at rest, they would
    assert find(replace(s, rest=apart), device).counts[0, 0] > 0


@pytest.mark.parametrize("dtype", DTYPES)
def test_points_behind_planes(device: str, dtype: torch.dtype) -> None:
    s = mixed_scene(2)
    found = find(s, device, dtype)
    movable = ~s.pinned[s.points]
    for b in range(2):
        at = np.concatenate([s.x[b], s.collider[b]]).astype(np.float32 if dtype == torch.float32 else np.float64)
        behind = []
        for k, (i, j, m) in enumerate(s.planes):
            normal = np.cross(at[j] - at[i], at[m] - at[i])
            behind += [[p, k] for p in np.flatnonzero(((at[s.points] - at[i]) @ normal < 0) & movable)]
        assert int(found.counts[b, 1]) == len(behind) > 0
        assert found.first[b, 1].tolist() == min(behind)
    assert find(Scene.of([sphere((0, 1, 0), 0.1)], [plane((0, 0, 0), (0, 0, 1), (1, 0, 0))])).counts[0, 1] == 0


# --- models ----------------------------------------------------------------------------------------------------------


def overlapping(device: str = "cpu", dtype: torch.dtype = torch.float64, shift: float = 0.17, things: Any = (),
                **options: Any) -> dv.Model:  # fmt: skip
    """Two boxes of 0.2 m, one ``shift`` above the other."""
    boxes = [dv.mesh.box(3, 0.2), dv.mesh.box(2, 0.2).translate((0.031, shift, 0.023))]
    barrier = dv.PairBarrier(**({"dhat": 0.02} | options))
    return dv.Model(dv.mesh.join(boxes), energies=(dv.StableNeoHookean(), barrier), colliders=things, device=device,
                    dtype=dtype)  # fmt: skip


def run(model: dv.Model, x: Any = None, steps: int = 1, **options: Any) -> results.Trajectory:
    x = model.rest_points if x is None else x
    return dv.rollout(model, x, torch.zeros_like(x), steps=steps, **STEP, **options)


@pytest.mark.parametrize("dtype", DTYPES)
def test_a_rollout_refuses_a_start_that_intersects(device: str, dtype: torch.dtype) -> None:
    model = overlapping(device, dtype)
    listed = dv.contact.intersections(model, model.rest_points)
    crossing = listed[0]
    ends = model.surface_of_contact.edges[crossing[1]].tolist()
    corners = model.surface_of_contact.triangles[crossing[2]].tolist()
    with pytest.raises(ValueError) as error:
        run(model)
    message = str(error.value)
    assert message.startswith(f"x: expected surfaces that do not intersect, got {len(listed)} edges through triangles")
    assert f"corner points {ends} passes through the triangle {corners} in scene 0" in message
    assert "in scene 0, of body 0 and body 1. " in message or "in scene 0, of body 1 and body 0. " in message
    assert "move the bodies apart" in message and "Checks(start=False)" in message
    assert run(model, checks=dv.Checks(start=False)).x.isfinite().all()
    assert run(model, steps=0).steps == [0]
    with debug_checks(), pytest.raises(ValueError, match="x: expected surfaces that do not intersect, got"):
        dv.step(model, model.rest_points, torch.zeros_like(model.rest_points), **STEP)


def test_what_contact_does_not_keep_apart_may_overlap() -> None:
    run(overlapping(between_bodies=False))
    dv.rollout(dv.Model(overlapping().mesh), overlapping().rest_points, 0 * overlapping().rest_points, steps=1, **STEP)
    pinned = dv.Model(overlapping().mesh, pinned=range(35), energies=(dv.StableNeoHookean(), dv.PairBarrier()))
    run(pinned)
    assert len(dv.contact.intersections(pinned, pinned.rest_points)) > 0


def test_colliders(device: str) -> None:
    """Where they are at the start counts, and behind a plane is an intersection."""
    obstacle = dv.mesh.box(2, 0.1).translate((0.05, 0.5, 0.05))
    thing = colliders.Obstacle(obstacle.points, obstacle.surface)
    model = overlapping(device, shift=0.21, things=[thing])
    inside = model.collider_points - torch.tensor([0.0, 0.15, 0.0], dtype=torch.float64, device=device)
    run(model)
    for options in ({"colliders": inside}, {"colliders": dv.per_step(inside[None]), "colliders_before": inside}):
        with pytest.raises(ValueError, match="x or colliders: expected surfaces that do not intersect"):
            run(model, **options)
    model = overlapping(device, shift=0.21, things=[colliders.Plane((0, 0.05, 0), (0, 1, 0))])
    with pytest.raises(ValueError, match=r"got 9 points behind planes: corner point 0 lies behind the plane \[35, 36"):
        run(model)


@pytest.mark.cuda
def test_a_captured_rollout_is_not_checked() -> None:
    model = overlapping("cuda")
    x = model.rest_points
    run(model, x, checks=dv.Checks(start=False))
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        captured = run(model, x).x[-1]
    graph.replay()
    assert captured.shape == x.shape


@pytest.mark.parametrize("dtype", DTYPES)
def test_intersections_of_a_model(device: str, dtype: torch.dtype) -> None:
    """The list for users is the reference's, in several scenes, and however many there are."""
    rng = generator("model")
    mesh = dv.mesh.join([dv.mesh.cube(5), dv.mesh.cube(4).translate((0.53, 0.47, 0.51))])
    model = dv.Model(mesh, device=device, dtype=dtype)
    noise = torch.from_numpy(rng.standard_normal((2, model.num_vertices, 3)))
    for size in (1e-2, 1.0):  # the latter crosses more often than it has edges
        x = model.rest_points + (size * noise).to(model.rest_points)
        found = dv.contact.intersections(model, x)
        edges = np.unique(np.sort(np.concatenate([mesh.surface[:, [k, k - 2]] for k in range(3)]), 1), axis=0)
        rows = [[b, *pair] for b in range(2) for pair in intersections(x[b], mesh.surface, edges).tolist()]
        assert found.tolist() == rows and len(rows) > 20 and (len(rows) > len(edges)) == (size == 1.0)
        assert found.dtype == torch.int64 and found.device.type == "cpu"
    with pytest.raises(ValueError, match="x: expected finite positions, got 1 that are not"):
        x[1, 3, 0] = torch.nan
        dv.contact.intersections(model, x)
