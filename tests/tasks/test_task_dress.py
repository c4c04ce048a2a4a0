"""Claim: the drape and the first frames of a dress give its Lame parameters, from vertices and from its outline."""

import warnings
from pathlib import Path

import pytest
import torch
from helpers.marks import slow
from helpers.task_checks import check_fall, check_gradient

from diffvbd.tasks import TASKS, Settings, dress
from diffvbd.tasks.dress import SOFTNESS, profile
from diffvbd.testing import tolerance

HEIGHTS = torch.tensor([0.1, 0.4, 0.7], dtype=torch.float64)


@pytest.mark.parametrize("name", ["dress-mu-lam", slow("dress-silhouette")])
def test_quick_run_recovers_the_material(name: str, tmp_path: Path) -> None:
    # stages after the first begin near their end; from vertices, they find it from farther away, too
    iterations = 16 if name == "dress-mu-lam" else None
    result = check_fall(name, tmp_path, factor=1e-3, whole=True, iterations=iterations)
    # what the alternation adds to stage A
    entered = next(row for row in result.history if row["stage"] == 1)
    assert max(result.errors.values()) < tolerance("recovered_dress") < 0.01 < abs(entered["lam"] / 800 - 1)


@pytest.mark.parametrize("stage", [0, 1, 2])
@pytest.mark.parametrize("name", ["dress-mu-lam", "dress-silhouette"])
def test_gradient_matches_central_differences(name: str, stage: int, tmp_path: Path) -> None:
    # limits and closest points have kinks; differences step over some
    check_gradient(name, tmp_path, step=1e-6, rel=tolerance("kinked_difference"), stage=stage)


def test_stages_alternate_and_each_objective_moves_one_parameter(tmp_path: Path) -> None:
    problem = dress.dress_mu_lam(Settings(tmp_path, quick=True))
    first, *rest = problem.stages
    assert first.moves is None
    assert [stage.moves for stage in rest] == [("log_mu",), ("log_lam",)] * (len(rest) // 2)
    alone = dress.problem("dress-mu-lam", Settings(tmp_path, quick=True), lambda frames: frames, alone=True)
    assert [stage.name for stage in alone.stages] == [stage.name for stage in rest]


@pytest.mark.parametrize("name", ["dress-mu-lam", "dress-size"])
def test_few_sweeps_of_a_coarse_dress_are_no_news(name: str, tmp_path: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        problem = TASKS[name].build(Settings(tmp_path, quick=True))
        problem.stages[0].loss()


def around(radius: torch.Tensor, heights: torch.Tensor, turn: float = 0.0) -> torch.Tensor:
    """Rings of 12 points about the y axis, of a radius at each height."""
    angle = turn + 2 * torch.pi * torch.arange(12, dtype=torch.float64) / 12
    ring = torch.stack([angle.cos(), torch.zeros_like(angle), angle.sin()], -1)
    up = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    return (radius[:, None, None] * ring + heights[:, None, None] * up).reshape(-1, 3)


def test_profile_is_the_radius_of_the_outline_and_forgets_which_vertex_is_where() -> None:
    radius = torch.tensor([0.3, 0.2, 0.1], dtype=torch.float64)
    outline = around(radius, HEIGHTS)
    torch.testing.assert_close(profile(outline, HEIGHTS), radius, rtol=0, atol=tolerance("softened"))
    # an inner layer hides behind the outer one, up to exp(-distance / SOFTNESS) of its distance
    inner = around(radius - 0.05, HEIGHTS)
    both = torch.cat([inner, outline])
    expected = radius - 0.05 / (1 + torch.tensor(0.05 / SOFTNESS).exp())
    torch.testing.assert_close(profile(both, HEIGHTS), expected, rtol=0, atol=tolerance("softened"))
    order = torch.randperm(len(both), generator=torch.Generator().manual_seed(0))
    frames = torch.stack([both[order], torch.cat([around(radius - 0.05, HEIGHTS, 0.3), around(radius, HEIGHTS, 0.7)])])
    torch.testing.assert_close(profile(frames, HEIGHTS), expected.expand(2, 3), rtol=0, atol=tolerance("softened"))
