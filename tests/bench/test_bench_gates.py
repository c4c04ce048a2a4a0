"""Benchmarks whose quick run is a gate: what they measure of physics, of advice and of silence holds."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bench import absent, advice, extremes, floors, floors_scenes, integrators, stifftasks
from bench import extremes_features as features
from bench.__main__ import main
from bench.floors_newton import Body
from bench.stifftasks_scenes import bodies
from diffvbd.testing import tolerance

QUICK = [case for case in features.CASES if case.axis in features.QUICK]
FEW = ("coarse, free", "BDF2, free", "floor, friction", "pairs, friction")


def results_of(name: str, out: Path) -> dict[str, Any]:
    """What `python -m bench NAME --quick` writes."""
    assert main([name, "--quick", "--out", str(out)]) == 0
    content = json.loads((out / f"{name}.json").read_text())
    assert {"date", "commit", "torch", "device"} <= set(content["environment"])
    return content["results"]


def test_a_plain_step_calls_two_operators_and_keeps_nothing_of_a_feature() -> None:
    model, once = absent.scene(absent.Feature(), True, "cpu")
    assert absent.counted(once).own() == {"diffvbd::begin": 1, "diffvbd::sweep": 1}
    assert model.surface_of_contact is None
    more, _ = absent.scene(absent.FEATURES["coarse corrections"], True, "cpu")
    assert absent.model_bytes(more) > absent.model_bytes(model)


def test_advice_is_kept_and_sure() -> None:
    rows = advice.run(quick=True, only="kept")["kept"]["rows"]
    assert len(rows) == 2
    for row in rows:
        assert row["reached"] and 0 < row["true"] <= row["asked"] and row["unsure"] < 0.5 * row["asked"]


def test_nothing_crosses_in_scenes_that_are_drawn(tmp_path: Path) -> None:
    rows = results_of("contact_fuzz", tmp_path)["rows"]
    assert sum(row["scene_steps"] for row in rows) >= 150
    assert all(row["crossings"] == row["nonfinite"] == 0 for row in rows)
    assert max(row["cut"] for row in rows) > 0.05


def a_ball(friction: float) -> floors_scenes.Scene:
    """71 vertices, which meet the floor at 2 m/s."""
    mesh = floors_scenes.ball(0.05, 0.025)
    mesh = mesh.translate((0.0, 0.004 - mesh.points[:, 1].min(), 0.0))
    body = Body(mesh.points, mesh.tets, 1e5, 0.3, 2e-3, 6e4, 3e-3, friction=friction, gravity=(0.0, -9.81, 0.0))
    return floors_scenes.Scene("ball", mesh, body, np.zeros_like(mesh.points) + (0.5, -2.0, 0.0), 12)


@pytest.mark.parametrize(("coarse", "friction"), [(None, 0.0), (None, 0.3), ("auto", 0.0)])
def test_sweeps_on_a_floor_come_to_a_converged_step_that_shares_no_code(coarse: Any, friction: float) -> None:
    scene = a_ball(friction)
    exact = scene.body.rollout(scene.mesh.points, scene.v, scene.steps)
    assert max(scene.body.iterations) > 3 and exact[1][-1, :, 1].mean() > 0.5  # it has left the floor again
    motion, _, _ = scene.executed(200, coarse)
    assert max(floors.apart(scene, motion, exact).values()) < tolerance("converged_floor")


def test_integrators_of_second_order_and_impacts_that_gain_nothing() -> None:
    results = integrators.run(quick=True)
    (row,) = results["beam"]
    for name in ("SDIRK2", "BDF2"):
        assert 0 < row[f"{name}, error"] < 0.3 * row["implicit Euler, error"]
    for row in results["impacts"]:
        assert row["most gained"] <= tolerance("energy_gain") and 0 < row["left"] < 1 and row["lowest gap [m]"] > 0


def test_the_rigid_correction_keeps_momentum_and_the_coarse_one_finds_the_shape() -> None:
    spinning, _, cantilever = bodies(True)[3:]
    rows = {(row["sweeps"], row["rigid"], row["coarse"]): row for row in stifftasks.of_body(spinning, True)}
    for (_, rigid, _), row in rows.items():
        for name in ("momentum", "angular_momentum"):
            assert row[name] < tolerance("sum") if rigid else row[name] > 1e-4
    plain, coarse = (r for r in stifftasks.of_body(cantilever, True) if r["sweeps"] == 10)
    assert coarse["error"] < 0.1 * plain["error"]


@pytest.mark.slow
def test_two_ranks_have_the_bits_of_one(tmp_path: Path) -> None:
    assert main(["scale", "--device", "cpu", "--quick", "--out", str(tmp_path)]) == 0
    results = json.loads((tmp_path / "scale.json").read_text())["results"]
    rows = [row for rows in results.values() for row in rows]
    assert [row["same_bits"] for row in rows] == [None, None, True, None, None, True]


@pytest.mark.parametrize(
    "case",
    [pytest.param(c, marks=[] if c.feature in FEW else pytest.mark.slow) for c in QUICK],
    ids=lambda c: f"{c.feature}: {c.axis}",
)
def test_extremes_are_finite_cross_nothing_and_are_not_silent(case: features.Extreme) -> None:
    row = features.check(case)
    assert row["finite"] and not row["raised"] and not row["silent"] and row["crossings"] == 0, row
    if case.axis == "none":
        assert row["gain"] <= features.GAIN and features.verdict(row) == "alike", row


def test_an_extreme_of_no_use_is_warned_of() -> None:
    (case,) = [c for c in QUICK if (c.feature, c.axis) == ("plain, free", "mu 1e10 Pa, K = 1")]
    row = features.check(case)
    assert row["useless"] and row["warned"] == "sweeps" and row["gain"] > 1


# --- extreme inputs ---------------------------------------------------------------------------------------------------


INPUTS = [case for case in extremes.CASES if case.quick]


@pytest.mark.parametrize("case", INPUTS, ids=lambda case: f"{case.axis}: {case.name}")
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
