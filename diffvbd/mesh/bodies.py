"""Procedural bodies of smooth shape, filled with tets by `fill`. Lengths are in metres and y points up."""

from __future__ import annotations

from functools import reduce

import numpy as np

from diffvbd.mesh.arrays import FloatArray, float_array
from diffvbd.mesh.implicit import fill
from diffvbd.mesh.shapes import count, positive
from diffvbd.mesh.tet_mesh import TetMesh


def capsule(radius: float = 0.1, length: float = 0.3, resolution: int = 6) -> TetMesh:
    """Cylinder with round ends, axis along y, centred at the origin.

    Args:
        radius: [m].  length: Of the cylindrical part [m]; 0 gives a ball.
        resolution: Lattice cells across the diameter, at least 3.

    Raises:
        TypeError, ValueError: radius not positive, length negative, resolution below 3.
    """
    radius, cells = positive("radius", radius), count("resolution", resolution, 3)
    half = float(float_array("length", length, ())) / 2
    if half < 0:
        raise ValueError(f"length: expected 0 or more, got {2 * half:.6g}")

    def body(points: FloatArray) -> FloatArray:
        to_axis = points.copy()
        to_axis[:, 1] -= np.clip(points[:, 1], -half, half)
        return np.linalg.norm(to_axis, axis=1) - radius

    corner = np.array([radius, half + radius, radius])
    return fill(body, -corner, corner, 2 * radius / cells)


def blob(resolution: int = 7, seed: int = 0, radius: float = 0.15) -> TetMesh:
    """Smooth random body around the origin: a ball whose radius varies with direction by at most a quarter.

    Args:
        resolution: Lattice cells across the mean diameter, at least 4.
        seed: Equal seeds give equal bodies.
        radius: Mean radius [m], about.

    Raises:
        TypeError, ValueError: resolution below 4, a seed that is negative or no integer, radius not positive.
    """
    radius, cells = positive("radius", radius), count("resolution", resolution, 4)
    random = np.random.default_rng(count("seed", seed, 0))
    waves, phases = random.normal(scale=2.0, size=(6, 3)), random.uniform(0, 2 * np.pi, size=6)
    weights = random.dirichlet(np.ones(6)) * 0.25

    def body(points: FloatArray) -> FloatArray:
        distance = np.linalg.norm(points, axis=1)
        direction = points / np.maximum(distance, 1e-12 * radius)[:, None]
        return distance - radius * (1 + np.cos(direction @ waves.T + phases) @ weights)

    corner = np.full(3, 1.25 * radius)
    return fill(body, -corner, corner, 2 * radius / cells)


def bunny(resolution: int = 9, height: float = 0.3) -> TetMesh:
    """Rabbit made of five blended ellipsoids (body, head, two ears, tail), sitting on y = 0 and looking along x.

    Args:
        resolution: Lattice cells over the height, at least 8. The default, 9, has 341 vertices and 1,155 tets.
        height: From the floor to the tips of the ears [m], about.

    Raises:
        TypeError, ValueError: resolution below 8, height not positive.
    """
    cells, scale = count("resolution", resolution, 8), positive("height", height) / 1.15

    def body(points: FloatArray) -> FloatArray:
        unit = points / scale
        parts = [
            _ellipsoid(unit, (0.0, 0.28, 0.0), (0.4, 0.28, 0.26)),
            _ellipsoid(unit, (0.3, 0.58, 0.0), (0.21, 0.19, 0.18)),
            _ellipsoid(unit, (0.2, 0.9, 0.11), (0.1, 0.27, 0.08), tilt=0.2),
            _ellipsoid(unit, (0.2, 0.9, -0.11), (0.1, 0.27, 0.08), tilt=0.2),
            _ellipsoid(unit, (-0.4, 0.3, 0.0), (0.12, 0.12, 0.12)),
        ]
        return reduce(_blend, parts)

    low, high = np.array([-0.56, -0.03, -0.3]), np.array([0.56, 1.17, 0.3])
    return fill(body, scale * low, scale * high, scale * 1.15 / cells)


def _ellipsoid(
    points: FloatArray, centre: tuple[float, float, float], radii: tuple[float, float, float], tilt: float = 0.0
) -> FloatArray:
    """Implicit ellipsoid, turned about z by `tilt` [rad]; near its surface about a distance."""
    cos, sin = np.cos(tilt), np.sin(tilt)
    local = (points - np.array(centre)) @ np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    return (np.linalg.norm(local / np.array(radii), axis=1) - 1) * min(radii)


def _blend(a: FloatArray, b: FloatArray, width: float = 0.06) -> FloatArray:
    """Union of two bodies whose seam is rounded over `width`: a smooth minimum."""
    overlap = np.maximum(width - np.abs(a - b), 0) / width
    return np.minimum(a, b) - width / 4 * overlap**2
