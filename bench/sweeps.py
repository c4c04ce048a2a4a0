"""Speed against accuracy: time of a step and error of its result over sweeps K and relaxation."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

import diffvbd as dv
from bench.measure import Card, least, timed
from bench.tables import Table

SWEEPS = (5, 10, 20, 50, 100, 200, 500, 1000)
RELAXATIONS = (1.0, 1.6)
MATERIAL = {"mu": 1e5, "lam": 1.5e5}
STEP = 1 / 60


def bar() -> dv.Model:
    """A bar of 1 m, 11 layers of vertices, held at its upper end."""
    mesh = dv.mesh.beam(11, 3, 3, size=(1.0, 0.2, 0.2), split="kuhn")
    # x is the long axis of beam(); turned so that it hangs down
    points = np.stack([mesh.points[:, 1], -mesh.points[:, 0], mesh.points[:, 2]], -1)
    mesh = dv.TetMesh(points, mesh.tets, orient=True)
    return dv.Model(mesh, pinned=points[:, 1] > -1e-9)


def solver(h: float, sweeps: int, relaxation: float = 1.0) -> dv.VBD:
    return dv.VBD(h, sweeps, relaxation=relaxation, start="predictor")


def hanging_bar(sweeps: tuple[int, ...], quick: bool) -> list[dict[str, Any]]:
    """Elongation at which the executed steps come to rest, against equilibrium, for two time steps.

    Unconverged sweeps leave part of each step's fall h^2 g, so the bar settles too low: a bias, not noise.
    """
    start = _equilibrium(MATERIAL, quick)
    cases = [(h, omega, k) for h in ((STEP,) if quick else (STEP, 0.1)) for omega in RELAXATIONS for k in sweeps]
    return [_at_rest(start, solver(h, k, omega), MATERIAL, quick) for h, omega, k in cases]


def equal_work(quick: bool) -> list[dict[str, Any]]:
    """The bar made 100 times stiffer, 100 sweeps per 1/60 s: few long steps or many short ones."""
    material = {k: 100 * value for k, value in MATERIAL.items()}
    start = _equilibrium(material, quick)
    parts = (1, 20) if quick else (1, 2, 5, 20, 100)
    return [_at_rest(start, solver(STEP / n, 100 // n), material, quick) for n in parts]


def _equilibrium(material: dict[str, float], quick: bool) -> Tensor:
    """Positions of the bar at rest, by steps whose sweeps have converged."""
    long = solver(0.1, 500 if quick else 20_000, 1.6)
    return _settle(bar(), bar().rest_points, long, 20 if quick else 100, material)[1]


def _at_rest(start: Tensor, solver: dv.VBD, material: dict[str, float], quick: bool) -> dict[str, Any]:
    model = bar()
    before, after = _settle(model, start, solver, 60 if quick else 5000, material)
    still = torch.zeros_like(before)
    left = dv.diagnose(model, after, solver, previous=(before, still), warn=False, **material)
    seconds = least(lambda: timed(lambda: dv.step(model, model.rest_points, still, solver, **material)), 7)
    return {
        "mu": material["mu"],
        "time_step": solver.time_step,
        "relaxation": solver.relaxation,
        "sweeps": solver.sweeps,
        "ms_per_step": 1e3 * seconds,
        "elongation": float(-1.0 - after[:, 1].min()),
        "error": float((1.0 + after[:, 1].min()) / (1.0 + start[:, 1].min())) - 1,
        "unbalanced": left.unbalanced,
        "courant": left.courant,
    }


def _settle(model: dv.Model, start: Tensor, solver: dv.VBD, steps: int, material: dict[str, float]
            ) -> tuple[Tensor, Tensor]:  # fmt: skip
    """The last two positions of up to `steps` steps without inertia."""
    before = after = checked = start
    for n in range(1, steps + 1):
        before = after
        after, _ = dv.step(model, before, torch.zeros_like(before), solver, **material)
        if n % 20 == 0:
            if float((after - checked).abs().max()) < 1e-9:
                break
            checked = after
    return before, after


def counts(card: Card) -> tuple[int, ...]:
    return (5, 50) if card.quick else SWEEPS


GROUPS: dict[str, Callable[[Card], list[dict[str, Any]]]] = {
    "hanging_bar": lambda card: hanging_bar(counts(card), card.quick),
    "equal_work": lambda card: equal_work(card.quick),
}
TABLES = (
    Table("Hanging bar of 1 m: elongation at rest against equilibrium", "hanging_bar"),
    Table("The same bar 100 times stiffer, 100 sweeps per 1/60 s", "equal_work"),
)
