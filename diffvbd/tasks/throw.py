"""Throw a soft ball into a box with a stretched sheet (a task that the paper does not have).

A sheet of 1 x 0.7 m is clamped 1 m above the floor; each spline has four control points. The loss is the squared
distance, 0.9 s after the start, from the ball's center of mass to the middle of the opening of a box, 1.1 m ahead and
0.3 m aside, and a little of the mean squared acceleration of the ends, which is what remains of it. At the end the
throw is simulated for twice the time with the walls of the box and the floor; the ball is caught if all of it is inside
then.

Choices: the sheet is 3 cm thick, of 1e5 Pa, and stretched by 15 % along x: without that the ball sinks 3 cm deeper, and
where it lands depends three times as strongly on the motion. The ball has a radius of 0.12 m and 3e4 Pa; both have 200
kg/m^3. h = 1/200 s; K = 10 sweeps. dhat is 5 cm, more than contact itself needs. The throw begins at once: where the
ball first rests on the sheet for 0.3 s, without damping, 2 mm of the control points move the landing by 6 cm, and Adam
gets no closer than 0.8 m. Walls are left out of the optimisation: the loss does not ask what comes after the opening.
The sweeps start from the predictor, as in the paper's tasks.
"""

from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor

import diffvbd as dv
from diffvbd import losses, results, viz
from diffvbd.tasks.optimizer import lbfgs
from diffvbd.tasks.problem import Problem, Row, Settings, Stage

SIZE, THICKNESS = (1.0, 0.7), 0.03  # of the sheet [m]
STRETCH = 1.15  # of the sheet between the bars
HEIGHT = 1.0  # of the sheet's middle at the start [m]
RADIUS, GAP = 0.12, 0.035  # of the ball; between ball and sheet at the start [m]
SHEET, BALL = 1e5, 3e4  # mu = lam [Pa]
DENSITY = 200.0  # [kg/m^3]
TIME_STEP, SWEEPS = 1 / 200, 10  # [s]
LANDING = 0.9  # [s]
KAPPA, DHAT, DAMPING, REACH = 300.0, 0.05, 5.0, 0.12  # [N/m], [m], [N s/m], [m]
CONTROLS, KNOT = 4, 0.06  # control points of an end, and the time between them [s]
LIMIT = 0.4  # largest control point [m]
LIFT = (0.3, 0.1)  # second control point of the ends of the rear and the front bar at the start [m]
BOX = ((1.35, 0.0, 0.4), (1.85, 0.4, 0.9))  # two corners [m]
VIEW = (35.0, 20.0)  # into the box
TOLERANCE = 5e-5  # of the gradient, over the first one: some 0.1 mm from the target
EFFORT = 1e-7  # weight of the squared acceleration of the ends [s^4]


class Version(NamedTuple):
    """Numbers that the quick version changes."""

    nx: int  # vertices of the sheet along its sides
    ny: int
    time_step: float
    evaluations: int


FULL, QUICK = Version(9, 7, TIME_STEP, 25), Version(7, 5, 1 / 150, 8)


def problem(settings: Settings) -> Problem:
    version = QUICK if settings.quick else FULL
    throw = Throw(settings, version)
    return Problem(
        name="throw",
        parameters={"ends": throw.raw},
        # it ends at the target: L-BFGS would go on to trade distance for less effort, by long ways
        stages=[Stage(throw.loss, version.evaluations, optimizer=lbfgs, gradient_tolerance=TOLERANCE, capturable=True)],
        estimates=throw.estimates,
        units={"miss": "m"},
        protocol={"vertices": throw.model.num_vertices, "tets": throw.model.num_tets, "steps": throw.steps,
                  "time_step": version.time_step, "sweeps": SWEEPS, "density": DENSITY, "sheet": SHEET, "ball": BALL,
                  "stretch": STRETCH, "kappa": KAPPA, "dhat": DHAT, "damping": DAMPING, "reach": REACH,
                  "controls": CONTROLS, "knot": KNOT, "limit": LIMIT, "lift": LIFT, "box": BOX, "effort": EFFORT},
        findings=throw.findings,
        picture=throw.picture,
        animation=throw.animation,
    )  # fmt: skip


class Throw:
    """Sheet and ball, and the motion of the sheet's four ends, which is looked for."""

    def __init__(self, settings: Settings, version: Version) -> None:
        self.device, self.time_step = settings.device, version.time_step
        self.steps = round(LANDING / version.time_step)
        self.sheet = sheet = dv.mesh.sheet(version.nx, version.ny, SIZE, THICKNESS)
        self.mesh = with_ball(sheet)
        self.part = slice(sheet.num_vertices, None)  # the ball's vertices
        along = sheet.points[:, 0] / SIZE[0]
        self.pinned = np.zeros(self.mesh.num_vertices, bool)
        self.pinned[: sheet.num_vertices] = (along == 0.0) | (along == 1.0)
        self.barrier = dv.PairBarrier(KAPPA, DHAT, self_contact=False, damping=DAMPING, detections=1, reach=REACH)
        self.model = self.model_of()
        like = {"dtype": self.model.dtype, "device": self.model.device}

        self.x = self.model.rest_points.clone()
        self.x[: sheet.num_vertices, 0] += (STRETCH - 1) * (self.x[: sheet.num_vertices, 0] - SIZE[0] / 2)
        self.mu = torch.full((self.mesh.num_tets,), SHEET, **like)
        self.mu[sheet.num_tets :] = BALL
        self.middle = torch.tensor([(BOX[0][0] + BOX[1][0]) / 2, BOX[1][1], (BOX[0][2] + BOX[1][2]) / 2], **like)
        times = version.time_step * torch.arange(1, 2 * self.steps + 1, dtype=torch.float64)
        self.curve = spline(times, CONTROLS, KNOT).to(**like)
        self.lifts = lifts(sheet, self.pinned).to(**like)
        self.walls = viz.box(*BOX)

        self.start = torch.zeros((CONTROLS, 4), **like)
        self.start[1] = torch.tensor(LIFT, **like).repeat_interleave(2) / LIMIT
        self.raw = self.start.atanh().requires_grad_()
        self.landed = self.x.new_zeros(3)  # the ball's center by the latest loss
        self.motions: dict[str, Tensor] = {}  # of the findings, for pictures

    def model_of(self, *others: Any, **more: Any) -> dv.Model:
        """Sheet and ball, with other energies and arguments of the Model besides their own."""
        energies = (dv.StableNeoHookean(), *others, self.barrier)
        model = dv.Model(self.mesh, energies=energies, density=DENSITY, pinned=self.pinned, **more)
        return model.to(self.device)

    def heights(self, raw: Tensor) -> Tensor:
        """Of the ends above where they start [m], shape [2 steps, 4]."""
        return self.curve @ (LIMIT * raw.tanh())

    def simulate(
        self, raw: Tensor, model: dv.Model, steps: int, save: Literal["all", "last"] = "last"
    ) -> results.Trajectory:
        bars = self.x + (self.heights(raw)[:steps] @ self.lifts.flatten(1)).unflatten(-1, (-1, 3))
        solver = dv.VBD(self.time_step, SWEEPS, start="predictor")
        return dv.rollout(model, self.x, torch.zeros_like(self.x), solver, steps=steps, save=save,
                          checkpoint_every=None, mu=self.mu, lam=self.mu, prescribed=dv.per_step(bars))  # fmt: skip

    def loss(self) -> Tensor:
        ball = self.simulate(self.raw, self.model, self.steps).x[-1, self.part]
        center = losses.center_of_mass(ball, self.model.mass[self.part])
        self.landed.copy_(center.detach())
        acceleration = self.heights(self.raw).diff(n=2, dim=0) / self.time_step**2
        return losses.vertex_distance(center, self.middle) + EFFORT * acceleration[: self.steps].square().mean()

    def estimates(self) -> Row:
        return {"miss": (self.landed - self.middle).norm().item()}

    @torch.no_grad()
    def with_walls(self, raw: Tensor) -> Tensor:
        """The same throw with walls and floor, for twice the time; positions [m], shape [2 steps + 1, V, 3]."""
        obstacle = dv.colliders.Obstacle(self.walls.points, self.walls.triangles)
        room = self.model_of(dv.FloorBarrier(kappa=KAPPA, dhat=DHAT), colliders=[obstacle])
        return self.simulate(raw, room, 2 * self.steps, "all").x

    def findings(self, history: list[Row]) -> dict[str, Any]:
        self.motions.update(initial=self.with_walls(self.start.atanh()), recovered=self.with_walls(self.raw))
        at_start, at_end = (inside(motion[-1, self.part], BOX) for motion in self.motions.values())
        return {"caught": at_end, "caught_at_start": at_start}

    def picture(self, path: Path, history: list[Row]) -> None:
        steps = self.steps
        shown = [steps // 4, steps // 2, 3 * steps // 4, steps, 2 * steps]
        frames = {name: motion[shown] for name, motion in self.motions.items()}
        times = [k * self.time_step for k in shown]
        viz.comparison(path, self.mesh.surface, frames, times, history, scenery=[self.walls], view=VIEW)

    def animation(self, path: Path) -> None:
        motions = {"recovered": self.motions["recovered"]}
        viz.animation(path, self.mesh.surface, motions, self.time_step, [self.walls], VIEW)


def with_ball(sheet: dv.TetMesh) -> dv.TetMesh:
    """Sheet and ball, in this order, at the height of the throw."""
    ball = dv.mesh.capsule(RADIUS, 0.0, resolution=3)
    # not in the middle of a vertex or an edge of the sheet, where several pairs would be nearest at once
    above = (SIZE[0] / 2 + 0.003, THICKNESS / 2 + GAP - ball.points[:, 1].min(), SIZE[1] / 2 + 0.002)
    return dv.mesh.join([sheet, ball.translate(above)]).translate((0.0, HEIGHT, 0.0))


def lifts(sheet: dv.TetMesh, pinned: np.ndarray) -> Tensor:
    """Motion of the vertices of the bars for a unit of each end, shape [4, V, 3]; `pinned`: these vertices [V]."""
    along, across = (torch.from_numpy(sheet.points[:, k] / SIZE[k // 2]) for k in (0, 2))
    ends = [(1 - along) * (1 - across), (1 - along) * across, along * (1 - across), along * across]
    out = torch.zeros((4, len(pinned), 3), dtype=torch.float64)
    out[:, : sheet.num_vertices, 1] = torch.stack(ends)
    out[:, torch.from_numpy(~pinned)] = 0.0
    return out


def spline(times: Tensor, controls: int, knot: float) -> Tensor:
    """Weights [times, controls] of a uniform cubic B-spline that leaves 0 at time 0 and returns there, both at rest.

    Control point j has the most weight, 2/3, at time (j + 2) knot, and none two knots away.
    """
    away = (times[:, None] / knot - torch.arange(2, controls + 2).to(times)).abs()
    return torch.where(away < 1, 2 / 3 - away**2 + away**3 / 2, (2 - away).clamp(min=0) ** 3 / 6)


def inside(points: Tensor, box: tuple[tuple[float, ...], tuple[float, ...]]) -> bool:
    """True if all points [V, 3] are between two corners [m]."""
    low, high = torch.tensor(box, dtype=points.dtype, device=points.device)
    return bool(((points > low) & (points < high)).all())
