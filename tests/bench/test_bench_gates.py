"""Benchmarks whose quick run is a gate: what they measure of physics, of advice and of silence holds."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from helpers.marks import quick_and_slow

import diffvbd as dv
from bench import contact, contact_gates, extremes, tables
from bench.__main__ import main
from diffvbd.testing import tolerance

QUICK = [case for case in extremes.FEATURE_CASES if case.axis in extremes.QUICK_AXES]
QUICK_EXTREMES = [case for case in extremes.CASES if case.quick]
FEW = ("coarse, free", "BDF2, free", "floor, friction", "pairs, friction")
LONG = ("pairs, friction", "float32, size 1e-4 m")


def results_of(name: str, out: Path, *arguments: str) -> dict[str, Any]:
    """What `python -m bench NAME --quick` writes."""
    assert main([name, "--quick", "--out", str(out), *arguments]) == 0
    content = json.loads((out / f"{name}.json").read_text())
    assert {"date", "commit", "torch", "device"} <= set(content["environment"])
    assert "| --- |" in tables.text_of(name, content["results"])
    return content["results"]


def test_a_plain_step_calls_two_operators() -> None:
    model = dv.Model(dv.mesh.cube(3), pinned=[0])
    x = model.rest_points
    dv.step(model, x, 0 * x, dv.VBD(0.01, 5), mu=1e5, lam=1e5)  # arranges what lasts
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CPU]) as seen:
        dv.step(model, x, 0 * x, dv.VBD(0.01, 5), mu=1e5, lam=1e5)
    called = {event.key: event.count for event in seen.key_averages() if event.key.startswith("diffvbd::")}
    assert called == {"diffvbd::begin": 1, "diffvbd::sweep": 1} and model.surface_of_contact is None


def test_advice_is_kept_and_sure(tmp_path: Path) -> None:
    rows = results_of("advice", tmp_path)["kept"]["rows"]
    assert len(rows) == 2
    for row in rows:
        assert row["reached"] and 0 < row["true"] <= row["asked"] and row["unsure"] < 0.5 * row["asked"]


@pytest.mark.parametrize("seed", range(3))
def test_nothing_crosses_in_a_few_scenes_that_are_drawn(seed: int) -> None:
    crossings, lost, steps, cut = contact._crossings(seed, "cpu", batch=2)
    assert crossings == lost == 0 and steps > 0 and cut > 0


@pytest.mark.slow
def test_nothing_crosses_in_scenes_that_are_drawn(tmp_path: Path) -> None:
    rows = results_of("contact", tmp_path, "--only", "fuzz")["fuzz"]["rows"]
    assert sum(row["scene_steps"] for row in rows) >= 120  # a batch ends where a scene leaves its bodies no way
    assert all(row["crossings"] == row["nonfinite"] == 0 for row in rows)
    assert max(row["cut"] for row in rows) > 0.05


@pytest.mark.parametrize("group", quick_and_slow(["gradient"], ["gradient", "violent"]))
def test_gates_of_contact_that_are_met(group: str, tmp_path: Path) -> None:
    for row in results_of("contact_gates", tmp_path, "--only", group)[group]["rows"]:
        assert {"gate", "case", "value", "reference", "bar", "seconds", "note"} <= set(row)
        assert row["met"] and row["seconds"] > 0, row


def raising(device: str) -> None:
    raise RuntimeError("not today")


def test_a_gate_is_not_met_by_an_error_and_parts_of_a_step_are_seen() -> None:
    rows, _ = contact_gates.measured((0, raising, {}), "cpu")
    assert isinstance(rows, list)
    (row,) = rows
    assert not row["met"] and "not today" in row["note"]
    assert set(contact_gates.contact_scenes.risen(3, "cpu")) == set(contact_gates.contact_scenes.PARTS)
    found = contact_gates.over([3], raising, "cpu")
    assert found["ends"] == {} and "scene 3" in found["raised"][0]
    for rows in (contact_gates.contact_scenes.flight_rows({}, found["raised"]),
                 contact_gates.contact_scenes.descent_rows({}, found["raised"]),
                 contact_gates.contact_scenes.gradient_rows({}, found["raised"], 1),
                 contact_gates.lost_rows({}, found["raised"], 8)):  # fmt: skip
        assert not any(row["met"] for row in rows)


def test_integrators_of_second_order_and_impacts_that_gain_nothing(tmp_path: Path) -> None:
    results = results_of("integrators", tmp_path)
    (row,) = results["beam"]["rows"]
    for name in ("SDIRK2", "BDF2"):
        assert 0 < row[f"{name}, error"] < 0.3 * row["implicit Euler, error"]
    for row in results["impacts"]["rows"]:
        assert row["most gained"] <= tolerance("energy_gain") and 0 < row["left"] < 1 and row["lowest gap [m]"] > 0


@pytest.mark.slow
def test_two_ranks_have_the_bits_of_one(tmp_path: Path) -> None:
    assert main(["scale", "--device", "cpu", "--quick", "--out", str(tmp_path)]) == 0
    results = json.loads((tmp_path / "scale.json").read_text())["results"]
    rows = [row for rows in results.values() for row in rows]
    assert [row["same_bits"] for row in rows] == [None, None, True, None, None, True]


@pytest.mark.parametrize(
    "case",
    quick_and_slow([c for c in QUICK if c.feature in FEW and (c.feature, c.axis) != LONG], QUICK),
    ids=lambda c: f"{c.feature}: {c.axis}",
)
def test_extremes_are_finite_cross_nothing_and_are_not_silent(case: extremes.Case) -> None:
    if case.feature.startswith("pairs, ") and case.axis.startswith("float32"):
        case = replace(case, steps=8)  # of which each takes a second; "pairs" takes all
    row = extremes.check_feature(case)
    assert row["finite"] and not row["raised"] and not row["silent"] and row["crossings"] == 0, row
    if case.axis == "none":
        assert row["gain"] <= extremes.GAIN and extremes.gradient_verdict(row) == "alike", row


def test_an_extreme_of_no_use_is_warned_of() -> None:
    (case,) = [c for c in QUICK if (c.feature, c.axis) == ("plain, free", "mu 1e10 Pa, K = 1")]
    row = extremes.check_feature(case)
    assert row["useless"] and row["warned"] == "sweeps" and row["gain"] > 1


# --- extreme inputs stay finite, descend and keep their gradients: the quick part of `python -m bench extremes` ---


@pytest.mark.parametrize("case", QUICK_EXTREMES, ids=lambda case: f"{case.axis}: {case.name}")
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
