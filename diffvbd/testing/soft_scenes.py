"""Scenes of statics, damping, muscles and couplings that tests and benchmarks share."""

from __future__ import annotations

import numpy as np

from .. import mesh
from ..couplings import Tendons
from ..embedding import Embedding
from ..energies import StableNeoHookean
from ..model.model import Model


def finger(nodes: tuple[int, int, int], size: tuple[float, float, float], points: int, k: float) -> Model:
    """A beam along x with a tendon along its upper side."""
    tets = mesh.beam(*nodes, size=size)
    route = np.stack([np.linspace(0, size[0], points), np.full(points, size[1]), np.full(points, size[2] / 2)], 1)
    tendon = Tendons(Embedding.of_points(tets, route), [range(points)], k, size[0])
    return Model(tets, pinned=tets.points[:, 0] < 1e-9, energies=(StableNeoHookean(), tendon))


def icosphere(levels: int) -> tuple[np.ndarray, np.ndarray]:
    """Points and triangles of a unit sphere."""
    t = (1 + 5**0.5) / 2
    signs = np.array([[-1, t], [1, t], [-1, -t], [1, -t]])
    zero = np.zeros((4, 1))
    points = np.concatenate([np.hstack([signs, zero]), np.hstack([zero, signs]), np.hstack([signs[:, 1:], zero,
                                                                                          signs[:, :1]])])  # fmt: skip
    distance = np.linalg.norm(points[:, None] - points, axis=-1)
    near = np.isclose(distance, 2.0)
    triangles = [(i, j, k) for i in range(12) for j in range(i) for k in range(j) if near[i, j] and near[j, k]
                 and near[i, k]]  # fmt: skip
    faces = np.array(triangles)
    a, b, c = (points[faces[:, k]] for k in range(3))
    inward = np.einsum("ni,ni->n", np.cross(b - a, c - a), a) < 0
    faces[inward] = faces[inward][:, ::-1]
    for _ in range(levels):
        sides = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
        edges, inverse = np.unique(sides, axis=0, return_inverse=True)
        (a, b, c), (ab, bc, ca) = faces.T, len(points) + inverse.reshape(3, -1)
        points = np.concatenate([points, points[edges].mean(1)])
        faces = np.concatenate([np.stack(f, 1) for f in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))])
    return points / np.linalg.norm(points, axis=1, keepdims=True), faces


def pressed_sphere(young: float, poisson: float, pressure: float, thickness: float) -> float:
    """Growth [m] of the middle radius, 1 m, of a sphere under pressure (Lame's thick sphere)."""
    a, b = 1 - thickness / 2, 1 + thickness / 2
    return pressure * a**3 / (young * (b**3 - a**3)) * ((1 - 2 * poisson) + (1 + poisson) * b**3 / 2)
