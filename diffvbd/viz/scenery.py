"""Floors and colliders of a Model as things to draw."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..checks import fail
from ..contact.colliders import Capsule, Plane, Sphere
from ..model.model import Model
from .drawing import SCENERY, Scenery, as_array, capsule

FLOOR = "#dcdad5"
REACH = 2.5  # planes are shown so far around a scene, in its radii


def scenery_of(
    model: Model,
    low: NDArray[np.float64],
    high: NDArray[np.float64],
    colliders: Any = None,
) -> tuple[Scenery, ...]:
    """Floors and colliders around a scene between two corners [m].

    Args:
        model: The scene.
        low, high: Its lowest and highest corner [m], shape [3].
        colliders: Where the corner points of the colliders are in each frame [m], shape [N, Vc, 3]; None: at rest.

    Raises:
        ValueError: colliders of another shape.
    """
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
    rows_of = model.collider_rows if model.colliders else ()
    for collider, rows in zip(model.colliders, rows_of, strict=True):
        frames = moved[..., rows, :]
        if isinstance(collider, Plane):
            corners = frames if frames.ndim == 2 else frames[0]
            across = np.cross(corners[1] - corners[0], corners[2] - corners[0])
            unit = across / np.linalg.norm(across)
            things.append(plane(corners[0], unit, middle, reach))
        elif isinstance(collider, (Sphere, Capsule)):
            ends = frames[None] if frames.ndim == 2 else frames
            shapes = [capsule(each[0], each[-1], collider.radius) for each in ends]
            points = np.stack([shape.points for shape in shapes])
            things.append(Scenery(points[0] if frames.ndim == 2 else points, shapes[0].triangles, SCENERY))
        else:
            things.append(Scenery(frames, collider.corners().triangles, SCENERY))
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
