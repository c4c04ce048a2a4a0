"""Claim: gradients through a stretched sheet, its contact with a ball and the flight find a throw that meets a goal."""

from pathlib import Path

import pytest
import torch
from helpers.task_checks import check_fall, check_gradient

from diffvbd.tasks.throw import inside, spline
from diffvbd.testing import tolerance


@pytest.mark.slow
def test_quick_run_throws_closer(tmp_path: Path) -> None:
    result = check_fall("throw", tmp_path, factor=0.2)
    assert result.history[0]["miss"] > 0.5
    assert result.estimates["miss"] < 0.5 * result.history[0]["miss"]


def test_gradient_matches_central_differences(tmp_path: Path) -> None:
    # nearest features change on the way; differences step over some of these kinks
    check_gradient("throw", tmp_path, step=1e-6, rel=tolerance("kinked_difference"))


def test_spline_starts_and_ends_at_rest() -> None:
    knot = 0.06
    times = torch.linspace(0, 0.6, 601, dtype=torch.float64)
    weights = spline(times, 4, knot)
    peaks = times[weights.argmax(0)]
    assert peaks.tolist() == pytest.approx([0.12, 0.18, 0.24, 0.3], abs=times[1].item())
    assert weights.amax(0).tolist() == pytest.approx([2 / 3] * 4)
    speed = weights.diff(dim=0)
    for values in (weights, speed):
        assert values[0].abs().max().item() < (times[1].item() / knot) ** 3
        assert values[-1].abs().max().item() == 0.0
    # equal control points are that height wherever all neighbours take part
    both = (times >= 0.18) & (times <= 0.24)
    assert weights[both].sum(1).tolist() == pytest.approx([1.0] * int(both.sum()))
    acceleration = speed.diff(dim=0) / 1e-6
    jump = acceleration.diff(dim=0).abs().max().item()
    assert jump == pytest.approx(3 / knot**3 * 1e-3, rel=tolerance("third_difference"))


def test_inside_wants_every_point() -> None:
    box = ((0.0, 0.0, 0.0), (1.0, 2.0, 3.0))
    points = torch.tensor([[0.5, 1.9, 2.9], [0.1, 0.1, 0.1]])
    assert inside(points, box)
    for axis, beyond in ((0, 1.1), (1, 2.1), (2, -0.1)):
        moved = points.clone()
        moved[1, axis] = beyond
        assert not inside(moved, box)
