"""Bodies that meet a floor: rollouts of 20 sweeps, plain and with coarse corrections, against converged steps."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import torch

import diffvbd as dv
from bench import floors_scenes
from bench.common import cell, markdown_table
from bench.floors_newton import Array
from bench.floors_scenes import Scene

COUNT, QUICK = 300, 30
SWEEPS, OFF = 20, 0.05
MORE = (40, 80, 160, 320, 640, 1280)
KINDS: dict[str, Any] = {"plain": None, "coarse": "auto"}


def run(quick: bool) -> dict[str, Any]:
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        return {"rebound": rebound(), "pressed": pressed(), "rollouts": rollouts(range(QUICK if quick else COUNT))}
    finally:
        torch.set_num_threads(threads)


def rebound() -> list[dict[str, Any]]:
    """How much of its speed the ball keeps."""
    scene = floors_scenes.falling_ball()
    _, v = scene.body.rollout(scene.mesh.points, scene.v, scene.steps)
    exact, out = _upward(scene, v[-1]) / 2.0, []
    for kind, coarse in KINDS.items():
        for sweeps in (8, 20, 100):
            motion, _, said = scene.executed(sweeps, coarse)
            share = _upward(scene, motion.v[-1].numpy()) / 2.0
            out.append({"corrections": kind, "sweeps": sweeps, "rebound": share, "converged": exact,
                        "said": _short(said)})  # fmt: skip
    return out


def pressed() -> list[dict[str, Any]]:
    """What the floor exerts on the pressed ball, and what its holder bears [N]."""
    scene, b = (made := floors_scenes.pressed_ball()), made.body
    x, _ = b.rollout(scene.mesh.points, scene.v, scene.steps, scene.prescribed)
    exact, out = b.floor_force(x[-1]), []
    for kind, coarse in KINDS.items():
        for sweeps in (8, 20, 100):
            motion, model, said = scene.executed(sweeps, coarse)
            floor = float(dv.contact.forces(model, motion.x[-1]).floors.normal[0, 0, 1])
            held = dv.reactions(model, motion.x[-1], young=b.young, poisson=b.poisson, gravity=b.gravity)
            out.append({"corrections": kind, "sweeps": sweeps, "floor [N]": floor,
                        "reactions [N]": -float(held[:, 1].sum()), "converged [N]": exact,
                        "said": _short(said)})  # fmt: skip
    return out


def rollouts(numbers: Iterable[int]) -> list[dict[str, Any]]:
    """Error of each drawn scene, plain and with corrections: of positions (rms over the largest rms motion, at the end
    and at worst), and of the velocity of the center of mass at the end, over that at the start."""
    out = []
    for number in numbers:
        scene = floors_scenes.drawn(number)
        b = scene.body
        exact = b.rollout(scene.mesh.points, scene.v, scene.steps)
        for kind, coarse in KINDS.items():
            motion, _, said = scene.executed(SWEEPS, coarse)
            errors = apart(scene, motion, exact)
            row = {"scene": scene.name, "young": b.young, "poisson": b.poisson, "speed": -float(scene.v[0, 1]),
                   "time_step": b.time_step, "steps": scene.steps, "kappa": b.kappa, "dhat": b.dhat,
                   "friction": b.friction, "gravity": b.gravity[1], "stiffness": scene.stiffness,
                   "corrections": kind, **errors, "off": max(errors.values()) > OFF, "said": _short(said)}  # fmt: skip
            if row["off"]:
                enough = (k for k in MORE if max(apart(scene, scene.executed(k, coarse)[0], exact).values()) < OFF)
                row["needs"] = next(enough, None)
            out.append(row)
    return out


def apart(scene: Scene, motion: dv.Trajectory, exact: tuple[Array, Array]) -> dict[str, float]:
    x, v = exact
    off = np.sqrt(((motion.x.numpy() - x) ** 2).sum(-1).mean(-1))
    moved = np.sqrt(((x - x[0]) ** 2).sum(-1).mean(-1)).max()
    mass = scene.body.mass / scene.body.mass.sum()
    speed = np.linalg.norm(mass @ (motion.v[-1].numpy() - v[-1])) / np.linalg.norm(mass @ v[0])
    errors = {"end": off[-1] / moved, "worst": off.max() / moved, "velocity": speed}
    return {name: float(value) if np.isfinite(value) else np.inf for name, value in errors.items()}


def _upward(scene: Scene, v: Array) -> float:
    return float(scene.body.mass @ v[:, 1] / scene.body.mass.sum())


def _short(said: list[str]) -> str:
    """Which arguments the warnings are about."""
    return ", ".join(dict.fromkeys(text.split(":")[0] for text in said))


def markdown(results: dict[str, Any]) -> str:
    rows, parts = results["rollouts"], []
    titles = {
        "rebound": "A ball of 0.1 m and 1e5 Pa that meets the floor at 2 m/s: share of its speed that it keeps",
        "pressed": "The same ball held by its upper cap and pressed down by 20 mm",
    }
    for name, title in titles.items():
        table = markdown_table(list(results[name][0]), [row.values() for row in results[name]])
        parts.append(f"## {title}\n\n{table}")
    summary, names = [], sorted({row["scene"].split(": ")[1].split(",")[0] for row in rows})
    for kind in KINDS:
        for name in ("all", *names):
            own = [r for r in rows if r["corrections"] == kind and (name == "all" or f": {name}," in r["scene"])]
            off = [r for r in own if r["off"]]
            silent = [r for r in off if not r["said"]]
            worst = [max(r["worst"], r["velocity"]) for r in own]
            summary.append([kind, name, len(own), len(off), len(silent), float(np.median(worst)), max(worst)])
    header = ["corrections", "bodies", "rollouts", f"off by more than {OFF:.0%}", "of them silent", "median error",
              "largest error"]  # fmt: skip
    parts.append(f"## Bodies thrown on a floor, K = {SWEEPS}\n\n{markdown_table(header, summary)}")
    off = sorted((r for r in rows if r["off"]), key=lambda r: -r["worst"])[:40]
    header = ["scene", "corrections", "E [Pa]", "v [m/s]", "h [ms]", "steps", "kappa [N/m]", "dhat [mm]", "friction",
              "h sqrt(E / rho) / spacing", "error at the end", "worst", "velocity", "K needed", "said"]  # fmt: skip
    table = [[r["scene"], r["corrections"], r["young"], r["speed"], 1e3 * r["time_step"], r["steps"], r["kappa"],
              1e3 * r["dhat"], r["friction"], r["stiffness"], r["end"], r["worst"], r["velocity"],
              r["needs"] or f"> {MORE[-1]}", r["said"] or "nothing"] for r in off]  # fmt: skip
    parts.append(f"## The {len(off)} farthest off\n\n{markdown_table(header, ([cell(v) for v in t] for t in table))}")
    return "\n".join(parts)
