"""Obstacles that soft bodies touch and do not move: planes, spheres, capsules, triangle meshes.

A collider stands in ``Model(colliders=[...])`` and meets the bodies through the Model's PairBarrier. Its corner points
are rows of ``model.collider_points`` (:attr:`Model.collider_rows` says which); a step that is given other points moves
it, and differentiates toward them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .._common.checks import check_positive, fail
from ..mesh.arrays import float_array, int_array
from ..mesh.surfaces import surface_arrays

MOST_LENGTH = 1e9  # [m] of coordinates and radii: fourth powers of distances must be numbers in float32


class Corners(NamedTuple):
    """Geometry of a collider; indices are into ``points``."""

    points: NDArray[np.float64]  # [n, 3] [m]
    triangles: NDArray[np.int64]  # [F, 3]
    edges: NDArray[np.int64]  # [E, 2]
    lone: NDArray[np.int64]  # [P] points that meet triangles
    plane: bool  # the three points span a plane
    radius: float  # [m] that its surface lies outside


_NONE = np.zeros(0, np.int64)


def _place(name: str, value: Any, shape: tuple[int | None, ...] = (3,)) -> NDArray[np.float64]:
    """Coordinates [m]."""
    out = float_array(name, value, shape)
    if out.size and np.abs(out).max() > MOST_LENGTH:
        fail(name, f"coordinates of at most {MOST_LENGTH:g} m", f"{out.flat[np.abs(out).argmax()]:g}")
    return out


def _radius(value: Any) -> float:
    radius = check_positive("radius", value, "m")
    if radius > MOST_LENGTH:
        fail("radius", f"at most {MOST_LENGTH:g} m", f"{radius:g}")
    return radius


def _corners(points: Any, triangles: Any = None, edges: Any = None, lone: Any = None, **options: Any) -> Corners:
    parts = [
        np.asarray(_NONE if part is None else part, np.int64).reshape(-1, width)
        for part, width in ((triangles, 3), (edges, 2))
    ]
    lone = _NONE if lone is None else np.asarray(lone, np.int64)
    return Corners(points, parts[0], parts[1], lone, options.get("plane", False), options.get("radius", 0.0))


@dataclass(frozen=True, eq=False)
class Plane:
    """The half-space below a plane. Three corner points span it: ``point`` and two at 1 m from it.

    A fixed plane costs less as a :class:`diffvbd.FloorBarrier`, which needs no detection.

    Args:
        point: On the plane [m], 3 numbers.  normal: Toward the free side, 3 numbers, not zero.
    """

    point: Sequence[float] = (0.0, 0.0, 0.0)
    normal: Sequence[float] = (0.0, 1.0, 0.0)

    def corners(self) -> Corners:
        point, normal = _place("point", self.point), float_array("normal", self.normal, (3,))
        if not np.abs(normal).max() > 0:
            fail("normal", "a vector that is not zero", self.normal)
        normal /= np.abs(normal).max()
        size = np.linalg.norm(normal)
        first = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
        first /= np.linalg.norm(first)
        second = np.cross(normal / size, first)
        return _corners(np.stack([point, point + first, point + second]), plane=True)


@dataclass(frozen=True, eq=False)
class Sphere:
    """A ball; its corner point is the center.

    Args:
        center: [m], 3 numbers.  radius: [m] > 0.
    """

    center: Sequence[float] = (0.0, 0.0, 0.0)
    radius: float = 1.0

    def corners(self) -> Corners:
        center = _place("center", self.center)
        return _corners(center[None], lone=[0], radius=_radius(self.radius))


@dataclass(frozen=True, eq=False)
class Capsule:
    """All points within ``radius`` of a segment; its corner points are the ends.

    Args:
        a, b: Ends of the segment [m], 3 numbers each, not equal.  radius: [m] > 0.
    """

    a: Sequence[float] = (0.0, -0.5, 0.0)
    b: Sequence[float] = (0.0, 0.5, 0.0)
    radius: float = 0.25

    def corners(self) -> Corners:
        ends = np.stack([_place("a", self.a), _place("b", self.b)])
        if not np.linalg.norm(ends[1] - ends[0]) > 0:
            fail("b", "an end apart from a (a Sphere has one point)", self.b)
        return _corners(ends, edges=[[0, 1]], lone=[0, 1], radius=_radius(self.radius))


@dataclass(frozen=True, eq=False)
class Obstacle:
    """A triangle mesh, open or closed; both sides collide.

    Args:
        points: [n, 3] [m].  triangles: Indices [F, 3]. Or ``points`` alone: the file of a surface in metres, or a mesh
            of trimesh or pyvista.
    """

    points: Any = None
    triangles: Any = None

    def corners(self) -> Corners:
        if self.triangles is None and self.points is not None:
            points, triangles = surface_arrays(self.points)
            points = _place("points", points, (None, 3))
        else:
            points = _place("points", self.points, (None, 3))
            triangles = int_array("triangles", self.triangles, (None, 3))
        if triangles.size == 0:
            fail("triangles", "at least one", 0)
        if triangles.min() < 0 or triangles.max() >= len(points):
            fail("triangles", f"indices in [0, {len(points)})", f"{triangles.min()}..{triangles.max()}")
        sides = points[triangles]
        area = np.linalg.norm(np.cross(sides[:, 1] - sides[:, 0], sides[:, 2] - sides[:, 0]), axis=1)
        if not (area > 0).all():
            fail("triangles", "triangles with an area", f"none at {int((area <= 0).argmax())}")
        return _corners(points, triangles, unique_edges(triangles), np.unique(triangles))


Collider = Plane | Sphere | Capsule | Obstacle


def unique_edges(triangles: NDArray[np.int64]) -> NDArray[np.int64]:
    """Edges [E, 2] of triangles [F, 3], each once, the smaller index first."""
    pairs = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    return np.unique(np.sort(pairs, 1), axis=0)


def mean_edges(points: NDArray[np.float64], edges: NDArray[np.int64], body: NDArray[np.int64], bodies: int
               ) -> NDArray[np.float64]:  # fmt: skip
    """Mean length of the edges of each body [bodies] [m], 0 where it has none; body: Of each point."""
    first, second = edges.T
    lengths = np.linalg.norm(points[first] - points[second], axis=1)
    total, number = (np.bincount(body[first], weights, bodies) for weights in (lengths, None))
    return total / np.maximum(number, 1)


__all__ = ["Capsule", "Obstacle", "Plane", "Sphere"]
