"""How scenes of `bench.contact_motion` are stepped, what is watched on the way, and rows of its tables."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

import diffvbd as dv
from diffvbd import reference

Array = NDArray[np.float64]
Row = dict[str, Any]
GRAVITY = 9.81  # [m/s^2]
UP = (0.0, 1.0, 0.0)
LOOKS = 10  # how often crossings are counted in a rollout


@dataclass(frozen=True)
class Scene:
    """A Model, its state and how it is stepped; lam is twice mu."""

    model: dv.Model
    mu: float  # [Pa]
    time_step: float  # [s]
    sweeps: int
    x: Tensor | None = None  # [V, 3] [m]; None: at rest
    v: Tensor | None = None  # [V, 3] [m/s]; None: still
    gravity: Any = (0.0, -GRAVITY, 0.0)  # [3] or [V, 3] [m/s^2]
    walls: tuple[tuple[Sequence[float], float], ...] = ()  # normal and height [m] of planes that nothing may be below
    prescribed: Callable[[int], Tensor] | None = None  # pinned vertices at the end of step n
    integrator: dv.ImplicitEuler | dv.SDIRK2 = dv.ImplicitEuler()

    def state(self) -> tuple[Tensor, Tensor]:
        x = self.model.rest_points if self.x is None else self.x
        return x, torch.zeros_like(x) if self.v is None else self.v

    def arguments(self, **changed: Any) -> dict[str, Any]:
        """Those of a step or rollout beside Model and state."""
        own = {"mu": self.mu, "lam": 2 * self.mu, "time_step": self.time_step, "sweeps": self.sweeps,
               "gravity": self.gravity, "integrator": self.integrator}  # fmt: skip
        return own | changed

    def finer(self, parts: int) -> Scene:
        return replace(self, time_step=self.time_step / parts)

    def wrong(self, x: Tensor) -> int:
        """Edges through triangles, and vertices below a wall."""
        found = 0 if self.model.contact is None else len(dv.contact.intersections(self.model, x))
        for normal, height in self.walls:
            n = torch.tensor(normal).to(x)
            found += int((x @ n < height * n.norm()).sum())
        return found


@dataclass
class Course:
    """What a rollout went through: states on the CPU, after every step or every few."""

    scene: Scene
    x: list[Tensor] = field(default_factory=list)
    v: list[Tensor] = field(default_factory=list)
    cut: list[float] = field(default_factory=list)  # share of the vertices, for each step
    seconds: list[float] = field(default_factory=list)
    crossings: int = 0
    nonfinite: int = 0
    error: str | None = None

    def center(self, at: int = -1, rows: slice = slice(None)) -> Array:
        """Center of mass of some vertices [m]."""
        mass = self.scene.model.mass.cpu()[rows, None]
        return ((mass * self.x[at][rows]).sum(0) / mass.sum()).numpy()

    def velocity(self, at: int = -1, rows: slice = slice(None)) -> Array:
        mass = self.scene.model.mass.cpu()[rows, None]
        return ((mass * self.v[at][rows]).sum(0) / mass.sum()).numpy()


@torch.no_grad()
def march(scene: Scene, steps: int, keep: int = 1, until: Callable[[Tensor], bool] | None = None) -> Course:
    """Steps one by one. keep: states are kept after every so many; until: of the velocity, ends it."""
    course, (x, v) = Course(scene), scene.state()
    course.x.append(x.cpu())
    course.v.append(v.cpu())
    course.crossings = scene.wrong(x)
    look = max(1, steps // LOOKS)
    for n in range(1, steps + 1):
        extra = {} if scene.prescribed is None else {"prescribed": scene.prescribed(n)}
        began = time.perf_counter()
        try:
            x, v = dv.step(scene.model, x, v, **scene.arguments(**extra))
        except (RuntimeError, ValueError) as failure:
            course.error = f"step {n}: {str(failure)[:160]}"
            break
        if x.is_cuda:
            torch.cuda.synchronize(x.device)
        course.seconds.append(time.perf_counter() - began)
        if scene.model.contact is not None:
            course.cut.append(sum(dv.contact.status(scene.model).cut) / scene.model.num_vertices)
        course.nonfinite = int((~torch.isfinite(torch.cat([x, v]))).sum())
        if course.nonfinite:
            break
        if n % keep == 0:
            course.x.append(x.cpu())
            course.v.append(v.cpu())
        if n % look == 0 or n == steps:
            course.crossings += scene.wrong(x)
        if until is not None and until(v):
            break
    return course


@torch.no_grad()
def settled(scene: Scene, steps: int = 40, gravity: Any = None) -> Scene:
    """The scene, come to rest without friction: long steps of many sweeps, each begun without velocity."""
    x, still = scene.state()[0], torch.zeros_like(scene.state()[0])
    free = {} if scene.model.friction is None else {"parameters": {"friction.coefficient": 0.0}}
    long = scene.arguments(time_step=0.05, sweeps=100, **free)
    long |= {} if gravity is None else {"gravity": gravity}
    for _ in range(steps):
        x, _ = dv.step(scene.model, x, still, **long)
    return replace(scene, x=x)


def energy(scene: Scene, course: Course) -> list[float]:
    """Kinetic and elastic energy and that of gravity above the start [J], of each state that was kept."""
    body = dv.Model(scene.model.mesh)  # by itself: no barriers
    mass = scene.model.mass.cpu()[:, None]
    g = torch.as_tensor(scene.gravity, dtype=mass.dtype).cpu()
    out = []
    for x, v in zip(course.x, course.v, strict=True):
        elastic = float(reference.incremental_potential(body, x, x, scene.mu, 2 * scene.mu, 1.0))
        out.append(float((0.5 * mass * v.square() - mass * g * (x - course.x[0])).sum()) + elastic)
    return out


def within(value: float, goal: float, share: float) -> bool:
    return abs(value - goal) <= share * abs(goal)


def row(course: Course | Iterable[Course], quantity: str, case: str, value: float | None, goal: float | None,
        target: str, met: bool | None, note: str = "") -> Row:  # fmt: skip
    """A row of the tables: a quantity, what it should be, and how the rollouts went that it was taken from.

    goal: the reference; met: None where there is no target. An unfinished rollout meets none.
    """
    courses = [course] if isinstance(course, Course) else list(course)
    first = courses[0].scene
    seconds = [s for c in courses for s in c.seconds]
    cut = [s for c in courses for s in c.cut]
    bad = any(c.error or c.nonfinite for c in courses)
    value = math.nan if value is None else float(value)
    return {
        "quantity": quantity, "case": case, "sweeps": first.sweeps, "time_step": first.time_step,
        "vertices": first.model.num_vertices, "value": value, "reference": goal, "target": target,
        "met": None if met is None else bool(met) and not bad and math.isfinite(value),
        "cut": float(np.mean(cut)) if cut else None, "crossings": sum(c.crossings for c in courses),
        "nonfinite": sum(c.nonfinite for c in courses),
        "ms_per_step": 1e3 * float(np.median(seconds)) if seconds else None,
        "error": next((c.error for c in courses if c.error), None), "note": note,
    }  # fmt: skip
