"""Contact under stress, and what contact costs: crossings, gaps, cut motion and energy; step times.

Crossings are counted by `dv.contact.intersections`, which knows nothing of distances and planes: signs of volumes, for
every edge of the surfaces and the triangles whose boxes it meets, at the start and after every n-th step ("check
every"). Energy is kinetic, elastic and of gravity (relative to the start), without barriers. A vertex is cut in a step
when pairs have held it up.
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

import diffvbd as dv
from bench import contact_cost
from bench.common import markdown_table
from bench.gpu_measure import Card
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


def torus(radius: float, tube: float, spacing: float) -> dv.TetMesh:
    """Ring about the y axis."""

    def inside(p: Array) -> Array:
        return np.hypot(np.hypot(p[:, 0], p[:, 2]) - radius, p[:, 1]) - tube

    corner = np.array([radius + tube, tube, radius + tube])
    return mesh.fill(inside, -corner, corner, spacing)


# --- scenes -----------------------------------------------------------------------------------------------------------


def boxes_collide() -> Start:
    box = mesh.box(4, 0.2, split="kuhn")
    return moving([(box, (25, 0, 0)), (box.translate([0.25, 0.05, 0.03]), (-25, 0, 0))])


def blobs_collide() -> Start:
    blobs = [mesh.blob(5, seed, 0.12) for seed in (1, 2)]
    return moving([(blobs[0], (50, 0, 0)), (blobs[1].translate([0.4, 0.04, 0.02]), (0, 0, 0))])


def edge_hits_edge() -> Start:
    """Two bars that cross, and meet with edges alone."""
    bar, rng = mesh.box((7, 2, 2), (0.6, 0.04, 0.04), split="kuhn"), np.random.default_rng(1)
    other = dv.TetMesh(turned(bar, rng).points, bar.tets)
    low, high = other.points.min(0)[1], bar.points.max(0)[1]
    return moving([(bar.translate([-0.3, 0, -0.02]), (0, 25, 0)),
                   (other.translate([0, high - low + 0.05, 0]), (0, -25, 0))])  # fmt: skip


def box_hits_ground() -> Start:
    box = turned(mesh.box(4, 0.2, split="kuhn"), np.random.default_rng(3))
    return moving([(box.translate([0, 0.3, 0]), (10, -50, 0))], walls=ground())


def box_and_box_hit_ground() -> Start:
    box = mesh.box(3, 0.2, split="kuhn")
    return moving([(box.translate([0, 0.05, 0]), (0, -50, 0)), (box.translate([0.05, 0.3, 0.03]), (15, -50, 0))],
                  walls=ground())  # fmt: skip


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


def rings() -> Start:
    """Two interlocked rings, 0.1 m in radius, pulled apart with 10 times their weight."""
    ring = torus(0.1, 0.025, 0.025)
    other = dv.TetMesh(ring.points[:, [0, 2, 1]] * [1, -1, 1] + [0.1, 0, 0], ring.tets)
    pull = np.zeros((2 * ring.num_vertices, 3))
    pull[:, 0] = np.repeat([10 * GRAVITY, -10 * GRAVITY], ring.num_vertices)
    return replace(moving([(ring, (0, 0, 0)), (other, (0, 0, 0))]), acceleration=pull)


def linking(start: Start, x: Array) -> float:
    """Gauss's linking number of the rings' center lines; +-1 while they interlock, whatever their shape."""
    count, parts, fine = start.mesh.num_vertices // 2, 24, np.arange(20)[:, None] / 20
    angle = np.arctan2(start.mesh.points[:count, 2], start.mesh.points[:count, 0])
    sector = np.floor((angle / math.tau + 0.5) * parts).astype(int) % parts
    points, chords = [], []
    for ring in (x[:count], x[count:]):
        corner = np.stack([ring[sector == k].mean(0) for k in range(parts)])
        chord = np.roll(corner, -1, 0) - corner
        points.append((corner[:, None] + (fine + 0.025) * chord[:, None]).reshape(-1, 3))
        chords.append(np.repeat(chord / len(fine), len(fine), 0))
    r = points[0][:, None] - points[1]
    turn = (r * np.cross(chords[0][:, None], chords[1])).sum(-1) / np.linalg.norm(r, axis=-1) ** 3
    return float(turn.sum()) / (4 * math.pi)


def interlocked(case: Case, start: Start, states: list[Tensor]) -> str:
    count = start.mesh.num_vertices // 2
    apart = [float((x[count:].mean(0) - x[:count].mean(0)).norm()) for x in states]
    numbers = [abs(linking(start, x.numpy())) for x in states[::5]]
    return (f"centers {apart[0]:.3g} m apart at the start, {apart[-1]:.3g} m at the end; linking number "
            f"{min(numbers):.3f} to {max(numbers):.3f}")  # fmt: skip


def clapping_sheet() -> Start:
    """A sheet whose halves are swung against each other."""
    sheet = mesh.sheet(13, 5, (0.6, 0.2), 0.01)
    velocity = np.zeros((sheet.num_vertices, 3))
    velocity[:, 1] = 40 * np.abs(sheet.points[:, 0] - 0.3)
    return Start(sheet, velocity, np.zeros(3))


def falling_sheet() -> Start:
    """A sheet that falls on its short edge and folds up on the ground."""
    sheet = mesh.sheet(17, 4, (0.8, 0.15), 0.01)
    upright = sheet.points[:, [1, 0, 2]] * [-1, 1, 1] + [0, 0.02, 0]
    upright[:, 0] += 0.01 * np.sin(8 * upright[:, 1])
    return moving([(dv.TetMesh(upright, sheet.tets), (0, -2, 0))], walls=ground())


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
    impacts = {"two boxes": boxes_collide, "two blobs": blobs_collide, "two bars, edge on edge": edge_hits_edge,
               "a box on the ground": box_hits_ground, "two boxes on the ground": box_and_box_hit_ground,
               "a sheet on a capsule": sheet_hits_capsule, "a blob on a wedge": blob_hits_wedge}  # fmt: skip
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
        Case("rings", "pulled apart", rings, 200, time_step=1 / 240, sweeps=20, modulus=2e5, check_every=2,
             note=interlocked, series=True),
        Case("sheet", "halves swung together at 40 rad/s", clapping_sheet, 120, time_step=1 / 240, modulus=1e3,
             quick=True),
        Case("sheet", "folds up on the ground", falling_sheet, 120, modulus=2e4, friction=0.3),
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


def run(quick: bool, device: str = "cpu") -> dict[str, Any]:
    card = Card(torch.device(device), quick)
    cases = [replace(case, steps=min(case.steps, 10)) for case in CASES if case.quick] if quick else CASES
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # most scenes are too small for two
    try:
        return {"rows": [check(case, card) for case in cases], "cost": contact_cost.measure(card)}
    finally:
        torch.set_num_threads(threads)


def markdown(results: dict[str, Any]) -> str:
    rows = results["rows"]
    columns = ("group", "name", "steps", "time_step", "sweeps", "detections", "bodies", "vertices", "check_every",
               "intersections", "nonfinite", "smallest_gap_over_dhat", "cut_max", "cut_mean", "pairs", "energy_start",
               "energy_max", "energy_end", "ms_per_step")  # fmt: skip
    header = ("group", "case", "steps", "h [s]", "K", "R", "bodies", "vertices", "check every", "crossings",
              "not finite", "smallest gap / dhat", "cut, most", "cut, mean", "pairs", "energy [J], start", "most",
              "end", "ms per step")  # fmt: skip
    text = "## Stress\n\n" + markdown_table(header, ([row[k] for k in columns] for row in rows))
    remarks = [f"- {r['group']}, {r['name']}: {r['note']}." for r in rows if r["note"]]
    remarks += [f"- {r['group']}, {r['name']}: ended after {r['done']} steps, {r['error'] or 'not finite'}."
                for r in rows if r["done"] < r["steps"] or r["nonfinite"]]  # fmt: skip
    return text + "\n" + "\n".join(remarks) + "\n\n" + contact_cost.markdown(results["cost"])
