"""What every task is held to: a quick run lowers the loss, and the first gradient is that of the loss."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from diffvbd.tasks import TASKS, Problem, Result, Settings, solve
from diffvbd.tasks.problem import Row


def quick(name: str, out: Path, **options: Any) -> tuple[Problem, Settings]:
    """The quick version of a task, without pictures."""
    settings = Settings(out, quick=True)
    problem = TASKS[name].build(settings, **options)
    problem.picture = None
    return problem, settings


def timeless(history: list[Row]) -> list[Row]:
    """What two runs of the same numbers have in common."""
    return [{key: value for key, value in row.items() if key != "seconds"} for row in history]


def check_fall(name: str, out: Path, factor: float, iterations: int | None = None, whole: bool = False,
               **options: Any) -> Result:  # fmt: skip
    """The last stage of a quick run ends with at most `factor` of the loss that the stage began with, or the run."""
    problem, settings = quick(name, out, **options)
    if iterations is not None:
        for stage in problem.stages:
            stage.iterations = min(stage.iterations, iterations)
    result = solve(problem, settings)
    last = [row for row in result.history if row.get("stage", 0) == len(problem.stages) - 1]
    assert result.best["loss"] <= factor * (result.history if whole else last)[0]["loss"]
    # the best parameters are back in place
    stage = problem.stages[-1]
    if stage.before:
        stage.before(last.index(result.best))
    assert stage.loss().item() == result.best["loss"]
    assert problem.estimates() == result.estimates
    return result


def check_gradient(name: str, out: Path, step: float, rel: float, stage: int = 0, **options: Any) -> None:
    """Along one direction of each parameter of a stage the gradient is a central difference of the loss."""
    problem, _ = quick(name, out, **options)
    chosen = problem.stages[stage]
    if chosen.before:
        chosen.before(0)
    names = list(problem.parameters) if chosen.moves is None else list(chosen.moves)
    moved = [problem.parameters[name] for name in names]
    gradients = torch.autograd.grad(chosen.loss(), moved)
    rng = np.random.default_rng(0)
    for parameter, gradient in zip(moved, gradients, strict=True):
        direction = torch.from_numpy(rng.choice([-1.0, 1.0], size=tuple(parameter.shape))).to(parameter)
        values = []
        for sign in (1, -1):
            with torch.no_grad():
                parameter += sign * step * direction
                values.append(chosen.loss().item())
                parameter -= sign * step * direction
        expected = (values[0] - values[1]) / (2 * step)
        assert expected != 0.0
        assert (gradient * direction).sum().item() == pytest.approx(expected, rel=rel)
