"""Cells of files that are neither tets nor triangles: volumes are cut into tets, faces into triangles."""

from __future__ import annotations

from typing import Any, NamedTuple

import meshio
import numpy as np

from diffvbd.mesh.arrays import IntArray

# Faces of a cell's corners, wound so that their normals point out of it, in the order of meshio.
_FACES = {
    "hexahedron": ((0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)),
    "wedge": ((0, 2, 1), (3, 4, 5), (0, 1, 4, 3), (1, 2, 5, 4), (2, 0, 3, 5)),
    "pyramid": ((0, 3, 2, 1), (0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4)),
}
_CORNERS = {"tetra": 4, "hexahedron": 8, "wedge": 6, "pyramid": 5, "triangle": 3, "quad": 4}
_LAGRANGE = {
    f"VTK_LAGRANGE_{name}": kind
    for name, kind in {"TETRAHEDRON": "tetra", "TRIANGLE": "triangle", "QUADRILATERAL": "quad"}.items()
} | {f"VTK_LAGRANGE_{name.upper()}": name for name in _FACES}


class Tets(NamedTuple):
    """Tets [T, 4] of the points of a file; for each block of cells that they come from, its index and the row in it of
    each tet; and how many cells of which kinds were cut into tets and left out."""

    tets: IntArray
    rows: list[tuple[int, IntArray]]
    cut: dict[str, int]
    left_out: dict[str, int]


def kind_of(cells: Any) -> str:
    """'hexahedron' for hexahedron20 and all others of more nodes: the corners come first in each of them."""
    return _LAGRANGE.get(cells.type) or str(cells.type).rstrip("0123456789")


def tets_of(content: meshio.Mesh) -> Tets:
    """Tets of all volume cells, in the order of the file, and how many cells of which kinds were cut or left out."""
    found, rows, cut, left_out = [], [], {}, {}
    for k, cells in enumerate(content.cells):
        kind, number = kind_of(cells), len(cells.data)
        if kind == "tetra":
            tets, parents = cells.data[:, :4].astype(np.int64), np.arange(number)
        elif kind in _FACES:
            tets, parents = _cut(cells.data[:, : _CORNERS[kind]].astype(np.int64), _FACES[kind])
            cut[kind] = cut.get(kind, 0) + number
        else:
            if cells.dim == 3 and number:
                left_out[kind] = left_out.get(kind, 0) + number
            continue
        found.append(tets)
        rows.append((k, parents))
    return Tets(np.concatenate(found) if found else np.empty((0, 4), dtype=np.int64), rows, cut, left_out)


def _cut(cells: IntArray, faces: tuple[tuple[int, ...], ...]) -> tuple[IntArray, IntArray]:
    """Tets [T, 4] from the lowest vertex of each cell to the faces that do not have it, and the cell of each tet.

    A quad is cut from its own lowest vertex, so that both of its cells cut it alike (Dompierre et al., "How to
    subdivide pyramids, prisms, and hexahedra into tetrahedra", 8th International Meshing Roundtable, 1999).
    """
    lowest = cells.min(axis=1)
    tets, parents = [], []
    for face in faces:
        corners = cells[:, face]
        first = corners.argmin(axis=1)
        turned = np.take_along_axis(corners, (first[:, None] + np.arange(len(face))) % len(face), axis=1)
        away = np.flatnonzero(turned[:, 0] != lowest)
        for k in range(1, len(face) - 1):
            tets.append(np.column_stack([lowest[away], turned[away][:, [0, k, k + 1]]]))
            parents.append(away)
    tets, parents = np.concatenate(tets), np.concatenate(parents)
    order = np.argsort(parents, kind="stable")
    tets, parents = tets[order], parents[order]
    # some mesh wedges and pyramids as hexahedra that name a vertex twice
    ranked = np.sort(tets, axis=1)
    whole = (ranked[:, 1:] != ranked[:, :-1]).all(axis=1)
    return tets[whole], parents[whole]


def triangles_of(content: meshio.Mesh) -> IntArray:
    """Triangles [F, 3] of all faces: those of more corners are cut from their first corner."""
    found = [np.empty((0, 3), dtype=np.int64)]
    for cells in content.cells:
        kind = kind_of(cells)
        if kind in ("triangle", "quad", "polygon") and len(cells.data):
            corners = np.asarray(cells.data)[:, : _CORNERS.get(kind)].astype(np.int64)
            fan = [corners[:, [0, k, k + 1]] for k in range(1, corners.shape[1] - 1)]
            found.append(np.stack(fan, axis=1).reshape(-1, 3))
    return np.concatenate(found)


def listed_kinds(kinds: dict[str, int]) -> str:
    """'2 hexahedron, 1 wedge'."""
    return ", ".join(f"{number} {kind}" for kind, number in kinds.items())
