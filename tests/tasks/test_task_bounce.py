"""Claim: gradients through a bounce bring a thrown body's center of mass to a target that the first throw misses."""

from pathlib import Path

import pytest
from helpers.marks import slow
from helpers.task_checks import check_fall, check_gradient

from diffvbd.testing import tolerance

NAMES = ("cube-bounce", "bunny-bounce")


@pytest.mark.parametrize("name", ["cube-bounce", slow("bunny-bounce")])
def test_quick_run_comes_close_after_the_bounce(name: str, tmp_path: Path) -> None:
    result = check_fall(name, tmp_path, factor=0.02)
    # of a motion of this size
    assert result.estimates["distance"] < 0.034 < 0.29 < result.history[0]["distance"]
    assert result.estimates["distance"] ** 2 == pytest.approx(result.best["loss"], rel=tolerance("cancelling"))
    found = result.findings
    assert found["start_distance"] == result.history[0]["distance"]
    assert 0 < found["first_contact"] < found["closest_approach"] and found["envelope"] > 0.5


@pytest.mark.parametrize("name", NAMES)
def test_gradient_matches_central_differences(name: str, tmp_path: Path) -> None:
    check_gradient(name, tmp_path, step=1e-6, rel=tolerance("long_difference"))
