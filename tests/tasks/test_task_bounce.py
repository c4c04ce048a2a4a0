"""Claim: gradients through a bounce bring a thrown body's center of mass to a target that the first throw misses."""

from pathlib import Path

import pytest
import torch
from helpers.marks import slow
from helpers.task_checks import check_fall, check_gradient, quick

from diffvbd import losses
from diffvbd.cli import main
from diffvbd.tasks import Settings, bounce
from diffvbd.testing import tolerance

NAMES = ("cube-bounce", "bunny-bounce")


@pytest.mark.parametrize("name", [slow("cube-bounce"), "bunny-bounce"])
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


def test_only_frames_from_the_first_contact_on_count(tmp_path: Path) -> None:
    scene = bounce.scene(Settings(tmp_path))
    rest, center = scene.model.rest_points, losses.center_of_mass(scene.model.rest_points, scene.model.mass)
    bottom = rest[:, 1].min().item()

    def squared(*gaps: float) -> torch.Tensor:
        """Of the cube at rest with these gaps between its lowest vertex and the floor."""
        down = torch.tensor([[0.0, gap - bottom, 0.0] for gap in gaps], dtype=torch.float64)
        values = scene.squared_distances(rest + down[:, None])
        expected = (center + down - scene.goal).square().sum(1)
        counted = values.isfinite()
        assert torch.allclose(values[counted], expected[counted], rtol=tolerance("cancelling"), atol=0.0)
        return values

    reach = scene.dhat
    assert squared(0.3, 1.2 * reach, 0.9 * reach, 0.3, 0.5 * reach, 0.4).isfinite().tolist() == [False] * 2 + [True] * 4
    # without contact, from the lowest frame on
    assert squared(0.5, 0.3, 0.2, 0.3).isfinite().tolist() == [False, False, True, True]


def test_scenes_of_a_batch_do_not_mix(tmp_path: Path) -> None:
    scene = bounce.scene(Settings(tmp_path))
    offsets = torch.tensor([[0.0, 0.0, 0.0], [0.1, -0.2, 0.0]], dtype=torch.float64)
    velocities = torch.tensor([[2.0, -1.0, 0.3], [1.5, -2.0, 0.5]], dtype=torch.float64, requires_grad=True)
    both = scene.squared_miss(offsets, velocities)
    (gradient,) = torch.autograd.grad(both.sum(), velocities)
    assert both.shape == (2,) and both[0] != both[1]
    for k in range(2):
        velocity = velocities[k].detach().requires_grad_()
        alone = scene.squared_miss(offsets[k], velocity)
        assert alone.item() == pytest.approx(both[k].item(), rel=tolerance("cancelling"))
        (expected,) = torch.autograd.grad(alone, velocity)
        assert expected.norm() > 0.1
        assert torch.allclose(gradient[k], expected, rtol=tolerance("through_a_bounce"), atol=0.0)


def test_sweeps_are_an_option_of_the_cube(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    problems = [quick("cube-bounce", tmp_path, sweeps=sweeps)[0] for sweeps in (1, 5, 20)]
    starts = [problem.stages[0].loss().sqrt().item() for problem in problems]
    # few sweeps change the bounce, by tenths of a millimetre: the rigid correction holds the body's motion
    assert 1e-2 > abs(starts[0] - starts[2]) > abs(starts[1] - starts[2]) > 1e-5
    assert main(["run", "cube-bounce", "--sweeps", "-1", "--out", str(tmp_path)]) == 2
    assert "sweeps: expected" in capsys.readouterr().err


def test_picture_is_drawn(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    settings = Settings(tmp_path, quick=True)
    problem = bounce.cube_bounce(settings)
    assert problem.picture is not None
    with torch.no_grad():
        problem.parameters["velocity"].add_(0.1)
    problem.picture(tmp_path / "picture.png", [{"distance": 0.3}, {"distance": 0.1}])
    assert (tmp_path / "picture.png").stat().st_size > 30_000
