"""Claim: on a loss with cliffs Adam goes back to where it has been best, and an interrupted run does the same."""

from pathlib import Path

import pytest
import torch

from diffvbd.tasks.optimizer import PATIENCE, optimizer_of
from diffvbd.tasks.problem import Problem, Settings, Stage
from diffvbd.tasks.runner import solve

EDGE, HEIGHT, LOWEST = 1.0, 8.0, 0.999  # where the cliff is, how high, where the valley before it is lowest
STEPS, RATE = 60, 0.2


def cliff(x: torch.Tensor) -> torch.Tensor:
    """A valley that ends at a cliff, beyond which the slope leads away from it."""
    return torch.where(x < EDGE, (x - LOWEST).square() + 0.1, HEIGHT - 0.1 * x).sum()


def course(rough: bool) -> list[float]:
    """Losses on the way."""
    x = torch.zeros(1, dtype=torch.float64, requires_grad=True)
    optimizer, schedule = optimizer_of(Stage(lambda: cliff(x), STEPS, RATE, rough=rough), [x])
    assert schedule is not None
    losses: list[float] = []

    def evaluate() -> float:
        x.grad = None
        loss = cliff(x)
        loss.backward()
        losses.append(loss.item())
        return loss.item()

    for _ in range(STEPS):
        optimizer.step(evaluate)
        schedule.step()
    return losses


def steps_back(losses: list[float]) -> list[int]:
    """Evaluations that follow one beyond the cliff and are before it."""
    return [k for k in range(1, len(losses)) if losses[k - 1] > 5 and losses[k] < 5]


def test_steps_over_a_cliff_are_taken_back() -> None:
    plain = course(rough=False)
    assert max(plain) > 5 and min(plain[-20:]) > 5  # Adam goes over the cliff and stays there
    losses = course(rough=True)
    falls = steps_back(losses)
    assert len(falls) >= 3 and max(losses[-10:]) < 0.12
    for k in falls:
        assert losses[k] == min(losses[:k])  # the very parameters of the lowest loss
    assert min(b - a for a, b in zip(falls, falls[1:], strict=False)) >= PATIENCE


@pytest.mark.parametrize("at", range(2, 40, 3))
def test_an_interrupted_run_goes_on_as_it_would_have(at: int, tmp_path: Path) -> None:
    def problem(stop: int | None = None) -> Problem:
        x = torch.zeros(1, dtype=torch.float64, requires_grad=True)
        calls = iter(range(1000))

        def loss() -> torch.Tensor:
            if next(calls) == stop:
                raise KeyboardInterrupt
            return cliff(x)

        return Problem("cliff", {"x": x}, [Stage(loss, STEPS, RATE, rough=True)], lambda: {"x": x.item()})

    with pytest.raises(KeyboardInterrupt):
        solve(problem(at), Settings(tmp_path))
    losses = [row["loss"] for row in solve(problem(), Settings(tmp_path)).history]
    assert losses == course(rough=True)
    assert min(steps_back(losses)) < 20 < max(steps_back(losses))


def test_what_cannot_be_rough_is_refused(tmp_path: Path) -> None:
    x = torch.zeros(1, requires_grad=True)

    def run(stage: Stage) -> None:
        solve(Problem("cliff", {"x": x}, [stage], lambda: {}), Settings(tmp_path))

    with pytest.raises(ValueError, match=r"stages\[0\].rough: expected False beside an optimizer .*, got True"):
        run(Stage(lambda: cliff(x), 1, optimizer=torch.optim.SGD, rough=True))
    with pytest.raises(TypeError, match=r"stages\[0\].rough: expected a bool, got 'yes'"):
        run(Stage(lambda: cliff(x), 1, rough="yes"))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="rough: expected a loss that is not negative, got -1"):
        run(Stage(lambda: x.sum() - 1, 5, rough=True))
