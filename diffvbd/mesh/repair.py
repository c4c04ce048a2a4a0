"""Surfaces as scanners and modellers leave them, made ready for `tetrahedralize` (the optional package trimesh)."""

from __future__ import annotations

from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from diffvbd.mesh.arrays import FloatArray, IntArray
from diffvbd.mesh.shapes import positive
from diffvbd.mesh.tetrahedralize import surface_arrays, warn_of_unit

# Rows: what becomes x, y, z. All are rotations, and each brings the axis of its name to y.
_TO_Y = {
    "y": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "-y": ((1, 0, 0), (0, -1, 0), (0, 0, -1)),
    "z": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    "-z": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
    "x": ((0, -1, 0), (1, 0, 0), (0, 0, 1)),
    "-x": ((0, 1, 0), (-1, 0, 0), (0, 0, 1)),
}


class Repair(NamedTuple):
    """A repaired surface, and what was found on the way; as text a table.

    `points` [P, 3] m and `triangles` [F, 3], wound outwards, are together `surface`. `scale` is metres per unit
    of the file, `welded` vertices lay where another one was, `dropped` triangles had no area or were there twice,
    `turned` triangles were wound the other way, `open_edges` belong to one triangle alone and `crowded_edges` to more
    than two, `pieces` is how many surfaces are not connected, and `volume` [m^3] is what they enclose.
    """

    points: FloatArray
    triangles: IntArray
    scale: float
    welded: int
    dropped: int
    turned: int
    open_edges: int
    crowded_edges: int
    pieces: int
    volume: float

    @property
    def surface(self) -> tuple[FloatArray, IntArray]:
        """Points [P, 3] m and triangles [F, 3], as `tetrahedralize` takes them."""
        return self.points, self.triangles

    def __str__(self) -> str:
        extent = " x ".join(f"{length:.4g}" for length in np.ptp(self.points, axis=0))
        closed = "closed" if not self.open_edges else f"{self.open_edges} open edges: holes, which tets will span"
        crowded = f", {self.crowded_edges} edges of more than two triangles" if self.crowded_edges else ""
        rows = {
            "surface": f"{len(self.points)} vertices, {len(self.triangles)} triangles, pieces: {self.pieces}",
            "extent": f"{extent} m (x, y, z; y is up), {self.scale:.6g} m per unit of the file",
            "repaired": f"{self.welded} vertices welded, {self.dropped} triangles dropped, {self.turned} turned",
            "edges": closed + crowded,
            "encloses": f"{self.volume:.6g} m^3",
        }
        return "\n".join(f"{name:9} {text}" for name, text in rows.items())


def repair(
    surface: str | PathLike[str] | tuple[Any, Any],
    size: float | None = None,
    scale: float | None = None,
    up: str = "y",
) -> Repair:
    """Bring a triangle surface to metres and to y up, and repair it. Needs the extra: `pip install diffvbd[mesh]`.

    Vertices in the same place (within 1e-8 of the diagonal of the bounding box) are welded, triangles without area or
    there twice are dropped, all are wound like their neighbours and outwards. A piece within the bounding box of
    another is turned only together with that one: it may be a cavity, which is wound inwards. Holes stay;
    `tetrahedralize` spans them.

    Args:
        surface: A file (STL, PLY, OBJ, OFF, or what meshio reads), or (points [P, 3], triangles [F, 3]).
        size: Largest extent that the surface shall have [m]. Or
        scale: Metres per unit of the file, 0.001 for mm; default 1, with a UserWarning if the surface is then larger
            than 5 m.
        up: The file's axis that points up: "x", "y", "z", or one of them with a minus. The surface is turned, so that
            it becomes y.

    Returns:
        `Repair`: points [P, 3] m, triangles [F, 3] and what was found.

    Raises:
        ImportError: trimesh is missing.
        FileNotFoundError: no such file.
        TypeError, ValueError: bad arrays, an unreadable file, one without triangles; size and scale together, or not
            positive; another axis; nothing is left.

    Source: Dawson-Haggerty et al., trimesh, https://trimesh.org.
    """
    if not isinstance(up, str) or up not in _TO_Y:
        raise ValueError(f"up: expected one of {', '.join(_TO_Y)}, got {up!r}")
    if size is not None and scale is not None:
        raise ValueError(f"size: expected none beside scale = {scale!r}, got {size!r}")
    points, triangles = surface_arrays(Path(surface) if isinstance(surface, (str, PathLike)) else surface)
    factor = positive("scale", 1.0 if scale is None else scale)
    if size is None and scale is None:
        cure = "for one in mm give scale=0.001 (--scale 0.001), or size= (--size), its largest extent in metres"
        warn_of_unit(points[triangles.ravel()], cure)
    if size is not None:
        factor = positive("size", size) / float(np.ptp(points[triangles.ravel()], axis=0).max())
    try:
        import networkx  # noqa: F401  (trimesh finds out only when it winds triangles)
        import trimesh
    except ImportError:
        raise ImportError("repair needs trimesh and networkx: pip install 'diffvbd[mesh]'") from None
    used, compact = np.unique(triangles, return_inverse=True)
    points, triangles = points[used], compact.reshape(-1, 3)
    low = points.min(0)
    diagonal = float(np.linalg.norm(np.ptp(points, axis=0)))
    # trimesh's tolerances are absolute: it gets a body of diagonal 1
    content = trimesh.Trimesh((points - low) / diagonal, triangles, process=False)
    content.merge_vertices(digits_vertex=8)
    welded = len(points) - len(content.vertices)
    content.update_faces(content.nondegenerate_faces() & content.unique_faces())
    dropped = len(triangles) - len(content.faces)
    if len(content.faces) == 0:
        raise ValueError("surface: expected triangles with an area, got none")
    before = content.faces.copy()
    trimesh.repair.fix_winding(content)
    pieces = _turn_outwards(content, trimesh.graph)
    turned = int((_even(before) != _even(content.faces)).sum())
    content.remove_unreferenced_vertices()
    uses = np.unique(np.sort(content.edges, axis=1), axis=0, return_counts=True)[1]
    turn = factor * np.array(_TO_Y[up], dtype=np.float64)
    return Repair(
        (np.asarray(content.vertices) * diagonal + low) @ turn.T,
        np.asarray(content.faces, dtype=np.int64),
        factor,
        welded,
        dropped,
        turned,
        int((uses == 1).sum()),
        int((uses > 2).sum()),
        pieces,
        float(content.volume) * (diagonal * factor) ** 3,
    )


def _even(triangles: IntArray) -> NDArray[np.bool_]:
    """Whether a triangle counts its vertices in ascending order, up to where it begins, shape [F]."""
    a, b, c = triangles.T
    return (a < b) ^ (a < c) ^ (b < c)


def _turn_outwards(content: Any, graph: Any) -> int:
    """Turn each piece that encloses a negative volume and lies in no other one, with all that lies in it; how many
    pieces there are."""
    faces = np.asarray(content.faces)
    groups = graph.connected_components(content.face_adjacency, nodes=np.arange(len(faces)), min_len=1)
    corners = [np.asarray(content.vertices)[faces[group]] for group in groups]
    low, high = (np.array([edge(c, axis=(0, 1)) for c in corners]) for edge in (np.min, np.max))

    def within(k: int) -> NDArray[np.bool_]:
        """Which pieces lie in piece k; one at a time, because noisy scans have thousands."""
        return np.asarray(np.all((low > low[k]) & (high < high[k]), axis=1))

    inner = np.zeros(len(groups), dtype=bool)
    for k in range(len(groups)):
        inner |= within(k)
    turned = np.zeros(len(groups), dtype=bool)
    for k in np.flatnonzero(~inner).tolist():
        if _volume(corners[k]) < 0:
            turned[k] = True
            turned |= within(k)
    for group in (groups[k] for k in np.flatnonzero(turned)):
        faces[group] = faces[group][:, ::-1]
    content.faces = faces
    return len(groups)


def _volume(corners: FloatArray) -> float:
    """What triangles [F, 3, 3] enclose, seen from their middle: with a hole that is about what it would be without."""
    a, b, c = (corners - corners.mean((0, 1))).transpose(1, 0, 2)
    return float(np.einsum("ni,ni->", a, np.cross(b, c)) / 6)
