"""Speed against accuracy: error of a motion and of its gradient over the time that they take, for each choice there is.

Nine scenes from soft to extreme. Each way runs with ever shorter steps and several numbers of sweeps; its error is the
distance to a reference of much shorter steps and more sweeps (root mean square over vertices and four frames, over the
motion), and that of the gradient of the mean squared way with respect to each modulus and a velocity of all vertices.
Times are those of one rollout, and of one with its backward. Scenes run side by side, one thread each.
"""

from __future__ import annotations

import math
import sys
import time
import warnings
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

import diffvbd as dv
from bench import common
from bench.advice_scenes import Scene
from bench.common import digits, markdown_table
from bench.tradeoff_peers import peers
from bench.tradeoff_scenes import SCENES, gripper, pile
from diffvbd.rollout.tune import FRAMES, Pilot, Pilots, converted, pilots_of
from diffvbd.rollout.tune import start_of

LONGEST = 1 / 30  # [s], the first step
ERRORS = (0.1, 0.01, 0.001)
Row = dict[str, Any]


@dataclass(frozen=True)
class Effort:
    """How long a run may take."""

    rung: float  # [s]: runs longer than this end a way
    reference: float  # [s]: as long as all runs toward the reference
    patience: float  # [s] of dv.advise
    finest: float  # an error below which no shorter step is tried


FULL, QUICK = Effort(0.5, 40.0, 40.0, 3e-4), Effort(0.05, 1.0, 1.0, 2e-2)


@dataclass(frozen=True)
class Way:
    """Settings but for the step, and numbers of sweeps; `changes` are arguments of Model.replace."""

    name: str
    settings: dv.Settings
    sweeps: tuple[int, ...]
    changes: tuple[tuple[str, Any], ...] = ()
    elastic: bool = True  # whether it is for scenes without contact
    contact: bool = True  # and with it
    gradient_only: bool = False  # what changes no motion


def _plain(**options: Any) -> dv.Settings:
    return dv.Settings(1.0, 1, **options)


COARSE: dict[str, Any] = {"relaxation": 1.5, "coarse": "auto"}
SDIRK2, BDF2 = dv.SDIRK2(), dv.BDF2()
WAYS = [
    Way("implicit Euler", _plain(), (5, 20, 80)),
    Way("implicit Euler, relaxation 1.6", _plain(relaxation=1.6), (20, 80), contact=False),
    Way("implicit Euler, start at y", _plain(), (20,), (("start", "predictor"),)),
    Way("implicit Euler, start at x + h v", _plain(), (20,), (("start", "inertia"),)),
    Way("implicit Euler, coarse", _plain(**COARSE), (2, 8)),
    Way("implicit Euler, block of the paper", _plain(block="paper"), (20,)),
    Way("SDIRK2", _plain(integrator=SDIRK2), (5, 20, 80)),
    Way("SDIRK2, relaxation 1.6", _plain(integrator=SDIRK2, relaxation=1.6), (20, 80), contact=False),
    Way("SDIRK2, coarse", _plain(integrator=SDIRK2, **COARSE), (2, 8)),
    Way("SDIRK2, coarse, float32", _plain(integrator=SDIRK2, dtype=torch.float32, **COARSE), (8,), contact=False),
    Way("SDIRK2, float32", _plain(integrator=SDIRK2, dtype=torch.float32), (20,), elastic=False),
    Way("BDF2", _plain(integrator=BDF2), (20,)),
    Way("BDF2, coarse", _plain(integrator=BDF2, **COARSE), (2, 8)),
    Way("SDIRK2, full tape", _plain(integrator=SDIRK2, tape="full"), (20,), gradient_only=True),
    Way("SDIRK2, compact tape", _plain(integrator=SDIRK2, tape="compact"), (20,), gradient_only=True),
    Way("SDIRK2, recomputed tape", _plain(integrator=SDIRK2, tape="recompute"), (20,), gradient_only=True),
    Way("SDIRK2, a checkpoint every 8 steps", _plain(integrator=SDIRK2, checkpoint_every=8), (20,),
        gradient_only=True),
]  # fmt: skip
BARRIERS: list[tuple[str, dict[str, Any]]] = [
    ("1 detection", {"detections": 1}),
    ("4 detections", {"detections": 4}),
    ("dhat / 2", {"dhat": 1e-3}),
    ("dhat x 2", {"dhat": 4e-3}),
    ("kappa / 10", {"kappa": 1e3}),
    ("kappa x 10", {"kappa": 1e5}),
]


# ways that are no others for the motion of the scene: they differ in the backward, or move in another scene
ASIDE = {f"SDIRK2, {label}" for label, _ in BARRIERS} | {way.name for way in WAYS if way.gradient_only}


class Front:
    """Runs of one scene, held against its reference."""

    def __init__(self, scene: Scene, effort: Effort, device: str) -> None:
        self.effort, self.device = effort, device
        model = scene.model.to(device)
        self.scene = replace(scene, model=model, v=scene.v.to(device), given=converted(scene.given, device=device))
        self.truth, self.unsure = self.reference()

    def pilots(self, gradient: bool, model: dv.Model | None = None) -> Pilots:
        scene = self.scene
        model = scene.model if model is None else model
        v, given = converted(scene.v, dtype=model.dtype), converted(scene.given, dtype=model.dtype)
        return pilots_of(dv.rollout, model, model.rest_points, v, scene.duration, None, gradient, given)

    def reference(self) -> tuple[Pilot, tuple[float, float]]:
        """The last of ever finer runs, and how far its motion and its gradient may be off."""
        runs = self.pilots(gradient=True)
        own = start_of(runs)
        settings = replace(own, sweeps=20 if own.coarse else 80)
        steps, last, off = FRAMES * math.ceil(self.scene.duration / (FRAMES * LONGEST)), None, (math.inf, math.inf)
        while True:
            now = runs.run(settings, steps)
            if last is not None and now.x is not None:
                off = self.errors(now, last)
            last = now if now.x is not None else last
            if max(off) < 0.3 * self.effort.finest or runs.spent + 2 * now.seconds > self.effort.reference:
                break
            steps *= 2
        if last is None:
            raise RuntimeError(f"{self.scene.name}: no reference: {now.failure}")
        return last, off

    def errors(self, truth: Pilot, run: Pilot) -> tuple[float, float]:
        """Of motion and gradient."""
        if run.x is None or truth.x is None:
            return math.inf, math.inf
        runs = self._runs
        motion = runs.apart(run.x.to(truth.x), truth.x)
        apart = [float((a.to(b) - b).norm() / b.norm().clamp(min=1e-300))
                 for a, b in zip(run.gradient, truth.gradient, strict=False)]  # fmt: skip
        return motion, max(apart, default=math.inf)

    def distance(self, frames: torch.Tensor) -> float:
        """Of frames [FRAMES, V, 3] to the reference."""
        assert self.truth.x is not None
        return self._runs.apart(torch.cat([self.truth.x[:1], frames.to(self.truth.x)]), self.truth.x)

    @property
    def _runs(self) -> Pilots:
        return Pilots(dv.rollout, self.scene.model, self.scene.model.rest_points, self.scene.v, self.scene.duration,
                      self.scene.given)  # fmt: skip

    def way(self, way: Way) -> list[Row]:
        model = self.scene.model
        if way.changes:
            model = model.replace(**dict(way.changes))
        if way.settings.dtype is not None:
            model = model.to(dtype=way.settings.dtype)
        forward, both = self.pilots(False, model), self.pilots(True, model)
        # not timed: the first checkpointed backward of a process loads torch's compiler, for seconds
        both.run(replace(way.settings, sweeps=1), 4 * FRAMES)
        out = []
        for sweeps in way.sweeps:
            settings = replace(way.settings, sweeps=sweeps)
            steps = FRAMES * math.ceil(self.scene.duration / (FRAMES * LONGEST))
            while True:
                run, back = forward.run(settings, steps), both.run(settings, steps)
                motion, gradient = self.errors(self.truth, back if back.gradient else run)
                out.append({"way": way.name, "sweeps": sweeps, "steps": steps, "ms": 1e3 * run.seconds,
                            "error": motion, "both_ms": 1e3 * back.seconds, "gradient_error": gradient})  # fmt: skip
                slow = max(run.seconds, 0.3 * back.seconds) if run.x is not None else 0.0
                if way.gradient_only or slow > self.effort.rung or motion < self.effort.finest or steps > 2**13:
                    break
                steps *= 2
        return out

    def advised(self) -> list[Row]:
        """What dv.advise says, run against the same reference."""
        runs, out, s = self.pilots(False), [], self.scene
        for error in ERRORS:
            told = dv.advise(s.model, s.model.rest_points, s.v, duration=s.duration, error=error,
                             patience=self.effort.patience, **s.given)  # fmt: skip
            assert told.predicted is not None
            reached = told.predicted.reached
            run = runs.run(told, told.steps(s.duration))
            out.append({"asked": error, "settings": str(replace(told, predicted=None)), "reached": reached,
                        "ms": 1e3 * run.seconds, "error": self.errors(self.truth, run)[0],
                        "spent": told.predicted.spent, "why": "" if reached else told.predicted.why})  # fmt: skip
        return out


def measured(name: str, quick: bool, device: str) -> Row:
    """All ways on one scene."""
    torch.set_num_threads(1)
    effort, began = QUICK if quick else FULL, time.perf_counter()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        front = Front(SCENES[name](), effort, device)
        model = front.scene.model
        rows = []
        for way in WAYS[:1] if quick else WAYS:
            if not (way.contact if model.touches or model.floor is not None else way.elastic):
                continue
            try:
                rows += front.way(way)
            except (ValueError, NotImplementedError) as error:  # what this scene does not support
                rows.append({"way": way.name, "why": str(error)[:160]})
        for label, options in [] if quick else BARRIERS:
            if (make := {"pile": pile, "gripper": gripper}.get(name)) is not None:
                changed = (("energies", make(**options).model.energies),)
                rows += front.way(Way(f"SDIRK2, {label}", _plain(integrator=SDIRK2), (20,), changed))
        others = peers(front.scene, front.distance, quick) if name in ("soft", "stiff") and device == "cpu" else []
        advised = front.advised()
    print(f"{name}: {time.perf_counter() - began:.0f} s", file=sys.stderr, flush=True)
    return {"scene": front.scene.name, "vertices": model.num_vertices, "duration": front.scene.duration,
            "unsure": front.unsure[0], "gradient_unsure": front.unsure[1], "rows": rows, "advised": advised,
            "peers": others}  # fmt: skip


def run(quick: bool, device: str = "cpu", only: str | None = None, out: Path | None = None) -> dict[str, Any]:
    chosen = list(SCENES) if only is None else [name.strip() for name in only.split(",")]
    if unknown := [name for name in chosen if name not in SCENES]:
        raise ValueError(f"only: expected scenes among {', '.join(SCENES)}, got {', '.join(unknown)}")
    environment = common.environment(device)
    path = None if out is None else out / f"tradeoff{common.device_suffix(device)}.json"
    results = common.earlier(path, quick, environment["device"])
    at_once = device == "cpu" and not quick
    for name, group in common.side_by_side(measured, chosen, quick, device, at_once=at_once):
        results[name] = group | common.stamp(environment)
        if out is not None:
            common.write("tradeoff", results, out, quick=quick, device=device, suffix=common.device_suffix(device))
    return {name: results[name] for name in SCENES if name in results}


def best(rows: list[Row], error: float, by: str = "error", time: str = "ms") -> Row | None:
    """The row that takes the least time of those within an error."""
    within = [r for r in rows if isinstance(r.get(by), float) and r[by] <= error and isinstance(r[time], float)]
    return min(within, key=lambda r: r[time], default=None)


def front_of(rows: list[Row], by: str = "error", time: str = "ms") -> list[Row]:
    """Those that no other beats in both time and error, fastest first."""
    out: list[Row] = []
    for row in sorted((r for r in rows if isinstance(r.get(by), float)), key=lambda r: r[time]):
        if not out or row[by] < out[-1][by]:
            out.append(row)
    return out


def _said(row: Row | None, time: str = "ms") -> str:
    return "-" if row is None else f"{row['way']}, K = {row['sweeps']}, {row['steps']} steps: {digits(row[time])} ms"


def others_of(rows: list[Row]) -> list[list[Any]]:
    """A line for each other solver."""
    out = []
    for name in dict.fromkeys(row["solver"] for row in rows):
        own = [row for row in rows if row["solver"] == name]
        cells = [best(own, e) for e in ERRORS]
        least = min(
            (row for row in own if isinstance(row.get("error"), float)), key=lambda r: r["error"], default=own[0]
        )
        out.append([name, *(None if c is None else c["ms"] for c in cells), least.get("error"), least.get("ms"),
                    least["note"]])  # fmt: skip
    return out


def markdown(results: dict[str, Any]) -> str:
    """The fastest way to each error, what the default does, and what is advised."""
    text, header = [], ("error", "fastest motion", "implicit Euler alone", "fastest gradient", "advised")
    for group in results.values():
        rows = [r for r in group["rows"] if "steps" in r]
        own = [r for r in rows if r["way"] not in ASIDE]
        euler = [r for r in own if r["way"] == "implicit Euler"]
        table = []
        for error in ERRORS:
            told = next((a for a in group["advised"] if a["asked"] == error), None)
            said = "-" if told is None else f"{told['settings']}: {digits(told['ms'])} ms, error {told['error']:.2g}"
            if told is not None and not told["reached"]:
                said = f"cannot be had: {told['why']}"
            table.append((error, _said(best(own, error)), _said(best(euler, error)),
                          _said(best(own, error, "gradient_error", "both_ms"), "both_ms"), said))  # fmt: skip
        unsure = f"{group['unsure']:.1g} (gradient {group['gradient_unsure']:.1g})" if isinstance(
            group["unsure"], float) else "unknown"  # fmt: skip
        text.append(f"## {group['scene']}, {group['vertices']} vertices, {group['duration']:.3g} s\n\n"
                    f"The reference may be off by {unsure}.\n\n{markdown_table(header, table)}")  # fmt: skip
        ways = []
        for name in dict.fromkeys(r["way"] for r in rows):
            of_way = [r for r in rows if r["way"] == name and isinstance(r["error"], float)]
            if not of_way:
                continue
            cells = [best(of_way, e) for e in ERRORS]
            least = min(of_way, key=lambda r: r["error"])
            ways.append([name, *(None if c is None else c["ms"] for c in cells), least["error"], least["ms"],
                         least["both_ms"]])  # fmt: skip
        text.append(markdown_table(("way", *(f"ms to {e:g}" for e in ERRORS), "least error", "in ms",
                                    "with backward"), ways))  # fmt: skip
        if group["peers"]:
            text.append(markdown_table(("solver", *(f"ms to {e:g}" for e in ERRORS), "least error", "in ms", "note"),
                                       others_of(group["peers"])))  # fmt: skip
    return "\n".join(text) + "\n" + common.of_several_runs(results)


def summary(results: dict[str, Any], error: float = 0.01) -> str:
    """A line for each scene: the fastest way to an error of the motion, implicit Euler alone, what dv.advise says."""
    table = []
    for group in results.values():
        own = [r for r in group["rows"] if "steps" in r and r["way"] not in ASIDE]
        euler = [r for r in own if r["way"] == "implicit Euler" and isinstance(r["error"], float)]
        least, fastest = min(r["error"] for r in euler), best(euler, error)
        told = next(a for a in group["advised"] if a["asked"] == error)
        table.append((group["scene"], f"{group['vertices']}, {group['duration']:.3g} s", _said(best(own, error)),
                      f"not in the time allowed (least {least:.1g})" if fastest is None
                      else f"{digits(fastest['ms'])} ms",
                      f"{digits(told['ms'])} ms: {told['error']:.1g}" if told["reached"]
                      else "cannot be had"))  # fmt: skip
    header = ("scene", "vertices, duration", "the fastest way", "implicit Euler alone",
              f"`dv.advise` for {100 * error:g} %: its true error")  # fmt: skip
    return markdown_table(header, table) + "\n" + common.of_several_runs(results)
