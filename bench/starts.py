"""Where the sweeps of a pinned body start: y, with gravity, x + h v, or the one of lower potential; soft to stiff."""

from __future__ import annotations

from typing import Any

import torch

import diffvbd as dv
from bench.common import markdown_table
from bench.sweeps import STEP, bar, beam, swing

STARTS = ("predictor", "inertia", "auto")


def run(quick: bool) -> dict[str, Any]:
    return {"cantilever": cantilever(quick), "hanging_bar": hanging_bar(quick)}


def cantilever(quick: bool) -> list[dict[str, Any]]:
    """Error over motion after 0.5 s of the cantilever of `sweeps`, against converged steps of the same h."""
    steps, out = (5 if quick else 30), []
    for mu in (1e5,) if quick else (1e3, 1e4, 1e5, 1e6, 1e7):
        material = {"mu": mu, "lam": 1.5 * mu}
        goal = swing(beam(1.6), 500 if quick else 5000, steps, material)
        moved = float((goal - beam().rest_points).norm(dim=-1).max())
        for k in (5,) if quick else (5, 20, 100):
            row: dict[str, Any] = {"mu": mu, "sweeps": k, "motion": moved}
            for start in STARTS:
                for relaxation in (1.0, 1.6):
                    end = swing(beam(relaxation, start), k, steps, material)
                    row[f"{start}_{relaxation:g}"] = float((end - goal).norm(dim=-1).max()) / moved
            out.append(row)
    return out


def hanging_bar(quick: bool) -> list[dict[str, Any]]:
    """The bar of `sweeps` begins at rest in equilibrium: its elongation over that of equilibrium 1 s later."""
    out = []
    for mu in (1e5,):
        material = {"mu": mu, "lam": 1.5 * mu}
        x = bar().rest_points
        for _ in range(10 if quick else 60):  # long steps without inertia
            x, _ = dv.step(bar(1.6), x, torch.zeros_like(x), time_step=0.1, sweeps=100 if quick else 1000, **material)
        options = {"steps": 10 if quick else 60, "time_step": STEP, "save": "last", **material}
        for k in (5,) if quick else (5, 20, 100):
            row: dict[str, Any] = {"mu": mu, "sweeps": k}
            for start in STARTS:
                for relaxation in (1.0, 1.6):
                    model = bar(relaxation, start)
                    end = dv.rollout(model, x, torch.zeros_like(x), sweeps=k, **options).x[-1]
                    row[f"{start}_{relaxation:g}"] = float((1 + end[:, 1].min()) / (1 + x[:, 1].min()))
            out.append(row)
    return out


def markdown(results: dict[str, Any]) -> str:
    titles = {
        "cantilever": "Cantilever of 1 m released from rest: error over motion after 0.5 s, by start and relaxation",
        "hanging_bar": "Bar of 1 m that hangs at rest: elongation after 1 s over that of equilibrium",
    }
    parts = []
    for name, title in titles.items():
        rows = results[name]
        table = markdown_table([k.replace("_", " ") for k in rows[0]], [list(r.values()) for r in rows])
        parts.append(f"## {title}\n\n{table}")
    return "\n".join(parts)
