"""Mesh files through meshio, and time series that ParaView opens."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from contextlib import redirect_stderr, redirect_stdout
from os import PathLike
from pathlib import Path
from typing import Any, Literal, TypeVar, overload
from xml.sax.saxutils import quoteattr

import meshio
import numpy as np
from numpy.typing import NDArray

from diffvbd.mesh.tet_mesh import FloatArray, IntArray, TetMesh, float_array, oriented, to_numpy

Result = TypeVar("Result")

# Cell data that may hold body labels: ours, and the integer labels of Gmsh and Medit files.
_BODY_DATA = ("body", "gmsh:physical", "medit:ref")
# meshio would take the extension .msh for a Fluent file first.
_PREFERRED_FORMAT = {".msh": "gmsh"}
# meshio would write these without a word, and without the tets.
_NO_TETS = (".obj", ".off", ".ply", ".stl", ".svg", ".wkt")


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
        FileNotFoundError: no such file.
        ValueError: unreadable or truncated file, unknown format, no tets in it, or tets that TetMesh refuses.
        ImportError: the format needs a package that is not installed.
    """
    path = Path(path)
    content = _read(path)
    blocks = [k for k, cells in enumerate(content.cells) if cells.type in ("tetra", "tetra10")]
    found = [content.cells[k].data[:, :4] for k in blocks]
    if sum(map(len, found)) == 0:
        others = ", ".join(sorted({cells.type for cells in content.cells})) or "no cells at all"
        raise ValueError(f"mesh file {path} has no tets (it has {others})")
    try:
        mesh, vertices = _mesh_of_used_vertices(content, np.concatenate(found), blocks, orient)
    except (TypeError, ValueError) as failure:
        raise ValueError(f"mesh file {path}: {failure}") from None
    return (mesh, vertices) if return_vertices else mesh


def _read(path: Path) -> meshio.Mesh:
    if not path.is_file():
        raise FileNotFoundError(
            f"mesh file {path} is not a file" if path.exists() else f"mesh file {path} does not exist"
        )
    return _quiet(lambda: meshio.read(path, file_format=_PREFERRED_FORMAT.get(path.suffix.lower())), f"read {path}")


def read_triangles(path: Path) -> tuple[NDArray[Any], IntArray]:
    """Points and triangles of a surface file; quads are cut in two. Raises as `load` does."""
    content = _read(path)
    found = [cells.data for cells in content.cells if cells.type == "triangle"]
    found += [cells.data[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3) for cells in content.cells if cells.type == "quad"]
    if sum(map(len, found)) == 0:
        raise ValueError(f"surface file {path} has no triangles")
    return content.points, np.concatenate(found).astype(np.int64)


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


def save(path: str | PathLike[str], mesh: TetMesh) -> None:
    """Write a mesh through meshio; the extension tells the format (.vtu, .vtk, .msh, .mesh, .inp, .xdmf, ...).

    With more than one body the label of each tet is written as cell data `body`, in formats that hold cell data.

    Raises:
        ValueError: a mesh without tets, an unknown extension, a format that holds no tets, or meshio fails.
        ImportError: the format needs a package that is not installed (h5py for .xdmf and .med).
        FileNotFoundError: the directory does not exist.
    """
    path = Path(path)
    if path.suffix.lower() in _NO_TETS:
        raise ValueError(f"cannot write {path}: {path.suffix} files hold no tets; use .vtu, .msh, ...")
    if not path.parent.is_dir():
        raise FileNotFoundError(f"directory {path.parent} does not exist")
    content = _content(mesh, mesh.points)
    _quiet(lambda: content.write(path, file_format=_PREFERRED_FORMAT.get(path.suffix.lower())), f"write {path}")


def _content(mesh: TetMesh, points: FloatArray, point_data: dict[str, Any] | None = None) -> meshio.Mesh:
    if mesh.num_tets == 0:
        raise ValueError("mesh: expected at least one tet to write, got none")
    cells: list[Any] = [("tetra", mesh.tets)]
    cell_data: dict[str, Any] = {"body": [mesh.body[mesh.tets[:, 0]]]} if mesh.num_bodies > 1 else {}
    return meshio.Mesh(points, cells, point_data=point_data, cell_data=cell_data)


def _quiet(action: Callable[[], Result], purpose: str) -> Result:
    """Run meshio with its printing kept back, and every way it fails turned into one line.

    meshio ends the process on files it cannot read, and a damaged file raises whatever the parser stumbles over.
    """
    said = io.StringIO()
    try:
        with redirect_stdout(said), redirect_stderr(said), np.errstate(all="ignore"):
            return action()
    except ImportError as failure:
        raise ImportError(f"cannot {purpose}: {failure}") from None
    except (meshio.ReadError, meshio.WriteError) as failure:
        reason = str(failure)
    except SystemExit:
        # What the reader said comes before meshio's own line.
        reason = said.getvalue().rpartition("Error:")[0]
    except Exception as failure:
        # The system's own errors (no permission, disk full) are clear already; they carry an error number.
        if isinstance(failure, OSError) and failure.errno:
            raise
        reason = f"damaged or truncated ({type(failure).__name__}: {failure})"
    raise ValueError(f"cannot {purpose}: {' '.join(reason.split())[:300] or 'damaged or truncated'}")


def write_series(
    path: str | PathLike[str],
    mesh: TetMesh,
    frames: Any,
    times: Any = None,
    point_data: Mapping[str, Any] | None = None,
) -> None:
    """Write a time series for ParaView: `path` (.pvd) and one .vtu per frame next to it.

    Args:
        path: The .pvd file; frame k goes to `<stem>_<k>.vtu` in the same directory.
        mesh: The mesh whose tets connect the frames.
        frames: Positions [m], shape [N, V, 3]; array or tensor.
        times: Time of each frame [s], shape [N], never decreasing; default 0, 1, 2, ...
        point_data: Further values per vertex by name, shape [N, V] or [N, V, C].

    Raises:
        TypeError, ValueError: wrong shape or dtype, NaN or Inf, decreasing times, a path that does not end in .pvd.
        FileNotFoundError: the directory does not exist.
    """
    path = Path(path)
    if path.suffix.lower() != ".pvd":
        raise ValueError(f"path: expected a name that ends in .pvd, got {path.name!r}")
    if not path.parent.is_dir():
        raise FileNotFoundError(f"directory {path.parent} does not exist")
    positions = float_array("frames", frames, (None, mesh.num_vertices, 3))
    moments = np.arange(len(positions)) if times is None else float_array("times", times, (len(positions),))
    if (np.diff(moments) < 0).any():
        raise ValueError("times: expected times that never decrease")
    data = {name: _per_vertex(name, values, positions) for name, values in (point_data or {}).items()}
    digits = max(4, len(str(len(positions) - 1)))
    entries = []
    for k, (time, points) in enumerate(zip(moments, positions, strict=True)):
        name = f"{path.stem}_{k:0{digits}d}.vtu"
        content = _content(mesh, points, {key: series[k] for key, series in data.items()})
        target = path.with_name(name)
        _quiet(lambda content=content, target=target: content.write(target), f"write {target}")
        entries.append(f'    <DataSet timestep="{time:.17g}" part="0" file={quoteattr(name)}/>\n')
    path.write_text(
        '<?xml version="1.0"?>\n<VTKFile type="Collection" version="0.1">\n  <Collection>\n'
        + "".join(entries)
        + "  </Collection>\n</VTKFile>\n",
        encoding="utf-8",
    )


def _per_vertex(name: str, values: Any, positions: FloatArray) -> FloatArray:
    array = to_numpy(values)
    wanted = positions.shape[:2]
    if array.ndim not in (2, 3) or array.shape[:2] != wanted:
        raise ValueError(
            f"point_data[{name!r}]: expected shape {list(wanted)} or {[*wanted, 'C']}, got {list(array.shape)}"
        )
    return float_array(f"point_data[{name!r}]", array, array.shape)
