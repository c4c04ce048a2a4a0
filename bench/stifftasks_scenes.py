"""Scenes of `bench.stifftasks`: what inverse problems simulate, at any step and any number of sweeps."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

import diffvbd as dv
from diffvbd.tasks import Settings, beam, cape_mu, cape_wind, fit_real_mesh, flag_wind
from diffvbd.tasks.cloth import hanging

NONE = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Way:
    """How a motion is computed."""

    time_step: float  # [s]
    sweeps: int
    relaxation: float = 1.0
    coarse: Any = None
    start: Any = "auto"


@dataclass(frozen=True)
class Motion:
    """A motion of some seconds from a given state, for each of some materials."""

    name: str
    mesh: dv.TetMesh
    pinned: np.ndarray
    density: float
    seconds: float
    materials: tuple[dict[str, Any], ...]  # mu, lam [Pa]: of the truth, and of the first guess where it is another
    many: int = 800  # sweeps with corrections that are converged
    x: Tensor | None = None  # None: at rest
    v: Tensor | None = None
    load: Callable[[int], dict[str, Any]] = lambda steps: {"gravity": NONE}

    @cached_property
    def state(self) -> tuple[Tensor, Tensor]:
        x = torch.from_numpy(self.mesh.points.copy()) if self.x is None else self.x
        return x, torch.zeros_like(x) if self.v is None else self.v

    def model(self, way: Way) -> dv.Model:
        return dv.Model(self.mesh, density=self.density, pinned=torch.from_numpy(self.pinned), coarse=way.coarse,
                        relaxation=way.relaxation, start=way.start)  # fmt: skip

    def rolled(self, model: dv.Model, way: Way, material: dict[str, Any]) -> Tensor:
        """Positions after each step."""
        steps = round(self.seconds / way.time_step)
        return dv.rollout(model, *self.state, steps=steps, time_step=way.time_step, sweeps=way.sweeps, **material,
                          **self.load(steps)).x  # fmt: skip

    @torch.no_grad()
    def motions(self, way: Way) -> list[Tensor]:
        model = self.model(way)
        return [self.rolled(model, way, material) for material in self.materials]

    def milliseconds(self, way: Way, rounds: int) -> float:
        """Process time of a rollout of the first material and its reverse with respect to mu; the least of some."""
        model, least = self.model(way), float("inf")
        mu = torch.as_tensor(self.materials[0]["mu"], dtype=torch.float64).clone().requires_grad_()
        for _ in range(rounds):
            begun = time.process_time()
            loss = self.rolled(model, way, {**self.materials[0], "mu": mu}).square().mean()
            torch.autograd.grad(loss, mu)
            least = min(least, time.process_time() - begun)
        return 1e3 * least


def twisted_beam(quick: bool) -> Motion:
    mesh, clamped = _beam(quick)
    truth = {"mu": beam.TRUE_MU, "lam": beam.LAM}
    return Motion("beam-mu", mesh, clamped, beam.DENSITY, 0.2, (truth, {**truth, "mu": beam.START_MU}), 100,
                  x=beam.twisted(torch.from_numpy(mesh.points.copy()), beam.TWIST))  # fmt: skip


def kicked_beam(quick: bool) -> Motion:
    mesh, clamped = _beam(quick)
    v = beam.kicked(torch.from_numpy(mesh.points.copy()), beam.KICK / 0.2)
    v[torch.from_numpy(clamped)] = 0
    first: dict[str, Any] = dict(zip(("mu", "lam"), beam.START, strict=True))
    return Motion("beam-mu-lam", mesh, clamped, beam.DENSITY, 0.2, (beam.TRUTH, first), 100,
                  v=v)  # fmt: skip


def _beam(quick: bool) -> tuple[dv.TetMesh, np.ndarray]:
    mesh = dv.mesh.beam(*((6, 3, 3) if quick else (21, 7, 7)), size=beam.SIZE, split="kuhn")
    return mesh, mesh.points[:, 0] < 1e-9


def sagging_cloth(quick: bool) -> Motion:
    task = cape_mu
    mesh = dv.mesh.sheet(*((6, 5) if quick else (22, 11)), size=(task.SIDE, task.SIDE), thickness=task.THICKNESS)
    corners = np.all(np.abs(mesh.points[:, ::2] - 0.5 * task.SIDE) > 0.5 * task.SIDE - 1e-9, axis=1)
    materials = tuple({"mu": mu, "lam": task.LAM} for mu in (task.TRUE_MU, task.START_MU))
    return Motion("cape-mu", mesh, corners, task.DENSITY, 1 / 3, materials, load=lambda steps: {})


def blown_cape(quick: bool) -> Motion:
    task = cape_wind
    mesh, top = hanging(*((5, 6) if quick else (18, 24)), task.WIDTH, task.LENGTH, task.THICKNESS)
    wind = tuple(a + b for a, b in zip(task.GRAVITY, task.TRUE_WIND, strict=True))
    return Motion("cape-wind", mesh, top, task.DENSITY, 0.5, ({"mu": task.MU, "lam": task.LAM},),
                  load=lambda steps: {"gravity": wind})  # fmt: skip


def blown_flag(quick: bool) -> Motion:
    task = flag_wind
    mesh, top = hanging(*((5, 4) if quick else (17, 13)), task.WIDTH, task.LENGTH, task.THICKNESS)
    gravity = torch.tensor(task.GRAVITY, dtype=torch.float64)

    def load(steps: int) -> dict[str, Any]:
        window = torch.arange(steps) * task.WINDOWS // steps
        return {"gravity": dv.per_step((gravity + task.reference_wind()[window])[:, None])}

    return Motion("flag-wind", mesh, top, task.DENSITY, 1.0, ({"mu": task.MU, "lam": task.LAM},),
                  load=load)  # fmt: skip


def pulled_rabbit(quick: bool) -> Motion:
    task = fit_real_mesh
    pulled = task.Pulled(task.scaled(dv.mesh.bunny(8 if quick else 10), task.HEIGHT), Settings(Path()),
                         task.QUICK if quick else task.FULL)  # fmt: skip
    load = {"force": pulled.force, "gravity": NONE}
    factor = 2 * task.POISSON / (1 - 2 * task.POISSON)
    return Motion("fit-real-mesh", pulled.body, pulled.model.pinned.numpy(), task.DENSITY, 0.24,
                  ({"mu": pulled.true, "lam": factor * pulled.true},), 60,
                  x=pulled.x.contiguous(), v=pulled.v, load=lambda steps: load)  # fmt: skip


# What `tasks` compares, and what became of it: first what a task had, then others. "kept": what the task has now.
TASKS: tuple[tuple[Callable[[bool], Motion], tuple[tuple[Way, str], ...]], ...] = (
    (twisted_beam, (
        (Way(2e-3, 15, start="predictor"), "before"),
        (Way(2e-3, 8, 1.5, "auto"), "kept"),
        (Way(2e-3, 5, 1.5, "auto"), ""),
        (Way(2e-3, 15, 1.6, start="predictor"), ""),
        (Way(2e-3, 20, 1.7), ""),
    )),
    (kicked_beam, (
        (Way(2e-3, 15, start="predictor"), "stays: soft, plain sweeps are converged"),
        (Way(2e-3, 5, 1.5, "auto"), ""),
        (Way(2e-3, 2, 1.5, "auto"), ""),
        (Way(2e-3, 5, start="predictor"), ""),
    )),
    (sagging_cloth, (
        (Way(1 / 240, 40, 1.7, start="predictor"), "before"),
        (Way(1 / 60, 29, 1.7, "auto"), "kept: the figure's h"),
        (Way(1 / 60, 11, 1.7, "auto"), ""),
        (Way(1 / 60, 40, 1.7), ""),
        (Way(1 / 240, 11, 1.7, "auto"), ""),
        (Way(1 / 240, 20, 1.7, "auto"), ""),
    )),
    (blown_cape, (
        (Way(1 / 120, 20, 1.7, start="predictor"), "before"),
        (Way(1 / 60, 8, 1.7, "auto"), "kept: the figure's h"),
        (Way(1 / 60, 5, 1.7, "auto"), ""),
        (Way(1 / 60, 40, 1.7, start="predictor"), ""),
        (Way(1 / 120, 11, 1.7, "auto"), ""),
    )),
    (blown_flag, (
        (Way(1 / 120, 10, 1.7, start="predictor"), "stays: the paper's K; 16 sweeps do what 11 with corrections do"),
        (Way(1 / 120, 8, 1.7, "auto"), ""),
        (Way(1 / 120, 11, 1.7, "auto"), ""),
        (Way(1 / 120, 16, 1.7, start="predictor"), ""),
        (Way(1 / 120, 20, 1.7, start="predictor"), ""),
        (Way(1 / 60, 8, 1.7, "auto"), ""),
    )),
    (pulled_rabbit, (
        (Way(5e-3, 20, 1.7, start="predictor"), "before"),
        (Way(5e-3, 20, 1.7), "kept: no corrections, but the better start"),
        (Way(5e-3, 8, 1.5, "auto"), ""),
        (Way(5e-3, 11, 1.5, "auto"), ""),
    )),
)  # fmt: skip


@dataclass(frozen=True)
class Body:
    """A body in gravity, in a state that it leaves."""

    name: str
    mesh: dv.TetMesh
    material: dict[str, Any]  # mu, lam [Pa]
    time_step: float = 1 / 60
    pinned: np.ndarray | None = None
    x: Tensor | None = None  # None: at rest
    v: Tensor | None = None
    energies: tuple[Any, ...] = (dv.StableNeoHookean(),)

    def model(self, coarse: Any, relaxation: float = 1.5, rigid: bool | None = None) -> dv.Model:
        pinned = None if self.pinned is None else torch.from_numpy(self.pinned)
        return dv.Model(self.mesh, pinned=pinned, energies=self.energies, relaxation=relaxation, rigid=rigid,
                        coarse=coarse)  # fmt: skip

    def rolled(self, model: dv.Model, sweeps: int, steps: int) -> dv.Trajectory:
        x = torch.from_numpy(self.mesh.points.copy()) if self.x is None else self.x
        v = torch.zeros_like(x) if self.v is None else self.v
        with torch.no_grad():
            return dv.rollout(model, x, v, steps=steps, time_step=self.time_step, sweeps=sweeps, **self.material)

    def goal(self, steps: int, quick: bool) -> tuple[Tensor, float, float]:
        """Converged steps, the largest motion but for the fall of a free body, and how far half the sweeps are off."""
        model = self.model("auto")
        few, many = (self.rolled(model, k, steps).x for k in ((20, 40) if quick else (300, 600)))
        motion = many - many[0]
        if self.pinned is None:
            m = model.mass[:, None]
            motion = motion - (m * motion).sum(1, keepdim=True) / m.sum()
        moved = float(motion.norm(dim=-1).max())
        return many, moved, float((many - few).norm(dim=-1).max()) / moved

    def milliseconds(self, model: dv.Model, sweeps: int, rounds: int, steps: int = 10) -> float:
        """Processor time of a step and its backward; the least of some rounds of ten."""
        x = (torch.from_numpy(self.mesh.points.copy()) if self.x is None else self.x).clone().requires_grad_()
        v, least = torch.zeros_like(x) if self.v is None else self.v, float("inf")
        for _ in range(rounds):
            begun = time.process_time()
            way = dv.rollout(model, x, v, steps=steps, time_step=self.time_step, sweeps=sweeps, save="last",
                             **self.material)  # fmt: skip
            torch.autograd.grad(way.x.sum(), x)
            least = min(least, time.process_time() - begun)
        return 1e3 * least / steps


def turning(points: Tensor, rate: float) -> Tensor:
    """Velocity [m/s] of points that turn about z through their middle at a rate [rad/s]."""
    arm = points - 0.5 * (points.amin(0) + points.amax(0))
    return rate * torch.stack([-arm[:, 1], arm[:, 0], torch.zeros_like(arm[:, 0])], dim=1)


def bodies(quick: bool) -> list[Body]:
    """Bars of 1 m: free and turning, free and thrown so that they bend, held at one end; soft and stiff."""
    mesh = dv.mesh.beam(*((5, 3, 3) if quick else (13, 5, 5)), size=(1.0, 0.2, 0.2), split="kuhn")
    points = torch.from_numpy(mesh.points.copy())
    bent = torch.zeros_like(points)
    bent[:, 1] = 2.0 * torch.cos(2 * torch.pi * points[:, 0])
    held = mesh.points[:, 0] < 1e-9
    out = []
    for mu in (1e4, 1e6):
        material = {"mu": mu, "lam": mu}
        out += [Body(f"falls and spins at 5 rad/s, mu {mu:.0e}", mesh, material, v=turning(points, 5.0)),
                Body(f"falls and bends, mu {mu:.0e}", mesh, material, v=bent),
                Body(f"cantilever, mu {mu:.0e}", mesh, material, pinned=held)]  # fmt: skip
    return out


def easy_bodies(quick: bool) -> list[Body]:
    """Scenes that plain sweeps settle quickly: soft, compact, short steps."""
    cube, rabbit = dv.mesh.cube(3 if quick else 6, size=0.5, split="kuhn"), dv.mesh.bunny(8)
    standing = cube.translate([0.0, 0.03 - cube.points[:, 1].min(), 0.0])
    rabbit = rabbit.translate([0.0, 0.03 - rabbit.points[:, 1].min(), 0.0])
    many = dv.mesh.replicate(
        dv.mesh.cube(3, size=0.1, split="kuhn"), [[0.2 * i, 0.03, 0.2 * j] for i in range(6) for j in range(6)]
    )
    floor = (dv.StableNeoHookean(), dv.FloorBarrier(height=0.0, kappa=1e3, dhat=0.01))
    factors = torch.tensor([1.0, 1.3, 1.0], dtype=torch.float64)

    def stretched(mesh: dv.TetMesh) -> Tensor:
        return torch.from_numpy(mesh.points.copy()) * factors

    def down(mesh: dv.TetMesh, speed: float = 1.0) -> Tensor:
        v = torch.zeros(mesh.num_vertices, 3, dtype=torch.float64)
        v[:, 1] = -speed
        return v

    soft, hard, short = {"mu": 1e4, "lam": 1e4}, {"mu": 1e5, "lam": 1e5}, 1 / 200
    out = [
        Body("cube in the air, stretched, mu 1e4, h = 1/200", cube, soft, short, x=stretched(cube)),
        Body("cube onto a floor, mu 1e4, h = 1/200", standing, soft, short, v=down(standing), energies=floor),
    ]
    return out if quick else [
        *out,
        Body("cube in the air, stretched, mu 1e3, h = 1/200", cube, {"mu": 1e3, "lam": 1e3}, short, x=stretched(cube)),
        Body("cube in the air, stretched, mu 1e4, h = 1/60", cube, soft, x=stretched(cube)),
        Body("cube in the air, stretched, mu 1e5, h = 1/60", cube, hard, x=stretched(cube)),
        Body("cube onto a floor, mu 1e5, h = 1/60", standing, hard, v=down(standing), energies=floor),
        Body("rabbit onto a floor, mu 1e4, h = 1/200", rabbit, soft, short, v=down(rabbit), energies=floor),
        Body("rabbit onto a floor, mu 1e5, h = 1/60", rabbit, hard, v=down(rabbit), energies=floor),
        Body("36 small cubes onto a floor, mu 1e4, h = 1/200", many, soft, short, v=down(many), energies=floor),
        Body("cube held at one side, mu 1e4, h = 1/60", cube, soft,
             pinned=cube.points[:, 0] < cube.points[:, 0].min() + 1e-9),
        *bodies(quick),  # the stiff ones of these are not easy: where does it turn?
    ]  # fmt: skip


BODIES, EASY = bodies, easy_bodies
