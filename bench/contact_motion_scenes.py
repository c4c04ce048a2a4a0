"""Scenes of `bench.contact_motion`: motion beside contact, with the answer known.

Each function measures one quantity and returns a row (or several) with the reference beside it. `barrier` are arguments
of PairBarrier that replace the scene's own, as {"detections": 10}; where none is given the scenes name kappa and dhat
and leave the rest at its default. Lengths in m, angles in rad, all bodies of 1000 kg/m^3 unless said otherwise.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import replace
from typing import Any

import numpy as np
import torch

import diffvbd as dv
from bench.contact_motion_run import (
    GRAVITY,
    UP,
    Array,
    Course,
    Row,
    Scene,
    march,
    row,
    settled,
    within,
)
from diffvbd import mesh
from diffvbd.colliders import Obstacle, Plane

Options = dict[str, Any] | None
SURFACES = ("FloorBarrier", "Plane", "Obstacle, large triangles", "Obstacle, small triangles")
BLOCK = (0.2, 0.1, 0.2)  # [m], 18 vertices
MODULUS = 1e5  # [Pa], mu of all bodies here; lam is twice that
KAPPA, DHAT = 1e4, 0.01


def pairs(barrier: Options = None, **own: Any) -> dv.PairBarrier:
    arguments: dict[str, Any] = {"kappa": KAPPA, "dhat": DHAT, **own, **(barrier or {})}
    return dv.PairBarrier(**arguments)


def relative(course: Course, quantity: str, case: str, value: float, goal: float, share: float, note: str = "") -> Row:
    """A row whose value has to be within a share of the reference."""
    return row(course, quantity, case, value, goal, f"within {100 * share:g} %", within(value, goal, share), note)


# --- sheet and spin: neighbors that must not brake --------------------------------------------------------------------


def hanging(contact: bool, sweeps: int, time_step: float, device: str, barrier: Options) -> Scene:
    body = mesh.sheet(9, 9, (0.4, 0.4), 0.005)
    energies = (dv.StableNeoHookean(), pairs(barrier, dhat=0.02)) if contact else (dv.StableNeoHookean(),)
    # "auto" beside pairs: without them it would be "inertia", where so few sweeps hardly move a thin sheet
    model = dv.Model(body, pinned=torch.from_numpy(body.points[:, 0] < 1e-9), energies=energies, start="predictor",
                     device=device)  # fmt: skip
    return Scene(model, MODULUS, time_step, sweeps)


def sheet(sweeps: int = 20, time_step: float = 1 / 60, device: str = "cpu", barrier: Options = None) -> Row:
    """Height of the free edge of a sheet of 0.4 m x 0.4 m x 5 mm, pinned at one edge, 0.25 s after it was let go."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # tets this thin want more sweeps; both ways have the same
        ways = [march(hanging(on, sweeps, time_step, device, barrier), round(0.25 / time_step)) for on in (False, True)]
    free, own = (float(way.x[-1][way.x[0][:, 0] > 0.4 - 1e-9, 1].mean()) for way in ways)
    return relative(ways[1], "tip y [m]", "self-contact", own, free, 0.03)


def spun(gap: float | None, sweeps: int, time_step: float, device: str, barrier: Options, rate: float = 20.0) -> Scene:
    """Two cubes of 0.2 m, the upper one spinning about y, without gravity; one alone and without contact if no gap."""
    box = mesh.box(3, 0.2, split="kuhn").translate((-0.1, 0, -0.1))
    body = box if gap is None else mesh.join([box, box.translate((0, -0.2 - gap, 0))])
    energies = (dv.StableNeoHookean(),) if gap is None else (dv.StableNeoHookean(), pairs(barrier))
    model = dv.Model(body, energies=energies, device=device, rigid=False)
    x = model.rest_points
    v = torch.zeros_like(x)
    v[:27] = rate * torch.linalg.cross(torch.tensor(UP).to(x).expand(27, 3), x[:27])
    return Scene(model, MODULUS, time_step, sweeps, v=v, gravity=(0.0, 0.0, 0.0))


def spin(gap: float = 0.002, steps: int = 1, sweeps: int = 20, time_step: float = 1 / 100, device: str = "cpu",
         barrier: Options = None) -> Row:  # fmt: skip
    """Share of its angular momentum that a cube keeps at 20 rad/s beside another that rests."""

    def kept(course: Course) -> float:
        mass = course.scene.model.mass.cpu()[:27, None]
        both = [torch.linalg.cross(x[:27], mass * v[:27]).sum(0)[1] for x, v in ((course.x[k], course.v[k])
                for k in (0, -1))]  # fmt: skip
        return float(both[1] / both[0])

    alone = march(spun(None, sweeps, time_step, device, None), steps)
    course = march(spun(gap, sweeps, time_step, device, barrier), steps)
    value = kept(course)
    case = f"{1e3 * gap:g} mm from another body, {steps} steps"
    return row(course, "share of spin kept", case, value, kept(alone), ">= 0.97" if steps == 1 else "",
               value >= 0.97 if steps == 1 else None)  # fmt: skip


# --- sliding ----------------------------------------------------------------------------------------------------------


def flat(length: float, width: float, cells: int, turn: Array) -> Obstacle:
    """A flat surface through the origin from x = -1 on, in squares of two triangles, then turned."""
    rows = max(1, round(cells * width / length))
    x, z = np.linspace(-1, length - 1, cells + 1), np.linspace(-width / 2, width / 2, rows + 1)
    points = np.stack([*np.meshgrid(x, [0.0], z, indexing="ij")], -1).reshape(-1, 3)
    i, k = (a.ravel() for a in np.meshgrid(np.arange(cells), np.arange(rows), indexing="ij"))
    a = i * (rows + 1) + k
    b, c, d = a + 1, a + rows + 1, a + rows + 2
    return Obstacle(points @ turn.T, np.concatenate([np.stack([a, b, c], -1), np.stack([c, b, d], -1)]))


def block(surface: str, friction: float, sweeps: int, time_step: float, device: str, barrier: Options, *,
          angle: float = 0.0, room: float = 24.0) -> Scene:  # fmt: skip
    """A block at rest on a surface through the origin that rises toward -x by an angle [rad]."""
    turn = np.array([[math.cos(angle), math.sin(angle), 0], [-math.sin(angle), math.cos(angle), 0], [0, 0, 1]])
    normal = tuple(float(n) for n in turn[:, 1])
    body = mesh.box((3, 2, 3), BLOCK, split="kuhn").translate((-0.1, 0.5 * DHAT, -0.1))
    body = dv.TetMesh(body.points @ turn.T, body.tets)
    rubbing = (dv.Friction(friction),) if friction else ()
    if surface == "FloorBarrier":
        model = dv.Model(body, energies=(dv.StableNeoHookean(), dv.FloorBarrier(0.0, normal, kappa=KAPPA, dhat=DHAT),
                                         *rubbing), device=device)  # fmt: skip
    else:
        if surface == "Plane":
            under = Plane((0.0, 0.0, 0.0), normal)
        elif surface in SURFACES:
            large = surface == SURFACES[2]
            under = flat(room, room if large else 0.83, 1 if large else round(room / 0.2), turn)
        else:
            raise ValueError(f"surface: expected one of {', '.join(SURFACES)}, got {surface}")
        model = dv.Model(body, energies=(dv.StableNeoHookean(), pairs(barrier, self_contact=False), *rubbing),
                         colliders=(under,), device=device)  # fmt: skip
    scene = Scene(model, MODULUS, time_step, sweeps, walls=((normal, 0.0),))
    return settled(scene, gravity=[-GRAVITY * math.cos(angle) * n for n in normal])


def thrown(scene: Scene, speed: float) -> Scene:
    v = torch.zeros_like(scene.state()[0])
    v[:, 0] = speed
    return replace(scene, v=v)


def slide(surface: str = "Plane", sweeps: int = 20, speed: float = 10.0, friction: float = 0.5,
          time_step: float = 1 / 60, device: str = "cpu", barrier: Options = None) -> Row:  # fmt: skip
    """How far a block slides until its center moves slower than 1 cm/s, at most in twice the time that is right.

    The reference is v^2 / (2 mu_f g) less the v h / 2 by which steps of backward Euler fall short of it.
    """
    right = speed / (friction * GRAVITY)
    scene = block(surface, friction, sweeps, time_step, device, barrier, room=2 * speed * right + 4)
    course = march(thrown(scene, speed), round(2 * right / time_step), until=lambda v: float(v[:, 0].mean()) < 0.01)
    travel = course.center()[0] - course.center(0)[0]
    return relative(course, "stopping distance [m]", surface, travel, 0.5 * speed * (right - time_step), 0.03,
                    f"moved for {time_step * (len(course.x) - 1):.3g} s, {right:.3g} s is right")  # fmt: skip


def slide_sweeps(surface: str = "Plane", most: int = 320, **options: Any) -> Row:
    """The least K of 5, 10, 20, ... at which :func:`slide` is within 3 %; `most` where none is."""
    sweeps = 5
    while not (found := slide(surface, sweeps, **options))["met"] and 2 * sweeps <= most:
        sweeps *= 2
    met = found["met"]
    note = f"a distance of {found['value']:.4g} m at K = {sweeps}" + (
        "" if met else ", which is not within 3 %, either"
    )
    return found | {"quantity": "K that a slide takes", "value": sweeps if met else None, "reference": None,
                    "target": "", "met": None, "note": note}  # fmt: skip


def incline(surface: str = "Plane", sweeps: int = 20, friction: float = 0.2, time_step: float = 1 / 60,
            device: str = "cpu", barrier: Options = None) -> Row:  # fmt: skip
    """How far a block slides down 30 degrees in a second; 1.60 m, and by steps of backward Euler (1 + h) times that."""
    angle = math.pi / 6
    scene = block(surface, friction, sweeps, time_step, device, barrier, angle=angle)
    course = march(scene, round(1 / time_step))
    moved = course.center() - course.center(0)
    goal = 0.5 * (1 + time_step) * GRAVITY * (math.sin(angle) - friction * math.cos(angle))
    travel = float(moved @ [math.cos(angle), -math.sin(angle), 0])
    return relative(course, "travel in 1 s [m]", f"{surface}, 30 degrees", travel, goal, 0.03)


def slide_gradient(surface: str = "Plane", speed: float = 1.0, sweeps: int = 20, friction: float = 0.1,
                   time_step: float = 1 / 60, device: str = "cpu", barrier: Options = None) -> list[Row]:  # fmt: skip
    """The derivative of the way that a block slides in 0.1 s, which is 0.1 s at each speed, and Newton's method.

    Newton starts at 0.7 times the speed and looks for the one that goes as far as Coulomb's law says of `speed`.
    """
    scene = block(surface, friction, sweeps, time_step, device, barrier)
    steps = round(0.1 / time_step)
    start = scene.state()[0]

    def travel(v0: float) -> tuple[float, float]:
        leaf = torch.tensor(v0, dtype=start.dtype, device=start.device, requires_grad=True)
        v = leaf * torch.tensor([1.0, 0.0, 0.0]).to(start).expand_as(start)
        end = dv.rollout(scene.model, start, v, steps=steps, save="last", **scene.arguments())
        weight = scene.model.mass[:, None] / scene.model.mass.sum()
        way = (weight * (end.x[-1] - start)).sum(0)[0]
        (slope,) = torch.autograd.grad(way, leaf)
        return float(way.detach()), float(slope)

    course = march(thrown(scene, speed), steps)
    time = steps * time_step
    # backward Euler's own sum, whose derivative is the time, too
    goal = speed * time - 0.5 * friction * GRAVITY * time * (time + time_step)
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
