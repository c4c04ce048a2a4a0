"""Claim: steps with contact and friction do the same at any size of the scene, in single precision as well."""

from typing import Any

import pytest
import torch

import diffvbd as dv
from diffvbd.testing import relative_error, tolerance

SIZES = (200.0, 1e-3, 2e-5)  # of the scene's edge of 0.2 m, as factors


def end_of(size: float, dtype: torch.dtype, own: bool) -> tuple[torch.Tensor, torch.Tensor]:
    """State and slope by the start velocity, in units of the size, of a cube that lands on its edge and turns. Moduli,
    stiffness and gravity grow with the size such that the motion does not."""
    cube = dv.mesh.cube(3, size=0.2)
    angle = torch.tensor(0.3, dtype=torch.float64)
    turn = torch.stack([torch.stack([angle.cos(), angle.sin()]), torch.stack([-angle.sin(), angle.cos()])])
    points = torch.tensor(cube.points)
    points = torch.cat([points[:, :2] @ turn, points[:, 2:]], 1)
    points[:, 1] += 0.012 - points[:, 1].min()
    mesh = dv.TetMesh((size * points).numpy(), cube.tets)
    energies = (
        dv.StableNeoHookean(),
        dv.FloorBarrier(kappa=1e4 * size**3, dhat=0.02 * size),
        dv.PairBarrier(kappa=1e4 * size**3, dhat=0.02 * size, self_contact=own),
        dv.Friction(0.4, velocity=0.01 * size),
    )
    model = dv.Model(mesh, energies=energies, dtype=dtype)
    jitter = torch.randn((27, 3), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    x = model.rest_points + (1e-3 * size * jitter).to(dtype)  # lest it is at a kink
    v = 5.0 * torch.linalg.cross(torch.tensor([0.3, 0.1, 1.0], dtype=dtype).expand_as(x), x - x.mean(0))
    v.requires_grad_()
    given: dict[str, Any] = {"mu": 1e5 * size**2, "lam": 2e5 * size**2, "time_step": 0.01, "sweeps": 5}
    end = dv.rollout(model, x, v, steps=8, gravity=(0.0, -9.81 * size, 0.0), save="last", **given).x[-1] / size
    weights = torch.linspace(-1, 1, end.numel(), dtype=dtype).reshape(end.shape)
    (slope,) = torch.autograd.grad((weights * end).sum(), v)
    return end.detach().double(), slope.double() * size


@pytest.mark.parametrize("own", (False, True))
@pytest.mark.parametrize("size", SIZES)
def test_a_scene_of_another_size(size: float, own: bool) -> None:
    end, slope = end_of(1.0, torch.float64, own)
    scaled = end_of(size, torch.float64, own)
    for one, other in zip(scaled, (end, slope), strict=True):
        assert torch.isfinite(one).all() and relative_error(one, other) < tolerance("property_factor") * tolerance(
            "contact_adjoint"
        )
    assert slope.abs().max() > 0


@pytest.mark.parametrize("size", SIZES)
def test_in_single_precision(size: float) -> None:
    for one, other in zip(end_of(size, torch.float32, True), end_of(1.0, torch.float32, True), strict=True):
        assert torch.isfinite(one).all() and relative_error(one, other) < tolerance("property_factor") * tolerance(
            "float32_forward"
        )
