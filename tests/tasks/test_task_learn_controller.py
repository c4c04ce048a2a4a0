"""Claim: gradients through 64 rollouts at once train a network that drives a soft arm to where it must be."""

from pathlib import Path

import pytest
import torch
from helpers.task_checks import check_fall, check_gradient

from diffvbd.tasks.learn_controller import cma_es
from diffvbd.testing import tolerance


@pytest.mark.slow
def test_quick_run_learns(tmp_path: Path) -> None:
    result = check_fall("learn-controller", tmp_path, factor=0.1)
    assert result.history[0]["distance"] > 0.2
    assert result.findings["test"]["distance"] < result.history[0]["distance"]


def test_gradient_matches_central_differences(tmp_path: Path) -> None:
    check_gradient("learn-controller", tmp_path, step=1e-6, rel=tolerance("long_difference"))


def test_cma_es_lowers_a_loss_without_its_gradient() -> None:
    pytest.importorskip("cma")
    goal = torch.linspace(-1, 1, 5, dtype=torch.float64)

    def losses(rows: torch.Tensor) -> torch.Tensor:
        return (rows - goal).square().sum(-1)

    best, course, count = cma_es(losses, torch.zeros(5, dtype=torch.float64), 0.2, seed=0)
    assert losses(best[None]).item() == course[-1][1] < 0.1 * course[0][1]
    assert course[-1][0] >= 0.2
    assert count % len(course) == 0
    assert all(a[0] < b[0] and a[1] >= b[1] for a, b in zip(course, course[1:], strict=False))
    _, course, _ = cma_es(losses, torch.zeros(5, dtype=torch.float64), 0.0, seed=0)
    assert len(course) == 1
