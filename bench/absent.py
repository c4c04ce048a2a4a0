"""Scenes without damping, muscles and couplings: time and bytes of a step beside those of another version.

The environment variable DIFFVBD_OTHER names a tree with the other version, built. Both are measured in processes of
their own, in turns, and the least time of each counts: what slows a machine down now and then slows down neither least.
"""

from __future__ import annotations

import gc
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

import diffvbd as dv
from bench.measure import calls_of, kept_bytes, timed
from bench.tables import Table

STEPS, SWEEPS = 5, 10


def scenes() -> dict[str, Callable[[], Any]]:
    """Forward and reverse of some steps of each scene."""
    return {
        "64 vertices": of(4),
        "2,197 vertices": of(13),
        "64 vertices, coarse": of(4, subspace="coarse"),
        "2,197 vertices, SDIRK2": of(13, integrator=dv.SDIRK2()),
        "64 vertices, floor and anchors": of(4, dv.FloorBarrier(height=-0.05), dv.Anchor(1.0)),
        "two cubes in contact": of(4, dv.PairBarrier(1e4, dhat=0.02), dv.Friction(0.3), bodies=2),
    }


def of(points: int, *energies: Any, bodies: int = 1, **options: Any) -> Callable[[], Any]:
    cubes = [dv.mesh.cube(points, size=1.0).translate((0, 1.01 * k, 0)) for k in range(bodies)]
    mesh = dv.mesh.join(cubes)
    model = dv.Model(mesh, pinned=mesh.points[:, 1] < 1e-9, energies=(dv.StableNeoHookean(), *energies))
    solver = dv.VBD(5e-3, SWEEPS, **options)
    mu = torch.full((), 1e5, dtype=model.dtype, requires_grad=True)

    def run() -> torch.Tensor:
        x, v = model.rest_points, torch.zeros_like(model.rest_points)
        for _ in range(STEPS):
            x, v = dv.step(model, x, v, solver, mu=mu, lam=1e5)
        return x.sum()

    return run


def measured(rounds: int) -> dict[str, dict[str, float]]:
    """Of each scene, in this process."""
    torch.set_num_threads(1)
    out = {}
    for name, run in scenes().items():
        run().backward()
        gc.collect()
        gc.disable()
        forward = [timed(run, time.process_time) for _ in range(rounds)]
        both = [timed(lambda run=run: run().backward(), time.process_time) for _ in range(rounds)]
        gc.enable()
        out[name] = {
            "forward": min(forward), "both": min(both),
            "bytes": kept_bytes(run), "calls": calls_of(run)[0],
        }  # fmt: skip
    return out


def run(quick: bool) -> dict[str, Any]:
    here = Path(__file__).resolve().parents[1]
    trees = {"this": here, "other": Path(os.environ.get("DIFFVBD_OTHER", here))}
    found: dict[str, list[dict[str, dict[str, float]]]] = {name: [] for name in trees}
    for _ in range(1 if quick else 5):
        for name, tree in trees.items():
            command = [sys.executable, str(Path(__file__)), "2" if quick else "40"]
            done = subprocess.run(command, env={**os.environ, "PYTHONPATH": str(tree)}, capture_output=True, text=True,
                                  check=True)  # fmt: skip
            found[name].append(json.loads(done.stdout))
    rows = []
    for scene in found["this"][0]:
        best = {name: {key: min(one[scene][key] for one in runs) for key in runs[0][scene]}
                for name, runs in found.items()}  # fmt: skip
        this, other = best["this"], best["other"]
        rows.append({"scene": scene, "forward [ms]": 1e3 * this["forward"] / STEPS,
                     "forward and reverse [ms]": 1e3 * this["both"] / STEPS, "bytes": this["bytes"] // STEPS,
                     **{f"{key} over other": this[key] / other[key] for key in this}})  # fmt: skip
    return {"rows": rows}


TABLES = (Table("A step without any of it beside another version: processor time, tape, Python calls", "rows"),)

if __name__ == "__main__":
    print(json.dumps(measured(int(sys.argv[1]))))
