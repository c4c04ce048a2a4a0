"""Claim: gradients through a stretched sheet, its contact with a ball and the flight find a throw that meets a goal."""

from pathlib import Path

import pytest
import torch
from helpers.task_checks import check_fall, check_gradient

from diffvbd.tasks.throw import inside
from diffvbd.testing import tolerance


@pytest.mark.slow
def test_quick_run_throws_closer(tmp_path: Path) -> None:
    result = check_fall("throw", tmp_path, factor=0.2)
    assert result.history[0]["miss"] > 0.5
    assert result.estimates["miss"] < 0.5 * result.history[0]["miss"]


def test_gradient_matches_central_differences(tmp_path: Path) -> None:
    # nearest features change on the way; differences step over some of these kinks
    check_gradient("throw", tmp_path, step=1e-6, rel=tolerance("kinked_difference"))


def test_inside_wants_every_point() -> None:
    box = ((0.0, 0.0, 0.0), (1.0, 2.0, 3.0))
    points = torch.tensor([[0.5, 1.9, 2.9], [0.1, 0.1, 0.1]])
    assert inside(points, box)
    for axis, beyond in ((0, 1.1), (1, 2.1), (2, -0.1)):
        moved = points.clone()
        moved[1, axis] = beyond
        assert not inside(moved, box)
