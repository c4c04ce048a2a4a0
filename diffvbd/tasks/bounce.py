"""Throw a body so that it meets a target after its bounce (paper, section 6.5 and appendix "Task protocols").

Adam with gradient clipping moves the throw until the center of mass passes a target voxel. The loss is the squared
distance of the closest frame after the first contact and nothing else, so the criterion itself falls; a smooth minimum
over time would also pull at frames that need not be near. A run ends once the loss is 1e-5 of the first one, which is a
distance of 1 mm. The floor (y = 0) has kappa = 400 N/m and dhat = 5 cm, without friction and damping.

cube-bounce: A cube of 0.3 m, of 100 kg/m^3 and mu = lam = 2e5 Pa, is released at a height of 1 m and tilted. It starts
0.304 m from the target; the paper reaches 0.013 m in 151 iterations, along a path of 1.8 m. 200 steps of 4 ms; K = 20
solves these steps to 0.1 mm in the path of the center. The offset of the release is free.

bunny-bounce: `mesh.bunny`, 0.3 m high, 341 vertices and 1,155 tets (the paper's: 339 and 897), of 1000 kg/m^3 and mu =
lam = 2e4 Pa, released with its feet 0.3 m above the floor. It shall end within the paper's 0.034 m. 150 steps of 1/300
s; K = 10 is 3 mm from the path of 40 sweeps (a stiffer bunny needs more).
"""

import math
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

import diffvbd as dv
from diffvbd import losses, viz
from diffvbd.tasks.problem import Problem, Row, Settings, Stage

VOXEL = 0.05  # side of the target in pictures [m]; the distance is that to its center


@dataclass(frozen=True)
class Bounce:
    """A soft body that is released above the floor y = 0, and where it shall go."""

    mesh: dv.TetMesh  # where it is released, at rest
    target: tuple[float, float, float]  # where the center of mass shall pass after the first contact [m]
    density: float  # [kg/m^3]
    mu: float  # [Pa]
    lam: float
    time_step: float  # [s]
    steps: int
    sweeps: int  # of a step
    kappa: float = 400.0  # stiffness [N/m] and range [m] of the floor's barrier; a vertex below dhat is in contact
    dhat: float = 0.05
    device: str = "cpu"

    @cached_property
    def model(self) -> dv.Model:
        energies = (dv.StableNeoHookean(), dv.FloorBarrier(kappa=self.kappa, dhat=self.dhat))
        return dv.Model(self.mesh, density=self.density, energies=energies).to(self.device)

    @cached_property
    def goal(self) -> Tensor:
        """The target [3] on the device."""
        return self.tensor(self.target)

    def tensor(self, values: tuple[float, ...]) -> Tensor:
        return torch.tensor(values, dtype=self.model.dtype, device=self.model.device)

    def motion(self, offset: Tensor, velocity: Tensor) -> Tensor:
        """Positions [m] of all frames, shape [steps + 1, ..., V, 3], from the offset of the release [m] and the
        velocity of all vertices [m/s], shape [..., 3]; leading dimensions are scenes."""
        x = self.model.rest_points + offset.unsqueeze(-2)
        v = velocity.unsqueeze(-2).expand_as(x)
        solver = dv.VBD(self.time_step, self.sweeps)
        return dv.rollout(self.model, x, v, solver, steps=self.steps, mu=self.mu, lam=self.lam).x

    def squared_distances(self, motion: Tensor) -> Tensor:
        """From center of mass to target [m^2] in every frame, shape [steps + 1, ...]; infinite before first contact.

        A motion without contact counts from its lowest frame on.
        """
        centers = losses.center_of_mass(motion, self.model.mass)
        lowest = motion.detach()[..., 1].amin(-1)
        before = lowest.cummin(0).values > lowest.amin(0).clamp(min=self.dhat)
        return (centers - self.goal).square().sum(-1).masked_fill(before, math.inf)

    def squared_miss(self, offset: Tensor, velocity: Tensor) -> Tensor:
        """Squared distance [m^2] of the closest approach after the first contact, shape [...].

        Frames are chosen on the device, so that nothing waits for it; the gradient is that of the chosen frame.
        """
        return self.squared_distances(self.motion(offset, velocity)).amin(0)

    def protocol(self) -> dict[str, Any]:
        numbers = {key: value for key, value in asdict(self).items() if key not in ("mesh", "device")}
        return {"vertices": self.mesh.num_vertices, "tets": self.mesh.num_tets} | numbers


def problem(
    name: str,
    scene: Bounce,
    velocity: tuple[float, float, float],
    moves: tuple[str, ...],
    iterations: int,
    learning_rate: float,
    clip: float,
    tolerance: float,
) -> Problem:
    """The task: from a first velocity [m/s] and no offset, move the parameters named ("offset", "velocity")."""
    first = {"offset": scene.tensor((0.0, 0.0, 0.0)), "velocity": scene.tensor(velocity)}
    now = {key: value.clone().requires_grad_(key in moves) for key, value in first.items()}
    squared = torch.zeros_like(first["offset"][0])

    def loss() -> Tensor:
        value = scene.squared_miss(**now)
        squared.copy_(value.detach())
        return value

    @torch.no_grad()
    def findings(history: list[Row]) -> dict[str, float]:
        motion = scene.motion(**now)
        centers = losses.center_of_mass(motion, scene.model.mass)
        contact, closest = moments(scene.squared_distances(motion))
        return {"start_distance": history[0]["distance"], "first_contact": contact * scene.time_step,
                "closest_approach": closest * scene.time_step,
                "envelope": (centers.amax(0) - centers.amin(0)).norm().item()}  # fmt: skip

    @torch.no_grad()
    def picture(path: Path, history: list[Row]) -> None:
        motions = {"initial": scene.motion(**first), "recovered": scene.motion(**now)}
        frames, centers = {}, {}
        for key, motion in motions.items():
            centers[key] = losses.center_of_mass(motion, scene.model.mass)
            contact, closest = moments(scene.squared_distances(motion))
            lowest = contact + int(centers[key][contact : closest + 1, 1].argmin())
            frames[key] = motion[[0, lowest, closest]]
        viz.paths(path, scene.mesh.surface, frames, centers, voxel(scene), history)

    @torch.no_grad()
    def animation(path: Path) -> None:
        motions = {"initial": scene.motion(**first), "recovered": scene.motion(**now)}
        points = torch.cat(list(motions.values())).flatten(0, 1)
        floor = viz.floor(points.amin(0).tolist()[::2], points.amax(0).tolist()[::2])
        viz.animation(path, scene.mesh.surface, motions, scene.time_step, [floor, voxel(scene)], view=(14.0, 15.0))

    return Problem(
        name=name,
        parameters={key: now[key] for key in moves},
        stages=[
            Stage(loss=loss, iterations=iterations, learning_rate=learning_rate, clip=clip, tolerance=tolerance,
                  capturable=True)
        ],
        estimates=lambda: {"distance": squared.sqrt().item()},
        units={"distance": "m"},
        protocol=scene.protocol() | {"velocity": velocity},
        findings=findings,
        picture=picture,
        animation=animation,
    )  # fmt: skip


def moments(squared: Tensor) -> tuple[int, int]:
    """Frames of the first contact and of the closest approach after it, of `Bounce.squared_distances` [steps + 1]."""
    return int(squared.isinf().sum()), int(squared.argmin())


def voxel(scene: Bounce) -> viz.Scenery:
    """The voxel about the target, for pictures."""
    cube = dv.mesh.cube(2, VOXEL, split="kuhn")
    return viz.Scenery(cube.points - cube.points.mean(0) + scene.target, cube.surface, viz.COLORS["target"])


SIZE, HEIGHT = 0.3, 1.0  # edge, and center above the floor at the release [m]
TILT = (0.3, 0.2)  # about z, after about x [rad]
VELOCITY = (2.0, -1.0, 0.3)  # at the start [m/s]
TARGET = (1.3, 0.45, 0.495)  # [m]
DENSITY = 100.0  # [kg/m^3]
MU = LAM = 2e5  # [Pa]
TIME_STEP, STEPS, SWEEPS = 1 / 250, 200, 20  # [s]
LEARNING_RATE, CLIP = 0.03, 0.5  # [m] and [m/s]; [m] and [m s]


def scene(settings: Settings, sweeps: int = SWEEPS) -> Bounce:
    """Cube above the floor, and its target."""
    cube = dv.mesh.cube(2, SIZE, split="kuhn")
    z, x = TILT
    about_z = np.array([[math.cos(z), -math.sin(z), 0.0], [math.sin(z), math.cos(z), 0.0], [0.0, 0.0, 1.0]])
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, math.cos(x), -math.sin(x)], [0.0, math.sin(x), math.cos(x)]])
    mesh = cube.translate([-SIZE / 2] * 3).transform(about_z @ about_x).translate([0.0, HEIGHT, 0.0])
    return Bounce(mesh=mesh, target=TARGET, density=DENSITY, mu=MU, lam=LAM, time_step=TIME_STEP, steps=STEPS,
                  sweeps=sweeps, device=settings.device)  # fmt: skip


def cube_bounce(settings: Settings, sweeps: int = SWEEPS) -> Problem:
    """The task cube-bounce; with another number of sweeps per step, at least 1, on request."""
    if sweeps < 1:
        raise ValueError(f"sweeps: expected at least 1, got {sweeps}")
    return problem("cube-bounce", scene(settings, sweeps), VELOCITY, moves=("offset", "velocity"),
                   iterations=15 if settings.quick else 151, learning_rate=LEARNING_RATE, clip=CLIP,
                   tolerance=1e-5)  # fmt: skip


def bunny_bounce(settings: Settings) -> Problem:
    """The task bunny-bounce."""
    resolution, steps, sweeps, iterations = (8, 120, 5, 15) if settings.quick else (9, 150, 10, 100)
    mesh = dv.mesh.bunny(resolution).translate([0.0, 0.3, 0.0])  # feet above the floor at the release [m]
    thrown = Bounce(mesh, target=(0.45, 0.23, 0.3785), density=1000.0, mu=2e4, lam=2e4, time_step=1 / 300, steps=steps,
                    sweeps=sweeps, device=settings.device)  # fmt: skip
    return problem("bunny-bounce", thrown, (1.2, -2.0, 0.2), moves=("velocity",), iterations=iterations,
                   learning_rate=0.1, clip=CLIP, tolerance=1e-5)  # fmt: skip
