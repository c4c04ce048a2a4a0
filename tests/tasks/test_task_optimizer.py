"""Claim: on a loss with cliffs Adam goes back to where it has been best, and an interrupted run does the same."""

from pathlib import Path

import pytest
import torch

from diffvbd.tasks.optimizer import PATIENCE, RISE, SLOWER, RetreatingAdam, optimizer_of
from diffvbd.tasks.problem import Problem, Settings, Stage
from diffvbd.tasks.runner import solve

EDGE, HEIGHT, LOWEST = 1.0, 8.0, 0.9  # where the cliff is, how high, and where the valley before it is lowest


def cliff(x: torch.Tensor) -> torch.Tensor:
    """A valley that ends at a cliff, beyond which the slope leads away from it."""
    return torch.where(x < EDGE, (x - LOWEST).square() + 0.1, HEIGHT - 0.1 * x).sum()


def course(rough: bool, steps: int = 60) -> tuple[list[float], torch.optim.Optimizer]:
    x = torch.zeros(1, dtype=torch.float64, requires_grad=True)
    optimizer, schedule = optimizer_of(Stage(lambda: cliff(x), steps, 0.3, rough=rough), [x])
    assert schedule is not None
    losses: list[float] = []

    def evaluate() -> float:
        x.grad = None
        loss = cliff(x)
        loss.backward()
        losses.append(loss.item())
        return loss.item()

    for _ in range(steps):
        optimizer.step(evaluate)
        schedule.step()
    return losses, optimizer


def test_a_step_over_a_cliff_is_taken_back() -> None:
    plain, _ = course(rough=False)
    assert max(plain) > 5 and min(plain[-20:]) > 5  # Adam goes over the cliff and stays there
    losses, optimizer = course(rough=True)
    falls = [k for k in range(1, len(losses)) if losses[k - 1] > 5 and losses[k] < 5]
    assert falls and max(losses[-20:]) < 0.12
    for k in falls:
        assert losses[k] == min(losses[:k])  # the very parameters of the lowest loss
        assert k < PATIENCE or losses[k - 1] > RISE * min(losses[:k])
    assert isinstance(optimizer, RetreatingAdam)
    assert all(b - a >= PATIENCE for a, b in zip(falls, falls[1:], strict=False))


def test_each_step_back_lowers_the_rate() -> None:
    x = torch.zeros(1, requires_grad=True)
    optimizer = RetreatingAdam([x], 0.5)
    losses = [1.0] * PATIENCE + [1.1 * RISE] + [1.0] * (PATIENCE - 2) + [1.1 * RISE] * 2

    def evaluate() -> float:
        x.grad = torch.ones(1)
        return losses.pop(0)

    for expected in [0.5] * PATIENCE + [0.5 * SLOWER] * PATIENCE + [0.5 * SLOWER**2]:
        optimizer.step(evaluate)
        assert optimizer.param_groups[0]["lr"] == pytest.approx(expected)
    assert not losses


@pytest.mark.parametrize("at", [1, 4, 9, 17, 30])
def test_an_interrupted_run_goes_on_as_it_would_have(at: int, tmp_path: Path) -> None:
    def problem(stop: int | None = None) -> Problem:
        x = torch.zeros(1, dtype=torch.float64, requires_grad=True)
        calls = iter(range(1000))

        def loss() -> torch.Tensor:
            if next(calls) == stop:
                raise KeyboardInterrupt
            return cliff(x)

        return Problem("cliff", {"x": x}, [Stage(loss, 40, 0.3, rough=True)], lambda: {"x": x.item()})

    whole = solve(problem(), Settings(tmp_path / "whole"))
    with pytest.raises(KeyboardInterrupt):
        solve(problem(at), Settings(tmp_path / "parts"))
    parts = solve(problem(), Settings(tmp_path / "parts"))
    assert [row["loss"] for row in parts.history] == [row["loss"] for row in whole.history]
    assert max(row["loss"] for row in whole.history[:20]) > 5


def test_a_stage_with_an_optimizer_of_its_own_cannot_be_rough(tmp_path: Path) -> None:
    x = torch.zeros(1, requires_grad=True)
    stage = Stage(lambda: cliff(x), 1, optimizer=torch.optim.SGD, rough=True)
    with pytest.raises(ValueError, match=r"stages\[0\].rough: expected False beside an optimizer .*, got True"):
        solve(Problem("cliff", {"x": x}, [stage], lambda: {}), Settings(tmp_path))
