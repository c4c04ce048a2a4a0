"""Motions as files: a series for ParaView, or an animated scene in USD or glTF."""

from __future__ import annotations

from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import NDArray

from diffvbd.mesh.arrays import FloatArray, check_mesh, float_array, to_numpy, to_path
from diffvbd.mesh.gltf import write_gltf
from diffvbd.mesh.parts import parts_of
from diffvbd.mesh.tet_mesh import TetMesh
from diffvbd.mesh.usd import require_usd, write_usd
from diffvbd.mesh.write import checked_fields, content_of, quiet, replace, vtu_names

USD = (".usd", ".usda", ".usdc")
GLTF = (".glb", ".gltf")
EXTENSIONS = (".pvd", *USD, *GLTF)


def write_series(
    path: str | PathLike[str],
    mesh: TetMesh,
    frames: Any,
    times: Any = None,
    point_data: Mapping[str, Any] | None = None,
    cell_data: Mapping[str, Any] | None = None,
) -> None:
    """Write a motion; the extension tells for whom.

    * .pvd, for ParaView: the tets, as `path` and one file `<stem>_<k>.vtu` for each frame beside it.
    * .usdc, .usd (binary) and .usda (text): the surface of each body as a `Mesh` of its own with points that change in
      time. Needs the extra: `pip install diffvbd[exchange]`.
    * .glb (binary) and .gltf (text): the surface of each body with one morph target for each frame after the first, and
      an animation that blends from one to the next. Its weights take 4 N^2 bytes: meant for some hundred frames.

    USD and glTF store positions in single precision. Both are told that y points up and that units are metres.

    Args:
        path: The file.
        mesh: The mesh whose tets connect the frames.
        frames: Positions [m], shape [N, V, 3]; array or tensor.
        times: Time of each frame [s], shape [N], never decreasing; default 0, 1, 2, ... In USD and glTF they increase,
            and in glTF they begin at 0 or later.
        point_data: Further values per vertex by name, shape [N, V] or [N, V, C]. USD has them as primvars; those named
            `velocities` [m/s], shape [N, V, 3], as the velocities of the points. glTF has no place for them.
        cell_data: Values per tet by name, shape [N, T] or [N, T, C]; .pvd only.

    Raises:
        TypeError, ValueError: wrong shape or dtype, NaN or Inf, times in another order, another extension, values that
            the format has no place for, a mesh without tets.
        ImportError: USD, and usd-core is not installed.
        FileNotFoundError: the directory does not exist.

    Source: OpenUSD's schema UsdGeomMesh; Khronos, "glTF 2.0 Specification", 2021, section 3.7.2.2, morph targets.
    """
    path = to_path("path", path)
    check_mesh(mesh)
    extension = check_extension(path)
    if not path.parent.is_dir():
        raise FileNotFoundError(f"directory {path.parent} does not exist")
    if mesh.num_tets == 0:
        raise ValueError("mesh: expected at least one tet to write, got none")
    # a file has no gradients: those of frames are let go
    positions = float_array("frames", to_numpy("frames", frames), (None, mesh.num_vertices, 3))
    moments = np.arange(len(positions)) if times is None else float_array("times", times, (len(positions),))
    if (np.diff(moments) < 0).any():
        raise ValueError("times: expected times that never decrease")
    of_vertices = checked_fields("point_data", point_data, positions.shape[:2])
    of_tets = checked_fields("cell_data", cell_data, (len(positions), mesh.num_tets))
    if extension == ".pvd":
        _write_pvd(path, mesh, positions, moments, of_vertices, of_tets)
        return
    if of_tets:
        raise ValueError(f"cell_data: expected none, because {extension} files get surfaces; .pvd holds values of tets")
    if len(positions) == 0:
        raise ValueError(f"frames: expected at least one frame for {extension}, got none")
    if (np.diff(moments) <= 0).any():
        raise ValueError(f"times: expected increasing times for {extension}, got two that are equal")
    if extension in USD:
        replace(path, lambda new: write_usd(new, parts_of(mesh), positions, moments, of_vertices))
        return
    if of_vertices:
        raise ValueError(f"point_data: expected none, because {extension} files hold no values that change in time")
    replace(path, lambda new: write_gltf(new, parts_of(mesh), positions, moments))


def check_extension(path: Path, name: str = "path") -> str:
    """The extension of a motion that can be written here: a ValueError names the argument, an ImportError the extra."""
    extension = path.suffix.lower()
    if extension not in EXTENSIONS:
        raise ValueError(f"{name}: expected a name that ends in {', '.join(EXTENSIONS)}, got {path.name!r}")
    if extension in USD:
        require_usd(extension)
    return extension


def _write_pvd(
    path: Path,
    mesh: TetMesh,
    positions: FloatArray,
    times: NDArray[Any],
    point_data: Mapping[str, NDArray[Any]],
    cell_data: Mapping[str, NDArray[Any]],
) -> None:
    digits = max(4, len(str(len(positions) - 1)))
    entries = []
    for k, (time, points) in enumerate(zip(times, positions, strict=True)):
        name = f"{path.stem}_{k:0{digits}d}.vtu"
        of_vertices, of_tets = (
            vtu_names({key: all[k] for key, all in data.items()}) for data in (point_data, cell_data)
        )
        content = content_of(mesh, points, of_vertices, of_tets)
        target = path.with_name(name)
        quiet(lambda content=content, target=target: replace(target, content.write), f"write {target}")
        entries.append(f'    <DataSet timestep="{time:.17g}" part="0" file={quoteattr(name)}/>\n')
    collection = (
        '<?xml version="1.0"?>\n<VTKFile type="Collection" version="0.1">\n  <Collection>\n'
        + "".join(entries)
        + "  </Collection>\n</VTKFile>\n"
    )
    replace(path, lambda new: new.write_text(collection, encoding="utf-8"))
