"""Rigid bodies: a ball on a soft bed beside Hertz, a pressed finger, a tumbling brick, a pendulum on a hinge.

* *Hertz*: A rigid cap of a ball of 0.1 m is pressed with 20 N into a bed of 0.3 m x 0.12 m x 0.3 m (1e5 Pa, Poisson's
  ratio 0.3) that is held below; friction 0.2 keeps it in place. Beside how far the middle of the bed sinks stands the
  closed form, Hertz (1882) with the bed's finite thickness after Dimitriadis et al. (2002). Meshes are finer in the
  middle; "extrapolated" is to cells of no size, by the last two, whose error falls with its square.
* *Pressed*: A finger on a soft bed, pushed down by 3 N beside its weight: the force on the bed at rest.
* *Tumbling*: A brick about its middle axis, 2 s without a torque, beside Euler's equations in small steps: vertices
  relative to the brick's size (root mean squares), spin and size of the vector of spin kept.
* *Hinge*: A bar on two springs of 1e6 N/m as a pendulum, 0.6 s: angle beside the equation of the pendulum, the largest
  gap of the hinge.
* *Time*: a step of a cube of 64 vertices on a soft bed, rigid or soft, on one core.
"""

from __future__ import annotations

import math
import time
from typing import Any

import numpy as np
import torch
from torch import Tensor

import diffvbd as dv
from bench.tables import Table

F64 = torch.float64
RADIUS, YOUNG, POISSON, LOAD, HALF, DEPTH = 0.1, 1e5, 0.3, 20.0, 0.15, 0.12
NOTHING = (0.0, 0.0, 0.0)
TABLES = (
    Table("A rigid ball on a soft bed, beside Hertz", "hertz", {
        "vertices": "vertices", "cell in the middle [mm]": "cell_mm", "sinks [mm]": "sinks_mm", "over Hertz": "ratio",
        "force over load": "force_ratio",
    }),
    Table("Rigid bodies beside closed forms", "checks", {"case": "case", "error": "error", "of": "of"}),
    Table("Time of a step with a cube on a soft bed", "times", {
        "cube": "cube", "sweeps": "sweeps", "forward [ms]": "forward_ms", "and gradient [ms]": "both_ms",
    }),
)  # fmt: skip


def graded(points: np.ndarray) -> np.ndarray:
    """Coordinates in [-1, 1], closer to each other in the middle."""
    return 0.25 * points + 0.75 * np.sign(points) * points**2


def bed_and_ball(n: int) -> tuple[dv.TetMesh, int]:
    """A bed with its top at 0, and the cap of a ball above it; the vertex in the middle of the bed's top."""
    bed = dv.mesh.box((n, (n + 1) // 2, n), (2.0, 1.0, 2.0)).translate((-1.0, -1.0, -1.0))
    points = graded(bed.points) * (HALF, DEPTH, HALF)
    ball = dv.mesh.box((n + 4, 4, n + 4), (2.0, 1.0, 2.0)).translate((-1.0, 0.0, -1.0))
    at = ball.points * (0.055, 1.0, 0.055)
    low = RADIUS - np.sqrt(RADIUS**2 - at[:, 0] ** 2 - at[:, 2] ** 2)
    at[:, 1] = low + (0.05 - low) * at[:, 1] + 5e-4
    mesh = dv.mesh.join([dv.TetMesh(points, bed.tets), dv.TetMesh(at, ball.tets)])
    return mesh, int(np.square(points).sum(1).argmin())


def hertz_depth() -> float:
    """How deep the load presses the ball [m]."""

    def load(depth: float) -> float:
        chi, nu = math.sqrt(RADIUS * depth) / DEPTH, POISSON
        a = -(1.2876 - 1.4678 * nu + 1.3442 * nu**2) / (1 - nu)
        b = (0.6387 - 1.0277 * nu + 1.5164 * nu**2) / (1 - nu)
        pi = math.pi
        thick = 1 - 2 * a / pi * chi + 4 * a**2 / pi**2 * chi**2 - 8 / pi**3 * (a**3 + 4 * pi**2 / 15 * b) * chi**3
        thick += 16 * a / pi**4 * (a**3 + 3 * pi**2 / 5 * b) * chi**4
        return 4 / 3 * YOUNG / (1 - nu**2) * math.sqrt(RADIUS) * depth**1.5 * thick

    low, high = 0.0, 0.02
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if load(middle) < LOAD else (low, middle)
    return low


def pressed_ball(n: int) -> dict[str, Any]:
    mesh, middle = bed_and_ball(n)
    energies = (dv.StableNeoHookean(), dv.PairBarrier(dhat=1e-3, self_contact=False), dv.Friction(0.2))
    model = dv.Model(mesh, 1000.0, mesh.points[:, 1] < 1e-9 - DEPTH, energies, rigid=[1])
    x, solver = model.rest_points, dv.VBD(0.02, 20, subspace="coarse")
    inputs = {"young": YOUNG, "poisson": POISSON, "gravity": NOTHING, "drag": 20.0}
    force = model.wrench(x, 1, force=(0.0, -LOAD, 0.0))
    with torch.no_grad():
        motion = dv.rollout(model, x, torch.zeros_like(x), solver, steps=80, save="last", force=force, **inputs)
        end = motion.x[-1]
        on = dv.contact.forces(model, end, solver, previous=(end, motion.v[-1]), force=force, **inputs).bodies.total
    sinks = -float(end[middle, 1])
    cells = np.diff(np.unique(mesh.points[mesh.body == mesh.body[0], 0]))
    return {"vertices": len(x), "cell_mm": 1e3 * float(cells.min()), "sinks_mm": 1e3 * sinks,
            "ratio": sinks / hertz_depth(), "force_ratio": float(on[1, 1]) / LOAD}  # fmt: skip


def hertz(quick: bool) -> list[dict[str, Any]]:
    rows = [pressed_ball(n) for n in ((9, 11) if quick else (17, 21, 25, 29))]
    (first, last), squares = rows[-2:], [row["cell_mm"] ** 2 for row in rows[-2:]]
    slope = (last["ratio"] - first["ratio"]) / (squares[1] - squares[0])
    ratio = last["ratio"] - slope * squares[1]
    return [*rows, {"vertices": "extrapolated", "cell_mm": 0.0, "sinks_mm": 1e3 * ratio * hertz_depth(),
                    "ratio": ratio, "force_ratio": None}]  # fmt: skip


def pressed_finger() -> dict[str, Any]:
    bed = dv.mesh.box((4, 2, 4), (0.12, 0.04, 0.12))
    mesh = dv.mesh.join([bed, dv.mesh.box((3, 5, 3), (0.03, 0.06, 0.03)).translate((0.045, 0.042, 0.045))])
    energies = (dv.StableNeoHookean(), dv.PairBarrier(), dv.Friction(0.5))
    model = dv.Model(mesh, 1000.0, mesh.points[:, 1] < 1e-9, energies, rigid=[1])
    x, solver = model.rest_points, dv.VBD(0.005, 10)
    force = model.wrench(x, 1, force=(0.0, -3.0, 0.0))
    inputs = {"mu": 3e4, "lam": 3e4, "drag": 20.0, "force": force}
    motion = dv.rollout(model, x, torch.zeros_like(x), solver, steps=300, save="last", **inputs)
    on = dv.contact.forces(model, motion.x[-1], solver, previous=(motion.x[-1], motion.v[-1]), **inputs).bodies.total
    wanted = 3.0 + 9.81 * float(model.mass[model.body == 1].sum())
    return {"case": "pressed with 3 N: force on the bed", "error": abs(float(on[1, 1]) / wanted - 1), "of": "itself"}


def about_center(model: dv.Model, values: Tensor) -> Tensor:
    mass = model.mass[:, None]
    return values - (mass * values).sum(-2, keepdim=True) / mass.sum()


def tumbling(steps: int, integrator: Any) -> list[dict[str, Any]]:
    size, h = np.array([0.1, 0.2, 0.3]), 2.0 / steps
    model = dv.Model(dv.mesh.box((3, 4, 5), tuple(size)), rigid=[0])
    omega, inertia = np.array([0.3, 6.0, 0.1]), (size**2).sum() - size**2
    arm = about_center(model, model.rest_points)
    v = torch.linalg.cross(torch.from_numpy(omega).expand_as(arm), arm)
    solver = dv.VBD(h, 1, integrator=integrator)
    end = dv.rollout(model, model.rest_points, v, solver, steps=steps, mu=1e5, lam=1e5, gravity=NOTHING, save="last")
    turn, tiny = np.eye(3), 1e-4

    def rate(w: np.ndarray) -> np.ndarray:
        return np.cross(inertia * w, w) / inertia

    for _ in range(round(2.0 / tiny)):  # midpoint rule
        w = omega + tiny / 2 * rate(omega)
        angle = np.linalg.norm(w) * tiny
        k = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]]) / np.linalg.norm(w)
        turn = turn @ (np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k)
        omega = omega + tiny * rate(w)
    away = about_center(model, end.x[-1]) - arm @ torch.from_numpy(turn.T)

    def spin(x: Tensor, v: Tensor) -> float:
        return float((model.mass[:, None] * torch.linalg.cross(about_center(model, x), v)).sum(0).norm())

    name = f"tumbling, {type(integrator).__name__}, h = {h:g} s"
    kept = abs(spin(end.x[-1], end.v[-1]) / spin(model.rest_points, v) - 1)
    return [{"case": f"{name}: vertices", "error": float(away.norm() / arm.norm()), "of": "the brick"},
            {"case": f"{name}: angular momentum", "error": kept, "of": "itself"},
            {"case": f"{name}: distances", "error": float((torch.pdist(end.x[-1]) - torch.pdist(arm)).abs().max()),
             "of": "m"}]  # fmt: skip


def hinge(sweeps: int) -> list[dict[str, Any]]:
    length, wide, h = 0.2, 0.03, 2e-3
    mesh = dv.mesh.box((5, 3, 3), (length, wide, wide)).translate((0.0, -wide / 2, -wide / 2))
    at = np.array([[0.0, 0.0, -wide / 2], [0.0, 0.0, wide / 2]])
    ends = [int(np.square(mesh.points - p).sum(1).argmin()) for p in at]
    springs = dv.Springs(dv.Embedding.of_vertices(ends), torch.from_numpy(at), stiffness=1e6)
    model = dv.Model(mesh, 1000.0, energies=(dv.StableNeoHookean(), springs), rigid=[0])
    x, solver = model.rest_points, dv.VBD(h, sweeps, integrator=dv.BDF2())
    motion = dv.rollout(model, x, torch.zeros_like(x), solver, steps=300, mu=1e5, lam=1e5)
    tip = (motion.x[-1][x[:, 0] > length - 1e-9]).mean(0) - torch.from_numpy(at).mean(0)
    angle, speed, tiny = 0.0, 0.0, 1e-5
    inertia = (length**2 + wide**2) / 12 + length**2 / 4
    for _ in range(round(300 * h / tiny)):
        speed -= tiny * 9.81 * length / 2 * math.cos(angle) / inertia
        angle += tiny * speed
    found = math.atan2(float(tip[1]), float(tip[0]))
    gap = (motion.x[:, ends] - torch.from_numpy(at)).norm(dim=-1).max()
    return [{"case": f"hinge, {sweeps} sweeps: angle after 0.6 s",
             "error": abs(math.remainder(found - angle, 2 * math.pi)), "of": "rad"},
            {"case": f"hinge, {sweeps} sweeps: gap", "error": float(gap), "of": "m"}]  # fmt: skip


def times(quick: bool) -> list[dict[str, Any]]:
    rows, threads = [], torch.get_num_threads()
    bed = dv.mesh.box((6, 3, 6), (0.2, 0.06, 0.2))
    mesh = dv.mesh.join([bed, dv.mesh.box(4, 0.06).translate((0.07, 0.062, 0.07))])
    torch.set_num_threads(1)
    for rigid in ((), (1,)):
        energies = (dv.StableNeoHookean(), dv.PairBarrier(), dv.Friction(0.5))
        model = dv.Model(mesh, 1000.0, mesh.points[:, 1] < 1e-9, energies, rigid=rigid)
        for sweeps in (5, 20):
            x, solver, spent = model.rest_points, dv.VBD(0.01, sweeps), {}
            for gradient in (False, True):
                least = math.inf
                for _ in range(3 if quick else 20):
                    start, begin = x.clone().requires_grad_(gradient), time.perf_counter()
                    end, _ = dv.step(model, start, torch.zeros_like(x), solver, mu=2e4, lam=2e4)
                    if gradient:
                        end.sum().backward()
                    least = min(least, time.perf_counter() - begin)
                spent[gradient] = 1e3 * least
            rows.append({"cube": "rigid" if rigid else "soft", "sweeps": sweeps, "forward_ms": spent[False],
                         "both_ms": spent[True]})  # fmt: skip
    torch.set_num_threads(threads)
    return rows


def run(quick: bool) -> dict[str, Any]:
    steps = 200 if quick else 1000
    checks = [pressed_finger(), *tumbling(steps, dv.BDF2()), *tumbling(steps, dv.ImplicitEuler()), *hinge(1), *hinge(5)]
    return {"hertz": hertz(quick), "checks": checks, "times": times(quick)}
