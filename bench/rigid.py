"""What the rigid correction costs beside a sweep and a step, from one small body to a million."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import torch

import diffvbd as dv
from bench.common import markdown_table


def run(quick: bool, device: str = "cpu") -> list[dict[str, Any]]:
    out = []
    sizes: list[tuple[str, Callable[[], dv.TetMesh], int, int]] = [
        ("cube of 27", lambda: dv.mesh.cube(3, size=0.2, split="kuhn"), 20, 1),
        ("cube of 1,331", lambda: dv.mesh.cube(11, split="kuhn"), 20, 1),
    ]
    if not quick:
        sizes += [
            ("cube of 195,112", lambda: dv.mesh.cube(58, split="kuhn"), 20, 1),
            ("10,000 cubes of 8, one mesh", lambda: _cubes(10_000), 5, 1),
        ]
        if device != "cpu":
            sizes.append(
                ("1,000,000 cubes of 8, a scene each", lambda: dv.mesh.cube(2, size=0.2, split="kuhn"), 5, 1_000_000)
            )
    for name, make, sweeps, scenes in sizes:
        mesh = make()
        for energies in ("none", "floor, in contact"):
            floor = (dv.FloorBarrier(height=-0.005, kappa=1e3, dhat=0.01),) if energies != "none" else ()
            row: dict[str, Any] = {"scene": name, "vertices": mesh.num_vertices, "energies": energies, "sweeps": sweeps}
            for rigid in (False, True):
                # without: the sweeps alone, from the predictor
                start = "auto" if rigid else "predictor"
                energies_of = (dv.StableNeoHookean(), *floor)
                model = dv.Model(mesh, energies=energies_of, rigid=rigid, start=start, device=device)
                key = "with" if rigid else "without"
                row[f"step_{key}"] = _seconds(model, scenes, sweeps, False, quick)
                if not rigid:
                    few = _seconds(model, scenes, 1, False, quick)
                    row["sweep"] = (row["step_without"] - few) / (sweeps - 1)
                row[f"both_{key}"] = _seconds(model, scenes, sweeps, True, quick)
            row["corrections_over_sweep"] = (row["step_with"] - row["step_without"]) / row["sweep"]
            row["step_ratio"] = row["step_with"] / row["step_without"]
            row["both_ratio"] = row["both_with"] / row["both_without"]
            out.append(row)
    return out


def _cubes(count: int) -> dv.TetMesh:
    side = round(count ** (1 / 2))
    offsets = torch.cartesian_prod(torch.arange(side), torch.arange(-(-count // side)))[:count].double()
    place = torch.stack([offsets[:, 0], torch.zeros(count, dtype=torch.float64), offsets[:, 1]], -1) * 0.3
    return dv.mesh.replicate(dv.mesh.cube(2, size=0.2, split="kuhn"), place.numpy())


def _seconds(model: dv.Model, scenes: int, sweeps: int, backward: bool, quick: bool) -> float:
    """Median time of a step, or of a step and its backward."""
    x = model.rest_points
    x = (x if scenes == 1 else x.expand(scenes, -1, -1).contiguous()).requires_grad_(backward)
    v = torch.zeros_like(x)
    cuda = model.device.type == "cuda"

    def once() -> None:
        x1, v1 = dv.step(model, x, v, mu=1e5, lam=1e5, time_step=0.01, sweeps=sweeps)
        if backward:
            torch.autograd.grad(x1.sum() + v1.sum(), x)

    def timed(repeats: int) -> float:
        if cuda:
            start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
            start.record()
            for _ in range(repeats):
                run_once()
            end.record()
            torch.cuda.synchronize()
            return start.elapsed_time(end) / 1e3 / repeats
        began = time.perf_counter()
        for _ in range(repeats):
            run_once()
        return (time.perf_counter() - began) / repeats

    run_once: Callable[[], object] = once
    for _ in range(2):
        once()
    if cuda:  # the device's own time: launches from a graph, as a rollout that is captured has them
        torch.cuda.synchronize()
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            once()
        run_once = graph.replay
    first = timed(1)
    repeats = max(1, min(200, int((0.02 if quick else 0.1) / max(first, 1e-6))))
    return sorted(timed(repeats) for _ in range(3 if quick else 7))[1 if quick else 3]


def markdown(results: list[dict[str, Any]]) -> str:
    header = ["scene", "energies", "K", "a sweep [us]", "both corrections over a sweep", "step with over without",
              "step and backward, with over without"]  # fmt: skip
    rows = [[r["scene"], r["energies"], r["sweeps"], 1e6 * r["sweep"], r["corrections_over_sweep"], r["step_ratio"],
             r["both_ratio"]] for r in results]  # fmt: skip
    return "## What the rigid corrections at the start and the end of a step cost\n\n" + markdown_table(header, rows)
