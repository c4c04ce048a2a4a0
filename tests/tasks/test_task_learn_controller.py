"""Claim: gradients through 64 rollouts at once train a network that drives a soft arm to where it must be."""

import sys
from pathlib import Path

import pytest
import torch
from helpers.task_checks import check_fall, check_gradient
from torch import nn

from diffvbd.tasks import Settings, learn_controller
from diffvbd.tasks.learn_controller import around, cma_es, policies, vector
from diffvbd.testing import tolerance


@pytest.mark.slow
def test_quick_run_learns(tmp_path: Path) -> None:
    result = check_fall("learn-controller", tmp_path, factor=0.1)
    assert result.history[0]["distance"] > 0.2
    assert result.findings["test"]["distance"] < result.history[0]["distance"]


def test_gradient_matches_central_differences(tmp_path: Path) -> None:
    check_gradient("learn-controller", tmp_path, step=1e-6, rel=tolerance("long_difference"))


def test_seeds_change_scenes_and_network(tmp_path: Path) -> None:
    def first_loss(seed: int) -> float:
        return learn_controller.problem(Settings(tmp_path, seed=seed, quick=True)).stages[0].loss().item()

    assert first_loss(0) == first_loss(0)
    assert first_loss(0) != first_loss(1)


def test_policies_are_the_network_with_other_numbers() -> None:
    torch.manual_seed(0)
    network = nn.Sequential(nn.Linear(9, 4), nn.Tanh(), nn.Linear(4, 2)).double()
    vectors = torch.stack([vector(network), torch.randn(50, dtype=torch.float64)])
    seen = torch.randn((2, 5, 9), dtype=torch.float64)
    both = policies(network, vectors)(seen)
    assert torch.allclose(both[0], network(seen[0]), rtol=0, atol=tolerance("formula"))
    assert torch.allclose(both[1], policies(network, vectors[1])(seen[1]), rtol=0, atol=tolerance("formula"))
    nn.utils.vector_to_parameters(vectors[1], network.parameters())
    assert torch.allclose(both[1], network(seen[1]), rtol=0, atol=tolerance("formula"))


def test_around_keeps_its_distance() -> None:
    length = around(1000, (0.15, 0.35), torch.Generator().manual_seed(0)).norm(dim=1)
    assert 0.15 <= length.min().item() < 0.16
    assert 0.34 < length.max().item() <= 0.35


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


def test_cma_es_says_what_it_needs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cma", None)
    with pytest.raises(ImportError, match=r"needs cma: pip install 'diffvbd\[tasks\]'"):
        cma_es(lambda rows: rows.sum(-1), torch.zeros(3), 0.0, seed=0)
