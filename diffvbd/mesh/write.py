"""Mesh files written through meshio, and time series that ParaView opens."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from contextlib import redirect_stderr, redirect_stdout
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar
from xml.sax.saxutils import quoteattr

import meshio
import numpy as np

from diffvbd.mesh.arrays import FloatArray, float_array, to_numpy

if TYPE_CHECKING:
    from diffvbd.mesh.tet_mesh import TetMesh

Result = TypeVar("Result")

# meshio would take the extension .msh for a Fluent file first.
PREFERRED_FORMAT = {".msh": "gmsh"}
# meshio would write these without a word, and without the tets.
_NO_TETS = (".obj", ".off", ".ply", ".stl", ".svg", ".wkt")


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
    quiet(lambda: content.write(path, file_format=PREFERRED_FORMAT.get(path.suffix.lower())), f"write {path}")


def _content(mesh: TetMesh, points: FloatArray, point_data: dict[str, Any] | None = None) -> meshio.Mesh:
    if mesh.num_tets == 0:
        raise ValueError("mesh: expected at least one tet to write, got none")
    cells: list[Any] = [("tetra", mesh.tets)]
    cell_data: dict[str, Any] = {"body": [mesh.body[mesh.tets[:, 0]]]} if mesh.num_bodies > 1 else {}
    return meshio.Mesh(points, cells, point_data=point_data, cell_data=cell_data)


def quiet(action: Callable[[], Result], purpose: str) -> Result:
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
        quiet(lambda content=content, target=target: content.write(target), f"write {target}")
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
