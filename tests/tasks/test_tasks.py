"""The shipped inverse problems find what they look for, with the gradient they claim, and survive an interruption."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.marks import quick_and_slow
from helpers.task_checks import check_gradient, quick, timeless

from diffvbd import losses
from diffvbd.tasks import TASKS, Settings, beam_mu, solve, table
from diffvbd.testing import tolerance

MATERIAL = sorted(name for name in TASKS if name.startswith("beam"))


@pytest.mark.parametrize("name", quick_and_slow(MATERIAL[:1], MATERIAL))
def test_quick_run_recovers_the_material(name: str, tmp_path: Path) -> None:
    problem, settings = quick(name, tmp_path)
    result = solve(problem, settings)
    start = result.history[0]
    assert result.best["loss"] < tolerance("quick_fall") * result.history[0]["loss"]
    for quantity, error in result.errors.items():
        assert error < 0.02 < abs(start[quantity] / problem.truth[quantity] - 1)
    assert f"{result.estimates['mu']:.6g}" in table(problem, result)


@pytest.mark.parametrize("name", MATERIAL)
def test_gradient_at_the_start_matches_central_differences(name: str, tmp_path: Path) -> None:
    # Truncation falls with the square of the step, rounding grows with its inverse: about 1e-9 at 1e-5.
    check_gradient(name, tmp_path, step=1e-5, rel=tolerance("finite_difference"))


@pytest.mark.slow
def test_log_and_picture_are_written(tmp_path: Path) -> None:
    settings = Settings(tmp_path, quick=True)
    result = solve(beam_mu.problem(settings), settings)
    log = json.loads((tmp_path / "log.json").read_text())
    assert {"diffvbd", "torch", "numpy", "python"} <= set(log["versions"])
    assert log["settings"]["seed"] == 0
    assert log["history"] == result.history
    assert set(log["history"][0]) == {"iteration", "loss", "gradient_norm", "mu", "seconds"}
    assert log["best"]["loss"] == min(row["loss"] for row in log["history"])
    if pytest.importorskip("matplotlib"):
        assert (tmp_path / "picture.png").read_bytes().startswith(b"\x89PNG")
    assert not (tmp_path / "state.pt").exists()


class Interrupted(Exception):
    pass


@pytest.mark.slow
def test_an_interrupted_run_continues_with_the_same_numbers(tmp_path: Path) -> None:
    problem, settings = quick("beam-mu", tmp_path / "whole")
    whole = solve(problem, settings)

    problem, settings = quick("beam-mu", tmp_path / "parts")
    loss, evaluations = problem.stages[0].loss, 0

    def failing() -> torch.Tensor:
        nonlocal evaluations
        evaluations += 1
        if evaluations == 8:
            raise Interrupted
        return loss()

    problem.stages[0].loss = failing
    with pytest.raises(Interrupted):
        solve(problem, settings)
    problem, settings = quick("beam-mu", tmp_path / "parts")
    parts = solve(problem, settings)
    assert timeless(parts.history) == timeless(whole.history)


def test_a_state_of_other_settings_is_not_continued(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    problem, settings = quick("beam-mu", tmp_path)
    loss, evaluations = problem.stages[0].loss, iter(range(3))
    problem.stages[0].loss = lambda: (next(evaluations), loss())[1]
    with pytest.raises(StopIteration):
        solve(problem, settings)
    problem, _ = quick("beam-mu", tmp_path)
    problem.stages[0].iterations = 2
    assert len(solve(problem, Settings(tmp_path, seed=1, quick=True)).history) == 2
    assert "starting anew" in capsys.readouterr().err


def test_a_loss_that_is_not_finite_is_reported(tmp_path: Path) -> None:
    problem, settings = quick("beam-mu", tmp_path)
    (parameter,) = problem.parameters.values()
    problem.stages[0].loss = lambda: parameter * float("nan")
    with pytest.raises(ArithmeticError, match="beam-mu: the loss or its gradient is not finite"):
        solve(problem, settings)


@pytest.mark.parametrize(
    ("loss", "kind", "says"),
    [
        (lambda x: losses.huber(x, x[:3], 0.1), ValueError, r"target: .* broadcasts to \[4, 3\], got \[3, 3\]"),
        (lambda x: losses.huber(x[:1], x, 0.1), ValueError, r"target: .* broadcasts to \[1, 3\], got \[4, 3\]"),
        (lambda x: losses.huber(x, x, "far"), TypeError, "delta: expected a number, got str"),
        (lambda x: losses.vertex_distance(x, x.numpy()), TypeError, "target: expected a tensor, got ndarray"),
        (lambda x: losses.vertex_distance([0.0], x), TypeError, "x: expected a tensor, got list"),
        (lambda x: losses.center_of_mass(x, torch.ones(3)), ValueError, r"mass: expected shape \[4\], .* shape \[3\]"),
        (lambda x: losses.center_of_mass(x, torch.ones(1)), ValueError, r"mass: expected shape \[4\], .* shape \[1\]"),
        (lambda x: losses.center_of_mass(x, np.ones(4)), TypeError, "mass: expected a tensor, got ndarray"),
    ],
)
def test_losses_name_what_does_not_fit(loss: Callable[[torch.Tensor], object], kind: type, says: str) -> None:
    with pytest.raises(kind, match=says):
        loss(torch.zeros(4, 3))


@pytest.mark.cuda
@pytest.mark.parametrize("name", sorted(TASKS))
def test_captured_run_has_the_numbers_of_an_eager_one(name: str, tmp_path: Path) -> None:
    histories = []
    for capturable in (True, False):
        settings = Settings(tmp_path / str(capturable), device="cuda", quick=True)
        problem = TASKS[name].build(settings)
        problem.picture = None
        for stage in problem.stages:
            stage.iterations = min(stage.iterations, 4)
            assert stage.capturable
            stage.capturable = capturable
        histories.append(timeless(solve(problem, settings).history))
    assert histories[0] == histories[1]
    assert histories[0][0]["loss"] != histories[0][3]["loss"] != 0.0
