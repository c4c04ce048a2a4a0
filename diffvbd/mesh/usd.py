"""Moving surfaces as a scene of Universal Scene Description (the optional package usd-core)."""

# names of pxr are made when it is loaded
# pyright: reportAttributeAccessIssue=false
from __future__ import annotations

import errno
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffvbd.mesh.arrays import FloatArray
from diffvbd.mesh.parts import Part

ROOT = "/simulation"
RATE = 24.0  # frames per second of a single frame


def write_usd(
    path: Path,
    parts: Sequence[Part],
    frames: FloatArray,
    times: NDArray[Any],
    point_data: Mapping[str, NDArray[Any]],
) -> None:
    """Write parts whose vertices move; frames [N, V, 3] m, times [N] s, increasing, point_data [N, V] or [N, V, C].

    Raises:
        ValueError: `velocities` of another shape than [N, V, 3].
        ImportError: usd-core is not installed.
    """
    require_usd(path.suffix)
    from pxr import Sdf, Tf, Usd, UsdGeom, Vt

    velocities = point_data.get("velocities")
    if velocities is not None and velocities.shape != frames.shape:
        shape = list(frames.shape)
        raise ValueError(f"point_data['velocities']: expected shape {shape}, got {list(velocities.shape)}")
    rate, codes = time_codes(times)
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetTimeCodesPerSecond(rate)
    stage.SetFramesPerSecond(rate)
    stage.SetStartTimeCode(codes[0])
    stage.SetEndTimeCode(codes[-1])
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, ROOT).GetPrim())

    def vectors(values: NDArray[Any]) -> Any:
        return Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(values, dtype=np.float32))

    for part in parts:
        surface = UsdGeom.Mesh.Define(stage, f"{ROOT}/{part.name}")
        surface.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
        surface.CreateFaceVertexCountsAttr(Vt.IntArray(len(part.triangles), 3))
        surface.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(part.triangles.ravel().astype(np.int32)))
        points, extent = surface.CreatePointsAttr(), surface.CreateExtentAttr()
        moving = surface.CreateVelocitiesAttr() if velocities is not None else None
        further = [
            (_primvar(surface, Sdf, UsdGeom, name, values), values, values.ndim == 3 and values.shape[2] == 3)
            for name, values in point_data.items()
            if name != "velocities"
        ]
        for k, code in enumerate(codes):
            here = frames[k, part.vertices]
            points.Set(vectors(here), code)
            extent.Set(vectors(np.stack([here.min(0), here.max(0)])), code)
            if moving is not None and velocities is not None:
                moving.Set(vectors(velocities[k, part.vertices]), code)
            for primvar, values, is_vector in further:
                rows = values[k, part.vertices]
                flat = np.ascontiguousarray(rows.ravel(), dtype=np.float32)
                primvar.Set(vectors(rows) if is_vector else Vt.FloatArray.FromNumpy(flat), code)
    try:
        written = stage.GetRootLayer().Export(str(path))
    except Tf.ErrorException:
        written = False
    if not written:
        raise OSError(errno.EIO, os.strerror(errno.EIO), str(path))  # USD does not say which error it was


def require_usd(extension: str) -> None:
    """Raises ImportError that names the extra, where usd-core is not installed."""
    try:
        import pxr.UsdGeom  # noqa: F401
    except ImportError:
        raise ImportError(f"writing {extension} needs usd-core: pip install 'diffvbd[exchange]'") from None


def time_codes(times: NDArray[Any]) -> tuple[float, list[float]]:
    """Frames per second, and the time codes of frames at these times [s]: whole numbers where frames are even."""
    rate = (len(times) - 1) / float(times[-1] - times[0]) if len(times) > 1 else RATE
    return rate, np.round(times * rate, 6).tolist()


def _primvar(surface: Any, sdf: Any, usd_geom: Any, name: str, values: NDArray[Any]) -> Any:
    """An attribute of vertices: floats, vectors where C = 3, or arrays of C floats each."""
    columns = values.shape[2] if values.ndim == 3 else 1
    kind = sdf.ValueTypeNames.Vector3fArray if columns == 3 else sdf.ValueTypeNames.FloatArray
    try:
        primvar = usd_geom.PrimvarsAPI(surface).CreatePrimvar(name, kind, usd_geom.Tokens.vertex)
    except Exception:
        primvar = None
    if not primvar:
        raise ValueError(f"point_data: expected names of letters, digits and underscores for USD, got {name!r}")
    if columns not in (1, 3):
        primvar.SetElementSize(columns)
    return primvar
