"""The paper's benchmarks run, and what they measure bears out every claim that is not about time."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from helpers.marks import quick_and_slow

from bench import cost, exactness, paper, tables
from bench.__main__ import PAPER, main
from diffvbd.testing import tolerance

K1_ERROR = 0.1  # the equation's adjoint after one sweep: the paper measures 0.37, these scenes 0.14 and 0.24
OMITTED = 1e-4  # what leaving out a term of the adjoint costs at least: the paper's smallest is 2.9e-4
OURS, UNROLLED, GLOBAL = exactness.OURS, exactness.UNROLLED, exactness.GLOBAL


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("results")


@pytest.fixture(scope="module")
def quick(folder: Path) -> Callable[[str], dict[str, Any]]:
    """What a benchmark's quick run has written, once for the whole module."""
    done: dict[str, dict[str, Any]] = {}

    def content(name: str) -> dict[str, Any]:
        if name not in done:
            assert main([name, "--quick", "--out", str(folder)]) == 0
            done[name] = json.loads((folder / f"{name}.json").read_text())
        return done[name]

    return content


def check_exactness(results: dict[str, Any]) -> None:
    scenes = results["scenes"]
    assert set(scenes) == {"preset", "soft"}
    for rows in scenes.values():
        assert [row["sweeps"] for row in rows] == [1, 5, 20]
        for row in rows:
            assert set(row["routes"]) == {OURS, UNROLLED, *GLOBAL}
            assert all(route["forward"] <= tolerance("forward") for route in row["routes"].values())
            assert 0 < row["routes"][OURS]["error"] <= tolerance("headline")
            assert row["routes"][UNROLLED]["error"] <= tolerance("headline")
            # they solve the same systems, also where these are not those of the gradient
            assert row["global_difference"] <= tolerance("global_routes")
        for route in GLOBAL:
            errors = [row["routes"][route]["error"] for row in rows]
            assert (
                errors[0] > K1_ERROR
                and errors[0] > 100 * errors[1] > 1e4 * errors[2]
                and errors[2] < tolerance("twenty_sweeps")
            )
            assert all(row["routes"][route]["converged"] for row in rows)
        residuals = [row["residual"] for row in rows]
        assert residuals == sorted(residuals, reverse=True) and residuals[0] > 0.1
    assert any("file" in row["mesh"] for row in results["meshes"])
    for row in results["meshes"]:
        assert row["routes"][OURS]["error"] <= tolerance("headline")
    assert {row["axis"] for row in results["axes"]} == set(exactness.AXES)
    for row in results["axes"]:
        assert row["error"] <= row["bar"] and row["unrolled_error"] <= row["bar"]


def check_ablation(results: dict[str, Any]) -> None:
    error = {(row["variant"], row["vertices"]): row["error"] for row in results["rows"] if row["sweeps"] == 1}
    assert {vertices for _, vertices in error} == {26, 115}
    for (variant, vertices), value in error.items():
        if variant.startswith("full adjoint"):
            assert 0 < value <= tolerance("headline")
        elif not variant.startswith("validity gate"):
            assert value > OMITTED and (vertices == 26 or value > error[variant, 26])
    gate = {vertices: value for (variant, vertices), value in error.items() if variant.startswith("validity gate")}
    # no tet of the coarse mesh comes near inversion
    assert gate[26] <= tolerance("headline") and gate[115] > OMITTED


def check_cost(results: dict[str, Any]) -> None:
    rows = {row["route"]: row for row in results["routes"]}
    full, compact, unrolled = (rows[name] for name in (cost.FULL, cost.COMPACT, UNROLLED))
    assert all(row["forward"] <= tolerance("forward") for row in results["routes"])
    assert all(row["error"] <= tolerance("headline") for row in (full, compact, unrolled))
    assert 0 < full["memory"] < unrolled["memory"]
    # by every definition; the global routes keep no tape at all
    assert 0 < rows[GLOBAL[0]]["kept"] < compact["kept"] < full["kept"] < unrolled["kept"]
    soft, stiff = results["stiffness"][0], results["stiffness"][-1]
    assert soft["modulus"] < stiff["modulus"] == paper.STIFF_MODULUS
    for route in GLOBAL:
        assert rows[route]["converged"] and rows[route]["error"] > full["error"]
        assert stiff["routes"][route]["iterations"] > 2 * soft["routes"][route]["iterations"]
    for row in results["stiffness"]:
        assert row["routes"][cost.FULL]["error"] <= tolerance("headline")
        assert row["routes"][UNROLLED]["error"] <= tolerance("headline")


def check_fd(results: dict[str, Any]) -> None:
    rows = results["checks"]
    assert len(rows) == 11
    for row in rows:
        assert row.get("passed") or ("missing" in row and row["device"] == "cuda"), row["name"]
        for errors in row.get("errors", {}).values():
            assert len(errors) == 6 and max(errors) > 0
        assert "missing" in row or set(row["errors"]) == {"x", "v", "mu", "lam"}


CLAIMS = {
    "exactness": check_exactness,
    "ablation": check_ablation,
    "cost": check_cost,
    "fd": check_fd,
}


@pytest.mark.parametrize("name", quick_and_slow(("ablation", "fd"), PAPER))
def test_quick_run_bears_out_the_claims(name: str, quick: Callable[[str], dict[str, Any]], folder: Path) -> None:
    pytest.importorskip("scipy", reason="without Delaunay meshes the scenes are others")
    content = quick(name)
    assert content["name"] == name and content["quick"]
    environment = content["environment"]
    assert environment["device"] == "cpu" and {"date", "commit", "torch", "dirty"} <= set(environment)
    assert "| --- |" in tables.text_of(name, content["results"])
    CLAIMS[name](content["results"])


def test_a_forward_that_differs_is_refused() -> None:
    scene = exactness.build(exactness.Case(kind="structured", size="small", steps=1))
    expected = exactness.expected_of(scene, 1)
    got = exactness.result_of(scene, 1, exactness.adjoint_of(OURS))
    h = scene.case.time_step
    assert exactness.verified_forward(got, expected, h, OURS) <= tolerance("forward")
    with pytest.raises(RuntimeError, match="reverse sweep: expected the reference's end state"):
        exactness.verified_forward({**got, "x": got["x"] + 1e-12}, expected, h, OURS)


def test_patches_deflect_more_than_plain_tets(quick: Callable[[str], dict[str, Any]]) -> None:
    results = quick("locking")["results"]
    rows = [*results["cantilever"], *results["cook"]]
    assert rows and all(1.1 < row["patches"] / row["plain"] < 1.8 for row in rows)
    assert all(abs(row["stress_along"] - 1) < 1e-4 > abs(row["across_over_along"]) for row in results["small_strain"])
    assert {row["law"] for row in results["sweeps"]} == {"plain", "patches"}
