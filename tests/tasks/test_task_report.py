"""Claim: a run ends with a line that says whether its result survives finer settings, or why that is not known."""

from pathlib import Path

import torch
from torch import Tensor

import diffvbd as dv
from diffvbd.tasks import Problem, Settings, Stage, solve, table


def push(before: bool = False, rollout: bool = True) -> Problem:
    """Pushes a block until its end is at 0.1 m; the state counts the calls of the loss."""
    mesh = dv.mesh.box(2, 0.1)
    model = dv.Model(mesh)
    force = torch.tensor(0.0, dtype=torch.float64, requires_grad=True)
    calls = torch.zeros((), dtype=torch.float64)
    x, way = model.rest_points, torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)

    def loss() -> Tensor:
        calls.add_(1)
        if not rollout:
            return (force - 1).square()
        end = dv.rollout(model, x, torch.zeros_like(x), mu=1e4, lam=1e4, time_step=1 / 50, sweeps=3, steps=5,
                         force=force * way, gravity=(0, 0, 0), save="last").x[-1]  # fmt: skip
        return ((end - x)[:, 0].mean() - 0.1).square()

    stages = [Stage(loss, 6, optimizer=lambda p: torch.optim.LBFGS(p, 1, 6, line_search_fn="strong_wolfe"),
                    before=(lambda k: None) if before else None)]  # fmt: skip
    return Problem("push", {"force": force}, stages, lambda: {"force": force.item()}, state={"calls": calls})


def test_a_run_ends_with_the_line(tmp_path: Path) -> None:
    problem = push()
    result = solve(problem, Settings(tmp_path))
    found = result.refined
    # implicit Euler goes (n + 1) / n of the right way in n steps: smaller ones go less far
    assert isinstance(found, dv.Refinement) and found.before == result.history[0]["loss"]
    assert found.loss < found.smaller_steps < result.history[0]["loss"]
    assert str(found) in table(problem, result).splitlines()[-1]
    assert str(found) in (tmp_path / "log.json").read_text(encoding="utf-8")
    assert float(problem.state["calls"]) <= len(result.history) + 1  # the four evaluations are not counted in


def test_or_with_why_not(tmp_path: Path) -> None:
    cases = {"quick": push(), "changes during the run": push(before=True), "runs dv.rollout": push(rollout=False)}
    for k, (words, problem) in enumerate(cases.items()):
        result = solve(problem, Settings(tmp_path / str(k), quick=words == "quick"))
        assert str(result.refined).startswith("not refined: ") and words in str(result.refined)
