"""Whether `dv.advise` keeps its promise, and how fast what it advises is.

Scenes drawn by a seed; for each wanted error the true one of the advised settings, against runs of eight times the
steps and five times the sweeps; the time of the advised settings over that of the best of a grid; and what the advice
cost. Then the cantilever and the drop of docs/numerics.md beside the best settings of implicit
Euler, and a fit of a material with steps that are too long and with short ones. One thread each.
"""

from __future__ import annotations

import math
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

import diffvbd as dv
from bench import common
from bench.advice_fit import fit
from bench.advice_scenes import Scene, drawn
from bench.common import markdown_table
from diffvbd.rollout.tune import FRAMES, Pilot, Pilots, pilots_of

ERRORS = (0.1, 0.01, 0.001)
SCENES, GRADIENTS, EXHAUSTIVE = 30, 12, 12  # of the drawn scenes, from the first
PATIENCE = 20.0  # [s]
FEWEST = 0.05  # [s]: what takes less is timed too badly to be compared
Row = dict[str, Any]
SWEEPS: list[tuple[dict[str, Any], tuple[int, ...]]] = [
    ({}, (5, 10, 20, 40)),
    ({"relaxation": 1.6}, (10, 20, 40)),
    ({"relaxation": 1.5, "coarse": "auto"}, (2, 5, 8)),
]
GRID = [
    dv.Settings(1.0, k, scheme, **options)
    for scheme in (dv.ImplicitEuler(), dv.SDIRK2(), dv.BDF2())
    for options, counts in SWEEPS
    for k in counts
]


def pilots(scene: Scene, gradient: bool = False) -> Pilots:
    state = scene.model.rest_points, scene.v
    return pilots_of(dv.rollout, scene.model, *state, scene.duration, None, gradient, scene.given)


def exact(runs: Pilots, settings: dv.Settings) -> tuple[Pilot, float]:
    """A run of much smaller steps and many more sweeps than those settings, and how far one of half of them is off."""
    steps = FRAMES * math.ceil(settings.steps(runs.duration) / FRAMES)
    sweeps = 40 if settings.coarse is None else 5 * settings.sweeps
    fine = replace(settings, sweeps=sweeps, integrator=dv.SDIRK2(), relaxation=1.5 if settings.coarse else 1.0)
    factor = 8
    a, b = runs.run(fine, factor // 2 * steps), runs.run(fine, factor * steps)
    return b, distance(runs, a, b)


def distance(runs: Pilots, a: Pilot, b: Pilot) -> float:
    if a.x is None or b.x is None:
        return math.inf
    apart = [runs.apart(a.x, b.x)]
    for u, w in zip(a.gradient, b.gradient, strict=True):
        apart.append(float((u - w).norm() / w.norm()))
    return max(apart)


def asked(scene: Scene, error: float, gradient: bool) -> tuple[Row, dv.Settings, Pilot | None]:
    s = dv.advise(scene.model, scene.model.rest_points, scene.v, duration=scene.duration, error=error,
                  gradient=gradient, patience=PATIENCE, **scene.given)  # fmt: skip
    told = s.predicted
    assert told is not None
    row: Row = {"scene": scene.name, "asked": error, "gradient": gradient, "reached": told.reached,
                "settings": str(replace(s, predicted=None)), "predicted": told.error, "true": None, "unsure": None,
                "ms": 1e3 * told.seconds, "cost": told.cost, "spent": told.spent,
                "why": "" if told.reached else told.why}  # fmt: skip
    if not told.reached:
        return row, s, None
    runs = pilots(scene, gradient)
    truth, row["unsure"] = exact(runs, s)
    row["true"] = distance(runs, runs.run(s, s.steps(scene.duration)), truth)
    return row, s, truth


def best(scene: Scene, error: float, advised: dv.Settings, truth: Pilot) -> Row:
    """The fastest settings of the grid that keep the error, each with the fewest steps that do, to a factor of 1.4."""
    runs = pilots(scene)
    own = min(runs.run(advised, advised.steps(scene.duration)).seconds for _ in range(3))
    least, name = math.inf, ""
    for settings in GRID:
        if scene.model.touches and (settings.coarse is not None or settings.relaxation > 1):
            continue
        steps = float(FRAMES)
        while steps < 2**14:
            run = runs.run(settings, FRAMES * round(steps / FRAMES))
            if run.seconds > min(own, least):
                break
            if distance(runs, run, truth) <= error:
                seconds = min([run.seconds, *(runs.run(settings, run.steps).seconds for _ in range(2))])
                if seconds < least:
                    least, name = seconds, str(run.settings)
                break
            steps *= 1.4
    return {"ms": 1e3 * own, "best_ms": 1e3 * min(own, least), "best": name or "the advised"}


def kept_of(number: int, quick: bool) -> list[Row]:
    """The rows of one scene."""
    rows, scene = [], drawn(number)
    for error in ERRORS[:1] if quick else ERRORS:
        row, settings, truth = asked(scene, error, False)
        compare = truth is not None and number < EXHAUSTIVE and error == 0.01
        rows.append(row | (best(scene, error, settings, truth) if compare and truth is not None else {}))
    if number < GRADIENTS and not quick:
        rows.append(asked(scene, 0.01, True)[0])
    print(f"scene {number}", file=sys.stderr, flush=True)
    return rows


def kept(quick: bool) -> list[Row]:
    found = dict(common.side_by_side(kept_of, range(2 if quick else SCENES), quick, at_once=not quick))
    return [row for number in sorted(found) for row in found[number]]


def beam(quick: bool) -> list[Row]:
    """The cantilever of docs/numerics.md to 0.1 %, beside the fastest implicit Euler, coarse corrections included."""
    body = (
        dv.mesh.beam(7, 3, 3, size=(0.6, 0.15, 0.15), split="kuhn")
        if quick
        else dv.mesh.beam(13, 4, 4, size=(0.6, 0.15, 0.15), split="kuhn")
    )
    model = dv.Model(body, pinned=torch.tensor(body.points[:, 0] < 1e-9))
    scene = Scene("cantilever of 0.6 m, 1e5 Pa", model, torch.zeros_like(model.rest_points), 0.4,
                  {"mu": 1e5, "lam": 2e5})  # fmt: skip
    return [against_euler(scene, 0.02 if quick else 0.001)]


def drop(quick: bool) -> list[Row]:
    """A bunny dropped for 0.3 s on a floor, to 10 % and 1 %."""
    body = dv.mesh.blob(4, 1, 0.1) if quick else dv.mesh.bunny(9, 0.2)
    body = body.translate((0, 0.05 - body.points[:, 1].min(), 0))
    model = dv.Model(body, energies=(dv.StableNeoHookean(), dv.FloorBarrier(kappa=1e3, dhat=DHAT_OF_DROP)))
    scene = Scene("bunny dropped 5 cm, 0.3 s", model, torch.zeros_like(model.rest_points), 0.02 if quick else 0.3,
                  {"young": 5e4, "poisson": 0.3})  # fmt: skip
    return [against_euler(scene, error) for error in ((0.1,) if quick else (0.1, 0.01))]


DHAT_OF_DROP = 2e-3  # [m]


def against_euler(scene: Scene, error: float) -> Row:
    row, settings, truth = asked(scene, error, False)
    row |= {"euler_ms": None, "euler": None}
    if truth is None:
        return row
    runs = pilots(scene)
    row["ms"] = 1e3 * min(runs.run(settings, settings.steps(scene.duration)).seconds for _ in range(3))
    least, name, began = math.inf, "", time.perf_counter()
    for option in (o for o in GRID if isinstance(o.integrator, dv.ImplicitEuler)):
        steps = 4.0 * FRAMES
        while time.perf_counter() - began < 300:
            run = runs.run(option, FRAMES * round(steps / FRAMES))
            if run.seconds > least:
                break
            if distance(runs, run, truth) <= error:
                least, name = run.seconds, str(run.settings)
                break
            steps *= 1.5
    return row | {"euler_ms": 1e3 * least, "euler": name}


GROUPS = {"kept": kept, "beam": beam, "drop": drop, "fit": fit}


def run(quick: bool, only: str | None = None, out: Path | None = None) -> dict[str, Any]:
    chosen = list(GROUPS) if only is None else [name.strip() for name in only.split(",")]
    if unknown := [name for name in chosen if name not in GROUPS]:
        raise ValueError(f"only: expected groups among {', '.join(GROUPS)}, got {', '.join(unknown)}")
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    environment = common.environment()
    results = common.earlier(None if out is None else out / "advice.json", quick, environment["device"])
    try:
        for name in chosen:
            results[name] = {"rows": GROUPS[name](quick), **common.stamp(environment)}
            if out is not None:
                common.write("advice", results, out, quick=quick)
    finally:
        torch.set_num_threads(threads)
    return {name: results[name] for name in GROUPS if name in results}


def shares(rows: list[Row]) -> list[tuple[Any, ...]]:
    """Of each wanted error: how many scenes reach it, keep it, are not far below it, and what the advice cost."""
    out = []
    for gradient in (False, True):
        for error in ERRORS:
            found = [r for r in rows if r["asked"] == error and r["gradient"] == gradient]
            told = [r for r in found if r["reached"]]
            if not told:
                continue
            within = sum(r["true"] <= error for r in told)
            near = sum(r["true"] >= error / 20 for r in told)
            long = [r["cost"] for r in told if r["spent"] > 0.5]
            out.append((error, gradient, len(found), len(told), within, near, max(long, default=None)))
    return out


def markdown(results: dict[str, Any]) -> str:
    text = []
    if "kept" in results:
        rows = results["kept"]["rows"]
        header = ("asked", "gradients too", "scenes", "said it can be had", "true error at most that",
                  "at least a twentieth", "largest cost [rollouts]")  # fmt: skip
        text += ["## Scenes drawn by a seed\n", markdown_table(header, shares(rows))]
        compared = [r for r in rows if r.get("best_ms") and r["ms"] > 1e3 * FEWEST]
        if compared:
            twice = sum(r["ms"] <= 2 * r["best_ms"] for r in compared)
            text.append(
                f"Within twice the best time of the grid: {twice} of {len(compared)} that take {FEWEST} s or more.\n"
            )
        keys = ("scene", "asked", "gradient", "settings", "predicted", "true", "unsure", "ms", "best_ms", "best",
                "cost", "why")  # fmt: skip
        header = ("scene", "asked", "gradients", "settings", "predicted", "true error", "of which unsure", "ms",
                  "best of the grid [ms]", "its settings", "cost", "why not")  # fmt: skip
        text.append(markdown_table(header, ([row.get(key) for key in keys] for row in rows)))
    for name in ("beam", "drop"):
        if name in results:
            keys = ("scene", "asked", "settings", "true", "ms", "euler_ms", "euler", "cost", "why")
            header = ("scene", "asked", "advised", "true error", "ms", "implicit Euler [ms]", "its settings", "cost",
                      "why not")  # fmt: skip
            rows = results[name]["rows"]
            text += [f"## {name}\n", markdown_table(header, ([row.get(key) for key in keys] for row in rows))]
    if "fit" in results:
        keys = ("fit", "young", "poisson", "left", "evaluations", "seconds", "over_first")
        header = ("fit of E = 50,000 Pa, nu = 0.3", "E [Pa]", "nu", "left of the shapes", "evaluations", "s",
                  "over the first")  # fmt: skip
        rows = results["fit"]["rows"]
        text += ["## fit\n", markdown_table(header, ([row.get(key) for key in keys] for row in rows))]
    return "\n".join(text)
