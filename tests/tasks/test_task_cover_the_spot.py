"""Claim: gradients through falls, hits and slides of three disks find a throw that covers the target."""

import math
from pathlib import Path

import pytest
import torch
from helpers.task_checks import check_fall, check_gradient

import diffvbd as dv
from diffvbd.cli import main
from diffvbd.tasks import Settings, cover_the_spot
from diffvbd.tasks.cover_the_spot import faces_up, outline, smooth_uncovered, sunflower, uncovered
from diffvbd.testing import tolerance

DISK = dv.mesh.disk(0.42, 0.06, 6)


def test_quick_run_covers_more(tmp_path: Path) -> None:
    result = check_fall("cover-the-spot", tmp_path, factor=0.7, iterations=5)
    assert result.history[0]["uncovered"] > 0.2
    assert result.estimates["uncovered"] < 0.7 * result.history[0]["uncovered"]
    assert result.estimates["uncovered"] == min(row["uncovered"] for row in result.history)


def test_gradient_matches_central_differences(tmp_path: Path) -> None:
    # limits and shares are decided, and so jump; the nearest line of an outline has kinks: a short step meets none
    check_gradient("cover-the-spot", tmp_path, step=1e-8, rel=tolerance("kinked_difference"))


def test_radius_decides_whether_there_is_a_solution(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    least = 0.45 * math.sqrt(3) / 2
    for radius in (least, 0.3, float("nan")):
        with pytest.raises(ValueError, match=r"radius: expected more than R sqrt\(3\)/2 = 0.3897 m"):
            cover_the_spot.problem(Settings(tmp_path), radius)
    assert main(["run", "cover-the-spot", "--radius", "0.38", "--out", str(tmp_path)]) == 2
    assert "got 0.38" in capsys.readouterr().err
    assert main(["run", "beam-mu", "--radius", "0.4", "--out", str(tmp_path)]) == 2
    assert "--radius: expected one of the task's options (none)" in capsys.readouterr().err


def test_uncovered_share_is_an_area() -> None:
    points = sunflower(4000, 0.45)
    assert points.norm(dim=1).max().item() < 0.45
    rest = torch.tensor(DISK.points)
    faces = torch.tensor(faces_up(DISK))
    far = torch.tensor([2.0, 0.0, 0.0])

    def share(*offsets: torch.Tensor) -> float:
        return uncovered(torch.stack([rest + o for o in offsets])[:, faces], points).item()

    # a disk of n = 36 corners has the area n/2 r^2 sin(2 pi / n)
    area = 18 * 0.42**2 * math.sin(math.pi / 18)
    assert share(0 * far, far, far) == pytest.approx(1 - area / (math.pi * 0.45**2), abs=tolerance("sampled_area"))
    assert share(far, far, far) == 1.0
    angles = 2 * math.pi * torch.arange(3, dtype=torch.float64) / 3
    around = 0.225 * torch.stack([angles.cos(), 0 * angles, angles.sin()], 1)
    assert share(*around) == 0.0
    assert share(*(around * 2)) > 0.0


def test_smooth_share_tends_to_the_share_and_pulls_disks_in() -> None:
    points = sunflower(2000, 0.45)
    rest = torch.tensor(DISK.points)
    rim, faces = torch.tensor(outline(DISK)), torch.tensor(faces_up(DISK))
    offsets = torch.tensor([[0.5, 0.0, 0.0], [-0.3, 0.0, 0.4], [-0.2, 0.0, -0.5]], dtype=torch.float64)
    offsets.requires_grad_()
    disks = rest + offsets[:, None]
    sharp = smooth_uncovered(disks[:, rim], points, torch.tensor(1e4)).item()
    assert sharp == pytest.approx(uncovered(disks[:, faces], points).item(), abs=tolerance("sampled_area"))
    turned = smooth_uncovered(disks[:, rim].flip(1), points, torch.tensor(1e4)).item()  # upside down
    assert turned == pytest.approx(sharp, rel=tolerance("adjoint"))
    smooth_uncovered(disks[:, rim], points, torch.tensor(10.0)).backward()
    assert (offsets.grad * offsets.detach()).sum(1).min().item() > 0.0
    assert offsets.grad[:, 1].abs().max().item() == 0.0
