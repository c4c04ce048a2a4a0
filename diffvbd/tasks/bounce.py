"""What cube_bounce and bunny_bounce share: a thrown body whose center of mass shall meet a target after the bounce."""

import math
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import diffvbd as dv
from diffvbd import losses, viz
from diffvbd.tasks.problem import Problem, Stage
from diffvbd.tasks.progress import Row

VOXEL = 0.05  # side of the target in pictures [m]; the distance is that to its center


@dataclass(frozen=True)
class Bounce:
    """A soft body that is released above the floor y = 0, and where it shall go.

    Attributes:
        mesh: The body where it is released, at rest.
        target: Where the center of mass shall pass after the first contact [m].
        density: [kg/m^3].
        mu, lam: Lame parameters [Pa].
        time_step: [s].
        steps, sweeps: Number of steps, and of sweeps in each.
        kappa, dhat: Stiffness [N/m] and range [m] of the floor's barrier; a vertex below dhat is in contact.
        device: A torch device.
    """

    mesh: dv.TetMesh
    target: tuple[float, float, float]
    density: float
    mu: float
    lam: float
    time_step: float
    steps: int
    sweeps: int
    kappa: float = 400.0
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
        """Positions [m] of all frames, shape [steps + 1, ..., V, 3].

        Args:
            offset: Of the release [m], shape [..., 3]; leading dimensions are scenes.
            velocity: Of all vertices at the release [m/s], shape [..., 3].
        """
        x = self.model.rest_points + offset.unsqueeze(-2)
        v = velocity.unsqueeze(-2).expand_as(x)
        return dv.rollout(self.model, x, v, steps=self.steps, mu=self.mu, lam=self.lam, time_step=self.time_step,
                          sweeps=self.sweeps).x  # fmt: skip

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
        return {
            "start_distance": history[0]["distance"],
            "first_contact": contact * scene.time_step,
            "closest_approach": closest * scene.time_step,
            "envelope": (centers.amax(0) - centers.amin(0)).norm().item(),
        }

    @torch.no_grad()
    def picture(path: Path, history: list[Row]) -> None:
        motions = {"initial": scene.motion(**first), "recovered": scene.motion(**now)}
        frames, centers = {}, {}
        for key, motion in motions.items():
            centers[key] = losses.center_of_mass(motion, scene.model.mass)
            contact, closest = moments(scene.squared_distances(motion))
            lowest = contact + int(centers[key][contact : closest + 1, 1].argmin())
            frames[key] = motion[[0, lowest, closest]]
        viz.paths(path, scene.mesh.surface, frames, centers, target(scene), history)

    @torch.no_grad()
    def animation(path: Path) -> None:
        motions = {"initial": scene.motion(**first), "recovered": scene.motion(**now)}
        points = torch.cat(list(motions.values())).flatten(0, 1)
        floor = viz.floor(points.amin(0).tolist()[::2], points.amax(0).tolist()[::2])
        viz.animation(path, scene.mesh.surface, motions, scene.time_step, [floor, target(scene)], view=(14.0, 15.0))

    return Problem(
        name=name,
        parameters={key: now[key] for key in moves},
        stages=[
            Stage(
                loss=loss,
                iterations=iterations,
                learning_rate=learning_rate,
                clip=clip,
                tolerance=tolerance,
                capturable=True,
            )
        ],
        estimates=lambda: {"distance": squared.sqrt().item()},
        units={"distance": "m"},
        protocol=scene.protocol() | {"velocity": velocity},
        findings=findings,
        picture=picture,
        animation=animation,
    )


def moments(squared: Tensor) -> tuple[int, int]:
    """Frames of the first contact and of the closest approach after it, of `Bounce.squared_distances` [steps + 1]."""
    return int(squared.isinf().sum()), int(squared.argmin())


def target(scene: Bounce) -> viz.Scenery:
    """The voxel about the target, for pictures."""
    cube = dv.mesh.cube(2, VOXEL, split="kuhn")
    return viz.Scenery(cube.points - cube.points.mean(0) + scene.target, cube.surface, viz.COLORS["target"])
