"""Coarse corrections between sweeps: error and time beside plain sweeps, in stiff and thin scenes.

Error: the largest distance of a vertex from where converged steps of the same h end, over the largest motion, after 30
steps. Time: a whole step, on one thread, everything included; on CUDA that of a graph. With coarse corrections
relaxation is 1.5; plain sweeps have the best of three relaxations and two starts at each K.

One correction: its time in sweeps, by differences over K; `reverse` the backward to state and material alone. Targets:
2.5 sweeps, and 3 in reverse.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

import diffvbd as dv
from bench.measure import Card, timed
from bench.sweeps import MATERIAL, STEP, bar
from bench.tables import Table
from diffvbd import results
from diffvbd.model.system import system_of

RELAXATION = 1.5  # with corrections


@dataclass(frozen=True)
class Scene:
    """A body at rest."""

    name: str
    mesh: dv.TetMesh
    pinned: np.ndarray
    material: dict[str, Any]  # mu, lam [Pa]
    device: str = "cpu"

    def state(self) -> tuple[Tensor, Tensor]:
        x = torch.from_numpy(self.mesh.points.copy()).to(self.device)
        return x, torch.zeros_like(x)

    @cached_property
    def model(self) -> dv.Model:
        return dv.Model(self.mesh, pinned=torch.from_numpy(self.pinned), device=self.device)

    def solver(self, sweeps: int = 1, subspace: Any = "coarse", relaxation: float = RELAXATION, start: Any = "auto"
               ) -> dv.VBD:  # fmt: skip
        return dv.VBD(STEP, sweeps, subspace=subspace, relaxation=relaxation, start=start)

    def rolled(self, solver: dv.VBD, steps: int, save: Any = "all") -> results.Trajectory:
        with torch.no_grad():
            return dv.rollout(self.model, *self.state(), solver, steps=steps, save=save, **self.material)

    def seconds(self, solver: dv.VBD, card: Card) -> float:
        """Of a step: of a CUDA graph, or over ten."""
        x, v = self.state()

        def work() -> Any:
            with torch.no_grad():
                return dv.step(self.model, x, v, solver, **self.material)

        if card.cuda:
            return card.graph(work) or 0.0
        return timed(lambda: self.rolled(solver, 10, "last")) / 10


def scenes(card: Card) -> list[Scene]:
    """On a GPU one large mesh."""
    if card.quick:
        return [cantilever((5, 3, 3)), sheet(0.25, cells=4)]
    if card.cuda:
        return [replace(cantilever((101, 45, 45)), device=str(card.device))]
    sizes = ((13, 5, 5), (21, 7, 7), (41, 13, 13))
    return [*map(cantilever, sizes), hanging_bar(), sheet(0.25), sheet(0.05)]


def cantilever(counts: tuple[int, int, int]) -> Scene:
    mesh = dv.mesh.beam(*counts, size=(1.0, 0.2, 0.2), split="kuhn")
    name = f"cantilever, {mesh.num_vertices} vertices"
    return Scene(name, mesh, mesh.points[:, 0] < 1e-9, {"mu": 1e7, "lam": 1e7})


def hanging_bar() -> Scene:
    return Scene("hanging bar", bar().mesh, bar().pinned.numpy(), dict(MATERIAL))


def sheet(ratio: float, cells: int = 20) -> Scene:
    """1 m square of one layer, held at one edge; ratio: thickness over the width of a cell."""
    mesh = dv.mesh.beam(cells + 1, 2, cells + 1, size=(1.0, ratio / cells, 1.0), split="kuhn")
    name = f"sheet, thickness 1/{round(1 / ratio)} cell"
    return Scene(name, mesh, mesh.points[:, 0] < 1e-9, {"mu": 1e6, "lam": 1.5e6})


def functions(scene: Scene) -> int:
    return int((~system_of(scene.model, scene.solver()).coarse_geometry.filling).sum())


SWEEPS = (1, 2, 4, 5, 7, 8, 10, 11, 13, 14, 16, 17, 19, 20, 22, 23, 25, 31, 40, 52, 70, 100, 150, 200, 300)
PLAIN_SWEEPS = (5, 10, 20, 50, 100, 200, 300)
LAST = 1000  # plain sweeps where those do not reach 1 %
PLAIN = tuple((relaxation, start) for relaxation in (1.0, 1.6, 1.8) for start in ("auto", "inertia"))
ROUNDS = 7  # of times
LEVELS = (0.01, 1e-4)
CONVERGED = 1e-7  # of the motion, between two K


def converged(scene: Scene, steps: int, quick: bool, most: int = 6400) -> tuple[Tensor, dict[str, float]]:
    """Where converged steps end, and how well they have: of the last step the share of its forces left over."""
    sweeps, last, apart = 100 if quick else 200, None, float("inf")
    while True:
        way = scene.rolled(scene.solver(sweeps), steps)
        moved = float((way.x[-1] - way.x[0]).norm(dim=-1).max())
        if last is not None:
            apart = float((way.x[-1] - last).norm(dim=-1).max()) / moved
        if apart < CONVERGED or sweeps >= most:
            break
        last, sweeps = way.x[-1], 2 * sweeps
    left = dv.diagnose(scene.model, way.x[-1], scene.solver(sweeps), previous=(way.x[-2], way.v[-2]), warn=False,
                       **scene.material)  # fmt: skip
    found = {"sweeps": sweeps, "apart": apart, "unbalanced": left.unbalanced, "motion": moved, "courant": left.courant}
    return way.x[-1], found


def least_times(scene: Scene, solvers: list[tuple[dv.VBD, list[dict[str, Any]]]], card: Card) -> None:
    """Adds to each row the time of a step, the least of several rounds of all: the machine is not always as fast."""
    for n in range(2 if card.quick else ROUNDS):
        for solver, rows in solvers:
            for row in rows:
                if row["sweeps"] <= 100 or n < 2:
                    seconds = scene.seconds(replace(solver, sweeps=row["sweeps"]), card)
                    row["ms"] = min(row.get("ms", float("inf")), 1e3 * seconds)


def line(rows: list[dict[str, Any]]) -> tuple[float, float]:
    """Milliseconds of a sweep of plain steps, and of what a step costs besides, from K = 10 and K = 50."""
    few, many = (next(row["ms"] for row in rows if row["sweeps"] == k) for k in (10, 50))
    sweep = (many - few) / 40
    return sweep, few - 10 * sweep


def first_below(rows: list[dict[str, Any]], level: float) -> dict[str, Any] | None:
    """The row of least K from which on all errors are below a level."""
    found = None
    for row in reversed(rows):
        if not row["error"] < level:
            break
        found = row
    return found


def measure(scene: Scene, card: Card) -> dict[str, Any]:
    """Errors and times over K, with corrections and without, and where each error is reached."""
    steps = 5 if card.quick else 30
    goal, found = converged(scene, steps, card.quick)

    def error(solver: dv.VBD, sweeps: int) -> float:
        end = scene.rolled(replace(solver, sweeps=sweeps), steps, "last").x[-1]
        return float((end - goal).norm(dim=-1).max()) / found["motion"]

    two, solvers = scene.solver(), {options: scene.solver(1, "rigid", *options) for options in PLAIN}
    rows = [{"sweeps": k, "error": error(two, k)} for k in SWEEPS[: 6 if card.quick else None]]
    plain = []
    for k in PLAIN_SWEEPS[: 4 if card.quick else None]:
        best = min((error(solver, k), *options) for options, solver in solvers.items())
        plain.append({"sweeps": k, "error": best[0], "relaxation": best[1], "start": best[2]})
    if not card.quick and plain[-1]["error"] > LEVELS[0]:
        options = (plain[-1]["relaxation"], plain[-1]["start"])
        plain.append({**plain[-1], "sweeps": LAST, "error": error(solvers[options], LAST)})
    least_times(scene, [(two, rows), (solvers[PLAIN[0]], plain)], card)
    sweep, fixed = line(plain)
    row: dict[str, Any] = {"scene": scene.name, "vertices": scene.mesh.num_vertices, "functions": functions(scene),
                           "reference": found, "sweep_ms": sweep, "fixed_ms": fixed}  # fmt: skip
    for name, own in (("two_level", rows), ("plain", plain)):
        row[name] = own
        for level in LEVELS:
            at = first_below(own, level)
            row[f"{name}_{level:g}"] = at and {"K": at["sweeps"], "ms": at["ms"], "sweeps": at["ms"] / sweep}
    return row


FEW, MANY = 4, 13  # sweeps between whose steps a correction is measured


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
    sizes = ((5, 3, 3),) if card.quick else ((21, 7, 7), (101, 45, 45)) if card.cuda else ((21, 7, 7),)
    return [*(_cost(card, cantilever(size), 1) for size in sizes), *([_cost(card, batch, scenes)] if card.cuda else []),
            _cost(card, crowd, 1)]  # fmt: skip


def _cost(card: Card, scene: Scene, scenes: int) -> dict[str, Any]:
    scene = replace(scene, device=str(card.device))
    took: dict[tuple[str, str, int], float] = {}  # [ms], by part of a step
    for subspace in ("rigid", "coarse"):
        for sweeps in (FEW, MANY):
            solver = scene.solver(sweeps, subspace)
            alone, both = (1e3 * _seconds(card, scene, solver, scenes, backward) for backward in (False, True))
            took |= {("forward", subspace, sweeps): alone, ("reverse", subspace, sweeps): both - alone}
        card.tidy()
    few, many = (dv.CoarseSpace().corrections(sweeps) for sweeps in (FEW, MANY))
    row: dict[str, Any] = {"scene": scene.name, "functions": functions(scene)}
    for part in ("forward", "reverse"):
        rigid, coarse = (took[part, subspace, MANY] - took[part, subspace, FEW] for subspace in ("rigid", "coarse"))
        sweep, one = rigid / (MANY - FEW), (coarse - rigid) / (many - few)
        besides = took[part, "coarse", FEW] - took[part, "rigid", FEW] - one * few
        row |= {f"{part}_sweep_ms": sweep, f"{part}_correction_ms": one, f"{part}_besides_ms": besides}
    for name, unit in (("forward", "forward"), ("reverse", "forward"), ("reverse", "reverse")):
        row[f"{name}_correction_in_{unit}_sweeps"] = row[f"{name}_correction_ms"] / row[f"{unit}_sweep_ms"]
    return row


def _seconds(card: Card, scene: Scene, solver: dv.VBD, scenes: int, backward: bool) -> float:
    x, v = (t.expand(scenes, -1, -1).contiguous().requires_grad_(backward) for t in scene.state())
    material: dict[str, Any] = {
        k: x.new_tensor(m).expand(scenes, 1).clone().requires_grad_(backward) for k, m in scene.material.items()
    }

    def work() -> Any:
        with torch.set_grad_enabled(backward):
            ends, _ = dv.step(scene.model, x, v, solver, **material)
            return torch.autograd.grad(ends.sum(), (x, v, *material.values())) if backward else ends

    return card.graph(work) or card.eager(work)


THREADS, ANYWHERE = 1, True
GROUPS: dict[str, Callable[[Card], list[dict[str, Any]]]] = {
    "scenes": lambda card: [measure(scene, card) for scene in scenes(card)],
    "cost": cost,
}  # fmt: skip
REACHED: dict[str, Any] = {
    f"{label} to {100 * level:g} %: {what}": f"{name}_{level:g}/{key}"
    for level in LEVELS for name, label in (("two_level", "coarse"), ("plain", "plain"))
    for key, what in (("K", "K"), ("ms", "ms"))
}  # fmt: skip
TABLES = (
    Table("Time of a step to an error", "scenes",
          {"scene": "scene", "vertices": "vertices", "functions": "functions", **REACHED,
           "ms of a plain sweep": "sweep_ms"}),
    Table("Error over motion by K, with corrections: {}", "scenes/*/two_level", ("sweeps", "error", "ms")),
    Table("One correction, in sweeps", "cost"),
)  # fmt: skip
