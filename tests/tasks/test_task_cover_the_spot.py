"""Claim: gradients through falls, hits and slides of three disks find a throw that covers the target."""

from pathlib import Path

import pytest
import torch
from helpers.task_checks import check_fall, check_gradient

import diffvbd as dv
from diffvbd.tasks.cover_the_spot import faces_up, outline, smooth_uncovered, sunflower, uncovered
from diffvbd.testing import tolerance

DISK = dv.mesh.disk(0.42, 0.06, 6)


@pytest.mark.slow
def test_quick_run_covers_more(tmp_path: Path) -> None:
    result = check_fall("cover-the-spot", tmp_path, factor=0.7, iterations=5)
    assert result.history[0]["uncovered"] > 0.2
    assert result.estimates["uncovered"] < 0.7 * result.history[0]["uncovered"]
    assert result.estimates["uncovered"] == min(row["uncovered"] for row in result.history)


def test_gradient_matches_central_differences(tmp_path: Path) -> None:
    # limits and shares are decided, and so jump; the nearest line of an outline has kinks: a short step meets none
    check_gradient("cover-the-spot", tmp_path, step=1e-8, rel=tolerance("kinked_difference"))


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
