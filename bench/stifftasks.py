"""Coarse corrections where it counts: in inverse problems, beside the rigid correction, and on easy scenes.

Error: the largest distance of a vertex from converged steps of the same h in any step, over the largest motion; the
fall of a free body does not count as motion. Time: processor time of one thread, the least of some rounds, everything
included.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable
from dataclasses import asdict
from typing import Any

import torch
from torch import Tensor

import diffvbd as dv
from bench.common import markdown_table
from bench.stifftasks_scenes import BODIES, EASY, TASKS, Body, Motion, Way

RIGID_COARSE = ((False, None), (True, None), (False, "auto"), (True, "auto"))
PART_SWEEPS = (4, 10)
EASY_SWEEPS = (2, 4, 5, 7, 8, 10, 14, 20, 26, 40)
COMPARED = (5, 10, 20)  # plain sweeps, beside corrections that take as long


def run(quick: bool, only: str = "tasks,parts,easy") -> dict[str, Any]:
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    groups: dict[str, Callable[[bool], Any]] = {
        "tasks": lambda quick: [row for make, ways in TASKS for row in of_task(make(quick), ways, quick)],
        "parts": lambda quick: [row for body in BODIES(quick) for row in of_body(body, quick)],
        "easy": lambda quick: [easy(body, quick) for body in EASY(quick)],
    }
    try:
        return {name: groups[name](quick) for name in only.split(",")}
    finally:
        torch.set_num_threads(threads)


# --- tasks ------------------------------------------------------------------------------------------------------------


def of_task(motion: Motion, ways: tuple[tuple[Way, str], ...], quick: bool) -> list[dict[str, Any]]:
    """A row for each way to compute a task's motion; of several materials the largest error counts."""
    rows, goals = [], {}
    for way, verdict in ways[:2] if quick else ways:
        if way.time_step not in goals:
            goals[way.time_step] = converged(motion, way.time_step, quick)
        goal, moved, apart = goals[way.time_step]
        errors = [distance(a, b) for a, b in zip(motion.motions(way), goal, strict=True)]
        rows.append({"task": motion.name, **asdict(way), "vertices": motion.mesh.num_vertices, "motion": moved,
                     "references_apart": apart, "errors": errors, "share": max(map(float.__truediv__, errors, moved)),
                     "ms": motion.milliseconds(way, 1 if quick else 4), "verdict": verdict})  # fmt: skip
        print(rows[-1], file=sys.stderr, flush=True)
    return rows


def converged(motion: Motion, time_step: float, quick: bool) -> tuple[list[Tensor], list[float], float]:
    """Motions of many sweeps with corrections, how far they go, and how far they are from those of half as many."""
    few, many = (
        motion.motions(Way(time_step, k, 1.5, "auto")) for k in ((20, 40) if quick else (motion.many // 2, motion.many))
    )
    moved = [distance(way, way[:1]) for way in many]
    return many, moved, max(distance(a, b) / m for a, b, m in zip(few, many, moved, strict=True))


def distance(a: Tensor, b: Tensor) -> float:
    return float((a - b).norm(dim=-1).max())


# --- parts: rigid correction, coarse corrections, both ---------------------------------------------------------------


def of_body(body: Body, quick: bool) -> list[dict[str, Any]]:
    steps = 5 if quick else 30
    goal, moved, apart = body.goal(steps, quick)
    rows = []
    for sweeps in PART_SWEEPS:
        for rigid, coarse in RIGID_COARSE:
            if rigid and body.pinned is not None:
                continue  # nothing that it could correct
            model = body.model(coarse, rigid=rigid)
            way = body.rolled(model, sweeps, steps)
            linear, angular = (None, None) if body.pinned is not None else momentum_errors(body, model, way)
            rows.append({
                "scene": body.name, "sweeps": sweeps, "rigid": rigid, "coarse": coarse or "off",
                "error": distance(way.x, goal) / moved, "momentum": linear, "angular_momentum": angular,
                "ms": body.milliseconds(model, sweeps, 1 if quick else 5), "references_apart": apart,
            })  # fmt: skip
            print(rows[-1], file=sys.stderr, flush=True)
    return rows


def momentum_errors(body: Body, model: dv.Model, way: dv.Trajectory) -> tuple[float, float]:
    """What momentum and angular momentum have gained at the end beyond what implicit Euler itself gives them, over sums
    of absolute values at the start."""
    h, steps, m = body.time_step, len(way.v) - 1, model.mass[:, None]
    gravity = torch.tensor([0.0, -9.81, 0.0], dtype=torch.float64)
    gained = (m * (way.v[-1] - way.v[0])).sum(0) - steps * h * m.sum() * gravity
    # about the center of mass, where gravity has no torque: L' - L = h sum m v' x v
    x, v = (a - (m * a).sum(1, keepdim=True) / m.sum() for a in (way.x, way.v))
    turned = (m * torch.linalg.cross(x, v)).sum(1)
    law = h * (m * torch.linalg.cross(v[1:], v[:-1])).sum((0, 1))
    scale = (m * way.v[0].norm(dim=1, keepdim=True)).sum()
    arm = (m[:, 0] * x[0].norm(dim=1) * v[0].norm(dim=1)).sum()
    return float(gained.norm() / scale), float((turned[-1] - turned[0] - law).norm() / arm)


# --- easy scenes ------------------------------------------------------------------------------------------------------


def easy(body: Body, quick: bool) -> dict[str, Any]:
    """Errors of plain sweeps and, in the time that they take, with corrections."""
    steps = 5 if quick else 30
    goal, moved, apart = body.goal(steps, quick)
    counts = EASY_SWEEPS[:4] if quick else EASY_SWEEPS
    kinds = {f"{coarse or 'plain'} {relaxation:g}": (coarse, relaxation)
             for coarse in ("auto", None) for relaxation in (1.0, 1.5)}  # fmt: skip
    models = {name: body.model(coarse, relaxation) for name, (coarse, relaxation) in kinds.items()}
    curves = {name: [{"sweeps": k, "error": distance(body.rolled(model, k, steps).x, goal) / moved,
                      "ms": float("inf")} for k in counts] for name, model in models.items()}  # fmt: skip
    for _ in range(1 if quick else 5):  # rounds of all: the machine is not always as fast
        for name, model in models.items():
            for row in curves[name]:
                row["ms"] = min(row["ms"], body.milliseconds(model, row["sweeps"], 1))
    compared = []
    for k in COMPARED[:1] if quick else COMPARED:
        plain = least(row for name in kinds if name.startswith("plain") for row in curves[name] if row["sweeps"] == k)
        corrected = [row for name in kinds if name.startswith("auto") for row in curves[name]]
        best = least(row for row in corrected if row["ms"] <= 1.05 * plain["ms"])
        same = least(row for row in corrected if row["sweeps"] == k)
        compared.append({"sweeps": k, "ms": plain["ms"], "error": plain["error"],
                         "coarse_sweeps": best.get("sweeps"), "coarse_error": best.get("error"),
                         "same_sweeps_error": same["error"], "same_sweeps_ms": same["ms"]})  # fmt: skip
    way = body.rolled(models["plain 1"], 10, steps)
    found = dv.diagnose(models["plain 1"], way.x[-1], time_step=body.time_step, previous=(way.x[-2], way.v[-2]),
                        warn=False, **body.material)  # fmt: skip
    row = {"scene": body.name, "vertices": body.mesh.num_vertices, "courant": found.courant,
           "unbalanced": found.unbalanced, "references_apart": apart, "compared": compared, **curves}  # fmt: skip
    print({k: v for k, v in row.items() if k not in kinds}, file=sys.stderr, flush=True)
    return row


def least(rows: Iterable[dict[str, Any]]) -> dict[str, Any]:
    """The row of the smallest error; an empty one of none."""
    return min(rows, key=lambda row: row["error"], default={})


def markdown(results: dict[str, Any]) -> str:
    parts = []
    if rows := results.get("tasks"):
        header = ("task", "h [ms]", "K", "relaxation", "corrections", "start", "error over motion", "errors [mm]",
                  "forward and backward [ms]", "")  # fmt: skip
        table = [[r["task"], 1e3 * r["time_step"], r["sweeps"], r["relaxation"], r["coarse"] or "-", r["start"],
                  r["share"], " / ".join(f"{1e3 * e:.2g}" for e in r["errors"]), r["ms"], r["verdict"]]
                 for r in rows]  # fmt: skip
        text = "Errors of the true material, then of the first guess where a task looks for it.\n\n"
        parts.append("## Motions of inverse problems\n\n" + text + markdown_table(header, table))
    if rows := results.get("parts"):
        names = ("scene", "sweeps", "rigid", "coarse", "error", "momentum", "angular_momentum", "ms")
        text = ("30 steps. Momentum: gained beyond implicit Euler's own law, over sum m |v| and sum m |r| |v| at "
                "the start. Milliseconds of a step and its backward.\n\n")  # fmt: skip
        table = markdown_table([n.replace("_", " ") for n in names], [[r[n] for n in names] for r in rows])
        parts.append("## Rigid correction and coarse corrections, each and together\n\n" + text + table)
    if rows := results.get("easy"):
        header = ("scene", "courant", "unbalanced", "plain K", "ms", "error", "K with corrections in that time",
                  "its error", "same K with corrections, error", "ms")  # fmt: skip
        table = [[*(r[n] for n in header[:3]), *c.values()] for r in rows for c in r["compared"]]
        text = ("All at the better of relaxation 1 and 1.5. Milliseconds of a step and its backward. Courant number "
                "and forces left over are those of plain steps of 10 sweeps.\n\n")  # fmt: skip
        parts.append("## Easy scenes: errors at equal time\n\n" + text + markdown_table(header, table))
    return "\n".join(parts)
