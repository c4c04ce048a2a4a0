"""Identify the material of a beam from its motion (paper, section 6.5 and appendix "Task protocols").

beam-mu: A cantilever of 0.5 x 0.2 x 0.2 m and 1,029 vertices is clamped at x = 0, twisted about its axis (the angle
grows linearly to 180 degrees at the free end) and released from rest. Given are the vertex positions of 100 steps of 2
ms, simulated with mu = 1e6 Pa; lam = 1e6 Pa is known. Adam moves log mu from 1e5 Pa.

Choices the paper leaves open: no gravity; density 1000 kg/m^3; the exact block; K = 8 sweeps with coarse corrections
and relaxation 1.5, with which the motion of the target stays within 2 mm of converged steps, that of the first guess
within 1 mm. Sweeps alone, 15 of them without relaxation, take as long and are 21 cm off. The loss is the mean squared
vertex distance over all frames: it falls monotonically over the whole way from 1e5 to 1e6, which the distance of the
last frame alone does not. The basin is not much wider: started from 1e4 Pa, Adam ends in another minimum, at 13,469 Pa.
The run ends when the loss is 1e-9 of the first one, which is a relative error of mu below 1e-4, or after 76 iterations,
the paper's count.

beam-mu-lam: The cantilever of beam-mu, at rest, receives a 60 degree angular kick. Given are the vertex positions of
100 steps of 2 ms, simulated with (mu, lam) = (800, 400) Pa; Adam moves the logarithms of both from (300, 150) Pa.

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

import torch

import diffvbd as dv
from diffvbd import losses
from diffvbd.tasks.problem import Problem, Settings, Stage
from diffvbd.tasks.report import pictures

TRUE_MU, START_MU, LAM = 1.0e6, 1.0e5, 1.0e6  # of beam-mu [Pa]
TRUTH, START = {"mu": 800.0, "lam": 400.0}, (300.0, 150.0)  # of beam-mu-lam [Pa]
DENSITY = 1000.0  # [kg/m^3]
SIZE = (0.5, 0.2, 0.2)  # [m]
TWIST = math.pi  # [rad]
KICK = math.radians(60.0)  # [rad], in the observed time
TIME_STEP = 2e-3  # [s]
SWEEPS, KICKED_SWEEPS = 8, 15  # of beam-mu, of beam-mu-lam
RELAXATION = 1.5


def beam_mu(settings: Settings) -> Problem:
    """The task beam-mu."""
    vertices, steps, iterations = ((6, 3, 3), 15, 60) if settings.quick else ((21, 7, 7), 100, 76)
    mesh = dv.mesh.beam(*vertices, size=SIZE, split="kuhn")
    clamped = mesh.points[:, 0] < mesh.points[:, 0].min() + 1e-9
    model = dv.Model(mesh, density=DENSITY, pinned=clamped).to(settings.device)
    solver = dv.VBD(TIME_STEP, SWEEPS, relaxation=RELAXATION, subspace="coarse")

    x = twisted(model.rest_points, TWIST)
    v = torch.zeros_like(x)

    def simulate(mu: torch.Tensor) -> torch.Tensor:
        return dv.rollout(model, x, v, solver, steps=steps, mu=mu, lam=LAM, gravity=(0.0, 0.0, 0.0)).x

    start = torch.tensor(START_MU, dtype=x.dtype, device=x.device)
    with torch.no_grad():
        target = simulate(torch.full_like(start, TRUE_MU))
    log_mu = start.log().requires_grad_()

    @torch.no_grad()
    def motions() -> dict[str, torch.Tensor]:
        return {"initial": simulate(start), "target": target, "recovered": simulate(log_mu.exp())}

    return Problem(
        name="beam-mu",
        parameters={"log_mu": log_mu},
        stages=[
            Stage(loss=lambda: losses.vertex_distance(simulate(log_mu.exp()), target), iterations=iterations,
                  learning_rate=0.2, tolerance=1e-9, capturable=True)
        ],
        estimates=lambda: {"mu": log_mu.exp().item()},
        truth={"mu": TRUE_MU},
        units={"mu": "Pa"},
        protocol={"vertices": vertices, "steps": steps, "time_step": TIME_STEP, "sweeps": SWEEPS,
                  "relaxation": RELAXATION, "subspace": "coarse", "density": DENSITY, "lam": LAM, "start_mu": START_MU},
        **pictures(mesh.surface, motions, TIME_STEP, [steps // 20, steps // 5, steps], {"mu": TRUE_MU}),
    )  # fmt: skip


def twisted(points: torch.Tensor, angle: float) -> torch.Tensor:
    """Points [V, 3] turned about the bar's axis (along x) by an angle [rad] that grows linearly to the free end."""
    low, high = points.amin(0), points.amax(0)
    center = 0.5 * (low + high)
    phi = angle * (points[:, 0] - low[0]) / (high[0] - low[0])
    y, z = points[:, 1] - center[1], points[:, 2] - center[2]
    cos, sin = phi.cos(), phi.sin()
    return torch.stack([points[:, 0], center[1] + cos * y - sin * z, center[2] + sin * y + cos * z], dim=1)


def beam_mu_lam(settings: Settings) -> Problem:
    """The task beam-mu-lam."""
    vertices, steps, iterations = ((6, 3, 3), 30, 60) if settings.quick else ((21, 7, 7), 100, 76)
    mesh = dv.mesh.beam(*vertices, size=SIZE, split="kuhn")
    clamped = mesh.points[:, 0] < mesh.points[:, 0].min() + 1e-9
    model = dv.Model(mesh, density=DENSITY, pinned=clamped).to(settings.device)
    solver = dv.VBD(TIME_STEP, KICKED_SWEEPS, start="predictor")

    x = model.rest_points
    v = kicked(x, KICK / (100 * TIME_STEP))
    v[model.pinned] = 0.0

    def simulate(mu: torch.Tensor, lam: torch.Tensor) -> torch.Tensor:
        return dv.rollout(model, x, v, solver, steps=steps, mu=mu, lam=lam, gravity=(0.0, 0.0, 0.0)).x

    start = torch.tensor(START, dtype=x.dtype, device=x.device)
    with torch.no_grad():
        target = simulate(*start.new_tensor([TRUTH["mu"], TRUTH["lam"]]))
    log_material = start.log().requires_grad_()

    @torch.no_grad()
    def motions() -> dict[str, torch.Tensor]:
        return {"initial": simulate(*start), "target": target, "recovered": simulate(*log_material.exp())}

    return Problem(
        name="beam-mu-lam",
        parameters={"log_material": log_material},
        stages=[
            Stage(loss=lambda: losses.vertex_distance(simulate(*log_material.exp()), target), iterations=iterations,
                  learning_rate=0.15, tolerance=1e-10, capturable=True)
        ],
        estimates=lambda: dict(zip(("mu", "lam"), log_material.exp().tolist(), strict=True)),
        truth=TRUTH,
        units={"mu": "Pa", "lam": "Pa"},
        protocol={"vertices": vertices, "steps": steps, "time_step": TIME_STEP, "sweeps": KICKED_SWEEPS,
                  "density": DENSITY, "start": START, "kick": KICK},
        **pictures(mesh.surface, motions, TIME_STEP, [steps // 4, steps // 2, steps], TRUTH),
    )  # fmt: skip


def kicked(points: torch.Tensor, rate: float) -> torch.Tensor:
    """Velocity [m/s] of points [V, 3] that turn at a rate [rad/s] about z through the middle of the face x = min."""
    low, high = points.amin(0), points.amax(0)
    arm_x, arm_y = points[:, 0] - low[0], points[:, 1] - 0.5 * (low[1] + high[1])
    return rate * torch.stack([-arm_y, arm_x, torch.zeros_like(arm_x)], dim=1)
