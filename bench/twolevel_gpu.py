"""Coarse corrections on CUDA: error and time beside plain sweeps on a large mesh, and what a correction costs.

Steps are captured in a CUDA graph and timed by events. Error: as in `twolevel`, after 30 steps. With corrections the
relaxation is 1.5; plain sweeps have the better of 1.6 and 1.8 at each K. One correction: by differences over K of steps
that keep no tape, and of their backward to state and a shared material.
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import torch
from torch import Tensor

import diffvbd as dv
from bench.common import markdown_table
from bench.gpu_measure import Card
from bench.twolevel_scenes import Scene, cantilever, functions

DEVICE = "cuda"
STEPS = 30
SWEEPS = (2, 4, 5, 7, 8, 10, 13, 16, 19, 22, 31, 40)
PLAIN_SWEEPS = (10, 20, 30, 100, 300)
PLAIN = (1.6, 1.8)
CONVERGED = (100, 200)
FUNCTIONS = ("auto", 256, 512)
LEVELS = (0.01, 1e-4)
TARGET = 30  # plain sweeps that 1 % may take
FORWARD, REVERSE = 2.5, 3.0  # sweeps that a correction may take
FEW, MANY = 4, 13  # sweeps between whose steps a correction is measured


def run(quick: bool, device: str = DEVICE, only: str = "cantilever,cost") -> dict[str, Any]:
    card = Card(torch.device(device), quick)
    groups = {"cantilever": large, "cost": cost}
    return {name: groups[name](card) for name in only.split(",")}


# --- error over time --------------------------------------------------------------------------------------------------


def large(card: Card) -> list[dict[str, Any]]:
    scene = cantilever((5, 3, 3) if card.quick else (101, 45, 45))
    steps = 3 if card.quick else STEPS
    model = scene.model().to(card.device)
    ends = [end(scene, model, k, steps) for k in (CONVERGED[:1] * 2 if card.quick else CONVERGED)]
    goal, moved = ends[-1], float((ends[-1] - model.rest_points).norm(dim=-1).max())

    def error(at: Tensor) -> float:
        return float((at - goal).norm(dim=-1).max()) / moved

    apart = error(ends[0])
    rows = []
    for most in FUNCTIONS[: 1 if card.quick else None]:
        space = "auto" if most == "auto" else dv.CoarseSpace(functions=most)
        model = scene.model(space).to(card.device)
        made = [(k, error(end(scene, model, k, steps)), ms(card, scene, model, k)) for k in SWEEPS]
        rows.append({"method": f"corrections, {most} functions", "functions": functions(model), "at": made})
    models = {omega: scene.model(None, omega).to(card.device) for omega in PLAIN}
    made = []
    for k in PLAIN_SWEEPS:
        best = min(PLAIN, key=lambda omega: error(end(scene, models[omega], k, steps)))
        made.append((k, error(end(scene, models[best], k, steps)), ms(card, scene, models[best], k)))
    rows.append({"method": "plain sweeps", "functions": 0, "at": made})
    sweep = (made[-1][2] - made[0][2]) / (made[-1][0] - made[0][0])
    for row in rows:
        for level in LEVELS:
            row[f"{level:g}"] = reached(row["at"], level, sweep)
        row |= {"vertices": scene.mesh.num_vertices, "sweep_ms": sweep, "reference_apart": apart}
        print(row, file=sys.stderr, flush=True)
    return rows


def reached(rows: list[tuple[int, float, float]], level: float, sweep: float) -> dict[str, float] | None:
    """The first K from which on all errors are below a level."""
    last = max((i for i, (_, error, _) in enumerate(rows) if error > level), default=-1)
    if last + 1 == len(rows):
        return None
    k, _, took = rows[last + 1]
    return {"sweeps": k, "ms": took, "in_plain_sweeps": took / sweep}


def end(scene: Scene, model: dv.Model, sweeps: int, steps: int) -> Tensor:
    x, v = (t.to(model.device) for t in scene.state())
    with torch.no_grad():
        given: dict[str, Any] = {"time_step": scene.time_step, **scene.material}
        return dv.rollout(model, x, v, steps=steps, sweeps=sweeps, save="last", **given).x[-1]


def ms(card: Card, scene: Scene, model: dv.Model, sweeps: int) -> float:
    """Milliseconds of a step."""
    x, v = (t.to(model.device) for t in scene.state())
    material = on(card, scene)

    def work() -> Any:
        with torch.no_grad():
            return dv.step(model, x, v, time_step=scene.time_step, sweeps=sweeps, **material)

    return 1e3 * (card.graph(work) or card.eager(work))


def on(card: Card, scene: Scene) -> dict[str, Any]:
    return {k: torch.as_tensor(m, dtype=torch.float64, device=card.device) for k, m in scene.material.items()}


# --- one correction ---------------------------------------------------------------------------------------------------


def cost(card: Card) -> list[dict[str, Any]]:
    small = dv.mesh.beam(5, 5, 4, size=(0.1, 0.1, 0.075), split="kuhn")
    side = 2 if card.quick else 100
    grid = np.stack(np.meshgrid(range(side), [0], range(side)), -1).reshape(-1, 3)
    stiff = {"mu": 1e7, "lam": 1e7}
    crowd = Scene(f"{len(grid)} bodies of {small.num_vertices} vertices", dv.mesh.replicate(small, 0.2 * grid),
                  np.tile(small.points[:, 0] < 1e-9, len(grid)), stiff)  # fmt: skip
    cells = 3 if card.quick else 11
    cube = dv.mesh.beam(cells, cells, cells, size=(0.5, 0.5, 0.5), split="kuhn")
    scenes = 2 if card.quick else 1024
    batch = Scene(f"{scenes} scenes of {cube.num_vertices} vertices", cube, cube.points[:, 0] < 1e-9, stiff)
    beams = [cantilever((5, 3, 3))] if card.quick else [cantilever((21, 7, 7)), cantilever((101, 45, 45))]
    return [*(_cost(card, beam, 1) for beam in beams), _cost(card, batch, scenes), _cost(card, crowd, 1)]


def _cost(card: Card, scene: Scene, scenes: int) -> dict[str, Any]:
    models = {name: scene.model(name).to(card.device) for name in (None, "auto")}
    took: dict[tuple, float] = {}
    for name, model in models.items():
        for sweeps in (FEW, MANY):
            for backward in (False, True):
                took[name, sweeps, backward] = 1e3 * _seconds(card, scene, model, scenes, sweeps, backward)
        card.tidy()
    corrections = dv.CoarseSpace().corrections(MANY) - dv.CoarseSpace().corrections(FEW)
    row: dict[str, Any] = {"scene": scene.name, "functions": functions(models["auto"])}
    for part, minus in (("forward", False), ("reverse", True)):

        def of(name: Any, sweeps: int, part: str = part, minus: bool = minus) -> float:
            whole = took[name, sweeps, part == "reverse"]
            return whole - took[name, sweeps, False] if minus else whole

        sweep = (of(None, MANY) - of(None, FEW)) / (MANY - FEW)
        one = (of("auto", MANY) - of("auto", FEW) - (of(None, MANY) - of(None, FEW))) / corrections
        besides = of("auto", FEW) - of(None, FEW) - one * dv.CoarseSpace().corrections(FEW)
        row |= {f"{part}_sweep_ms": sweep, f"{part}_correction_ms": one, f"{part}_besides_ms": besides}
    for name, unit in (("forward", "forward"), ("reverse", "forward"), ("reverse", "reverse")):
        row[f"{name}_correction_in_{unit}_sweeps"] = row[f"{name}_correction_ms"] / row[f"{unit}_sweep_ms"]
    print(row, file=sys.stderr, flush=True)
    return row


def _seconds(card: Card, scene: Scene, model: dv.Model, scenes: int, sweeps: int, backward: bool) -> float:
    x, v = (t.to(model.device).expand(scenes, -1, -1).contiguous().requires_grad_(backward) for t in scene.state())
    material: dict[str, Any] = {
        k: m.expand(scenes, 1).clone().requires_grad_(backward) for k, m in on(card, scene).items()
    }

    def work() -> Any:
        with torch.set_grad_enabled(backward):
            ends, _ = dv.step(model, x, v, time_step=scene.time_step, sweeps=sweeps, **material)
            return torch.autograd.grad(ends.sum(), (x, v, *material.values())) if backward else ends

    return card.graph(work) or card.eager(work)


# --- text -------------------------------------------------------------------------------------------------------------


def markdown(results: dict[str, Any]) -> str:
    parts = []
    if rows := results.get("cantilever"):
        header = ["method", "functions", *(f"{100 * level:g} %: {name}" for level in LEVELS for name in
                                           ("K", "ms", "sweeps")), "error left"]  # fmt: skip
        table = []
        for row in rows:
            found = [row[f"{level:g}"] for level in LEVELS]
            cells = [c for one in found for c in (one.values() if one else ("not reached", None, None))]
            table.append([row["method"], row["functions"], *cells, f"{row['at'][-1][1]:.3g} at {row['at'][-1][0]}"])
        text = (f"Cantilever, {rows[0]['vertices']} vertices, mu = lam = 1e7 Pa, h = 1/60 s. A plain sweep takes "
                f"{rows[0]['sweep_ms']:.3g} ms; 1 % may take {TARGET} of them. References apart: "
                f"{rows[0]['reference_apart']:.2g} of the motion.\n\n")  # fmt: skip
        parts.append("## Time to an error\n\n" + text + markdown_table(header, table))
    if rows := results.get("cost"):
        text = f"Targets, in sweeps: forward {FORWARD:g}, reverse {REVERSE:g}.\n\n"
        names = list(rows[0])
        table = [[name.replace("_", " "), *(row[name] for row in rows)] for name in names]
        parts.append("## One correction, in sweeps\n\n" + text + markdown_table(table[0], table[1:]))
    return "\n".join(parts)
