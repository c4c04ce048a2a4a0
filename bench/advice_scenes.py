"""Scenes of `bench advice`, drawn by a seed: meshes, materials over five decades, with and without contact.

Barriers are drawn as well, one to ten times as stiff as it takes that kappa dhat^2 is the kinetic energy of a vertex:
what meets a much weaker one stops at gaps that no time step resolves.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

import diffvbd as dv
from diffvbd import mesh

SEED = 20_261_125  # of no scene that the search was tuned on
DHAT = 2e-3  # [m]


@dataclass(frozen=True)
class Scene:
    name: str
    model: dv.Model
    v: Tensor  # [V, 3] [m/s]
    duration: float  # [s]
    given: dict[str, Any]

    @property
    def touches(self) -> bool:
        return self.model.contact is not None or self.model.floor is not None


def _body(rng: np.random.Generator) -> tuple[str, dv.TetMesh]:
    kind = ("beam", "sheet", "blob", "box")[rng.integers(4)]
    if kind == "beam":
        n = int(rng.integers(2, 4))
        return kind, mesh.beam(
            int(rng.integers(5, 12)), n, n, size=(float(rng.uniform(0.2, 0.8)), 0.1, 0.1), split="kuhn"
        )
    if kind == "sheet":
        return kind, mesh.sheet(8, 8, (0.3, 0.3), float(rng.uniform(0.01, 0.04)))
    if kind == "blob":
        return kind, mesh.blob(5, int(rng.integers(100)), 0.1)
    return kind, mesh.box(int(rng.integers(2, 5)), 0.1, split="kuhn")


def _kappa(rng: np.random.Generator, body: dv.TetMesh, speed: float) -> float:
    """Stiffness of a barrier [N/m]."""
    mass = float(dv.Model(body).mass.mean())
    return 10 ** float(rng.uniform(0, 1)) * 0.5 * mass * speed**2 / DHAT**2


def drawn(number: int) -> Scene:
    """Scene `number` of the seed: every third falls on a floor, or meets another body."""
    rng = np.random.default_rng((SEED, number))
    kind, body = _body(rng)
    young, poisson = float(10 ** rng.uniform(3.5, 8.5)), float(rng.uniform(0.1, 0.47))
    material: dict[str, Any] = {"young": young, "poisson": poisson}
    contact = ("none", "none", "floor", "none", "none", "pairs")[number % 6]
    size = float(np.ptp(body.points, axis=0).max())
    # some swings of the slowest kind, as far as it is known beforehand
    wave = size / np.sqrt(young / 1000.0)
    duration = float(np.clip(rng.uniform(4, 20) * wave, 0.02, 0.4))
    if contact == "none":
        pinned = body.points[:, 0] < body.points[:, 0].min() + 1e-6
        turn = bool(rng.integers(2)) and kind in ("blob", "box")
        model = dv.Model(body, pinned=None if turn else pinned)
        v = torch.zeros_like(model.rest_points)
        if turn:  # free: it spins and quivers
            arm = model.rest_points - model.rest_points.mean(0)
            v = torch.linalg.cross(torch.tensor(rng.standard_normal(3) * 10).expand_as(arm), arm) + 2.0 * arm
    elif contact == "floor":
        speed, low = float(rng.uniform(0.5, 2.0)), body.points[:, 1].min()
        floor = dv.FloorBarrier(low - 0.01, kappa=_kappa(rng, body, speed), dhat=DHAT)
        model = dv.Model(body, energies=(dv.StableNeoHookean(), floor))
        v = torch.zeros_like(model.rest_points)
        v[:, 1] = -speed
        duration = 0.1
    else:
        other = body.translate((0.004 + float(np.ptp(body.points[:, 0])), 0.007, 0.003))
        speed = float(rng.uniform(0.3, 1.5))
        pairs = dv.PairBarrier(kappa=_kappa(rng, body, speed), dhat=DHAT)
        model = dv.Model(mesh.join([body, other]), energies=(dv.StableNeoHookean(), pairs))
        v = torch.zeros_like(model.rest_points)
        v[: body.num_vertices, 0] = speed
        material["gravity"] = (0.0, 0.0, 0.0)
        duration = 0.06
    vertices = model.num_vertices
    return Scene(f"{number}: {kind}, {vertices} vertices, {young:.1g} Pa, {contact}", model, v, duration, material)
