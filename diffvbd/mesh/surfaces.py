"""Triangle surfaces as scanners and modellers leave them: repaired (trimesh), and filled with tets (fTetWild)."""

from __future__ import annotations

import logging
import os
import tempfile
from os import PathLike
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from diffvbd.mesh.arrays import (
    FloatArray,
    IntArray,
    check_mesh,
    connected,
    count,
    float_array,
    int_array,
    positive,
    warn,
)
from diffvbd.mesh.io import Source, read_triangles
from diffvbd.mesh.tet_mesh import TetMesh

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
    than two, `pieces` is how many surfaces are not connected, and `volume` [m^3] is what they enclose. Interfaces
    between parts of a body do not change it.
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
    surface: Source | tuple[Any, Any], size: float | None = None, scale: float | None = None, up: str = "y"
) -> Repair:
    """A triangle surface, brought to metres and to y up, and repaired. Needs the extra: `pip install diffvbd[mesh]`.

    Vertices in the same place (within 1e-8 of the diagonal of the bounding box) are welded, triangles without area or
    there twice are dropped, all are wound like their neighbours and outwards. A piece within the bounding box of
    another is turned only together with that one: it may be a cavity, which is wound inwards. Holes stay;
    `tetrahedralize` spans them.

    Args:
        surface: A file (STL, PLY, OBJ, OFF, or what meshio reads), a mesh of trimesh, pyvista or meshio, or
            (points [P, 3], triangles [F, 3]).
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
        raise ValueError(f"size: expected none with scale = {scale!r}, got {size!r}")
    points, triangles = surface_arrays(surface)
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
    pieces, bounding = _turn_outwards(content, trimesh.graph)
    turned = int((_even(before) != _even(content.faces)).sum())
    content.remove_unreferenced_vertices()
    uses = np.unique(np.sort(content.edges, axis=1), axis=0, return_counts=True)[1]
    turn = factor * np.array(_TO_Y[up], dtype=np.float64)
    volume = _volume(np.asarray(content.vertices)[content.faces[bounding]]) * (diagonal * factor) ** 3
    points = (np.asarray(content.vertices) * diagonal + low) @ turn.T
    return Repair(points, np.asarray(content.faces, dtype=np.int64), factor, welded, dropped, turned,
                  int((uses == 1).sum()), int((uses > 2).sum()), pieces, volume)  # fmt: skip


def _even(triangles: IntArray) -> NDArray[np.bool_]:
    """Mask [F] of triangles that count their vertices in ascending order, up to where they begin."""
    a, b, c = triangles.T
    return (a < b) ^ (a < c) ^ (b < c)


def _turn_outwards(content: Any, graph: Any) -> tuple[int, NDArray[np.bool_]]:
    """Turn each piece that encloses a negative volume and lies in no other one, with all that lies in it.

    Returns how many pieces there are, and which triangles [F] are part of the boundary. The others are interfaces
    between parts of a body: open pieces within the rest, and closed ones that are wound outwards, as no cavity is.
    """
    faces = np.array(content.faces)
    groups = graph.connected_components(content.face_adjacency, nodes=np.arange(len(faces)), min_len=1)
    corners = [np.asarray(content.vertices)[faces[group]] for group in groups]
    low, high = (np.array([edge(c, axis=(0, 1)) for c in corners]) for edge in (np.min, np.max))

    def within(k: int) -> NDArray[np.bool_]:
        """Mask of the pieces in piece k; one at a time, because noisy scans have thousands."""
        return np.asarray(np.all((low > low[k]) & (high < high[k]), axis=1))

    inner = np.zeros(len(groups), dtype=bool)
    for k in range(len(groups)):
        inner |= within(k)
    turned = np.zeros(len(groups), dtype=bool)
    for k in np.flatnonzero(~inner).tolist():
        if _volume(corners[k], middle=True) < 0:
            turned[k] = True
            turned |= within(k)
    for group in (groups[k] for k in np.flatnonzero(turned)):
        faces[group] = faces[group][:, ::-1]
    points = np.asarray(content.vertices)
    front, back = _meets_outside(points, faces)
    faces[back & ~front] = faces[back & ~front][:, ::-1]
    bounding = front ^ back
    for k in np.flatnonzero(inner).tolist():
        rest = bounding.copy()
        rest[groups[k]] = False
        if bounding[groups[k]].any() and _volume(points[faces[groups[k]]]) > 0:
            bounding[groups[k]] = _winding(points[faces[rest]], corners[k][0, 0]) < 0.5
    content.faces = faces
    return len(groups), bounding


def _meets_outside(points: FloatArray, faces: IntArray) -> NDArray[np.bool_]:
    """Masks [2, F] of the triangles [F, 3] whose front, and whose back, meets the outside.

    Sides that face each other around an edge bound one chamber, and the chamber of negative volume is the outside.
    Interfaces between two chambers meet it with neither side. Only surfaces without open edges on which more than two
    triangles meet at some edge are looked at; of the others every front meets it.
    """
    ends, tips = faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), faces[:, [2, 0, 1]].reshape(-1)
    forward, (low, high) = ends[:, 0] < ends[:, 1], np.sort(ends, axis=1).T
    axis = points[high] - points[low]
    first = np.cross(axis, np.eye(3)[np.abs(axis).argmin(axis=1)])
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(axis / np.linalg.norm(axis, axis=1, keepdims=True), first)
    arm = points[tips] - points[low]
    angle = np.arctan2(np.einsum("ni,ni->n", arm, second), np.einsum("ni,ni->n", arm, first))
    _, edge, uses = np.unique(low * len(points) + high, return_inverse=True, return_counts=True)
    order = np.lexsort((angle, edge))
    ends_at = np.cumsum(uses)
    following = np.arange(1, len(order) + 1)
    following[ends_at - 1] = ends_at - uses  # the last triangle around an edge comes before the first one
    side = 2 * (np.arange(3 * len(faces)) // 3)[order]  # of the front; the back has the next number
    turned = ~forward[order]
    facing = np.stack([side + turned, (side + ~turned)[following]], axis=1)
    chamber, surface = connected(facing, 2 * len(faces)), connected(facing // 2, len(faces))
    a, b, c = points[faces].transpose(1, 0, 2)
    volume = np.einsum("ni,ni->n", a, np.cross(b, c)) / 6
    enclosed = np.bincount(chamber, np.stack([-volume, volume], axis=1).ravel(), 2 * len(faces))[chamber].reshape(-1, 2)
    least, crowded = np.full(len(faces), np.inf), np.zeros(len(faces), dtype=bool)
    np.minimum.at(least, surface, enclosed.min(axis=1))
    crowded[surface[side[uses[edge][order] > 2] // 2]] = True
    crowded[surface[side[uses[edge][order] == 1] // 2]] = False
    outside = enclosed == least[surface][:, None]
    outside[~crowded[surface]] = (True, False)
    return outside.T


def _winding(corners: FloatArray, point: FloatArray) -> float:
    """Winding number of triangles [F, 3, 3] around a point [3]: 1 inside of a closed surface, 0 outside.

    Source: Van Oosterom and Strackee, "The solid angle of a plane triangle", IEEE Trans. Biomed. Eng. 30, 1983.
    """
    a, b, c = (corners - point).transpose(1, 0, 2)
    la, lb, lc = (np.linalg.norm(side, axis=1) for side in (a, b, c))
    below = la * lb * lc + (a * b).sum(1) * lc + (b * c).sum(1) * la + (c * a).sum(1) * lb
    return float(np.arctan2(np.einsum("ni,ni->n", a, np.cross(b, c)), below).sum() / (2 * np.pi))


def _volume(corners: FloatArray, middle: bool = False) -> float:
    """Volume that triangles [F, 3, 3] enclose. Seen from their middle, one with a hole is about what it would be
    without."""
    a, b, c = (corners - (corners.mean((0, 1)) if middle else 0.0)).transpose(1, 0, 2)
    return float(np.einsum("ni,ni->", a, np.cross(b, c)) / 6)


def cavities(mesh: TetMesh) -> list[IntArray]:
    """Closed inner surfaces of a mesh, as of a balloon: triangles [F, 3] of each, whose normals point into the walls.

    Raises:
        TypeError: No TetMesh.
    """
    check_mesh(mesh)
    triangles = mesh.surface
    if not len(triangles):
        return []
    ends = np.sort(np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]), axis=1)
    edges, of_edge = np.unique(ends, axis=0, return_inverse=True)
    edge = of_edge.reshape(3, -1).T  # those of each triangle
    label = connected(edge, len(edges))[edge[:, 0]]
    parts = [triangles[label == k] for k in np.unique(label)]
    # outward of the material is into a cavity: its volume is negative
    return [part[:, ::-1].copy() for part in parts if _volume(mesh.points[part], middle=True) < 0]


LOG = logging.getLogger("diffvbd")  # as said.LOGGER, without torch
UNLIKELY = 5.0  # [m]; of a surface whose unit nobody gave, millimetres or inches are likelier from here on


def tetrahedralize(
    surface: Source | tuple[Any, Any],
    edge_length: float | None = None,
    epsilon: float | None = None,
    max_triangles: int | None = 3000,
) -> TetMesh:
    """Tets that fill a triangle surface. Needs the extra: `pip install diffvbd[mesh]`.

    fTetWild accepts surfaces with holes and self-intersections; what it returns stays within `epsilon` of the input.
    Its time grows with the input triangles more than with the output: a scan of 100,000 triangles does not end in
    minutes, 3,000 take about ten seconds, 12,000 three quarters of a minute. Surfaces above `max_triangles` are
    therefore decimated first.

    Every call makes another mesh, with other vertices and about as many: save the one that results belong to.

    Args:
        surface: A file (STL, PLY, OBJ, OFF, or what meshio reads), a mesh of trimesh, pyvista or meshio, or (points
            [P, 3] in metres, triangles [F, 3]), such as the `surface` of what `repair` returns.
            A file is taken to be in metres, with a UserWarning if it is larger than 5.
        edge_length: Wanted edge length [m], at most the diagonal of the bounding box; default 1/20 of it.
        epsilon: Largest distance from the input surface [m]; default 1/20 of `edge_length`.
        max_triangles: Decimate larger surfaces to this many triangles; None never does.

    Raises:
        ImportError: pytetwild or pyvista is missing.
        FileNotFoundError: no such file.
        TypeError, ValueError: bad arrays, an unreadable file, one without triangles, lengths that are not positive,
            edges longer than the body; no tets came out.

    Source: Hu et al., "Fast tetrahedral meshing in the wild", ACM TOG 39(4), 2020.
    """
    points, triangles = surface_arrays(surface)
    if isinstance(surface, (str, PathLike)):
        warn_of_unit(points[triangles.ravel()], "dv.mesh.repair(surface, scale=0.001) reads one in mm")
    diagonal = float(np.linalg.norm(np.ptp(points[triangles].reshape(-1, 3), axis=0)))
    edge = diagonal / 20 if edge_length is None else positive("edge_length", edge_length)
    if edge > diagonal:
        raise ValueError(f"edge_length: expected at most the diagonal of the body, {diagonal:.4g} m, got {edge:g}")
    tolerance = edge / 20 if epsilon is None else positive("epsilon", epsilon)
    limit = None if max_triangles is None else count("max_triangles", max_triangles, 4)
    try:
        import pytetwild
    except ImportError:
        # pytetwild 0.4 cannot be imported without pyvista
        raise ImportError("tetrahedralize needs pytetwild and pyvista: pip install diffvbd[mesh]") from None
    if limit is not None and len(triangles) > limit:
        points, triangles = _decimated(points, triangles, limit)
    LOG.info("filling %d triangles with tets, wanted edge length %.4g m", len(triangles), edge)
    # fTetWild leaves a file in the working directory, so it gets one of its own.
    home = os.getcwd()
    with tempfile.TemporaryDirectory() as scratch:
        try:
            os.chdir(scratch)
            # pytetwild has a marker of types, and neither __all__ nor `as` on what it exports
            vertices, tets = pytetwild.tetrahedralize(  # pyright: ignore[reportPrivateImportUsage]
                points, triangles.astype(np.int32), edge_length_fac=edge / diagonal, epsilon=tolerance / diagonal
            )
        finally:
            os.chdir(home)
    if len(tets) == 0:
        raise ValueError("surface: fTetWild found no inside; is the surface closed?")
    LOG.info("fTetWild made %d tets", len(tets))
    used, compact = np.unique(tets, return_inverse=True)
    return TetMesh(vertices[used], compact.reshape(-1, 4), orient=True)


def warn_of_unit(points: FloatArray, cure: str) -> None:
    """Warn the caller of a function of this package of points [P, 3] that are hardly in metres."""
    extent = float(np.ptp(points, axis=0).max())
    if extent > UNLIKELY:
        warn(f"surface: its largest extent is {extent:.4g} m, if its unit is the metre, which is assumed; {cure}")


def surface_arrays(surface: Source | tuple[Any, Any]) -> tuple[FloatArray, IntArray]:
    """Points [P, 3] and triangles [F, 3] of a file, an object or a pair of arrays; raises as `tetrahedralize` does."""
    if isinstance(surface, (tuple, list)) and len(surface) == 2:
        points, triangles = surface
    else:
        try:
            points, triangles = read_triangles(surface)
        except TypeError:
            hint = ": give its .surface" if hasattr(surface, "surface") else ""
            wanted = "a path, (points, triangles), or a mesh of trimesh, pyvista or meshio"
            raise TypeError(f"surface: expected {wanted}, got {type(surface).__name__}{hint}") from None
    points = float_array("points", points, (None, 3))
    triangles = int_array("triangles", triangles, (None, 3))
    if len(triangles) == 0:
        raise ValueError("surface: expected triangles, got none")
    if triangles.min() < 0 or triangles.max() >= len(points):
        got = f"{triangles.min()}..{triangles.max()}"
        raise ValueError(f"triangles: expected vertex indices from 0 to {len(points) - 1}, got {got}")
    if np.ptp(points[triangles].reshape(-1, 3), axis=0).max() == 0:
        raise ValueError("surface: expected an extended body, got a single point")
    return points, triangles


def _decimated(points: FloatArray, triangles: IntArray, limit: int) -> tuple[FloatArray, IntArray]:
    try:
        import pyvista
    except ImportError:
        purpose = f"decimating {len(triangles)} triangles to max_triangles = {limit}"
        raise ImportError(f"{purpose} needs pyvista: pip install diffvbd[mesh]") from None
    # Welding first: STL-like input without shared vertices cannot be decimated.
    surface = pyvista.PolyData.from_regular_faces(points, triangles).clean()
    reduced = surface.decimate(1 - limit / surface.n_cells)
    return np.asarray(reduced.points, dtype=np.float64), reduced.regular_faces.astype(np.int64)
