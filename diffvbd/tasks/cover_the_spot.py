"""Throw three soft disks so that together they cover a round target (paper, section 6.5 and appendix "Task protocols").

The disks have a radius r = 0.42 m, the target on the floor (y = 0) has R = 0.45 m; r must exceed R sqrt(3)/2, below
which no three disks cover the target. The 18 numbers are the initial velocity of each disk and an offset of where it is
released. The sigmoid of the loss is sharpened from 4 / R to 25 / R; the result is judged by the share of 4,000 points
of the target that lie below no triangle of the disks. It reaches 0.0 % well before the last of the 600 evaluations,
which are the paper's count, and the rest lowers the smooth loss.

Choices: disks are 6 cm thick with three rings of vertices (74 vertices, 162 tets each), of 1000 kg/m^3 and mu = lam =
2e4 Pa; h = 1/150 s; K = 2 sweeps; one search for pairs per step, up to 10 cm. Disks start 0.35 m from the target's
axis, 25 cm above one another, and move away from it at 0.4 m/s, to which a seed adds noise: some nine tenths of the
target stay uncovered. Above one another, because disks that fall side by side meet rim to rim on the floor, and no
small change lifts one over the other. Offsets are at most 0.1 m along each axis. Lighter disks and longer slides cover
the target too, but bounce, and their gradient is rough. Adam alone, at half the rate, covered the target from two of
three seeds, crossed a cliff with the third and ended with 3 % uncovered, so the stage is `rough`. Without clipping,
bounces on the way may leave Adam with steps that are too short: such a run ended with 1 % uncovered.

Few sweeps and long steps bounce less than short ones. So the findings say what the same throw leaves uncovered in steps
four times as short with four times as many sweeps.
"""

import math
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor

import diffvbd as dv
from diffvbd import viz
from diffvbd.tasks.problem import Problem, Row, Settings, Stage

TARGET_RADIUS = 0.45  # R [m]
RADIUS = 0.42  # r [m]
TIME_STEP, SWEEPS = 1 / 150, 2  # [s]
THICKNESS = 0.06  # [m]
HEIGHT, SPACING = 2.5, 0.25  # release of the lowest disk above the floor, and from disk to disk [m]
RING = 0.35  # distance of the release from the target's axis [m]
OFFSET = 0.1  # largest offset of the release along each axis [m]
OUTWARD = 0.4  # first velocity, away from the target's axis [m/s]
NOISE = 0.05  # standard deviation of what a seed adds to the first velocities [m/s]
DENSITY = 1000.0  # [kg/m^3]
MU = LAM = 2e4  # [Pa]
KAPPA, DHAT, DAMPING = 400.0, 0.02, 8.0  # [N/m], [m], [N s/m]
REACH = 0.1  # [m]
SHARPNESS = (4.0, 25.0)  # at the first and the last iteration [1 / R]
CLIP = 1.0  # longest gradient, about that of the first iteration; a bounce on the way has several times that
SAMPLES, FINE_SAMPLES = 400, 4000  # points of the target: of the loss, of the result
SHORTER = 4  # times: steps by which the result is judged, too, with as many times the sweeps


class Version(NamedTuple):
    """Numbers that the quick version changes."""

    rings: int
    height: float  # release of the lowest disk above the floor [m]
    steps: int
    sweeps: int
    iterations: int


FULL, QUICK = Version(3, HEIGHT, 160, SWEEPS, 600), Version(2, 0.5, 75, 4, 30)


def problem(settings: Settings, radius: float = RADIUS) -> Problem:
    """The task; disks of another radius [m] on request. ValueError for at most R sqrt(3)/2."""
    least = 0.5 * math.sqrt(3) * TARGET_RADIUS
    if not radius > least:
        raise ValueError(
            f"radius: expected more than R sqrt(3)/2 = {least:.4f} m, below which no three disks cover the target of "
            f"R = {TARGET_RADIUS} m, got {radius}"
        )
    version = QUICK if settings.quick else FULL
    fall = Fall(settings, radius, version)
    return Problem(
        name="cover-the-spot",
        parameters={"velocity": fall.velocity, "offset": fall.offset},
        stages=[
            Stage(loss=fall.loss, iterations=version.iterations, learning_rate=0.06, clip=CLIP, rough=True,
                  before=fall.anneal, criterion="uncovered", capturable=True)
        ],
        estimates=fall.estimates,
        protocol={"radius": radius, "target_radius": TARGET_RADIUS, "vertices": fall.model.num_vertices,
                  "tets": fall.model.num_tets, "rings": version.rings, "steps": version.steps, "time_step": TIME_STEP,
                  "sweeps": version.sweeps, "density": DENSITY, "mu": MU, "lam": LAM, "kappa": KAPPA, "dhat": DHAT,
                  "damping": DAMPING, "reach": REACH, "detections": 1, "heights": fall.centers[:, 1].tolist(),
                  "sharpness": SHARPNESS, "clip": CLIP, "offset": OFFSET, "noise": NOISE,
                  "samples": (SAMPLES, FINE_SAMPLES)},
        findings=None if settings.quick else fall.findings,
        picture=fall.picture,
        animation=fall.animation,
    )  # fmt: skip


class Fall:
    """Three disks from their release to where they come to lie, and the 18 numbers that decide it."""

    def __init__(self, settings: Settings, radius: float, version: Version) -> None:
        self.version, self.disk = version, dv.mesh.disk(radius, THICKNESS, version.rings)
        angles = 2 * np.pi * np.arange(3) / 3
        outward = np.stack([np.cos(angles), np.zeros(3), np.sin(angles)], axis=1)
        self.centers = RING * outward
        self.centers[:, 1] = version.height + SPACING * np.arange(3)
        self.model = model_of(self.disk, self.centers).to(settings.device)
        like = {"dtype": self.model.dtype, "device": self.model.device}
        self.rim = torch.as_tensor(outline(self.disk), device=self.model.device)
        self.top = torch.as_tensor(faces_up(self.disk), device=self.model.device)
        self.samples, self.fine = (sunflower(n, TARGET_RADIUS).to(**like) for n in (SAMPLES, FINE_SAMPLES))
        self.sharpness = torch.tensor(SHARPNESS[0] / TARGET_RADIUS, **like)
        self.landed = torch.zeros((3, self.disk.num_vertices, 3), **like)  # by the latest loss

        noise = torch.randn((3, 3), generator=torch.Generator().manual_seed(settings.seed), dtype=torch.float64)
        self.velocity = (OUTWARD * torch.from_numpy(outward) + NOISE * noise).to(**like).requires_grad_()
        self.offset = torch.zeros((3, 3), **like, requires_grad=True)

    def simulate(self, save: Literal["all", "last"] = "last", shorter: int = 1) -> Tensor:
        """Positions [m] of saved frames, shape [frames, 3, vertices of a disk, 3]; on request in steps so many times
        as short, with as many times the sweeps."""
        moved, v = (
            each[:, None].expand(-1, self.disk.num_vertices, -1).flatten(0, 1)
            for each in (OFFSET * self.offset.tanh(), self.velocity)
        )
        solver = dv.VBD(TIME_STEP / shorter, shorter * self.version.sweeps)
        motion = dv.rollout(self.model, self.model.rest_points + moved, v, solver, steps=shorter * self.version.steps,
                            save=save, mu=MU, lam=LAM)  # fmt: skip
        return motion.x.unflatten(1, (3, -1))

    def loss(self) -> Tensor:
        end = self.simulate()[-1]
        self.landed.copy_(end.detach())
        return smooth_uncovered(end[:, self.rim], self.samples, self.sharpness)

    def anneal(self, iteration: int) -> None:
        share = iteration / max(1, self.version.iterations - 1)
        self.sharpness.fill_((SHARPNESS[0] + share * (SHARPNESS[1] - SHARPNESS[0])) / TARGET_RADIUS)

    def estimates(self) -> Row:
        return {"uncovered": uncovered(self.landed[:, self.top], self.fine).item()}

    @torch.no_grad()
    def findings(self, history: list[Row]) -> dict[str, float]:
        end = self.simulate(shorter=SHORTER)[-1]
        return {"uncovered_in_shorter_steps": uncovered(end[:, self.top], self.fine).item()}

    @torch.no_grad()
    def motion(self) -> Tensor:
        """All frames, shape [frames, V, 3]."""
        return self.simulate("all").flatten(1, 2)

    def picture(self, path: Path, history: list[Row]) -> None:
        motion = self.motion()
        heights = motion[..., 1].mean(1)
        shown = [int((heights > share * heights[0]).sum()) for share in (0.75, 0.25)] + [self.version.steps]
        surfaces = [self.disk.surface + k * self.disk.num_vertices for k in range(3)]
        viz.landing(path, surfaces, motion[shown], [k * TIME_STEP for k in shown], TARGET_RADIUS, history)

    def animation(self, path: Path) -> None:
        viz.animation(path, self.model.surface.cpu().numpy(), {"recovered": self.motion()}, TIME_STEP)


def model_of(disk: dv.TetMesh, centers: np.ndarray) -> dv.Model:
    """A disk at each of some centers [m], shape [n, 3], above a floor."""
    energies = (
        dv.StableNeoHookean(),
        dv.FloorBarrier(kappa=KAPPA, dhat=DHAT, damping=DAMPING),
        dv.PairBarrier(KAPPA, DHAT, self_contact=False, damping=DAMPING, detections=1, reach=REACH),
    )
    return dv.Model(dv.mesh.join([disk.translate(c) for c in centers]), density=DENSITY, energies=energies)


def outline(disk: dv.TetMesh) -> np.ndarray:
    """Vertices of the upper rim of `mesh.disk` [n], clockwise as seen from above."""
    x, y, z = disk.points.T
    distance = np.hypot(x, z)
    rim = np.flatnonzero((y > 0) & (distance > distance.max() - 1e-9))
    return rim[np.argsort(np.arctan2(z[rim], x[rim]))]


def faces_up(disk: dv.TetMesh) -> np.ndarray:
    """Triangles of the upper side of `mesh.disk` [F, 3]."""
    return disk.surface[(disk.points[disk.surface][..., 1] > 0).all(1)]


def sunflower(count: int, radius: float) -> Tensor:
    """Points (x, z) [count, 2], evenly spread over a disk [m], by Vogel's spiral of the golden angle."""
    k = torch.arange(count, dtype=torch.float64)
    distance, angle = radius * ((k + 0.5) / count).sqrt(), math.pi * (3 - math.sqrt(5)) * k
    return torch.stack([distance * angle.cos(), distance * angle.sin()], dim=1)


def smooth_uncovered(rims: Tensor, points: Tensor, sharpness: Tensor) -> Tensor:
    """Mean over points (x, z) [N, 2] [m] of the product over disks of sigmoid(-sharpness distance), distance to the
    outline from inside; rims [disks, n, 3] [m] are convex, in the order of `outline` or against it."""
    start = rims[..., ::2]
    edge = start.roll(-1, 1) - start
    # a disk that has landed upside down is gone round the other way
    turns = (start[..., 0] * edge[..., 1] - start[..., 1] * edge[..., 0]).sum(-1).sign()
    inward = turns[:, None, None] * torch.stack([-edge[..., 1], edge[..., 0]], -1) / edge.norm(dim=-1, keepdim=True)
    # the outline is convex: a point is as deep inside as it is behind the nearest line
    depth = ((points[:, None, None] - start) * inward).sum(-1).amin(-1)
    # a sum of logarithms: the derivative of a product waits for the device
    return torch.nn.functional.logsigmoid(-sharpness * depth).sum(-1).exp().mean()


def uncovered(triangles: Tensor, points: Tensor) -> Tensor:
    """Share of points (x, z) [N, 2] that lie below none of the triangles [disks, F, 3, 3] (any positions [m])."""
    a = triangles.reshape(-1, 3, 3)[..., ::2]
    edge = a.roll(-1, 1) - a
    to_point = points[:, None, None] - a
    side = edge[..., 0] * to_point[..., 1] - edge[..., 1] * to_point[..., 0]
    covered = ((side >= 0).all(-1) | (side <= 0).all(-1)).any(-1)
    return 1 - covered.to(points.dtype).mean()
