"""Statics, damping, muscles, tendons and pressure beside independent solvers, theory and what was hidden."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

import diffvbd as dv
from bench.measure import Card, Row
from bench.tables import Table
from diffvbd.testing.dense_statics import newton, potential, residual, weight
from diffvbd.testing.soft_scenes import (
    PROBLEMS,
    STILL,
    Linked,
    Mode,
    beam,
    finger,
    finger_on_palm,
    hollow_finger,
    icosphere,
    pressed_sphere,
    recovered_activation,
)

STATIC = dv.VBD(1.0, 0, subspace="coarse")


def spent(work: Callable[[], Any]) -> tuple[Any, float]:
    """What a call returns, and its seconds."""
    begun = time.perf_counter()
    return work(), time.perf_counter() - begun


# --- statics ----------------------------------------------------------------------------------------------------------


def statics(quick: bool) -> list[Row]:
    """Rest states beside a dense Newton solver on its own energy, both from the rest shape."""
    rows = []
    for name in list(PROBLEMS)[: 2 if quick else None]:
        model, inputs, more, weighs = PROBLEMS[name]()
        x = model.rest_points
        done, seconds = spent(lambda m=model, x=x, i=inputs: dv.equilibrium(m, x, STATIC, tolerance=1e-10, **i))
        load = weight(model) if weighs else torch.zeros_like(x)
        energy = potential(model, load, *dv.lame(inputs["young"], inputs["poisson"]), more)
        start = torch.where(model.pinned[:, None], inputs.get("prescribed", x), x)
        other, dense = spent(lambda m=model, e=energy, s=start: newton(m, e, s))
        moved = float((done.x - x).abs().max())
        rows.append({"problem": name, "vertices": model.num_vertices, "iterations": done.iterations,
                     "residual": residual(model, energy, load, done.x),
                     "difference": float((done.x - other).abs().max()) / moved, "seconds": seconds,
                     "dense [s]": dense})  # fmt: skip
    return rows


def sizes(quick: bool) -> list[Row]:
    """A beam that sags by a sixth of its length, beside Newton's method with a sparse direct solver; and its gradient
    with respect to Young's modulus."""
    rows = []
    for cells in (8,) if quick else (8, 16, 32):
        model = beam(1e6, shape=(cells + 1, cells // 4 + 1, cells // 4 + 1)).model
        young = torch.tensor(1e6, dtype=torch.float64, requires_grad=True)
        done, seconds = spent(lambda m=model, y=young: dv.equilibrium(m, m.rest_points, STATIC, young=y, poisson=0.3))
        _, backward = spent(lambda d=done, y=young: torch.autograd.grad(d.x[:, 1].sum(), y))
        (other, iterations), sparse = spent(lambda m=model: sparse_newton(m, *dv.lame(1e6, 0.3)))
        moved = float((done.x - model.rest_points).detach().abs().max())
        rows.append({"vertices": model.num_vertices, "iterations": done.iterations, "seconds": seconds,
                     "gradient [s]": backward, "difference": float((done.x.detach() - other).abs().max()) / moved,
                     "sparse: iterations": iterations, "sparse [s]": sparse})  # fmt: skip
    return rows


def sparse_newton(model: dv.Model, mu: float, lam: float) -> tuple[Tensor, int]:
    """Rest state under gravity by full Newton steps, assembled from derivatives of the energy of one tet; and the
    number of steps."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.linalg import spsolve

    tets, x, load = model.tets, model.rest_points, weight(model)
    edges = (x[tets[:, 1:]] - x[tets[:, :1]]).mT
    inverse, volume = torch.linalg.inv(edges), torch.linalg.det(edges) / 6

    def energy(corners: Tensor, inverse: Tensor, volume: Tensor) -> Tensor:
        f = (corners.reshape(4, 3)[1:] - corners[:3]).mT @ inverse
        j = (f[0] * torch.linalg.cross(f[1], f[2])).sum() - 1
        return volume * (mu / 2 * f.square().sum() - mu * j + (mu + lam) / 2 * j.square())

    slopes, blocks = (torch.func.vmap(of(energy)) for of in (torch.func.grad, torch.func.hessian))
    index = (3 * tets[:, :, None] + torch.arange(3)).reshape(-1, 12)
    free = (~model.pinned).repeat_interleave(3).numpy().nonzero()[0]
    rows, columns = index[:, :, None].expand(-1, 12, 12).reshape(-1), index[:, None].expand(-1, 12, 12).reshape(-1)
    for step in range(50):
        given = x.reshape(-1)[index], inverse, volume
        left = -load.reshape(-1).index_add(0, index.reshape(-1), -slopes(*given).reshape(-1)).numpy()[free]
        if np.linalg.norm(left) <= 1e-10 * float(load.norm()):
            return x, step
        matrix = coo_matrix((blocks(*given).reshape(-1).numpy(), (rows.numpy(), columns.numpy()))).tocsc()
        move = np.zeros(x.numel())
        move[free] = spsolve(matrix[free][:, free], -left)
        x = x + torch.from_numpy(move).reshape(-1, 3)
    raise RuntimeError(f"sparse_newton: expected convergence in 50 steps, got a residual of {np.linalg.norm(left)} N")


# --- damping and muscles ----------------------------------------------------------------------------------------------


def ring_down(quick: bool) -> list[Row]:
    """The lowest mode of a clamped beam: damping ratios recovered from its decay with 1 % of noise."""
    mode = Mode()
    rows = []
    for ratio in (0.04,) if quick else (0.01, 0.02, 0.04, 0.08):
        found = [mode.recovered(ratio, seed) for seed in range(3, 4 if quick else 8)]
        errors = [abs(one / ratio - 1) for one in found]
        rows.append({"ratio": ratio, "motions": len(found), "median error": float(np.median(errors)),
                     "largest error": max(errors)})  # fmt: skip
    return rows


def decay(quick: bool) -> list[Row]:
    """Two periods of the same mode at a ratio of 0.05 beside the formula, over the largest displacement."""
    mode, rows = Mode(), []
    for integrator in (dv.SDIRK2(),) if quick else (dv.SDIRK2(), dv.BDF2(), dv.ImplicitEuler()):
        for per_period in (60,) if quick else (30, 60, 120):
            solver = mode.solver(per_period, 30, integrator)
            steps, drag = 2 * per_period, {"drag": 2 * 0.05 * mode.frequency}
            exact = mode.ring(solver, steps, 0.05)
            errors = [float((mode.amplitudes(solver, steps, **damping) - exact).abs().max() / exact.abs().max())
                      for damping in (mode.viscosities(0.05), drag)]  # fmt: skip
            rows.append({"integrator": str(integrator), "steps of a period": per_period, "error, viscosity": errors[0],
                         "error, drag": errors[1]})  # fmt: skip
    return rows


def muscles(quick: bool) -> list[Row]:
    """Four activations recovered from twelve frames of a motion."""
    true = torch.tensor([0.05, 0.15, 0.25, 0.1], dtype=torch.float64)
    rows = []
    for noise in (1e-5,) if quick else (0.0, 1e-5, 1e-4):
        found, seconds = spent(lambda noise=noise: recovered_activation(true, noise))
        rows.append({"noise [m]": noise, "largest error": float((found / true - 1).abs().max()), "seconds": seconds})
    return rows


# --- pressure and tendons ---------------------------------------------------------------------------------------------

YOUNG, POISSON = 1e5, 0.3


def spheres(quick: bool) -> list[Row]:
    """Growth of a sphere of radius 1 m under pressure: at rest, and where a damped motion of 1 s ends."""
    rows = []
    for levels, thickness in ((1, 0.1),) if quick else ((2, 0.05), (3, 0.05), (3, 0.02)):
        model = dv.Model(dv.mesh.shell(*icosphere(levels), thickness), energies=(dv.StableNeoHookean(), dv.Pressure()))
        pressure = 0.002 * YOUNG * thickness
        inputs = {"young": YOUNG, "poisson": POISSON, "pressure": pressure, "gravity": STILL}
        ends = {"equilibrium": spent(lambda m=model, i=inputs: dv.equilibrium(m, m.rest_points, STATIC, **i).x)}
        for h, sweeps in ((1e-2, 80), (1e-3, 12)) if levels == 2 or thickness < 0.05 or quick else ():
            solver = dv.VBD(h, sweeps, relaxation=1.6, subspace="coarse")
            ends[f"steps of {1e3 * h:g} ms"] = spent(lambda m=model, s=solver, i=inputs: settled(m, s, **i))
        thick = pressed_sphere(YOUNG, POISSON, pressure, thickness)
        thin = pressure * (1 - POISSON) / (2 * YOUNG * thickness)
        for name, (x, seconds) in ends.items():
            growth = float((x.norm(dim=1) - model.rest_points.norm(dim=1)).mean())
            rows.append({"wall [m]": thickness, "vertices": model.num_vertices, "by": name,
                         "over thick sphere": growth / thick - 1, "over thin sphere": growth / thin - 1,
                         "seconds": seconds})  # fmt: skip
    return rows


@torch.no_grad()
def settled(model: dv.Model, solver: dv.VBD, **inputs: Any) -> Tensor:
    x = model.rest_points
    return dv.rollout(model, x, torch.zeros_like(x), solver, duration=1.0, save="last", drag=30.0, **inputs).x[-1]


def fingers(quick: bool) -> list[Row]:
    """Bending by a tendon: of stiff links and soft hinges, whose moments balance, in rad; and of a beam whose upper
    side it runs along, whose end moment deflects it, in m."""
    rows = []
    for cells in (4,) if quick else (4, 8, 12):
        linked = Linked.of(cells)
        for short in (2e-3, 1e-2):
            inputs = {"tendon_rest_length": 0.14 - short, "tendon_stiffness": 10.0}
            done, seconds = spent(lambda m=linked, i=inputs: dv.equilibrium(
                m.model, m.model.rest_points, STATIC, young=m.young, poisson=0.0, gravity=STILL, **i))  # fmt: skip
            angle, balance = linked.angle(done.x), linked.balanced(tension_of(linked.model, done.x, **inputs))
            rows.append(row_of("links and hinges", cells, linked.model, angle, balance, done, seconds))
    length, height, width = 0.2, 0.03, 0.005
    for cells in () if quick else (4, 8, 12):
        model = finger((round(length / height * cells) + 1, cells + 1, 2), (length, height, width), 5, 100.0)
        inputs = {"tendon_rest_length": length - 5e-4}
        done, seconds = spent(lambda m=model, i=inputs: dv.equilibrium(
            m, m.rest_points, STATIC, young=1e6, poisson=0.3, gravity=STILL, **i))  # fmt: skip
        tip = model.rest_points[:, 0] > length - 1e-9
        moment = tension_of(model, done.x, **inputs) * height / 2
        deflection = moment * length**2 / (2 * 1e6 * height**3 * width / 12)
        found = float((done.x - model.rest_points)[tip, 1].mean())
        rows.append(row_of("beam", cells, model, found, deflection, done, seconds))
    return rows


# --- joined bodies ----------------------------------------------------------------------------------------------------


def joints(quick: bool) -> list[Row]:
    """Motions of joined bodies by few sweeps beside those by many: what is looked at over its largest change."""
    rows = []
    for name, scene in JOINED.items():
        moved, model, look, inputs, h, steps, sweeps = scene()
        exact = None
        for subspace, count in (("coarse", 320), *((sub, k) for sub in ("rigid", "coarse") for k in sweeps)):
            if quick and count > 40 and exact is not None:
                continue
            with warnings.catch_warnings(record=True) as heard, torch.no_grad():
                warnings.simplefilter("always")
                x, solver = model.rest_points, dv.VBD(h, count, subspace=subspace)
                motion, seconds = spent(lambda m=model, s=solver, x=x, i=inputs, n=steps: dv.rollout(
                    m, x, torch.zeros_like(x), s, steps=n, **i))  # fmt: skip
            found = look(motion.x)
            exact = found if exact is None else exact
            error = float((found - exact).square().mean().sqrt() / (exact - exact[0]).abs().max())
            warned = any("leave steps unsolved" in str(w.message) for w in heard)
            rows.append({"scene": name, "looked at": moved, "vertices": model.num_vertices, "subspace": subspace,
                         "K": count, "error": error, "warned": warned, "ms a step": 1e3 * seconds / steps})  # fmt: skip
    return rows


def swinging(stiffness: float) -> Any:
    half = dv.mesh.beam(7, 3, 3, size=(0.3, 0.1, 0.1))
    mesh = dv.mesh.join([half, half.translate((0.3, 0, 0))])
    at = np.flatnonzero(abs(mesh.points[:, 0] - 0.3) < 1e-9)
    ends = [dv.Embedding.of_vertices(at[(at >= half.num_vertices) == side]) for side in (False, True)]
    springs = dv.Springs(*ends, stiffness=stiffness)
    model = dv.Model(mesh, pinned=mesh.points[:, 0] < 1e-9, energies=(dv.StableNeoHookean(), springs))
    tip = model.rest_points[:, 0] > 0.599
    return "height of the tip", model, lambda x: x[:, tip, 1].mean(1), {"young": 1e5, "poisson": 0.3}, 0.01, 60, SWEEPS


def on_palm() -> Any:
    model, tip = finger_on_palm()
    inputs = {"young": 3e5, "poisson": 0.35}
    return "height of the tip", model, lambda x: tip.at(x)[:, 0, 1], inputs, 0.02, 20, (20, 60, 200)


def bending(stiffness: float) -> Any:
    """Tendons of one tension at rest."""
    model = finger((16, 4, 4), (0.1, 0.02, 0.02), 6, stiffness)
    tip = model.rest_points[:, 0] > 0.0999
    inputs = {"young": 1e5, "poisson": 0.4, "tendon_rest_length": 0.1 - 0.4 / stiffness, "gravity": STILL}
    return "height of the tip", model, lambda x: x[:, tip, 1].mean(1), inputs, 0.02, 10, SWEEPS


def inflated() -> Any:
    model = hollow_finger()
    tip, inputs = model.rest_points[:, 0] > 0.079, {"young": 3e4, "poisson": 0.4, "pressure": 1e4, "gravity": STILL}
    return "height of the tip", model, lambda x: x[:, tip, 1].mean(1), inputs, 0.01, 15, SWEEPS


SWEEPS = (10, 20, 40, 160)
JOINED: dict[str, Callable[[], Any]] = {
    "two beams, k of a vertex": lambda: swinging(5e3),
    "two beams, 10 k": lambda: swinging(5e4),
    "two beams, 100 k": lambda: swinging(5e5),
    "finger on a palm": on_palm,
    "tendon, 20 N/m": lambda: bending(20.0),
    "tendon, 200 N/m": lambda: bending(200.0),
    "tendon, 2 kN/m": lambda: bending(2e3),
    "gas at one atmosphere": inflated,
}


def tension_of(model: dv.Model, x: Tensor, **inputs: Any) -> float:
    tension = dv.coupling_forces(model, x, **inputs).tendons
    assert tension is not None
    return float(tension)


def row_of(name: str, cells: int, model: dv.Model, found: float, expected: float, done: Any, seconds: float) -> Row:
    return {"finger": name, "cells over height": cells, "vertices": model.num_vertices, "found": found,
            "theory": expected, "found over theory": found / expected, "iterations": done.iterations,
            "seconds": seconds}  # fmt: skip


THREADS = 1
GROUPS: dict[str, Callable[[Card], list[Row]]] = {
    "statics": lambda card: statics(card.quick),
    "sizes": lambda card: sizes(card.quick),
    "ring down": lambda card: ring_down(card.quick),
    "decay": lambda card: decay(card.quick),
    "muscles": lambda card: muscles(card.quick),
    "spheres": lambda card: spheres(card.quick),
    "fingers": lambda card: fingers(card.quick),
    "joints": lambda card: joints(card.quick),
}
TABLES = (
    Table("Rest states beside a dense Newton solver: largest difference over the largest displacement", "statics"),
    Table("A sagging beam beside Newton's method with a sparse direct solver, one thread", "sizes"),
    Table("Damping ratio recovered from a motion with 1 % of noise", "ring down"),
    Table("A damped mode beside the formula, two periods", "decay"),
    Table("Muscles: activation recovered from a motion", "muscles"),
    Table("Growth of a sphere under pressure", "spheres"),
    Table("Fingers bent by a tendon", "fingers"),
    Table("Joined bodies: motion by few sweeps beside K = 320", "joints"),
)
