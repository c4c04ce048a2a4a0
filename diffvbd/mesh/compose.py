"""New meshes from old ones: refine, join, replicate."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from diffvbd.mesh.arrays import IntArray, check_mesh, float_array
from diffvbd.mesh.tet_mesh import TetMesh

# Edges of a tet; edge k has its midpoint at slot 4 + k of the ten-node tet below.
MOST_TETS = 10**9  # of a mesh that is refined
_EDGES = np.array([[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]])
_CORNER_TETS = np.array([[0, 4, 5, 6], [4, 1, 7, 8], [5, 7, 2, 9], [6, 8, 9, 3]])
# The inner octahedron has three diagonals, between midpoints of opposite edges. Each row: the four tets around one.
_DIAGONALS = np.array([[4, 9], [5, 8], [6, 7]])
_INNER_TETS = np.array(
    [
        [[4, 9, 5, 6], [4, 9, 6, 8], [4, 9, 8, 7], [4, 9, 7, 5]],
        [[5, 8, 6, 4], [5, 8, 9, 6], [5, 8, 7, 9], [5, 8, 4, 7]],
        [[6, 7, 4, 5], [6, 7, 5, 9], [6, 7, 9, 8], [6, 7, 8, 4]],
    ]
)


def subdivide(mesh: TetMesh, levels: int = 1) -> TetMesh:
    """Regular refinement: every tet becomes eight, of one eighth of its volume each.

    The old vertices keep their indices; one midpoint per edge follows. Each inner octahedron is cut along its shortest
    diagonal, which bounds the decline of quality over repeated refinement (Zhang, "Successive subdivisions of
    tetrahedra", Houston J. Math. 21, 1995). Body labels are kept.

    Args:
        mesh: The mesh to refine; it stays as it is.
        levels: How often, 0 or more.

    Raises:
        TypeError, ValueError: no TetMesh; levels is not an integer or negative.
    """
    check_mesh(mesh)
    if isinstance(levels, bool) or not isinstance(levels, (int, np.integer)):
        raise TypeError(f"levels: expected an integer, got {levels!r}")
    if levels < 0:
        raise ValueError(f"levels: expected 0 or more, got {levels}")
    if mesh.num_tets * 8 ** min(levels, 11) > MOST_TETS:
        raise ValueError(f"levels: expected at most {MOST_TETS} tets, got {mesh.num_tets} times 8^{levels}")
    for _ in range(levels):
        mesh = _refined(mesh)
    return mesh


def _refined(mesh: TetMesh) -> TetMesh:
    ends = np.sort(mesh.tets[:, _EDGES].reshape(-1, 2), axis=1)
    edges, edge_of = np.unique(ends[:, 0] * max(mesh.num_vertices, 1) + ends[:, 1], return_inverse=True)
    low, high = np.divmod(edges, max(mesh.num_vertices, 1))
    points = np.concatenate([mesh.points, (mesh.points[low] + mesh.points[high]) / 2])
    nodes = np.concatenate([mesh.tets, mesh.num_vertices + edge_of.reshape(-1, 6)], axis=1)
    spans = points[nodes[:, _DIAGONALS[:, 0]]] - points[nodes[:, _DIAGONALS[:, 1]]]
    shortest = np.einsum("nki,nki->nk", spans, spans).argmin(axis=1)
    inner = np.take_along_axis(nodes, _INNER_TETS[shortest].reshape(-1, 16), axis=1)
    tets = np.concatenate([nodes[:, _CORNER_TETS].reshape(-1, 16), inner], axis=1).reshape(-1, 4)
    return TetMesh(points, tets, np.concatenate([mesh.body, mesh.body[low]]))


def _ranked(mesh: TetMesh) -> tuple[IntArray, int]:
    """Body labels replaced by their rank, and how many there are."""
    labels, rank = np.unique(mesh.body, return_inverse=True)
    return rank, len(labels)


def join(meshes: Iterable[TetMesh]) -> TetMesh:
    """All meshes side by side in one, vertices and tets in the order given. Nothing is merged.

    Bodies stay apart: labels of the result count up from 0 through the bodies of the first mesh (in the order of its
    labels), then those of the second, and so on.

    Raises:
        TypeError: something that is not a TetMesh, or no sequence of them.
    """
    if not isinstance(meshes, Iterable):
        raise TypeError(f"meshes: expected TetMesh objects, as in a list, got {type(meshes).__name__}")
    meshes = list(meshes)
    for k, mesh in enumerate(meshes):
        if not isinstance(mesh, TetMesh):
            raise TypeError(f"meshes: expected TetMesh objects, got {type(mesh).__name__} at {k}")
    if not meshes:
        return TetMesh([], [])
    ranked = {id(mesh): _ranked(mesh) for mesh in {id(mesh): mesh for mesh in meshes}.values()}
    vertices = np.array([mesh.num_vertices for mesh in meshes])
    vertex_start = np.cumsum(vertices) - vertices
    bodies = np.array([ranked[id(mesh)][1] for mesh in meshes])
    body_start = np.cumsum(bodies) - bodies
    tets = np.concatenate([mesh.tets for mesh in meshes])
    tets += np.repeat(vertex_start, [mesh.num_tets for mesh in meshes])[:, None]
    body = np.concatenate([ranked[id(mesh)][0] for mesh in meshes]) + np.repeat(body_start, vertices)
    return TetMesh(np.concatenate([mesh.points for mesh in meshes]), tets, body)


def replicate(mesh: TetMesh, offsets: Any) -> TetMesh:
    """N translated copies of one mesh as N times as many bodies; a million cubes take seconds.

    Args:
        mesh: The mesh to copy.
        offsets: Translation of each copy [m], shape [N, 3].

    Raises:
        TypeError, ValueError: no TetMesh; offsets of wrong shape or dtype, NaN or Inf.
    """
    check_mesh(mesh)
    moves = float_array("offsets", offsets, (None, 3))
    copies = np.arange(len(moves))[:, None]
    rank, bodies = _ranked(mesh)
    return TetMesh(
        (mesh.points + moves[:, None]).reshape(-1, 3),
        (mesh.tets + (copies * mesh.num_vertices)[..., None]).reshape(-1, 4),
        (rank + copies * bodies).ravel(),
    )
