"""Extreme inputs stay finite, descend and keep their gradients: the quick part of `python -m bench extremes`."""

import json
from pathlib import Path

import pytest

from bench import common, extremes
from bench.__main__ import main
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


def test_every_axis_of_the_table_has_a_quick_case() -> None:
    # a start so stretched that double precision has no digits is a limit to document, not a promise to test
    assert {case.axis for case in QUICK} | {"huge strain"} == {case.axis for case in extremes.CASES}


def test_results_name_versions_and_no_paths(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = common.write("demo", {"value": float("nan"), "list": [1.23456789]}, tmp_path, text="## Table")
    content = json.loads(path.read_text())
    assert content["results"] == {"value": "nan", "list": [1.23457]}
    assert {"torch", "numpy", "python", "diffvbd", "commit", "dirty", "date", "cpu"} <= set(content["environment"])
    assert str(Path(common.__file__).resolve().parents[1]) not in path.read_text()
    assert "demo.json" in (tmp_path / "demo.md").read_text()
    assert main(["list"]) == 0
    assert "extremes" in capsys.readouterr().out
