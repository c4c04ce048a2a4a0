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
from ..ops.sums import Rows, one_thread

LEAST = 0.01  # factor of a lumped mass
EXACT = 1e-9  # relative error of masses, centers and inertias up to which they count as right


class Masses(NamedTuple):
    """How the masses of the vertices of a rigid body, n of them, follow from the masses of its tets, t of them: the
    lumped ones, and what makes mass, center and inertia those of the tets, for any density. With one far from the
    Model's some may be negative, which sums over the body alone do not mind."""

    vertices: Tensor  # int64 [n]
    tets: Tensor  # int64 [t]
    factor: Tensor  # [n], of the lumped masses
    terms: Tensor  # [n, 10], polynomials of degree 2 at the vertices
    integrals: Tensor  # [t, 10], their means over the tets
    change: Tensor  # [n, 10], of the masses for what is missing of the integrals


class RigidBodies(NamedTuple):
    """The bodies of a Model that move as wholes, R of them."""

    numbers: tuple[int, ...]  # as in Model.body
    mask: Tensor  # bool [V], their vertices
    order: Tensor  # int64 [n], the same, body by body
    rows: Rows  # n, by body
    of_tets: tuple[Masses, ...]

    def to(self, device: torch.device, dtype: torch.dtype) -> RigidBodies:
        def placed(t: Tensor) -> Tensor:
            return t.to(device, dtype) if t.is_floating_point() else t.to(device)

        masses = tuple(Masses(*map(placed, m)) for m in self.of_tets)
        return RigidBodies(self.numbers, placed(self.mask), placed(self.order), self.rows.to(device), masses)

    def masses(self, lumped: Tensor, of_tets: Tensor) -> Tensor:
        """Lumped masses [B, V] with those of rigid bodies exchanged, of tets of masses [B, T]; linear in these."""
        for m in self.of_tets:
            own = m.factor.to(lumped) * lumped[:, m.vertices]
            with one_thread(lumped):
                missing = of_tets[:, m.tets] @ m.integrals.to(lumped) - own @ m.terms.to(lumped)
                lumped = lumped.index_copy(1, m.vertices, own + missing @ m.change.to(lumped).T)
        return lumped

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
    if not isinstance(given, Sequence) or isinstance(given, str | bytes):
        raise TypeError(f"rigid: expected a sequence of numbers of bodies, got {type(given).__name__}")
    if not given:
        return None
    label = np.unique(mesh.body, return_inverse=True)[1].reshape(-1)
    parts = arrays.connected(mesh.tets, mesh.num_vertices)
    numbers, of, masses = [], np.full(mesh.num_vertices, -1), []
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
        masses.append(_masses(number, mesh, vertices, density.numpy()))
        numbers.append(number)
    mask = torch.from_numpy(of >= 0)
    order = torch.from_numpy(np.argsort(np.where(of < 0, len(numbers), of), kind="stable")[: int(mask.sum())])
    return RigidBodies(tuple(numbers), mask, order, Rows.of(torch.from_numpy(of)[order], len(numbers)), tuple(masses))


def _masses(number: int, mesh: TetMesh, vertices: np.ndarray, density: np.ndarray) -> Masses:
    """Of all masses with the right mass, center and inertia those nearest to the lumped ones, and none below a share
    LEAST of its own, with the Model's density. Where the vertices lie so that there are none, the lumped ones."""
    tets = np.flatnonzero(np.isin(mesh.tets[:, 0], vertices))
    m = density[tets] * mesh.volume[tets]
    low, high = mesh.points[vertices].min(0), mesh.points[vertices].max(0)
    x = (mesh.points - (low + high) / 2) / max(float((high - low).max()), 1e-300)
    corners = mesh.tets[tets]
    mass = np.bincount(corners.reshape(-1), np.repeat(m / 4, 4), len(x))[vertices]

    def terms(p: np.ndarray) -> np.ndarray:
        a, b, c = p.T
        return np.stack([np.ones_like(a), a, b, c, a * a, a * b, a * c, b * b, b * c, c * c], 1)

    # squares are integrated exactly by a tet's corners, of weight 1/20 each, and its center, of weight 4/5
    at = x[corners]
    integrals = terms(at.reshape(-1, 3)).reshape(-1, 4, 10).sum(1) / 20 + 0.8 * terms(at.mean(1))
    own, wanted = terms(x[vertices]), m @ integrals
    factor, free, change = np.ones(len(mass)), np.ones(len(mass), bool), np.zeros_like(own)
    while free.any():
        weighted = np.where(free, mass, 0.0)[:, None] * own
        change = weighted @ np.linalg.pinv(own.T @ weighted, hermitian=True)
        made = factor * mass + change @ (wanted - (factor * mass) @ own)
        if not (free & (made < LEAST * mass)).any():
            break
        free &= made >= LEAST * mass
        factor[~free] = LEAST
    if not np.abs((factor * mass + change @ (wanted - (factor * mass) @ own)) @ own - wanted).max() < EXACT * wanted[0]:
        factor, change = np.ones(len(mass)), np.zeros_like(own)
        off = np.abs(mass @ own - wanted)[4:].max() / max(wanted[[4, 7, 9]].min(), 1e-300)
        warn(f"rigid: the inertia of body {number} is wrong by up to {off:.0%}, since no vertex, or too few, lie "
             "inside it; a mesh with three or more points along each edge has the exact one")  # fmt: skip
    return Masses(*map(torch.from_numpy, (vertices, tets, factor, own, integrals, change)))
