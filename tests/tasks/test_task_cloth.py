"""Claim: gradients through falling and blown cloth find its stiffness, its size and the wind, and say what of the wind
can be seen."""

import math
from pathlib import Path

import pytest
import torch
from helpers.marks import slow
from helpers.task_checks import check_fall, check_gradient, quick

import diffvbd as dv
from diffvbd.tasks.cape_wind import TRUE_WIND
from diffvbd.tasks.dress_size import cut
from diffvbd.tasks.flag_wind import reference_wind
from diffvbd.testing import tolerance

NAMES = ("cape-mu", "cape-wind", "dress-size", "flag-wind")


@pytest.mark.parametrize(("name", "factor"), [("cape-mu", 1e-4), slow("dress-size", 1e-4)])
def test_quick_run_recovers_the_truth(name: str, factor: float, tmp_path: Path) -> None:
    result = check_fall(name, tmp_path, factor)
    (error,) = result.errors.values()
    assert error < tolerance("recovered_cloth")


def test_quick_run_recovers_the_wind_of_a_cape(tmp_path: Path) -> None:
    result = check_fall("cape-wind", tmp_path, 1e-5)
    assert set(result.errors) == {"wind_x", "wind_z"}
    assert max(result.errors.values()) < tolerance("recovered_wind")
    assert abs(result.estimates["wind_y"]) < tolerance("recovered_wind") * math.hypot(*TRUE_WIND)
    assert result.history[0]["deviation"] == 1.0
    assert result.estimates["deviation"] < tolerance("recovered_wind")


@pytest.mark.parametrize("name", NAMES)
def test_gradient_matches_central_differences(name: str, tmp_path: Path) -> None:
    check_gradient(name, tmp_path, step=1e-5, rel=tolerance("finite_difference"))


def test_singular_values_are_those_of_the_loss(tmp_path: Path) -> None:
    problem, _ = quick("flag-wind", tmp_path)
    (stage,), wind = problem.stages, problem.parameters["wind"]
    assert problem.findings is not None
    with torch.no_grad():
        wind.copy_(reference_wind())
    values = problem.findings([])["singular_values"]
    assert problem.stages[0].loss().item() == 0.0
    # squared and summed over all directions: the trace of the loss's quadratic form
    trace, step = 0.0, 1e-3
    for k in range(wind.numel()):
        with torch.no_grad():
            wind.copy_(reference_wind())
            wind.view(-1)[k] += step
            trace += stage.loss().item() / step**2
    assert sum(value**2 for value in values) == pytest.approx(trace, rel=tolerance("one_sided_difference"))


@pytest.mark.parametrize("size", [0.45, 0.91, 1.3])
def test_cut_is_the_dress_of_that_size_in_the_same_cloth(size: float) -> None:
    one = dv.mesh.dress(8, 6, 0.01, neck_height=1.45, hem_height=0.65)
    other = dv.mesh.dress(8, 6, 0.01, neck_height=1.45, hem_height=1.45 - 0.8 * size, scale=size)
    neck = torch.tensor([0.0, 1.45, 0.0], dtype=torch.float64)
    points = cut(torch.tensor(one.points), torch.tensor(size, dtype=torch.float64), neck)
    torch.testing.assert_close(points, torch.tensor(other.points), rtol=0.0, atol=tolerance("geometry"))
