"""What a coarse correction costs, in sweeps, and what it takes to build a Model with them; on one thread."""

from __future__ import annotations

import resource
import sys
import time
from typing import Any

import numpy as np
import torch

import diffvbd as dv
from bench.common import markdown_table
from bench.twolevel_scenes import Scene, cantilever, functions

FORWARD, REVERSE = 2.5, 3.0  # targets


def run(quick: bool) -> dict[str, Any]:
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        return {"cost": cost(quick)}
    finally:
        torch.set_num_threads(threads)


def cost(quick: bool) -> list[dict[str, Any]]:
    """One correction in sweeps' time, by differences over K; `reverse` the backward to state and material alone."""
    beam = cantilever((5, 3, 3) if quick else (21, 7, 7))
    small = dv.mesh.beam(5, 5, 4, size=(0.1, 0.1, 0.075), split="kuhn")
    side = 2 if quick else 100
    grid = np.stack(np.meshgrid(range(side), [0], range(side)), -1).reshape(-1, 3)
    out = [_cost(beam, 31, 61, 3 if quick else 40)]
    begun = time.perf_counter()
    many = dv.mesh.replicate(small, 0.2 * grid)
    meshed = time.perf_counter() - begun
    pinned = np.tile(small.points[:, 0] < 1e-9, len(grid))
    crowd = Scene(f"{len(grid)} bodies of {small.num_vertices} vertices", many, pinned, {"mu": 1e7, "lam": 1e7})
    return [*out, {**_cost(crowd, 7, 19, 3 if quick else 5), "mesh_s": meshed}]


def _cost(scene: Scene, few: int, many: int, rounds: int) -> dict[str, Any]:
    built, models = [], []
    for coarse in (None, "auto"):
        begun = time.perf_counter()
        models.append(scene.model(coarse))
        built.append(time.perf_counter() - begun)
    jobs = [(model, k) for model in models for k in (few, many)]
    best = [(float("inf"),) * 2] * len(jobs)
    for _ in range(rounds):  # of all: the machine is not always as fast
        best = [tuple(map(min, found, one_step(scene, *job))) for found, job in zip(best, jobs, strict=True)]
    corrections = dv.CoarseSpace().corrections(many) - dv.CoarseSpace().corrections(few)
    row: dict[str, Any] = {"scene": scene.name, "functions": functions(models[1]), "build_plain_s": built[0],
                           "build_two_level_s": built[1]}  # fmt: skip
    for part, name in enumerate(("forward", "reverse")):
        plain_few, plain_many, two_few, two_many = (seconds[part] for seconds in best)
        sweep = (plain_many - plain_few) / (many - few)
        one = (two_many - two_few - (plain_many - plain_few)) / corrections
        besides = two_few - plain_few - one * dv.CoarseSpace().corrections(few)
        row |= {
            f"{name}_sweep_ms": 1e3 * sweep,
            f"{name}_correction_ms": 1e3 * one,
            f"{name}_besides_ms": 1e3 * besides,
        }
    for name, unit in (("forward", "forward"), ("reverse", "forward"), ("reverse", "reverse")):
        row[f"{name}_correction_in_{unit}_sweeps"] = row[f"{name}_correction_ms"] / row[f"{unit}_sweep_ms"]
    row["peak_gb"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(scene.name, row, file=sys.stderr, flush=True)
    return row


def one_step(scene: Scene, model: dv.Model, sweeps: int) -> tuple[float, float]:
    """Seconds of a step that keeps its tape, and of its backward."""
    x, v = (t.clone().requires_grad_() for t in scene.state())
    material: dict[str, Any] = {
        k: torch.as_tensor(m, dtype=x.dtype).clone().requires_grad_() for k, m in scene.material.items()
    }
    begun = time.perf_counter()
    end, _ = dv.step(model, x, v, time_step=scene.time_step, sweeps=sweeps, **material)
    middle = time.perf_counter()
    end.sum().backward()
    return middle - begun, time.perf_counter() - middle


def markdown(results: dict[str, Any]) -> str:
    rows = results["cost"]
    text = f"Targets, in sweeps: forward {FORWARD:g}, reverse {REVERSE:g}.\n\n"
    names = list(dict.fromkeys(name for row in rows for name in row))
    table = [[name.replace("_", " "), *(row.get(name) for row in rows)] for name in names]
    return "## One correction, in sweeps\n\n" + text + markdown_table(table[0], table[1:])
