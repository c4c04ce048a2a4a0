"""Extreme inputs stay finite, descend and keep their gradients: the quick part of `python -m bench extremes`."""

import pytest

from bench import extremes
from diffvbd.testing import tolerance

QUICK = [case for case in extremes.CASES if case.quick]


@pytest.mark.parametrize("case", QUICK, ids=lambda case: f"{case.axis}: {case.name}")
def test_case_is_finite_descends_and_keeps_its_gradient(case: extremes.Extreme) -> None:
    row = extremes.check(case)
    assert row["finite"]
    if row["must_descend"]:
        assert row["rise"] <= extremes.RISE
    # the bar of the exactness tests, or the conditioning where that is larger
    assert extremes.verdict(row) in ("ok", "conditioning")


@pytest.mark.parametrize("floor", [False, True], ids=["cantilever", "drop"])
def test_rollout_of_hundreds_of_steps(floor: bool) -> None:
    # later on the floor the loss hardly depends on the stiffness, and differences of it are rounding
    row = extremes.check_rollout(extremes.Rollout("short", 200 if floor else 300, floor=floor))
    assert row["finite"] and row["gradient"] != 0.0
    assert row["difference_error"] < tolerance("long_difference")
    if floor:
        assert row["lowest"] > -0.2
