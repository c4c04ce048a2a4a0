"""What contact costs, and a search for crossings by violent scenes that a seed draws.

Cost: one step of h = 1/60 s of boxes in pairs, one above the other, of which some touch; on the CPU processor time of
one thread. What is kept for the backward is counted on the CPU.

Violent scenes: bodies of a mesh start at random turns, thrown at each other at up to 60 m/s, with vertices that move on
their own, on a floor, among colliders that move, with one to eight sweeps; every fifth batch in single precision, every
fourth with coarse corrections, every seventh with SDIRK2 and another with BDF2. `dv.contact.intersections`, which knows
nothing of distances and planes, looks at every step of every scene.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

import diffvbd as dv
from bench import measure
from bench.measure import Card, kept_bytes, least
from bench.tables import Table, times
from diffvbd import mesh


def turned(body: dv.TetMesh, rng: np.random.Generator) -> dv.TetMesh:
    """A body turned at random about its center, which comes to the origin."""
    q, r = np.linalg.qr(rng.standard_normal((3, 3)))
    q = q * np.sign(np.diag(r))
    q[0] *= np.sign(np.linalg.det(q))
    return dv.TetMesh((body.points - body.points.mean(0)) @ q.T, body.tets)


DHAT = 2e-3  # [m]
CLOSE = 0.5 * DHAT  # gap of bodies that touch [m]
FAR = 0.2  # [m], of those that do not: beyond any reach
SHORT = 2 * DHAT  # [m], a reach that lists the fewest pairs
SWEEPS, DETECTIONS, TIME_STEP, MODULUS = 10, 2, 1 / 60, 1e5


def piles(count: int, n: int, close: int) -> dv.TetMesh:
    """`count` pairs of boxes of n^3 vertices and 0.1 m, one above the other; the first `close` pairs touch."""
    box, side = mesh.box(n, 0.1, split="kuhn"), int(np.ceil(np.sqrt(count)))
    offsets = []
    for k in range(count):
        place = np.array([(k % side) * (0.1 + FAR), 0.0, (k // side) * (0.1 + FAR)])
        # a shift along the face, lest edges lie on edges
        offsets += [place, place + [0.013, 0.1 + (CLOSE if k < close else FAR), 0.017]]
    return mesh.replicate(box, np.array(offsets))


def stepping(model: dv.Model, reverse: bool) -> Callable[[], Any]:
    """A step from rest, or one and the gradient toward its state."""
    x = model.rest_points.clone().requires_grad_(reverse)
    v = torch.zeros_like(x).requires_grad_(reverse)
    modulus = torch.full((), MODULUS, dtype=x.dtype, device=x.device)
    ones = torch.ones_like(x)

    def work() -> tuple[Tensor, ...]:
        end = dv.step(model, x, v, dv.VBD(TIME_STEP, SWEEPS), mu=modulus, lam=modulus, gravity=(0.0, 0.0, 0.0))
        return torch.autograd.grad(end, (x, v), (ones, ones)) if reverse else end

    return work


def milliseconds(card: Card, work: Callable[[], Any]) -> float:
    """Median of replays of a CUDA graph; on the CPU the least of several calls, in processor time of one thread, which
    other programs on the machine do not stretch."""
    replayed = card.graph(work)
    if replayed is not None:
        return 1e3 * replayed

    return 1e3 * least(lambda: measure.timed(work, time.process_time), 3 if card.quick else 7)


def measured(card: Card, count: int, n: int, close: int, reach: float | None = None) -> dict[str, Any]:
    """Times of piles with contact and without."""
    tets = piles(count, n, close)
    row: dict[str, Any] = {"bodies": 2 * count, "vertices": tets.num_vertices, "reach": reach}
    barrier = dv.PairBarrier(kappa=100.0, dhat=DHAT, detections=DETECTIONS, reach=reach)
    for key, pairs in (("without", ()), ("with", (barrier,))):
        model = dv.Model(tets, energies=(dv.StableNeoHookean(), *pairs), device=card.device)
        row[f"{key}_ms"] = milliseconds(card, stepping(model, False))
        row[f"{key}_reverse_ms"] = milliseconds(card, stepping(model, True))
        row[f"{key}_kept"] = kept_bytes(stepping(model.to("cpu"), True))
        if pairs:
            stepping(model, False)()  # raises where a captured one would have returned NaN
            row["pairs"] = dv.contact.status(model).pairs
        card.tidy()
    return row


SCENES, BATCH, FUZZ_STEPS = 2000, 40, 6
SPEEDS = (2.0, 10.0, 60.0)  # [m/s]
FUZZ_DHAT = 2e-3  # [m]
INTEGRATORS = {1: dv.SDIRK2(), 4: dv.BDF2()}  # by seed modulo 7


def _bodies(rng: np.random.Generator) -> list[dv.TetMesh]:
    kinds = (
        lambda: mesh.box(int(rng.integers(2, 4)), 0.1, split="kuhn"),
        lambda: mesh.sheet(5, 5, (0.14, 0.14), float(rng.uniform(0.01, 0.03))),
        lambda: mesh.blob(4, int(rng.integers(100)), 0.06),
    )
    chosen = [kinds[rng.integers(3)]() for _ in range(int(rng.integers(2, 5)))]
    places = [0.24 * np.array([k % 2, k // 2, 0.0]) + [0, 0.15, 0] for k in range(len(chosen))]
    return [turned(body, rng).translate(place) for body, place in zip(chosen, places, strict=True)]


def _drawn(seed: int, device: str, batch: int) -> dict[str, Any]:
    """Scenes of one mesh."""
    rng = np.random.default_rng(seed)
    tets, speed = mesh.join(_bodies(rng)), SPEEDS[seed % len(SPEEDS)]
    energies: tuple[Any, ...] = (
        dv.StableNeoHookean(),
        dv.PairBarrier(kappa=float(10 ** rng.uniform(2, 5)), dhat=FUZZ_DHAT, damping=float(rng.choice([0.0, 5.0])),
                       detections=(None, 1, 2)[rng.integers(3)]),
    )  # fmt: skip
    energies += (dv.Friction(float(rng.uniform(0, 0.8))),) if rng.random() < 0.6 else ()
    energies += (dv.FloorBarrier(kappa=1e4, dhat=FUZZ_DHAT),) if rng.random() < 0.6 else ()
    ball = dv.colliders.Sphere(center=(0.1, 0.62, 0.0), radius=0.05)
    colliders = (ball,) if rng.random() < 0.5 else ()
    dtype, subspace = torch.float32 if seed % 5 == 2 else torch.float64, "coarse" if seed % 4 == 3 else "rigid"
    model = dv.Model(tets, energies=energies, colliders=colliders, dtype=dtype, device=device)
    toward = rng.standard_normal((batch, tets.num_bodies, 1, 3))
    v = speed * toward / np.linalg.norm(toward, axis=-1, keepdims=True)
    v = v[:, tets.body, 0] + 0.2 * speed * rng.standard_normal((batch, tets.num_vertices, 3))
    x = model.rest_points.expand(batch, -1, -1).clone()
    sweeps, modulus, h = int(rng.integers(1, 9)), float(10 ** rng.uniform(3, 7)), float(10 ** rng.uniform(-2.7, -1.3))
    solver = dv.VBD(h, sweeps, subspace=subspace, integrator=INTEGRATORS.get(seed % 7, dv.ImplicitEuler()))
    return {"model": model, "x": x, "v": torch.from_numpy(v).to(x), "modulus": modulus, "solver": solver}


def _crossings(seed: int, device: str, batch: int) -> tuple[int, int, int, float]:
    """Of all steps: crossings, numbers that are not finite, steps, and the mean share of cut vertices."""
    s = _drawn(seed, device, batch)
    model, x, v, solver = s["model"], s["x"], s["v"], s["solver"]
    crossings = lost = 0
    cut, points, history = [], model.collider_points, None
    for step in range(FUZZ_STEPS):
        given: dict[str, Any] = {}
        if len(points):  # it comes down on them
            before, points = points, points - points.new_tensor([0.0, 0.01 * (step % 3), 0.0])
            given = {"colliders": dv.per_step(points[None]), "colliders_before": before}
        try:
            with torch.no_grad():
                end = dv.rollout(model, x, v, solver, steps=1, mu=s["modulus"], lam=s["modulus"], history=history,
                                 checks=dv.Checks(start=step == 0), **given)  # fmt: skip
            x, v, history = end.x[-1], end.v[-1], end.history
        except ValueError as error:  # what is prescribed leaves bodies no way: said, not done
            if "expected feasible motion" not in str(error):
                raise
            return crossings, lost, step, float(np.mean(cut or [0.0]))
        crossings += len(dv.contact.intersections(model, x))
        lost += int((~torch.isfinite(x)).sum() + (~torch.isfinite(v)).sum())
        cut.append(float(np.mean(dv.contact.status(model).truncated)) / model.num_vertices)
    return crossings, lost, FUZZ_STEPS, float(np.mean(cut))


def cost(card: Card) -> list[dict[str, Any]]:
    """Piles of which ever more touch, then a crowd that does, with the usual reach and with a short one."""
    count, n = (8, 3) if card.quick else (64, 4)
    rows = [measured(card, count, n, close) for close in sorted({0, count // 8, count // 4, count // 2, count})]
    count, n = (4, 4) if card.quick else (50, 10)
    return [*rows, *(measured(card, count, n, count, reach) for reach in (None, SHORT))]


def fuzz(card: Card) -> list[dict[str, Any]]:
    batch = 10 if card.quick else BATCH
    keys = ("scenes", "crossings", "nonfinite", "scene_steps", "cut")
    rows = {speed: {"speed": speed, **dict.fromkeys(keys, 0)} for speed in SPEEDS}
    for seed in range(3 if card.quick else SCENES // BATCH):
        crossings, lost, steps, cut = _crossings(seed, str(card.device), batch)
        row = rows[SPEEDS[seed % len(SPEEDS)]]
        for key, more in zip(keys, (batch, crossings, lost, batch * steps, batch * cut), strict=True):
            row[key] += more
        print(f"{seed}: {crossings}, {lost}", file=sys.stderr, flush=True)
    return [row | {"cut": row["cut"] / max(row["scenes"], 1)} for row in rows.values()]


THREADS, ANYWHERE = 1, True  # most scenes are too small for two threads
GROUPS: dict[str, Callable[[Card], list[dict[str, Any]]]] = {"cost": cost, "fuzz": fuzz}
TABLES = (
    Table("Cost", "cost",
          {"bodies": "bodies", "vertices": "vertices", "reach [m]": "reach", "pairs": "pairs",
           "step without contact [ms]": "without_ms", "with [ms]": "with_ms",
           "forward + backward without [ms]": "without_reverse_ms", "with, both [ms]": "with_reverse_ms",
           "kept without [MB]": times("without_kept", 1e-6), "with, kept [MB]": times("with_kept", 1e-6)}),
    Table("Violent scenes, by speed", "fuzz"),
)  # fmt: skip
