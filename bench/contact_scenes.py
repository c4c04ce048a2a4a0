"""How the gates of contact run scenes and judge them, and the violent scenes that a seed draws."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack
from itertools import pairwise
from typing import Any, NamedTuple
from unittest import mock

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

import diffvbd as dv
from bench.contact import turned
from diffvbd import mesh, reference
from diffvbd.colliders import Plane
from diffvbd.reference.energies import smoothed

Array = NDArray[np.float64]
Row = dict[str, Any]
GRAVITY, NONE, UP = 9.81, (0.0, 0.0, 0.0), (0.0, 1.0, 0.0)  # [m/s^2]
KAPPA, DHAT = 1e4, 0.01
MODULUS = 1e5  # [Pa], mu of most bodies; lam is twice that
LOOKS = 10  # how often crossings are counted in a rollout
WAYS: dict[str, dict[str, Any]] = {"plain": {}, "coarse": {"subspace": "coarse"}}


class Course(NamedTuple):
    """What a rollout went through, on the CPU."""

    model: dv.Model
    time_step: float
    x: Tensor  # [steps + 1, V, 3]
    v: Tensor
    cut: float  # mean share of the vertices that contact stopped
    crossings: int  # edges through triangles, and vertices below a wall

    def mean(self, of: Tensor, rows: slice = slice(None)) -> Array:
        """Mean over the mass of some vertices: [..., V, 3] -> [..., 3]."""
        mass = self.model.mass.cpu()[rows, None]
        return ((mass * of[..., rows, :]).sum(-2) / mass.sum()).numpy()

    def moved(self, rows: slice = slice(None)) -> Array:
        return self.mean(self.x[-1] - self.x[0], rows)

    def gained(self, first: int, last: int) -> Array:
        """Mean acceleration of the center of mass between the ends of two steps [m/s^2]."""
        return self.mean(self.v[last] - self.v[first]) / ((last - first) * self.time_step)

    def forces(self, steps: int, read: Callable[[dv.contact.Forces], Tensor]) -> Array:
        """What is read from the forces of contact at the ends of the last steps, on average."""
        x, v = (t[-steps - 1 :].to(self.model.device) for t in (self.x, self.v))
        solver = dv.VBD(self.time_step, 1)
        found = (dv.contact.forces(self.model, x[k + 1], solver, previous=(x[k], v[k])) for k in range(steps))
        return np.mean([read(one).cpu().numpy() for one in found], 0)


def crossings(model: dv.Model, x: Tensor) -> int:
    """Edges through triangles, [B, V, 3]; of the same body only where it keeps itself apart."""
    found, surface = dv.contact.intersections(model, x), model.surface_of_contact
    assert surface is not None and model.contact is not None
    if model.contact.self_contact:
        return len(found)
    body = model.body.cpu()
    edge, triangle = (table.cpu()[found[:, k]][:, 0] for k, table in ((1, surface.edges), (2, surface.triangles)))
    return int((body[edge] != body[triangle]).sum())


@torch.no_grad()
def march(model: dv.Model, h: float, sweeps: int, steps: int, way: str = "plain", *, mu: float = MODULUS,
          x: Tensor | None = None, v: Tensor | None = None, gravity: Any = (0.0, -GRAVITY, 0.0),
          walls: Iterable[Sequence[float]] = (), options: dict[str, Any] | None = None, **inputs: Any
          ) -> Course:  # fmt: skip
    """A rollout. x, v: At its start; None: at rest. walls: Normals of planes that nothing may be below."""
    x = model.rest_points if x is None else x
    v, pushes = torch.zeros_like(x) if v is None else v, model.contact is not None
    stopped = {"observe": lambda *_: torch.tensor(sum(dv.contact.status(model).truncated) / len(x))} if pushes else {}
    end = dv.rollout(model, x, v, dv.VBD(h, sweeps, **(options or WAYS[way])), steps=steps, mu=mu, lam=2 * mu,
                     gravity=gravity, checks=dv.Checks(False, False, False), **stopped, **inputs)  # fmt: skip
    seen = end.x[:: max(1, steps // LOOKS)]
    wrong = crossings(model, seen) if pushes else 0
    wrong += sum(int((seen @ torch.tensor(normal).to(x) < 0).sum()) for normal in walls)
    return Course(model, h, end.x.cpu(), end.v.cpu(), float(end.observations.mean()) if pushes else 0.0, wrong)


def settled(model: dv.Model, steps: int = 40, sweeps: int = 100, mu: float = MODULUS, gravity: Any = None) -> Tensor:
    """Where the bodies of a Model rest without friction: long steps of many sweeps, each begun without velocity."""
    x, still = model.rest_points, torch.zeros_like(model.rest_points)
    free: dict[str, Any] = {} if model.friction is None else {"friction": 0.0}
    down = (0.0, -GRAVITY, 0.0) if gravity is None else gravity
    for _ in range(steps):
        x, _ = dv.step(model, x, still, dv.VBD(0.05, sweeps), mu=mu, lam=2 * mu, gravity=down, **free)
    return x


def row(gate: str, case: str, value: float | None, goal: float | None, bar: str, met: bool, note: str = "",
        course: Course | None = None) -> Row:  # fmt: skip
    """A row of the table. course: The rollout that the value was taken from."""
    said = [note] if note else []
    if course is not None:
        said += [f"{100 * course.cut:.2g} % of the vertices stopped"] * (course.cut > 1e-3)
        said += [f"{course.crossings} crossings"] * (course.crossings > 0)
        met = met and not course.crossings
    met = bool(met) and value is not None and math.isfinite(value)
    return {"gate": gate, "case": case, "value": None if value is None else float(value), "reference": goal, "bar": bar,
            "met": met, "note": "; ".join(said)}  # fmt: skip


def near(gate: str, case: str, value: float, goal: float, share: float, note: str = "",
         course: Course | None = None) -> Row:  # fmt: skip
    """A row whose value has to be within a share of the reference."""
    met = abs(value - goal) <= share * abs(goal)
    return row(gate, case, value, goal, f"within {100 * share:g} %", met, note, course)


def moving(model: dv.Model, speed: float, axis: int, rows: slice = slice(None)) -> Tensor:
    """Velocities of some vertices along an axis [V, 3]."""
    v = torch.zeros_like(model.rest_points)
    v[rows, axis] = speed
    return v


def pairs(**own: Any) -> dv.PairBarrier:
    return dv.PairBarrier(**{"kappa": KAPPA, "dhat": DHAT, "self_contact": False, **own})


def model_of(bodies: dv.TetMesh | Sequence[dv.TetMesh], *energies: Any, **options: Any) -> dv.Model:
    tets = bodies if isinstance(bodies, dv.TetMesh) else mesh.join(list(bodies))
    return dv.Model(tets, energies=(dv.StableNeoHookean(), *energies), **options)


# --- violent scenes: gradients, crossings, energy, descent ------------------------------------------------------------

SEED, FLIGHT = 2911, 6  # steps of a rollout


def drawn(number: int, device: str) -> tuple[dv.Model, Tensor, Tensor, dict[str, Any], dv.VBD]:
    """Two to four cubes, thrown at each other and at a floor or Plane that they nearly touch."""
    rng = np.random.default_rng((SEED, number))
    count, size, n = int(rng.integers(2, 5)), float(rng.uniform(0.1, 0.2)), int(rng.integers(2, 4))
    h, sweeps = 1 / float(np.exp(rng.uniform(np.log(60), np.log(500)))), int(rng.choice([2, 3, 5, 8, 12, 20]))
    speed, dhat = float(np.exp(rng.uniform(0, np.log(60)))), float(rng.choice([0.005, 0.01, 0.02]))
    wall, coarse = str(rng.choice(["none", "FloorBarrier", "Plane"])), rng.random() < 0.2
    normal = np.array([0.1, 1.0, 0.05]) if rng.random() < 0.5 else np.array(UP)
    normal /= np.linalg.norm(normal)
    bodies, top = [], 0.0
    for _ in range(count):
        body = turned(mesh.box(n, size, split="kuhn"), rng)
        points = body.points + rng.normal(size=body.points.shape) * 0.01 * size
        gap = dhat * 0.3 + speed * h * float(rng.uniform(0, 2))
        points += [rng.normal() * 0.2 * size, top + gap - points[:, 1].min(), rng.normal() * 0.2 * size]
        top = points[:, 1].max()
        bodies.append(dv.TetMesh(points, body.tets))
    tets = mesh.join(bodies)
    height = float((tets.points @ normal).min()) - dhat * 0.3 - speed * h * float(rng.uniform(0, 2))
    energies: list[Any] = [pairs(kappa=float(10 ** rng.uniform(3, 5)), dhat=dhat, self_contact=rng.random() < 1 / 3)]
    colliders = (Plane(tuple(height * normal), tuple(normal)),) if wall == "Plane" else ()
    if wall == "FloorBarrier":
        energies.append(dv.FloorBarrier(height, tuple(normal), kappa=KAPPA, dhat=dhat))
    if rng.random() < 0.5:
        energies.append(dv.Friction(float(rng.uniform(0.1, 0.8)), 0.01))
    model = model_of(tets, *energies, colliders=colliders, device=device)
    v = np.zeros_like(tets.points)
    for k in range(count):
        own = tets.body == k
        arm, axis = tets.points[own] - tets.points[own].mean(0), rng.normal(size=3)
        spin = axis / np.linalg.norm(axis) * float(rng.uniform(0, 40))
        # the upper ones come down, on others or on the wall
        down = speed * ((0.5 if wall == "none" else -0.3) - k / (count - 1))
        v[own] = np.cross(spin, arm) + np.array([0, down, 0]) + 0.1 * speed * rng.normal(size=3)
    modulus, x = float(10 ** rng.uniform(4, 6)), model.rest_points
    solver = dv.VBD(h, sweeps, **WAYS["coarse" if coarse else "plain"])
    return model, x, torch.from_numpy(v).to(x), {"mu": modulus, "lam": 2 * modulus}, solver


Found = dict[str, Any]  # of some scenes: "ends", by number what came out, and "raised", the errors of others


def over(numbers: Sequence[int], work: Callable[..., Any], device: str, **given: Any) -> Found:
    """What a function finds of some scenes."""
    ends, raised = {}, []
    for number in numbers:
        try:
            ends[number] = work(number, device=device, **given)
        except Exception as failure:
            raised.append(f"scene {number}: {type(failure).__name__}: {str(failure)[:100]}")
    return {"ends": ends, "raised": raised}


SIZES = (1e-5, 1e-6, 1e-7, 1e-8)  # of central differences
SMOOTH, ALIKE = 3e-3, 2e-6  # how far those of both sides, and of one size after another, may differ at a smooth point
EXACT = 1e-5  # the bar of a gradient


def slope_error(number: int, steps: int, device: str) -> float | None:
    """Relative error of the derivative along a random direction of (x, v, mu); None: at a kink."""
    model, x, v, material, solver = drawn(number, device)
    rng = np.random.default_rng((SEED, number, steps))
    w, d = (torch.from_numpy(rng.normal(size=(2, *x.shape))).to(x) for _ in range(2))
    d = d * torch.tensor([0.1, 10.0]).to(x)[:, None, None]  # [m], [m/s]
    grow = float(rng.normal()) * material["mu"]

    def loss(x: Tensor, v: Tensor, mu: Any) -> Tensor:
        for _ in range(steps):
            x, v = dv.step(model, x, v, solver, mu=mu, lam=material["lam"], gravity=(0.1, -GRAVITY, 0.2))
        return (w[0] * x).sum() + 0.01 * (w[1] * v).sum()

    leaves = [t.clone().requires_grad_() for t in (x, v, torch.tensor([material["mu"]]).to(x))]
    here = loss(*leaves)
    grads, found = torch.autograd.grad(here, leaves), []
    parts = [float((grads[0] * d[0]).sum()), float((grads[1] * d[1]).sum()), float(grads[2]) * grow]
    size = max(map(abs, parts))  # where these cancel, differences have fewer digits
    with torch.no_grad():
        for e in SIZES:
            ahead, back = (float(loss(x + q * d[0], v + q * d[1], material["mu"] + q * grow)) for q in (e, -e))
            bend = abs(ahead - 2 * float(here) + back) / e
            found.append((ahead - back) / (2 * e) if bend <= SMOOTH * size else math.nan)
    errors = [min(abs(a - sum(parts)), abs(b - sum(parts))) / size for a, b in pairwise(found)
              if abs(a - b) <= ALIKE * size]  # fmt: skip
    return min(errors, default=None)


def pair_energy(model: dv.Model, x: Tensor) -> Tensor:
    """Energy of the barriers of pairs [B] [J]. x: [B, V, 3] [m]."""
    from diffvbd._contact.pair_forces import corner_points, near_pairs
    from diffvbd.reference.distance import log_barrier

    barrier, surface = model.contact, model.surface_of_contact
    assert barrier is not None and surface is not None
    colliders = model.collider_points.expand(len(x), -1, 3)
    found = near_pairs(x, None, colliders, colliders, surface, barrier)
    gap, _, weight, _ = found.measures(corner_points(x, None, colliders))
    value = weight * log_barrier(gap, torch.full_like(gap, barrier.kappa), found.dhat)[0]
    return torch.zeros_like(x[:, 0, 0]).index_add(0, found.scene, value)


def flown(number: int, device: str) -> tuple[int, int, float, bool]:
    """Of a rollout without gravity: crossings, numbers that are not finite, largest energy over that at the start, and
    whether it warned."""
    model, x, v, material, solver = drawn(number, device)
    with warnings.catch_warnings(record=True) as said, torch.no_grad():
        warnings.simplefilter("always")
        end = dv.rollout(model, x, v, solver, steps=FLIGHT, gravity=NONE, checks=dv.Checks(energy=True), **material)
    model, x, v = model.to("cpu"), end.x.cpu(), end.v.cpu()
    lost = int((~torch.isfinite(torch.cat([x, v]))).sum())
    if lost:
        return 0, lost, math.inf, bool(said)
    crossed, outer = crossings(model, x), torch.from_numpy(np.unique(model.mesh.surface))
    for a, b, c in model.collider_points.reshape(-1, 3, 3):
        crossed += int(((x[:, outer] - a) @ torch.linalg.cross(b - a, c - a) < 0).sum())
    floor = [energy for energy in model.energies if isinstance(energy, dv.FloorBarrier)]
    body = model_of(model.mesh, *floor)
    own = reference.incremental_potential(body, x, x, **material, time_step=1.0)
    crossed += int(torch.isinf(own).sum())  # below a floor
    energy = own + pair_energy(model, x) + 0.5 * (model.mass[:, None] * v**2).sum((-1, -2))
    return crossed, lost, float(energy.max() / energy[0]), bool(said)


PARTS = ("start", "first rigid correction", "sweeps", "coarse correction", "corrections after the sweeps", "whole step")


def friction_energy(of: Any, x: Tensor) -> float:
    """Potential of lagged friction and damping in a step of diffvbd.step.contact, times h^2. x: [B, V, 3] [m]."""
    numbers, total = of.prepared.settings.numbers, 0.0
    h, reach = numbers.time_step, numbers.friction_eps
    if len(of.lagged.pairs):
        load, rate, n, w = of.lag.split((1, 1, 3, 4), -1)
        moved = torch.cat([x - of.x_prev, torch.zeros_like(of.before)], 1)  # colliders rest
        rows = of.lagged.pairs.long()
        moved = (w[..., None] * moved[rows[:, 5:], rows[:, :4]]).sum(1)
        along = (n * moved).sum(-1, keepdim=True)
        total += float((h * h * load[:, 0] * smoothed((moved - along * n).T, reach)[0]).sum())
        total += float((0.5 * h * rate * along.clamp(max=0) ** 2).sum())
    if of.floor_lag.numel():
        load, n = of.floor_lag[..., 0], of.floor_lag[..., 1:]
        travel = (x - of.x_prev)[:, :, None]
        slip = travel - n * (n * travel).sum(-1, keepdim=True)
        total += float((h * h * load * smoothed(slip.mT, reach)[0]).sum())
    return total


class Pass(NamedTuple):
    """A run of a step; one whose lists were too short is run again, with another ``of``."""

    of: Any  # a diffvbd.step.contact.ContactStep
    moves: list[tuple[str, Tensor, Tensor]]  # part, state before it and after it


def passes(number: int, device: str) -> Iterator[Pass]:
    """Four steps of a scene. It looks between the parts of diffvbd.step.contact."""
    from diffvbd.step import contact

    model, x, v, material, solver = drawn(number, device)
    step, runs = contact.ContactStep, list[Pass]()
    detect, start, corrected = step.detect, contact.start_substep, contact.corrected

    def note(part: str, x: Tensor, to: Tensor) -> None:
        runs[-1].moves.append((part, x.detach(), to.detach()))

    def watched(owner: Any, name: str, part: str) -> Any:
        work = getattr(owner, name)

        def wrapped(*given: Any, **more: Any) -> Any:
            end = work(*given, **more)
            note(part, given[1], end[0])
            return end

        return mock.patch.object(owner, name, wrapped)

    def detected(of: Any, *given: Any) -> Any:
        if not runs or runs[-1].of is not of:
            runs.append(Pass(of, []))
        return detect(of, *given)

    def started(x: Tensor, *given: Any) -> Any:
        end = start(x, *given)
        note(PARTS[0], x, end.x)
        return end

    def moved(of: Any, x: Tensor, *given: Any) -> Any:
        end = corrected(of, x, *given)
        latest = next(part for part, *_ in reversed(runs[-1].moves) if part in (PARTS[0], PARTS[2]))
        note(PARTS[4 if latest == PARTS[2] else 1], x, end.x)
        return end

    with ExitStack() as patches, torch.no_grad():
        for patch in (mock.patch.object(step, "detect", detected),
                      mock.patch.object(contact, "start_substep", started),
                      mock.patch.object(contact, "corrected", moved),
                      watched(step, "_sweep", PARTS[2]),
                      watched(contact.Corrections, "correct", PARTS[3])):  # fmt: skip
            patches.enter_context(patch)
        for _ in range(4):
            x, v = dv.step(model, x, v, solver, gravity=(0.0, -GRAVITY, 0.0), **material)
            yield runs[-1]


def risen(number: int, device: str) -> dict[str, float]:
    """By part of a step the largest rise of the scene's potential over its value at the start of the step, in four
    steps."""
    model, _, _, material, solver = drawn(number, "cpu")
    floor = [energy for energy in model.energies if isinstance(energy, dv.FloorBarrier)]
    body, worst, h = model_of(model.mesh, *floor), dict[str, float](), solver.time_step
    for of, moves in passes(number, device):
        y = of.begun.y.cpu()

        def potential(x: Tensor, of: Any = of, y: Tensor = y) -> float:
            own = reference.incremental_potential(body, x.cpu(), y, **material, time_step=h).sum()
            return float(own + h * h * pair_energy(model, x.cpu()).sum()) + friction_energy(of, x)

        size = potential(moves[0][1])
        for part, x, to in [*moves, (PARTS[5], moves[0][1], moves[-1][2])]:
            worst[part] = max(worst.get(part, -math.inf), (potential(to) - potential(x)) / size)
    return worst


def scenes(numbers: Iterable[int]) -> str:
    return ", ".join(["scenes", *map(str, list(numbers)[:8])]) if numbers else ""


def gradient_rows(ends: dict[int, float | None], raised: list[str], steps: int) -> list[Row]:
    smooth = {n: error for n, error in ends.items() if error is not None}
    wrong = sorted((n for n, error in smooth.items() if not error <= EXACT), key=lambda n: -smooth[n])
    fine, case = not raised and len(smooth) > len(ends) / 2, f"{len(ends) + len(raised)} scenes, steps: {steps}"
    note = "; ".join(filter(None, [f"{len(ends) - len(smooth)} at kinks", scenes(wrong), *raised[:1]]))
    worst = max(smooth.values(), default=math.inf)
    return [row("gradient", f"worst error of {case}", worst, 0.0, f"<= {EXACT:g}", worst <= EXACT and fine, note),
            row("gradient", f"wrong ones of {case}", len(wrong), 0, "0", not wrong and fine)]  # fmt: skip


def flight_rows(ends: dict[int, tuple], raised: list[str]) -> list[Row]:
    case, out = f"{len(ends) + len(raised)} scenes", []
    for at, what in enumerate(("crossings", "not finite")):
        where = [n for n, end in ends.items() if end[at]]
        note = "; ".join(filter(None, [f"{len(raised)} raised", *raised[:1], scenes(where)]))
        out.append(row("violent", f"{what}, {case}", sum(end[at] for end in ends.values()), 0, "0",
                       not where and not raised, note))  # fmt: skip
    gained = {n: end[2] for n, end in ends.items() if not end[2] <= 1.05}
    silent = sorted((n for n in gained if not ends[n][3]), key=lambda n: -gained[n])
    note = f"{len(gained) - len(silent)} more warn; " + ", ".join(f"scene {n}: {gained[n]:.3g}" for n in silent[:6])
    return [*out, row("violent", f"energy over 1.05 of that at the start without a warning, {case}", len(silent), 0,
                      "0", not silent and not raised, note)]  # fmt: skip


RISE = 1e-12


def descent_rows(ends: dict[int, dict[str, float]], raised: list[str]) -> list[Row]:
    out, note = [], "; ".join(raised[:1])
    for part in PARTS:
        rise = {n: end[part] for n, end in ends.items() if part in end}
        above = sorted((n for n in rise if not rise[n] <= RISE), key=lambda n: -rise[n])
        worst = max(rise.values(), default=math.nan)
        said = "; ".join(filter(None, [f"{len(above)} rise", scenes(above), note]))
        out.append(row("descent", f"{part}, {len(rise)} scenes", worst, 0.0, f"<= {RISE:g}", not above and not raised,
                       said))  # fmt: skip
    return out
