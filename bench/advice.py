"""Whether `dv.advise` keeps its promise, and how fast what it advises is.

Scenes drawn by a seed: meshes, materials over five decades, with and without contact. For each wanted error the true
one of what is advised, against runs of eight times the steps and five times the sweeps; its time over that of the best
of a grid; and what the advice cost, in rollouts of what it advises. Barriers are drawn as well, one to ten times as
stiff as it takes that kappa dhat^2 is the kinetic energy of a vertex: what meets a much weaker one stops at gaps that
no time step resolves.
"""

from __future__ import annotations

import math
import time
import warnings
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

import diffvbd as dv
from bench import common
from bench.measure import Card
from bench.tables import Table, count, most
from diffvbd import mesh
from diffvbd.rollout.tune import STILL

SEED = 20_261_125  # of no scene that the search was tuned on
DHAT = 2e-3  # [m]


@dataclass(frozen=True)
class Scene:
    name: str
    model: dv.Model
    v: Tensor  # [V, 3] [m/s]
    duration: float  # [s]
    given: dict[str, Any]

    @property
    def touches(self) -> bool:
        return self.model.contact is not None or self.model.floor is not None


# --- rollouts of one scene by one solver or another -------------------------------------------------------------------

FRAMES = 4  # at which two runs are compared, equally spaced over the duration


class Run(NamedTuple):
    steps: int
    x: Tensor | None  # [FRAMES + 1, V, 3], the first is the start; None: it failed
    seconds: float
    gradient: tuple[Tensor, ...] = ()


class Runs:
    """Rollouts of a scene from rest shape by any solver. With a gradient: that of the mean squared way, with respect
    to the moduli and to one velocity of all vertices, since those of single ones excite what no time step resolves."""

    def __init__(self, scene: Scene, gradient: bool = False, dtype: torch.dtype | None = None) -> None:
        self.model = scene.model if dtype is None else scene.model.to(dtype=dtype)
        self.scene, self.gradient, self.spent = scene, gradient, 0.0
        self.x = self.model.rest_points
        self.v = scene.v.to(self.x)
        self.given = {k: v.to(self.x) if isinstance(v, Tensor) else v for k, v in scene.given.items()}
        self.warm: set[str] = set()

    def run(self, solver: dv.VBD, steps: int, checkpoint_every: Any = "auto") -> Run:
        """So many steps over the whole duration; a first short one, which arranges what lasts, is not timed."""
        kind = f"{replace(solver, time_step=1.0, prediction=None)} {solver.start}"
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                if kind not in self.warm:
                    self._rollout(solver, steps, 1 if not self.gradient else FRAMES, checkpoint_every)
                    self.warm.add(kind)
                began = time.perf_counter()
                x, gradient = self._rollout(solver, steps, steps, checkpoint_every)
                if x.is_cuda:
                    torch.cuda.synchronize(x.device)
            except (RuntimeError, ValueError):
                return Run(steps, None, math.inf)
        seconds = time.perf_counter() - began
        self.spent += seconds
        return Run(steps, x, seconds, gradient) if bool(torch.isfinite(x).all()) else Run(steps, None, seconds)

    def _rollout(self, solver: dv.VBD, steps: int, count: int, checkpoint_every: Any
                 ) -> tuple[Tensor, tuple[Tensor, ...]]:  # fmt: skip
        """``count`` of steps of the scene's duration over ``steps``."""
        h, given, v, leaves = self.scene.duration / steps, dict(self.given), self.v, []
        for name, value in self.given.items():
            if callable(value):  # of the time at a step's end
                given[name] = lambda step, x, v, value=value: value((step + 1) * h).to(x)
        if self.gradient:
            leaves = [self.x.new_zeros(3, requires_grad=True)]
            v = torch.where(self.model.pinned[:, None], v, v + leaves[0])
            for name in set(given) & {"mu", "lam", "young", "poisson"}:
                given[name] = torch.as_tensor(given[name]).to(self.x).detach().clone().requires_grad_()
                leaves.append(given[name])
        with torch.set_grad_enabled(self.gradient):
            x = dv.rollout(self.model, self.x, v, replace(solver, time_step=h), steps=count,
                           save=max(1, count // FRAMES), checkpoint_every=checkpoint_every,
                           checks=dv.Checks(contact=False, energy=False), **given).x  # fmt: skip
            way = (x[-1] - self.x).square().mean()
        return x.detach(), torch.autograd.grad(way, leaves) if leaves else ()

    def motion(self, x: Tensor) -> float:
        """Root mean square way from the start, over vertices and frames [m], at least what `advise` calls still."""
        size = float((x[0].amax(0) - x[0].amin(0)).norm())
        return max(float((x[1:] - x[:1]).square().sum(-1).mean().sqrt()), STILL * size)

    def apart(self, a: Run, b: Run) -> tuple[float, float]:
        """Root mean square distance over the motion of the second, and the relative one of the worst gradient."""
        if a.x is None or b.x is None:
            return math.inf, math.inf
        off = float((a.x[1:].to(b.x) - b.x[1:]).square().sum(-1).mean().sqrt()) / self.motion(b.x)
        gradients = [float((u.to(w) - w).norm() / w.norm().clamp(min=1e-300))
                     for u, w in zip(a.gradient, b.gradient, strict=False)]  # fmt: skip
        return off, max(gradients, default=0.0)


# --- scenes -----------------------------------------------------------------------------------------------------------


def _body(rng: np.random.Generator) -> tuple[str, dv.TetMesh]:
    kind = ("beam", "sheet", "blob", "box")[rng.integers(4)]
    if kind == "beam":
        n = int(rng.integers(2, 4))
        counts = int(rng.integers(5, 12)), n, n
        return kind, mesh.beam(*counts, size=(float(rng.uniform(0.2, 0.8)), 0.1, 0.1), split="kuhn")
    if kind == "sheet":
        return kind, mesh.sheet(8, 8, (0.3, 0.3), float(rng.uniform(0.01, 0.04)))
    if kind == "blob":
        return kind, mesh.blob(5, int(rng.integers(100)), 0.1)
    return kind, mesh.box(int(rng.integers(2, 5)), 0.1, split="kuhn")


def _kappa(rng: np.random.Generator, body: dv.TetMesh, speed: float) -> float:
    """Stiffness of a barrier [N/m]."""
    mass = float(dv.Model(body).mass.mean())
    return 10 ** float(rng.uniform(0, 1)) * 0.5 * mass * speed**2 / DHAT**2


def drawn(number: int) -> Scene:
    """Scene `number` of the seed: every third falls on a floor, or meets another body."""
    rng = np.random.default_rng((SEED, number))
    kind, body = _body(rng)
    young, poisson = float(10 ** rng.uniform(3.5, 8.5)), float(rng.uniform(0.1, 0.47))
    material: dict[str, Any] = {"young": young, "poisson": poisson}
    contact = ("none", "none", "floor", "none", "none", "pairs")[number % 6]
    size = float(np.ptp(body.points, axis=0).max())
    # some swings of the slowest kind, as far as it is known beforehand
    wave = size / np.sqrt(young / 1000.0)
    duration = float(np.clip(rng.uniform(4, 20) * wave, 0.02, 0.4))
    if contact == "none":
        pinned = body.points[:, 0] < body.points[:, 0].min() + 1e-6
        turn = bool(rng.integers(2)) and kind in ("blob", "box")
        model = dv.Model(body, pinned=None if turn else pinned)
        v = torch.zeros_like(model.rest_points)
        if turn:  # free: it spins and quivers
            arm = model.rest_points - model.rest_points.mean(0)
            v = torch.linalg.cross(torch.tensor(rng.standard_normal(3) * 10).expand_as(arm), arm) + 2.0 * arm
    elif contact == "floor":
        speed, low = float(rng.uniform(0.5, 2.0)), body.points[:, 1].min()
        floor = dv.FloorBarrier(low - 0.01, kappa=_kappa(rng, body, speed), dhat=DHAT)
        model = dv.Model(body, energies=(dv.StableNeoHookean(), floor))
        v = torch.zeros_like(model.rest_points)
        v[:, 1] = -speed
        duration = 0.1
    else:
        other = body.translate((0.004 + float(np.ptp(body.points[:, 0])), 0.007, 0.003))
        speed = float(rng.uniform(0.3, 1.5))
        pairs = dv.PairBarrier(kappa=_kappa(rng, body, speed), dhat=DHAT)
        model = dv.Model(mesh.join([body, other]), energies=(dv.StableNeoHookean(), pairs))
        v = torch.zeros_like(model.rest_points)
        v[: body.num_vertices, 0] = speed
        material["gravity"] = (0.0, 0.0, 0.0)
        duration = 0.06
    vertices = model.num_vertices
    return Scene(f"{number}: {kind}, {vertices} vertices, {young:.1g} Pa, {contact}", model, v, duration, material)


ERRORS = (0.1, 0.01, 0.001)
SCENES, GRADIENTS, EXHAUSTIVE = 30, 12, 12  # of the drawn scenes, from the first
PATIENCE = 20.0  # [s]
FEWEST = 0.05  # [s]: what takes less is timed too badly to be compared
Row = dict[str, Any]
SWEEPS: list[tuple[dict[str, Any], tuple[int, ...]]] = [
    ({}, (5, 10, 20, 40)),
    ({"relaxation": 1.6}, (10, 20, 40)),
    ({"relaxation": 1.5, "subspace": "coarse"}, (2, 5, 8)),
]
GRID = [dv.VBD(1.0, k, integrator=scheme, **options) for scheme in (dv.ImplicitEuler(), dv.SDIRK2(), dv.BDF2())
        for options, counts in SWEEPS for k in counts]  # fmt: skip


# --- the promise ------------------------------------------------------------------------------------------------------


def advised(scene: Scene, error: float, gradient: bool, patience: float) -> tuple[dv.VBD, Row]:
    """What is advised, and what is said of it."""
    found = dv.advise(scene.model, scene.model.rest_points, scene.v, duration=scene.duration, error=error,
                      gradient=gradient, time_budget=patience, **scene.given)  # fmt: skip
    told = found.prediction
    row: Row = {"scene": scene.name, "asked": error, "gradient": gradient, "reached": told.reached,
                "settings": str(replace(found, prediction=None)), "predicted": told.error, "ms": 1e3 * told.seconds,
                "cost": told.cost, "spent": told.spent, "why": "" if told.reached else told.why}  # fmt: skip
    return found, row


def exact(runs: Runs, solver: dv.VBD) -> tuple[Run, float]:
    """A run of much smaller steps and many more sweeps than those solver, and how far one of half of them is off."""
    steps = 4 * FRAMES * math.ceil(solver.steps(runs.scene.duration) / FRAMES)
    sweeps = 40 if solver.coarse is None else 5 * solver.sweeps
    fine = replace(solver, sweeps=sweeps, integrator=dv.SDIRK2(), relaxation=1.5 if solver.coarse else 1.0)
    a, b = runs.run(fine, steps), runs.run(fine, 2 * steps)
    return b, max(runs.apart(a, b))


def asked(scene: Scene, error: float, gradient: bool) -> tuple[Row, dv.VBD, Run | None]:
    solver, row = advised(scene, error, gradient, PATIENCE)
    if not row["reached"]:
        return row, solver, None
    runs = Runs(scene, gradient)
    truth, row["unsure"] = exact(runs, solver)
    row["true"] = max(runs.apart(runs.run(solver, solver.steps(scene.duration)), truth))
    return row, solver, truth


def best(scene: Scene, error: float, own: dv.VBD, truth: Run) -> Row:
    """The fastest solver of the grid that keep the error, each with the fewest steps that do, to a factor of 1.4."""
    runs = Runs(scene)
    seconds = min(runs.run(own, own.steps(scene.duration)).seconds for _ in range(3))
    least, name = math.inf, "the advised"
    for solver in GRID:
        if scene.model.touches and (solver.coarse is not None or solver.relaxation > 1):
            continue
        steps = float(FRAMES)
        while steps < 2**14:
            run = runs.run(solver, FRAMES * round(steps / FRAMES))
            if run.seconds > min(seconds, least):
                break
            if runs.apart(run, truth)[0] <= error:
                least, name = run.seconds, f"{replace(solver, time_step=scene.duration / run.steps)}"
                break
            steps *= 1.4
    return {"ms": 1e3 * seconds, "best_ms": 1e3 * min(seconds, least), "best": name}


def kept_of(number: int, quick: bool) -> list[Row]:
    """The rows of one scene."""
    rows, scene = [], drawn(number)
    for error in ERRORS[: 1 if quick else None]:
        row, solver, truth = asked(scene, error, False)
        compare = truth is not None and number < EXHAUSTIVE and error == 0.01
        rows.append(row | (best(scene, error, solver, truth) if compare and truth is not None else {}))
    if number < GRADIENTS and not quick:
        rows.append(asked(scene, 0.01, True)[0])
    return rows


def kept(card: Card) -> list[Row]:
    numbers = range(2 if card.quick else SCENES)
    found = dict(common.side_by_side(kept_of, numbers, card.quick, at_once=not card.quick))
    return [row for number in sorted(found) for row in found[number]]


def is_kept(row: Row) -> bool:
    return row["reached"] and row["true"] <= row["asked"]


THREADS = 1
GROUPS = {"kept": kept}
SHARES: dict[str, Any] = {
    "scenes": count(), "said that it can be had": count("reached"), "true error at most that": count(is_kept),
    "at least a twentieth": count(lambda row: row["reached"] and row["true"] >= row["asked"] / 20),
    "largest cost [rollouts]": most("cost"),
}  # fmt: skip
TABLES = (
    Table("Scenes drawn by a seed, by the error that is asked", "kept", SHARES, by="asked",
          only=lambda row: not row["gradient"]),
    Table("The same, gradients too", "kept", SHARES, by="asked", only=lambda row: row["gradient"]),
    Table("Beside the best of a grid", "kept",
          {"scene": "scene", "asked": "asked", "advised": "settings", "true error": "true", "unsure": "unsure",
           "ms": "ms", "best of the grid [ms]": "best_ms", "its settings": "best"},
          only=lambda row: row.get("best_ms")),
)  # fmt: skip
