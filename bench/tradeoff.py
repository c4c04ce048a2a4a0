"""Speed against accuracy: time of a step and error of its result over sweeps K and relaxation."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import torch
from torch import Tensor

import diffvbd as dv
from bench.common import markdown_table

SWEEPS = (5, 10, 20, 50, 100, 200, 500, 1000)
RELAXATIONS = (1.0, 1.6)
MATERIAL = {"mu": 1e5, "lam": 1.5e5}
STEP = 1 / 60


def run(quick: bool) -> dict[str, Any]:
    sweeps = (5, 50) if quick else SWEEPS
    return {"hanging_bar": hanging_bar(sweeps, quick), "swinging_beam": swinging_beam(sweeps, quick)}


def bar(relaxation: float = 1.0) -> dv.Model:
    """A bar of 1 m, 11 layers of vertices, held at its upper end."""
    mesh = dv.mesh.beam(11, 3, 3, size=(1.0, 0.2, 0.2))
    # x is the long axis of beam(); turned so that it hangs down
    points = np.stack([mesh.points[:, 1], -mesh.points[:, 0], mesh.points[:, 2]], -1)
    mesh = dv.TetMesh(points, mesh.tets, orient=True)
    return dv.Model(mesh, pinned=points[:, 1] > -1e-9, relaxation=relaxation)


def hanging_bar(sweeps: tuple[int, ...], quick: bool) -> dict[str, Any]:
    """Elongation at which the executed steps come to rest, against equilibrium, for two time steps.

    Unconverged sweeps leave part of each step's fall h^2 g, so the bar settles too low: a bias, not noise.
    """
    out = []
    for h in (STEP,) if quick else (STEP, 0.1):
        exact = _settle(bar(1.6), h, 3000 if not quick else 500, 20)[0]
        for relaxation in RELAXATIONS:
            for k in sweeps:
                model = bar(relaxation)
                tip, x, v, x1, seconds = _settle(model, h, k, 60 if quick else 1500)
                left = dv.diagnostics.diagnose(model, x1, time_step=h, previous=(x, v), warn=False, **MATERIAL)
                out.append(
                    {
                        "time_step": h,
                        "relaxation": relaxation,
                        "sweeps": k,
                        "ms_per_step": 1e3 * seconds,
                        "elongation": tip,
                        "error": tip / exact - 1,
                        "unbalanced": left.unbalanced,
                        "drift_per_step": float((x1 - x).abs().max()),
                    }
                )
    return {"rows": out, "free_fall_per_step": {str(h): 9.81 * h * h for h in (STEP, 0.1)}}


def _settle(model: dv.Model, h: float, sweeps: int, steps: int) -> Any:
    """Elongation [m] after up to `steps` damped steps, the last two states and the time of a step [s]."""
    x = model.rest_points.clone()
    v, x1, last, begun, done = torch.zeros_like(x), x, x, time.perf_counter(), 0
    for n in range(1, steps + 1):
        x = x1
        # without velocity every step ends nearer to where the sweeps balance gravity
        x1, _ = dv.step(model, x, v, time_step=h, sweeps=sweeps, **MATERIAL)
        done = n
        if n % 20 == 0:
            if float((x1 - last).abs().max()) < 1e-9:
                break
            last = x1
    seconds = (time.perf_counter() - begun) / done
    return float(-1.0 - x1[:, 1].min()) * -1.0, x, v, x1, seconds


def swinging_beam(sweeps: tuple[int, ...], quick: bool) -> dict[str, Any]:
    """Position error after 0.5 s of a cantilever falling from rest, against converged steps of the same h."""
    steps = 5 if quick else 30
    out = []
    for stiffness in (1.0,) if quick else (1.0, 100.0):
        goal, _ = _swing(1.6, 500 if quick else 4000, steps, stiffness)
        for relaxation in RELAXATIONS:
            for k in sweeps:
                x, seconds = _swing(relaxation, k, steps, stiffness)
                moved = float((goal - _beam().rest_points).norm(dim=-1).max())
                out.append(
                    {
                        "mu": stiffness * MATERIAL["mu"],
                        "relaxation": relaxation,
                        "sweeps": k,
                        "ms_per_step": 1e3 * seconds,
                        "error_over_motion": float((x - goal).norm(dim=-1).max()) / moved,
                        "error": float((x - goal).norm(dim=-1).max()),
                    }
                )
    return {"rows": out}


def _beam(relaxation: float = 1.0) -> dv.Model:
    mesh = dv.mesh.beam(11, 3, 3, size=(1.0, 0.2, 0.2))
    return dv.Model(mesh, pinned=mesh.points[:, 0] < 1e-9, relaxation=relaxation)


def _swing(relaxation: float, sweeps: int, steps: int, stiffness: float) -> tuple[Tensor, float]:
    model = _beam(relaxation)
    x = model.rest_points
    begun = time.perf_counter()
    material = {k: stiffness * value for k, value in MATERIAL.items()}
    end = dv.rollout(model, x, torch.zeros_like(x), steps=steps, time_step=STEP, sweeps=sweeps, save="last", **material)
    return end.x[-1], (time.perf_counter() - begun) / steps


def markdown(results: dict[str, Any]) -> str:
    text = []
    for name, title in (
        ("hanging_bar", "Hanging bar: elongation at rest against equilibrium"),
        ("swinging_beam", "Cantilever released from rest: position after 0.5 s against converged steps"),
    ):
        rows = results[name]["rows"]
        header = [k.replace("_", " ") for k in rows[0]]
        text.append(f"## {title}\n\n" + markdown_table(header, [list(r.values()) for r in rows]))
    return "\n".join(text)
