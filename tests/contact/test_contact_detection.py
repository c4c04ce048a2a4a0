"""Detection of contact against brute force: the pairs, their constants, the near pairs, counts and bits."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from helpers.detection_scenes import (
    Pairs,
    Scene,
    Surface,
    all_pairs,
    capsule,
    mixed_scene,
    plane,
    solid,
    soup,
    sphere,
)

import diffvbd as dv
from diffvbd.ops import contact as ops_contact
from diffvbd.testing import generator, tolerance


def detect(s: Scene, device: str = "cpu", dtype: torch.dtype = torch.float64, capacity: int = 60000) -> Any:
    found = ops_contact.contact_detect(*s.arguments(device, dtype, capacity))
    assert all(t.device.type == device for t in found)
    return ops_contact.Detection(*(t.cpu() for t in found))


def check(s: Scene, device: str = "cpu", dtype: torch.dtype = torch.float64) -> tuple[list[Pairs], Any]:
    """Compares everything a detection returns with brute force; returns both."""
    if dtype == torch.float32:  # the numbers that the operator sees
        names = ("x", "collider", "collider_next", "rest", "radius", "origin")
        local = replace(s, x=s.x - s.origin if s.origin.size else s.x)
        s = replace(s, **{n: getattr(local, n).astype(np.float32).astype(np.float64) for n in names})
        if s.origin.size:
            s.x = s.x + s.origin
    single = dtype == torch.float32
    tol = tolerance("detection_float32" if single else "detection")
    rtol = tolerance("thresholds_float32" if single else "thresholds")
    got = detect(s, device, dtype)
    n, scenes = len(s.body), len(s.x)
    expected = [all_pairs(s, b) for b in range(scenes)]
    count = int(got.counts[0])
    rows = got.pairs[:count].numpy()
    assert (got.pairs[count:] == -1).all() and int(got.ptr[-1]) == 4 * count
    for b, e in enumerate(expected):
        mine = rows[rows[:, 5] == b]
        index = {(k, *c): i for i, (k, c) in enumerate(zip(e.kind, e.corners.tolist(), strict=True))}
        picked = np.array([index[(r[4], *r[:4])] for r in mine.tolist()], int)
        assert (np.diff(picked) > 0).all()  # in the order of keys, each once
        missing = np.setdiff1d(np.flatnonzero(e.margin > 0), picked)
        assert (e.margin[missing] < tol).all() and (e.margin[picked] > -tol).all(), (missing, e.margin.shape)
        constants = got.constants[:count][rows[:, 5] == b].double().numpy()
        np.testing.assert_allclose(constants[:, :3], e.constants[picked], rtol=rtol, atol=tol)
        np.testing.assert_allclose(np.linalg.norm(constants[:, 3:6], axis=1), 1, atol=10 * tol)
        np.testing.assert_allclose(constants[:, 6], e.near[e.corners[picked]].min(1), atol=tol)
        np.testing.assert_allclose(constants[:, 7], e.gap[picked], atol=tol)
        check_near(s, b, e, got, index, tol)
        assert abs(float(got.smallest[b]) - min([s.reach, *e.gap])) < tol
    touching = [(e.begins <= 0, e.key) for e in expected]
    assert int(got.counts[1]) == sum(int(t.sum()) for t, _ in touching)
    first = [int(k[t].min()) for t, k in touching if t.any()]
    assert int(got.counts[2]) == min(first, default=-1)
    corner = torch.arange(4 * count)
    point = got.pairs[corner // 4, 5] * n + got.pairs[corner // 4, corner % 4]
    lists = [got.entry[got.ptr[i] : got.ptr[i + 1]] for i in range(scenes * n)]
    assert torch.equal(torch.cat([*lists, corner[:0].int()]), corner[torch.argsort(point, stable=True)].int())
    return expected, got


def check_near(s: Scene, b: int, e: Pairs, got: Any, index: dict, tol: float) -> None:
    values, near = got.near_values[b].double().numpy(), got.near_corners[b].numpy()
    np.testing.assert_allclose(values[:, 7], e.near, atol=tol)
    for i, row in enumerate(near.tolist()):
        if row[4] < 0:
            assert row == [i] * 4 + [-1] and not values[i, :7].any() and e.near[i] > s.reach - tol
            continue
        pair = index[(row[4], *row[:4])]
        assert i in row[:4] and e.gap[pair] - e.near[i] < tol
        c = np.concatenate([s.x[b], s.collider_next[b] if e.ends[pair] else s.collider[b]])[row[:4]]
        d, offset = values[i, 7] + e.constants[pair, 1], values[i, :4] @ (c - c[0])
        assert abs(np.linalg.norm(values[i, 4:7]) - 1) < 10 * tol and abs(values[i, :4].sum()) < tol
        assert abs(values[i, 4:7] @ offset - d) < 10 * tol


DTYPES = [torch.float64, torch.float32]


@pytest.mark.parametrize("dtype", DTYPES)
def test_bodies_and_all_kinds_of_colliders(device: str, dtype: torch.dtype) -> None:
    expected, _ = check(mixed_scene(), device, dtype)
    kinds, counts = np.unique(expected[0].kind[expected[0].margin > 0], return_counts=True)
    assert kinds.tolist() == [0, 1, 2] and counts.min() > 10, counts


@pytest.mark.parametrize("self_contact", [False, True])
@pytest.mark.parametrize("between_bodies", [False, True])
def test_switches(device: str, self_contact: bool, between_bodies: bool) -> None:
    check(mixed_scene(self_contact=self_contact, between_bodies=between_bodies), device)


def test_scenes_do_not_mix(device: str) -> None:
    expected, _ = check(mixed_scene(scenes=5), device)
    assert len({len(e.gap) for e in expected}) > 1


@pytest.mark.parametrize("triangles", [1, 2, 9, 150])
def test_random_triangles(device: str, triangles: int) -> None:
    check(Scene.of([soup(generator("soup", triangles), triangles)]), device)


def fine_surface() -> Surface:
    """Far away, with more edges than CUDA compares with one another: there it walks through trees."""
    fine = soup(generator("fine"), 700)
    return replace(fine, points=fine.points + 50.0)


@pytest.mark.parametrize("dtype", DTYPES)
def test_a_fine_surface_far_away_changes_nothing(device: str, dtype: torch.dtype) -> None:
    near = generator("near")
    others = [capsule((0.1, 0.8, 0.2), (0.9, 0.7, 0.5), 0.1), plane((0, 0, 0), (0, 0, 1), (1, 0, 0.1))]
    boxes = [soup(near, 25), solid(dv.mesh.box(2, (0.5, 0.3, 0.3)))]
    for bodies, colliders, scenes in (([soup(near, 150)], [], 1), (boxes, others, 3)):
        small, large = Scene.of(bodies, colliders, scenes), Scene.of(bodies, [*colliders, fine_surface()], scenes)
        assert len(small.edges) < 2048 < len(large.edges)
        alone, beside = detect(small, device, dtype), detect(large, device, dtype)
        count, corners = int(alone.counts[0]), alone.near_values.shape[1]
        assert count > 300 and torch.equal(alone.counts[:2], beside.counts[:2])
        assert torch.equal(alone.pairs[:count], beside.pairs[:count])
        assert torch.equal(alone.constants[:count], beside.constants[:count])
        assert torch.equal(alone.near_values, beside.near_values[:, :corners])
        assert torch.equal(alone.near_corners, beside.near_corners[:, :corners])
        assert torch.equal(alone.smallest, beside.smallest)


def test_bodies_and_shells_of_meshes(device: str) -> None:
    """A folded sheet near a blob: sides of the sheet are closer at rest than dhat, and keep 0.9 of that."""
    mesh = dv.mesh.sheet(7, 5, (0.5, 0.4), thickness=0.01)
    s = Scene.of([solid(mesh), solid(dv.mesh.blob(4).translate((0.1, 0.25, 0.1)))], dhat=0.02)
    s.x[0, :, 1] += 0.1 * np.sin(8 * s.x[0, :, 0]) + 0.002 * generator("fold").standard_normal(s.x.shape[1])
    expected, _ = check(s, device)
    dhat = expected[0].constants[expected[0].margin > 0, 0]
    assert (dhat < 0.9 * 0.0101).sum() > 20 and (dhat == 0.02).sum() > 20


def test_sides_in_one_place_at_rest_are_no_pair(device: str) -> None:
    body = soup(generator("twice"), 4)
    doubled = Surface.of(np.concatenate([body.points] * 2), np.concatenate([body.triangles, body.triangles + 12]))
    s = Scene.of([doubled], trust_radius=0.18)
    s.x[0, 12:] += 0.05
    expected, got = check(s, device)
    assert len(expected[0].gap) > 0 and int(got.counts[1]) == 0
    s.rest[12:] += 10.0
    assert len(all_pairs(s, 0).gap) > len(expected[0].gap)
    check(s, device)


def test_held_corners_and_colliders_alone_make_no_pair(device: str) -> None:
    s = mixed_scene()
    s.pinned[:] = True
    assert detect(s, device).counts.tolist() == [0, 0, -1]
    nothing = Scene.of([], [sphere((0, 0, 0), 1), capsule((0, 0, 0), (1, 0, 0), 1)])
    assert detect(nothing, device).counts.tolist() == [0, 0, -1]


@pytest.mark.parametrize("dtype", DTYPES)
def test_far_from_the_origin(device: str, dtype: torch.dtype) -> None:
    """Bodies relative to a point of their own lose nothing, however far away they are."""
    s = mixed_scene()
    v, far = s.x.shape[1], np.array([4096.0, -8192.0, 1024.0])
    triangles, edges = (s.triangles < v).all(1), (s.edges < v).all(1)
    mesh = replace(
        s, triangles=s.triangles[triangles], edges=s.edges[edges], points=s.points[s.points < v], planes=s.planes[:0],
        face_counts=s.face_counts[np.concatenate([triangles, edges])],
    )  # fmt: skip
    body = mesh.body[:v]
    mesh.origin = np.stack([np.round(mesh.x[0, body == b][0], 1) for b in range(3)])[body][None]
    mesh.origin = mesh.origin.astype(np.float32).astype(np.float64)
    near, _ = check(mesh, device, dtype)
    mesh.origin, mesh.x = mesh.origin + far, mesh.x + far
    _, got = check(replace(mesh, origin=mesh.origin, x=mesh.x), device, dtype)
    assert int(got.counts[0]) >= (near[0].margin > 1e-3).sum() > 50


def test_one_query_with_thousands_of_pairs(device: str) -> None:
    """A sphere, a long capsule and a plane beside everything."""
    grid = np.stack(np.meshgrid(*[np.linspace(0, 1, 30)] * 2, indexing="ij"), -1).reshape(-1, 2)
    points = np.insert(grid, 1, 0.01 * np.sin(20 * grid[:, 0]), axis=1)
    a = (np.arange(29)[:, None] * 30 + np.arange(29)).reshape(-1)
    triangles = np.concatenate([np.stack([a, a + 1, a + 30], -1), np.stack([a + 1, a + 31, a + 30], -1)])
    colliders = [sphere((0.5, 20, 0.5), 19.9), capsule((-9, -0.15, 0.4), (9, -0.15, 0.5), 0.1),
                 plane((0, -0.06, 0), (0, -0.06, 1), (1, -0.06, 0))]  # fmt: skip
    s = Scene.of([Surface.of(points, triangles)], colliders, self_contact=False, trust_radius=0.11, dhat=0.08)
    expected, _ = check(s, device)
    assert np.bincount(expected[0].corners[expected[0].kind < 2].reshape(-1)).max() > 1500


def test_touching_pairs_are_counted(device: str) -> None:
    triangle = np.array([[0, 0, 0], [1, 0, 0], [0, 0, 1]], dtype=float)
    upper = triangle + np.array([0.25, 0.0, 0.25])
    faces = np.array([[0, 1, 2]])
    s = Scene.of([Surface.of(triangle, faces), Surface.of(upper, faces)], trust_radius=0.13)
    got = detect(s, device)
    expected = all_pairs(s, 0)
    touching = expected.begins <= 0
    assert 0 < touching.sum() == int(got.counts[1]) and int(got.counts[2]) == expected.key[touching].min()
    assert float(got.smallest) == 0.0
    below = Scene.of([Surface.of(triangle, faces)], [plane((0, 3, 0), (0, 3, 1), (1, 3, 0))])
    _, got = check(below, device)
    assert int(got.counts[1]) == 3 and float(got.smallest) == -3.0


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e300])
def test_positions_that_are_not_finite(device: str, bad: float) -> None:
    s = Scene.of([soup(generator("bad"), 30), solid(dv.mesh.cube(2, 0.4))], scenes=2)
    assert int(detect(s, device).counts[1]) == 0
    s.x[1, 7, 1] = bad
    got, alone = detect(s, device), detect(s.alone(0), device)
    assert int(got.counts[1]) == 1 and int(alone.counts[1]) == 0 and (got.smallest > 0).tolist() == [True, False]
    assert torch.equal(alone.near_values[0], got.near_values[0])
    s.x[:] = bad
    assert int(detect(s, device).counts[1]) >= s.x.shape[0] * s.x.shape[1]
    s = mixed_scene()
    s.collider_next[:] = bad  # of planes
    assert int(detect(s, device).counts[1]) >= s.x.shape[1]


@pytest.mark.parametrize("fine", [False, True])
def test_capacity_that_does_not_suffice(device: str, fine: bool) -> None:
    s = Scene.of([soup(generator("crowded"), 60)], [fine_surface()], 2) if fine else mixed_scene(scenes=2)
    full = detect(s, device)
    needed = int(full.counts[0])
    assert needed > 100
    rows = {tuple(r) for r in full.pairs[:needed].tolist()}
    for capacity in (0, 1, needed - 1, needed):
        got = detect(s, device, capacity=capacity)
        assert torch.equal(got.counts, full.counts) and torch.equal(got.near_values, full.near_values)
        assert len(got.pairs) == len(got.constants) == capacity and {tuple(r) for r in got.pairs.tolist()} <= rows
        assert int(got.ptr[-1]) == len(got.entry) == 4 * capacity
        assert sorted(got.entry.tolist()) == list(range(4 * capacity))


def test_nothing_to_detect(device: str) -> None:
    s = mixed_scene()
    no_scene = replace(s, x=s.x[:0], collider=s.collider[:0], collider_next=s.collider_next[:0])
    for empty in (Scene.of([Surface(np.zeros((0, 3)))]), Scene.of([Surface(np.zeros((3, 3)))], scenes=2), no_scene):
        got = detect(empty, device, capacity=3)
        assert got.counts.tolist() == [0, 0, -1] and (got.pairs == -1).all() and not got.ptr.any()
        assert (got.near_values[..., 7] == s.reach).all() and (got.smallest == s.reach).all()
    points_only = Scene.of(
        [Surface(np.zeros((3, 3)), lone=[0, 1])], [plane((0, -0.07, 0), (0, -0.07, 1), (1, -0.07, 0))]
    )
    assert len(check(points_only, device)[0][0].gap) == 2


@pytest.mark.parametrize("dtype", DTYPES)
def test_bits_repeat(device: str, dtype: torch.dtype) -> None:
    s, threads = mixed_scene(scenes=3), torch.get_num_threads()
    first = detect(s, device, dtype)
    try:
        for n in (1, 2, 3):
            torch.set_num_threads(n)
            assert all(torch.equal(a, b) for a, b in zip(first, detect(s, device, dtype), strict=True))
    finally:
        torch.set_num_threads(threads)
    for b in range(3):  # alone as in the batch
        alone = detect(s.alone(b), device, dtype)
        rows = first.pairs[: int(first.counts[0])]
        assert torch.equal(rows[rows[:, 5] == b][:, :5], alone.pairs[: int(alone.counts[0]), :5])
        assert torch.equal(first.near_values[b], alone.near_values[0])


def test_threads_that_share_a_scene_change_nothing() -> None:
    sheet, threads = dv.mesh.sheet(28, 28, (1.0, 1.0), 0.02), torch.get_num_threads()
    s = Scene.of([solid(sheet), solid(sheet.translate((0.013, 0.03, 0.007)))])
    s.x += 0.002 * generator("shared").standard_normal(s.x.shape)
    results = []
    try:
        for n in (1, 2, 4):
            torch.set_num_threads(n)
            results.append(detect(s, "cpu"))
    finally:
        torch.set_num_threads(threads)
    # far more than the search hands to one thread: 2,048 points and edges
    assert s.x.shape[1] > 3000 and int(results[0].counts[0]) > 3000
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))
