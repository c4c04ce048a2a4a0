"""Speed against accuracy: error of a motion and of its gradient over the time that they take, for each choice there is.

Nine scenes from soft to extreme. Each way runs with ever shorter steps and several numbers of sweeps; its error is the
distance to a reference of much shorter steps and more sweeps (root mean square over vertices and four frames, over the
motion), and that of the gradient of the mean squared way with respect to each modulus and a velocity of all vertices.
Times are those of one rollout, and of one with its backward. Scenes run side by side, one thread each.

On the two cantilevers other solvers of the same law take part: converged steps, and Newton's SolverVBD where it is
installed.
"""

from __future__ import annotations

import importlib
import io
import math
import sys
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

import diffvbd as dv
from bench import common
from bench.advice import DHAT, ERRORS, FRAMES, Row, Run, Runs, Scene, advised
from bench.tables import Table
from diffvbd import mesh

ELASTIC = dv.StableNeoHookean()


def beam() -> dv.TetMesh:
    """0.6 m long."""
    return mesh.beam(13, 4, 4, size=(0.6, 0.15, 0.15), split="kuhn")


def still(model: dv.Model) -> Tensor:
    return torch.zeros_like(model.rest_points)


def cantilever(mu: float, poisson: float = 1 / 3, contrast: float = 1.0, speed: float = 0.0, name: str = "") -> Scene:
    """A beam of 0.6 m held at one end, some swings of it. contrast: of its two halves' stiffness, in layers; speed:
    of its free end at first [m/s], where it would hardly sag."""
    body = beam()
    model = dv.Model(body, pinned=torch.tensor(body.points[:, 0] < 1e-9))
    lam = 2 * mu * poisson / (1 - 2 * poisson)
    share = np.where(body.points[body.tets].mean(1)[:, 1] > 0.075, 1.0, 1 / contrast)
    scale = torch.tensor(share) if contrast > 1 else torch.tensor(1.0, dtype=torch.float64)
    duration = float(np.clip(0.4 * math.sqrt(1e5 / mu), 0.02, 0.4))
    v = still(model)
    v[:, 1] = speed * (model.rest_points[:, 0] / 0.6) ** 2
    material = {"mu": mu * scale, "lam": lam * scale}
    return Scene(name or f"cantilever, mu = {mu:.0e} Pa", model, v, duration, material)


def cloth() -> Scene:
    """A sheet of 0.3 m, 15 mm thick, held at two corners."""
    body = mesh.sheet(12, 12, (0.3, 0.3), 0.015)
    points = torch.tensor(body.points)
    corner = (points[:, 0] < 1e-9) & ((points[:, 2] < 0.02) | (points[:, 2] > 0.28))
    model = dv.Model(body, pinned=corner)
    return Scene("cloth of 15 mm", model, still(model), 0.3, {"mu": 3e4, "lam": 3e4})


def twist() -> Scene:
    """A bar whose ends are turned against each other by half a turn in 0.3 s."""
    body = beam()
    rest = torch.tensor(body.points)
    left, right = rest[:, 0] < 1e-9, rest[:, 0] > 0.6 - 1e-9
    model = dv.Model(body, pinned=left | right)
    middle = torch.tensor([0.0, 0.075, 0.075], dtype=rest.dtype)

    def turned(t: float) -> Tensor:
        angle = math.pi / 2 * t / 0.3
        out = rest.clone()
        for end, sign in ((left, -1.0), (right, 1.0)):
            arm = rest[end] - middle
            c, s = math.cos(sign * angle), math.sin(sign * angle)
            out[end, 1] = middle[1] + c * arm[:, 1] - s * arm[:, 2]
            out[end, 2] = middle[2] + s * arm[:, 1] + c * arm[:, 2]
        return out

    given = {"mu": 1e5, "lam": 2e5, "prescribed": turned}
    return Scene("twist by half a turn", model, still(model), 0.3, given)


def drop() -> Scene:
    """A soft ball that falls 1 cm on a floor at 1 m/s, and rises."""
    body = mesh.blob(5, 1, 0.1)
    body = body.translate((0, 0.01 + DHAT - body.points[:, 1].min(), 0))
    model = dv.Model(body, energies=(ELASTIC, dv.FloorBarrier(kappa=1e3, dhat=DHAT)))
    v = still(model)
    v[:, 1] = -1.0
    return Scene("drop on a floor", model, v, 0.1, {"young": 1e5, "poisson": 0.3})


def pairs(**barrier: Any) -> dv.PairBarrier:
    return dv.PairBarrier(kappa=1e4, dhat=DHAT, self_contact=False, **barrier)


def pile() -> Scene:
    """Three boxes that fall on each other and on a floor, with friction."""
    rng, box = np.random.default_rng(1), mesh.box(3, 0.1, split="kuhn")
    shifts = [(float(x), 0.005 + 0.105 * n, float(z)) for n, (x, z) in enumerate(rng.uniform(-0.01, 0.01, (3, 2)))]
    energies = (ELASTIC, pairs(), dv.Friction(0.4), dv.FloorBarrier(kappa=1e4, dhat=DHAT))
    model = dv.Model(mesh.join([box.translate(shift) for shift in shifts]), energies=energies)
    return Scene("pile of three boxes", model, still(model), 0.15, {"mu": 1e5, "lam": 2e5})


def gripper(n: int = 3, plates: tuple[int, int, int] = (2, 3, 3), **barrier: Any) -> Scene:
    """A cube between two plates that close in 0.05 s and lift it with the speed that they have reached, by friction.

    Args:
        n, plates: Vertices along the edges of the cube and of the plates.
    """
    size, thick = 0.05, 0.02
    cube, plate = mesh.box(n, size, split="kuhn"), mesh.box(plates, (thick, 0.06, 0.06), split="kuhn")
    sides = [plate.translate((x, y, -0.005)) for x, y in ((-thick - DHAT, -0.0052), (size + DHAT, -0.0049))]
    body = mesh.join([cube, *sides])
    x = torch.tensor(body.points)
    outer = (x[:, 0] < -thick - 0.5 * DHAT) | (x[:, 0] > size + thick + 0.5 * DHAT)
    outer[: cube.num_vertices] = False
    model = dv.Model(body, pinned=outer, energies=(ELASTIC, pairs(**barrier), dv.Friction(0.8)))
    inward = torch.where(outer, torch.where(x[:, 0] < 0, 1.0, -1.0), 0.0)

    def clamps(t: float) -> Tensor:
        out = x.clone()
        out[:, 0] += 1.5e-3 * min(1.0, t / 0.05) * inward
        out[:, 1] += torch.where(outer, 0.3 * max(0.0, t - 0.05), 0.0)
        return out

    return Scene("gripper", model, still(model), 0.15, {"mu": 1e5, "lam": 2e5, "prescribed": clamps})


SCENES: dict[str, Callable[[], Scene]] = {
    "soft": lambda: cantilever(1e4),
    "stiff": lambda: cantilever(1e8, speed=5.0),
    "cloth": cloth,
    "contrast": lambda: cantilever(1e5, contrast=1e6, name="contrast 1e6"),
    "incompressible": lambda: cantilever(1e5, poisson=0.4999, name="nu = 0.4999"),
    "twist": twist,
    "drop": drop,
    "pile": pile,
    "gripper": gripper,
}

LONGEST = 1 / 30  # [s], the first step


@dataclass(frozen=True)
class Effort:
    """How long a run may take."""

    rung: float  # [s]: runs longer than this end a way
    reference: float  # [s]: as long as all runs toward the reference
    patience: float  # [s] of dv.advise
    finest: float  # an error below which no shorter step is tried


FULL, QUICK = Effort(0.5, 40.0, 40.0, 3e-4), Effort(0.05, 1.0, 1.0, 2e-2)


class Way(NamedTuple):
    """A solver but for its step, and numbers of sweeps."""

    name: str
    solver: dv.VBD
    sweeps: tuple[int, ...]
    dtype: torch.dtype | None = None
    checkpoint_every: Any = "auto"
    elastic: bool = True  # whether it is for scenes without contact
    contact: bool = True  # and with it
    gradient_only: bool = False  # what changes no motion


def _vbd(**options: Any) -> dv.VBD:
    return dv.VBD(1.0, 1, **options)


COARSE: dict[str, Any] = {"relaxation": 1.5, "subspace": "coarse"}
SDIRK2, BDF2 = dv.SDIRK2(), dv.BDF2()
WAYS = [
    Way("implicit Euler", _vbd(), (5, 20, 80)),
    Way("implicit Euler, relaxation 1.6", _vbd(relaxation=1.6), (20, 80), contact=False),
    Way("implicit Euler, start at y", _vbd(start="predictor"), (20,)),
    Way("implicit Euler, start at x + h v", _vbd(start="inertia"), (20,)),
    Way("implicit Euler, coarse", _vbd(**COARSE), (2, 8)),
    Way("implicit Euler, block of the paper", _vbd(block="paper"), (20,)),
    Way("SDIRK2", _vbd(integrator=SDIRK2), (5, 20, 80)),
    Way("SDIRK2, relaxation 1.6", _vbd(integrator=SDIRK2, relaxation=1.6), (20, 80), contact=False),
    Way("SDIRK2, coarse", _vbd(integrator=SDIRK2, **COARSE), (2, 8)),
    Way("SDIRK2, coarse, float32", _vbd(integrator=SDIRK2, **COARSE), (8,), torch.float32, contact=False),
    Way("SDIRK2, float32", _vbd(integrator=SDIRK2), (20,), torch.float32, elastic=False),
    Way("BDF2", _vbd(integrator=BDF2), (20,)),
    Way("BDF2, coarse", _vbd(integrator=BDF2, **COARSE), (2, 8)),
    *(Way(f"SDIRK2, {name} tape", _vbd(integrator=SDIRK2, tape=tape), (20,), gradient_only=True)
      for name, tape in (("full", "full"), ("compact", "compact"), ("recomputed", "recompute"))),
    Way("SDIRK2, a checkpoint every 8 steps", _vbd(integrator=SDIRK2), (20,), checkpoint_every=8, gradient_only=True),
]  # fmt: skip
# ways that differ in the backward alone
ASIDE = {way.name for way in WAYS if way.gradient_only}


Distance = Callable[[Tensor], float]  # of frames [FRAMES, V, 3] to the reference of the scene


class Front:
    """Runs of one scene, held against its reference."""

    def __init__(self, scene: Scene, effort: Effort, device: str) -> None:
        self.effort = effort
        self.scene = replace(scene, model=scene.model.to(device))
        self.runs = Runs(self.scene, gradient=True)
        self.first_steps = FRAMES * math.ceil(scene.duration / (FRAMES * LONGEST))
        self.truth, self.unsure = self.reference()

    def reference(self) -> tuple[Run, tuple[float, float]]:
        """The last of ever finer runs, and how far its motion and its gradient may be off."""
        solver = _vbd(integrator=SDIRK2) if self.scene.touches else _vbd(integrator=SDIRK2, **COARSE)
        solver = replace(solver, sweeps=80 if self.scene.touches else 20)
        steps, last, off = self.first_steps, None, (math.inf, math.inf)
        while True:
            now = self.runs.run(solver, steps)
            if last is not None and now.x is not None:
                off = self.runs.apart(now, last)
            last = now if now.x is not None else last
            if max(off) < 0.3 * self.effort.finest or self.runs.spent + 2 * now.seconds > self.effort.reference:
                break
            steps *= 2
        if last is None:
            raise RuntimeError(f"{self.scene.name}: no reference")
        return last, off

    def distance(self, frames: torch.Tensor) -> float:
        """Of frames [FRAMES, V, 3] to the reference."""
        assert self.truth.x is not None
        x = torch.cat([self.truth.x[:1], frames.to(self.truth.x)])
        return self.runs.apart(Run(FRAMES, x, 0.0), self.truth)[0]

    def way(self, way: Way) -> list[Row]:
        forward, both = (Runs(self.scene, gradient, way.dtype) for gradient in (False, True))
        out = []
        for sweeps in way.sweeps:
            solver, steps = replace(way.solver, sweeps=sweeps), self.first_steps
            while True:
                run, back = (runs.run(solver, steps, way.checkpoint_every) for runs in (forward, both))
                motion, gradient = self.runs.apart(back if back.gradient else run, self.truth)
                out.append({"way": way.name, "sweeps": sweeps, "steps": steps, "ms": 1e3 * run.seconds,
                            "error": motion, "both_ms": 1e3 * back.seconds, "gradient_error": gradient})  # fmt: skip
                slow = max(run.seconds, 0.3 * back.seconds) if run.x is not None else 0.0
                if way.gradient_only or slow > self.effort.rung or motion < self.effort.finest or steps > 2**13:
                    break
                steps *= 2
        return out

    def advised(self) -> list[Row]:
        """What dv.advise says, run against the same reference."""
        runs, out = Runs(self.scene), []
        for error in ERRORS:
            solver, row = advised(self.scene, error, False, self.effort.patience)
            run = runs.run(solver, solver.steps(self.scene.duration))
            out.append(row | {"ms": 1e3 * run.seconds, "error": runs.apart(run, self.truth)[0]})
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
            if not (way.contact if front.scene.touches else way.elastic):
                continue
            try:
                rows += front.way(way)
            except (ValueError, NotImplementedError) as error:  # what this scene does not support
                rows.append({"way": way.name, "why": str(error)[:160]})
        others: list[Row] = []
        if name in ("soft", "stiff") and device == "cpu":
            others = [*converged(front.scene, front.distance, 1 if quick else 5),
                      *newton(front.scene, front.distance, quick)]  # fmt: skip
        advised = front.advised()
    print(f"{name}: {time.perf_counter() - began:.0f} s", file=sys.stderr, flush=True)
    return {"scene": front.scene.name, "vertices": model.num_vertices, "duration": front.scene.duration,
            "unsure": front.unsure[0], "gradient_unsure": front.unsure[1], "rows": rows, "advised": advised,
            "peers": others}  # fmt: skip


def run(quick: bool, device: str = "cpu", only: str | None = None, out: Path | None = None) -> dict[str, Any]:
    """Scenes side by side; each is written as it ends, as `common.by_group` does one after another."""
    environment = common.environment(device)
    suffix = common.device_suffix(device)
    results = common.earlier(None if out is None else out / f"tradeoff{suffix}.json", quick, environment["device"])
    at_once = device == "cpu" and not quick
    for name, group in common.side_by_side(measured, common.chosen(only, SCENES), quick, device, at_once=at_once):
        results[name] = group | common.stamp(environment)
        if out is not None:
            common.write("tradeoff", results, out, quick=quick, device=device, suffix=suffix)
    return {name: results[name] for name in SCENES if name in results}


def front_of(rows: list[Row]) -> list[Row]:
    """Those that no other beats in both time and error, fastest first."""
    out: list[Row] = []
    for row in sorted(rows, key=lambda r: r["ms"]):
        if not out or row["error"] < out[-1]["error"]:
            out.append(row)
    return out


# --- other solvers of the same law ------------------------------------------------------------------------------------


def converged(scene: Scene, distance: Distance, rungs: int) -> list[Row]:
    """dv.solve: each step of implicit Euler swept until its residual is 1e-4."""
    rows = []
    for rung in range(rungs):
        x, v, frames, steps, began = scene.model.rest_points, scene.v, [], FRAMES * 2**rung, time.perf_counter()
        for n in range(1, steps + 1):
            with torch.no_grad():
                found = dv.solve(scene.model, x, v, dv.VBD(scene.duration / steps, 1), tolerance=1e-4, max_sweeps=5000,
                                 on_failure="warn", **scene.given)  # fmt: skip
            x, v = found.x, found.v
            frames += [x] if n % (steps // FRAMES) == 0 else []
        rows.append({"solver": "dv.solve", "iterations": "to 1e-4", "steps": steps, "note": "implicit Euler",
                     "ms": 1e3 * (time.perf_counter() - began), "error": distance(torch.stack(frames))})  # fmt: skip
    return rows


def newton(scene: Scene, distance: Distance, quick: bool) -> list[Row]:
    """Newton's SolverVBD on the same mesh and moduli, forward, in float32 on the CPU, where it is installed."""
    try:
        warp, engine = importlib.import_module("warp"), importlib.import_module("newton")
    except ImportError as error:
        return [{"solver": "Newton SolverVBD", "note": f"not available ({error})"}]
    model, rows = newton_model(engine, scene), []
    for count in (2,) if quick else (5, 20, 80):
        solver = engine.solvers.SolverVBD(model, iterations=count)
        for rung in range(-1, 1 if quick else 6):  # the first compiles
            steps, states, seen = FRAMES * 2 ** max(rung, 0), [model.state(), model.state()], []
            states[0].particle_qd.assign(scene.v.numpy().astype(np.float32))
            warp.synchronize_device("cpu")
            start = time.perf_counter()
            for n in range(1, steps + 1):
                solver.step(states[0], states[1], model.control(), None, scene.duration / steps)
                states.reverse()
                if n % (steps // FRAMES) == 0:
                    seen.append(states[0].particle_q.numpy().copy())  # on the CPU it is a view
            seconds = time.perf_counter() - start
            if rung >= 0:
                rows.append({"solver": f"Newton {engine.__version__} SolverVBD", "iterations": count, "steps": steps,
                             "ms": 1e3 * seconds, "error": distance(torch.from_numpy(np.stack(seen).astype(float))),
                             "note": "implicit Euler in float32"})  # fmt: skip
    return rows


def newton_model(engine: Any, scene: Scene) -> Any:
    """Newton's model of a scene with one mu and lam, without surface triangles, which would only cost memory."""
    mesh, pinned = scene.model.mesh, scene.model.pinned.numpy()
    material = float(scene.given["mu"]), float(scene.given["lam"]), 0.0
    shape = (mesh.points[mesh.tets[:, 1:]] - mesh.points[mesh.tets[:, :1]]).swapaxes(1, 2)  # columns are edges
    mass = np.where(pinned, 0.0, scene.model.mass.numpy())
    builder = engine.ModelBuilder(gravity=(0.0, -9.81, 0.0))
    builder.add_particles(pos=list(mesh.points), vel=[(0.0, 0.0, 0.0)] * len(mass), mass=mass.tolist(),
                          flags=np.where(pinned, 0, int(engine.ParticleFlags.ACTIVE)).tolist())  # fmt: skip
    builder.tet_indices.extend(map(tuple, mesh.tets.tolist()))
    builder.tet_poses.extend(np.linalg.inv(shape).tolist())
    builder.tet_activations.extend([0.0] * len(mesh.tets))
    builder.tet_materials.extend([material] * len(mesh.tets))
    builder.color()
    return builder.finalize(device="cpu")


# --- tables and picture -----------------------------------------------------------------------------------------------


def numbers(rows: list[Row]) -> list[Row]:
    """Rows of which error and time are numbers."""
    return [r for r in rows if isinstance(r.get("error"), float) and isinstance(r["ms"], float)]


def least_of(rows: list[Row]) -> Row:
    """Of rows of one way or solver, that of the least error."""
    return min((r for r in rows if isinstance(r.get("error"), float)), key=lambda r: r["error"], default={})


def time_to(error: float) -> Callable[[list[Row]], Any]:
    return lambda rows: min((r["ms"] for r in numbers(rows) if r["error"] <= error), default=None)


TIMES: dict[str, Any] = {
    **{f"ms to {error:g}": time_to(error) for error in ERRORS},
    "least error": lambda rows: least_of(rows).get("error"),
    "in ms": lambda rows: least_of(rows).get("ms"),
}
TABLES = (
    Table("{}: the ways", "*/rows",
          {**TIMES, "with backward": lambda rows: least_of(rows).get("both_ms")}, by="way"),
    Table("{}: what dv.advise says", "*/advised", ("asked", "settings", "reached", "ms", "error", "spent", "why")),
    Table("{}: other solvers", "*/peers", {**TIMES, "note": lambda rows: rows[0]["note"]}, by="solver"),
)  # fmt: skip


def draw(results: dict[str, Any], path: Path) -> None:
    """Points of the common ways, the front of all, and what dv.advise says."""
    from matplotlib.figure import Figure

    figure = Figure(layout="constrained")
    drawn = {"implicit Euler": ("o", "C1"), "implicit Euler, coarse": ("s", "C3"), "SDIRK2": ("^", "C0"),
             "SDIRK2, coarse": ("D", "C2"), "BDF2, coarse": ("v", "C4")}  # fmt: skip
    groups = list(results.values())
    columns = min(3, len(groups))
    lines = math.ceil(len(groups) / columns)
    figure.set_size_inches(10, 3.0 * lines)
    all_axes = figure.subplots(lines, columns, squeeze=False).ravel()
    for ax, group in zip(all_axes, groups, strict=False):

        def plot(rows: list[Row], style: str, ax: Any = ax, **options: Any) -> None:
            ax.loglog([r["ms"] for r in rows], [r["error"] for r in rows], style, **options)

        rows = [r for r in numbers(group["rows"]) if r["way"] not in ASIDE]
        for name, (marker, color) in drawn.items():
            plot([r for r in rows if r["way"] == name], marker, color=color, markersize=3, alpha=0.7, label=name)
        plot(front_of(rows), "k-", linewidth=0.8, label="front of all")
        told = [a for a in group["advised"] if a["reached"] and isinstance(a["error"], float)]
        plot(told, "*", color="k", label="dv.advise")
        if isinstance(group["unsure"], float):
            ax.axhline(group["unsure"], color="0.6", linestyle=":", label="the reference's own error")
        ax.set_title(group["scene"], fontsize="small")
        ax.set_ylim(1e-5, 3)
        ax.xaxis.set_minor_formatter("")
        ax.set_xlabel("ms of a rollout", fontsize="small")
        ax.grid(alpha=0.3)
    for ax in all_axes[len(groups) :]:
        ax.axis("off")
    all_axes[0].set_ylabel("error over motion")
    figure.legend(*all_axes[0].get_legend_handles_labels(), fontsize="x-small", loc="outside lower center", ncols=4)
    drawn_as = io.BytesIO()
    figure.savefig(drawn_as, dpi=100)
    common.keep_picture(drawn_as, path)
