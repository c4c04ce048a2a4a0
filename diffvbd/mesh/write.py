"""Mesh files written through meshio, with values per vertex and per tet."""

from __future__ import annotations

import io
import os
import warnings
from collections.abc import Callable, Mapping
from contextlib import redirect_stderr, redirect_stdout
from os import PathLike
from pathlib import Path
from typing import Any, Protocol, TypeVar
from xml.sax.saxutils import escape

import meshio
import numpy as np
from numpy.typing import NDArray

from diffvbd.mesh.arrays import FloatArray, IntArray, check_mesh, float_array, listed, to_numpy, to_path

Result = TypeVar("Result")


class Mesh(Protocol):
    """Attributes of a TetMesh, which knows this file and not the other way round."""

    @property
    def points(self) -> FloatArray: ...
    @property
    def tets(self) -> IntArray: ...
    @property
    def body(self) -> IntArray: ...
    @property
    def surface(self) -> IntArray: ...


# meshio would take the extension .msh for a Fluent file first.
PREFERRED_FORMAT = {".msh": "gmsh"}
_SURFACES = (".obj", ".ply", ".stl")  # which get the boundary
# meshio would write these without a word, and without the tets.
_NO_TETS = (".off", ".svg", ".wkt")
# meshio writes another file with these, whose name follows from theirs.
_OF_TWO_FILES = (".xdmf", ".xmf", ".node", ".ele")
# What meshio writes values per vertex and per tet to. Into other formats it would write the mesh without them.
_WITH_FIELDS = (".msh", ".vtk", ".vtu", ".xdmf")
# How many columns values may have where not any number comes back: .vtk makes three of two.
_COLUMNS = {".msh": (1, 3, 9), ".vtk": (1, 3, 4, 5, 6, 7, 8, 9)}


def save(
    path: str | PathLike[str],
    mesh: Mesh,
    point_data: Mapping[str, Any] | None = None,
    cell_data: Mapping[str, Any] | None = None,
    *,
    points: Any = None,
) -> None:
    """File of a mesh, written by meshio; the extension tells the format (.vtu, .vtk, .msh, .mesh, .inp, .xdmf, ...).

    In .stl, .obj and .ply the boundary is written: triangles whose normals point outwards. With more than one body the
    label of each tet is written as cell data `body`, in formats that hold cell data. `load_fields` reads point_data and
    cell_data back.

    Args:
        path: The file.
        mesh: The TetMesh.
        point_data: Values of vertices by name, shape [V] or [V, C], in any unit; arrays or tensors, numbers or bool
            (written as 0 and 1). Only .vtu, .vtk, .msh and .xdmf hold them. In .msh all become float64 and C is 1, 3 or
            9; in .vtk C is 1 or 3 to 9.
        cell_data: The same for tets, shape [T] or [T, C].
        points: Positions of the vertices [m], shape [V, 3], an array or a tensor; default those of the mesh.

    Raises:
        TypeError: no path or no TetMesh; values or positions that are no real numbers, values that have no names.
        ValueError: a mesh without tets, an unknown extension, a format that holds no tets or no values, values or
            positions of another shape or not finite, a name that is empty, not printable or none in this format (in
            .vtk with spaces, in .msh with quotes), cell data `body` with labels, or meshio fails.
        ImportError: the format needs a package that is not installed (h5py for .xdmf and .med).
        FileNotFoundError: the directory does not exist.
    """
    path = to_path("path", path)
    check_mesh(mesh)
    extension = path.suffix.lower()
    if extension in _NO_TETS:
        raise ValueError(f"cannot write {path}: {path.suffix} files hold no tets; use .vtu, .msh, .stl, ...")
    positions = mesh.points if points is None else float_array("points", to_numpy("points", points), mesh.points.shape)
    if not path.parent.is_dir():
        raise FileNotFoundError(f"directory {path.parent} does not exist")
    given = {"point_data": (point_data, len(mesh.points)), "cell_data": (cell_data, len(mesh.tets))}
    fields: dict[str, Any] = {}
    for kind, (named, rows) in given.items():
        fields[kind] = values = checked_fields(kind, named, (rows,), _COLUMNS.get(extension))
        if values and extension not in _WITH_FIELDS:
            raise ValueError(f"{kind}: expected none, because {extension} files hold no values; use .vtu, .msh, ...")
        if extension == ".vtk" and (spaced := [name for name in values if name.split() != [name]]):
            raise ValueError(f"{kind}: expected names without spaces in a .vtk file, got {spaced[0]!r}")
        if extension == ".msh" and (quoted := [name for name in values if '"' in name]):
            raise ValueError(f"{kind}: expected names without quotes in a .msh file, got {quoted[0]!r}")
        if extension == ".vtu":
            fields[kind] = vtu_names(values)
    content = content_of(mesh, positions, **fields)
    if extension in _SURFACES:
        used, triangles = np.unique(mesh.surface, return_inverse=True)
        content = meshio.Mesh(positions[used], [("triangle", triangles.reshape(-1, 3))])

    def write(new: Path) -> None:
        options = {"binary": True} if extension == ".stl" else {}
        content.write(new, file_format=PREFERRED_FORMAT.get(extension), **options)

    quiet(lambda: write(path) if extension in _OF_TWO_FILES else replace(path, write), f"write {path}")


def replace(path: Path, write: Callable[[Path], object]) -> None:
    """Write a file as a whole: after an error, and after a crash, what was there before is still there.

    Args:
        path: The file.
        write: Called with another path in the same folder, of the same extension, that takes the file's place.

    Raises:
        OSError: the disk is full, or the like; it names the file.
    """
    path = path.resolve()  # what a link points to is written, not the link
    unfinished = path.with_name(f"{path.stem}.{os.getpid()}.part{path.suffix}")
    try:
        write(unfinished)
        os.replace(unfinished, path)
    except OSError as error:
        if error.errno is None:
            raise
        raise OSError(error.errno, error.strerror, str(path)) from None
    finally:
        unfinished.unlink(missing_ok=True)


def content_of(mesh: Mesh, points: FloatArray, point_data: Mapping[str, NDArray[Any]],
               cell_data: Mapping[str, NDArray[Any]]) -> meshio.Mesh:  # fmt: skip
    """Content for meshio: a mesh whose vertices are at `points`, with values that `checked_fields` has seen."""
    if len(mesh.tets) == 0:
        raise ValueError("mesh: expected at least one tet to write, got none")
    of_tets: dict[str, Any] = {name: [values] for name, values in cell_data.items()}
    if len(np.unique(mesh.body)) > 1:
        if "body" in of_tets:
            raise ValueError("cell_data: expected another name than 'body', which has the labels of this mesh's bodies")
        of_tets["body"] = [mesh.body[mesh.tets[:, 0]]]
    return meshio.Mesh(points, [("tetra", mesh.tets)], point_data=dict(point_data), cell_data=of_tets)


def vtu_names(fields: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Values by names as they stand in a .vtu file, into whose XML meshio writes them unescaped."""
    return {escape(name, {'"': "&quot;"}): values for name, values in fields.items()}


def checked_fields(kind: str, fields: Mapping[str, Any] | None, leading: tuple[int, ...],
                   widths: tuple[int, ...] | None = None) -> dict[str, NDArray[Any]]:  # fmt: skip
    """Copies of values by name, each of shape [*leading] or [*leading, C], finite; `widths` limits C."""
    if fields is not None and not isinstance(fields, Mapping):
        raise TypeError(f"{kind}: expected values by name, as in a dict, got {type(fields).__name__}")
    found = {}
    for name, given in (fields or {}).items():
        label = f"{kind}[{name!r}]"
        if not isinstance(name, str) or not name.strip() or not name.isprintable():
            raise ValueError(f"{kind}: expected printable names of values, got {name!r}")
        values = to_numpy(label, given)
        if values.dtype.kind not in "biuf":
            raise TypeError(f"{label}: expected real numbers, got dtype {values.dtype}")
        rows, columns = values.shape[: len(leading)], values.shape[len(leading) :]
        if rows != leading or len(columns) > 1 or 0 in columns:
            raise ValueError(f"{label}: expected shape {[*leading]} or {[*leading, 'C']}, got {list(values.shape)}")
        width = columns[0] if columns else 1
        if widths is not None and width not in widths:
            raise ValueError(f"{label}: expected {' or '.join(map(str, widths))} columns, got {width}")
        if not np.isfinite(values).all():
            bad = np.unique(np.nonzero(~np.isfinite(values))[0])
            raise ValueError(f"{label}: expected finite numbers, got NaN or Inf in {listed(bad, 'row')}")
        narrow = {"b": np.uint8, "f": np.float64 if values.dtype.itemsize not in (4, 8) else values.dtype}
        found[name] = np.array(values, dtype=narrow.get(values.dtype.kind, values.dtype), order="C")
    return found


def quiet(action: Callable[[], Result], purpose: str, warned: list[str] | None = None) -> Result:
    """Run a reader or a writer with its printing kept back, and every way it fails turned into one line.

    meshio ends the process on files it cannot read, and a damaged file raises whatever the parser stumbles over.
    What it warned of goes into `warned`.
    """
    said = io.StringIO()
    try:
        with redirect_stdout(said), redirect_stderr(said), np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            result = action()
        if warned is not None:
            warned += [" ".join(each.split()) for each in said.getvalue().split("Warning:")[1:]]
        return result
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
        said_why = f"{type(failure).__name__}: {failure}"
        reason = f"truncated ({said_why})" if isinstance(failure, EOFError) else f"the reader fails on it ({said_why})"
    raise ValueError(f"cannot {purpose}: {' '.join(reason.split())[:300] or 'damaged or truncated'}")
