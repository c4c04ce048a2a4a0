"""Throw three soft disks so that together they cover a round target (paper, section 6.5 and appendix "Task protocols").

Three disks of radius r = 0.42 m are thrown from 2.5 m above the floor, around a target of radius R = 0.45 m that is
painted on it; r must exceed R sqrt(3)/2, below which no three disks cover the target. They fall, hit the floor (y = 0)
and one another, stack, and slide: contact has no friction. Adam moves 18 numbers, for each disk its initial velocity
and an offset of where it is released, by the derivative of 160 steps. The loss is a smooth uncovered share of the
target at the end, whose sigmoid is sharpened from 4 / R to 25 / R on the way; the result is judged by the share that
lies below no triangle of the disks.

Choices the paper leaves open: disks 6 cm thick in three rings of vertices (222 vertices in all), density 200 kg/m^3,
mu = lam = 2e4 Pa, h = 1/120 s, K = 6 sweeps, one search for pairs per step up to 16 cm, so that bounds cut little of a
landing at 7 m/s. Disks are released on a ring of 0.77 m about the target with vertical speeds of -1, 0 and 1 m/s, so
that they land one after the other; a seed disturbs all velocities.
"""

import math
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

import diffvbd as dv
from diffvbd import viz
from diffvbd.tasks.runner import Problem, Row, Settings

TARGET_RADIUS = 0.45  # R [m]
RADIUS = 0.42  # r [m]
THICKNESS = 0.06  # [m]
HEIGHT = 2.5  # of the release above the floor [m]
RING = 0.77  # distance of the release from the target's axis [m]
OFFSET = 0.1  # largest offset of the release along each axis [m]
VERTICAL = (-1.0, 0.0, 1.0)  # first vertical velocities [m/s]
NOISE = 0.05  # standard deviation of the first velocities [m/s]
DENSITY = 200.0  # [kg/m^3]
MU = LAM = 2e4  # [Pa]
KAPPA, DHAT, DAMPING = 400.0, 0.02, 8.0  # [N/m], [m], [N s/m]
REACH = 0.16  # [m]
CAPACITY = 4096
SHARPNESS = (4.0, 25.0)  # at the first and the last iteration [1 / R]
SAMPLES, FINE_SAMPLES = 400, 4000  # points of the target: of the loss, of the result


def problem(settings: Settings, radius: float = RADIUS) -> Problem:
    """The task; disks of another radius [m] on request.

    Raises:
        ValueError: radius is at most R sqrt(3)/2.
    """
    least = 0.5 * math.sqrt(3) * TARGET_RADIUS
    if not radius > least:
        raise ValueError(f"radius: expected more than R sqrt(3)/2 = {least:.4f} m, below which no three disks cover the "
                         f"target of R = {TARGET_RADIUS} m, got {radius}")  # fmt: skip
    rings, steps, sweeps, iterations, time_step = (3, 160, 6, 600, 1 / 120)
    if settings.quick:
        rings, steps, sweeps, iterations, time_step = (2, 50, 4, 30, 1 / 60)
    disk = dv.mesh.disk(radius, THICKNESS, rings)
    angles = 2 * np.pi * np.arange(3) / 3
    centers = np.stack([RING * np.cos(angles), np.full(3, HEIGHT), RING * np.sin(angles)], axis=1)
    contact = {"kappa": KAPPA, "dhat": DHAT, "damping": DAMPING}
    barrier = dv.PairBarrier(**contact, self_contact=False, detections=1, reach=REACH, capacity=CAPACITY)
    energies = (dv.StableNeoHookean(), dv.FloorBarrier(**contact), barrier)
    model = dv.Model(dv.mesh.join([disk.translate(c) for c in centers]), density=DENSITY, energies=energies)
    model = model.to(settings.device)
    like = {"dtype": model.dtype, "device": model.device}

    rim, top = outline(disk), faces_up(disk)
    rim, top = (torch.as_tensor(part, device=model.device) for part in (rim, top))
    samples, fine = (sunflower(n, TARGET_RADIUS).to(**like) for n in (SAMPLES, FINE_SAMPLES))
    sharpness = torch.tensor(SHARPNESS[0] / TARGET_RADIUS, **like)

    noise = torch.randn((3, 3), generator=torch.Generator().manual_seed(settings.seed), dtype=torch.float64)
    first = NOISE * noise + torch.tensor(VERTICAL, dtype=torch.float64)[:, None] * torch.tensor([0.0, 1.0, 0.0])
    velocity = first.to(**like).requires_grad_()
    offset = torch.zeros((3, 3), **like, requires_grad=True)
    body = model.body
    landed = torch.zeros((3, disk.num_vertices, 3), **like)

    def simulate(save: str = "last") -> Tensor:
        """Positions of the three disks [frames, 3, vertices of one, 3]."""
        x = model.rest_points + OFFSET * offset.tanh()[body]
        motion = dv.rollout(model, x, velocity[body], steps=steps, mu=MU, lam=LAM, time_step=time_step, sweeps=sweeps,
                            save=save)  # fmt: skip
        return motion.x.unflatten(1, (3, -1))

    def loss() -> Tensor:
        end = simulate()[-1]
        landed.copy_(end.detach())
        return smooth_uncovered(end[:, rim], samples, sharpness)

    def anneal(iteration: int) -> None:
        share = iteration / max(1, iterations - 1)
        sharpness.fill_((SHARPNESS[0] + share * (SHARPNESS[1] - SHARPNESS[0])) / TARGET_RADIUS)

    def estimates() -> Row:
        return {"uncovered": uncovered(landed[:, top], fine).item()}

    return Problem(
        name="cover-the-spot",
        parameters={"velocity": velocity, "offset": offset},
        loss=loss,
        estimates=estimates,
        iterations=iterations,
        learning_rate=0.05,
        before=anneal,
        criterion="uncovered",
        capture=True,
        simulate=lambda: simulate("all"),
    )


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
    """Mean over points of the product over disks of sigmoid(-sharpness distance), distance to the outline from inside.

    Args:
        rims: Outlines [m], shape [disks, n, 3], convex, in the order of `outline`.
        points: (x, z) [m], shape [N, 2].
        sharpness: Scalar [1/m].
    """
    start = rims[..., ::2]
    edge = start.roll(-1, 1) - start
    inward = torch.stack([-edge[..., 1], edge[..., 0]], -1) / edge.norm(dim=-1, keepdim=True)
    # the outline is convex: a point is as deep inside as it is behind the nearest line
    depth = ((points[:, None, None] - start) * inward).sum(-1).amin(-1)
    return torch.sigmoid(-sharpness * depth).prod(-1).mean()


def uncovered(triangles: Tensor, points: Tensor) -> Tensor:
    """Share of points (x, z) [N, 2] that lie below none of the triangles [disks, F, 3, 3] (any positions [m])."""
    a = triangles.reshape(-1, 3, 3)[..., ::2]
    edge = a.roll(-1, 1) - a
    to_point = points[:, None, None] - a
    side = edge[..., 0] * to_point[..., 1] - edge[..., 1] * to_point[..., 0]
    covered = ((side >= 0).all(-1) | (side <= 0).all(-1)).any(-1)
    return 1 - covered.to(points.dtype).mean()
