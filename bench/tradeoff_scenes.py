"""Scenes of `bench tradeoff`, from soft to extreme."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

import diffvbd as dv
from bench.advice_scenes import Scene
from diffvbd import mesh

DHAT = 2e-3  # [m]
ELASTIC = dv.StableNeoHookean()


def cantilever(mu: float, poisson: float = 1 / 3, contrast: float = 1.0, speed: float = 0.0, name: str = "") -> Scene:
    """A beam of 0.6 m held at one end, some swings of it. contrast: of its two halves' stiffness, in layers; speed:
    of its free end at first [m/s], where it would hardly sag."""
    body = mesh.beam(13, 4, 4, size=(0.6, 0.15, 0.15), split="kuhn")
    model = dv.Model(body, pinned=torch.tensor(body.points[:, 0] < 1e-9))
    lam = 2 * mu * poisson / (1 - 2 * poisson)
    share = np.where(body.points[body.tets].mean(1)[:, 1] > 0.075, 1.0, 1 / contrast)
    scale = torch.tensor(share) if contrast > 1 else torch.tensor(1.0, dtype=torch.float64)
    swing = math.sqrt(1e5 / mu)
    duration = float(np.clip(0.4 * swing, 0.02, 0.4))
    v = torch.zeros_like(model.rest_points)
    v[:, 1] = speed * (model.rest_points[:, 0] / 0.6) ** 2
    material = {"mu": mu * scale, "lam": lam * scale}
    return Scene(name or f"cantilever, mu = {mu:.0e} Pa", model, v, duration, material)


def cloth() -> Scene:
    """A sheet of 0.3 m, 15 mm thick, held at two corners."""
    body = mesh.sheet(12, 12, (0.3, 0.3), 0.015)
    points = torch.tensor(body.points)
    corner = (points[:, 0] < 1e-9) & ((points[:, 2] < 0.02) | (points[:, 2] > 0.28))
    model = dv.Model(body, pinned=corner)
    return Scene("cloth of 15 mm", model, torch.zeros_like(model.rest_points), 0.3, {"mu": 3e4, "lam": 3e4})


def twist() -> Scene:
    """A bar whose ends are turned against each other by half a turn in 0.3 s."""
    body = mesh.beam(13, 4, 4, size=(0.6, 0.15, 0.15), split="kuhn")
    rest = torch.tensor(body.points)
    left, right = rest[:, 0] < 1e-9, rest[:, 0] > 0.6 - 1e-9
    model = dv.Model(body, pinned=left | right)
    middle = torch.tensor([0.0, 0.075, 0.075], dtype=rest.dtype)

    def turned(t: float) -> Tensor:
        angle = math.pi / 2 * t / 0.3
        out = rest.clone()
        for end, sign in ((left, -1.0), (right, 1.0)):
            arm = rest[end] - middle
            c, s = math.cos(sign * angle), math.sin(sign * angle)
            out[end, 1] = middle[1] + c * arm[:, 1] - s * arm[:, 2]
            out[end, 2] = middle[2] + s * arm[:, 1] + c * arm[:, 2]
        return out

    return Scene("twist by half a turn", model, torch.zeros_like(rest), 0.3,
                 {"mu": 1e5, "lam": 2e5, "prescribed": turned})  # fmt: skip


def drop() -> Scene:
    """A soft ball that falls 1 cm on a floor at 1 m/s, and rises."""
    body = mesh.blob(5, 1, 0.1)
    body = body.translate((0, 0.01 + DHAT - body.points[:, 1].min(), 0))
    model = dv.Model(body, energies=(ELASTIC, dv.FloorBarrier(kappa=1e3, dhat=DHAT)))
    v = torch.zeros_like(model.rest_points)
    v[:, 1] = -1.0
    return Scene("drop on a floor", model, v, 0.1, {"young": 1e5, "poisson": 0.3})


def pile(**barrier: Any) -> Scene:
    """Three boxes that fall on each other and on a floor, with friction."""
    rng, box = np.random.default_rng(1), mesh.box(3, 0.1, split="kuhn")
    shifts = [(float(x), 0.005 + 0.105 * n, float(z)) for n, (x, z) in enumerate(rng.uniform(-0.01, 0.01, (3, 2)))]
    pairs = dv.PairBarrier(**{"kappa": 1e4, "dhat": DHAT, "self_contact": False} | barrier)
    energies = (ELASTIC, pairs, dv.Friction(0.4), dv.FloorBarrier(kappa=1e4, dhat=DHAT))
    model = dv.Model(mesh.join([box.translate(shift) for shift in shifts]), energies=energies)
    return Scene("pile of three boxes", model, torch.zeros_like(model.rest_points), 0.15, {"mu": 1e5, "lam": 2e5})


def gripper(n: int = 3, plates: tuple[int, int, int] = (2, 3, 3), **barrier: Any) -> Scene:
    """A cube between two plates that close in 0.05 s and lift it with the speed that they have reached, by friction.

    Args:
        n, plates: Vertices along the edges of the cube and of the plates.
    """
    size, thick = 0.05, 0.02
    cube, plate = mesh.box(n, size, split="kuhn"), mesh.box(plates, (thick, 0.06, 0.06), split="kuhn")
    sides = [plate.translate((x, y, -0.005)) for x, y in ((-thick - DHAT, -0.0052), (size + DHAT, -0.0049))]
    body = mesh.join([cube, *sides])
    x = torch.tensor(body.points)
    outer = (x[:, 0] < -thick - 0.5 * DHAT) | (x[:, 0] > size + thick + 0.5 * DHAT)
    outer[: cube.num_vertices] = False
    pairs = dv.PairBarrier(**{"kappa": 1e4, "dhat": DHAT, "self_contact": False} | barrier)
    model = dv.Model(body, pinned=outer, energies=(ELASTIC, pairs, dv.Friction(0.8)))
    inward = torch.where(outer, torch.where(x[:, 0] < 0, 1.0, -1.0), 0.0)

    def clamps(t: float) -> Tensor:
        out = x.clone()
        out[:, 0] += 1.5e-3 * min(1.0, t / 0.05) * inward
        out[:, 1] += torch.where(outer, 0.3 * max(0.0, t - 0.05), 0.0)
        return out

    return Scene("gripper", model, torch.zeros_like(x), 0.15, {"mu": 1e5, "lam": 2e5, "prescribed": clamps})


SCENES: dict[str, Callable[[], Scene]] = {
    "soft": lambda: cantilever(1e4),
    "stiff": lambda: cantilever(1e8, speed=5.0),
    "cloth": cloth,
    "contrast": lambda: cantilever(1e5, contrast=1e6, name="contrast 1e6"),
    "incompressible": lambda: cantilever(1e5, poisson=0.4999, name="nu = 0.4999"),
    "twist": twist,
    "drop": drop,
    "pile": pile,
    "gripper": gripper,
}
