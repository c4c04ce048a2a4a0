"""Which wrong motion is silent: rollouts of random parameters against the same steps with converged sweeps.

Four kinds: bodies that drop onto a floor, bodies that bounce off one, cantilevers that vibrate at K = 10, and Delaunay
tapers with slivers. A rollout is wrong where its motion is off by more than 5 %, of four frames and all vertices over
their way; it is silent where nothing was warned of.
"""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

import diffvbd as dv
from bench.measure import Card
from bench.tables import Table, count

WRONG, CONVERGED = 0.05, 0.005  # of the motion
MOST_SWEEPS = 15_000
FLOOR_TIME = 0.25  # [s] of a drop
SEED = 61


class Scene(NamedTuple):
    model: dv.Model
    v: Tensor
    gravity: float  # [m/s^2], along y
    steps: int
    solver: dv.VBD
    young: float
    poisson: float


def _relaxation(rng: np.random.Generator) -> float:
    return float(rng.choice([1.0, 1.0, 1.3, 1.5]))


def on_floor(rng: np.random.Generator, bounces: bool) -> Scene:
    body = dv.mesh.blob(int(rng.integers(4, 6)), radius=0.1)
    if rng.random() < 0.5:
        body = dv.mesh.cube(int(rng.integers(3, 5)), size=0.2)
    body = body.translate((0.0, -float(body.points[:, 1].min()), 0.0))
    dhat, h = 10 ** rng.uniform(-2.6, -2), 10 ** rng.uniform(-3.3, -2)
    gap = rng.uniform(1.5, 6) * dhat
    floor = dv.FloorBarrier(height=-gap, kappa=10 ** rng.uniform(3, 5.5), dhat=dhat)
    model, relaxation = dv.Model(body, energies=(dv.StableNeoHookean(), floor)), _relaxation(rng)
    speed = rng.uniform(0.5, 3) if bounces else rng.uniform(0, 0.5)
    v = torch.zeros_like(model.rest_points)
    v[:, 1] = -speed
    duration = 2.5 * gap / speed + 0.12 if bounces else FLOOR_TIME
    solver = dv.VBD(h, int(rng.integers(2, 25)), relaxation=relaxation)
    return Scene(model, v, 0.0 if bounces else -9.81, _steps(duration, h), solver, 10 ** rng.uniform(4, 7),
                 rng.uniform(0.2, 0.45))  # fmt: skip


def cantilever(rng: np.random.Generator) -> Scene:
    width, length = rng.uniform(0.03, 0.1), 0.4
    body = dv.mesh.beam(int(rng.integers(4, 10)), 3, 3, size=(length, width, width))
    model, relaxation = dv.Model(body, pinned=body.points[:, 0] < 1e-9), _relaxation(rng)
    young, h = 10 ** rng.uniform(4, 7), 10 ** rng.uniform(-3.3, -1.7)
    v, falls = torch.zeros_like(model.rest_points), rng.random() < 0.5
    if not falls:
        v[:, 1] = rng.uniform(1, 9) * model.rest_points[:, 0].square()
    integrator = rng.choice(np.array([dv.ImplicitEuler(), dv.ImplicitEuler(), dv.BDF2(), dv.SDIRK2()], dtype=object))
    solver = dv.VBD(h, 10, relaxation=relaxation, integrator=integrator)
    return Scene(model, v, -9.81 if falls else 0.0, _steps(1.5 * _period(young, length, width), h), solver, young,
                 rng.uniform(0.2, 0.45))  # fmt: skip


def taper(rng: np.random.Generator) -> Scene:
    body, h, young = sliver_taper(rng), 10 ** rng.uniform(-3, -1.7), 10 ** rng.uniform(4, 7)
    model, coarse = dv.Model(body, pinned=body.points[:, 0] < 1e-9), rng.random() < 0.5
    relaxation = 1.5 if coarse else _relaxation(rng)
    integrator = dv.SDIRK2() if rng.random() < 0.5 else dv.ImplicitEuler()
    solver = dv.VBD(h, int(rng.integers(2, 20)), relaxation=relaxation, integrator=integrator,
                    subspace="coarse" if coarse else "rigid")  # fmt: skip
    return Scene(model, torch.zeros_like(model.rest_points), -9.81, _steps(1.5 * _period(young, 0.6, 0.1), h), solver,
                 young, rng.uniform(0.2, 0.4))  # fmt: skip


def sliver_taper(rng: np.random.Generator, least: float = 0.02) -> dv.TetMesh:
    """A bar that narrows, of moved points; its worst tets have at least this quality (a regular one 1)."""
    from scipy.spatial import Delaunay

    points = []
    for along in np.linspace(0, 1, 7):
        width = 0.12 - 0.07 * along
        for side in np.stack(np.meshgrid((-0.5, 0.0, 0.5), (-0.5, 0.0, 0.5)), -1).reshape(-1, 2):
            moved = np.array([0.6 * along, *(width * side)]) + 0.075 * width * rng.uniform(-1, 1, 3)
            on_face = np.array([along in (0.0, 1.0), *(side != 0)])
            points.append(np.where(on_face, [0.6 * along, *(width * side)], moved))
    corners = np.array(points)
    tets = Delaunay(corners).simplices
    edges = corners[tets[:, 1:]] - corners[tets[:, :1]]
    sides = corners[tets[:, [0, 0, 0, 1, 1, 2]]] - corners[tets[:, [1, 2, 3, 2, 3, 3]]]
    quality = math.sqrt(2) * np.abs(np.linalg.det(edges)) / np.square(sides).sum(-1).mean(1) ** 1.5
    return dv.TetMesh(corners, tets[quality > least], orient=True)


def _period(young: float, length: float, width: float) -> float:
    """Of the first bending vibration of a bar of 1000 kg/m^3 [s]."""
    return 2 * math.pi * length**2 / (3.516 * math.sqrt(young * width**2 / 12e3))


def _steps(duration: float, h: float) -> int:
    return max(12, min(300, 4 * round(duration / h / 4)))


KINDS = {"drop on a floor": lambda rng: on_floor(rng, False), "bounce": lambda rng: on_floor(rng, True),
         "cantilever, K = 10": cantilever, "taper with slivers": taper}  # fmt: skip


def rolled(scene: Scene, solver: dv.VBD) -> Tensor | None:
    """Frames, or None where the rollout refuses to go on."""
    try:
        with torch.no_grad():
            return dv.rollout(scene.model, scene.model.rest_points, scene.v, solver, steps=scene.steps,
                              young=scene.young, poisson=scene.poisson, gravity=(0, scene.gravity, 0)).x  # fmt: skip
    except ValueError:
        return None


def apart(a: Tensor, b: Tensor) -> float:
    """Root mean square distance, over vertices and four frames, over the way of b from its start."""
    frames = [len(b) // 4 * k for k in (1, 2, 3)] + [len(b) - 1]
    size = [float((t[frames] - s).square().mean().sqrt()) for t, s in ((a, b[frames]), (b, b[0]))]
    return size[0] / size[1] if math.isfinite(size[0]) else math.inf


def converged(scene: Scene, floor: bool) -> Tensor | None:
    """Frames of the same steps, whose sweeps trebled change nothing to speak of."""
    relaxation, subspace = (1.3, "rigid") if floor else (1.0, "coarse")
    solver = replace(scene.solver, relaxation=relaxation, subspace=subspace)
    sweeps, before = 100, None
    while sweeps < MOST_SWEEPS:
        now = rolled(scene, replace(solver, sweeps=sweeps))
        if before is not None and now is not None and apart(before, now) < CONVERGED:
            return now
        before, sweeps = now, 3 * sweeps
    return None


def measure(case: tuple[str, int]) -> dict[str, Any]:
    torch.set_num_threads(1)
    kind, number = case
    scene = KINDS[kind](np.random.default_rng([SEED, list(KINDS).index(kind), number]))
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        began = time.perf_counter()
        frames = rolled(scene, scene.solver)
        seconds = time.perf_counter() - began
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        reference = converged(scene, kind in list(KINDS)[:2])
    error = None if reference is None else math.inf if frames is None else apart(frames, reference)
    return {"error": error, "warned": bool(said) or frames is None,
            "of": sorted({str(w.message).split(":")[0] for w in said}),
            "sweeps": scene.solver.sweeps, "time_step": scene.solver.time_step, "steps": scene.steps,
            "young": scene.young, "poisson": scene.poisson, "relaxation": scene.solver.relaxation,
            "coarse": scene.solver.coarse is not None, "integrator": type(scene.solver.integrator).__name__,
            "seconds": seconds}  # fmt: skip


def kind(name: str) -> Callable[[Card], list[dict[str, Any]]]:
    return lambda card: [measure((name, number)) for number in range(1 if card.quick else 20)]


def wrong(row: Any) -> bool:
    return row["error"] is not None and not (isinstance(row["error"], float) and row["error"] <= WRONG)


GROUPS = {name: kind(name) for name in KINDS}
THREADS = 1
TABLES = (
    Table(f"Rollouts off by more than {100 * WRONG:g} % of their motion: {{}}", "*",
          {"rollouts": count(), "wrong, silent": count(lambda row: wrong(row) and not row["warned"]),
           "wrong, warned": count(lambda row: wrong(row) and row["warned"]),
           "right, warned": count(lambda row: row["error"] is not None and not wrong(row) and row["warned"]),
           "reference not converged": count(lambda row: row["error"] is None)}, by="coarse"),
)  # fmt: skip
