"""Identify a uniform material of any mesh from observed shapes: Adam on log mu and log lam."""

import hashlib
from pathlib import Path

import torch

from diffvbd import losses, viz
from diffvbd.tasks.runner import Problem, Row, Settings
from diffvbd.tasks.scene import Observation


def problem(
    observation: Observation,
    settings: Settings,
    start: tuple[float, float],
    fixed_lam: bool = False,
    iterations: int = 100,
    learning_rate: float = 0.15,
) -> Problem:
    """The inverse problem: mean squared vertex distance over the observed shapes.

    Args:
        observation: What was seen, and the scene it was seen in.
        settings: Device, seed, directory.
        start: mu and lam [Pa] to start from.
        fixed_lam: Keep lam at its start value.
        iterations: Most evaluations of the loss.
        learning_rate: Adam's first rate in log mu and log lam; it falls to 0 along a cosine.

    Raises:
        ValueError: a start value is not positive.
    """
    if min(start) <= 0:
        raise ValueError(f"start: expected positive mu and lam, got {start}")
    scene = observation.scene
    model = scene.model(settings.device)
    target = torch.as_tensor(observation.x, dtype=model.dtype, device=model.device)
    observed = observation.steps.tolist()
    logarithms = torch.tensor(start, dtype=model.dtype, device=model.device).log()
    log_mu, log_lam = logarithms.unbind()
    log_mu = log_mu.clone().requires_grad_()
    log_lam = log_lam.clone().requires_grad_(not fixed_lam)

    def simulate(mu: torch.Tensor, lam: torch.Tensor) -> torch.Tensor:
        return scene.simulate(model, mu, lam, observed[-1]).x[observed]

    def picture(path: Path, history: list[Row]) -> None:
        with torch.no_grad():
            initial, recovered = simulate(*logarithms.exp()), simulate(log_mu.exp(), log_lam.exp())
        chosen = sorted({len(observed) // 4, len(observed) // 2, len(observed) - 1})
        motions = {"initial": initial[chosen], "target": target[chosen], "recovered": recovered[chosen]}
        times = [observed[k] * scene.time_step for k in chosen]
        viz.comparison(path, scene.mesh.surface, motions, times, history, observation.truth)

    moving = {"log_mu": log_mu} if fixed_lam else {"log_mu": log_mu, "log_lam": log_lam}
    return Problem(
        name="identify",
        parameters=moving,
        loss=lambda: losses.vertex_distance(simulate(log_mu.exp(), log_lam.exp()), target),
        estimates=lambda: {"mu": log_mu.exp().item(), "lam": log_lam.exp().item()},
        truth=observation.truth,
        iterations=iterations,
        learning_rate=learning_rate,
        tolerance=1e-9,
        protocol={
            "start": list(start),
            "fixed_lam": fixed_lam,
            "iterations": iterations,
            "learning_rate": learning_rate,
            "steps": observed,
            "observation": hashlib.sha256(observation.x.tobytes()).hexdigest(),
        },
        picture=picture,
    )
