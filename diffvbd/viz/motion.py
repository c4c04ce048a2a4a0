"""Motions as the viewer takes them: positions of a surface over time, from results, files and Models."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .._common.checks import check_positive, fail
from .._contact.colliders import Capsule, Plane, Sphere
from ..mesh.arrays import connected
from ..mesh.io import load
from ..mesh.motions import read_frames
from ..mesh.tet_mesh import TetMesh, boundary_faces
from ..mesh.write import replace
from ..model.model import Model
from ..rollout.trajectory import Trajectory
from .scenery import SCENERY, Scenery, as_array, capsule, check_surface

Mesh = Model | TetMesh


@dataclass(frozen=True)
class Motion:
    """Positions of a surface over time."""

    points: NDArray[np.float64]  # [m] [N, V, 3]
    triangles: NDArray[np.int64]  # of the boundary, outward oriented [F, 3]
    times: NDArray[np.float64] | None = None  # of each frame [s] [N]; None: not known
    body: NDArray[np.int64] | None = None  # label of each vertex [V]
    tets: NDArray[np.int64] | None = None  # tet that each triangle bounds [F]; None for a bare surface
    velocities: NDArray[np.float64] | None = None  # [m/s] [N, V, 3]; None: those between frames
    steps: NDArray[np.int64] | None = None  # step number of each frame [N]; None: not known
    scene: int = 0  # which of several scenes it is, for values [B, T]
    scenery: tuple[Scenery, ...] = ()  # what else is there; points may have shape [N, P, 3]

    def __len__(self) -> int:
        return len(self.points)

    @property
    def bounds(self) -> NDArray[np.float64]:
        """Lowest and highest corner [m] of all frames, shape [2, 3]."""
        return np.stack([self.points.min((0, 1)), self.points.max((0, 1))])


def mesh_of(mesh: Any) -> TetMesh | None:
    """The mesh of a Model, or a mesh itself."""
    if mesh is None or isinstance(mesh, TetMesh):
        return mesh
    if isinstance(mesh, Model):
        return mesh.mesh
    raise TypeError(f"mesh: expected a dv.Model or a dv.TetMesh, got {type(mesh).__name__}")


def motions_of(source: Any, mesh: Mesh | None = None, time_step: float | None = None) -> dict[str, Motion]:
    """A trajectory, positions [m] of shape [V, 3], [N, V, 3] or [N, B, V, 3], or a mesh, as motions by name. TypeError
    or ValueError for something else, a shape that is not the mesh's, positions that are not finite."""
    if isinstance(source, Motion):
        return {"motion": source}
    if isinstance(source, Mapping):
        found: dict[str, Motion] = {}
        for name, value in source.items():
            each = motions_of(value, mesh, time_step)
            found |= {f"{name}" if len(each) == 1 else f"{name}, {key}": motion for key, motion in each.items()}
        if not found:
            fail("source", "at least one motion", "an empty dict")
        return found
    if isinstance(source, (Model, TetMesh)):
        return motions_of((source if isinstance(source, TetMesh) else source.mesh).points, source, time_step)
    body, step = mesh_of(mesh), None if time_step is None else check_positive("time_step", time_step, "s")
    if body is None:
        raise TypeError(f"mesh: expected a dv.Model or a dv.TetMesh with {type(source).__name__}, got None")
    x, v, steps = source, None, None
    if isinstance(source, Trajectory):
        x, v, steps = source.x, as_array(source.v), np.asarray(source.steps)
    if isinstance(x, (str, bytes)) or not (hasattr(x, "__array__") or isinstance(x, Sequence)):
        raise TypeError(f"source: expected a Trajectory, positions, a mesh or a file, got {type(source).__name__}")
    points = positions("source", x, body.num_vertices)
    numbers = np.arange(len(points)) if steps is None else steps
    times = None if step is None else as_array(numbers * step)
    triangles, tets = boundary_faces(body.tets, body.num_vertices)
    speeds = None if v is None else v.reshape(points.shape)
    motions = [Motion(points[:, b], triangles, times, body.body, tets, None if speeds is None else speeds[:, b],
                      numbers, b) for b in range(points.shape[1])]  # fmt: skip
    return {"motion" if len(motions) == 1 else f"scene {motion.scene}": motion for motion in motions}


def positions(name: str, x: Any, vertices: int) -> NDArray[np.float64]:
    """Positions [m] as an array [N, B, V, 3]."""
    try:
        points = as_array(x)
    except (TypeError, ValueError):
        raise TypeError(f"{name}: expected positions of real numbers, got {type(x).__name__}") from None
    if points.ndim not in (2, 3, 4) or points.shape[-2:] != (vertices, 3):
        fail(name, f"shape [{vertices}, 3], [N, {vertices}, 3] or [N, B, {vertices}, 3]", f"shape {list(points.shape)}")
    if 0 in points.shape:
        fail(name, "at least one frame, scene and vertex", f"shape {list(points.shape)}")
    points = points.reshape(len(points) if points.ndim > 2 else 1, -1, vertices, 3)
    bad = ~np.isfinite(points).all((1, 2, 3))
    if bad.any():
        fail(name, "finite positions", f"some that are not, first in frame {int(bad.argmax())}")
    return points


# --- files ------------------------------------------------------------------------------------------------------------

MOST_VALUES = 30_000_000  # numbers of a kept motion; longer ones keep every n-th frame


def save_motions(
    path: str | PathLike[str],
    surface: Any,
    motions: Mapping[str, Any],
    time_step: float,
    scenery: Sequence[Scenery] = (),
) -> None:
    """Write motions [N, V, 3] m of one surface as the .npz that :func:`load_motions` reads, in single precision."""
    arrays: dict[str, Any] = {"surface": np.asarray(surface, np.int32), "names": np.array([*motions], dtype=np.str_)}
    for k, motion in enumerate(motions.values()):
        points = as_array(motion)
        every = -(-points.size // MOST_VALUES)
        arrays[f"points_{k}"] = points[::every].astype(np.float32)
        arrays[f"times_{k}"] = np.arange(len(points))[::every] * time_step
    arrays["scenery_colors"] = np.array([thing.color for thing in scenery], dtype=np.str_)
    for k, thing in enumerate(scenery):
        arrays[f"scenery_points_{k}"] = as_array(thing.points).astype(np.float32)
        arrays[f"scenery_triangles_{k}"] = np.asarray(thing.triangles, np.int32)

    save_arrays(path, arrays)


def save_arrays(path: str | PathLike[str], arrays: Mapping[str, Any]) -> None:
    """Write an .npz file, which is whole or not there."""

    def write(new: Path) -> None:
        with new.open("wb") as file:  # numpy adds .npz to other names
            np.savez_compressed(file, **arrays)

    replace(Path(path), write)


def load_motions(path: str | PathLike[str]) -> dict[str, Motion]:
    """Motions by name from a file that :func:`save_motions` wrote; ValueError for another content."""
    try:
        with np.load(path, allow_pickle=False) as content:
            arrays = dict(content)
        triangles = arrays["surface"].astype(np.int64)
        colors = [str(color) for color in arrays["scenery_colors"]]
        things = tuple(
            Scenery(as_array(arrays[f"scenery_points_{k}"]), arrays[f"scenery_triangles_{k}"], color or SCENERY)
            for k, color in enumerate(colors)
        )
        motions = {}
        for k, name in enumerate(arrays["names"]):
            points, times = as_array(arrays[f"points_{k}"]), as_array(arrays[f"times_{k}"])
            if points.ndim != 3 or points.shape[-1] != 3 or times.shape != points.shape[:1]:
                raise ValueError(f"positions of shape {list(points.shape)}")
            check_surface(triangles, points.shape[1])
            body = bodies(triangles, points.shape[1])
            motions[str(name)] = Motion(points, triangles, times, body, scenery=things)
    except FileNotFoundError:
        raise
    except Exception as error:  # numpy raises errors of many kinds
        raise ValueError(f"{path}: expected motions of a run, got a file that has none ({error})") from None
    if not motions:
        raise ValueError(f"{path}: expected motions of a run, got a file that has none")
    return motions


MOTION, LOG = "motion.npz", "log.json"  # of the folder of a run
NOT_SHOWN = {"iteration", "stage", "seconds", "loss"}  # of a row of the log


_FOR_OTHERS = (".glb", ".gltf", ".usd", ".usda", ".usdc")  # what `write_series` writes and nothing here reads


class Opened(NamedTuple):
    """Motions by name, their mesh if the file has tets, and the course of an optimisation."""

    motions: dict[str, Motion]
    mesh: TetMesh | None = None
    losses: tuple[float, ...] = ()
    parameters: Mapping[str, float] = MappingProxyType({})


def opened(path: Path, time_step: float | None = None) -> Opened:
    """The motions of a .pvd, of a mesh file, of a motion.npz, or of the folder of a run. FileNotFoundError for no such
    file; ValueError for one of another kind, or a run that has kept no motion."""
    suffix, expected = path.suffix.lower(), "expected a .pvd, a mesh with tets or the folder of a run"
    if not path.exists():
        raise FileNotFoundError(f"{path} does not exist: {expected}")
    if path.is_dir():
        return _run(path)
    if suffix == ".npz":
        return Opened(load_motions(path))
    if suffix == ".pvd":
        frames = read_frames(path)
        motions = motions_of(frames.points, frames.mesh, time_step)
        if time_step is None:
            motions = {name: _timed(motion, frames.times) for name, motion in motions.items()}
        return Opened(motions, frames.mesh)
    if suffix in _FOR_OTHERS:
        raise ValueError(f"{path}: {expected}; {path.suffix} is for other programs")
    mesh = load(path)
    return Opened(motions_of(mesh, time_step=time_step), mesh)


def _timed(motion: Motion, times: Any) -> Motion:
    """A motion at other times [s], which are not those of single steps."""
    return dataclasses.replace(motion, times=times, steps=None) if len(times) < 2 or times[-1] > times[0] else motion


def _run(folder: Path) -> Opened:
    if not (folder / MOTION).is_file():
        kind = "a run that is not finished" if (folder / "state.pt").exists() else "none"
        raise ValueError(f"{folder}: expected the folder of a finished `diffvbd run` with {MOTION}, got {kind}")
    history: list[dict[str, Any]] = []
    losses: tuple[float, ...] = ()
    if (folder / LOG).is_file():
        try:
            history = json.loads((folder / LOG).read_text(encoding="utf-8")).get("history", [])
            losses = tuple(float(row.get("loss", math.nan)) for row in history)
        except (ValueError, TypeError, AttributeError, RecursionError) as error:
            raise ValueError(f"{folder / LOG}: expected the log of a run, got {error}") from None
    last = history[-1] if history else {}
    numbers = {k: v for k, v in last.items() if k not in NOT_SHOWN and isinstance(v, (int, float))}
    return Opened(load_motions(folder / MOTION), None, losses, numbers)


FLOOR = "#dcdad5"
REACH = 2.5  # planes are shown so far around a scene, in its radii


def scenery_of(
    model: Model, low: NDArray[np.float64], high: NDArray[np.float64], colliders: Any = None
) -> tuple[Scenery, ...]:
    """Floors and colliders around a scene between two corners [m]; colliders: where their corner points are in each
    frame [m], shape [N, Vc, 3], else at rest. Raises ValueError for another shape."""
    middle, reach = 0.5 * (low + high), REACH * 0.5 * float(np.linalg.norm(high - low))
    things = []
    if model.floor is not None:
        normals, heights = np.atleast_2d(as_array(model.floor.normal)), np.atleast_1d(as_array(model.floor.height))
        for k, normal in enumerate(normals):
            unit = normal / np.linalg.norm(normal)
            things.append(plane(heights[min(k, len(heights) - 1)] * unit, unit, middle, reach))
    rest = as_array(model.collider_points) if model.colliders else np.zeros((0, 3))
    moved = rest if colliders is None else as_array(colliders)
    if moved.shape[-2:] != rest.shape or moved.ndim not in (2, 3):
        fail("colliders", f"shape [N, {len(rest)}, 3]", f"shape {list(moved.shape)}")
    for collider, rows in zip(model.colliders, model.collider_rows if model.colliders else (), strict=True):
        frames = moved[..., rows, :]
        if isinstance(collider, Plane):
            corners = frames.reshape(-1, *frames.shape[-2:])[0]
            across = np.cross(corners[1] - corners[0], corners[2] - corners[0])
            things.append(plane(corners[0], across / np.linalg.norm(across), middle, reach))
        elif isinstance(collider, (Sphere, Capsule)):
            ends = frames.reshape(-1, *frames.shape[-2:])
            shapes = [capsule(each[0], each[-1], collider.radius) for each in ends]
            points = np.stack([shape.points for shape in shapes])
            things.append(Scenery(points[0] if frames.ndim == 2 else points, shapes[0].triangles))
        else:
            things.append(Scenery(frames, collider.corners().triangles))
    return tuple(things)


def plane(
    point: NDArray[np.float64], normal: NDArray[np.float64], middle: NDArray[np.float64], reach: float
) -> Scenery:
    """A square piece of a plane, as large as `reach` [m] to each side of the place below `middle` [m]."""
    foot = middle - ((middle - point) @ normal) * normal
    first = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
    first /= np.linalg.norm(first)
    second = np.cross(normal, first)
    corners = foot + reach * as_array([-first - second, first - second, first + second, second - first])
    return Scenery(corners, np.array([[0, 1, 2], [0, 2, 3]]), FLOOR)


SHARP = np.cos(np.radians(40.0))  # cosine between two triangles from which on their edge is drawn as one


def bodies(triangles: NDArray[np.int64], vertices: int) -> NDArray[np.int64]:
    """Labels [V] of the connected parts of a surface [F, 3]."""
    return connected(np.concatenate([triangles[:, :2], triangles[:, 1:]]), vertices)


def smooth_parts(points: NDArray[np.float64], triangles: NDArray[np.int64]) -> NDArray[np.int64]:
    """Labels [F] of the parts of a surface that sharp edges bound, for points [m] of shape [V, 3]."""
    corners = points[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    edges = np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), 1)
    key = edges[:, 0] * len(points) + edges[:, 1]
    order = np.argsort(key, kind="stable")
    same = key[order][1:] == key[order][:-1]
    pairs = np.stack([order[:-1][same] // 3, order[1:][same] // 3], 1)
    smooth = (normals[pairs[:, 0]] * normals[pairs[:, 1]]).sum(1) > SHARP
    return connected(pairs[smooth], len(triangles))
