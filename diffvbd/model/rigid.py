"""Rigid bodies of a Model: which they are, masses that have their inertia, and sums over each of them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from .._common.checks import check_count, fail
from .._common.messages import warn
from ..mesh import TetMesh, arrays
from ..ops.sums import Rows

LEAST = 0.01  # factor of a lumped mass
EXACT = 1e-9  # relative error of masses, centers and inertias from which on a body counts as having its own


class RigidBodies(NamedTuple):
    """The bodies of a Model that move as wholes, R of them."""

    numbers: tuple[int, ...]  # as in Model.body
    mask: Tensor  # bool [V], their vertices
    order: Tensor  # int64 [n], the same, body by body
    rows: Rows  # n, by body
    weights: Tensor  # [V], of the lumped masses; 1 elsewhere

    def to(self, device: torch.device, dtype: torch.dtype) -> RigidBodies:
        moved = (self.mask.to(device), self.order.to(device), self.rows.to(device), self.weights.to(device, dtype))
        return RigidBodies(self.numbers, *moved)

    def translation(self, mass: Tensor, displacement: Tensor) -> Tensor:
        """Displacements [B, V, 3] with those of each rigid body replaced by their mean over its mass [1 | B, V]."""
        own = displacement[:, self.order]
        m = mass[:, self.order, None].expand(len(own), -1, 1)
        sums = self.rows.sum(torch.cat([m * own, m], -1))
        return self._put(displacement, self.rows.gather(sums[..., :3] / sums[..., 3:]))

    def balanced(self, x: Tensor, mass: Tensor, force: Tensor) -> Tensor:
        """Forces [B, V, 3] with those on each rigid body replaced by the inertial ones, m_i (F / M + a x r_i), of the
        same force and torque. x: [B, V, 3].  mass: [1 | B, V]."""
        own, at = force[:, self.order], x[:, self.order]
        m = mass[:, self.order, None].expand(len(own), -1, 1)

        def sums(values: Tensor) -> Tensor:
            return self.rows.sum(values.contiguous())

        arm = at - self.rows.gather(sums(m * at) / sums(m))
        torque, inertia = sums(torch.linalg.cross(arm, own)), sums(inertias(m, arm)).unflatten(-1, (3, 3))
        turn = (torch.linalg.pinv(inertia, hermitian=True) @ torque[..., None])[..., 0]
        spread = self.rows.gather(sums(own) / sums(m)) + torch.linalg.cross(self.rows.gather(turn), arm)
        return self._put(force, m * spread)

    def _put(self, values: Tensor, own: Tensor) -> Tensor:
        return values.index_copy(1, self.order, own)


def inertias(mass: Tensor, arm: Tensor) -> Tensor:
    """m (|r|^2 - r r^T) of masses [..., 1] at arms [..., 3], by rows [..., 9]."""
    square = arm.square().sum(-1)[..., None, None]
    eye = torch.eye(3, dtype=arm.dtype, device=arm.device)
    return (mass[..., None] * (square * eye - arm[..., :, None] * arm[..., None, :])).flatten(-2)


def rigid_bodies(given: Any, mesh: TetMesh, pinned: Tensor, density: Tensor) -> RigidBodies | None:
    """None: there is none. pinned bool [V], density [T], on the CPU.

    Raises:
        ValueError, TypeError: Where ``given`` is no sequence of bodies that may move as wholes.
    """
    if not isinstance(given, Sequence) or isinstance(given, str):
        raise TypeError(f"rigid: expected a sequence of numbers of bodies, got {type(given).__name__}")
    if not given:
        return None
    label = np.unique(mesh.body, return_inverse=True)[1].reshape(-1)
    parts = arrays.connected(mesh.tets, mesh.num_vertices)
    numbers, of = [], np.full(mesh.num_vertices, -1)
    weights = np.ones(mesh.num_vertices)
    for number in given:
        number = check_count("rigid", number, maximum=mesh.num_bodies - 1)
        if number in numbers:
            fail("rigid", "different numbers of bodies", f"{number} twice")
        vertices = np.flatnonzero(label == number)
        if pinned.numpy()[vertices].any():
            fail("rigid", "bodies without pinned vertices", f"body {number}, which has some")
        if (parts[vertices] != parts[vertices[0]]).any():
            fail("rigid", "bodies whose tets are connected", f"body {number}, which has loose parts")
        of[vertices] = len(numbers)
        weights[vertices] = _weights(number, mesh, vertices, density.numpy())
        numbers.append(number)
    mask = torch.from_numpy(of >= 0)
    order = torch.from_numpy(np.argsort(np.where(of < 0, len(numbers), of), kind="stable")[: int(mask.sum())])
    rows = Rows.of(torch.from_numpy(of)[order], len(numbers))
    return RigidBodies(tuple(numbers), mask, order, rows, torch.from_numpy(weights))


def _weights(number: int, mesh: TetMesh, vertices: np.ndarray, density: np.ndarray) -> np.ndarray:
    """Factors of the lumped masses of a body with which mass, center and inertia are those of its tets, near 1 and not
    below LEAST. Where the vertices lie so that there are none, they are 1."""
    rows = np.isin(mesh.tets[:, 0], vertices)
    tets, m = mesh.tets[rows], density[rows] * mesh.volume[rows]
    low, high = mesh.points[vertices].min(0), mesh.points[vertices].max(0)
    x = (mesh.points - (low + high) / 2) / max(float((high - low).max()), 1e-300)
    mass = np.bincount(tets.reshape(-1), np.repeat(m / 4, 4), len(x))[vertices]

    def terms(p: np.ndarray) -> np.ndarray:
        a, b, c = p.T
        return np.stack([np.ones_like(a), a, b, c, a * a, a * b, a * c, b * b, b * c, c * c], 1)

    # squares are integrated exactly by a tet's corners, of weight 1/20 each, and its center, of weight 4/5
    corners = x[tets]
    wanted = m @ (terms(corners.reshape(-1, 3)).reshape(-1, 4, 10).sum(1) / 20 + 0.8 * terms(corners.mean(1)))
    own = terms(x[vertices])
    factors, free = np.full(len(mass), LEAST), np.ones(len(mass), bool)
    while free.any():
        m, a = mass[free], own[free]
        missing = wanted - (mass * np.where(free, 1.0, LEAST)) @ own
        factors[free] = 1 + a @ (np.linalg.pinv(a.T @ (m[:, None] * a), hermitian=True) @ missing)
        if not (factors < LEAST).any():
            break
        free &= factors >= LEAST
        factors[~free] = LEAST
    if np.abs((mass * factors) @ own - wanted).max() < EXACT * wanted[0]:
        return factors
    off = np.abs(mass @ own - wanted)[4:].max() / (wanted[4] + wanted[7] + wanted[9])
    warn(f"rigid: body {number} has its mass at its vertices, by which its inertia is up to {off:.0%} of itself off; "
         "with more vertices inside it is exact")  # fmt: skip
    return np.ones(len(vertices))
