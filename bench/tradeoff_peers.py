"""Other solvers on the cantilevers of `bench tradeoff`: converged steps, steps in other precisions, unrolled autograd,
XPBD, projective dynamics.

The first three have the law of the scene and its reference. XPBD (springs along edges) and projective dynamics (tets
that resist rotation-free change) have laws of their own, so each is held against its own limit of short steps and many
iterations: what it takes to resolve what it models. Newton's SolverVBD takes part where it is installed.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

import diffvbd as dv
from bench import newton
from bench.advice_scenes import Scene
from diffvbd.rollout.tune import FRAMES
from diffvbd.solvers import XPBD, ProjectiveDynamics

Row = dict[str, Any]
Step = Callable[[Tensor, Tensor, float, int], tuple[Tensor, Tensor]]
Distance = Callable[[Tensor], float]  # of frames [FRAMES, V, 3] to the reference of the scene
LAW = "error against its own limit: another law"


def framed(step: Step, x: Tensor, v: Tensor, steps: int, duration: float, iterations: int) -> tuple[Tensor, float]:
    """Frames [FRAMES, V, 3] of steps one by one, and what they took [s]."""
    frames, began = [], time.perf_counter()
    for n in range(1, steps + 1):
        x, v = step(x, v, duration / steps, iterations)
        if n % (steps // FRAMES) == 0:
            frames.append(x)
    return torch.stack(frames), time.perf_counter() - began


def apart(frames: Tensor, truth: Tensor, x: Tensor) -> float:
    """Root mean square distance over the motion."""
    return float((frames - truth).square().sum(-1).mean().sqrt() / (truth - x).square().sum(-1).mean().sqrt())


def against_itself(name: str, step: Step, scene: Scene, iterations: tuple[int, ...], rungs: int) -> list[Row]:
    """Ever more steps, held against the last of them with twice the steps and the most iterations."""
    x = scene.model.rest_points
    finest = FRAMES * 2**rungs
    with torch.no_grad():
        truth, _ = framed(step, x, scene.v, 2 * finest, scene.duration, iterations[-1])
        rows = []
        for count in iterations:
            for rung in range(rungs + 1):
                frames, seconds = framed(step, x, scene.v, FRAMES * 2**rung, scene.duration, count)
                rows.append({"solver": name, "iterations": count, "steps": FRAMES * 2**rung, "ms": 1e3 * seconds,
                             "error": apart(frames, truth, x), "note": LAW})  # fmt: skip
    return rows


def peers(scene: Scene, distance: Distance, quick: bool) -> list[Row]:
    model, rungs = scene.model, 1 if quick else 5
    mu = float(torch.as_tensor(scene.given["mu"]))
    return [
        *converged(scene, distance, rungs),
        *precisions(scene, distance, rungs),
        *unrolled(scene, quick),
        *against_itself("XPBD, springs", _xpbd(model, mu), scene, (2,) if quick else (5, 20), rungs),
        *against_itself("projective dynamics", _projective(model, mu), scene, (2,) if quick else (5, 20), rungs),
        *newtons(scene, distance, quick),
    ]  # fmt: skip


def converged(scene: Scene, distance: Distance, rungs: int) -> list[Row]:
    """dv.solve: each step of implicit Euler swept until its residual is 1e-4."""

    def step(x: Tensor, v: Tensor, h: float, most: int) -> tuple[Tensor, Tensor]:
        found = dv.solve(scene.model, x, v, time_step=h, tolerance=1e-4, max_sweeps=most, on_failure="warn",
                         **scene.given)  # fmt: skip
        return found.x, found.v

    rows = []
    with torch.no_grad():
        for rung in range(rungs):
            steps = FRAMES * 2**rung
            frames, seconds = framed(step, scene.model.rest_points, scene.v, steps, scene.duration, 5000)
            rows.append({"solver": "dv.solve", "iterations": "to 1e-4", "steps": steps, "ms": 1e3 * seconds,
                         "error": distance(frames), "note": "implicit Euler"})  # fmt: skip
    return rows


def precisions(scene: Scene, distance: Distance, rungs: int) -> list[Row]:
    """The same steps in double, in single, and in single precision with a state that is kept in double."""
    double = scene.model.replace(relaxation=1.5, coarse=dv.CoarseSpace())
    single = double.to(dtype=torch.float32)
    given = {name: value.float() if isinstance(value, Tensor) else value for name, value in scene.given.items()}

    def stepped(model: dv.Model, material: dict[str, Any], keeps: bool) -> Step:
        def step(x: Tensor, v: Tensor, h: float, sweeps: int) -> tuple[Tensor, Tensor]:
            at, speed = x.to(model.dtype), v.to(model.dtype)
            end = dv.step(model, at, speed, time_step=h, sweeps=sweeps, integrator=dv.SDIRK2(), **material)
            return (x + (end[0] - at).to(x), v + (end[1] - speed).to(v)) if keeps else end

        return step

    ways = [("float64", stepped(double, scene.given, False)), ("float32", stepped(single, given, False)),
            ("float32 sweeps, float64 state", stepped(single, given, True))]  # fmt: skip
    rows = []
    with torch.no_grad():
        for name, step in ways:
            for rung in range(rungs):
                steps = FRAMES * 2**rung
                frames, seconds = framed(step, scene.model.rest_points, scene.v, steps, scene.duration, 8)
                rows.append({"solver": name, "iterations": 8, "steps": steps, "ms": 1e3 * seconds,
                             "error": distance(frames.double()), "note": "SDIRK2, coarse"})  # fmt: skip
    return rows


def unrolled(scene: Scene, quick: bool) -> list[Row]:
    """Forward and backward of 8 steps, K = 5, by torch's autograd through the same sweeps, and by the reverse sweep."""
    rows, steps = [], 2 if quick else 8
    x = scene.model.rest_points
    for name, adjoint in (("unrolled autograd", dv.Unrolled()), ("reverse sweep", dv.ReverseSweep())):
        v = scene.v.clone().requires_grad_()
        began = time.perf_counter()
        end = dv.rollout(scene.model, x, v, steps=steps, time_step=scene.duration / 64, sweeps=5, adjoint=adjoint,
                         save="last", **scene.given)  # fmt: skip
        (end.x[-1] - x).square().sum().backward()
        rows.append({"solver": name, "iterations": 5, "steps": steps, "ms": 1e3 * (time.perf_counter() - began),
                     "error": None, "note": "forward and backward; the same numbers"})  # fmt: skip
    return rows


def _xpbd(model: dv.Model, mu: float) -> Step:
    solver = XPBD.from_mesh(model.mesh, pinned=model.pinned)
    # a spring of a tet's size and the same modulus
    stiffness = mu * float(model.mesh.points[model.mesh.tets].std(1).mean())
    return lambda x, v, h, k: solver.step(x, v, stiffness=stiffness, time_step=h, sweeps=k)


def _projective(model: dv.Model, mu: float) -> Step:
    solver = ProjectiveDynamics.from_mesh(model.mesh, pinned=model.pinned)
    factors: dict[float, Any] = {}

    def step(x: Tensor, v: Tensor, h: float, k: int) -> tuple[Tensor, Tensor]:
        if h not in factors:
            factors[h] = solver.factor(time_step=h, tet_stiffness=2 * mu, stiffness=None)
        return solver.step(x, v, factor=factors[h], sweeps=k)

    return step


def newtons(scene: Scene, distance: Distance, quick: bool) -> list[Row]:
    """Newton's SolverVBD of the same mesh and moduli, forward, in float32 on the CPU."""
    try:
        material = float(scene.given["mu"]), float(scene.given["lam"])
        return newton.ladder(scene.model.mesh, scene.model.pinned.numpy(), material, scene.duration,
                             (2,) if quick else (5, 20, 80), 1 if quick else 6, FRAMES,
                             lambda x: distance(torch.as_tensor(x)), scene.v.numpy())  # fmt: skip
    except ImportError as error:
        return [{"solver": "Newton SolverVBD", "note": f"not available ({error})"}]
