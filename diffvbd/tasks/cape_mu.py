"""Identify the shear modulus of a cloth from how far its center sags (paper, appendix "Additional inverse problems").

A square cloth of 0.6 x 0.6 m and 484 vertices, a shell of two layers, is held at its four corners and falls from flat
into a hammock. Given is one number, the height of its center after t = 1/3 s, simulated with mu = 2000 Pa. Adam moves
log mu from 8000 Pa on the squared difference of the two heights [m^2]. On the way from there a softer cloth hangs lower
at that moment, and the loss has one minimum. Above 1e5 Pa this is false: a stiffer cloth hangs lower again, the loss
falls as mu grows, and Adam started there moves away from the solution.

Choices the paper leaves open: the layers have 22 x 11 vertices, 1 cm apart; a corner is one vertex of each layer; the
center is the mean of the four vertices nearest to it. Density 50 kg/m^3 (0.5 kg/m^2, a heavy wool); lam = 2000 Pa is
known. h = 1/60 s, as the paper's figure suggests, and K = 29 with coarse corrections and relaxation 1.7: the target
and the first guess stay within 3 mm of converged steps. Sweeps alone need more than a thousand at this h without
relaxation; with 20 the center falls freely, whatever mu is. The run ends when the loss is 1e-10 of the first one, or
after 80 iterations, the paper's count.
"""

import numpy as np
import torch
from torch import Tensor

import diffvbd as dv
from diffvbd.tasks.cloth import mean_weights
from diffvbd.tasks.problem import Problem, Settings, Stage
from diffvbd.tasks.report import pictures

TRUE_MU, START_MU, LAM = 2000.0, 8000.0, 2000.0  # [Pa]
SIDE, THICKNESS = 0.6, 0.01  # [m]
DENSITY = 50.0  # [kg/m^3]
TIME_STEP = 1 / 60  # [s]
RELAXATION = 1.7


def problem(settings: Settings) -> Problem:
    vertices, steps, sweeps, iterations = ((6, 5), 10, 8, 60) if settings.quick else ((22, 11), 20, 29, 80)
    mesh = dv.mesh.sheet(*vertices, size=(SIDE, SIDE), thickness=THICKNESS)
    from_center = np.abs(mesh.points[:, ::2] - 0.5 * SIDE)
    corners = (from_center > 0.5 * SIDE - 1e-9).all(axis=1)
    model = dv.Model(mesh, density=DENSITY, pinned=corners).to(settings.device)
    solver = dv.VBD(TIME_STEP, sweeps, relaxation=RELAXATION, subspace="coarse")
    x, v = model.rest_points, torch.zeros_like(model.rest_points)
    distance = np.hypot(*from_center.T)
    center = mean_weights(distance < distance.min() + 1e-9, x)

    def simulate(mu: Tensor) -> Tensor:
        """Positions [m] after each step, shape [steps + 1, V, 3]."""
        return dv.rollout(model, x, v, solver, steps=steps, mu=mu, lam=LAM).x

    def height(mu: Tensor) -> Tensor:
        return center @ simulate(mu)[-1, :, 1]

    start = torch.tensor(START_MU, dtype=x.dtype, device=x.device)
    true = torch.full_like(start, TRUE_MU)
    with torch.no_grad():
        target = height(true)
    log_mu = start.log().requires_grad_()

    @torch.no_grad()
    def motions() -> dict[str, Tensor]:
        return {"initial": simulate(start), "target": simulate(true), "recovered": simulate(log_mu.exp())}

    # the two layers lie so close that a picture of both mixes them up
    upper = mesh.surface[(mesh.surface >= mesh.num_vertices // 2).all(axis=1)]

    return Problem(
        name="cape-mu",
        parameters={"log_mu": log_mu},
        stages=[
            Stage(loss=lambda: (height(log_mu.exp()) - target).square(), iterations=iterations, learning_rate=0.1,
                  tolerance=1e-10, capturable=True)
        ],
        estimates=lambda: {"mu": log_mu.exp().item()},
        truth={"mu": TRUE_MU},
        units={"mu": "Pa"},
        protocol={"vertices": vertices, "side": SIDE, "thickness": THICKNESS, "density": DENSITY, "lam": LAM,
                  "start_mu": START_MU, "steps": steps, "time_step": TIME_STEP, "sweeps": sweeps,
                  "relaxation": RELAXATION, "subspace": "coarse", "target_height": target.item()},
        **pictures(upper, motions, TIME_STEP, [steps // 4, steps // 2, steps], {"mu": TRUE_MU}),
    )  # fmt: skip
