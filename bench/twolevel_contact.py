"""Coarse corrections and Anderson acceleration beside contact: sweeps and time to an error of one step.

A beam that its load presses on a plane, with a contact stiffness of 10 to 1000 times that of its vertices; a sheet with
self-contact on whose sides do not touch; five boxes, one on the other. Error: rms of positions from a converged step,
over the rms of its motion. Derivative: of a smooth weighted sum of the end by the start velocity, relative error beside
the converged one, at the K that reaches a level. Time: of a step without its backward, one thread.
"""

from __future__ import annotations

import sys
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

import diffvbd as dv
from bench.common import markdown_table

SWEEPS = (2, 3, 4, 5, 7, 8, 10, 11, 13, 14, 17, 20, 25, 31, 40, 52, 70, 100, 150, 200, 300, 400, 600)
LEVELS = (0.01, 1e-4)
ENOUGH = 1000  # accelerated sweeps of a second reference; plain ones may stay where they do not solve the step
ROUNDS = 3
BARRIER_CURVATURE = 6.4  # of the barrier at half of dhat, over kappa
# name, and options of the Model
METHODS: dict[str, dict[str, Any]] = {
    "plain": {},
    "plain, relaxation 1.5": {"relaxation": 1.5},
    "coarse": {"coarse": "auto"},
    "coarse, relaxation 1.5": {"coarse": "auto", "relaxation": 1.5},
}


@dataclass
class Scene:
    name: str
    model: Callable[..., dv.Model]
    given: dict[str, Any]
    settling: int = 0  # steps before the one that is measured
    friction: bool = False

    def state(self) -> tuple[Tensor, Tensor]:
        model = self.model()
        x = model.rest_points
        v = torch.zeros_like(x)
        for _ in range(self.settling):
            x, v = dv.step(model, x, v, sweeps=40, **self.given)
        return x, v


def beam(ratio: float, points: tuple[int, int, int] = (14, 4, 7)) -> Scene:
    size, mu, dhat = (1.0, 0.15, 0.4), 1e6, 0.01
    mesh = dv.mesh.box(points, size, split="kuhn")
    kappa = ratio * 3 * mu * 0.06 / BARRIER_CURVATURE
    energies = (dv.StableNeoHookean(), dv.PairBarrier(kappa, dhat, self_contact=False))
    plane = (dv.colliders.Plane((0, -0.9 * dhat, 0), (0, 1, 0)),)
    force = torch.zeros(mesh.num_vertices, 3, dtype=torch.float64)
    top = torch.tensor(mesh.points[:, 1] > 0.99 * size[1])
    force[top, 1] = -8000.0 / int(top.sum())

    def model(**options: Any) -> dv.Model:
        return dv.Model(mesh, pinned=mesh.points[:, 0] < 1e-9, energies=energies, colliders=plane, **options)

    return Scene(f"beam on a plane, {ratio:g}", model, {"mu": mu, "lam": 2 * mu, "time_step": 1 / 60, "force": force})


def sheet(points: int = 31) -> Scene:
    mesh = dv.mesh.box((points, 2, points), (1.0, 0.01, 1.0), split="kuhn")
    x, z = mesh.points[:, 0], mesh.points[:, 2]
    corners = (x < 1e-9) & ((z < 1e-9) | (z > 1 - 1e-9))
    energies = (dv.StableNeoHookean(), dv.PairBarrier(1e4, 0.004))
    return Scene("sheet, self-contact", lambda **o: dv.Model(mesh, pinned=corners, energies=energies, **o),
                 {"mu": 1e5, "lam": 1e5, "time_step": 1 / 60})  # fmt: skip


def boxes(count: int = 5, points: int = 5) -> Scene:
    dhat, kappa = 0.005, 1e5
    one = dv.mesh.box((points,) * 3, (0.2, 0.2, 0.2), split="kuhn")
    mesh = dv.mesh.join([one.translate((0.01 * (i % 2), i * (0.2 + 0.7 * dhat), 0.013 * (i % 3)))
                         for i in range(count)])  # fmt: skip
    energies = (dv.StableNeoHookean(), dv.FloorBarrier(height=-0.7 * dhat, kappa=kappa, dhat=dhat),
                dv.PairBarrier(kappa, dhat), dv.Friction(0.4, 0.05))  # fmt: skip
    return Scene(f"{count} stacked boxes", lambda **o: dv.Model(mesh, energies=energies, **o),
                 {"mu": 1e6, "lam": 2e6, "time_step": 1 / 60}, settling=40, friction=True)  # fmt: skip


def scenes(quick: bool) -> list[Scene]:
    if quick:
        return [beam(10, (7, 3, 4)), boxes(2, 3)]
    return [*(beam(ratio) for ratio in (10, 100, 1000)), sheet(), boxes()]


def run(quick: bool) -> dict[str, Any]:
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of relaxations that are meant
            return {"scenes": [measure(scene, quick) for scene in scenes(quick)]}
    finally:
        torch.set_num_threads(threads)


def measure(scene: Scene, quick: bool) -> dict[str, Any]:
    x, v = scene.state()
    best = scene.model(coarse="auto", acceleration=dv.Anderson(2), relaxation=1.0 if scene.friction else 1.5)
    goal, slope = ended(scene, best, x, v, 100 if quick else 300)
    other = dv.step(scene.model(acceleration=dv.Anderson(5)), x, v, sweeps=ENOUGH, **scene.given)[0]
    motion = (goal - x).square().mean().sqrt()
    row: dict[str, Any] = {"scene": scene.name, "vertices": len(x), "motion": float(motion),
                           "references_apart": rms(other - goal, motion), "methods": {}}  # fmt: skip
    for name, options in METHODS.items():
        if scene.friction and options.get("relaxation", 1.0) > 1:
            continue  # Friction warns of it
        row["methods"][name] = reached(scene, scene.model(**options), x, v, goal, slope, motion, quick)
        print(scene.name, name, row["methods"][name], file=sys.stderr, flush=True)
    return row


def rms(difference: Tensor, motion: Tensor) -> float:
    return float(difference.square().mean().sqrt() / motion)


def ended(scene: Scene, model: dv.Model, x: Tensor, v: Tensor, sweeps: int) -> tuple[Tensor, Tensor]:
    """Where a step ends, and the derivative of a weighted sum of that by the start velocity."""
    v = v.clone().requires_grad_()
    end = dv.step(model, x, v, sweeps=sweeps, **scene.given)[0]
    weights = torch.sin(5 * model.rest_points.flip(-1))
    return end.detach(), torch.autograd.grad((weights * end).sum(), v)[0]


def reached(scene: Scene, model: dv.Model, x: Tensor, v: Tensor, goal: Tensor, slope: Tensor, motion: Tensor,
            quick: bool) -> dict[str, Any]:  # fmt: skip
    """The first K from which on all errors are below each level, its time, and how wrong its derivative is."""
    errors = {}
    for sweeps in SWEEPS[:12] if quick else SWEEPS:
        errors[sweeps] = rms(dv.step(model, x, v, sweeps=sweeps, **scene.given)[0] - goal, motion)
        if max(list(errors.values())[-3:]) < 0.3 * LEVELS[-1]:
            break
    out: dict[str, Any] = {"errors": errors, "levels": {}}
    for level in LEVELS:
        found = None
        for sweeps, error in reversed(errors.items()):
            if not error < level:
                break
            found = sweeps
        if found is None:
            continue
        own = ended(scene, model, x, v, found)[1]
        out["levels"][f"{level:g}"] = {"sweeps": found, "ms": milliseconds(scene, model, x, v, found),
                                       "slope": float((own - slope).norm() / slope.norm())}  # fmt: skip
    return out


def milliseconds(scene: Scene, model: dv.Model, x: Tensor, v: Tensor, sweeps: int) -> float:
    times = []
    for _ in range(ROUNDS):
        begun = time.perf_counter()
        dv.step(model, x, v, sweeps=sweeps, **scene.given)
        times.append(time.perf_counter() - begun)
    return 1e3 * min(times)


def markdown(results: dict[str, Any]) -> str:
    of_level = ["K", "ms", "error of the derivative"]
    header = ["scene", "method", *(f"{100 * level:g} %: {name}" for level in LEVELS for name in of_level),
              "error at the most sweeps"]  # fmt: skip
    rows = []
    for row in results["scenes"]:
        for name, method in row["methods"].items():
            line: list[Any] = [row["scene"], name]
            for level in LEVELS:
                found = method["levels"].get(f"{level:g}")
                line += ["not reached", None, None] if found is None else list(found.values())
            last, error = list(method["errors"].items())[-1]
            rows.append([*line, f"{error:.2g} at {last}"])
    table = [[row["scene"], row["vertices"], row["motion"], row["references_apart"]] for row in results["scenes"]]
    return "\n".join([
        "## Sweeps and time to an error of one step\n\n" + markdown_table(header, rows),
        "## References\n\n" + markdown_table(
            ["scene", "vertices", "rms motion [m]", "converged in two ways, apart over motion"], table),
    ])  # fmt: skip
