"""Mesh files read through meshio."""

from __future__ import annotations

from os import PathLike
from pathlib import Path
from typing import Any, Literal, NamedTuple, overload

import meshio
import numpy as np
from numpy.typing import NDArray

from diffvbd.mesh.arrays import IntArray, check_flag, float_array, to_path
from diffvbd.mesh.tet_mesh import TetMesh, oriented
from diffvbd.mesh.write import PREFERRED_FORMAT, quiet

# Cell data that may hold body labels: ours, and the integer labels of Gmsh and Medit files.
_BODY_DATA = ("body", "gmsh:physical", "medit:ref")


@overload
def load(path: str | PathLike[str], *, orient: bool = True, return_vertices: Literal[False] = False) -> TetMesh: ...
@overload
def load(
    path: str | PathLike[str], *, orient: bool = True, return_vertices: Literal[True]
) -> tuple[TetMesh, IntArray]: ...


def load(
    path: str | PathLike[str], *, orient: bool = True, return_vertices: bool = False
) -> TetMesh | tuple[TetMesh, IntArray]:
    """Read the tets of a mesh file: Gmsh, VTK, VTU, Medit, Abaqus, XDMF and whatever else meshio reads.

    All blocks of tets are taken, in the order of the file; of second-order tets the four corners. Other cells are
    ignored and vertices without tets dropped. Cell data `body`, or the labels of Gmsh and Medit files, become
    `TetMesh.body` where no vertex is shared between two labels; otherwise all labels are 0.

    Args:
        path: The file; its extension tells the format. Coordinates are taken as metres.
        orient: Exchange two vertices of every tet of negative volume: files often mix orientations.
        return_vertices: Also return the index in the file of each vertex of the mesh, shape [V].

    Raises:
        TypeError: no path.
        FileNotFoundError: no such file.
        ValueError: unreadable or truncated file, unknown format, no tets in it, or tets that TetMesh refuses.
        ImportError: the format needs a package that is not installed.
    """
    check_flag("return_vertices", return_vertices)
    _, mesh, vertices, _ = _tets_of(to_path("path", path), orient)
    return (mesh, vertices) if return_vertices else mesh


class Fields(NamedTuple):
    """A mesh file with its values: the mesh, values of vertices [V] or [V, C] and of tets [T] or [T, C], by name."""

    mesh: TetMesh
    point_data: dict[str, NDArray[Any]]
    cell_data: dict[str, NDArray[Any]]


def load_fields(path: str | PathLike[str], *, orient: bool = True) -> Fields:
    """Read the tets of a mesh file and the values that it has for vertices and tets, as `save` writes them.

    Rows follow the vertices and tets of the mesh: values of dropped vertices and of other cells are left out. Units are
    those of the file. Cell data `body` is not repeated here where it has become `TetMesh.body`.

    Args:
        path, orient: As in `load`.

    Returns:
        `Fields`: the mesh, point_data of shape [V] or [V, C] and cell_data of shape [T] or [T, C], by name.

    Raises:
        TypeError, FileNotFoundError, ImportError: As `load`.
        ValueError: As `load`, and for values of another number of rows, or that are no numbers.
    """
    path = to_path("path", path)
    content, mesh, vertices, blocks = _tets_of(path, orient)
    points: dict[str, NDArray[Any]] = {}
    for name, values in content.point_data.items():
        if name == "gmsh:dim_tags":  # bookkeeping of meshio, which .msh files have always
            continue
        points[name] = _rows(path, f"point_data[{name!r}]", values, len(content.points))[vertices]
    cells: dict[str, NDArray[Any]] = {}
    for name, values in content.cell_data.items():
        if name != "body" or mesh.num_bodies == 1:
            label = f"cell_data[{name!r}]"
            cells[name] = np.concatenate([_rows(path, label, values[k], len(content.cells[k].data)) for k in blocks])
    return Fields(mesh, points, cells)


def _rows(path: Path, label: str, values: Any, rows: int) -> NDArray[Any]:
    array = np.asarray(values)
    if array.dtype.kind not in "iuf" or array.ndim == 0 or len(array) != rows:
        got = f"shape {list(array.shape)} of dtype {array.dtype}"
        raise ValueError(f"mesh file {path}: {label}: expected {rows} rows of numbers, got {got}")
    # torch takes no numbers in the byte order of .vtk files
    return array.astype(array.dtype.newbyteorder("="), copy=False)


def _tets_of(path: Path, orient: bool) -> tuple[meshio.Mesh, TetMesh, IntArray, list[int]]:
    """A file's content, its mesh, the index in the file of each vertex [V], and the blocks of tets."""
    check_flag("orient", orient)
    content = _read(path)
    blocks = [k for k, cells in enumerate(content.cells) if cells.type in ("tetra", "tetra10")]
    found = [content.cells[k].data[:, :4] for k in blocks]
    if sum(map(len, found)) == 0:
        others = ", ".join(sorted({cells.type for cells in content.cells})) or "no cells at all"
        fill = ": a surface is filled by `diffvbd mesh` or dv.mesh.tetrahedralize" if "triangle" in others else ""
        raise ValueError(f"mesh file {path} has no tets (it has {others}){fill}")
    try:
        mesh, vertices = _mesh_of_used_vertices(content, np.concatenate(found), blocks, orient)
    except (TypeError, ValueError) as failure:
        raise ValueError(f"mesh file {path}: {failure}") from None
    return content, mesh, vertices, blocks


def _read(path: Path) -> meshio.Mesh:
    if not path.is_file():
        raise FileNotFoundError(
            f"mesh file {path} is not a file" if path.exists() else f"mesh file {path} does not exist"
        )
    return quiet(lambda: meshio.read(path, file_format=PREFERRED_FORMAT.get(path.suffix.lower())), f"read {path}")


def read_triangles(path: Path) -> tuple[NDArray[Any], IntArray]:
    """Points and triangles of a surface file; quads are cut in two. Raises as `load` does."""
    content = _read(path)
    found = [cells.data for cells in content.cells if cells.type == "triangle"]
    found += [cells.data[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3) for cells in content.cells if cells.type == "quad"]
    if sum(map(len, found)) == 0:
        raise ValueError(f"surface file {path} has no triangles")
    return content.points, np.concatenate(found).astype(np.int64)


def read_points(path: Path) -> NDArray[Any]:
    """Points [P, 3] of a mesh file, as they stand in it. Raises as `load` does."""
    try:
        return float_array("points", _read(path).points, (None, 3))
    except (TypeError, ValueError) as failure:
        raise ValueError(f"mesh file {path}: {failure}") from None


def _mesh_of_used_vertices(
    content: meshio.Mesh, cells: NDArray[Any], blocks: list[int], orient: bool
) -> tuple[TetMesh, IntArray]:
    cells = cells.astype(np.int64)
    if cells.min() < 0 or cells.max() >= len(content.points):
        raise ValueError(
            f"expected vertex indices from 0 to {len(content.points) - 1}, got {cells.min()}..{cells.max()}"
        )
    used = np.zeros(len(content.points), dtype=bool)
    used[cells] = True
    vertices = np.nonzero(used)[0]
    points = float_array("points", content.points[vertices], (None, 3))
    tets = (np.cumsum(used) - 1)[cells]
    return TetMesh(points, oriented(points, tets) if orient else tets, _body_labels(content, blocks, tets)), vertices


def _body_labels(content: meshio.Mesh, blocks: list[int], tets: IntArray) -> IntArray | None:
    """Labels per vertex from the first cell data that keeps to whole bodies."""
    for name in _BODY_DATA:
        if name not in content.cell_data:
            continue
        labels = np.concatenate([np.asarray(content.cell_data[name][k]).ravel() for k in blocks])
        if len(labels) != len(tets) or not np.array_equal(labels, labels.astype(np.int64)):
            continue
        body = np.zeros(tets.max() + 1, dtype=np.int64)
        body[tets] = labels.astype(np.int64)[:, None]
        if np.array_equal(body[tets], np.broadcast_to(labels[:, None], tets.shape)):
            return body
    return None
