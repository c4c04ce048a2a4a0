"""Claim: the motion of a surface, with noise, shows where a body is stiff, without being told of regions."""

import importlib.util
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.task_checks import check_fall, check_gradient

import diffvbd as dv
from diffvbd.tasks import Settings, fit_real_mesh
from diffvbd.tasks.fit_real_mesh import HEIGHT, scaled
from diffvbd.testing import tolerance

BODY = scaled(dv.mesh.bunny(8), HEIGHT)


@pytest.mark.slow
def test_quick_run_finds_both_regions(tmp_path: Path) -> None:
    result = check_fall("fit-real-mesh", tmp_path, factor=0.08)
    uniform = [row for row in result.history if row["stage"] == 0]
    assert min(row["field_error"] for row in uniform) > 0.5
    assert result.errors["mu_soft"] < 0.08 and result.errors["mu_stiff"] < 0.15
    assert result.estimates["field_error"] < 0.1
    assert 0.9 < result.findings["misfit_of_truth"] < result.findings["misfit"] < 2.0


@pytest.mark.parametrize("stage", [0, 1])
def test_gradient_matches_central_differences(tmp_path: Path, stage: int) -> None:
    check_gradient("fit-real-mesh", tmp_path, step=1e-5, rel=tolerance("long_difference"), stage=stage)


@pytest.mark.slow
def test_weight_falls_until_the_misfit_is_that_of_the_noise(tmp_path: Path) -> None:
    # this seed's noise is a little smaller than stated
    problem = fit_real_mesh.problem(Settings(tmp_path, seed=2))
    exponents, lowered = problem.parameters["exponents"], problem.state["lowered"]

    def enter(stage: int) -> None:
        before = problem.stages[stage].before
        assert before is not None
        before(0)
        before(0)  # a captured stage asks twice
        before(1)

    enter(1)
    enter(2)
    body = scaled(dv.mesh.bunny(10), HEIGHT)
    middle = 0.5 * (body.points.min(0) + body.points.max(0))
    stiff = (body.points[body.tets].mean(1) - middle)[:, :2].sum(1) > 0
    with torch.no_grad():
        true = torch.from_numpy(np.where(stiff, 2e4, 5e3) / fit_real_mesh.START).log()
        limit = math.log(fit_real_mesh.RANGE)
        exponents.copy_(limit * (true / limit).atanh())
    assert problem.estimates()["within_10_percent"] == 1.0
    enter(3)
    assert problem.findings is not None
    assert problem.findings([])["weight"] == pytest.approx(100.0 / math.sqrt(10))
    assert lowered.tolist() == [0, 0, 1, 0, 0]


def test_mesh_of_a_file(tmp_path: Path) -> None:
    file = tmp_path / "big.mesh"
    dv.mesh.save(file, BODY.transform(7.0 * np.eye(3)).translate([1.0, 2.0, 3.0]))
    problem = fit_real_mesh.problem(Settings(tmp_path, quick=True), mesh=file, iterations=7)
    assert [stage.iterations for stage in problem.stages] == [5, 7]
    assert problem.protocol["tets"] == BODY.num_tets
    assert scaled(dv.mesh.load(file), HEIGHT).points[:, 1] == pytest.approx(BODY.points[:, 1])
    with pytest.raises(FileNotFoundError, match="none.mesh"):
        fit_real_mesh.problem(Settings(tmp_path), mesh=tmp_path / "none.mesh")
    surface = tmp_path / "surface.obj"
    corners = "".join(f"v {x} {y} {z}\n" for x, y, z in np.vstack([np.zeros(3), np.eye(3)]))
    surface.write_text(corners + "f 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n")
    with pytest.raises(ValueError, match="edge_length: expected"):
        fit_real_mesh.problem(Settings(tmp_path), mesh=surface, edge_length=-1.0)
    with pytest.raises(ValueError, match="iterations: expected at least 1, got 0"):
        fit_real_mesh.problem(Settings(tmp_path), iterations=0)
    if importlib.util.find_spec("pytetwild") is None:
        with pytest.raises(ImportError, match="pytetwild"):
            fit_real_mesh.problem(Settings(tmp_path), mesh=surface)
