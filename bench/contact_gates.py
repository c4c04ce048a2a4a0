"""Gates of contact: scenes whose answer is known, and a bar for each that a change of contact must not break.

Each row has a gate, a case, its value, its reference, the bar in words and whether it is met. References are closed
forms, the same scene without contact, central differences, or steps that Newton's method in NumPy has converged
(`bench.floors`). A row is not met, either, where a step raises, edges pass through triangles or vertices lie below a
plane; its note says so. Lengths in m, angles in rad, forces in N; bodies of 1000 kg/m^3 unless said otherwise.
"""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable, Iterable, Sequence
from itertools import product
from typing import Any

import numpy as np
import torch
from torch import Tensor

import diffvbd as dv
from bench import common, contact_scenes, converged_floor
from bench.contact import turned

from bench.contact_scenes import DHAT, GRAVITY, KAPPA, MODULUS, NONE, RISE, SEED, UP, WAYS, Array, Found, Row  # isort: skip
from bench.contact_scenes import march, model_of, moving, near, over, pairs, row, scenes, settled  # isort: skip
from bench.measure import Card, calls_of, least, nodes_of
from bench.tables import Table
from diffvbd import mesh, reference
from diffvbd.colliders import Obstacle, Plane

BLOCK, BOX = (0.2, 0.1, 0.2), (0.2, 0.2, 0.2)  # [m]
SURFACES = ("FloorBarrier", "Plane", "Obstacle, large triangles", "Obstacle, small triangles")


@torch.no_grad()
def floor_descent(subspace: str, device: str) -> Row:
    """Over one sweep, two and so on of a step in which a ball hits a floor: the largest rise of G over its values."""
    worst, material = -math.inf, dict(zip(("mu", "lam"), dv.lame(1e5, 0.3), strict=True))
    for h, gap, speed in ((2e-3, 6e-3, 2.0), (5e-3, 1e-2, 3.0)):
        model = model_of(the_ball(gap), dv.FloorBarrier(kappa=2e5, dhat=5e-3), device=device)
        x, v, values = model.rest_points, moving(model, -speed, 1), []
        for sweeps in range(1, 13):
            end, _ = dv.step(model, x, v, dv.VBD(h, sweeps, **WAYS[subspace]), gravity=NONE, **material)
            values.append(float(reference.incremental_potential(model, end, x + h * v, **material, time_step=h)))
        worst = max(worst, float(np.diff(values).max()) / max(values))
    return row("descent", f"ball on FloorBarrier, {subspace}, K = 1 to 12", worst, 0.0, f"<= {RISE:g}", worst <= RISE)


# --- a soft ball: rebound and pressure --------------------------------------------------------------------------------

RADIUS, SPACING, BALL_DHAT = 0.1, 0.036, 5e-3


def the_ball(gap: float) -> dv.TetMesh:
    body = converged_floor.ball(RADIUS, SPACING)
    return body.translate((0.0, gap - body.points[:, 1].min(), 0.0))


def on(surface: str, tets: dv.TetMesh, kappa: float, **options: Any) -> dv.Model:
    """A body above y = 0."""
    if surface == "FloorBarrier":
        return model_of(tets, dv.FloorBarrier(kappa=kappa, dhat=BALL_DHAT), **options)
    return model_of(tets, pairs(kappa=kappa, dhat=BALL_DHAT), colliders=(Plane(),), **options)


def ball(young: float, time_step: float, sweeps: int, device: str) -> list[Row]:
    """Rebound of a ball, over its speed of 2 m/s, once the converged one has left the floor."""
    tets, kappa, steps, out = the_ball(8e-3), max(1e5, 3 * young * SPACING), 0, []
    body = converged_floor.Body(tets.points, tets.tets, young, 0.3, time_step, kappa, BALL_DHAT)
    x, v, share = tets.points, np.zeros_like(tets.points) - (0.0, 2.0, 0.0), body.mass / body.mass.sum()
    while (share @ v[:, 1] < 0 or x[:, 1].min() < BALL_DHAT) and steps < 600:
        x, v = body.step(x, v)
        steps += 1
    goal = float(share @ v[:, 1]) / 2.0
    for surface, way in product(SURFACES[:2], WAYS):
        model = on(surface, tets, kappa, device=device)
        end = dv.rollout(model, model.rest_points, moving(model, -2.0, 1), dv.VBD(time_step, sweeps, **WAYS[way]),
                         save="last", steps=round(1.2 * steps) + 2, gravity=NONE, young=young, poisson=0.3)  # fmt: skip
        value = float((model.mass * end.v[-1, :, 1]).sum() / model.mass.sum()) / 2.0
        case = f"{surface}, {way}, {young:g} Pa, h = {1e3 * time_step:g} ms, K = {sweeps}"
        out.append(near("ball", case, value, goal, 0.03))
    return out


def pressed(ways: Sequence[float], sweeps: int, device: str) -> list[Row]:
    """Force on the floor of a ball whose top is pinned to a plate that comes down by so much in each step."""
    tets, h, kappa, out = the_ball(BALL_DHAT), 5e-3, 2e5, []
    plate = tets.points[:, 1] > BALL_DHAT + 1.6 * RADIUS
    body = converged_floor.Body(tets.points, tets.tets, 1e5, 0.3, h, kappa, BALL_DHAT, pinned=plate)
    down = tets.points - np.cumsum(ways)[:, None, None] * plate[:, None] * np.array(UP)
    goal = body.floor_force(body.rollout(tets.points, 0 * tets.points, len(ways), down)[0][-1])
    for surface, way in product(SURFACES[:2], WAYS):
        model = on(surface, tets, kappa, pinned=plate, device=device)
        x = model.rest_points
        end = dv.rollout(model, x, 0 * x, dv.VBD(h, sweeps, **WAYS[way]), steps=len(ways), save="last", gravity=NONE,
                         young=1e5, poisson=0.3, prescribed=dv.per_step(torch.from_numpy(down).to(x)))  # fmt: skip
        found = dv.contact.forces(model, end.x[-1])
        value = float((found.floors if surface == "FloorBarrier" else found.colliders).normal[..., 1].sum())
        case = f"20 mm in {np.count_nonzero(ways)} of {len(ways)} steps, {surface}, {way}, K = {sweeps}"
        out.append(near("pressed", case, value, goal, 0.02))
    return out


# --- motion: a sheet, a spin, friction --------------------------------------------------------------------------------


def sheet(sweeps: int, device: str = "cpu") -> Row:
    """Height of the free edge of a sheet of 0.4 m x 0.4 m x 5 mm, pinned at one edge, 0.25 s after it was let go."""
    body, ways = mesh.sheet(9, 9, (0.4, 0.4), 0.005), []
    for energies in ((), (pairs(dhat=0.02, self_contact=True),)):
        model = model_of(body, *energies, pinned=torch.from_numpy(body.points[:, 0] < 1e-9), device=device)
        # "auto" with pairs: without them it would be "inertia", where so few sweeps hardly move a thin sheet
        ways.append(march(model, 1 / 60, sweeps, 15, options={"start": "predictor"}))
    free, own = (float(way.x[-1][way.x[0][:, 0] > 0.4 - 1e-9, 1].mean()) for way in ways)
    return near("sheet", f"tip y with self-contact, K = {sweeps}", own, free, 0.03, "", ways[1])


def spin(gap: float = 0.002, steps: int = 1, sweeps: int = 20, device: str = "cpu") -> Row:
    """Share of its angular momentum that a cube keeps at 20 rad/s by another that rests; alone it is the reference."""
    box, kept = mesh.box(3, 0.2, split="kuhn").translate((-0.1, 0, -0.1)), []
    for bodies, energies in (([box], ()), ([box, box.translate((0, -0.2 - gap, 0))], (pairs(self_contact=True),))):
        model = model_of(bodies, *energies, device=device)
        v, x = torch.zeros_like(model.rest_points), model.rest_points
        v[:27] = 20.0 * torch.linalg.cross(torch.tensor(UP).to(x).expand(27, 3), x[:27])
        course = march(model, 1 / 100, sweeps, steps, v=v, gravity=NONE, options={"subspace": None})
        momentum = course.mean(torch.linalg.cross(course.x, course.v), slice(27))[:, 1]
        kept.append(float(momentum[-1] / momentum[0]))
    return row("spin", f"share kept, {1e3 * gap:g} mm from another, K = {sweeps}", kept[1], kept[0], ">= 0.97",
               kept[1] >= 0.97, "", course)  # fmt: skip


def flat(length: float, width: float, cells: int, turn: Array) -> Obstacle:
    """A flat surface through the origin from x = -1 on, in squares of two triangles, then turned."""
    rows = max(1, round(cells * width / length))
    x, z = np.linspace(-1, length - 1, cells + 1), np.linspace(-width / 2, width / 2, rows + 1)
    points = np.stack([*np.meshgrid(x, [0.0], z, indexing="ij")], -1).reshape(-1, 3)
    i, k = (a.ravel() for a in np.meshgrid(np.arange(cells), np.arange(rows), indexing="ij"))
    a = i * (rows + 1) + k
    b, c, d = a + 1, a + rows + 1, a + rows + 2
    return Obstacle(points @ turn.T, np.concatenate([np.stack([a, b, c], -1), np.stack([c, b, d], -1)]))


def block(surface: str, friction: float, device: str, angle: float = 0.0, room: float = 24.0, mu: float = MODULUS
          ) -> tuple[dv.Model, dict[str, Any]]:  # fmt: skip
    """A block at rest on a surface through the origin that rises toward -x by an angle [rad], and arguments of
    march."""
    turn = np.array([[math.cos(angle), math.sin(angle), 0], [-math.sin(angle), math.cos(angle), 0], [0, 0, 1]])
    normal = tuple(float(n) for n in turn[:, 1])
    body = mesh.box((3, 2, 3), BLOCK, split="kuhn").translate((-0.1, 0.5 * DHAT, -0.1))
    large, colliders = surface == SURFACES[2], []
    if surface == "Plane":
        colliders = [Plane(NONE, normal)]
    elif surface != "FloorBarrier":
        colliders = [flat(room, room if large else 0.83, 1 if large else round(room / 0.2), turn)]
    barrier = pairs() if colliders else dv.FloorBarrier(0.0, normal, kappa=KAPPA, dhat=DHAT)
    model = model_of(dv.TetMesh(body.points @ turn.T, body.tets), barrier, dv.Friction(friction), colliders=colliders,
                     device=device)  # fmt: skip
    x = settled(model, mu=mu, gravity=[-GRAVITY * math.cos(angle) * n for n in normal])
    return model, {"x": x, "mu": mu, "walls": [normal]}


def slide(surface: str = "Plane", sweeps: int = 20, speed: float = 10.0, friction: float = 0.5, device: str = "cpu"
          ) -> Row:  # fmt: skip
    """How far a block slides until its center moves slower than 1 cm/s, at most in twice the time that is right.

    The reference is v^2 / (2 mu_f g) less the v h / 2 by which steps of backward Euler fall short of it.
    """
    right, h = speed / (friction * GRAVITY), 1 / 60
    model, rest = block(surface, friction, device, room=2 * speed * right + 4)
    course = march(model, h, sweeps, round(2 * right / h), v=moving(model, speed, 0), **rest)
    stopped = [*(course.mean(course.v)[:, 0] < 0.01), True].index(True)
    travel = float(course.mean(course.x[min(stopped, len(course.x) - 1)] - course.x[0])[0])
    return near("slide", f"{surface}, {speed:g} m/s, K = {sweeps}", travel, 0.5 * speed * (right - h), 0.03,
                f"moved for {h * stopped:.3g} s, {right:.3g} s is right", course)  # fmt: skip


def incline(surface: str, sweeps: int, device: str, friction: float = 0.5) -> list[Row]:
    """The angle of friction, from the acceleration on a steeper incline, and the creep on one that is less steep."""
    angle, case = math.atan(1.2 * friction), f"{surface}, K = {sweeps}"
    model, rest = block(surface, friction, device, angle)
    course = march(model, 1 / 100, sweeps, 60, **rest)
    down = np.array([math.cos(angle), -math.sin(angle), 0.0])
    found = math.tan(angle) - float(course.gained(20, 60) @ down) / (GRAVITY * math.cos(angle))
    model, rest = block(surface, friction, device, math.atan(0.9 * friction), mu=10 * MODULUS)
    below = march(model, 1 / 100, sweeps, 60, **rest)
    # smoothed friction bears a share s at a slip of eps_v (1 - sqrt(1 - s))
    creep, goal = float(np.linalg.norm(below.mean(below.v[-1]))), 1e-3 * (1 - math.sqrt(0.1))
    return [near("incline", f"threshold, {case}", found, friction, 0.01, "", course),
            near("incline", f"creep at 0.9 of it, {case}", creep, goal, 0.01, "", below)]  # fmt: skip


def groove(surface: str, sweeps: int, device: str, friction: float = 0.5) -> Row:
    """Deceleration of a block that slides along a V of two planes at 45 degrees: sqrt(2) times that on a flat one."""
    s, body = math.sqrt(0.5), mesh.box((3, 3, 3), (0.2, 0.1, 0.1), split="kuhn")
    body = dv.TetMesh(body.points @ np.array([[1, 0, 0], [0, s, s], [0, -s, s]]).T, body.tets)
    normals, planes = ((0.0, s, s), (0.0, s, -s)), surface == "Plane"
    barrier = pairs() if planes else dv.FloorBarrier((0.0, 0.0), normals, kappa=KAPPA, dhat=DHAT)
    body = body.translate((0, (0.5 * DHAT - (body.points @ normals[0]).min()) / s, 0))
    model = model_of(body, barrier, dv.Friction(friction), colliders=[Plane(NONE, n) for n in normals if planes],
                     device=device)  # fmt: skip
    course = march(model, 1 / 100, sweeps, 35, x=settled(model), v=moving(model, 3.0, 0), walls=normals)
    return near("groove", f"deceleration, {surface}, K = {sweeps}", -float(course.gained(5, 35)[0]),
                friction * GRAVITY / s, 0.01, "", course)  # fmt: skip


def conveyor(surface: str, sweeps: int, device: str, friction: float = 0.5) -> Row:
    """How far a belt at 1 m/s takes a block that it finds at rest, in 0.4 s."""
    (model, rest), h = block(surface, friction, device), 1 / 100
    way = torch.tensor([h, 0.0, 0.0]).to(model.collider_points) * torch.arange(1, 41).to(model.device)[:, None, None]
    course = march(model, h, sweeps, 40, colliders=dv.per_step(model.collider_points + way),
                   colliders_before=model.collider_points, **rest)  # fmt: skip
    goal = h * sum(min(1.0, n * h * friction * GRAVITY) for n in range(1, 41))
    return near("conveyor", f"way, {surface}, K = {sweeps}", float(course.moved()[0]), goal, 0.03, "", course)


def torsion(surface: str, sweeps: int, device: str, friction: float = 0.1) -> Row:
    """Angular deceleration of a block that turns on a floor at 5 rad/s: friction times the moment of the normal forces
    on the way, over its inertia."""
    model, rest = block(surface, friction, device, mu=10 * MODULUS)
    x = rest["x"]
    flat = torch.tensor([1.0, 0.0, 1.0]).to(x)
    arm, lost = (x - (model.mass @ x) / model.mass.sum()) * flat, []
    inertia = float((model.mass[:, None] * arm**2).sum())
    turning = 5 * torch.linalg.cross(torch.tensor(UP).to(x).expand_as(x), arm)
    for coefficient in (0.0, friction):  # backward Euler slows a spin down, too
        course = march(model, 1 / 400, sweeps, 25, v=turning, friction=coefficient, **rest)
        at = course.x - torch.from_numpy(course.mean(course.x))[:, None]
        rate = course.mean(torch.linalg.cross(at, course.v))[:, 1] * float(model.mass.sum()) / inertia
        lost.append(float(rate[5] - rate[25]) * 20)
    ends = [t[5:25].to(x) for t in (course.x, at)]
    moments = [dv.contact.forces(model, end).vertices.normal[:, 1] @ (r * flat).norm(dim=1)
               for end, r in zip(*ends, strict=True)]  # fmt: skip
    goal = friction * float(torch.stack(moments).mean()) / inertia
    return near("torsion", f"{surface}, K = {sweeps}", lost[1] - lost[0], goal, 0.02, "", course)


def rest(support: str, sweeps: int, device: str = "cpu") -> Row:
    """Sideways speed of a block without friction, 0.4 s after it lay at rest.

    It lies on a Plane, on a wider "box" with a pinned bottom, or on a "pinned box" of which nothing moves. Dented
    surfaces are not level, nor are normals between edges: with boxes the reference is the speed at K = 400.
    """
    body, pinned, colliders = mesh.box(3, BOX, split="kuhn").translate((0, 0.5 * DHAT, 0)), None, (Plane(),)
    if support != "Plane":
        # askew, so that closest points are not at ties
        lower = mesh.box((4, 3, 4), (0.3, 0.2, 0.3), split="kuhn").translate((-0.053, -0.2, -0.047))
        body, colliders = mesh.join([body, lower]), ()
        pinned = torch.from_numpy(body.points[:, 1] < (1e-9 if support == "pinned box" else -0.2 + 1e-9))
    model = model_of(body, pairs(), pinned=pinned, colliders=colliders, device=device)
    x, counts = settled(model), (sweeps,) if support == "Plane" else (sweeps, 400)
    courses = [march(model, 1 / 100, count, 40, x=x) for count in counts]
    speed, *goal = (float(np.hypot(*c.mean(c.v[-1], slice(27))[[0, 2]])) for c in courses)
    off = abs(speed - sum(goal))
    return row("rest", f"sideways speed on a {support}, K = {sweeps}", speed, sum(goal), "off by <= 0.001", off <= 1e-3,
               "", courses[0])  # fmt: skip


def fall(sweeps: int, way: str, device: str) -> Row:
    """Two cubes, 2 mm apart, in free flight: steps of backward Euler fall by g h^2 n (n + 1) / 2."""
    box, h, n = mesh.box(3, BOX, split="kuhn"), 1 / 100, 30
    model = model_of([box, box.translate((0.202, 0.013, 0.017))], pairs(dhat=1e-3), device=device)
    course, goal = march(model, h, sweeps, n, way), GRAVITY * h * h * n * (n + 1) / 2
    off = float((course.x[-1] - course.x[0] + goal * torch.tensor(UP).double()).abs().max()) / goal
    return row("free fall", f"off by, K = {sweeps}, {way}", off, 0.0, "<= 1e-12", off <= 1e-12, "", course)


def struck(count: int, gap: float, speed: float, sweeps: int, way: str, device: str) -> Row:
    """The most momentum that a row of cubes of 0.1 m gains or loses, of which the first is thrown at the others: over
    what it had."""
    cube = mesh.cube(2, size=0.1, split="kuhn")
    model = model_of([cube.translate((i * (0.1 + gap), 0.003 * i, 0.002 * i)) for i in range(count)],
                     pairs(dhat=1e-3, self_contact=True), device=device)  # fmt: skip
    course = march(model, 1 / 100, sweeps, max(10, round(count * gap / speed * 100) + 10), way, mu=2 * MODULUS,
                   v=moving(model, speed, 0, slice(cube.num_vertices)), gravity=NONE)  # fmt: skip
    momentum = course.mean(course.v)
    worst = float(np.linalg.norm(momentum - momentum[0], axis=1).max() / np.linalg.norm(momentum[0]))
    bar = 1e-12 if count == 2 else 1e-11  # of a collision; in rows roundings add up
    return row("momentum", f"{count} cubes, {1e3 * gap:g} mm apart, {speed:g} m/s, K = {sweeps}, {way}", worst, 0.0,
               f"<= {bar:g}", worst <= bar, "", course)  # fmt: skip


# --- what bodies bear -------------------------------------------------------------------------------------------------


def stack(count: int, sweeps: int, way: str, device: str, height: float = 0.2, mu: float = 2 * MODULUS,
          kappa: float = KAPPA, densities: Sequence[float] = ()) -> list[Row]:  # fmt: skip
    """Boxes 0.2 m wide on each other, not quite in line, after 2 s of 1/100 s: sway of a center, and the forces.

    It stands if no box sways by half its width, and the top one keeps 0.9 of its height. A column of this
    material buckles under its weight from about 1.1 m on, so ten boxes have to be flat.
    """
    box, gap, rng = mesh.box(2, (BOX[0], height, BOX[2]), split="kuhn"), 0.3 * DHAT, np.random.default_rng(0)
    bodies = [box.translate((x, gap + k * (height + gap), z)) for k, (x, z) in
              enumerate(rng.uniform(-0.005, 0.005, (count, 2)))]  # fmt: skip
    heavy = torch.tensor(densities or [1000.0] * count, dtype=torch.float64).repeat_interleave(box.num_tets)
    model = model_of(bodies, pairs(kappa=kappa), dv.Friction(0.5), dv.FloorBarrier(0.0, UP, kappa=kappa, dhat=DHAT),
                     density=heavy, device=device)  # fmt: skip
    course = march(model, 1 / 100, sweeps, 200, way, mu=mu, walls=[UP])
    centers = course.x.reshape(201, count, -1, 3).mean(2)
    sway = float((centers - centers[0])[..., [0, 2]].norm(dim=-1).max())
    top = float(centers[-1, -1, 1] / centers[0, -1, 1])
    case = f"{count} boxes of {height:g} m, K = {sweeps}, {way}" + ", 1:10:100" * bool(densities)
    # what contact bears of each body, summed up from the top
    up = course.forces(20, lambda found: found.vertices.total[:, 1].reshape(count, -1).sum(1))
    weight = GRAVITY * model.mass.cpu().reshape(count, -1).sum(1).numpy()
    off = up[::-1].cumsum()[::-1] / weight[::-1].cumsum()[::-1] - 1
    worst = int(np.abs(off).argmax())
    return [row("stack", f"sway, {case}", sway, 0.0, "stands", sway < 0.5 * BOX[0] and top > 0.9,
                f"top at {top:.3f} of its height", course),
            near("stack", f"force over weight, {case}", 1 + float(off[worst]), 1.0, 0.01,
                 f"worst under box {worst + 1} from below")]  # fmt: skip


def grip(sweeps: int, way: str, device: str, friction: float = 0.6, squeeze: float = 6e-4) -> Row:
    """Vertical force that a cube of 5 cm and 0.103 kg, held by friction alone, puts on its two clamps.

    The clamps are plates whose outer faces are pinned and move inward in 0.1 s, by squeeze beyond the start of the
    barrier. Gravity pulls the cube alone, so that the clamps bear its weight, once at rest: mean of the last 0.1 s.
    """
    size, thick, dhat, h = 0.05, 0.02, 2e-3, 1 / 240
    cube, plate = mesh.box(3, size, split="kuhn"), mesh.box((2, 3, 3), (thick, 0.06, 0.06), split="kuhn")
    left = plate.translate((-thick - dhat, -0.0052, -0.0047))
    body = mesh.join([cube, left, plate.translate((size + dhat, -0.0049, -0.0051))])
    n, across = cube.num_vertices, torch.from_numpy(body.points[:, 0])
    outer = (across < -thick - 0.5 * dhat) | (across > size + thick + 0.5 * dhat)
    density = torch.full((body.num_tets,), 1000.0, dtype=torch.float64)
    density[: cube.num_tets] = 0.103 / size**3
    model = model_of(body, pairs(dhat=dhat), dv.Friction(friction), density=density, pinned=outer, device=device)
    start, gravity = model.rest_points, moving(model, -GRAVITY, 1, slice(n))
    inward = torch.zeros_like(start)
    inward[:, 0] = torch.where(model.pinned, -squeeze * start[:, 0].sign(), 0.0)
    share = (h / 0.1 * torch.arange(1, 121)).clamp(max=1).to(start)[:, None, None]
    course = march(model, h, sweeps, 120, way, gravity=gravity, prescribed=dv.per_step(start + share * inward))
    loads = [dv.reactions(model, x.to(start), gravity=gravity, mu=MODULUS, lam=2 * MODULUS).cpu().sum(0)[1]
             for x in course.x[-24:]]  # fmt: skip
    return near("grip", f"force on the clamps, K = {sweeps}, {way}", float(np.mean(loads)), 0.103 * GRAVITY, 0.05,
                f"cube moved {1e3 * float(course.moved(slice(n))[1]):.3g} mm", course)  # fmt: skip


def ring(sides: int = 12, radius: float = 0.1, width: float = 0.03) -> dv.TetMesh:
    """A ring about the z axis, of square section."""
    angle, i = 2 * np.pi * np.arange(sides)[:, None] / sides, np.arange(sides)
    far, up = (width * (a.ravel() - 0.5) for a in np.meshgrid([0, 1], [0, 1], indexing="ij"))
    points = np.stack([np.cos(angle) * (radius + far), np.sin(angle) * (radius + far), 0 * angle + up], -1)
    paths = [(0, a, a + b, 7) for a, b in ((4, 2), (4, 1), (2, 4), (2, 1), (1, 4), (1, 2))]  # Kuhn's
    tets = [np.stack([4 * ((i + c // 4) % sides) + c % 4 for c in path], -1) for path in paths]
    return dv.TetMesh(points.reshape(-1, 3), np.concatenate(tets), orient=True)


def rings(sweeps: int, way: str, device: str) -> Row:
    """Force between two rings of a chain, the upper one held: the weight of the lower one."""
    upper = ring()
    low = upper.points[:, [2, 1, 0]] + np.array([0.003, -0.2 + 0.03 + 1.5 * DHAT, 0.002])
    model = model_of([upper, dv.TetMesh(low, upper.tets, orient=True)], pairs(), dv.Friction(0.3),
                     pinned=np.concatenate([upper.points[:, 1] > 0.05, low[:, 1] > np.inf]), device=device)  # fmt: skip
    course = march(model, 1 / 100, sweeps, 150, way, mu=10 * MODULUS)
    force = course.forces(30, lambda found: found.vertices.total[upper.num_vertices :].sum(0))[1]
    weight = GRAVITY * float(model.mass[upper.num_vertices :].sum())
    return near("rings", f"force between, K = {sweeps}, {way}", float(force), weight, 0.05, "", course)


# --- surfaces of tets are flat ----------------------------------------------------------------------------------------


def askew(sweeps: int, device: str) -> Row:
    """Sideways part of the normal force between two cubes out of line, over the weight of the upper one."""
    box = mesh.box(3, BOX, split="kuhn")
    bodies = [box.translate((0, -0.2, 0)), box.translate((0.004, 0.5 * DHAT, 0.003))]
    model = model_of(bodies, pairs(), dv.Friction(0.5), pinned=np.arange(54) < 27, device=device)
    course = march(model, 1 / 50, sweeps, 60)
    force = course.forces(10, lambda found: found.vertices.normal[27:].sum(0))
    layers = course.x[-1][27:].reshape(3, 3, 3, 3)
    axis = (layers[:, -1] - layers[:, 0]).reshape(-1, 3).mean(0)
    tilt = float(axis[[0, 2]].norm() / axis[1])
    value = float(np.hypot(*force[[0, 2]])) / (GRAVITY * float(model.mass[27:].sum()))
    return row("flat", f"sideways force of cubes out of line, K = {sweeps}", value, 0.0, "<= 2 tilts + 1e-3",
               value <= 2 * tilt + 1e-3, f"tilt {tilt:.2g}", course)  # fmt: skip


def cards(sweeps: int, device: str) -> Row:
    """How far frictionless cards that lie on a table of tets slide in 1 s."""
    table = mesh.box((9, 2, 5), (0.8, 0.05, 0.4), split="kuhn").translate((0, -0.05, 0))
    card, bodies = mesh.box((4, 2, 3), (0.12, 0.02, 0.08), split="kuhn"), []
    for k, angle in enumerate((0.0, 0.3, 0.7, 1.1)):
        c, s = math.cos(angle), math.sin(angle)
        points = (card.points - card.points.mean(0)) @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]).T
        bodies.append(dv.TetMesh(points + [0.113 + 0.19 * k, 0.01 + 0.5 * DHAT, 0.19 + 0.007 * k], card.tets))
    tets = mesh.join([*bodies, table])
    model = model_of(tets, pairs(), pinned=torch.from_numpy(tets.points[:, 1] < -0.049), device=device)
    course = march(model, 1 / 100, sweeps, 100, mu=10 * MODULUS)
    moved = [float(np.hypot(*course.moved(slice(24 * k, 24 * k + 24))[[0, 2]])) for k in range(4)]
    return row("flat", f"slide of cards on a table in 1 s, K = {sweeps}", max(moved), 0.0, "<= 0.0005",
               max(moved) <= 5e-4, ", ".join(f"{1e3 * way:.2g}" for way in moved) + " mm", course)  # fmt: skip


def strip(sweeps: int, device: str) -> Row:
    """How far a strip falls in 0.2 s that two frictionless pads of tets press."""
    body, h = mesh.box((2, 7, 3), (0.02, 0.2, 0.06), split="kuhn"), 1 / 200
    pad, off = mesh.box((2, 9, 3), (0.05, 0.6, 0.1), split="kuhn"), 0.5 * DHAT
    bodies = [body, pad.translate((-0.05 - off, -0.35, -0.021)), pad.translate((0.02 + off, -0.35, -0.018))]
    model = model_of(bodies, pairs(), pinned=np.arange(42 + 2 * 54) >= 42, device=device)
    course = march(model, h, sweeps, 40)
    value = -float(course.moved(slice(42))[1])
    return row("flat", f"fall of a strip between pads in 0.2 s, K = {sweeps}", value, GRAVITY * h * h * 40 * 41 / 2,
               ">= 0.195", value >= 0.195, "", course)  # fmt: skip


def gaps(support: str, sizes: Sequence[int], sweeps: int, device: str) -> Row:
    """How much the gap differs at which a cube of n^3 vertices rests, over the least."""
    found = []
    for n in sizes:
        bodies, colliders = [mesh.box(n, BOX, split="kuhn").translate((0, 0.5 * DHAT, 0))], (Plane(),)
        if support == "tets":
            bodies.append(mesh.box((5, 2, 5), (0.3, 0.1, 0.3), split="kuhn").translate((-0.053, -0.1, -0.047)))
            colliders = ()
        tets = mesh.join(bodies)
        # soft enough for a gap of a third of dhat
        model = model_of(tets, pairs(kappa=None, kappa_per_area=2e4), pinned=np.arange(tets.num_vertices) >= n**3,
                         colliders=colliders, device=device)  # fmt: skip
        x = settled(model, steps=12, sweeps=sweeps, mu=10 * MODULUS)[: n**3]
        found.append(float(x[model.rest_points[: n**3, 1] < 0.5 * DHAT + 1e-9, 1].mean()))
    value = max(found) / min(found) - 1
    return row("flat", f"gap on {support}, {', '.join(map(str, sizes))} vertices an edge", value, 0.0, "<= 5 %",
               value <= 0.05, ", ".join(f"{1e3 * gap:.3g}" for gap in found) + " mm")  # fmt: skip


# --- crowds -----------------------------------------------------------------------------------------------------------


def cubes_of(n: int, places: Array, rng: np.random.Generator) -> list[dv.TetMesh]:
    return [turned(mesh.box(n, 0.1, split="kuhn"), rng).translate(tuple(place)) for place in places]


def crowd(sweeps: int, way: str, device: str) -> Row:
    """Share of the vertices that contact stops where 18 cubes come together."""
    places = 0.2 * np.array([*product(range(3), range(2), range(3))])
    model = model_of(cubes_of(3, places, np.random.default_rng(5)), pairs(), device=device)
    x = model.rest_points.reshape(18, 27, 3)
    v = -15.0 * (x.mean(1, keepdim=True) - x.mean((0, 1))).expand(18, 27, 3).reshape(-1, 3)
    course = march(model, 1 / 100, sweeps, 15, way, mu=2e4, v=v, gravity=NONE)
    return row("crowd", f"share stopped of 18 bodies, K = {sweeps}, {way}", course.cut, 0.0, "<= 5 %",
               course.cut <= 0.05, "", course._replace(cut=0.0))  # fmt: skip


def lost(number: int, sweeps: int, device: str) -> float:
    """The most momentum that a group of two to six cubes that meet loses, over that of all its cubes."""
    rng = np.random.default_rng((SEED, 3, number))
    count = int(rng.integers(2, 7))
    places = np.array([0.22, 0, 0]) * np.arange(count)[:, None] + rng.normal(size=(count, 3)) * [0, 0.03, 0.03]
    model = model_of(cubes_of(2, places, rng), pairs(), device=device)
    speeds = rng.uniform(1, 10, count) * np.where(np.arange(count) < count / 2, 1, -1)
    v = moving(model, 1.0, 0) * torch.from_numpy(np.repeat(speeds, 8)).to(model.rest_points)[:, None]
    course = march(model, 1 / 100, sweeps, 12, mu=2 * MODULUS, v=v, gravity=NONE)
    momentum, had = course.mean(course.v), np.abs(course.mean(course.v[0].abs()))[0]
    return math.inf if course.crossings else float(np.linalg.norm(momentum - momentum[0], axis=1).max() / had)


def lost_rows(ends: dict[int, float], raised: list[str], sweeps: int) -> list[Row]:
    bad, allowed = [n for n, share in ends.items() if not share <= 0.01], len(ends) / 30
    note = "; ".join(filter(None, [f"most {max(ends.values(), default=math.nan):.2g}", scenes(bad), *raised[:1]]))
    return [row("crowd", f"throws of {len(ends)} that lose 1 % of momentum, K = {sweeps}", len(bad), 0,
                f"<= {allowed:g}", len(bad) <= allowed and not raised, note)]  # fmt: skip


# --- cost -------------------------------------------------------------------------------------------------------------


def cost(way: str, quick: bool, device: str) -> list[Row]:
    """A step of two cubes that touch, of 54 vertices, K = 10: processor time on the CPU, the wall clock on CUDA."""
    cube, card = mesh.box(3, 0.1, split="kuhn"), Card(torch.device(device), quick)
    bodies = [cube, cube.translate((0.013, 0.1 + 0.5 * DHAT, 0.017))]
    model = model_of(bodies, pairs(self_contact=True), dv.Friction(), device=device)
    solver, x = dv.VBD(1 / 100, 10, **WAYS[way]), model.rest_points
    leaves = [t.clone().requires_grad_() for t in (x, 0 * x, x.new_tensor(MODULUS))]

    def step(x: Tensor, v: Tensor, mu: Tensor) -> Any:
        return dv.step(model, x, v, solver, mu=mu, lam=mu)

    def forward() -> Any:
        return step(*(t.detach() for t in leaves))

    def both() -> Any:
        return torch.autograd.grad(step(*leaves), leaves, (torch.ones_like(x),) * 2)

    def milliseconds(work: Callable[[], Any], count: int = 2 if quick else 20) -> float:
        def many() -> float:
            began = time.process_time()
            for _ in range(count):
                work()
            return (time.process_time() - began) / count

        many()
        return 1e3 * (card.eager(work, 40) if card.cuda else least(many, 2 if quick else 7))

    bars = {"plain": ((1.5, 3), (2, 4)), "coarse": ((2.5, 5), (3, 6))}[way][card.cuda]
    found = [(f"ms, {name}", milliseconds(work), bar) for name, work, bar in
             zip(("forward", "with gradient"), (forward, both), bars, strict=True)]  # fmt: skip
    calls, files = calls_of(forward)
    nodes = nodes_of(step(*leaves))
    found += [("Python calls", calls, 200), ("files entered", files, 20), ("autograd nodes", nodes, 12)]
    return [row("cost", f"{name}, {way}", value, None, f"<= {most}", value <= most) for name, value, most in found]


# --- groups -----------------------------------------------------------------------------------------------------------

Case = tuple[Callable[..., Any], dict[str, Any]]  # a function and its arguments


def every(work: Callable[..., Any], **ranges: Iterable[Any]) -> list[Case]:
    """Cases of all combinations of some arguments."""
    return [(work, dict(zip(ranges, values, strict=True))) for values in product(*ranges.values())]


def chunks(work: Callable[..., Any], count: int, size: int, **given: Any) -> list[Case]:
    return [(over, {"numbers": range(k, min(k + size, count)), "work": work, **given}) for k in range(0, count, size)]


def measured(case: tuple[int, Callable[..., Any], dict[str, Any]], device: str) -> tuple[list[Row] | Found, float]:
    """What a case has found, and seconds: of the processor on the CPU, which other programs do not stretch. An error is
    a row that is not met."""
    _, work, given = case
    clock = time.process_time if torch.device(device).type == "cpu" else time.perf_counter
    began = clock()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            made = work(**given, device=device)
        except Exception as error:
            about = ", ".join(f"{key} {value}" for key, value in given.items())[:80]
            made = row(
                work.__name__, about, None, None, "no error", False, f"{type(error).__name__}: {str(error)[:200]}"
            )
    return [made] if isinstance(made, dict) and "gate" in made else made, clock() - began


def group(cases: Callable[[bool], list[Case]], rows_of: Callable[..., list[Row]] | None = None, alone: bool = False,
          **given: Any) -> Callable[[Card], list[Row]]:  # fmt: skip
    """Rows of cases, on all cores; rows_of: makes them of what all cases have found. alone: one after another."""

    def run(card: Card) -> list[Row]:
        numbered = [(k, *case) for k, case in enumerate(cases(card.quick))]
        side_by_side = common.side_by_side(measured, numbered, str(card.device), at_once=not (alone or card.quick))
        ends = sorted(((case[0], end) for case, end in side_by_side), key=lambda one: one[0])
        parts = [found for _, (found, _) in ends if isinstance(found, dict)]
        out = [(made, seconds / len(rows)) for _, (rows, seconds) in ends if isinstance(rows, list) for made in rows]
        if rows_of is not None:
            found = {n: end for part in parts for n, end in part["ends"].items()}
            made = rows_of(found, [text for part in parts for text in part["raised"]], **given)
            out += [(one, sum(seconds for _, (_, seconds) in ends)) for one in made]
        return [{**made, "seconds": seconds, "note": made["note"]} for made, seconds in out]

    return run


def both(*runs: Callable[[Card], list[Row]]) -> Callable[[Card], list[Row]]:
    return lambda card: [made for run in runs for made in run(card)]


def motion(quick: bool) -> list[Case]:
    k, surfaces = (8,) if quick else (8, 20), SURFACES[1:2] if quick else SURFACES[:2]
    out = every(sheet, sweeps=k) + every(spin, sweeps=k) + every(fall, sweeps=k, way=WAYS)
    out += every(slide, surface=surfaces if quick else SURFACES, sweeps=k, speed=[1.0 if quick else 10.0])
    for name in (incline, groove, torsion):
        out += every(name, surface=surfaces, sweeps=k)
    out += every(conveyor, surface=SURFACES[1 : 2 if quick else 3], sweeps=k)
    out += every(rest, support=["Plane"] if quick else ["Plane", "pinned box", "box"], sweeps=k)
    thrown = ((2, 0.005, 3.0), (2, 0.01, 10.0), (4, 0.005, 3.0), (4, 0.01, 10.0), (10, 0.002, 5.0), (10, 0.02, 3.0))
    for count, gap, speed in thrown[: 1 if quick else 6]:
        out += every(struck, count=[count], gap=[gap], speed=[speed], sweeps=k, way=WAYS)
    return out


def borne(quick: bool) -> list[Case]:
    if quick:
        return every(rings, sweeps=[8], way=["plain"])
    heavy = {"densities": [(100.0, 1000.0, 10000.0)], "mu": [1e6], "kappa": [1e5]}
    return [*every(stack, count=[5], sweeps=(8, 20), way=WAYS), *every(stack, count=[10], sweeps=(12, 20),
            height=[0.06], way=WAYS), *every(stack, count=[3], sweeps=(8, 20), way=["coarse"], **heavy),
            *every(grip, sweeps=[40], way=["plain"]), *every(grip, sweeps=[20], way=["coarse"]),
            *every(rings, sweeps=(8, 20), way=WAYS)]  # fmt: skip


def flats(quick: bool) -> list[Case]:
    out = every(strip, sweeps=[8] if quick else [8, 20]) + every(askew, sweeps=[8] if quick else [20, 100])
    out += [] if quick else every(cards, sweeps=[20, 100])
    return out + every(gaps, support=["Plane"] if quick else ["Plane", "tets"], sweeps=[40],
                       sizes=[(3, 5) if quick else (3, 5, 7, 9)])  # fmt: skip


BALLS = {"young": [3e4, 1e5, 1e6, 1e7], "time_step": [1e-3, 2e-3, 4e-3]}
FEWER = {"young": [1e6], "time_step": [4e-3]}
PRESSES = ((0.004,) * 5 + (0.0,) * 5, (0.02,), (0.001,) * 20 + (0.0,) * 10)  # [m]
GROUPS: dict[str, Callable[[Card], list[Row]]] = {
    "gradient": both(*(group(lambda quick, n=n: chunks(contact_scenes.slope_error, 6 if quick else 300, 10, steps=n),
                             contact_scenes.gradient_rows, steps=n) for n in (1, 3))),
    "violent": group(lambda quick: chunks(contact_scenes.flown, 40 if quick else 2000, 50), contact_scenes.flight_rows),
    "descent": both(group(lambda quick: chunks(contact_scenes.risen, 10 if quick else 300, 10),
                          contact_scenes.descent_rows), group(lambda quick: every(floor_descent, subspace=WAYS))),
    "ball": group(lambda quick: every(ball, **(FEWER if quick else BALLS), sweeps=[20])),
    "pressed": group(lambda quick: every(pressed, ways=PRESSES[: 1 if quick else 3], sweeps=[20])),
    "motion": group(motion),
    "borne": group(borne),
    "flat": group(flats),
    "crowd": both(group(lambda quick: every(crowd, sweeps=[8] if quick else [8, 20], way=[*WAYS][: 1 if quick else 2])),
                  *(group(lambda quick, k=k: chunks(lost, 4 if quick else 150, 15, sweeps=k), lost_rows, sweeps=k)
                    for k in (8, 20))),
    "cost": group(lambda quick: every(cost, way=WAYS, quick=[quick]), alone=True),
}  # fmt: skip
THREADS, ANYWHERE = 1, True  # the scenes are too small for two threads
COLUMNS = ("gate", "case", "value", "reference", "bar", "met", "seconds", "note")
TABLES = (
    Table("Not met: {}", "*", COLUMNS, only=lambda made: not made["met"]),
    Table("All: {}", "*", COLUMNS),
)
