"""Claim: gradients through two hundred steps of very many bodies, with pushes between them, bring each to its place."""

from pathlib import Path

import pytest
import torch
from helpers.task_checks import check_fall, check_gradient, quick, timeless

from diffvbd.tasks import Settings, million_cubes, solve
from diffvbd.tasks.million_cubes import RADIUS, is_near
from diffvbd.testing import tolerance

NAME = "million-cubes"


@pytest.mark.slow
def test_quick_run_brings_bodies_to_their_places(tmp_path: Path) -> None:
    result = check_fall(NAME, tmp_path, factor=0.9)
    errors = [row["mean_error"] for row in result.history]
    assert errors[0] > 0.03 and result.estimates["mean_error"] < 0.03 * errors[0]
    assert result.findings["mean_error_with_contact"] == result.estimates["mean_error"]


@pytest.mark.parametrize("stage", [0, 1])
def test_gradient_matches_central_differences(stage: int, tmp_path: Path) -> None:
    # the gradient of the material is tiny beside that of the velocity: differences of it have few digits
    check_gradient(NAME, tmp_path, step=1e-4, rel=tolerance("coarse_difference"), stage=stage)


def test_an_interrupted_run_continues_in_the_second_stage(tmp_path: Path) -> None:
    def run(folder: Path, fail_at: int | None) -> list[dict[str, float]]:
        problem, settings = quick(NAME, folder)
        for stage in problem.stages:
            stage.iterations = 4
        loss, calls = problem.stages[1].loss, iter(range(100))

        def failing() -> torch.Tensor:
            if next(calls) == fail_at:
                raise KeyboardInterrupt
            return loss()

        problem.stages[1].loss = failing
        return timeless(solve(problem, settings).history)

    whole = run(tmp_path / "whole", None)
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "parts", 2)
    assert run(tmp_path / "parts", None) == whole


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("away", [0.0, 1e3])
def test_bodies_near_others_leave_out_no_pair(away: float, dtype: torch.dtype) -> None:
    generator = torch.Generator().manual_seed(0)
    points = (away + 0.03 * torch.rand(2000, 3, generator=generator, dtype=torch.float64)).to(dtype)
    some = points[points[:, 0] < away + 0.01]
    near = is_near(some, points)
    pair = (points[:, None] - some).square().sum(-1) < RADIUS**2
    assert bool((near | ~pair.any(1)).all()) and len(some) < int(near.sum()) < 0.7 * len(points)
    for broken in (torch.nan, torch.inf):
        points[-1, 1] = broken
        assert bool(is_near(some, points).all())


def test_bad_options_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="bodies: expected at least 1, got 0"):
        million_cubes.problem(Settings(tmp_path), bodies=0)
    for wrong in ({"bodies": 65}, {"steps": 240}):
        with pytest.raises(ValueError, match="at most 64|none beside --quick"):
            quick(NAME, tmp_path, **wrong)
    with pytest.raises(ValueError, match="steps: expected at least 120, .* got 119"):
        million_cubes.problem(Settings(tmp_path), bodies=4, steps=119)
    with pytest.raises(ValueError, match="iterations: expected at least 1, got 0"):
        million_cubes.problem(Settings(tmp_path), bodies=4, iterations=0)
