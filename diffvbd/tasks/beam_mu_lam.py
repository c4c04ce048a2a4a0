"""Identify both Lame parameters of a soft beam from its motion (paper, section 6.5 and appendix "Task protocols").

The cantilever of beam-mu, at rest, receives a 60 degree angular kick. Given are the vertex positions of 100 steps of
2 ms, simulated with (mu, lam) = (800, 400) Pa; Adam moves the logarithms of both from (300, 150) Pa.

The paper does not define its kick. Here it is an initial angular velocity about the z axis through the middle of the
clamped face: a free rigid beam would turn by 60 degrees within the observed 0.2 s. This bends and stretches the beam,
so both parameters matter: the Hessian of the loss in (mu, lam) has a condition number of about 10 at the solution. An
initial twist of 60 degrees keeps the volume, hardly sees lam, and has about 500.

Other choices as in beam-mu: no gravity (a beam this soft would not carry itself), density 1000 kg/m^3, the exact block
(mu > lam, where the paper's block does not guarantee descent), K = 15, mean squared vertex distance over all frames.
The run ends when the loss is 1e-10 of the first one, or after 76 iterations. The sweeps start from the predictor, as in
the paper.
"""

import math
from pathlib import Path

import torch

import diffvbd as dv
from diffvbd import losses, viz
from diffvbd.tasks.problem import Problem, Settings, Stage
from diffvbd.tasks.progress import Row

TRUTH = {"mu": 800.0, "lam": 400.0}  # [Pa]
START = (300.0, 150.0)
DENSITY = 1000.0  # [kg/m^3]
SIZE = (0.5, 0.2, 0.2)  # [m]
KICK = math.radians(60.0)  # [rad], in the observed time
TIME_STEP = 2e-3  # [s]
SWEEPS = 15


def problem(settings: Settings) -> Problem:
    vertices, steps, iterations = ((6, 3, 3), 30, 60) if settings.quick else ((21, 7, 7), 100, 76)
    mesh = dv.mesh.beam(*vertices, size=SIZE, split="kuhn")
    clamped = mesh.points[:, 0] < mesh.points[:, 0].min() + 1e-9
    model = dv.Model(mesh, density=DENSITY, pinned=clamped, start="predictor").to(settings.device)

    x = model.rest_points
    v = kicked(x, KICK / (100 * TIME_STEP))
    v[model.pinned] = 0.0

    def simulate(mu: torch.Tensor, lam: torch.Tensor) -> torch.Tensor:
        motion = dv.rollout(
            model, x, v, steps=steps, mu=mu, lam=lam, time_step=TIME_STEP, sweeps=SWEEPS, gravity=(0.0, 0.0, 0.0)
        )
        return motion.x

    start = torch.tensor(START, dtype=x.dtype, device=x.device)
    with torch.no_grad():
        target = simulate(*start.new_tensor([TRUTH["mu"], TRUTH["lam"]]))
    log_material = start.log().requires_grad_()

    @torch.no_grad()
    def motions() -> dict[str, torch.Tensor]:
        return {"initial": simulate(*start), "target": target, "recovered": simulate(*log_material.exp())}

    def picture(path: Path, history: list[Row]) -> None:
        shown = [steps // 4, steps // 2, steps]
        frames = {name: motion[shown] for name, motion in motions().items()}
        viz.comparison(path, mesh.surface, frames, [k * TIME_STEP for k in shown], history, TRUTH)

    return Problem(
        name="beam-mu-lam",
        parameters={"log_material": log_material},
        stages=[
            Stage(
                loss=lambda: losses.vertex_distance(simulate(*log_material.exp()), target),
                iterations=iterations,
                learning_rate=0.15,
                tolerance=1e-10,
                capturable=True,
            )
        ],
        estimates=lambda: dict(zip(("mu", "lam"), log_material.exp().tolist(), strict=True)),
        truth=TRUTH,
        units={"mu": "Pa", "lam": "Pa"},
        protocol={
            "vertices": vertices,
            "steps": steps,
            "time_step": TIME_STEP,
            "sweeps": SWEEPS,
            "density": DENSITY,
            "start": START,
            "kick": KICK,
        },
        picture=picture,
        animation=lambda path: viz.animation(path, mesh.surface, motions(), TIME_STEP),
    )


def kicked(points: torch.Tensor, rate: float) -> torch.Tensor:
    """Velocity [m/s] of points [V, 3] that turn at a rate [rad/s] about z through the middle of the face x = min."""
    low, high = points.amin(0), points.amax(0)
    arm_x, arm_y = points[:, 0] - low[0], points[:, 1] - 0.5 * (low[1] + high[1])
    return rate * torch.stack([-arm_y, arm_x, torch.zeros_like(arm_x)], dim=1)
