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

RADIUS_FACTOR, DHAT = 0.01, 0.02
MARGIN = RADIUS_FACTOR + DHAT / 2
CUBE = dv.mesh.cube(2, 1.0)


def arguments(
    s: Scene, move: np.ndarray, mass: np.ndarray, device: str = "cpu", dtype: torch.dtype = torch.float64
) -> tuple:
    """Of contact_islands; move [B, V, 3], mass [1 | B, V]."""
    x, origin, collider, following, _, radius, *_, planes, body, pinned = s.arguments(device, dtype)[:12]
    v = s.x.shape[1]
    order = np.argsort(s.body[:v], kind="stable").astype(np.int32)
    ptr = np.searchsorted(s.body[order], np.arange(s.mesh_bodies + 1)).astype(np.int32)
    real = [torch.as_tensor(np.array(a), dtype=dtype, device=device) for a in (move, mass)]
    index = [torch.as_tensor(a, device=device) for a in (order, ptr)]
    trust_radius = torch.full((len(x), s.mesh_bodies + 1), RADIUS_FACTOR, dtype=dtype, device=device)
    return (x, origin, *real, collider, following, planes, body, *index, pinned, radius, trust_radius, s.mesh_bodies,
            DHAT)  # fmt: skip


def islands(s: Scene, move: Any, device: str = "cpu", dtype: torch.dtype = torch.float64) -> list[list[int]]:
    """With unit masses; move: of each body."""
    v = s.x.shape[1]
    moves = np.broadcast_to(np.asarray(move, dtype=float)[s.body[:v]], s.x.shape)
    return ops_contact.contact_islands(*arguments(s, moves, np.ones((1, v)), device, dtype)).tolist()


def cubes(*places: Any, colliders: tuple[Surface, ...] = (), pinned: int | None = None, scenes: int = 1) -> Scene:
    """Unit cubes with these lower corners."""
    s = Scene.of([solid(CUBE.translate(p)) for p in places], colliders, scenes)
    if pinned is not None:
        s.pinned[pinned] = True
    return s


DOWN = (0, -1, 0)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_bodies_that_fall_side_by_side_move_together(device: str, dtype: torch.dtype) -> None:
    s = cubes((0, 0, 0), (1.001, 0, 0), (5, 0, 0), (6.001, 0.5, 0), (0, 3, 0))
    assert islands(s, [DOWN] * 5, device, dtype) == [[0, 0, 2, 2, 4]]
    s.origin, s.x = np.broadcast_to([1e4, 0, 0], s.x.shape).copy(), s.x + [1e4, 0, 0]
    assert islands(s, [DOWN] * 5, device, dtype) == [[0, 0, 2, 2, 4]]


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


def definition(s: Scene, b: int, move: np.ndarray, mass: np.ndarray) -> list[int]:
    """As written down, with loops."""
    v, bodies = s.x.shape[1], range(s.mesh_bodies)
    body, pinned = s.body[:v], s.pinned[:v]
    label, blocked = np.arange(s.mesh_bodies), np.array([pinned[body == k].any() for k in bodies])
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
            free = own & ~pinned
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
    s = cubes(*places, colliders=colliders, pinned=40 if seed % 2 else None, scenes=3)
    move = rng.normal(0, 1, (3, s.mesh_bodies, 3))[:, s.body[: s.x.shape[1]]] + 0.1 * rng.standard_normal(s.x.shape)
    s.x += rng.uniform(-0.2, 0.2, (3, s.mesh_bodies, 3))[:, s.body[: s.x.shape[1]]]
    for mass in (rng.uniform(0.5, 2, (1, s.x.shape[1])), rng.uniform(0.5, 2, s.x.shape[:2])):
        found = ops_contact.contact_islands(*arguments(s, move, mass, device))
        assert torch.equal(found, ops_contact.contact_islands(*arguments(s, move, mass, device)))
        assert found.tolist() == [definition(s, b, move[b], mass[b % len(mass)]) for b in range(3)]


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
