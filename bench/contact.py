"""Contact under stress, what contact costs, and a search for crossings by violent scenes that a seed draws.

Crossings are counted by `dv.contact.intersections`, which knows nothing of distances and planes: signs of volumes, for
every edge of the surfaces and the triangles whose boxes it meets, at the start and after every n-th step ("check
every"). Energy is kinetic, elastic and of gravity (relative to the start), without barriers. A vertex is cut in a step
when pairs have held it up.

Cost: one step of h = 1/60 s of boxes in pairs, one above the other, of which some touch; on the CPU processor time of
one thread. What is kept for the backward is counted on the CPU.

Violent scenes: bodies of a mesh start at random turns, thrown at each other at up to 60 m/s, with vertices that move on
their own, on a floor, among colliders that move, with one to eight sweeps; every fifth batch in single precision, every
fourth with coarse corrections, every seventh with SDIRK2 and another with BDF2. Every step of every scene is looked at.
"""

from __future__ import annotations

import itertools
import math
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

import diffvbd as dv
from bench.measure import Card, kept_bytes, least
from bench.tables import Table, times
from diffvbd import mesh, reference

Array = NDArray[np.float64]
GRAVITY = -9.81  # [m/s^2], along y


@dataclass(frozen=True)
class Start:
    """Bodies, how they move, and what they move in."""

    mesh: dv.TetMesh
    velocity: Array  # [V, 3] [m/s]
    acceleration: Array = field(default_factory=lambda: np.array([0.0, GRAVITY, 0.0]))  # [3] or [V, 3] [m/s^2]
    walls: tuple[tuple[Array, float], ...] = ()  # normal and height [m] of each plane of a FloorBarrier
    colliders: tuple[Any, ...] = ()


@dataclass(frozen=True)
class Case:
    """One scene and how it is stepped. dhat is relative to the mean edge of the surfaces."""

    group: str
    name: str
    build: Callable[[], Start]
    steps: int
    time_step: float = 1 / 60  # [s]
    sweeps: int = 10
    detections: int = 2
    dhat: float = 0.05
    kappa: float = 1e4  # [N/m]
    modulus: float = 1e5  # [Pa], mu; lam is twice that
    damping: float = 0.0  # [N s/m]
    friction: float = 0.0
    check_every: int = 1
    capacity: int | None = None  # pairs; None: the barrier's own
    note: Callable[[Case, Start, list[Tensor]], str] | None = None  # of the states that were checked
    series: bool = False
    quick: bool = False


# --- bodies -----------------------------------------------------------------------------------------------------------


def turned(body: dv.TetMesh, rng: np.random.Generator) -> dv.TetMesh:
    """A body turned at random about its center, which comes to the origin."""
    q, r = np.linalg.qr(rng.standard_normal((3, 3)))
    q = q * np.sign(np.diag(r))
    q[0] *= np.sign(np.linalg.det(q))
    return dv.TetMesh((body.points - body.points.mean(0)) @ q.T, body.tets)


def moving(bodies: list[tuple[dv.TetMesh, tuple[float, float, float]]], **options: Any) -> Start:
    """Bodies, each at a velocity of its own [m/s]."""
    velocity = [np.tile(np.array(v, float), (body.num_vertices, 1)) for body, v in bodies]
    return Start(mesh.join([body for body, _ in bodies]), np.concatenate(velocity), **options)


def ground(height: float = 0.0) -> tuple[tuple[Array, float], ...]:
    return ((np.array([0.0, 1.0, 0.0]), height),)


# --- scenes -----------------------------------------------------------------------------------------------------------


def boxes_collide() -> Start:
    box = mesh.box(4, 0.2, split="kuhn")
    return moving([(box, (25, 0, 0)), (box.translate([0.25, 0.05, 0.03]), (-25, 0, 0))])


def blobs_collide() -> Start:
    blobs = [mesh.blob(5, seed, 0.12) for seed in (1, 2)]
    return moving([(blobs[0], (50, 0, 0)), (blobs[1].translate([0.4, 0.04, 0.02]), (0, 0, 0))])


def sheet_hits_capsule() -> Start:
    """A sheet flies into a bar that does not give way."""
    bar = dv.colliders.Capsule((0.2, -0.15, -0.1), (0.2, -0.15, 0.5), 0.05)
    return moving([(mesh.sheet(9, 9, (0.4, 0.4), 0.01), (0, -50, 0))], colliders=(bar,))


def blob_hits_wedge() -> Start:
    points = [[-0.3, -0.5, -0.3], [-0.3, -0.5, 0.3], [0, -0.2, 0], [0.3, -0.5, 0.3], [0.3, -0.5, -0.3]]
    wedge = dv.colliders.Obstacle(points, [[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2]])
    return moving([(mesh.blob(6, 4, 0.12), (0, -50, 0))], colliders=(wedge,))


def tower() -> Start:
    """Ten boxes, a millimetre apart and a little askew; flat ones, as a slender tower of so soft a material buckles."""
    rng, height = np.random.default_rng(0), 0.06
    box = mesh.box(2, (0.2, height, 0.2), split="kuhn")
    return moving([(box.translate([x, 1e-3 + k * (height + 1e-3), z]), (0, 0, 0))
                   for k, (x, z) in enumerate(rng.uniform(-0.005, 0.005, (10, 2)))], walls=ground())  # fmt: skip


def crowd(per_side: int, layers: int) -> Start:
    """Boxes, plates and blobs, thrown at up to 5 m/s into a box of five planes."""
    rng, pitch, bodies = np.random.default_rng(7), 0.15, []
    for i, j, k in itertools.product(range(per_side), range(layers), range(per_side)):
        kind, size = rng.integers(4), rng.uniform(0.04, 0.07)
        body = (mesh.box(2, size, split="kuhn") if kind < 2 else mesh.sheet(3, 3, (size, size), 0.2 * size) if kind == 2
                else mesh.blob(4, int(rng.integers(100)), 0.5 * size))  # fmt: skip
        place = pitch * np.array([i + 0.5, j + 0.5, k + 0.5])
        bodies.append((turned(body, rng).translate(place), tuple(rng.uniform(-5, 5, 3))))
    width = pitch * per_side
    sides = [(np.array(n, float), 0.0 if sum(n) > 0 else -width)
             for n in ((1, 0, 0), (-1, 0, 0), (0, 0, 1), (0, 0, -1))]  # fmt: skip
    return moving(bodies, walls=(*ground(), *sides))


def free_fall() -> Start:
    """Twenty-seven boxes, a millimetre apart, all at 10 m/s."""
    box = mesh.box(3, 0.1, split="kuhn")
    places = 0.101 * np.array(list(itertools.product(range(3), repeat=3)))
    return moving([(box.translate(place), (6, -8, 0)) for place in places])


def deviation_from_fall(case: Case, start: Start, states: list[Tensor]) -> str:
    """Against x0 + n h v + n (n + 1) / 2 h^2 g, what implicit Euler makes of a fall."""
    h, worst = case.time_step, 0.0
    for k, x in enumerate(states):
        n = k * case.check_every
        fall = start.mesh.points + n * h * start.velocity + n * (n + 1) / 2 * h * h * start.acceleration
        worst = max(worst, float(np.abs(x.numpy() - fall).max()))
    return f"at most {worst:.2g} m off the closed form"


def drop() -> Start:
    """A box and a blob dropped at 3 m/s onto a box on the ground: what the parameters are varied in."""
    box = mesh.box(3, 0.2, split="kuhn")
    return moving([(box.translate([0, 0.02, 0]), (0, 0, 0)),
                   (turned(box, np.random.default_rng(5)).translate([0.1, 0.45, 0.08]), (0, -3, 0)),
                   (mesh.blob(4, 3, 0.09).translate([0.25, 0.75, 0.1]), (0, -3, 0))], walls=ground())  # fmt: skip


def _cases() -> list[Case]:
    impacts = {"two boxes": boxes_collide, "two blobs": blobs_collide, "a sheet on a capsule": sheet_hits_capsule,
               "a blob on a wedge": blob_hits_wedge}  # fmt: skip
    quick = ("two boxes", "a sheet on a capsule")
    out = [Case("50 m/s", name, build, 30, quick=name in quick, series=name == "two boxes")
           for name, build in impacts.items()]  # fmt: skip
    out += [Case("50 m/s", f"two boxes, K = {k}, R = {r}", boxes_collide, 30, sweeps=k, detections=r)
            for k, r in ((1, 1), (100, 1), (10, 4))]  # fmt: skip
    out += [
        Case("tower", "10 boxes", tower, 1000, time_step=1 / 120, sweeps=100, modulus=2e5, damping=2.0, friction=0.5,
             check_every=5, series=True),
        # by so few sweeps it does not stand
        Case("tower", "10 boxes, far from converged", tower, 300, sweeps=20, modulus=2e5, damping=2.0, friction=0.5),
        Case("crowd", "100 bodies in a box of 5 planes", lambda: crowd(5, 4), 150, friction=0.3, check_every=2),
        Case("free fall", "27 boxes 1 mm apart at 10 m/s", free_fall, 60, dhat=4e-3, capacity=40_000,
              note=deviation_from_fall, quick=True),
    ]  # fmt: skip
    for dhat in (1e-4, 1e-3, 1e-2, 1e-1):
        out.append(Case("dhat", f"{dhat:g} of an edge", drop, 60, dhat=dhat))
    for kappa in 10.0 ** np.arange(9):
        out.append(Case("kappa", f"{kappa:g} N/m", drop, 60, kappa=float(kappa)))
    for h in (1e-4, 1e-3, 1 / 240, 1 / 120, 1 / 60, 1 / 30):
        out.append(Case("h", f"{h:.3g} s", drop, max(40, min(400, round(0.5 / h))), time_step=h,
                        check_every=2 if h < 1e-3 else 1))  # fmt: skip
    return out


CASES = _cases()


# --- one runner -------------------------------------------------------------------------------------------------------


def model_of(case: Case, start: Start, card: Card) -> dv.Model:
    surface = start.mesh.surface
    edges = start.mesh.points[surface] - start.mesh.points[surface[:, [1, 2, 0]]]
    dhat = case.dhat * float(np.linalg.norm(edges, axis=-1).mean())
    barrier = dv.PairBarrier(kappa=case.kappa, dhat=dhat, damping=case.damping, detections=case.detections,
                             capacity=case.capacity)  # fmt: skip
    energies: list[Any] = [dv.StableNeoHookean(), barrier]
    if start.walls:
        energies.append(dv.FloorBarrier([height for _, height in start.walls], [n.tolist() for n, _ in start.walls],
                                        kappa=case.kappa, dhat=dhat, damping=case.damping))  # fmt: skip
    if case.friction:
        energies.append(dv.Friction(case.friction))
    return dv.Model(start.mesh, energies=energies, colliders=start.colliders, device=card.device)


class Energy:
    """Kinetic and elastic energy and that of gravity [J], on the CPU."""

    def __init__(self, case: Case, start: Start) -> None:
        self.case, self.body = case, dv.Model(start.mesh)
        self.acceleration = torch.from_numpy(np.broadcast_to(start.acceleration, start.mesh.points.shape).copy())
        self.start = self.body.rest_points

    def __call__(self, x: Tensor, v: Tensor) -> float:
        mass, mu = self.body.mass[:, None], self.case.modulus
        elastic = reference.incremental_potential(self.body, x, x, mu, 2 * mu, 1.0)
        lift = -(mass * self.acceleration * (x - self.start)).sum()
        return float((0.5 * mass * v.square()).sum() + elastic + lift)


def check(case: Case, card: Card) -> dict[str, Any]:
    start = case.build()
    model = model_of(case, start, card)
    assert model.contact is not None
    energy = Energy(case, start)
    x, v = model.rest_points.clone(), torch.from_numpy(start.velocity).to(model.rest_points)
    acceleration = torch.from_numpy(start.acceleration).to(x)
    states, energies = [x.cpu()], [energy(x.cpu(), v.cpu())]
    crossings, nonfinite, error = len(dv.contact.intersections(model, x)), 0, None
    gap, cut, pairs, seconds, done = math.inf, [], 0, [], 0
    for done in range(1, case.steps + 1):
        card.sync()
        began = time.perf_counter()
        try:
            x, v = dv.step(model, x, v, mu=case.modulus, lam=2 * case.modulus, time_step=case.time_step,
                           sweeps=case.sweeps, gravity=acceleration)  # fmt: skip
        except (RuntimeError, ValueError) as failure:
            error = str(failure)[:200]
            break
        card.sync()
        seconds.append(time.perf_counter() - began)
        status = dv.contact.status(model)
        gap, pairs = min(gap, *status.smallest_gap), max(pairs, status.pairs)
        cut.append(sum(status.cut))
        nonfinite = int((~torch.isfinite(torch.cat([x, v]))).sum())
        if nonfinite:
            break
        if done % case.check_every == 0 or done == case.steps:
            states.append(x.cpu())
            energies.append(energy(states[-1], v.cpu()))
            crossings += len(dv.contact.intersections(model, states[-1]))
    return {
        "group": case.group, "name": case.name, "steps": case.steps, "done": done if error is None else done - 1,
        "time_step": case.time_step, "sweeps": case.sweeps, "detections": case.detections,
        "bodies": int(model.body.max()) + 1, "vertices": model.num_vertices, "check_every": case.check_every,
        "intersections": crossings, "nonfinite": nonfinite, "error": error, "dhat": model.contact.dhat,
        "smallest_gap_over_dhat": gap / model.contact.dhat, "cut_max": max(cut, default=0),
        "cut_mean": float(np.mean(cut)) if cut else 0.0, "pairs": pairs,
        "energy_start": energies[0], "energy_max": max(energies), "energy_end": energies[-1],
        "ms_per_step": 1e3 * float(np.median(seconds)) if seconds else None,
        "note": None if case.note is None else case.note(case, start, states),
        "series": energies if case.series else None,
    }  # fmt: skip


COST_DHAT = 2e-3  # [m]
CLOSE = 0.5 * COST_DHAT  # gap of bodies that touch [m]
FAR = 0.2  # [m], of those that do not: beyond any reach
SHORT = 2 * COST_DHAT  # [m], a reach that lists the fewest pairs
COST_SWEEPS, DETECTIONS, COST_STEP, MODULUS = 10, 2, 1 / 60, 1e5


def piles(count: int, n: int, close: int) -> dv.TetMesh:
    """`count` pairs of boxes of n^3 vertices and 0.1 m, one above the other; the first `close` pairs touch."""
    box, side = mesh.box(n, 0.1, split="kuhn"), int(np.ceil(np.sqrt(count)))
    offsets = []
    for k in range(count):
        place = np.array([(k % side) * (0.1 + FAR), 0.0, (k // side) * (0.1 + FAR)])
        # a shift along the face, lest edges lie on edges
        offsets += [place, place + [0.013, 0.1 + (CLOSE if k < close else FAR), 0.017]]
    return mesh.replicate(box, np.array(offsets))


def piled(tets: dv.TetMesh, card: Card, contact: bool, reach: float | None = None) -> dv.Model:
    barrier = (dv.PairBarrier(kappa=100.0, dhat=COST_DHAT, detections=DETECTIONS, reach=reach),) if contact else ()
    return dv.Model(tets, energies=(dv.StableNeoHookean(), *barrier), device=card.device)


def stepping(model: dv.Model, reverse: bool) -> Callable[[], Any]:
    """A step from rest, or one and the gradient toward its state; as gpu_measure times it."""
    x = model.rest_points.clone().requires_grad_(reverse)
    v = torch.zeros_like(x).requires_grad_(reverse)
    modulus = torch.full((), MODULUS, dtype=x.dtype, device=x.device)
    ones = torch.ones_like(x)

    def work() -> tuple[Tensor, ...]:
        end = dv.step(
            model, x, v, mu=modulus, lam=modulus, time_step=COST_STEP, sweeps=COST_SWEEPS, gravity=(0.0, 0.0, 0.0)
        )
        return torch.autograd.grad(end, (x, v), (ones, ones)) if reverse else end

    return work


def milliseconds(card: Card, work: Callable[[], Any]) -> float:
    """Median of replays of a CUDA graph; on the CPU the least of several calls, in processor time of one thread, which
    other programs on the machine do not stretch."""
    replayed = card.graph(work)
    if replayed is not None:
        return 1e3 * replayed

    def span() -> float:
        start = time.process_time()
        work()
        return time.process_time() - start

    return 1e3 * least(span, 3 if card.quick else 7)


def measured(card: Card, count: int, n: int, close: int, reach: float | None = None) -> dict[str, Any]:
    """Times of piles with contact and without."""
    tets = piles(count, n, close)
    row: dict[str, Any] = {"bodies": 2 * count, "vertices": tets.num_vertices, "reach": reach}
    for key, contact in (("without", False), ("with", True)):
        model = piled(tets, card, contact, reach)
        row[f"{key}_ms"] = milliseconds(card, stepping(model, False))
        row[f"{key}_reverse_ms"] = milliseconds(card, stepping(model, True))
        row[f"{key}_kept"] = kept_bytes(stepping(model.to("cpu"), True))
        if contact:
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
    places = [np.array([i, j, 0.0]) for j in range(2) for i in range(2)]
    chosen = [kinds[rng.integers(3)]() for _ in range(int(rng.integers(2, 5)))]
    return [
        turned(body, rng).translate(0.24 * place + [0, 0.15, 0]) for body, place in zip(chosen, places, strict=False)
    ]


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
    dtype, coarse = torch.float32 if seed % 5 == 2 else torch.float64, "auto" if seed % 4 == 3 else None
    model = dv.Model(tets, energies=energies, colliders=colliders, coarse=coarse, dtype=dtype, device=device)
    toward = rng.standard_normal((batch, tets.num_bodies, 1, 3))
    v = speed * toward / np.linalg.norm(toward, axis=-1, keepdims=True)
    v = v[:, tets.body, 0] + 0.2 * speed * rng.standard_normal((batch, tets.num_vertices, 3))
    x = model.rest_points.expand(batch, -1, -1).clone()
    return {"model": model, "x": x, "v": torch.from_numpy(v).to(x), "sweeps": int(rng.integers(1, 9)),
            "modulus": float(10 ** rng.uniform(3, 7)), "time_step": float(10 ** rng.uniform(-2.7, -1.3))}  # fmt: skip


def _crossings(seed: int, device: str, batch: int) -> tuple[int, int, int, float]:
    """Of all steps: crossings, numbers that are not finite, steps, and the mean share of cut vertices."""
    s = _drawn(seed, device, batch)
    model, x, v = s["model"], s["x"], s["v"]
    crossings = lost = 0
    cut, points = [], model.collider_points
    integrator, history = INTEGRATORS.get(seed % 7, dv.ImplicitEuler()), None
    for step in range(FUZZ_STEPS):
        given: dict[str, Any] = {}
        if len(points):  # it comes down on them
            before, points = points, points - points.new_tensor([0.0, 0.01 * (step % 3), 0.0])
            given = {"colliders": points, "colliders_before": before}
        try:
            x, v, *past = dv.step(model, x, v, mu=s["modulus"], lam=s["modulus"], time_step=s["time_step"],
                                  sweeps=s["sweeps"], integrator=integrator, history=history, **given)  # fmt: skip
            history = past[0] if past else None
        except ValueError as error:  # what is prescribed leaves bodies no way: said, not done
            if "leaves bodies a way" not in str(error):
                raise
            return crossings, lost, step, float(np.mean(cut or [0.0]))
        crossings += len(dv.contact.intersections(model, x))
        lost += int((~torch.isfinite(x)).sum() + (~torch.isfinite(v)).sum())
        cut.append(float(np.mean(dv.contact.status(model).cut)) / model.num_vertices)
    return crossings, lost, FUZZ_STEPS, float(np.mean(cut))


# --- groups -----------------------------------------------------------------------------------------------------------


def stress(card: Card) -> list[dict[str, Any]]:
    cases = [replace(case, steps=min(case.steps, 10)) for case in CASES if case.quick] if card.quick else CASES
    return [check(case, card) for case in cases]


def cost(card: Card) -> list[dict[str, Any]]:
    """Piles of which ever more touch, then a crowd that does, with the usual reach and with a short one."""
    count, n = (8, 3) if card.quick else (64, 4)
    rows = [measured(card, count, n, close) for close in sorted({0, count // 8, count // 4, count // 2, count})]
    count, n = (4, 4) if card.quick else (50, 10)
    return [*rows, *(measured(card, count, n, count, reach) for reach in (None, SHORT))]


def fuzz(card: Card) -> list[dict[str, Any]]:
    batch, out = 10 if card.quick else BATCH, []
    keys = ("scenes", "crossings", "nonfinite", "scene_steps", "cut")
    rows: dict[float, list[float]] = {speed: [0, 0, 0, 0, 0.0] for speed in SPEEDS}
    for seed in range(3 if card.quick else SCENES // BATCH):
        crossings, lost, steps, cut = _crossings(seed, str(card.device), batch)
        row = rows[SPEEDS[seed % len(SPEEDS)]]
        for k, more in enumerate((batch, crossings, lost, batch * steps, batch * cut)):
            row[k] += more
        print(f"{seed}: {crossings}, {lost}", file=sys.stderr, flush=True)
    for speed, row in rows.items():
        row[-1] /= max(row[0], 1)
        out.append({"speed": speed, **dict(zip(keys, row, strict=True))})
    return out


THREADS, ANYWHERE = 1, True  # most scenes are too small for two threads
GROUPS: dict[str, Callable[[Card], list[dict[str, Any]]]] = {"stress": stress, "cost": cost, "fuzz": fuzz}
TABLES = (
    Table("Stress", "stress",
          {"group": "group", "case": "name", "steps": "steps", "h [s]": "time_step", "K": "sweeps", "R": "detections",
           "bodies": "bodies", "vertices": "vertices", "check every": "check_every", "crossings": "intersections",
           "not finite": "nonfinite", "smallest gap / dhat": "smallest_gap_over_dhat", "cut, most": "cut_max",
           "cut, mean": "cut_mean", "pairs": "pairs", "energy [J], start": "energy_start", "most": "energy_max",
           "end": "energy_end", "ms per step": "ms_per_step", "note": "note", "error": "error"}),
    Table("Cost", "cost",
          {"bodies": "bodies", "vertices": "vertices", "reach [m]": "reach", "pairs": "pairs",
           "step without contact [ms]": "without_ms", "with [ms]": "with_ms",
           "forward + backward without [ms]": "without_reverse_ms", "with, both [ms]": "with_reverse_ms",
           "kept without [MB]": times("without_kept", 1e-6), "with, kept [MB]": times("with_kept", 1e-6)}),
    Table("Violent scenes, by speed", "fuzz"),
)  # fmt: skip
