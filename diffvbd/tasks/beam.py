"""Identify the material of a beam from its motion (paper, section 6.5 and appendix "Task protocols").

A cantilever of 0.5 x 0.2 x 0.2 m is clamped at x = 0; there is no gravity, the density is 1000 kg/m^3, and blocks are
exact. The loss is the mean squared vertex distance over all frames. A run ends after 76 iterations, the paper's count.

beam-mu: The twist grows linearly to the free end; lam = 1e6 Pa is known. With K = 8, coarse corrections and relaxation
1.5 the target's motion stays within 2 mm of converged steps, that of the first guess within 1 mm. The loss falls
monotonically from 1e5 to 1e6 Pa, which the distance of the last frame alone does not. The basin is not much wider: from
1e4 Pa Adam ends in another minimum, at 13,469 Pa. A loss of 1e-9 of the first one is a relative error of mu below 1e-4.

beam-mu-lam: The paper does not define its kick of 60 degrees. Here it is an initial angular velocity about the z axis
through the middle of the clamped face. K = 15, and the sweeps start from the predictor, as in the paper. The paper's
block would not guarantee descent, as mu > lam.
"""

import math
from typing import Any

import torch
from torch import Tensor

import diffvbd as dv
from diffvbd.tasks.problem import Problem, Settings
from diffvbd.tasks.report import fitted

TRUE_MU, START_MU, LAM = 1.0e6, 1.0e5, 1.0e6  # of beam-mu [Pa]
TRUTH, START = {"mu": 800.0, "lam": 400.0}, (300.0, 150.0)  # of beam-mu-lam [Pa]
DENSITY = 1000.0  # [kg/m^3]
SIZE = (0.5, 0.2, 0.2)  # [m]
TWIST = math.pi  # [rad]
KICK = math.radians(60.0)  # [rad], in the observed time
TIME_STEP = 2e-3  # [s]
SWEEPS, KICKED_SWEEPS = 8, 15  # of beam-mu, of beam-mu-lam
RELAXATION = 1.5


def cantilever(settings: Settings) -> tuple[dv.TetMesh, dv.Model, dict[str, Any]]:
    """The beam, clamped at x = 0, and the entries of the protocol that both tasks have."""
    vertices = (6, 3, 3) if settings.quick else (21, 7, 7)
    mesh = dv.mesh.beam(*vertices, size=SIZE, split="kuhn")
    clamped = mesh.points[:, 0] < mesh.points[:, 0].min() + 1e-9
    model = dv.Model(mesh, density=DENSITY, pinned=clamped).to(settings.device)
    return mesh, model, {"vertices": vertices, "time_step": TIME_STEP, "density": DENSITY}


def beam_mu(settings: Settings) -> Problem:
    """The task beam-mu."""
    steps, iterations = (15, 60) if settings.quick else (100, 76)
    mesh, model, protocol = cantilever(settings)
    solver = dv.VBD(TIME_STEP, SWEEPS, relaxation=RELAXATION, subspace="coarse")
    x = twisted(model.rest_points, TWIST)
    v = torch.zeros_like(x)

    def simulate(mu: Tensor) -> Tensor:
        return dv.rollout(model, x, v, solver, steps=steps, mu=mu, lam=LAM, gravity=(0.0, 0.0, 0.0)).x

    return fitted(
        "beam-mu", "log_mu", simulate, x.new_tensor(START_MU), x.new_tensor(TRUE_MU),
        estimates=lambda mu: {"mu": mu.item()},
        stage={"iterations": iterations, "learning_rate": 0.2, "tolerance": 1e-9},
        drawn=(mesh.surface, TIME_STEP, [steps // 20, steps // 5, steps]),
        truth={"mu": TRUE_MU},
        units={"mu": "Pa"},
        protocol={**protocol, "steps": steps, "sweeps": SWEEPS, "relaxation": RELAXATION, "subspace": "coarse",
                  "lam": LAM, "start_mu": START_MU},
    )  # fmt: skip


def twisted(points: Tensor, angle: float) -> Tensor:
    """Points [V, 3] turned about the bar's axis (along x) by an angle [rad] that grows linearly to the free end."""
    low, high = points.amin(0), points.amax(0)
    center = 0.5 * (low + high)
    phi = angle * (points[:, 0] - low[0]) / (high[0] - low[0])
    y, z = points[:, 1] - center[1], points[:, 2] - center[2]
    cos, sin = phi.cos(), phi.sin()
    return torch.stack([points[:, 0], center[1] + cos * y - sin * z, center[2] + sin * y + cos * z], dim=1)


def beam_mu_lam(settings: Settings) -> Problem:
    """The task beam-mu-lam."""
    steps, iterations = (30, 60) if settings.quick else (100, 76)
    mesh, model, protocol = cantilever(settings)
    solver = dv.VBD(TIME_STEP, KICKED_SWEEPS, start="predictor")
    x = model.rest_points
    v = kicked(x, KICK / (100 * TIME_STEP))
    v[model.pinned] = 0.0

    def simulate(material: Tensor) -> Tensor:
        mu, lam = material
        return dv.rollout(model, x, v, solver, steps=steps, mu=mu, lam=lam, gravity=(0.0, 0.0, 0.0)).x

    return fitted(
        "beam-mu-lam", "log_material", simulate, x.new_tensor(START), x.new_tensor([*TRUTH.values()]),
        estimates=lambda material: dict(zip(("mu", "lam"), material.tolist(), strict=True)),
        stage={"iterations": iterations, "learning_rate": 0.15, "tolerance": 1e-10},
        drawn=(mesh.surface, TIME_STEP, [steps // 4, steps // 2, steps]),
        truth=TRUTH,
        units={"mu": "Pa", "lam": "Pa"},
        protocol={**protocol, "steps": steps, "sweeps": KICKED_SWEEPS, "start": START, "kick": KICK},
    )  # fmt: skip


def kicked(points: Tensor, rate: float) -> Tensor:
    """Velocity [m/s] of points [V, 3] that turn at a rate [rad/s] about z through the middle of the face x = min."""
    low, high = points.amin(0), points.amax(0)
    arm_x, arm_y = points[:, 0] - low[0], points[:, 1] - 0.5 * (low[1] + high[1])
    return rate * torch.stack([-arm_y, arm_x, torch.zeros_like(arm_x)], dim=1)
