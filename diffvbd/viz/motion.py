"""A motion as the viewer holds it: positions of a surface over time, and what its colors are computed from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..checks import check_positive, fail
from ..mesh.tet_mesh import TetMesh, boundary_faces
from ..mesh.write import replace
from ..model.model import Model
from ..rollout.trajectory import Trajectory
from .drawing import SCENERY, Scenery, as_array, check_surface
from .surfaces import bodies

Mesh = Model | TetMesh


@dataclass(frozen=True)
class Motion:
    """Positions of a surface over time.

    Attributes:
        points: Positions [m], shape [N, V, 3].
        triangles: Boundary triangles, outward oriented, shape [F, 3].
        times: Of each frame [s], shape [N]; None: not known.
        body: Label of each vertex, shape [V].
        tets: Tet that each triangle bounds, shape [F]; None for a bare surface.
        velocities: [m/s], shape [N, V, 3]; None: those between frames.
        steps: Step number of each frame, shape [N]; None: not known.
        scene: Which of several scenes it is, for values [B, T].
        scenery: What else is there; points may have shape [N, P, 3].
    """

    points: NDArray[np.float64]
    triangles: NDArray[np.int64]
    times: NDArray[np.float64] | None = None
    body: NDArray[np.int64] | None = None
    tets: NDArray[np.int64] | None = None
    velocities: NDArray[np.float64] | None = None
    steps: NDArray[np.int64] | None = None
    scene: int = 0
    scenery: tuple[Scenery, ...] = field(default=())

    def __len__(self) -> int:
        return len(self.points)

    @property
    def bounds(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Lowest and highest corner [m] of all frames."""
        return self.points.min((0, 1)), self.points.max((0, 1))


def mesh_of(mesh: Any) -> TetMesh | None:
    """The mesh of a Model, or a mesh itself."""
    if mesh is None or isinstance(mesh, TetMesh):
        return mesh
    if isinstance(mesh, Model):
        return mesh.mesh
    raise TypeError(f"mesh: expected a dv.Model or a dv.TetMesh, got {type(mesh).__name__}")


def motions_of(source: Any, mesh: Mesh | None = None, time_step: float | None = None) -> dict[str, Motion]:
    """A trajectory, positions [m] of shape [V, 3], [N, V, 3] or [N, B, V, 3], or a mesh, as motions by name.

    Raises:
        TypeError, ValueError: something else, a shape that is not the mesh's, positions that are not finite.
    """
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
        body = mesh_of(source)
        assert body is not None
        return motions_of(body.points, source, time_step)
    body, step = mesh_of(mesh), None if time_step is None else check_positive("time_step", time_step, "s")
    if body is None:
        raise TypeError(f"mesh: expected a dv.Model or a dv.TetMesh beside {type(source).__name__}, got None")
    x, v, steps = source, None, None
    if isinstance(source, Trajectory):
        x, v, steps = source.x, as_array(source.v), np.asarray(source.steps)
    if isinstance(x, (str, bytes)) or not (hasattr(x, "__array__") or isinstance(x, Sequence)):
        raise TypeError(f"source: expected a dv.Trajectory, positions, a mesh or a file, got {type(source).__name__}")
    points = positions("source", x, body.num_vertices)
    numbers = np.arange(len(points)) if steps is None else steps
    times = None if step is None else as_array(numbers * step)
    triangles, tets = boundary_faces(body.tets, body.num_vertices)
    motions = {}
    for b in range(points.shape[1]):
        of_scene = None if v is None else v.reshape(points.shape)[:, b]
        name = "motion" if points.shape[1] == 1 else f"scene {b}"
        motions[name] = Motion(points[:, b], triangles, times, body.body, tets, of_scene, numbers, b)
    return motions


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

    def write(new: Path) -> None:
        with new.open("wb") as file:  # numpy adds .npz to other names
            np.savez_compressed(file, **arrays)

    replace(Path(path), write)


def load_motions(path: str | PathLike[str]) -> dict[str, Motion]:
    """Motions by name from a file that :func:`save_motions` wrote.

    Raises:
        FileNotFoundError: no such file.
        ValueError: another content.
    """
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
