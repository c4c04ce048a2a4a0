"""Meshes from files: what a reader found, made one mesh of tets, and what is not in it said."""

from __future__ import annotations

import itertools
from os import PathLike
from pathlib import Path
from typing import Any, Literal, NamedTuple, overload

import meshio
import numpy as np
from numpy.typing import NDArray

from diffvbd.mesh.arrays import FloatArray, IntArray, check_flag, connected, float_array, listed, positive, warn
from diffvbd.mesh.read import SURFACES, Tets, kind_of, listed_kinds, read_cells, tets_of, triangles_of
from diffvbd.mesh.tet_mesh import EDGES, TetMesh, oriented, signed_volume

Source = str | PathLike[str] | Any  # a path, or a mesh of trimesh, pyvista or meshio
# Cell data that may hold body labels: ours, and the integer labels of Gmsh and Medit files.
_BODY_DATA = ("body", "gmsh:physical", "medit:ref")


@overload
def load(
    source: Source, *, orient: bool = True, return_vertices: Literal[False] = False, weld: float | None = None
) -> TetMesh: ...
@overload
def load(
    source: Source, *, orient: bool = True, return_vertices: Literal[True], weld: float | None = None
) -> tuple[TetMesh, IntArray]: ...


def load(
    source: Source, *, orient: bool = True, return_vertices: bool = False, weld: float | None = None
) -> TetMesh | tuple[TetMesh, IntArray]:
    """Tets of a mesh file: Gmsh, VTK, VTU, Medit, Abaqus, TetGen, XDMF and whatever else meshio reads.

    All volume cells are taken, in the order of the file. Hexahedra, wedges and pyramids are cut into tets. Cells of
    higher order keep their corners; the nodes between these are left out. Faces and lines are ignored and vertices
    without tets dropped. A UserWarning says what of a file is not in the mesh, or was cut.

    Cell data `body`, or the labels of Gmsh and Medit files, become `TetMesh.body` where there are at least two and no
    vertex is shared between them. Otherwise each connected piece is a body.

    Args:
        source: The file; its extension tells the format. Or a mesh of pyvista (`UnstructuredGrid`) or meshio.
            Coordinates are taken as metres.
        orient: Exchange two vertices of every tet of negative volume: files often mix orientations.
        return_vertices: Also return the index in the file of each vertex of the mesh, shape [V].
        weld: Vertices that are at most so far apart become one [m]: where two parts were meshed each for itself, they
            do not hold together. By default they stay as they are, with a UserWarning where some lie in one place; 0
            does the same without it.

    Raises:
        TypeError: neither a path nor a mesh of such a library.
        FileNotFoundError: no such file.
        ValueError: unreadable or truncated file, unknown format, one of which not all nodes arrive, no tets in it, or
            tets that TetMesh refuses, also once they are welded; hexahedra that are too distorted to be cut.
        ImportError: the format needs a package that is not installed.
    """
    check_flag("return_vertices", return_vertices)
    found = _read_tets(source, orient, weld)
    return (found.mesh, found.vertices) if return_vertices else found.mesh


class Fields(NamedTuple):
    """A mesh file with its values: the mesh, values of vertices [V] or [V, C] and of tets [T] or [T, C], by name."""

    mesh: TetMesh
    point_data: dict[str, NDArray[Any]]
    cell_data: dict[str, NDArray[Any]]


def load_fields(source: Source, *, orient: bool = True, weld: float | None = None) -> Fields:
    """Tets of a mesh file and the values that it has for vertices and tets, as `save` writes them.

    Rows follow the vertices and tets of the mesh: values of dropped vertices and of other cells are left out. Units are
    those of the file. Cell data `body` is not repeated here where it has become `TetMesh.body`.

    Args:
        source, orient, weld: As in `load`. A tet cut out of a cell has the values of the cell, a welded vertex those of
            the first one in its place.

    Returns:
        `Fields`: the mesh, point_data of shape [V] or [V, C] and cell_data of shape [T] or [T, C], by name.

    Raises:
        TypeError, FileNotFoundError, ImportError: As `load`.
        ValueError: As `load`, and for values of another number of rows, or that are no numbers.
    """
    content, mesh, vertices, rows, labels = _read_tets(source, orient, weld)
    points: dict[str, NDArray[Any]] = {}
    for name, values in content.point_data.items():
        if name == "gmsh:dim_tags":  # bookkeeping of meshio, which .msh files have always
            continue
        points[name] = _rows(source, f"point_data[{name!r}]", values, len(content.points))[vertices]
    of_tets: dict[str, NDArray[Any]] = {}
    for name, values in content.cell_data.items():
        if name != labels or name != "body":
            label = f"cell_data[{name!r}]"
            found = [_rows(source, label, values[k], len(content.cells[k].data))[parents] for k, parents in rows]
            of_tets[name] = np.concatenate(found)
    return Fields(mesh, points, of_tets)


def _rows(source: Source, label: str, values: Any, rows: int) -> NDArray[Any]:
    array = np.asarray(values)
    if array.dtype.kind not in "iuf" or array.ndim == 0 or len(array) != rows:
        got = f"shape {list(array.shape)} of dtype {array.dtype}"
        raise ValueError(f"{name_of(source)}: {label}: expected {rows} rows of numbers, got {got}")
    # torch takes no numbers in the byte order of .vtk files
    return array.astype(array.dtype.newbyteorder("="), copy=False)


class _Found(NamedTuple):
    """A file's content, its mesh, the index in the file of each vertex [V], the block and the rows in it of its tets,
    and the name of the cell data that its labels are from."""

    content: meshio.Mesh
    mesh: TetMesh
    vertices: IntArray
    rows: list[tuple[int, IntArray]]
    labels: str


def name_of(source: Source) -> str:
    """A source as messages name it: the file, or the kind of object."""
    return f"mesh file {source}" if isinstance(source, (str, PathLike)) else f"mesh of type {type(source).__name__}"


def _read_tets(source: Source, orient: bool, weld: float | None) -> _Found:
    check_flag("orient", orient)
    distance = positive("weld", weld) if weld else weld
    name = name_of(source)
    if isinstance(source, (str, PathLike)) and (path := Path(source)).suffix.lower() in SURFACES and path.is_file():
        raise ValueError(f"{name} has no tets: {path.suffix} files hold surfaces; {_FILL}")
    content, notes = read_cells(source)
    found = tets_of(content)
    if len(found.tets) == 0:
        others = ", ".join(sorted({block.type for block in content.cells})) or "no cells at all"
        surface = len(triangles_of(content)) > 0 and not found.left_out
        raise ValueError(f"{name} has no tets (it has {others}){f'; {_FILL}' if surface else ''}")
    if found.cut:
        notes.append(f"{listed_kinds(found.cut)} cells are cut into tets")
    if found.curved:
        notes.append(f"{listed_kinds(found.curved)} cells keep their corners alone, without the nodes between these")
    if found.left_out:
        notes.append(f"{listed_kinds(found.left_out)} cells are left out")
    try:
        mesh, vertices, labels, doubled = _mesh_of(content, found, orient, distance)
    except (TypeError, ValueError) as failure:
        raise ValueError(f"{name}: {failure}") from None
    if doubled and distance is None:
        step = float(f"{1e-6 * np.linalg.norm(np.ptp(mesh.points, axis=0)):.1g}")
        notes.append(
            f"{doubled} vertices lie where another one does, and the mesh does not hold together there: weld={step:g} "
            "joins those that are closer than that [m], weld=0 keeps them"
        )
    for note in notes:
        warn(f"{name}: {note}")
    return _Found(content, mesh, vertices, found.rows, labels)


_FILL = "`diffvbd mesh` or dv.mesh.tetrahedralize fill a surface with tets"


def read_triangles(source: Source) -> tuple[NDArray[Any], IntArray]:
    """Points and triangles of a surface; faces of more corners are cut. Raises as `load` does."""
    content, notes = read_cells(source)
    triangles = triangles_of(content)
    for note in notes:
        warn(f"{name_of(source)}: {note}")
    if len(triangles) == 0:
        tets = len(tets_of(content).tets)
        hint = f"; it has {tets} tets, which dv.mesh.load reads" if tets else ""
        raise ValueError(f"{name_of(source)} has no triangles{hint}")
    return content.points, triangles


def read_points(path: Path) -> NDArray[Any]:
    """Points [P, 3] of a mesh file, as they stand in it. Raises as `load` does."""
    content, _ = read_cells(path)
    try:
        return float_array("points", content.points, (None, 3))
    except (TypeError, ValueError) as failure:
        raise ValueError(f"mesh file {path}: {failure}") from None


def _mesh_of(content: meshio.Mesh, found: Tets, orient: bool, weld: float | None) -> tuple[TetMesh, IntArray, str, int]:
    """The mesh, the index in the file of each of its vertices, the name of the cell data that its labels are from, and
    how many vertices lie where another one does."""
    tets = found.tets
    if tets.min() < 0 or tets.max() >= len(content.points):
        raise ValueError(f"expected vertex indices from 0 to {len(content.points) - 1}, got {tets.min()}..{tets.max()}")
    vertices, tets = _used(tets)
    points = float_array("points", content.points[vertices], (None, 3))
    _check_cut(points, tets, content, found)
    if weld and weld >= (shortest := _shortest_edge(points, tets)):
        raise ValueError(f"weld: expected less than the shortest edge, {shortest:.3g} m, got {weld:g}")
    first = together(points, weld or 1e-8 * float(np.linalg.norm(np.ptp(points, axis=0))))
    doubled = np.flatnonzero(first != np.arange(len(first)))
    if weld:
        kept, tets = _used(first[tets])
        points, vertices = points[kept], vertices[kept]
    name, body = _body_labels(content, found.rows, tets)
    if name in ("body", "medit:ref") and not weld:  # bodies that touch, as `save` writes them
        doubled = doubled[body[doubled] == body[first[doubled]]]
    return TetMesh(points, oriented(points, tets) if orient else tets, body), vertices, name, len(doubled)


def _shortest_edge(points: FloatArray, tets: IntArray) -> float:
    return float(min(np.linalg.norm(points[tets[:, i]] - points[tets[:, j]], axis=1).min() for i, j in EDGES))


def _used(tets: IntArray) -> tuple[IntArray, IntArray]:
    """The vertices that tets [T, 4] have, ascending, and the tets in terms of these."""
    used = np.zeros(tets.max() + 1, dtype=bool)
    used[tets] = True
    return np.flatnonzero(used), (np.cumsum(used) - 1)[tets]


def _check_cut(points: FloatArray, tets: IntArray, content: meshio.Mesh, found: Tets) -> None:
    """Raises where a cell is cut into tets that do not lie side by side: some would be turned and overlap."""
    start = 0
    for k, parents in found.rows:
        part, start = tets[start : start + len(parents)], start + len(parents)
        kind = kind_of(content.cells[k])
        if kind in found.cut:
            volume, _ = signed_volume(points, part)
            cell_volume = np.bincount(parents, volume)
            bad = np.unique(parents[volume * cell_volume[parents] < 0])
            if len(bad):
                raise ValueError(f"cells: expected {kind} cells that can be cut, got distorted {listed(bad, 'cell')}")


def _body_labels(content: meshio.Mesh, rows: list[tuple[int, IntArray]], tets: IntArray) -> tuple[str, IntArray]:
    """The name of the first cell data that tells whole bodies apart, and its labels per vertex; or those of pieces."""
    for name in _BODY_DATA:
        labels = _labels(content, name, rows)
        if labels is None or len(labels) != len(tets) or labels.min() == labels.max():
            continue
        body = np.zeros(tets.max() + 1, dtype=np.int64)
        body[tets] = labels[:, None]
        if np.array_equal(body[tets], np.broadcast_to(labels[:, None], tets.shape)):
            return name, body
    return "", np.unique(connected(tets, int(tets.max()) + 1), return_inverse=True)[1]


def _labels(content: meshio.Mesh, name: str, rows: list[tuple[int, IntArray]]) -> IntArray | None:
    """Integer cell data by that name of each tet, or None."""
    if name not in content.cell_data:
        return None
    given = [np.asarray(content.cell_data[name][k]) for k, _ in rows]
    if any(len(values) != values.size or values.dtype.kind not in "iuf" for values in given):
        return None
    labels = np.concatenate([values.ravel()[parents] for values, (_, parents) in zip(given, rows, strict=True)])
    with np.errstate(invalid="ignore"):
        whole = labels.astype(np.int64)
    return whole if np.array_equal(whole, labels) else None


def together(points: FloatArray, distance: float) -> IntArray:
    """The lowest of the points [V, 3] that each is joined with, by steps of at most `distance` [m], shape [V]."""
    # along a direction that no plane of a mesh is likely to be normal to, few points are as close as that
    along = points @ np.array([0.5257311, 0.3090170, 0.7925580])
    order = np.argsort(along, kind="stable")
    pairs = [np.empty((0, 2), dtype=np.int64)]
    for step in itertools.count(1):
        near = np.flatnonzero(along[order[step:]] - along[order[:-step]] <= distance)
        if len(near) == 0:
            return connected(np.concatenate(pairs), len(points))
        found = np.stack([order[near], order[near + step]], axis=1)
        gap = points[found[:, 0]] - points[found[:, 1]]
        pairs.append(found[np.einsum("ni,ni->n", gap, gap) <= distance**2])
    raise AssertionError("unreachable")
