"""Scenes for the tests of detection, and all of their pairs by brute force in numpy."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

import diffvbd as dv
from diffvbd.testing import generator

POINT_TRIANGLE, EDGE_EDGE, POINT_PLANE = 0, 1, 2

# --- scenes -----------------------------------------------------------------------------------------------------------


@dataclass
class Surface:
    """One body or collider of a scene; `flat`: it is a plane."""

    points: np.ndarray
    triangles: Any = ()
    edges: Any = ()
    lone: Any = ()  # corner points that may touch
    radius: float = 0.0
    flat: bool = False

    @staticmethod
    def of(points: np.ndarray, triangles: np.ndarray) -> Surface:
        edges = np.unique(np.sort(np.concatenate([triangles[:, [i, j]] for i, j in ((0, 1), (1, 2), (2, 0))])), axis=0)
        return Surface(points, triangles, edges, np.unique(triangles))


def soup(rng: np.random.Generator, triangles: int, size: float = 0.3, extent: float = 1.0) -> Surface:
    """Separate triangles."""
    center = rng.uniform(0, extent, (triangles, 1, 3))
    points = (center + size * rng.uniform(-0.5, 0.5, (triangles, 3, 3))).reshape(-1, 3)
    return Surface.of(points, np.arange(3 * triangles).reshape(-1, 3))


def solid(mesh: dv.TetMesh) -> Surface:
    return Surface.of(np.array(mesh.points), np.array(mesh.surface))


def sphere(center: Any, radius: float) -> Surface:
    return Surface(np.array([center], dtype=float), lone=[0], radius=radius)


def capsule(a: Any, b: Any, radius: float) -> Surface:
    return Surface(np.array([a, b], dtype=float), edges=[[0, 1]], lone=[0, 1], radius=radius)


def plane(*points: Any) -> Surface:
    return Surface(np.array(points, dtype=float), flat=True)


@dataclass
class Scene:
    """Arguments of contact_detect in float64; x is absolute."""

    x: np.ndarray
    collider: np.ndarray
    collider_next: np.ndarray
    rest: np.ndarray
    radius: np.ndarray
    triangles: np.ndarray
    edges: np.ndarray
    points: np.ndarray
    planes: np.ndarray
    body: np.ndarray
    pinned: np.ndarray
    mesh_bodies: int
    face_counts: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int32))  # of triangles, then sharp edges
    self_contact: bool = True
    between_bodies: bool = True
    dhat: float = 0.03
    trust_radius: float = 0.05  # how far vertices of the first body may go; of the last half as far
    own_fraction: float = 0.79  # of that, that they may go beside the rigid motion of their body
    origin: np.ndarray = field(default_factory=lambda: np.zeros((0, 0, 3)))

    @staticmethod
    def of(bodies: Sequence[Surface], colliders: Sequence[Surface] = (), scenes: int = 1, **options: Any) -> Scene:
        parts = [*bodies, *colliders]
        sizes = [len(p.points) for p in parts]
        first = np.concatenate([[0], np.cumsum(sizes)[:-1]]).astype(int)

        def stack(name: str, width: int) -> np.ndarray:
            rows = [np.asarray(getattr(p, name), int).reshape(-1, width) + f for p, f in zip(parts, first, strict=True)]
            return np.concatenate(rows).astype(np.int32)

        rest = np.concatenate([p.points for p in parts])
        v = sum(sizes[: len(bodies)])
        planes = [[f, f + 1, f + 2] for p, f in zip(parts, first, strict=True) if p.flat]
        collider = np.broadcast_to(rest[v:], (scenes, len(rest) - v, 3)).copy()
        triangles, edges = stack("triangles", 3), stack("edges", 2)
        faces = np.concatenate([triangles, edges[::3, [0, 1, 1]], np.repeat(edges[::4, :1], 3, 1)])
        counts = np.concatenate([1 - 2 * (faces.sum(1) % 2), edges.sum(1) % 3 > 0])  # any will do
        return Scene(
            x=np.broadcast_to(rest[:v], (scenes, v, 3)).copy(),
            collider=collider,
            collider_next=collider.copy(),
            rest=rest,
            radius=np.repeat([p.radius for p in parts], sizes),
            triangles=faces,
            edges=edges,
            face_counts=counts.astype(np.int32),
            points=stack("lone", 1).reshape(-1),
            planes=np.array(planes, np.int32).reshape(-1, 3),
            body=np.repeat(np.arange(len(parts)), sizes).astype(np.int32),
            pinned=np.arange(len(rest)) >= v,
            mesh_bodies=len(bodies),
            **options,
        )

    @property
    def weights(self) -> np.ndarray:
        """Of each point; any will do."""
        return 1 + self.points % 3 / 4

    @property
    def trust_radii(self) -> np.ndarray:
        """Of each body [mesh_bodies]."""
        return self.trust_radius * np.linspace(1, 0.5, self.mesh_bodies)

    @property
    def reach(self) -> float:
        """Largest gap that may be found."""
        return self.dhat + 2 * max(1.0, self.own_fraction) * self.trust_radius

    def alone(self, b: int) -> Scene:
        """Scene b of the batch."""
        one = {n: getattr(self, n)[[b]] for n in ("x", "collider", "collider_next")}
        return replace(self, **one, origin=self.origin[[b]] if self.origin.size else self.origin)

    def arguments(self, device: str = "cpu", dtype: torch.dtype = torch.float64, capacity: int = 60000) -> tuple:
        def real(a: np.ndarray) -> Tensor:
            return torch.as_tensor(a, dtype=dtype, device=device).contiguous()

        def index(a: np.ndarray) -> Tensor:
            return torch.as_tensor(a, device=device)

        x = self.x - self.origin if self.origin.size else self.x
        trust_radius = np.tile([*self.trust_radii, self.trust_radius], (len(x), 1))
        return (
            real(x), real(self.origin), real(self.collider), real(self.collider_next), real(trust_radius),
            real(self.own_fraction * trust_radius),
            (real(self.rest), real(self.radius), index(self.triangles), index(self.edges), index(self.points),
             index(self.planes), index(self.body), index(self.pinned), index(self.face_counts), real(self.weights)),
            self.mesh_bodies, self.self_contact, self.between_bodies, self.dhat, capacity,
        )  # fmt: skip


def mixed_scene(scenes: int = 1, **options: Any) -> Scene:
    """Three bodies and every kind of collider, some vertices held, positions off their rest."""
    rng = generator("mixed")
    bodies = [
        soup(rng, 25),
        solid(dv.mesh.cube(2, 0.4)),
        solid(dv.mesh.box(2, (0.5, 0.3, 0.3)).translate((0.3, 0.45, 0.1))),
    ]
    colliders = [
        sphere((0.6, 0.1, 0.2), 0.15), plane((0, 0.05, 0), (0, 0.05, 1), (1, 0.05, 0.1)),
        capsule((0.1, 0.8, 0.2), (0.9, 0.7, 0.5), 0.1), soup(rng, 6), plane((1, 0, 0), (1, 1, 0.2), (1.1, 0, 1)),
    ]  # fmt: skip
    s = Scene.of(bodies, colliders, scenes, **options)
    s.x += 0.02 * rng.standard_normal(s.x.shape)
    s.collider += 0.01 * rng.standard_normal(s.collider.shape)
    s.collider_next += 0.01 * rng.standard_normal(s.collider.shape)
    s.pinned[: s.x.shape[1]] = rng.uniform(size=s.x.shape[1]) < 0.3
    return s


# --- brute force ------------------------------------------------------------------------------------------------------


def segment_weights(p: np.ndarray, a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Weights of a and b in the point of the segment that is closest to p, row by row."""
    ab = b - a
    square = (ab * ab).sum(-1)
    t = np.clip(((p - a) * ab).sum(-1) / np.where(square > 0, square, 1), 0, 1)
    return 1 - t, t


def closest(kind: int, c: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance [n] and weights [n, 4] of pairs with corners c [n, 4, 3], from all features, the interior one first."""
    n, (a, b, p, q) = len(c), c.transpose(1, 0, 2)
    candidates = []  # weights and whether they are valid
    one, zero = np.ones(n), np.zeros(n)
    if kind == EDGE_EDGE:
        u, v, r = b - a, q - p, a - p
        uu, vv, uv = (u * u).sum(-1), (v * v).sum(-1), (u * v).sum(-1)
        ur, vr, size = (u * r).sum(-1), (v * r).sum(-1), uu * vv - uv * uv
        safe = np.where(size > 1e-14 * uu * vv, size, 1)
        s, t = (uv * vr - vv * ur) / safe, (uu * vr - uv * ur) / safe
        inside = (size > 1e-14 * uu * vv) & (s > 0) & (s < 1) & (t > 0) & (t < 1)
        candidates.append((np.stack([1 - s, s, t - 1, -t], -1), inside))
        for end, first in ((a, (one, zero)), (b, (zero, one))):
            k, m = segment_weights(end, p, q)
            candidates.append((np.stack([*first, -k, -m], -1), one > 0))
        for end, last in ((p, (-one, zero)), (q, (zero, -one))):
            k, m = segment_weights(end, a, b)
            candidates.append((np.stack([k, m, *last], -1), one > 0))
    else:
        normal = np.cross(p - b, q - b)
        square = (normal * normal).sum(-1)
        safe = np.where(square > 0, square, 1)
        v = (np.cross(a - b, q - b) * normal).sum(-1) / safe
        w = (np.cross(p - b, a - b) * normal).sum(-1) / safe
        weights = np.stack([one, v + w - 1, -v, -w], -1)
        if kind == POINT_PLANE:
            return (normal * (a - b)).sum(-1) / np.sqrt(safe), weights
        candidates.append((weights, (square > 0) & (v > 0) & (w > 0) & (v + w < 1)))
        for i, j in ((1, 2), (2, 3), (3, 1)):
            k, m = segment_weights(a, c[:, i], c[:, j])
            weights = np.zeros((n, 4))
            weights[:, 0], weights[:, i], weights[:, j] = 1, -k, -m
            candidates.append((weights, one > 0))
    distances = np.stack([
        np.where(valid, np.linalg.norm(np.einsum("nk,nkd->nd", w, c), axis=-1), np.inf) for w, valid in candidates
    ])  # fmt: skip
    best = distances.argmin(0)
    return distances.min(0), np.stack([w for w, _ in candidates])[best, np.arange(n)]


@dataclass
class Pairs:
    """All pairs of one scene that are considered and within the reach of their sides, in the order of their keys."""

    kind: np.ndarray
    corners: np.ndarray
    gap: np.ndarray
    weights: np.ndarray
    constants: np.ndarray
    key: np.ndarray
    margin: np.ndarray  # how far inside the list [m]; listed where > 0
    near: np.ndarray  # smallest gap of each corner point, or the reach
    ends: np.ndarray  # bool: of a plane where it ends
    begins: np.ndarray  # gap where a plane begins, or the gap


def all_pairs(s: Scene, b: int) -> Pairs:
    now, later = np.concatenate([s.x[b], s.collider[b]]), np.concatenate([s.x[b], s.collider_next[b]])
    base = max(map(len, (s.triangles, s.edges, s.points, s.planes))) + 1
    found = []
    for kind in (POINT_TRIANGLE, EDGE_EDGE, POINT_PLANE):
        left = s.edges if kind == EDGE_EDGE else s.points[:, None]
        right = (s.triangles, s.edges, s.planes)[kind]
        i, j = np.meshgrid(np.arange(len(left)), np.arange(len(right)), indexing="ij")
        i, j = (a[i < j] if kind == EDGE_EDGE else a.reshape(-1) for a in (i, j))
        corners = np.concatenate([left[i], right[j]], 1).reshape(-1, 4)
        second = 2 if kind == EDGE_EDGE else 1
        body = s.body[corners]
        one, other = body[:, 0], body[:, second]
        collider = np.maximum(one, other) >= s.mesh_bodies
        both = np.minimum(one, other) >= s.mesh_bodies
        admitted = np.where(collider, ~both, s.self_contact & (one == other) | s.between_bodies & (one != other))
        pinned = s.pinned[corners]
        admitted &= ~(pinned[:, 0] if kind == POINT_PLANE else pinned.all(1))
        for m, n in itertools.product(range(second), range(second, 4)):
            admitted &= corners[:, m] != corners[:, n]
        if kind == POINT_TRIANGLE:  # edges and vertices are no faces for points of their own body
            admitted &= (one != other) | (corners[:, 2] != corners[:, 3])
        i, j, corners, one, other = (a[admitted] for a in (i, j, corners, one, other))
        offset = s.radius[corners[:, 0]] + s.radius[corners[:, second]]
        d, weights = closest(kind, now[corners])
        least, begins, takes = d, d, np.zeros(len(d), dtype=bool)
        if kind == POINT_PLANE:  # where it ends, unless it is behind the point there
            end, of_end = closest(kind, np.where(np.arange(4)[:, None] > 0, later[corners], now[corners]))
            takes, least, begins = end > offset, np.minimum(d, end), d
            d, weights = np.where(takes, end, d), np.where(takes[:, None], of_end, weights)
        rest = s.rest[corners]
        at_rest = closest(kind, rest)[0] if kind != POINT_PLANE else np.full(len(d), np.inf)
        at_rest = np.where(one == other, at_rest, np.inf)
        edges = [np.linalg.norm(rest[:, n] - rest[:, m], axis=-1) for m, n in ((0, 1), (1, 2), (2, 3), (3, 1))]
        counts, sharp = s.face_counts[: len(s.triangles)], s.face_counts[len(s.triangles) :]
        if kind == EDGE_EDGE:
            measure, blunt = 1e-3 * (edges[0] * edges[2]) ** 2, (one != other) & (sharp[i] * sharp[j] == 0)
        else:
            measure, blunt = s.weights[i] * (counts[j] if kind == POINT_TRIANGLE else 1), np.zeros(len(d), bool)
        dhat = np.where(at_rest < s.dhat, 0.9 * at_rest, np.where(blunt, 0.25 * s.dhat, s.dhat))
        trust_radii = np.append(s.trust_radii, 0)[np.minimum(np.stack([one, other], 1), s.mesh_bodies)].sum(1)
        trust_radii = np.where(one == other, s.own_fraction * trust_radii, trust_radii)
        keep = (least - offset < s.dhat + trust_radii) & (at_rest > 1e-9 * np.maximum(*edges[1:3]))
        columns = (np.full(len(d), kind), corners, d - offset, least - offset, weights,
                   np.stack([dhat, offset, measure], -1), ((b * 3 + kind) * base + i) * base + j, takes,
                   begins - offset)  # fmt: skip
        found.append([a[keep] for a in columns])
    kind, corners, gap, least, weights, constants, key, ends, begins = (
        np.concatenate(a) for a in zip(*found, strict=True)
    )
    near = np.full(len(s.body), s.reach)
    np.minimum.at(near, corners, gap[:, None])
    trust_radius = np.where(s.body < s.mesh_bodies, np.append(s.trust_radii, 0)[np.minimum(s.body, s.mesh_bodies)], 0.0)
    second = corners[np.arange(len(kind)), np.where(kind == EDGE_EDGE, 2, 1)]
    own = np.where(s.body[corners[:, 0]] == s.body[second], s.own_fraction, 1.0)
    margin = constants[:, 0] - (least - own * (trust_radius[corners[:, 0]] + trust_radius[second]))
    return Pairs(kind, corners, gap, weights, constants, key, margin, near, ends, begins)
