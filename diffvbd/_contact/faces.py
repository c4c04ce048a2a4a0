"""Which faces of a surface push a point, along which edges it is sharp, and how much of it each vertex bears for."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..mesh import TetMesh
from ..mesh.arrays import connected

# Degrees by which a surface turns at rest along a sharp edge. Below, it lies within 3 % of an edge from its vertices.
SHARP = 15.0


def _edges_of(triangles: NDArray[Any], edges: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """All edges once, lower vertex first; the row there of each of ``edges`` [E]; and of the sides of triangles [3F]:
    those between corners 0 and 1 of all, then 1 and 2, then 2 and 0."""
    sides = np.concatenate([edges, triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    rows, inverse = np.unique(np.sort(sides, axis=1), axis=0, return_inverse=True)
    inverse = inverse.reshape(-1)
    return rows, inverse[: len(edges)], inverse[len(edges) :]


def faces_of(triangles: NDArray[Any], edges: NDArray[Any]) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """The faces of surfaces [F, 3], (a, b, b) of edges and (a, a, a) of vertices, and how often each counts [F].

    A face counts 1 less what the faces that contain it count: inclusion and exclusion. Then a point has the barrier of
    its distance to the surface once, however many faces are as close. Faces that count 0 are left out.

    Source: Li et al. (2023), Convergent incremental potential contact.
    """
    rows, _, of_triangles = _edges_of(triangles, edges)
    of_edges = 1 - np.bincount(of_triangles, minlength=len(rows))
    vertices = np.unique(rows)
    of_vertices = np.ones(vertices.max(initial=-1) + 1, np.int64)
    np.subtract.at(of_vertices, triangles, 1)
    np.subtract.at(of_vertices, rows, of_edges[:, None])
    faces = np.concatenate([triangles, rows[:, [0, 1, 1]], np.repeat(vertices[:, None], 3, 1)])
    counts = np.concatenate([np.ones(len(triangles), np.int64), of_edges, of_vertices[vertices]])
    return faces[counts != 0].astype(np.int32), counts[counts != 0].astype(np.int32)


def sharp_edges(points: NDArray[np.float64], triangles: NDArray[Any], edges: NDArray[Any]) -> NDArray[np.bool_]:
    """Whether a surface turns by SHARP or more at each edge [E]; all other edges than of two triangles are sharp."""
    a, b, c = (points[triangles[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), np.finfo(np.float64).tiny)
    rows, own, of_triangles = _edges_of(triangles, edges)
    total = np.zeros((len(rows), 3))
    np.add.at(total, of_triangles, np.concatenate([normal] * 3))
    flat = np.bincount(of_triangles, minlength=len(rows)) == 2
    flat &= np.linalg.norm(total, axis=1) > 2 * np.cos(np.radians(SHARP) / 2)  # |n + m| of unit normals n and m
    return ~flat[own]


def vertex_areas(points: NDArray[np.float64], triangles: NDArray[Any]) -> NDArray[np.float64]:
    """The part of a surface that each point [N] bears for [m^2]; 0 of points of no triangle.

    It is the point's Voronoi cell, or, where sharp edges cut that, the largest piece: what presses on a point presses
    on one side of an edge.

    Source: Meyer et al. (2003), Discrete differential-geometry operators for triangulated 2-manifolds, for the cells.
    """
    at, count, vertex = points[triangles], len(triangles), triangles.reshape(-1)
    sides = np.roll(at, -1, axis=1) - at  # [F, 3, 3], from each corner to the next
    area = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1) / 2
    squares, cosines = (sides**2).sum(2), -(sides * np.roll(sides, 1, axis=1)).sum(2)  # the latter times both lengths
    opposite = squares * np.roll(cosines, 1, axis=1)  # of a side: of the corner across
    cells = (opposite + np.roll(opposite, 1, axis=1)) / np.maximum(16 * area, np.finfo(float).tiny)[:, None]
    obtuse = cosines < 0
    cells = np.where(obtuse.any(1)[:, None], np.where(obtuse, 2, 1) * area[:, None] / 4, cells)
    # corners of two triangles at a point are of one piece if an edge between them is not sharp
    edges, _, of_sides = _edges_of(triangles, triangles[:0, :2])
    order = np.argsort(of_sides, kind="stable")
    both = order[~sharp_edges(points, triangles, edges)[of_sides[order]]].reshape(-1, 2)
    corner = 3 * (both % count) + both // count  # where each of the two sides begins; it ends at the next one
    ends = [corner, corner - both // count + (both // count + 1) % 3]
    pairs = [np.stack([one[:, 0], other[:, 1]], 1) for one in ends for other in ends]
    pairs = np.concatenate([pair[(vertex[pair[:, 0]] == vertex[pair[:, 1]])] for pair in pairs])
    piece = connected(pairs, 3 * count)
    of_piece = np.bincount(piece, cells.reshape(-1), 3 * count)
    out = np.zeros(len(points))
    np.maximum.at(out, vertex, of_piece[piece])
    return out


def mean_area(mesh: TetMesh) -> float:
    """Of the surface vertices of a mesh [m^2]; 1 where it has none."""
    vertices = np.unique(mesh.surface)
    return float(vertex_areas(mesh.points, mesh.surface)[vertices].mean()) if len(vertices) else 1.0
