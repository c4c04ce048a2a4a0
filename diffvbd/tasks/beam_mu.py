"""Identify the shear modulus of a beam from its motion (paper, section 6.5 and appendix "Task protocols").

A cantilever of 0.5 x 0.2 x 0.2 m and 1,029 vertices is clamped at x = 0, twisted about its axis (the angle grows
linearly to 180 degrees at the free end) and released from rest. Given are the vertex positions of 100 steps of 2 ms,
simulated with mu = 1e6 Pa; lam = 1e6 Pa is known. Adam moves log mu from 1e5 Pa.

Choices the paper leaves open: no gravity; density 1000 kg/m^3; the exact block; K = 8 sweeps with coarse corrections
and relaxation 1.5, with which the motion of the target stays within 2 mm of converged steps, that of the first guess
within 1 mm. Sweeps alone, 15 of them without relaxation, take as long and are 21 cm off. The loss is the mean squared
vertex distance over all frames: it falls monotonically over the whole way from 1e5 to 1e6, which the distance
of the last frame alone does not. The basin is not much wider: started from 1e4 Pa, Adam ends in another minimum, at
13,469 Pa. The run ends when the loss is 1e-9 of the first one, which is a relative error of mu below 1e-4, or after 76
iterations, the paper's count.
"""

import math
from pathlib import Path

import torch

import diffvbd as dv
from diffvbd import losses, viz
from diffvbd.tasks.problem import Problem, Settings, Stage
from diffvbd.tasks.progress import Row

TRUE_MU = 1.0e6  # [Pa]
START_MU = 1.0e5
LAM = 1.0e6
DENSITY = 1000.0  # [kg/m^3]
SIZE = (0.5, 0.2, 0.2)  # [m]
TWIST = math.pi  # [rad]
TIME_STEP = 2e-3  # [s]
SWEEPS = 8
RELAXATION = 1.5


def problem(settings: Settings) -> Problem:
    vertices, steps, iterations = ((6, 3, 3), 15, 60) if settings.quick else ((21, 7, 7), 100, 76)
    mesh = dv.mesh.beam(*vertices, size=SIZE, split="kuhn")
    clamped = mesh.points[:, 0] < mesh.points[:, 0].min() + 1e-9
    model = dv.Model(mesh, density=DENSITY, pinned=clamped, relaxation=RELAXATION, coarse="auto")
    model = model.to(settings.device)

    x = twisted(model.rest_points, TWIST)
    v = torch.zeros_like(x)

    def simulate(mu: torch.Tensor) -> torch.Tensor:
        motion = dv.rollout(
            model, x, v, steps=steps, mu=mu, lam=LAM, time_step=TIME_STEP, sweeps=SWEEPS, gravity=(0.0, 0.0, 0.0)
        )
        return motion.x

    start = torch.tensor(START_MU, dtype=x.dtype, device=x.device)
    with torch.no_grad():
        target = simulate(torch.full_like(start, TRUE_MU))
    log_mu = start.log().requires_grad_()

    @torch.no_grad()
    def motions() -> dict[str, torch.Tensor]:
        return {"initial": simulate(start), "target": target, "recovered": simulate(log_mu.exp())}

    def picture(path: Path, history: list[Row]) -> None:
        shown = [steps // 20, steps // 5, steps]
        frames = {name: motion[shown] for name, motion in motions().items()}
        viz.comparison(path, mesh.surface, frames, [k * TIME_STEP for k in shown], history, {"mu": TRUE_MU})

    return Problem(
        name="beam-mu",
        parameters={"log_mu": log_mu},
        stages=[
            Stage(
                loss=lambda: losses.vertex_distance(simulate(log_mu.exp()), target),
                iterations=iterations,
                learning_rate=0.2,
                tolerance=1e-9,
                capturable=True,
            )
        ],
        estimates=lambda: {"mu": log_mu.exp().item()},
        truth={"mu": TRUE_MU},
        units={"mu": "Pa"},
        protocol={
            "vertices": vertices,
            "steps": steps,
            "time_step": TIME_STEP,
            "sweeps": SWEEPS,
            "relaxation": RELAXATION,
            "coarse": "auto",
            "density": DENSITY,
            "lam": LAM,
            "start_mu": START_MU,
        },
        picture=picture,
        animation=lambda path: viz.animation(path, mesh.surface, motions(), TIME_STEP),
    )


def twisted(points: torch.Tensor, angle: float) -> torch.Tensor:
    """Points [V, 3] turned about the bar's axis (along x) by an angle [rad] that grows linearly to the free end."""
    low, high = points.amin(0), points.amax(0)
    center = 0.5 * (low + high)
    phi = angle * (points[:, 0] - low[0]) / (high[0] - low[0])
    y, z = points[:, 1] - center[1], points[:, 2] - center[2]
    cos, sin = phi.cos(), phi.sin()
    return torch.stack([points[:, 0], center[1] + cos * y - sin * z, center[2] + sin * y + cos * z], dim=1)
