"""Figures of the paper, the one place that has them; `beside` sets them beside ours, from the files of results."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bench.common import cell
from bench.tables import markdown_table

# Table "Gradient error vs. the autograd reference": |V| = 115, four steps, by K.
EXACTNESS = {
    1: {"residual": 1.6e-1, "reverse sweep": 3.6e-15, "global, assembled": 3.7e-1, "global, matrix-free": 3.7e-1},
    5: {"residual": 4.7e-9, "reverse sweep": 3.3e-15, "global, assembled": 2.3e-5, "global, matrix-free": 2.3e-5},
    20: {"residual": 1.0e-14, "reverse sweep": 2.1e-15, "global, assembled": 9.7e-10, "global, matrix-free": 1.6e-10},
}
WORST_OF_ALL_AXES = 3.6e-15

# Table "Backward cost": |V| = 115, K = 20, four steps, an RTX 4090 Laptop GPU. Milliseconds, MB, iterations.
COST = {
    "reverse sweep, full tape": {"backward_ms": 28.5, "memory_mb": 0.9, "iterations": None, "error": 2.1e-15},
    "unrolled autograd": {"backward_ms": 939.9, "memory_mb": 64.3, "iterations": None, "error": None},
    "global, assembled": {"backward_ms": 257.6, "memory_mb": 19.8, "iterations": 36, "error": 9.7e-10},
    "global, matrix-free": {"backward_ms": 89.4, "memory_mb": 17.7, "iterations": 40, "error": 1.6e-10},
}
LESS_TIME_THAN_UNROLLED = 33
LESS_MEMORY_THAN_UNROLLED = 71
LESS_TIME_THAN_GLOBAL = 3  # 89.4 / 28.5 = 3.1
# The global routes at two materials: "around 5" iterations for soft material at h = 1e-2 s; and at mu = lam = 5e5 Pa.
SOFT_ITERATIONS = 5
STIFF_MODULUS, STIFF_ITERATIONS, STIFF_MS = 5e5, 233, (247, 389)

# Table "Finite-difference (FD) validation": six of eleven checks.
FINITE_DIFFERENCES = {
    "K = 1, CPU": 4.07e-10,
    "K = 1, GPU": 4.07e-10,
    "K = 2": 1.64e-9,
    "K = 3": 3.05e-10,
    "mu only (lam = 0)": 1.34e-9,
    "lam only (mu = 0)": 5.33e-10,
}

# Table "Ablation" of the paper, K = 1
ABLATION = {
    "full adjoint": {26: 4.2e-16, 115: 5.1e-16, 631: 9.1e-16},
    "full adjoint, diffvbd.step": {26: 4.2e-16, 115: 5.1e-16, 631: 9.1e-16},
    "no saturation Jacobian": {26: 7.7e-2, 115: 1.6e-1, 631: 2.6e-1},
    "no Hessian tangent": {26: 2.9e-4, 115: 8.2e-3, 631: 1.1e-1},
    "validity gate det F > 0.5": {26: 4.2e-16, 115: 8.2e-3, 631: 1.2e-1},
}

# Appendix on depth and outcome, cube-bounce: best distance [m] over 8 starts, and from its default start, by sweeps;
# Welch's t of the means of two numbers of sweeps; what the task itself reaches [m]
DEPTH = {
    5: {"mean": 0.052, "std": 0.020, "min": 0.023, "max": 0.081, "default": 0.039},
    20: {"mean": 0.034, "std": 0.018, "min": 0.015, "max": 0.065, "default": 0.058},
    100: {"mean": 0.035, "std": 0.010, "min": 0.021, "max": 0.053, "default": 0.024},
}
DEPTH_T = {(5, 20): 1.87, (5, 100): 2.16, (20, 100): 0.11}
BOUNCE_DISTANCE = 0.013

# Table "Measured K x |V| grid", an RTX A6000, 50 steps, 558 to 201,341 vertices, K = 5 to 200
GRID_RATIO = (0.96, 1.14)  # backward over forward, without the first call at K = 5
GRID_KB = (3.6, 4.6)  # peak over |V| K, "about 4"
GRID_MORE_VERTICES, GRID_MORE_MEMORY = 360, 370  # at one K

# Section "Runtime and scaling" and appendix on the grid: a bunny of 339 vertices and 897 tets, ms of a step on CUDA
BUNNY_MS, BUNNY_RATIO = (3, 5), 1.7  # the second is backward over forward

# Appendix "Inverse-problem tasks in detail" [s], [Pa]; the dress is of (1500, 800), Adam starts at (5000, 3000)
COVER_SECONDS = 40
DRESS_SINGLE_STAGE = {"dress-mu-lam": (1471, 880), "dress-silhouette": (1528, 900)}


@dataclass(frozen=True)
class Task:
    """What the paper says of an inverse problem (tables "Inverse-problem results" and "Additional inverse problems",
    section "Scale"), and what ours must reach: figures of its log and the most that each may be."""

    iterations: str
    outcome: str
    bars: dict[str, float]
    seconds: float | None = None  # the paper's time on its GPU, where it states one


# Bars are the paper's results or about as strict; the last four tasks are not in it.
TASKS = {
    "beam-mu": Task("76", "mu 0.1 %", {"mu": 1e-3}),
    "beam-mu-lam": Task("100", "mu, lam < 0.25 %", {"mu": 2.5e-3, "lam": 2.5e-3}),
    "dress-mu-lam": Task("250 + 5", "mu 0.01 %, lam 0.03 %", {"mu": 1e-4, "lam": 3e-4}),
    "dress-silhouette": Task("350 + 5", "mu, lam < 0.01 %", {"mu": 1e-4, "lam": 1e-4}),
    "flag-wind": Task("199", "loss 32 -> 5.1e-3 m^2", {"loss": 5e-3}),
    "cube-bounce": Task("151", "0.304 -> 0.013 m", {"distance": BOUNCE_DISTANCE}),
    "bunny-bounce": Task("100", "0.035 -> 0.034 m", {"distance": 0.034}),
    "cover-the-spot": Task("600", f"0.0 % uncovered, < {COVER_SECONDS} s", {"uncovered": 0.0}, COVER_SECONDS),
    "cape-mu": Task("80", "mu 0.16 %", {"mu": 1.6e-3}),
    "dress-size": Task("80", "scale < 0.5 %", {"size": 5e-3}),
    "cape-wind": Task("120", "wind < 0.3 %", {"deviation": 3e-3}),
    "million-cubes": Task(
        "about 180 + 200, each 300 s", "mean error 0.291 m, with contact 0.311 m (another scene, float64)",
        {"mean_error_without_contact": 0.291, "mean_error_with_contact": 0.311, "seconds_per_iteration": 3.0,
         "peak_memory_gb": 74.0},
    ),
    "throw": Task("-", "-", {}),
    "lift": Task("-", "-", {}),
    "learn-controller": Task("-", "-", {}),
    "fit-real-mesh": Task("-", "-", {}),
}  # fmt: skip


# --- beside ours ------------------------------------------------------------------------------------------------------

OURS, GLOBAL = "reverse sweep", ("global, assembled", "global, matrix-free")
FULL, UNROLLED = "reverse sweep, full tape", "unrolled autograd"
Results = dict[str, Any]
Figure = Callable[[Any], Any]  # of results or of a task's history
Line = tuple[Any, ...]  # figure, paper, ours on the CPU and on a GPU


def beside(results: Path) -> str:
    """A table of what the paper says and what we measure on each device, from a folder of results; a figure that is not
    there is "-"."""
    lines: list[Line] = []
    for name, figures in (("exactness", _exactness()), ("ablation", _ablation()), ("cost", _cost()), ("fd", _fd())):
        lines += [(label, theirs, *_both(results, name, ours)) for label, theirs, ours in figures]
    groups = _content(results / "gpu.json").get("results", {})
    lines += [(label, theirs, None, ours) for label, theirs, ours in (*_grid(groups), *_bunny(groups))]
    lines += [(label, theirs, *_both(results, "depth", ours)) for label, theirs, ours in _depth()]
    return markdown_table(("figure", "paper", "ours, CPU", "ours, GPU"), [*lines, *_tasks(results / "tasks")])


def _content(path: Path) -> dict[str, Any]:
    return json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}


def _both(folder: Path, name: str, figure: Figure, key: str = "results") -> list[Any]:
    """A figure of what a benchmark or a task has kept of the CPU and of a GPU."""
    contents = [_content(folder / f"{name}{suffix}.json").get(key) for suffix in ("", "-cuda")]
    return [figure(content) if content else None for content in contents]


def _range(values: Iterable[Any]) -> str | None:
    found = [value for value in values if value is not None]
    return " to ".join(dict.fromkeys((cell(min(found)), cell(max(found))))) if found else None


def _slashed(values: Iterable[Any]) -> str:
    return " / ".join(cell(value) for value in values)


def _exactness() -> Iterator[tuple[str, Any, Figure]]:
    """By K: the reverse sweep, and the worse global route."""
    for n, (sweeps, theirs) in enumerate(EXACTNESS.items()):
        for label, names in ((OURS, (OURS,)), ("global adjoint", GLOBAL)):

            def worst(r: Results, n: int = n, names: tuple[str, ...] = names) -> float:
                return max(r["scenes"]["preset"][n]["routes"][name]["error"] for name in names)

            yield f"gradient error, K = {sweeps}, {label}", max(theirs[name] for name in names), worst


def _ablation() -> Iterator[tuple[str, Any, Figure]]:
    for variant, theirs in ABLATION.items():

        def error(r: Results, wanted: tuple = (variant, 631, 1)) -> float | None:
            rows = {(row["variant"], row["vertices"], row["sweeps"]): row["error"] for row in r["rows"]}
            return rows.get(wanted)

        if "diffvbd" not in variant:
            yield f"ablation, {variant}", theirs[631], error


def _cost() -> Iterator[tuple[str, Any, Figure]]:
    def of(r: Results, route: str, key: str = "backward_ms") -> float:
        return next(row[key] for row in r["routes"] if row["route"] == route)

    def stiff(r: Results) -> str:
        row = next(row for row in r["stiffness"] if row["modulus"] == STIFF_MODULUS)
        return _slashed(row["routes"][name]["total_iterations"] for name in GLOBAL)

    yield "backward of four steps [ms]", COST[FULL]["backward_ms"], lambda r: of(r, FULL)
    for what, theirs, key in (("time than unrolled autograd, backward", LESS_TIME_THAN_UNROLLED, "backward_ms"),
                              ("peak memory than unrolled autograd", LESS_MEMORY_THAN_UNROLLED, "memory")):  # fmt: skip
        yield f"less {what}", theirs, lambda r, key=key: of(r, UNROLLED, key) / of(r, FULL, key)
    yield ("less time than the faster global route", LESS_TIME_THAN_GLOBAL,
           lambda r: min(of(r, name) for name in GLOBAL) / of(r, FULL))  # fmt: skip
    yield f"global routes at {STIFF_MODULUS:g} Pa, iterations", STIFF_ITERATIONS, stiff


def _fd() -> Iterator[tuple[str, Any, Figure]]:
    yield ("finite differences, worst check", max(FINITE_DIFFERENCES.values()),
           lambda r: max(row["error"] for row in r["checks"] if "error" in row))  # fmt: skip


def _grid(groups: Results) -> Iterator[tuple[str, Any, Any]]:
    rows = groups.get("grid", {}).get("rows", [])
    sizes = sorted({row["vertices"] for row in rows})
    peaks = {(row["vertices"], row["sweeps"]): row["full_peak"] for row in rows if row.get("full_peak")}
    ends = [peaks[n, 10] for n in (sizes[0], sizes[-1]) if (n, 10) in peaks] if sizes else []
    more = (None, None) if len(ends) < 2 else (sizes[-1] / sizes[0], ends[1] / ends[0])
    each = [peak / vertices / sweeps / 1e3 for (vertices, sweeps), peak in peaks.items()]
    yield "K x V grid, backward over forward", _range(GRID_RATIO), _range(row.get("ratio") for row in rows)
    yield "grid, peak memory [KB per vertex and sweep]", f"about 4, {_range(GRID_KB)}", _range(each)
    yield ("grid at K = 10, times more vertices / times more memory", _slashed((GRID_MORE_VERTICES, GRID_MORE_MEMORY)),
           _slashed(more))  # fmt: skip


def _bunny(groups: Results) -> Iterator[tuple[str, Any, Any]]:
    found = {row["part"]: row.get("ms") for row in groups.get("bunny", {}).get("rows", [])}
    both = found.get("forward with full tape"), found.get("reverse, full tape")
    yield "bunny, K = 20: forward / backward of a step [ms]", f"about {_slashed(BUNNY_MS)}", _slashed(both)
    yield "bunny, backward over forward", BUNNY_RATIO, both[1] / both[0] if both[0] and both[1] else None


def _depth() -> Iterator[tuple[str, Any, Figure]]:
    def shown(row: dict[str, Any]) -> str:
        return f"{row['mean']:.3f} +- {row['std']:.3f}"

    for n, (sweeps, theirs) in enumerate(DEPTH.items()):
        yield f"cube-bounce, {sweeps} sweeps: mean distance [m]", shown(theirs), lambda r, n=n: shown(r["depths"][n])


def _tasks(logs: Path) -> Iterator[Line]:
    def found(history: Any) -> str | None:
        first = [row for row in history if row["stage"] == 0]
        return f"({first[-1]['mu']:.0f}, {first[-1]['lam']:.0f})" if first else None

    yield ("cover-the-spot [s], 600 evaluations", f"< {COVER_SECONDS}",
           *_both(logs, "cover-the-spot", lambda history: f"{history[-1]['seconds']:.0f}", "history"))  # fmt: skip
    for name, theirs in DRESS_SINGLE_STAGE.items():
        yield f"{name}, one stage of Adam, (mu, lam) [Pa]", str(theirs), *_both(logs, name, found, "history")
