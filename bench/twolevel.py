"""Coarse corrections between sweeps, with Anderson acceleration and without: error and time beside plain sweeps.

Error: the largest distance of a vertex from where converged steps of the same h end, over the largest motion, after 30
steps. Time: a whole step, on one thread, everything included; also in plain sweeps of the same scene, and as the K of a
plain step that takes as long. With coarse corrections relaxation is 1.5; plain sweeps have the best of three
relaxations and two starts at each K. Anderson acceleration: of cycles with corrections, window 2; and of plain sweeps,
window 5, relaxation 1.3.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

import diffvbd as dv
from bench.common import markdown_table
from bench.twolevel_scenes import Scene, functions, hanging_bar, scenes, violent_scenes
from diffvbd import reference

SWEEPS = (1, 2, 4, 5, 7, 8, 10, 11, 13, 14, 16, 17, 19, 20, 22, 23, 25, 31, 40, 52, 70, 100, 150, 200, 300)
PLAIN_SWEEPS = (5, 10, 20, 50, 100, 200, 300)
LAST = 1000  # plain sweeps where those do not reach 1 %
PLAIN = tuple((relaxation, start) for relaxation in (1.0, 1.6, 1.8) for start in ("auto", "inertia"))
# methods beside plain sweeps: name, arguments of Scene.model
METHODS: dict[str, dict[str, Any]] = {
    "two_level": {},
    "two_level_anderson": {"window": 2},
    "plain_anderson": {"coarse": None, "relaxation": 1.3, "start": "inertia", "window": 5},
}
VIOLENT_SWEEPS = (13, 25, 49)
ROUNDS = 7  # of times
LEVELS = (0.01, 1e-4)
CONVERGED = 1e-7  # of the motion, between two K
RISE = 1e-12  # of the potential at the start of a step, below which a rise counts as none
HANGING, VIOLENT_RATIO = 1e-3, 1.3  # targets; those of calm scenes stand in `scenes`


def run(quick: bool, only: str = "scenes,violent") -> dict[str, Any]:
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    groups: dict[str, Callable[[bool], Any]] = {
        "scenes": lambda quick: [measure(scene, quick) for scene in scenes(quick)],
        "violent": lambda quick: [row for scene in violent_scenes(quick) for row in violent(scene, quick)],
    }
    try:
        return {name: groups[name](quick) for name in only.split(",")}
    finally:
        torch.set_num_threads(threads)


def converged(scene: Scene, steps: int, quick: bool, most: int = 6400) -> tuple[Tensor, dict[str, float]]:
    """Where converged steps end, and how well they have: of the last step the share of its forces left over."""
    model = scene.model()
    sweeps, last, apart = 100 if quick else 200, None, float("inf")
    while True:
        way = scene.rolled(model, sweeps, steps)
        moved = float((way.x[-1] - way.x[0]).norm(dim=-1).max())
        if last is not None:
            apart = float((way.x[-1] - last).norm(dim=-1).max()) / moved
        if apart < CONVERGED or sweeps >= most:
            break
        last, sweeps = way.x[-1], 2 * sweeps
    left = dv.diagnose(model, way.x[-1], time_step=scene.time_step, previous=(way.x[-2], way.v[-2]), warn=False,
                       **scene.material)  # fmt: skip
    found = {"sweeps": sweeps, "apart": apart, "unbalanced": left.unbalanced, "motion": moved, "courant": left.courant}
    return way.x[-1], found


def measure(scene: Scene, quick: bool) -> dict[str, Any]:
    steps = 5 if quick else 30
    goal, found = converged(scene, steps, quick)

    def error(model: dv.Model, sweeps: int) -> float:
        return float((scene.end(model, sweeps, steps) - goal).norm(dim=-1).max()) / found["motion"]

    own = {name: scene.model(**options) for name, options in METHODS.items()}
    counts = SWEEPS[:6] if quick else SWEEPS
    found_by = {name: [{"sweeps": k, "error": error(model, k)} for k in counts] for name, model in own.items()}
    models = {options: scene.model(None, *options) for options in PLAIN}
    plain = []
    for k in PLAIN_SWEEPS[:4] if quick else PLAIN_SWEEPS:
        best = min((error(m, k), *options) for options, m in models.items())
        plain.append({"sweeps": k, "error": best[0], "relaxation": best[1], "start": best[2]})
    if not quick and plain[-1]["error"] > LEVELS[0]:
        options = (plain[-1]["relaxation"], plain[-1]["start"])
        plain.append({**plain[-1], "sweeps": LAST, "error": error(models[options], LAST)})
    timed = [(own[name], rows) for name, rows in found_by.items()]
    least_times(scene, [*timed, (models[PLAIN[0]], plain)], 2 if quick else ROUNDS)
    sweep, fixed = line(plain)
    reached = {}
    for name, rows in (*found_by.items(), ("plain", plain)):
        for level in LEVELS:
            at = first_below(rows, level)
            reached[f"{name}_{level:g}"] = None if at is None else {"K": at["sweeps"], "ms": at["ms"],
                "sweeps": at["ms"] / sweep, "plain_K": (at["ms"] - fixed) / sweep}  # fmt: skip
    row = {"scene": scene.name, "vertices": scene.mesh.num_vertices, "functions": functions(own["two_level"]),
           "reference": found, "sweep_ms": sweep, "fixed_ms": fixed, "targets": scene.targets, **reached,
           **found_by, "plain": plain}  # fmt: skip
    if scene.name == "hanging bar":
        row["at_rest"] = at_rest(quick)
    _say(scene.name, {k: v for k, v in row.items() if k not in (*METHODS, "plain")})
    return row


def least_times(scene: Scene, models: list[tuple[dv.Model, list[dict[str, Any]]]], rounds: int) -> None:
    """Adds to each row the time of a step, the least of several rounds of all: the machine is not always as fast."""
    for n in range(rounds):
        for model, rows in models:
            for row in rows:
                if row["sweeps"] <= 100 or n < 2:
                    row["ms"] = min(row.get("ms", float("inf")), 1e3 * scene.seconds(model, row["sweeps"]))


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


def at_rest(quick: bool) -> list[dict[str, Any]]:
    """Error of the elongation at which steps without inertia come to rest, as `bench sweeps` measures it."""
    scene, out, ends = hanging_bar(), [], {}
    for k in (10,) if quick else (500, 5, 10, 20):
        model, (x, v) = scene.model(), scene.state()
        for _ in range(20 if quick else 2000):
            before, (x, _) = x, dv.step(model, x, v, time_step=scene.time_step, sweeps=k, **scene.material)
            if float((x - before).abs().max()) < 1e-12:
                break
        ends[k] = float(-1 - x[:, 1].min())
        out.append({"sweeps": k, "elongation": ends[k], "error": ends[k] / ends[next(iter(ends))] - 1})
    return out


def violent(scene: Scene, quick: bool) -> list[dict[str, Any]]:
    """Two-level and plain sweeps of equal relaxation and time; whether steps descend from where they start."""
    steps = 5 if quick else 30
    goal, found = converged(scene, steps, quick, 1600)
    two, plain = scene.model(), scene.model(None)
    # where minima are several, plain sweeps may come to another; each error is to the nearer
    other = scene.end(plain, 200 if quick else 3000, steps)
    motion = found["motion"]

    def error(way: dv.Trajectory) -> float:
        return min(float((way.x[-1] - g).norm(dim=-1).max()) for g in (goal, other)) / motion

    rows = [{"sweeps": k} for k in (VIOLENT_SWEEPS[:1] if quick else VIOLENT_SWEEPS)]
    beside = [{"sweeps": 10}, {"sweeps": 50}]
    least_times(scene, [(two, rows), (plain, beside)], 2 if quick else ROUNDS)
    sweep, fixed = line(beside)
    out = []
    for row in rows:
        k, ms = row["sweeps"], row["ms"]
        same = max(1, round((ms - fixed) / sweep))
        with dv.coarse.record() as lengths:
            way = scene.rolled(two, k, steps)
        plainly = scene.rolled(plain, same, steps)
        errors = error(way), error(plainly)
        # one K may be lucky, so means over K nearby as well
        around = [error(scene.rolled(two, k + d, steps)) for d in (-6, -3, 0, 3, 6)]
        plainly_around = [error(scene.rolled(plain, max(1, round(same * f)), steps)) for f in (0.8, 0.9, 1, 1.1, 1.25)]
        out.append({
            "scene": scene.name, "sweeps": k, "ms": ms, "plain_sweeps": same, "error": errors[0],
            "plain_error": errors[1], "ratio": errors[0] / errors[1],
            "ratio_near": mean(around) / mean(plainly_around),
            "rise": rise(scene, plain, way), "plain_rise": rise(scene, plain, plainly),
            "mean_length": float(torch.cat([s.flatten() for s in lengths]).mean()),
            "references_apart": float((goal - other).norm(dim=-1).max()) / motion, "reference": found,
        })  # fmt: skip
        _say(scene.name, out[-1])
    return out


def mean(errors: list[float]) -> float:
    return float(np.exp(np.mean(np.log(errors))))


def rise(scene: Scene, model: dv.Model, way: dv.Trajectory) -> float:
    """The largest rise of the incremental potential from where a step's sweeps start to its end, over what it is
    there; negative where all steps descend. model: without corrections, so that no sweeps end where they start."""
    h, worst = scene.time_step, -float("inf")
    gravity = torch.tensor([0.0, -9.81, 0.0], dtype=torch.float64)
    for n in range(len(way.x) - 1):
        x, v = way.x[n], way.v[n]
        y = torch.where(model.pinned[:, None], x, x + h * v + h * h * gravity)
        start, _ = dv.step(model, x, v, time_step=h, sweeps=0, **scene.material)
        before, after = (
            float(reference.incremental_potential(model, at, y, **scene.material, time_step=h, x_prev=x))
            for at in (start, way.x[n + 1])
        )
        worst = max(worst, (after - before) / max(abs(before), 1e-300))
    return worst


def _say(name: str, row: dict[str, Any]) -> None:
    print(name, row, file=sys.stderr, flush=True)


# --- text -------------------------------------------------------------------------------------------------------------


def markdown(results: dict[str, Any]) -> str:
    parts = []
    if rows := results.get("scenes"):
        header = ("scene", "vertices", "functions", "method", "1 %: K", "ms", "sweeps", "equal K", "0.01 %: K", "ms",
                  "sweeps", "equal K", "error left", "targets")  # fmt: skip
        parts.append("## Time to an error, and what is left at the most sweeps\n\n" + markdown_table(
            header, [_time_row(row, name) for row in rows for name in (*METHODS, "plain") if name in row]))  # fmt: skip
        counts = [row["sweeps"] for row in rows[0]["two_level"]]
        for method in METHODS:
            table = [[row["scene"], *(r["error"] for r in row[method])] for row in rows if method in row]
            title = f"## Error over motion by K, {method.replace('_', ' ')}\n\n"
            parts.append(title + markdown_table(["scene", *map(str, counts)], table))
        table = [[row["scene"], *(f"{r['error']:.3g} ({r['relaxation']:g}, {r['start']})" for r in row["plain"][:7])]
                 for row in rows]  # fmt: skip
        counts = [row["sweeps"] for row in rows[0]["plain"][:7]]
        parts.append("## Plain sweeps: error over motion by K (relaxation, start)\n\n"
                     + markdown_table(["scene", *map(str, counts)], table))  # fmt: skip
        table = [[row["scene"], row["sweep_ms"], row["fixed_ms"], *row["reference"].values()] for row in rows]
        header = ("scene", "ms of a plain sweep", "ms besides", *(k.replace("_", " ") for k in rows[0]["reference"]))
        parts.append("## References: K, difference of the last two K over motion\n\n" + markdown_table(header, table))
        for row in rows:
            if "at_rest" in row:
                table = markdown_table(list(row["at_rest"][0]), [list(r.values()) for r in row["at_rest"]])
                error = next(r["error"] for r in row["two_level"] if r["sweeps"] == 10)
                text = f"Error over motion after 30 steps of K = 10: {error:.3g}; target {HANGING:g}.\n\n"
                parts.append("## Hanging bar: elongation where steps with corrections come to rest\n\n" + text + table)
    if rows := results.get("violent"):
        names = ("scene", "sweeps", "ms", "plain_sweeps", "error", "plain_error", "ratio", "ratio_near", "rise",
                 "plain_rise", "mean_length", "references_apart")  # fmt: skip
        risen = sum(row["rise"] > RISE for row in rows)
        text = f"Target of the ratio: {VIOLENT_RATIO:g}. Rollouts with a step that rises: {risen} of {len(rows)}.\n\n"
        table = markdown_table([n.replace("_", " ") for n in names], [[row[n] for n in names] for row in rows])
        parts.append("## Violent states: beside plain sweeps of equal relaxation and time\n\n" + text + table)
    return "\n".join(parts)


def _time_row(row: dict[str, Any], method: str) -> list[Any]:
    out = [row["scene"], row["vertices"], row["functions"], method.replace("_", " ")]
    for level in LEVELS:
        at = row[f"{method}_{level:g}"]
        out += ["not reached", None, None, None] if at is None else list(at.values())
    last = row[method][-1]
    targets = " / ".join("-" if t is None else f"{t:g}" for t in row["targets"]) if method == "two_level" else None
    return [*out, f"{last['error']:.3g} at {last['sweeps']}", targets]
