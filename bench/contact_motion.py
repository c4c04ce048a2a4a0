"""Motion beside contact, where the answer is known: closed forms, the same scene without contact, or converged steps.

Braking of a thin sheet and of a spin, sliding and its derivative, bodies at rest, stacks and impacts.
Each row has a value, its reference, a target and whether it is met. "cut" is the mean share of vertices that
pairs have held up; crossings are edges through triangles and vertices below a plane, counted at ten times of each
rollout; "not finite" are coordinates and velocities. Milliseconds are of a step without its backward, one thread.

Each function measures one quantity. Lengths in m, angles in rad, all bodies of 1000 kg/m^3.
"""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

import diffvbd as dv
from bench.measure import Card
from bench.tables import Table
from diffvbd import mesh
from diffvbd.colliders import Obstacle, Plane

Array = NDArray[np.float64]
Row = dict[str, Any]
GRAVITY = 9.81  # [m/s^2]
UP = (0.0, 1.0, 0.0)
LOOKS = 10  # how often crossings are counted in a rollout


@dataclass(frozen=True)
class Scene:
    """A Model, its state and how it is stepped; lam is twice mu."""

    model: dv.Model
    mu: float  # [Pa]
    time_step: float  # [s]
    sweeps: int
    x: Tensor | None = None  # [V, 3] [m]; None: at rest
    v: Tensor | None = None  # [V, 3] [m/s]; None: still
    gravity: Any = (0.0, -GRAVITY, 0.0)  # [3] or [V, 3] [m/s^2]
    floor: bool = False  # whether nothing may be below y = 0
    options: dict[str, Any] = field(default_factory=dict)  # of the solver

    def state(self) -> tuple[Tensor, Tensor]:
        x = self.model.rest_points if self.x is None else self.x
        return x, torch.zeros_like(x) if self.v is None else self.v

    def arguments(self, **more: Any) -> dict[str, Any]:
        """Those of a step or rollout beside Model and state."""
        solver = dv.VBD(self.time_step, self.sweeps, **self.options)
        return {"solver": solver, "mu": self.mu, "lam": 2 * self.mu, "gravity": self.gravity, **more}

    def wrong(self, x: Tensor) -> int:
        """Edges through triangles, and vertices below the floor."""
        found = 0 if self.model.contact is None else len(dv.contact.intersections(self.model, x))
        return found + int((x[:, 1] < 0).sum()) * self.floor


@dataclass
class Course:
    """What a rollout went through: states on the CPU, after every step or every few."""

    scene: Scene
    x: list[Tensor] = field(default_factory=list)
    v: list[Tensor] = field(default_factory=list)
    cut: list[float] = field(default_factory=list)  # share of the vertices, for each step
    seconds: list[float] = field(default_factory=list)
    crossings: int = 0
    nonfinite: int = 0
    error: str | None = None

    def mean(self, values: Tensor, rows: slice = slice(None)) -> Array:
        """Of a state's positions or velocities, over the mass of some vertices."""
        mass = self.scene.model.mass.cpu()[rows, None]
        return ((mass * values[rows]).sum(0) / mass.sum()).numpy()


@torch.no_grad()
def march(scene: Scene, steps: int, keep: int = 1, until: Callable[[Tensor], bool] | None = None) -> Course:
    """Steps one by one. keep: states are kept after every so many; until: of the velocity, ends it."""
    course, (x, v) = Course(scene), scene.state()
    course.x.append(x.cpu())
    course.v.append(v.cpu())
    course.crossings = scene.wrong(x)
    look = max(1, steps // LOOKS)
    for n in range(1, steps + 1):
        began = time.perf_counter()
        try:
            x, v = dv.step(scene.model, x, v, **scene.arguments())
        except (RuntimeError, ValueError) as failure:
            course.error = f"step {n}: {str(failure)[:160]}"
            break
        if x.is_cuda:
            torch.cuda.synchronize(x.device)
        course.seconds.append(time.perf_counter() - began)
        if scene.model.contact is not None:
            course.cut.append(sum(dv.contact.status(scene.model).truncated) / scene.model.num_vertices)
        course.nonfinite = int((~torch.isfinite(torch.cat([x, v]))).sum())
        if course.nonfinite:
            break
        if n % keep == 0:
            course.x.append(x.cpu())
            course.v.append(v.cpu())
        if n % look == 0 or n == steps:
            course.crossings += scene.wrong(x)
        if until is not None and until(v):
            break
    return course


@torch.no_grad()
def settled(scene: Scene) -> Scene:
    """The scene, come to rest without friction: long steps of many sweeps, each begun without velocity."""
    x, still = scene.state()[0], torch.zeros_like(scene.state()[0])
    free = {} if scene.model.friction is None else {"friction": 0.0}
    long = replace(scene, time_step=0.05, sweeps=100).arguments(**free)
    for _ in range(40):
        x, _ = dv.step(scene.model, x, still, **long)
    return replace(scene, x=x)


def row(course: Course, quantity: str, case: str, value: float, goal: float, target: str, met: bool | None,
        note: str = "") -> Row:  # fmt: skip
    """A row of the tables: a quantity, what it should be, and how the rollouts went that it was taken from.

    goal: the reference; met: None where there is no target. An unfinished rollout meets none.
    """
    value, scene = float(value), course.scene
    sound = not course.error and not course.nonfinite and math.isfinite(value)
    return {
        "quantity": quantity, "case": case, "sweeps": scene.sweeps, "time_step": scene.time_step,
        "vertices": scene.model.num_vertices, "value": value, "reference": goal, "target": target,
        "met": None if met is None else bool(met and sound),
        "cut": float(np.mean(course.cut)) if course.cut else None, "crossings": course.crossings,
        "nonfinite": course.nonfinite,
        "ms_per_step": 1e3 * float(np.median(course.seconds)) if course.seconds else None,
        "error": course.error, "note": note,
    }  # fmt: skip


SURFACES = ("FloorBarrier", "Plane", "Obstacle, large triangles", "Obstacle, small triangles")
BLOCK = (0.2, 0.1, 0.2)  # [m], 18 vertices
BOX = (0.2, 0.2, 0.2)  # [m]
MODULUS = 1e5  # [Pa], mu of all bodies here; lam is twice that
KAPPA, DHAT = 1e4, 0.01
ELASTIC = dv.StableNeoHookean()


def pairs(dhat: float = DHAT, **options: Any) -> dv.PairBarrier:
    return dv.PairBarrier(kappa=KAPPA, dhat=dhat, **options)


def relative(course: Course, quantity: str, case: str, value: float, goal: float, share: float, note: str = "") -> Row:
    """A row whose value has to be within a share of the reference."""
    met = abs(value - goal) <= share * abs(goal)
    return row(course, quantity, case, value, goal, f"within {100 * share:g} %", met, note)


# --- sheet and spin: neighbors that must not brake --------------------------------------------------------------------


def hanging(contact: bool, sweeps: int, device: str) -> Scene:
    body = mesh.sheet(9, 9, (0.4, 0.4), 0.005)
    energies = (ELASTIC, pairs(0.02)) if contact else (ELASTIC,)
    # "auto" beside pairs: without them it would be "inertia", where so few sweeps hardly move a thin sheet
    model = dv.Model(body, pinned=torch.from_numpy(body.points[:, 0] < 1e-9), energies=energies, device=device)
    return Scene(model, MODULUS, 1 / 60, sweeps, options={"start": "predictor"})


def sheet(sweeps: int = 20, device: str = "cpu") -> Row:
    """Height of the free edge of a sheet of 0.4 m x 0.4 m x 5 mm, pinned at one edge, 0.25 s after it was let go."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # tets this thin want more sweeps; both ways have the same
        ways = [march(hanging(on, sweeps, device), 15) for on in (False, True)]
    free, own = (float(way.x[-1][way.x[0][:, 0] > 0.4 - 1e-9, 1].mean()) for way in ways)
    return relative(ways[1], "tip y [m]", "self-contact", own, free, 0.03)


def spun(gap: float | None, device: str, rate: float = 20.0) -> Scene:
    """Two cubes of 0.2 m, the upper one spinning about y, without gravity; one alone and without contact if no gap."""
    box = mesh.box(3, 0.2, split="kuhn").translate((-0.1, 0, -0.1))
    body = box if gap is None else mesh.join([box, box.translate((0, -0.2 - gap, 0))])
    model = dv.Model(body, energies=(ELASTIC,) if gap is None else (ELASTIC, pairs()), device=device)
    x = model.rest_points
    v = torch.zeros_like(x)
    v[:27] = rate * torch.linalg.cross(torch.tensor(UP).to(x).expand(27, 3), x[:27])
    return Scene(model, MODULUS, 1 / 100, 20, v=v, gravity=(0.0, 0.0, 0.0), options={"subspace": None})


def spin(gap: float = 0.002, steps: int = 1, device: str = "cpu") -> Row:
    """Share of its angular momentum that a cube keeps at 20 rad/s beside another that rests."""

    def kept(course: Course) -> float:
        mass = course.scene.model.mass.cpu()[:27, None]
        both = [torch.linalg.cross(course.x[k][:27], mass * course.v[k][:27]).sum(0)[1] for k in (0, -1)]
        return float(both[1] / both[0])

    alone, course = (march(spun(g, device), steps) for g in (None, gap))
    value = kept(course)
    case = f"{1e3 * gap:g} mm from another body, {steps} steps"
    return row(course, "share of spin kept", case, value, kept(alone), ">= 0.97" if steps == 1 else "",
               value >= 0.97 if steps == 1 else None)  # fmt: skip


# --- sliding ----------------------------------------------------------------------------------------------------------


def flat(length: float, width: float, cells: int) -> Obstacle:
    """A flat surface through the origin from x = -1 on, in squares of two triangles."""
    rows = max(1, round(cells * width / length))
    x, z = np.linspace(-1, length - 1, cells + 1), np.linspace(-width / 2, width / 2, rows + 1)
    points = np.stack([*np.meshgrid(x, [0.0], z, indexing="ij")], -1).reshape(-1, 3)
    i, k = (a.ravel() for a in np.meshgrid(np.arange(cells), np.arange(rows), indexing="ij"))
    a = i * (rows + 1) + k
    b, c, d = a + 1, a + rows + 1, a + rows + 2
    return Obstacle(points, np.concatenate([np.stack([a, b, c], -1), np.stack([c, b, d], -1)]))


def block(surface: str, friction: float, sweeps: int, device: str, room: float = 24.0) -> Scene:
    """A block at rest on y = 0, a surface as long as `room` [m]."""
    under: dict[str, Callable[[], Any]] = {
        "Plane": lambda: Plane((0.0, 0.0, 0.0), UP),
        SURFACES[2]: lambda: flat(room, room, 1),
        SURFACES[3]: lambda: flat(room, 0.83, round(room / 0.2)),
    }
    if surface not in SURFACES:
        raise ValueError(f"surface: expected one of {', '.join(SURFACES)}, got {surface}")
    body = mesh.box((3, 2, 3), BLOCK, split="kuhn").translate((-0.1, 0.5 * DHAT, -0.1))
    barrier = pairs(self_contact=False) if surface in under else dv.FloorBarrier(0.0, UP, kappa=KAPPA, dhat=DHAT)
    model = dv.Model(body, energies=(ELASTIC, barrier, dv.Friction(friction)), device=device,
                     colliders=(under[surface](),) if surface in under else ())  # fmt: skip
    return settled(Scene(model, MODULUS, 1 / 60, sweeps, floor=True))


def thrown(scene: Scene, speed: float) -> Scene:
    v = torch.zeros_like(scene.state()[0])
    v[:, 0] = speed
    return replace(scene, v=v)


def slide(surface: str = "Plane", sweeps: int = 20, speed: float = 10.0, device: str = "cpu") -> Row:
    """How far a block slides until its center moves slower than 1 cm/s, at most in twice the time that is right.

    The reference is v^2 / (2 mu_f g) less the v h / 2 by which steps of backward Euler fall short of it.
    """
    friction = 0.5
    right = speed / (friction * GRAVITY)
    scene = block(surface, friction, sweeps, device, room=2 * speed * right + 4)
    h = scene.time_step
    course = march(thrown(scene, speed), round(2 * right / h), until=lambda v: float(v[:, 0].mean()) < 0.01)
    travel = (course.mean(course.x[-1]) - course.mean(course.x[0]))[0]
    return relative(course, "stopping distance [m]", surface, travel, 0.5 * speed * (right - h), 0.03,
                    f"moved for {h * (len(course.x) - 1):.3g} s, {right:.3g} s is right")  # fmt: skip


def slide_gradient(surface: str = "Plane", speed: float = 1.0, device: str = "cpu") -> list[Row]:
    """The derivative of the way that a block slides in 0.1 s, which is 0.1 s at each speed, and Newton's method.

    Newton starts at 0.7 times the speed and looks for the one that goes as far as Coulomb's law says of `speed`.
    """
    friction = 0.1
    scene = block(surface, friction, 20, device)
    steps, start = 6, scene.state()[0]

    def travel(v0: float) -> tuple[float, float]:
        leaf = torch.tensor(v0, dtype=start.dtype, device=start.device, requires_grad=True)
        v = leaf * torch.tensor([1.0, 0.0, 0.0]).to(start).expand_as(start)
        end = dv.rollout(scene.model, start, v, steps=steps, save="last", **scene.arguments())
        weight = scene.model.mass[:, None] / scene.model.mass.sum()
        way = (weight * (end.x[-1] - start)).sum(0)[0]
        (slope,) = torch.autograd.grad(way, leaf)
        return float(way.detach()), float(slope)

    course = march(thrown(scene, speed), steps)
    time = steps * scene.time_step
    # backward Euler's own sum, whose derivative is the time, too
    goal = speed * time - 0.5 * friction * GRAVITY * time * (time + scene.time_step)
    way, slope = travel(speed)
    guess, off, taken = 0.7 * speed, math.inf, 0
    while taken < 8:
        taken += 1
        at, change = travel(guess)
        off = at / goal - 1
        if abs(off) < 1e-3 or not math.isfinite(off) or change == 0:
            break
        guess -= (at - goal) / change
        if not math.isfinite(guess) or abs(guess) > 1e3:
            break
    case = f"{surface}, {speed:g} m/s"
    return [
        relative(course, "d travel / d v0 [s]", case, slope, time, 0.05, f"travel {way:.4g} m, {goal:.4g} m is right"),
        row(course, "Newton on v0, distance off / target", case, off, 0.0, "off by <= 0.001", abs(off) <= 1e-3,
            f"{taken} evaluations"),
    ]  # fmt: skip


# --- at rest ----------------------------------------------------------------------------------------------------------


def rest(support: str = "Plane", sweeps: int = 5, device: str = "cpu") -> Row:
    """Sideways speed of a block without friction, 0.4 s after it lay at rest.

    It lies on a Plane, on a wider "box" with a pinned bottom, or on a "pinned box" of which nothing moves. Dented
    surfaces are not level, nor are normals between edges: beside boxes the reference is the speed at K = 400.
    """
    supports = ("Plane", "pinned box", "box")
    if support not in supports:
        raise ValueError(f"support: expected one of {', '.join(supports)}, got {support}")
    body, pinned, colliders = mesh.box(3, BOX, split="kuhn").translate((0, 0.5 * DHAT, 0)), None, (Plane(),)
    size = body.num_vertices
    if support != "Plane":
        # askew, so that closest points are not at ties
        lower = mesh.box((4, 3, 4), (0.3, 0.2, 0.3), split="kuhn").translate((-0.053, -0.2, -0.047))
        body, colliders = mesh.join([body, lower]), ()
        pinned = torch.from_numpy(body.points[:, 1] < (1e-9 if support == "pinned box" else -0.2 + 1e-9))
    model = dv.Model(body, pinned=pinned, energies=(ELASTIC, pairs(self_contact=False)), colliders=colliders,
                     device=device)  # fmt: skip
    scene = settled(Scene(model, MODULUS, 1 / 100, sweeps))

    def speed(scene: Scene) -> tuple[float, Course]:
        course = march(scene, 40)
        return float(np.hypot(*course.mean(course.v[-1], slice(size))[[0, 2]])), course

    value, course = speed(scene)
    goal = 0.0 if support == "Plane" else speed(replace(scene, sweeps=400))[0]
    return row(course, "sideways speed [m/s]", f"on a {support}", value, goal, "off by <= 0.001",
               abs(value - goal) <= 1e-3)  # fmt: skip


def stack(count: int = 5, sweeps: int = 5, height: float = 0.2, seconds: float = 2.0, device: str = "cpu") -> Row:
    """Sway of boxes 0.2 m wide on each other, not quite in line: the largest distance that a box's center has moved
    sideways in 2 s.

    They stand if no box sways by half its width, and the top one keeps 0.9 of its height. A column of this
    material buckles under its weight from about 1.1 m on, so ten boxes have to be flat.
    """
    box, gap, rng = mesh.box(2, (BOX[0], height, BOX[2]), split="kuhn"), 0.3 * DHAT, np.random.default_rng(0)
    lifts = gap + np.arange(count) * (height + gap)
    body = mesh.join([box.translate((x, y, z)) for y, (x, z) in zip(lifts, rng.uniform(-0.005, 0.005, (count, 2)),
                      strict=True)])  # fmt: skip
    floor = dv.FloorBarrier(0.0, UP, kappa=KAPPA, dhat=DHAT)
    model = dv.Model(body, energies=(ELASTIC, pairs(self_contact=False), dv.Friction(0.5), floor), device=device)
    course = march(Scene(model, 2 * MODULUS, 1 / 100, sweeps, floor=True), round(100 * seconds), keep=5)
    centers = torch.stack([x.reshape(count, -1, 3).mean(1) for x in course.x])
    sway = float((centers - centers[0])[..., [0, 2]].norm(dim=-1).max())
    top = float(centers[-1, -1, 1] / centers[0, -1, 1])
    stands = sway < 0.5 * BOX[0] and top > 0.9
    return row(course, "sway [m]", f"{count} boxes of {height:g} m", sway, 0.0, "stands", stands,
               f"top at {top:.3f} of its height")  # fmt: skip


# --- impact -----------------------------------------------------------------------------------------------------------


def struck(count: int, gap: float, speed: float, time_step: float = 1 / 100, device: str = "cpu") -> Row:
    """The most momentum that a row of cubes of 0.1 m gains or loses in a step, of which the first is thrown at the
    others: over what it had."""
    cube = mesh.cube(2, size=0.1, split="kuhn")
    body = mesh.join([cube.translate((i * (0.1 + gap), 0.003 * i, 0.002 * i)) for i in range(count)])
    model = dv.Model(body, energies=(ELASTIC, pairs(1e-3)), device=device)
    v = torch.zeros_like(model.rest_points)
    v[: cube.num_vertices, 0] = speed
    scene = Scene(model, 2 * MODULUS, time_step, 10, v=v, gravity=(0.0, 0.0, 0.0))
    course = march(scene, max(10, round(count * gap / speed / time_step) + 10))
    momentum = [float(course.mean(v)[0]) for v in course.v]
    worst = max(abs(p - momentum[0]) for p in momentum) / momentum[0]
    case = f"{count} cubes, {1e3 * gap:g} mm apart, {speed:g} m/s"
    return row(course, "momentum lost", case, worst, 0.0, "<= 0.01", worst <= 0.01)


SPEEDS = (0.2, 1.0, 3.0, 10.0)  # [m/s]
STRUCK = (  # cubes in a row, gap [m], speed of the first [m/s], time step [s]
    *((4, gap, speed, 0.01) for gap in (0.001, 0.005, 0.01, 0.02) for speed in (0.3, 1.0, 3.0, 10.0)),
    *((10, gap, speed, 0.01) for gap in (0.002, 0.02) for speed in (0.3, 1.0, 3.0, 5.0)),
    (10, 0.002, 5.0, 0.0025), (10, 0.02, 5.0, 0.0025),
)  # fmt: skip


Made = list[Row | list[Row]]
GROUPED: dict[str, Callable[[bool, str], Made]] = {
    "sheet": lambda quick, device: [sheet(k, device=device) for k in ((10,) if quick else (10, 20))],
    "slide": lambda quick, device: [slide("Plane", speed=1.0, device=device)] if quick else [
        *(slide(surface, device=device) for surface in SURFACES),
    ],
    "spin": lambda quick, device: [spin(gap, steps, device=device)
                                   for gap, steps in ((0.002, 1), (0.002, 10), (0.01, 10))[: 1 if quick else 3]],
    "gradient": lambda quick, device: [slide_gradient(surface, speed, device=device) for surface in SURFACES[:2]
                                       for speed in (SPEEDS[1:2] if quick else SPEEDS)],
    "stacks": lambda quick, device: [stack(2, seconds=0.1, device=device)] if quick else [
        stack(count, k, height, device=device)
        for count, height, sweeps in ((5, 0.2, (5, 10, 20, 160)), (10, 0.06, (10, 20, 160))) for k in sweeps],
    "rest": lambda quick, device: [rest(support, k, device=device) for support in ("Plane", "pinned box", "box")
                                   for k in ((5,) if quick else (5, 20))],
    "struck": lambda quick, device: [struck(count, gap, speed, time_step, device=device)
                                     for count, gap, speed, time_step in STRUCK[: 1 if quick else None]],
}  # fmt: skip


def group(name: str) -> Callable[[Card], list[Row]]:
    def rows(card: Card) -> list[Row]:
        made = GROUPED[name](card.quick, str(card.device))
        return [row for one in made for row in (one if isinstance(one, list) else [one])]

    return rows


GROUPS = {name: group(name) for name in GROUPED}
THREADS, ANYWHERE = 1, True  # the scenes are too small for two threads
TABLES = (
    Table("Against known answers: {}", "*",
          {"quantity": "quantity", "case": "case", "K": "sweeps", "h [s]": "time_step", "value": "value",
           "reference": "reference", "target": "target", "met": "met", "cut": "cut", "crossings": "crossings",
           "not finite": "nonfinite", "vertices": "vertices", "ms per step": "ms_per_step", "error": "error",
           "note": "note"}),
)  # fmt: skip
