"""The shipped inverse problems find what they look for, with the gradient they claim, and survive an interruption."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.task_checks import check_gradient, quick, timeless

from diffvbd import losses
from diffvbd.tasks import TASKS, Settings, beam, solve, table
from diffvbd.testing import tolerance

MATERIAL = sorted(name for name in TASKS if name.startswith("beam"))


@pytest.mark.parametrize("name", MATERIAL)
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


def test_log_and_picture_are_written(tmp_path: Path) -> None:
    settings = Settings(tmp_path, quick=True)
    result = solve(beam.beam_mu(settings), settings)
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


def test_twist_turns_the_free_end_and_keeps_the_clamped_one() -> None:
    points = torch.tensor([[0.0, 0.0, 0.0], [0.0, 2.0, 2.0], [4.0, 0.0, 0.0], [4.0, 2.0, 2.0]], dtype=torch.float64)
    turned = beam.twisted(points, torch.pi)
    expected = points[[0, 1, 3, 2]].clone()
    expected[2:, 0] = 4.0
    torch.testing.assert_close(turned, expected, rtol=0, atol=tolerance("formula"))


def test_huber_is_quadratic_then_linear_with_a_finite_gradient() -> None:
    x = torch.tensor([[0.0, 0.0, 0.0], [0.3, 0.0, 0.4], [3.0, 4.0, 0.0]], dtype=torch.float64, requires_grad=True)
    loss = losses.huber(x, torch.zeros(3, dtype=torch.float64), delta=1.0)
    assert loss.item() == pytest.approx((0.0 + 0.125 + 4.5) / 3)
    loss.backward()
    expected = torch.tensor([[0.0, 0.0, 0.0], [0.3, 0.0, 0.4], [0.6, 0.8, 0.0]], dtype=torch.float64) / 3
    torch.testing.assert_close(x.grad, expected)
    with pytest.raises(ValueError, match="delta: expected a finite number > 0 m, got 0"):
        losses.huber(x, x, 0.0)


def test_center_of_mass_weighs_by_mass() -> None:
    x = torch.tensor([[[0.0, 0.0, 0.0], [4.0, 0.0, 8.0]]], dtype=torch.float64)
    center = losses.center_of_mass(x, torch.tensor([3.0, 1.0], dtype=torch.float64))
    assert center.tolist() == [[1.0, 0.0, 2.0]]
    assert losses.vertex_distance(center, torch.zeros(3)).item() == 5.0


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


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(TASKS))
def test_two_runs_have_the_same_numbers(name: str, tmp_path: Path) -> None:
    histories = []
    for k in range(2):
        problem, settings = quick(name, tmp_path / str(k))
        for stage in problem.stages:
            stage.iterations = min(stage.iterations, 5)
        histories.append(timeless(solve(problem, settings).history))
    assert histories[0] == histories[1]
    assert histories[0][0]["loss"] != histories[0][-1]["loss"] != 0.0


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
