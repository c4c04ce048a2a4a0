"""Islands of bodies in contact, against a plain restatement of their definition; sums over segments."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from helpers.detection_scenes import Scene, Surface, capsule, plane, solid, sphere

import diffvbd as dv
from diffvbd.ops import contact as ops_contact
from diffvbd.testing import generator, tolerance

ROOM, DHAT = 0.01, 0.02
MARGIN = ROOM + DHAT / 2
CUBE = dv.mesh.cube(2, 1.0)


def arguments(
    s: Scene, move: np.ndarray, mass: np.ndarray, device: str = "cpu", dtype: torch.dtype = torch.float64
) -> tuple:
    """Of contact_islands; move [B, V, 3], mass [1 | B, V]."""
    x, origin, collider, following, _, radius, *_, planes, body, held = s.arguments(device, dtype)[:12]
    v = s.x.shape[1]
    order = np.argsort(s.body[:v], kind="stable").astype(np.int32)
    ptr = np.searchsorted(s.body[order], np.arange(s.mesh_bodies + 1)).astype(np.int32)
    real = [torch.as_tensor(np.array(a), dtype=dtype, device=device) for a in (move, mass)]
    index = [torch.as_tensor(a, device=device) for a in (order, ptr)]
    room = torch.full((len(x), s.mesh_bodies + 1), ROOM, dtype=dtype, device=device)
    return (x, origin, *real, collider, following, planes, body, *index, held, radius, room, s.mesh_bodies, DHAT)


def islands(s: Scene, move: Any, device: str = "cpu", dtype: torch.dtype = torch.float64) -> list[list[int]]:
    """With unit masses; move: of each body."""
    v = s.x.shape[1]
    moves = np.broadcast_to(np.asarray(move, dtype=float)[s.body[:v]], s.x.shape)
    return ops_contact.contact_islands(*arguments(s, moves, np.ones((1, v)), device, dtype)).tolist()


def cubes(*places: Any, colliders: tuple[Surface, ...] = (), held: int | None = None, scenes: int = 1) -> Scene:
    """Unit cubes with these lower corners."""
    s = Scene.of([solid(CUBE.translate(p)) for p in places], colliders, scenes)
    if held is not None:
        s.held[held] = True
    return s


DOWN = (0, -1, 0)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_bodies_that_fall_side_by_side_move_together(device: str, dtype: torch.dtype) -> None:
    s = cubes((0, 0, 0), (1.001, 0, 0), (5, 0, 0), (6.001, 0.5, 0), (0, 3, 0))
    assert islands(s, [DOWN] * 5, device, dtype) == [[0, 0, 2, 2, 4]]
    s.origin, s.x = np.broadcast_to([1e4, 0, 0], s.x.shape).copy(), s.x + [1e4, 0, 0]
    assert islands(s, [DOWN] * 5, device, dtype) == [[0, 0, 2, 2, 4]]


def test_fast_bodies_that_would_meet_are_one_island(device: str) -> None:
    apart = cubes((0, 0, 0), (9, 0, 0))
    assert islands(apart, [(3.9, 0, 0), (-3.9, 0, 0)], device) == [[0, 1]]
    assert islands(apart, [(4.1, 0, 0), (-4.1, 0, 0)], device) == [[0, 0]]
    assert islands(apart, [(1e6, 0, 0), (1e6, 0, 0)], device) == [[0, 0]]


def test_a_held_vertex_keeps_its_island(device: str) -> None:
    s = cubes((0, 0, 0), (1.001, 0, 0), (4, 0, 0), held=3)
    assert islands(s, [DOWN] * 3, device) == [[-1, -1, 2]]


@pytest.mark.parametrize("height,expected", [(-1.02, -1), (-1.05, 0)])
def test_what_reaches_a_collider_stays(device: str, height: float, expected: int) -> None:
    """A unit fall reaches y = -1, and 0.02 below it with the margin; the collider has the same margin."""
    floor = plane((0, height, 0), (0, height, 1), (1, height, 0))
    ball, rod = sphere((0.5, height - 0.3, 0.5), 0.3), capsule((-2, height - 0.1, 0.3), (2, height - 0.1, 0.4), 0.1)
    slab = solid(dv.mesh.box(2, (1.0, 1.0, 1.0)).translate((0, height - 1, 0)))
    for collider in (floor, ball, rod, slab):
        assert islands(cubes((0, 0, 0), colliders=(collider,)), [DOWN], device) == [[expected]]
        s = cubes((0, 0, 0), colliders=(sphere((50, 0, 0), 1), collider))
        s.collider_next[:, 1:], s.collider[:, 1:, 1] = s.collider[:, 1:], s.collider[:, 1:, 1] - 7.0  # on its way up
        assert islands(s, [DOWN], device) == [[expected]]


def test_a_plane_bounds_half_of_space_only(device: str) -> None:
    """The points that span it are nowhere near; neither is their bounding box a collider."""
    slope = plane((100, -3, 0), (100, -2, 1), (101, -3, 0))  # y = z - 3
    assert islands(cubes((0, 0, 0), colliders=(slope,)), [(0, 0, 0)], device) == [[0]]
    assert islands(cubes((0, 0, 3), colliders=(slope,)), [(0, 0, 0)], device) == [[-1]]
    around = plane((-5, -3, -5), (-5, -3, 5), (5, -3, -5))
    assert islands(cubes((0, 0, 0), colliders=(around,)), [(0, 0, 0)], device) == [[0]]


def test_chains_that_do_not_settle_become_one_island(device: str) -> None:
    """Every round of joining drags the row into one body more."""
    places = [(3.0 * k, 0, 0) for k in range(12)]
    assert islands(cubes(*places), [(40.0, 0, 0)] + [(0, 0, 0)] * 11, device) == [[0] * 12]
    far = cubes(*places, (0, 500, 0))
    assert islands(far, [(2.1, 0, 0)] + [(2.1, 0, 0)] * 12, device) == [[0] * 12 + [12]]


def definition(s: Scene, b: int, move: np.ndarray, mass: np.ndarray) -> list[int]:
    """As written down, with loops."""
    v, bodies = s.x.shape[1], range(s.mesh_bodies)
    body, held = s.body[:v], s.held[:v]
    label, blocked = np.arange(s.mesh_bodies), np.array([held[body == k].any() for k in bodies])
    boxes = np.stack([[s.x[b][body == k].min(0), s.x[b][body == k].max(0)] for k in bodies])
    solids = []
    for k in set(s.body[v:].tolist()) - set(s.body[s.planes].reshape(-1).tolist()):
        path = np.stack([s.collider[b], s.collider_next[b]])[:, s.body[v:] == k].reshape(-1, 3)
        r = s.radius[s.body == k][0] + MARGIN
        solids.append((path.min(0) - r, path.max(0) + r))

    def sweep() -> np.ndarray:
        out = np.empty_like(boxes)
        for k in bodies:
            own = np.isin(body, np.flatnonzero(label == label[k]))
            free = own & ~held
            stays = blocked[label == label[k]].any() or not free.any()
            u = np.zeros(3) if stays else (mass[free, None] * move[free]).sum(0) / mass[free].sum()
            ends = np.stack([boxes[k], boxes[k] + u])
            out[k] = ends[:, 0].min(0) - MARGIN, ends[:, 1].max(0) + MARGIN
        for k in bodies:
            near = any((out[k, 0] <= hi).all() and (lo <= out[k, 1]).all() for lo, hi in solids)
            for p in s.planes - v:
                a, c, d = s.collider_next[b][p]
                n = np.cross(c - a, d - a)
                n /= np.linalg.norm(n)
                near |= bool((n * (np.where(n < 0, out[k, 1], out[k, 0]) - a)).sum() < MARGIN)
            blocked[k] |= near
        return out

    def meetings() -> list[tuple[int, int]]:
        box = sweep()
        return [(i, j) for i in bodies for j in range(i) if label[i] != label[j]
                and (box[i, 0] <= box[j, 1]).all() and (box[j, 0] <= box[i, 1]).all()]  # fmt: skip

    for _ in range(4):
        for i, j in meetings():
            label[np.isin(label, [label[i], label[j]])] = min(label[i], label[j])
    if meetings():
        label[:] = 0
        sweep()
    return [-1 if blocked[label == label[k]].any() else int(label[k]) for k in bodies]


@pytest.mark.parametrize("seed", range(6))
def test_random_scenes(device: str, seed: int) -> None:
    rng = generator("islands", seed)
    places = rng.uniform(0, (12, 12, 30)[seed % 3], (25, 3))
    colliders = (sphere((6, 6, 6), 0.5), plane((0, 0.5, 0), (0, 0.5, 1), (1, 0.4, 0)))[: seed % 3]
    s = cubes(*places, colliders=colliders, held=40 if seed % 2 else None, scenes=3)
    move = rng.normal(0, 1, (3, s.mesh_bodies, 3))[:, s.body[: s.x.shape[1]]] + 0.1 * rng.standard_normal(s.x.shape)
    s.x += rng.uniform(-0.2, 0.2, (3, s.mesh_bodies, 3))[:, s.body[: s.x.shape[1]]]
    for mass in (rng.uniform(0.5, 2, (1, s.x.shape[1])), rng.uniform(0.5, 2, s.x.shape[:2])):
        found = ops_contact.contact_islands(*arguments(s, move, mass, device))
        assert torch.equal(found, ops_contact.contact_islands(*arguments(s, move, mass, device)))
        assert found.tolist() == [definition(s, b, move[b], mass[b % len(mass)]) for b in range(3)]


def test_many_bodies(device: str) -> None:
    """Columns of cubes that fall side by side."""
    m = 40
    corner = np.array(CUBE.points) * 0.9
    place = np.stack(np.meshgrid(np.arange(m) * 3.0, np.arange(m) * 0.905, indexing="ij"), -1).reshape(-1, 2)
    x = (np.insert(place, 2, 0, axis=1)[:, None] + corner).reshape(1, -1, 3)
    bodies = Surface(x[0])
    s = Scene.of([bodies])
    s.body, s.mesh_bodies = np.repeat(np.arange(m * m), 8).astype(np.int32), m * m
    found = islands(s, np.tile(DOWN, (m * m, 1)), device)
    assert found == [np.repeat(np.arange(m) * m, m).tolist()]


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_bodies_that_are_not_finite_stay(device: str, value: float) -> None:
    s = cubes((0, 0, 0), (1.001, 0, 0), (5, 0, 0))
    s.x[0, -1, 0] = value
    assert islands(s, [DOWN] * 3, device)[0][2] == -1
    assert islands(cubes((0, 0, 0)), [(value, 0, 0)], device) == [[-1]]


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("sizes", [[0, 3, 0, 1], [1] * 40, [5000, 20], [2048], [100] * 6, [2000] + [30] * 9])
def test_segment_sum(device: str, sizes: list[int], dtype: torch.dtype) -> None:
    rng = generator("segments", *sizes)
    values = torch.as_tensor(rng.standard_normal((2, sum(sizes), 3)), dtype=dtype, device=device)
    order = torch.as_tensor(rng.permutation(sum(sizes)).astype(np.int32), device=device)
    ptr = torch.as_tensor(np.cumsum([0, *sizes]).astype(np.int32), device=device)
    got = ops_contact.segment_sum(values, order, ptr)
    rows = values.double().cpu()[:, order.cpu().long()].split(sizes, 1)
    expected = torch.stack([r.sum(1) for r in rows], 1)
    atol = tolerance("long_sum" if dtype == torch.float64 else "long_sum_float32")
    torch.testing.assert_close(got.double().cpu(), expected, rtol=0, atol=atol)
    assert torch.equal(got, ops_contact.segment_sum(values, order, ptr))


@pytest.mark.parametrize("sizes", [[100] * 6, [2000] + [30] * 9])
def test_segment_sum_of_a_scene_is_that_of_many(device: str, sizes: list[int]) -> None:
    rng, scenes = generator("segments of many", *sizes), 2000
    values = torch.as_tensor(rng.standard_normal((1, sum(sizes), 3)), device=device)
    order = torch.as_tensor(rng.permutation(sum(sizes)).astype(np.int32), device=device)
    ptr = torch.as_tensor(np.cumsum([0, *sizes]).astype(np.int32), device=device)
    alone = ops_contact.segment_sum(values, order, ptr)
    assert float(alone.abs().min()) > 0
    together = ops_contact.segment_sum(values.expand(scenes, -1, -1).contiguous(), order, ptr)
    assert torch.equal(together, alone.expand(scenes, -1, -1))


def test_threads_that_share_scenes_and_segments_change_nothing() -> None:
    rng, scenes, threads = generator("shared"), 100, torch.get_num_threads()
    s = cubes(*rng.uniform(0, 12, (25, 3)), scenes=scenes)
    move = np.repeat(rng.normal(0, 1, (scenes, s.mesh_bodies, 3)), CUBE.num_vertices, axis=1)
    values = torch.as_tensor(rng.standard_normal((2, 12_000, 3)))
    order = torch.as_tensor(rng.permutation(12_000).astype(np.int32))
    ptr = torch.arange(0, 12_001, 20, dtype=torch.int32)
    results = []
    try:
        for n in (1, 2, 4):
            torch.set_num_threads(n)
            found = ops_contact.contact_islands(*arguments(s, move, np.ones((1, s.x.shape[1]))))
            results.append((found, ops_contact.segment_sum(values, order, ptr)))
    finally:
        torch.set_num_threads(threads)
    # more than one thread is given
    assert scenes * s.x.shape[1] > 4 * 4096 and results[0][0].unique().numel() > 2
    for found, sums in results[1:]:
        assert torch.equal(found, results[0][0]) and torch.equal(sums, results[0][1])


def test_opcheck_and_bad_input(device: str) -> None:
    s = cubes((0, 0, 0), (1.001, 0, 0), colliders=(sphere((5, 0, 0), 1),))
    good = arguments(s, np.zeros(s.x.shape), np.ones((1, s.x.shape[1])), device)
    torch.library.opcheck(torch.ops.diffvbd.contact_islands.default, (*good, False))
    order, ptr = good[8], good[9]
    torch.library.opcheck(torch.ops.diffvbd.segment_sum.default, (good[0], order, ptr))
    for place in (0, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12):
        for bad in (good[place][None], good[place].to(torch.int64)):
            with pytest.raises(ValueError, match="expected"):
                ops_contact.contact_islands(*good[:place], bad, *good[place + 1 :])
    for bad in ((good[0][0], order, ptr), (good[0], order.long(), ptr), (good[0], order, ptr[:0])):
        with pytest.raises(ValueError, match="expected"):
            ops_contact.segment_sum(*bad)
