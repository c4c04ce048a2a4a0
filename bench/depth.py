"""Solver depth and outcome: how close cube-bounce comes to its target with 5, 20 or 100 sweeps (paper, appendix).

Best distance [m] of the cube's center of mass from its target after the bounce, within some iterations of Adam, from
eight first states: height, and velocity along each axis, of the task's own first state times 1 + 0.15 n with n normal.
"default" starts from that state itself. Every result is a new rollout of the best throw with the sweeps it was found
with; "converged" is the median distance of the same throws with many sweeps, and "unsolved" by how much the distance of
one throw changes with them, at most. "near" counts the throws that pass within 0.013 m, which the paper's cube reaches
in 151 iterations. Mean and standard deviation include throws that end in a local minimum far from the target.
"""

from __future__ import annotations

import itertools
import math
import statistics
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from bench import paper
from bench.tables import Table
from diffvbd.tasks import Problem, Settings, Stage, bounce, solve
from diffvbd.tasks.bounce import Bounce

SWEEPS = (5, 20, 100)
CONVERGED = 500  # sweeps that judge what was found with fewer
STARTS, JITTER, SEED = 8, 0.15, 0  # first states around the task's own; standard deviation of each number, relative
ITERATIONS = 40


def run(quick: bool) -> dict[str, Any]:
    sweeps, starts, iterations = ((5, 20), 2, 3) if quick else (SWEEPS, STARTS, ITERATIONS)
    converged = 20 if quick else CONVERGED
    depths = [study(k, starts, iterations, converged) for k in sweeps]
    tests = [{"sweeps": [a["sweeps"], b["sweeps"]], **welch(a["distances"], b["distances"])}
             for a, b in itertools.combinations(depths, 2)]  # fmt: skip
    setting = {"iterations": iterations, "jitter": JITTER, "seed": SEED, "converged": converged}
    return setting | {"depths": depths, "pairs": tests}


def study(sweeps: int, starts: int, iterations: int, converged: int) -> dict[str, Any]:
    """The task from its own start and from others, all in one batch: scenes over one mesh never mix."""
    with tempfile.TemporaryDirectory() as folder:
        settings = Settings(Path(folder))
        scene, judge = (bounce.scene(settings, k) for k in (sweeps, converged))
        batch = Batch(scene, first_states(starts))
        history = solve(batch.problem(iterations), settings).history
    with torch.no_grad():
        found, judged = (each.squared_miss(*batch.best.unbind(1)).sqrt().tolist() for each in (scene, judge))
    return {
        "sweeps": sweeps,
        "starts": [history[0][f"distance {k}"] for k in range(1, starts + 1)],
        "distances": found[1:],
        "mean": statistics.mean(found[1:]),
        "std": statistics.stdev(found[1:]),
        "median": statistics.median(found[1:]),
        "min": min(found[1:]),
        "max": max(found[1:]),
        "default": found[0],
        "converged": statistics.median(judged[1:]),
        "unsolved": max(abs(a - b) for a, b in zip(found[1:], judged[1:], strict=True)),
        "near": sum(distance <= paper.BOUNCE_DISTANCE for distance in found[1:]),
        "seconds": history[-1]["seconds"],
    }


def first_states(starts: int) -> Tensor:
    """Offsets [m] and velocities [m/s], shape [1 + starts, 2, 3]: the task's own, then jittered ones."""
    own = torch.tensor([(0.0, bounce.HEIGHT, 0.0), bounce.VELOCITY], dtype=torch.float64)
    noise = torch.randn((starts, 2, 3), generator=torch.Generator().manual_seed(SEED), dtype=torch.float64)
    states = torch.cat([own[None], own * (1 + JITTER * noise)])
    states[:, 0] -= own[0]
    return states


class Batch:
    """Several throws that are optimised side by side as if each were alone, and the best states of each."""

    def __init__(self, scene: Bounce, first: Tensor) -> None:
        self.scene = scene
        self.states = first.clone().requires_grad_()
        self.best = first.clone()
        self.distances = self.least = torch.full_like(first[:, 0, 0], math.inf)

    def loss(self) -> Tensor:
        # Adam treats each number alone, but Stage.clip would scale all scenes by one number
        states = clipped(self.states, bounce.CLIP)
        squared = self.scene.squared_miss(*states.unbind(1))
        self.distances = squared.detach().sqrt()
        better = self.distances < self.least
        self.best = torch.where(better[:, None, None], states.detach(), self.best)
        self.least = torch.where(better, self.distances, self.least)
        return squared.sum()

    def problem(self, iterations: int) -> Problem:
        stage = Stage(loss=self.loss, iterations=iterations, learning_rate=bounce.LEARNING_RATE, refinable=False)
        return Problem(
            name=f"cube-bounce, {self.scene.sweeps} sweeps",
            parameters={"states": self.states},
            stages=[stage],
            estimates=lambda: {f"distance {k}": d for k, d in enumerate(self.distances.tolist())},
        )


def clipped(states: Tensor, limit: float) -> Tensor:
    """The same states [N, ...], whose gradients are scaled down, each for itself, to a norm of at most `limit`."""
    same = states.clone()

    def clip(gradient: Tensor) -> Tensor:
        norm = gradient.flatten(1).norm(dim=1).clamp(min=1e-300)
        return gradient * (limit / norm).clamp(max=1.0).reshape(-1, *[1] * (gradient.dim() - 1))

    if same.requires_grad:
        same.register_hook(clip)
    return same


def welch(a: Sequence[float], b: Sequence[float]) -> dict[str, float]:
    """t of the difference of two means whose variances differ, and its degrees of freedom (Welch 1947)."""
    first, second = (statistics.variance(values) / len(values) for values in (a, b))
    return {
        "t": (statistics.mean(a) - statistics.mean(b)) / math.sqrt(first + second),
        "df": (first + second) ** 2 / (first**2 / (len(a) - 1) + second**2 / (len(b) - 1)),
    }


def theirs(key: str) -> Callable[[dict[str, Any]], Any]:
    return lambda row: paper.DEPTH.get(row["sweeps"], {}).get(key)


COLUMNS = ("mean", "std", "median", "min", "max", "near", "default", "converged", "unsolved")
TABLES = (
    Table("Distances", "depths", {"sweeps": "sweeps", **{key: key for key in COLUMNS},
                                  **{f"paper, {k}": theirs(k) for k in ("mean", "std", "min", "max", "default")}}),
    Table("Differences of the means", "pairs",
          {"sweeps": lambda row: " and ".join(map(str, row["sweeps"])), "Welch's t": "t", "degrees of freedom": "df",
           "paper, t": lambda row: paper.DEPTH_T.get(tuple(row["sweeps"]))}),
)  # fmt: skip
