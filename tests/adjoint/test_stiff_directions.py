"""Claim: a direction that is far stiffer than the others costs the gradient no digits: planes at small gaps in any
direction, and lam far above mu. Measured against a step in 120 digits, in units of what an ulp in the inputs does."""

import numpy as np
import pytest
import torch
from helpers.marks import quick_and_slow, slow
from helpers.results import TAPES, evaluated

import diffvbd as dv
from bench import limits
from diffvbd import testing
from diffvbd.testing import many_digits, tolerance

RATIOS = ((1e2, 3), (1e4, 1), (1e4, 3), (1e5, 1), (1e6, 3), (1e9, 1), (1e9, 3), (1e12, 3))  # of lam to mu, with sweeps
QUICK_RATIOS = ((1e4, 1), (1e6, 3), (1e12, 3))


def check(device: str, scene: limits.Scene, sweeps: int) -> None:
    truth = limits.exact(scene, sweeps)
    assert len(truth.values) == 1 + len(scene.names) and all(value.any() for value in truth.values.values())
    for tape in TAPES:
        found = limits.measure(scene, truth, sweeps, tape, device)
        for name, error in found.errors.items():
            allowed = tolerance("stiff_direction") * max(found.sensitivity[name], many_digits.ULP)
            assert error <= allowed, f"{tape}, {name}: {error:.1e}, allowed {allowed:.1e}"


@pytest.mark.parametrize("gap", quick_and_slow((min(limits.GAPS),), limits.GAPS))
def test_an_oblique_plane(device: str, gap: float) -> None:
    for sweeps, normal in zip((1, 3, 3, 1), limits.NORMALS, strict=True):
        check(device, limits.oblique(gap, (normal,)), sweeps)


@pytest.mark.parametrize("gap", (1e-3, 1e-7))
def test_two_planes_that_meet(device: str, gap: float) -> None:
    check(device, limits.oblique(gap, limits.CORNER), 2)


@pytest.mark.parametrize("block", ("exact", "paper"))
@pytest.mark.parametrize(
    ("ratio", "sweeps"), [*QUICK_RATIOS, *(slow(*case) for case in RATIOS if case not in QUICK_RATIOS)]
)
def test_volume_far_stiffer_than_shape(device: str, ratio: float, sweeps: int, block: str) -> None:
    check(device, limits.volumetric(ratio, block), sweeps)


@pytest.mark.parametrize("ratio", (1e3, 1e6, 1e8, 1e10))
def test_float32_of_an_inverted_start_is_finite(device: str, ratio: float) -> None:
    """A mirrored body with lam far above mu: sums of blocks have no digits of mu left in float32, and their noise, fed
    back from vertex to vertex, used to grow to NaN in gradients whose size is 1e3 to 1e5."""
    mesh = dv.mesh.cube(3)
    noise = testing.generator("mirrored").uniform(-1e-3, 1e-3, mesh.points.shape)
    x = torch.from_numpy(mesh.points * np.array([1.0, -1.0, 1.0]) + noise).float()
    model = dv.Model(mesh, pinned=mesh.points[:, 0] < 1e-9, dtype=torch.float32, device=device)
    inputs = {"x": x, "v": torch.zeros_like(x), "mu": torch.tensor(1.0), "lam": torch.tensor(ratio)}
    result = evaluated(model, testing.on_device(inputs, device), dv.VBD(0.2, 20))
    for name, value in result.items():
        assert torch.isfinite(value).all() and value.any(), name
