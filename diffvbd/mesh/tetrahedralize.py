"""Closed triangle surfaces to tets through fTetWild (the optional package pytetwild)."""

from __future__ import annotations

import os
import tempfile
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from diffvbd.mesh.arrays import FloatArray, IntArray, float_array, int_array, warn
from diffvbd.mesh.io import read_triangles
from diffvbd.mesh.shapes import count, positive
from diffvbd.mesh.tet_mesh import TetMesh

UNLIKELY = 5.0  # [m]; of a surface whose unit nobody gave, millimetres or inches are likelier from here on


def tetrahedralize(
    surface: str | PathLike[str] | tuple[Any, Any],
    edge_length: float | None = None,
    epsilon: float | None = None,
    max_triangles: int | None = 3000,
) -> TetMesh:
    """Fill a triangle surface with tets. Needs the extra: `pip install diffvbd[mesh]`.

    fTetWild accepts surfaces with holes and self-intersections; what it returns stays within `epsilon` of the input.
    Its time grows with the input triangles more than with the output: a scan of 100,000 triangles does not end in
    minutes, 3,000 take about ten seconds, 12,000 three quarters of a minute. Surfaces above `max_triangles` are
    therefore decimated first.

    Every call makes another mesh, with other vertices and about as many: save the one that results belong to.

    Args:
        surface: A file (STL, PLY, OBJ, OFF, or what meshio reads), or (points [P, 3] in metres, triangles [F, 3]), such
            as the `surface` of what `repair` returns.
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
    used, compact = np.unique(tets, return_inverse=True)
    return TetMesh(vertices[used], compact.reshape(-1, 4), orient=True)


def warn_of_unit(points: FloatArray, cure: str) -> None:
    """Warn the caller of a function of this package of points [P, 3] that are hardly in metres."""
    extent = float(np.ptp(points, axis=0).max())
    if extent > UNLIKELY:
        warn(f"surface: its largest extent is {extent:.4g} m, if its unit is the metre, which is assumed; {cure}")


def surface_arrays(surface: str | PathLike[str] | tuple[Any, Any]) -> tuple[FloatArray, IntArray]:
    """Points [P, 3] and triangles [F, 3] of a file or of a pair of arrays; raises as `tetrahedralize` does."""
    if isinstance(surface, (str, PathLike)):
        points, triangles = read_triangles(Path(surface))
    else:
        try:
            points, triangles = surface
        except (TypeError, ValueError):
            hint = ": give its .surface" if hasattr(surface, "surface") else ""
            got = f"{type(surface).__name__}{hint}"
            raise TypeError(f"surface: expected a path or (points, triangles), got {got}") from None
    points = float_array("points", points, (None, 3))
    triangles = int_array("triangles", triangles, (None, 3))
    if len(triangles) == 0:
        raise ValueError("surface: expected triangles, got none")
    if triangles.min() < 0 or triangles.max() >= len(points):
        raise ValueError(
            f"triangles: expected vertex indices from 0 to {len(points) - 1}, got {triangles.min()}..{triangles.max()}"
        )
    if np.ptp(points[triangles].reshape(-1, 3), axis=0).max() == 0:
        raise ValueError("surface: expected an extended body, got a single point")
    return points, triangles


def _decimated(points: FloatArray, triangles: IntArray, limit: int) -> tuple[FloatArray, IntArray]:
    try:
        import pyvista
    except ImportError:
        raise ImportError(
            f"decimating {len(triangles)} triangles to max_triangles = {limit} needs pyvista: pip install diffvbd[mesh]"
        ) from None
    # Welding first: STL-like input without shared vertices cannot be decimated.
    surface = pyvista.PolyData.from_regular_faces(points, triangles).clean()
    reduced = surface.decimate(1 - limit / surface.n_cells)
    return np.asarray(reduced.points, dtype=np.float64), reduced.regular_faces.astype(np.int64)
