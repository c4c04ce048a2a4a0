"""Integrators of time: error and time of a motion over the time step, and what impacts do to energy."""

from __future__ import annotations

import itertools
import time
from typing import Any

import torch
from torch import Tensor

import diffvbd as dv
from bench import tradeoff
from bench.tables import Table
from diffvbd import colliders, reference

INTEGRATORS = {"implicit Euler": dv.ImplicitEuler(), "SDIRK2": dv.SDIRK2(), "BDF2": dv.BDF2()}
SECONDS = 0.4
GAIN = 1e-6  # share of its energy that a scene must gain to count
MATERIAL: dict[str, Any] = {"mu": 1e5, "lam": 2e5}


def beam(quick: bool) -> list[dict[str, Any]]:
    """A cantilever of 0.6 m released from rest: error of its end state over its motion after 0.4 s, and the time that
    takes, of ladders of steps. Sweeps fall with the step, so that each ladder does about the same number of them."""
    mesh = dv.mesh.beam(7, 3, 3, size=(0.6, 0.15, 0.15), split="kuhn") if quick else tradeoff.beam()
    model = dv.Model(mesh, pinned=mesh.points[:, 0] < 0.01)
    x, v = model.rest_points, torch.zeros_like(model.rest_points)

    def end(steps: int, sweeps: int, integrator: Any) -> Tensor:
        solver = dv.VBD(SECONDS / steps, sweeps, relaxation=1.6, integrator=integrator)
        with torch.no_grad():
            return dv.rollout(model, x, v, solver, steps=steps, save="last", **MATERIAL).x[-1]

    exact = end(200 if quick else 3200, 40, dv.SDIRK2())
    motion, out = float((exact - x).norm()), []
    for steps in (25,) if quick else (25, 50, 100, 200, 400, 800):
        sweeps = max(10, 10_000 // steps)
        row: dict[str, Any] = {"time step [ms]": 1e3 * SECONDS / steps, "sweeps": sweeps}
        for name, integrator in INTEGRATORS.items():
            begun = time.perf_counter()
            error = float((end(steps, sweeps, integrator) - exact).norm()) / motion
            row |= {f"{name}, error": error, f"{name} [s]": time.perf_counter() - begun}
        out.append(row)
    return out


def impacts(quick: bool) -> list[dict[str, Any]]:
    """Cubes of 0.2 m, a scene each, that turn and fall on a plane at some 4 m/s, at any phase of a step: by how much
    the energy of the worst of them exceeds that at its start, what the median has left, and the lowest gap."""
    count, mu, lam, out = (40 if quick else 1000), 1e5, 1e5, []
    cube = dv.mesh.cube(2, size=0.2, split="kuhn")
    plane, body = colliders.Plane((0.0, -0.3, 0.0), (0.0, 1.0, 0.0)), dv.Model(cube)
    models = {}
    for name, own, rubbing in (("rubbing", False, (dv.Friction(0.3),)), ("rubbing, self-contact", True,
                               (dv.Friction(0.3),)), ("smooth", False, ())):  # fmt: skip
        pairs = dv.PairBarrier(kappa=1e4, dhat=0.01, self_contact=own)
        models[name] = dv.Model(cube, energies=(dv.StableNeoHookean(), pairs, *rubbing), colliders=[plane])
    floor = dv.FloorBarrier(-0.3, kappa=1e4, dhat=0.01)
    models["FloorBarrier"] = dv.Model(cube, energies=(dv.StableNeoHookean(), floor))
    model = models["smooth"]
    random = torch.Generator().manual_seed(0)
    x = model.rest_points.expand(count, -1, -1).clone()
    x[..., 1] += 0.2 * torch.rand((count, 1), generator=random, dtype=x.dtype)
    arm = x - x.mean(1, keepdim=True)
    spin, v = (torch.randn((count, 1, 3), generator=random, dtype=x.dtype) for _ in range(2))
    v = v + torch.linalg.cross((6 * spin).expand_as(arm), arm)
    v[..., 1] -= 4

    def energy(x: Tensor, v: Tensor) -> Tensor:
        elastic = reference.incremental_potential(body, x, x, mu, lam, 1.0)
        mass = model.mass[:, None]
        return elastic + (mass * (0.5 * v.square() + 9.81 * (x + 0.3) * torch.tensor([0.0, 1.0, 0.0]))).sum((-1, -2))

    start = energy(x, v)
    cases = [*itertools.product(models, (0.02, 0.005, 0.001), INTEGRATORS.items())]
    for kind, time_step, (name, integrator) in cases[:3] if quick else cases:
        with torch.no_grad():
            steps = round((0.1 if quick else 0.3) / time_step)
            motion = dv.rollout(models[kind], x, v, dv.VBD(time_step, 15, integrator=integrator), steps=steps, mu=mu,
                                lam=lam, checks=dv.Checks(contact=False))  # fmt: skip
            over = torch.stack([energy(a, b) for a, b in zip(motion.x[1:], motion.v[1:], strict=True)]) / start - 1
        out.append({"integrator": name, "floor": kind, "time step [s]": time_step, "impacts": count,
                    "scenes that gain": int((over.amax(0) > GAIN).sum()), "most gained": float(over.max()),
                    "left": float(over[-1].median()) + 1,
                    "lowest gap [m]": float(motion.x[..., 1].min()) + 0.3})  # fmt: skip
    return out


THREADS = 1
GROUPS = {"beam": lambda card: beam(card.quick),          "impacts": lambda card: impacts(card.quick)}  # fmt: skip
TABLES = (
    Table("Cantilever of 0.6 m after 0.4 s: error over motion, and seconds on one thread", "beam"),
    Table("Cubes that fall on a plane: energy over that at the start, worst and median scene", "impacts"),
)
