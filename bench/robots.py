"""Robots with soft bodies: kinematics, forces, gradients, the limit of slip, and beams that a gripper lifts.

"kinematics": poses of links beside those of yourdfpy and mujoco; joint torques of contact beside the derivative of the
barriers' potential. "gradient": an arm with a hand of two fingers moves at random for four steps, touches a soft box
and rubs along it. Derivatives of a random linear function of the end state along one random direction of each argument
are compared with central differences; scenes are drawn until 50 of them are smooth for all arguments, those at a kink
are counted. Errors are relative to the derivative along that direction. "slip": two fingers hold a soft block with
which a weight G pulls down. Smoothed friction bears load up to its velocity and no more beyond, so the block is held if
it creeps more slowly than that in the last 0.2 s. Bisection over the closing of the fingers finds the least normal
force at which it does: G / (2 mu_f) in closed form. "beams": random ones that slip from the fingers, or stay on the
ground, at the start; Rprop, which takes the sign of the derivative, finds the closing. They are then held for another
0.6 s. Wrenches of the fingers on them, and the force on the joint that lifts, are means of the last 20 steps, since a
beam that creeps over an edge of a finger jolts. What they lack of the weight is relative to it, in torques about the
center of mass to that times half the width.
"""

from __future__ import annotations

import importlib
import math
import tempfile
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

import diffvbd as dv
from bench import common
from bench.measure import Card
from bench.tables import Table
from diffvbd import losses, results, robots
from diffvbd.tasks import lift
from diffvbd.testing.robot_scenes import ARM_MJCF, ARM_URDF, barrier_energy

Row = dict[str, Any]
SEED, F64 = 2911, torch.float64

# --- kinematics -------------------------------------------------------------------------------------------------------


def kinematics(card: Card) -> list[Row]:
    """Largest differences of poses over random joint positions, and of J^T f relative to the largest of its entries."""
    import yourdfpy

    mujoco: Any = importlib.import_module("mujoco")

    rng, count = np.random.default_rng(SEED), 5 if card.quick else 200
    arm, other = robots.loads(ARM_URDF), robots.loads(ARM_MJCF)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "arm.urdf"
        file.write_text(ARM_URDF, encoding="utf-8")
        urdf = yourdfpy.URDF.load(str(file), load_meshes=False)
    m: Any = mujoco.MjModel.from_xml_string(ARM_MJCF)
    d, worst = mujoco.MjData(m), [0.0, 0.0]
    for q in rng.normal(size=(count, 3)) * 0.5:
        urdf.update_cfg(dict(zip(arm.joints, q, strict=True)))
        expected = np.stack([urdf.get_transform(name) for name in arm.links])
        worst[0] = max(worst[0], float(np.abs(arm.frames(torch.from_numpy(q)).numpy() - expected).max()))
        for name, value in zip((*other.joints, "follow"), (*q, 0.01 + 0.002 + 0.5 * q[2]), strict=True):
            d.joint(name).qpos[:] = value
        mujoco.mj_kinematics(m, d)
        frames = other.frames(torch.from_numpy(q)).numpy()
        for k, name in enumerate(other.links):
            own = (
                np.abs(frames[k, :3, :3] - d.body(name).xmat.reshape(3, 3)),
                np.abs(frames[k, :3, 3] - d.body(name).xpos),
            )
            worst[1] = max(worst[1], *(float(part.max()) for part in own))
    errors = []
    for number in range(2 if card.quick else 20):
        s = Drawn(number)
        q, about = s.path[-1], torch.from_numpy(rng.normal(size=3))
        torques = arm.torques(q, dv.contact.forces(s.model, s.x, colliders=arm(q), about=about), about)
        for way in torch.eye(3, dtype=F64):
            ends = [(barrier_energy(s.model, s.x, arm(q + e * way)) - barrier_energy(s.model, s.x, arm(q - e * way)))
                    / (2 * e) for e in (1e-6, 1e-7, 1e-8)]  # fmt: skip
            errors.append(min(float((torques @ way + slope).abs() / torques.abs().max()) for slope in ends))
    return [
        {"what": "poses of URDF links beside yourdfpy's [m, -]", "cases": count, "value": worst[0], "bar": 1e-12},
        {"what": "poses of MJCF links beside mujoco's [m, -]", "cases": count, "value": worst[1], "bar": 1e-12},
        {"what": "J^T f beside the derivative of the barriers' energy", "cases": len(errors), "value": max(errors),
         "bar": 1e-6},
    ]  # fmt: skip


# --- gradients --------------------------------------------------------------------------------------------------------

ARGUMENTS = ("joints", "x", "v", "mu", "friction")
WAYS = (0.01, 0.01, 1.0)  # lengths of directions of joints [rad, m], x [m] and v [m/s]
SIZES = (1e-4, 1e-5, 1e-6, 1e-7, 1e-8)  # of differences, times those
SMOOTH, ALIKE, EXACT = 3e-3, 2e-6, 1e-5  # as bench.contact_scenes; the bar
STEPS = 4


class Drawn:
    """A soft box between the fingers of an arm, a random motion of its joints, and the other arguments of a rollout."""

    def __init__(self, number: int) -> None:
        rng = np.random.default_rng((SEED, number))
        self.robot = robots.loads(ARM_URDF)
        points, size = rng.integers(2, 5, 3), rng.uniform(0.03, 0.06, 3)
        box, dhat = dv.mesh.box(tuple(points.tolist()), tuple(size.tolist())), 0.003
        gap = float(rng.uniform(0.6, 0.9)) * dhat
        start = np.array([rng.uniform(-0.1, 0.1), rng.uniform(-0.5, 0.5), 0.07 - size[0] / 2 - gap])
        # in the frame of the hand; turned, since almost parallel edges make a motion steep, as exactly parallel ones
        # make it kinked
        w = np.array([rng.uniform(0.2, 0.6), *(0.01 * rng.normal(size=2))]) @ np.cross(np.eye(3), np.eye(3)[:, None])
        turn = torch.linalg.matrix_exp(torch.from_numpy(w)).numpy()
        own = (box.points - size / 2) @ turn.T + 0.01 * size * rng.normal(size=box.points.shape) * (0, 1, 1)
        hand = self.robot.frames(torch.from_numpy(start))[self.robot.links.index("hand")].numpy()
        own = (own + (0.0, -0.06 + rng.uniform(-0.01, 0.01), 0.0)) @ hand[:3, :3].T + hand[:3, 3]
        coefficient = float(rng.uniform(0.2, 1.0))
        matrix = coefficient * (1 + 0.2 * rng.random((6, 6)))  # of the box and five links
        energies = (dv.StableNeoHookean(), dv.PairBarrier(float(10 ** rng.uniform(2, 3)), dhat, self_contact=False),
                    dv.Friction(torch.from_numpy(matrix) if number % 2 else coefficient, 0.005))  # fmt: skip
        self.model = dv.Model(dv.TetMesh(own, box.tets), energies=energies, colliders=self.robot.colliders)
        self.x = self.model.rest_points
        moves = rng.normal(size=(STEPS, 3)) * (3e-4, 0.002, 0.0) + (0, 0, 3e-4) * rng.random((STEPS, 3))
        self.path = torch.from_numpy(start + np.cumsum(np.vstack([np.zeros(3), moves]), 0))  # [STEPS + 1, 3]
        self.solver = dv.VBD(float(rng.uniform(0.004, 0.01)), int(rng.choice([5, 10, 20])))
        modulus = float(10 ** rng.uniform(4, 5.5))
        self.given = {"lam": 2 * modulus, "gravity": (0.0, -9.81, 0.0)}
        self.arguments = (
            self.path,
            self.x,
            torch.from_numpy(0.1 * rng.normal(size=self.x.shape)),
            torch.tensor(modulus, dtype=F64),
            torch.as_tensor(energies[2].coefficient, dtype=F64),
        )
        self.weights = torch.from_numpy(rng.normal(size=(2, *self.x.shape)))
        sizes = (*WAYS, modulus, coefficient)
        self.ways = [size * torch.from_numpy(np.asarray(rng.normal(size=tuple(t.shape))))
                     for size, t in zip(sizes, self.arguments, strict=True)]  # fmt: skip

    def end(self, path: Tensor, x: Tensor, v: Tensor, mu: Tensor, friction: Tensor) -> results.Trajectory:
        def at(step: int, x: Tensor, v: Tensor) -> Tensor:
            return self.robot(path[step + 1])

        return dv.rollout(self.model, x, v, self.solver, steps=STEPS, colliders=at,
                          colliders_before=self.robot(path[0]), mu=mu, friction=friction,
                          checks=dv.Checks(start=False), **self.given)  # fmt: skip

    def loss(self, *arguments: Tensor) -> Tensor:
        end = self.end(*arguments)
        return (self.weights[0] * end.x[-1]).sum() + 0.01 * (self.weights[1] * end.v[-1]).sum()

    def touched(self) -> tuple[int, bool]:
        """How many fingers press at the end, and whether friction acts."""
        end, (path, *_, friction) = self.end(*self.arguments), self.arguments
        forces = dv.contact.forces(self.model, end.x[-1], self.solver, previous=(end.x[-2], end.v[-2]),
                                   friction=friction, colliders=self.robot(path[-1]),
                                   colliders_before=self.robot(path[-2]))  # fmt: skip
        fingers = [self.robot.links.index(name) for name in ("left", "right")]
        return int((forces.colliders.normal[0, fingers].norm(dim=-1) > 0).sum()), bool(forces.vertices.tangential.any())


def slope_errors(number: int) -> Row:
    """Relative error of the derivative along a direction of each argument, and None for those at a kink."""
    torch.set_num_threads(1)
    s, out = Drawn(number), {}
    leaves = [t.clone().requires_grad_() for t in s.arguments]
    here = s.loss(*leaves)
    slopes = [float((g * d).sum()) for g, d in zip(torch.autograd.grad(here, leaves), s.ways, strict=True)]
    with torch.no_grad():
        for k, (name, slope) in enumerate(zip(ARGUMENTS, slopes, strict=True)):
            found = []
            for e in SIZES:
                ahead, back = (float(s.loss(*s.arguments[:k], s.arguments[k] + q * s.ways[k], *s.arguments[k + 1 :]))
                               for q in (e, -e))  # fmt: skip
                bend = abs(ahead - 2 * float(here) + back) / e
                found.append((ahead - back) / (2 * e) if bend <= SMOOTH * abs(slope) else math.nan)
            alike = [(a, b) for a, b in pairwise(found) if abs(a - b) <= ALIKE * abs(a)]
            out[name] = min((min(abs(a - slope), abs(b - slope)) / abs(a) for a, b in alike), default=None)
    fingers, rubs = s.touched()
    return {"scene": number, "fingers": fingers, "rubs": rubs, **out}


def gradient(card: Card) -> list[Row]:
    wanted, rows = 3 if card.quick else 50, []
    tried = range(5 if card.quick else 76)
    rows = sorted((row for _, row in common.side_by_side(slope_errors, tried, at_once=not card.quick)),
                  key=lambda row: row["scene"])  # fmt: skip
    smooth = [row for row in rows if row["fingers"] and row["rubs"] and None not in row.values()][:wanted]
    last = smooth[-1]["scene"] if smooth else len(rows) - 1
    return [{"argument": name, "scenes": len(smooth), "bar": EXACT, "value": max(row[name] for row in smooth),
             "both_fingers": sum(row["fingers"] == 2 for row in smooth), "drawn": last + 1,
             "at_a_kink": sum(row[name] is None for row in rows[: last + 1]),
             "worst_of_all_drawn": max(row[name] or 0.0 for row in rows[: last + 1])}
            for name in ARGUMENTS]  # fmt: skip


# --- the limit of slip ------------------------------------------------------------------------------------------------

BLOCK, HEAVY, CREEP = 0.022, 2500.0, 5e-3  # edge of the block [m]; [kg/m^3]; below which friction is smoothed [m/s]
WINDOWS = (0.2, 0.1, 0.3)  # in which the fingers close, the pull comes, and it stays [s]
SLIP = {  # by case: friction, Young's modulus [Pa], pull besides the weight [N]
    "weight, mu_f = 0.5": (0.5, 2e5, 0.0),
    "weight, mu_f = 0.2": (0.2, 2e5, 0.0),
    "weight, mu_f = 1": (1.0, 2e5, 0.0),
    "softer": (0.5, 5e4, 0.0),
    "pulled down by 0.5 N": (0.5, 2e5, 0.5),
}


@torch.no_grad()
def slip(card: Card) -> list[Row]:
    """The least force at which fingers hold a block, all cases at once."""
    names = list(SLIP)[:2] if card.quick else list(SLIP)
    mu, young, load = torch.tensor([SLIP[name] for name in names], dtype=F64).T
    grip = lift.Grip(dv.mesh.box(3, BLOCK), density=HEAVY, velocity=CREEP, height=0.5 * BLOCK + 0.004)
    load = load + grip.weight
    solver, count = dv.VBD(0.01, 20 if card.quick else 40), len(names)
    ramp = lift.smooth_steps(WINDOWS, 0.01, mu)
    share = (grip.model.mass / grip.model.mass.sum())[:, None] * torch.tensor([0.0, -1.0, 0.0], dtype=F64)
    force = ramp[1:, 1, None, None, None] * load[:, None, None] * share
    given = {"friction": mu, "young": young[:, None], "floor_height": torch.tensor([-1e3], dtype=F64)}

    def held(closing: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        q = grip.positions(ramp[:, :1] * closing, torch.zeros_like(ramp[:, :1] * closing))
        end = grip.rollout(q, solver, force=dv.per_step(force), gravity=(0.0, 0.0, 0.0), **given)
        forces = grip.forces(q, end, solver, friction=mu, floor_height=given["floor_height"])
        speeds = -end.v[..., 1] @ grip.model.mass / grip.model.mass.sum()
        return (
            speeds[-20:].max(0).values,
            forces.colliders.normal[:, 0, :, 0].abs().mean(-1),
            forces.colliders.total[:, 0, :, 1].sum(-1),
        )

    low, high = torch.zeros(count, dtype=F64), torch.full((count,), 4e-3, dtype=F64)
    for _ in range(12 if card.quick else 14):
        middle = 0.5 * (low + high)
        speed, _, _ = held(middle)
        low, high = torch.where(speed < CREEP, low, middle), torch.where(speed < CREEP, middle, high)
    (slow, least, carried), (fast, most, _) = held(high), held(low)
    expected = load / (2 * mu)
    return [{"case": name, "value": float(least[k]), "closed_form": float(expected[k]), "bar": 0.01,
             "error": float(least[k] / expected[k] - 1), "just_slips_at": float(most[k]), "creep": float(slow[k]),
             "slip": float(fast[k]), "carried": float(carried[k] / load[k])}
            for k, name in enumerate(names)]  # fmt: skip


# --- beams that are lifted --------------------------------------------------------------------------------------------

FIRM, LOOSER, TRIES = 1.8, 0.8, 8  # the start is loosened from a closing [mm] by a factor; evaluations of the loss
HOLD, REST = 0.6, 20  # beyond the windows of the task, for the balance [s]; steps over which it is a mean


def beam(number: int, quick: bool = False) -> Row:
    """The closing of the fingers that lifts a random beam, found from one that does not, and how it then hangs."""
    torch.set_num_threads(1)
    rng = np.random.default_rng((SEED, 7, number))
    size = rng.uniform((0.024, 0.024, 0.08), (0.036, 0.036, 0.16))
    young, density, friction = (
        float(10 ** rng.uniform(4.5, 5.3)),
        float(rng.uniform(500, 1200)),
        float(rng.uniform(0.3, 0.9)),
    )
    along = 5 if quick else 7
    grip = lift.Grip(dv.mesh.box((3, 3, along), tuple(size.tolist())), friction, density)
    solver = dv.VBD(0.01, 40)

    def path(closing: Tensor, hold: float = 0.0) -> Tensor:
        steps = lift.smooth_steps((*lift.WINDOWS[:2], lift.WINDOWS[2] + hold), 0.01, closing)
        return grip.positions(1e-3 * closing * steps[:, 0], lift.RISE * steps[:, 1])

    def risen(closing: Tensor) -> tuple[Tensor, Tensor]:
        return grip.height(grip.rollout(q := path(closing), solver, young=young).x), q[:, 0]

    start = torch.tensor(FIRM, dtype=F64)
    with torch.no_grad():
        while risen(start)[0][-1] > 0.1 * lift.RISE:
            start *= LOOSER
    closing, course = start.clone().requires_grad_(), []
    optimizer = torch.optim.Rprop([closing], lr=0.1)
    for _ in range(TRIES):
        rise, hand = risen(closing)
        # of all steps: a beam that is dropped ends on the ground, however far it came
        loss = ((rise - hand) / lift.RISE).square().mean() + lift.SQUEEZE * (2e-3 * closing / grip.width).square()
        optimizer.zero_grad()
        loss.backward()
        course.append((float(loss.detach()), float(closing.detach()), float(rise[-1].detach())))
        optimizer.step()
    best, q = min(course), path(torch.tensor(min(course)[1], dtype=F64), HOLD)
    with torch.no_grad():
        end = grip.rollout(q, finer := dv.VBD(0.01, 100), young=young)
        center = losses.center_of_mass(end.x[-1], grip.model.mass)
        wrenches = []
        for k in range(len(q) - REST, len(q)):
            forces = grip.forces(q, end, finer, k, about=center)
            joint = grip.robot.torques(q[k], forces, center)[:1]
            wrenches.append(torch.cat([forces.colliders.total[0].sum(0), forces.colliders.torque[0].sum(0), joint]))
        total, torque, on_lift = torch.stack(wrenches).mean(0).split((3, 3, 1))
        speed = float(losses.center_of_mass(end.v[-1], grip.model.mass).norm())
        normal = float(grip.forces(q, end, finer).colliders.normal[0, :, 0].abs().mean())
    rise = float(grip.height(end.x[-1]))
    up = torch.tensor([0.0, grip.weight, 0.0], dtype=F64)
    return {"beam": number, "size": size, "young": young, "density": density, "friction": friction,
            "closing_at_start": course[0][1], "rise_at_start": course[0][2], "closing": best[1], "rise": rise,
            "speed": speed, "of_the_limit": normal / (grip.weight / (2 * friction)),
            "lifted": course[0][2] < 0.1 * lift.RISE and rise > 0.8 * lift.RISE and speed < lift.VELOCITY,
            "force": float((total - up).norm()) / grip.weight,
            "torque": float(torque.norm()) / (grip.weight * grip.width / 2),
            "lift_joint": abs(float(on_lift) / grip.weight + 1)}  # fmt: skip


def beams(card: Card) -> list[Row]:
    numbers = range(1 if card.quick else 20)
    rows = [row for _, row in common.side_by_side(beam, numbers, card.quick, at_once=not card.quick)]
    return sorted(rows, key=lambda row: row["beam"])


GROUPS = {"kinematics": kinematics, "gradient": gradient, "slip": slip, "beams": beams}
THREADS = 1  # the scenes are too small for two threads
TABLES = (
    Table("Kinematics", "kinematics", ("what", "cases", "value", "bar")),
    Table("Gradients through robot, contact and friction", "gradient", {
        "derivative by": "argument", "scenes": "scenes", "both fingers touch in": "both_fingers",
        "largest error": "value", "bar": "bar", "scenes drawn": "drawn", "of these at a kink": "at_a_kink",
    }),
    Table("Normal force at which slip begins", "slip", {
        "case": "case", "found [N]": "value", "closed form [N]": "closed_form", "error": "error", "bar": "bar",
        "slips at [N]": "just_slips_at", "creep [m/s]": "creep", "carried over the weight": "carried",
    }),
    Table("Beams that are lifted", "beams", {
        "beam": "beam", "Young's modulus [Pa]": "young", "density [kg/m^3]": "density", "friction": "friction",
        "rise at the start [m]": "rise_at_start", "rise [m]": "rise", "squeeze over the limit of slip": "of_the_limit",
        "lifted": "lifted", "force off balance": "force", "torque off balance": "torque", "lift joint": "lift_joint",
    }),
)  # fmt: skip
