"""Identify a uniform material of any mesh from observed shapes: L-BFGS on log mu and log lam.

Most motions show Young's modulus far better than lam / mu: the loss is a narrow curved valley, in which Adam creeps and
a quasi-Newton method does not.
"""

import hashlib
import math
from pathlib import Path

import torch

from diffvbd import losses, viz
from diffvbd.tasks.optimizer import lbfgs
from diffvbd.tasks.problem import Problem, Row, Settings, Stage
from diffvbd.tasks.scene import Observation

# Line searches try wild steps: the material stays within this factor of the first guess, or its inverse.
RANGE = 1e4


def problem(
    observation: Observation,
    settings: Settings,
    start: tuple[float, float],
    fixed_lam: bool = False,
    iterations: int = 100,
) -> Problem:
    """The inverse problem: mean squared distance from the observed shapes over their own from the initial shape.

    Args:
        observation: What was seen, and the scene it was seen in.
        settings: Device, seed, directory.
        start: First guess of mu and lam [Pa]; the result is within a factor RANGE of it.
        fixed_lam: Keep lam at its start value.
        iterations: Most evaluations of the loss.

    Raises:
        ValueError: a start value is not positive, or nothing moves.
    """
    if not all(0 < value < math.inf for value in start):
        raise ValueError(f"start: expected positive mu and lam, got {start}")
    scene = observation.scene
    model = scene.model(settings.device)
    target = torch.tensor(observation.x, dtype=model.dtype, device=model.device)
    observed = observation.steps.tolist()
    first = torch.tensor(start, dtype=model.dtype, device=model.device)
    free = 1 if fixed_lam else 2
    exponents = torch.zeros(free, dtype=model.dtype, device=model.device, requires_grad=True)
    still = torch.tensor(scene.x0, dtype=model.dtype, device=model.device)
    scale = losses.vertex_distance(target, still).item()
    if scale == 0.0:
        raise ValueError("observation: expected shapes that differ from the initial one, got none")

    def material() -> torch.Tensor:
        limit = math.log(RANGE)
        factors = (limit * (exponents / limit).tanh()).exp()
        return torch.cat([factors * first[:free], first[free:]])

    def simulate(mu: torch.Tensor, lam: torch.Tensor) -> torch.Tensor:
        return scene.simulate(model, mu, lam, observed[-1]).x[observed]

    def picture(path: Path, history: list[Row]) -> None:
        with torch.no_grad():
            initial, recovered = simulate(*first), simulate(*material())
        chosen = sorted({len(observed) // 4, len(observed) // 2, len(observed) - 1})
        motions = {"initial": initial[chosen], "target": target[chosen], "recovered": recovered[chosen]}
        times = [observed[k] * scene.time_step for k in chosen]
        viz.comparison(path, scene.mesh.surface, motions, times, history, observation.truth)

    return Problem(
        name="identify",
        parameters={"exponents": exponents},
        stages=[
            Stage(loss=lambda: losses.vertex_distance(simulate(*material()), target) / scale, iterations=iterations,
                  tolerance=1e-12, gradient_tolerance=1e-7, optimizer=lbfgs)
        ],
        estimates=lambda: dict(zip(("mu", "lam"), material().tolist(), strict=True)),
        truth=observation.truth,
        protocol={"start": list(start), "fixed_lam": fixed_lam, "iterations": iterations, "range": RANGE,
                  "steps": observed, "observation": hashlib.sha256(observation.x.tobytes()).hexdigest()},
        picture=picture,
    )  # fmt: skip
