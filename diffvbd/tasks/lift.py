"""Lift a soft beam with the two fingers of a robot (a task that the paper does not have).

A beam of 14 x 3 x 3 cm lies on the ground between the fingers of a gripper, a URDF robot. Looked for
is how the fingers close and how the hand rises: where both are at the ends of three windows, six numbers, with smooth
steps between them. The loss is the mean over all steps of the squared distance, as a share of 3 cm, between the height
of the beam's center of mass and a smooth step to 3 cm in the second window, and twice the mean squared share of its
width by which the fingers close after they begin to touch. Fingers hold a body of weight G if each presses with at
least G / (2 mu_f). At the start the hand rises by 3 cm, but the fingers press with less, and the beam stays on the
ground.

Choices: 1.5e4 Pa, Poisson's ratio 0.4, 1000 kg/m^3, mu_f = 0.5. Windows of 0.25 s, 0.25 s and 0.15 s in steps of 10 ms;
K = 40. All steps count in the loss, since a beam that is dropped ends on the ground, however far it came. The ground is
soft: it bears the beam at a gap of 6 mm, so that a beam that is half carried lies higher, and the gradient tells so.
The fingers are turned by 20 degrees: where edges of bodies are almost parallel, the motion hangs on tiny changes, and
the slope of the loss, though exact, was up to 1e8 per mm.
"""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

import diffvbd as dv
from diffvbd import losses, results, robots, viz
from diffvbd.robots.gripper import gripper as two_fingers
from diffvbd.tasks.problem import Problem, Row, Settings, Stage

PAD = (0.02, 0.04, 0.04)  # size of a finger [m]
CLEAR = 0.028  # height of the fingers' middle at which their corners just clear the ground [m]
OPEN = 0.1  # between the fingers at the position 0 [m]
SIZE, DENSITY = (0.03, 0.03, 0.14), 1000.0  # of the beam [m]; [kg/m^3]
YOUNG, POISSON, FRICTION = 1.5e4, 0.4, 0.5  # [Pa]
VELOCITY = 0.005  # below which friction is smoothed [m/s]
KAPPA, DHAT = 500.0, 0.002  # [J/m^2], [m]
SOFT = 0.01  # dhat of the ground [m]
RISE = 0.03  # [m]
WINDOWS = (0.25, 0.25, 0.15)  # [s]
SQUEEZE = 0.5  # weight in the loss
UNITS = (1e-3, 5e-3)  # of the parameters, closing and rise [m]
VIEW = (15.0, -50.0)
TILT = 0.35  # of the fingers [rad]: edges that are parallel to edges of a body would be at ties


def gripper(height: float) -> robots.Robot:
    """The gripper, with its joints lift and close; the middle of the fingers at a height [m]."""
    base = torch.eye(4, dtype=torch.float64)
    base[1, 3] = height
    return two_fingers(PAD, OPEN, base, rise=0.5, travel=0.05, tilt=TILT)


class Grip:
    """A body that lies on the ground, between the fingers of the gripper.

    Args:
        body: Its mesh; it is moved to the ground and the fingers' middle, but for a per cent of its size.
        friction: Coefficient, one number or a matrix of the body, both fingers and the ground.
        density: [kg/m^3].
        velocity: Sliding speed below which friction is smoothed [m/s].
        height: Of the fingers' middle at the start [m].
    """

    def __init__(self, body: dv.TetMesh, friction: Any = FRICTION, density: float = DENSITY,
                 velocity: float = VELOCITY, height: float = CLEAR, device: str = "cpu") -> None:  # fmt: skip
        low, high = body.points.min(0), body.points.max(0)
        self.width = float(high[0] - low[0])
        # exactly between the fingers it would be at ties, which have no useful gradient
        middle = 0.01 * (high - low) * (1, 0, 1) - 0.5 * (low + high) * (1, 0, 1)
        self.mesh = body.translate(middle + (0.0, 0.63 * SOFT - low[1], 0.0))
        lowest = int((body.points[:, 1] < low[1] + 0.1 * SOFT).sum())
        self.weight = 9.81 * float(dv.Model(self.mesh, density).mass.sum())  # [N]
        ground = self.weight / (0.56 * SOFT * lowest)  # which bears the weight at gaps of 0.63 dhat
        self.robot = gripper(height)
        energies = (dv.StableNeoHookean(), dv.FloorBarrier(kappa=ground, dhat=SOFT),
                    dv.PairBarrier(KAPPA, DHAT, self_contact=False), dv.Friction(friction, velocity))  # fmt: skip
        self.model = dv.Model(self.mesh, density, energies=energies, colliders=self.robot.colliders).to(device)

    def positions(self, closing: Tensor, rise: Tensor) -> Tensor:
        """Joint positions [..., 2] where the fingers have closed by so much from where they begin to touch [m]."""
        touch = 0.5 * (OPEN - self.width) - DHAT - 0.01 * self.width
        return torch.stack([rise, touch + closing], -1)

    def rollout(self, q: Tensor, solver: dv.VBD, save: Any = "all", **inputs: Any) -> results.Trajectory:
        """From rest, as the joints go from q[0] through q[1:]; q: [steps + 1, 2] [m], or [steps + 1, B, 2]."""
        corners, x = self.robot(q), self.model.rest_points
        x = x.expand(*q.shape[1:-1], *x.shape)
        given = {"young": YOUNG, "poisson": POISSON, **inputs}
        return dv.rollout(self.model, x, torch.zeros_like(x), solver, steps=len(q) - 1, save=save,
                          colliders=dv.per_step(corners[1:]), colliders_before=corners[0], **given)  # fmt: skip

    def forces(self, q: Tensor, end: results.Trajectory, solver: dv.VBD, step: int = -1, **inputs: Any
               ) -> dv.contact.Forces:  # fmt: skip
        """Those at a frame of such a rollout, by default the last one."""
        before, after = self.robot(q[step - 1]), self.robot(q[step])
        return dv.contact.forces(self.model, end.x[step], solver, previous=(end.x[step - 1], end.v[step - 1]),
                                 colliders=after, colliders_before=before, **inputs)  # fmt: skip

    def height(self, x: Tensor) -> Tensor:
        """Of the center of mass above where it starts [m]; x: [..., V, 3]."""
        return losses.center_of_mass(x - self.model.rest_points, self.model.mass)[..., 1]


def smooth_steps(windows: tuple[float, ...], time_step: float, like: Tensor) -> Tensor:
    """Weights [steps + 1, windows] of increments, each of which comes in a window [s] of its own with no speed at its
    ends."""
    begins = np.cumsum([0.0, *windows])
    times = time_step * torch.arange(round(begins[-1] / time_step) + 1).to(like)[:, None]
    s = ((times - torch.from_numpy(begins[:-1]).to(like)) / torch.tensor(windows).to(like)).clamp(0, 1)
    return s * s * (3 - 2 * s)


class Version(NamedTuple):
    """Numbers that the quick version changes."""

    vertices: tuple[int, int, int]
    time_step: float
    sweeps: int
    evaluations: int


FULL, QUICK = Version((4, 4, 13), 0.01, 40, 40), Version((3, 3, 7), 0.0125, 16, 16)


def problem(settings: Settings) -> Problem:
    version = QUICK if settings.quick else FULL
    lift = Lift(settings, version)
    return Problem(
        name="lift",
        parameters={"closing": lift.closing, "rise": lift.rise},
        stages=[Stage(lift.loss, version.evaluations, learning_rate=0.15, capturable=True)],
        estimates=lift.estimates,
        units={"rise": "m", "squeezed": "m"},
        protocol={"vertices": lift.grip.model.num_vertices, "tets": lift.grip.model.num_tets,
                  "steps": len(lift.steps) - 1, "time_step": version.time_step, "sweeps": version.sweeps,
                  "windows": WINDOWS, "size": SIZE, "density": DENSITY, "young": YOUNG, "poisson": POISSON,
                  "friction": FRICTION, "kappa": KAPPA, "dhat": DHAT, "target": RISE, "squeeze": SQUEEZE},
        findings=lift.findings,
        picture=lift.picture,
        animation=lift.animation,
    )  # fmt: skip


class Lift:
    """Beam and gripper, and the motion of its joints, which is looked for."""

    def __init__(self, settings: Settings, version: Version) -> None:
        self.grip = Grip(dv.mesh.box(version.vertices, SIZE), device=settings.device)
        self.solver = dv.VBD(version.time_step, version.sweeps)
        like = self.grip.model.rest_points
        self.steps = smooth_steps(WINDOWS, version.time_step, like)
        self.start = torch.tensor([[1.3, 1.3, 1.3], [0.0, RISE / UNITS[1], RISE / UNITS[1]]]).to(like)
        self.closing, self.rise = (row.clone().requires_grad_() for row in self.start)
        self.found = like.new_zeros(2)  # rise and squeeze by the latest loss
        self.motions: dict[str, Tensor] = {}  # of the findings, for pictures

    def joints(self, closing: Tensor, rise: Tensor) -> Tensor:
        """Positions [steps + 1, 2] [m] that reach these at the ends of the windows [windows], within their limits."""
        paths = (unit * self.steps @ torch.cat([p[:1], p.diff()])
                 for unit, p in zip(UNITS, (closing, rise), strict=True))  # fmt: skip
        low, high = self.grip.robot.limits.to(self.steps).T
        return torch.maximum(torch.minimum(self.grip.positions(*paths), high), low)

    def loss(self) -> Tensor:
        grip = self.grip
        height = grip.height(grip.rollout(self.joints(self.closing, self.rise), self.solver).x)
        squeezed = 2 * UNITS[0] * self.closing
        self.found.copy_(torch.stack([height[-1], squeezed[-1]]).detach())
        away = height / RISE - self.steps[:, 1]
        return away.square().mean() + SQUEEZE * (squeezed / grip.width).square().mean()

    def estimates(self) -> Row:
        rise, squeezed = self.found.tolist()
        return {"rise": rise, "squeezed": squeezed}

    @torch.no_grad()
    def findings(self, history: list[Row]) -> dict[str, Any]:
        out: dict[str, Any] = {"slip_limit": self.grip.weight / (2 * FRICTION)}
        for name, (closing, rise) in {"initial": self.start, "recovered": (self.closing, self.rise)}.items():
            q = self.joints(closing, rise)
            end = self.grip.rollout(q, self.solver)
            forces = self.grip.forces(q, end, self.solver)
            self.motions[name] = torch.cat([end.x, self.grip.robot(q)], 1)  # beam and fingers
            out |= {f"{name}_squeeze": float(forces.colliders.normal[0, :, 0].abs().mean()),
                    f"{name}_carried": float(forces.colliders.total[0, :, 1].sum()) / self.grip.weight,
                    f"{name}_rise": float(self.grip.height(end.x[-1]))}  # fmt: skip
        return out

    def picture(self, path: Path, history: list[Row]) -> None:
        ends = [0, *np.rint(np.cumsum(WINDOWS) / self.solver.time_step).astype(int)]
        frames = {name: motion[ends] for name, motion in self.motions.items()}
        times = [float(k * self.solver.time_step) for k in ends]
        viz.comparison(path, self.surface(), frames, times, history, scenery=self.scenery(), view=VIEW)

    def surface(self) -> np.ndarray:
        """Triangles of the beam and the fingers [F, 3]."""
        grip = self.grip
        first = [grip.model.num_vertices + rows.start for rows in grip.robot.rows]
        links = [link.triangles + n for link, n in zip(grip.robot.colliders, first, strict=True)]
        return np.concatenate([grip.mesh.surface, *links])

    def scenery(self) -> list[Any]:
        return [viz.floor([-0.06, -0.08], [0.06, 0.08])]

    def animation(self, path: Path) -> None:
        viz.animation(path, self.surface(), {"recovered": self.motions["recovered"]}, self.solver.time_step,
                      self.scenery(), VIEW)  # fmt: skip
