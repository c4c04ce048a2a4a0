"""Claim: a direction that is far stiffer than the others costs the gradient no digits: planes at small gaps in any
direction, and lam far above mu. Measured against a step in 120 digits, in units of what an ulp in the inputs does."""

from typing import Any

import numpy as np
import pytest
import torch
from helpers.marks import quick_and_slow, slow
from helpers.results import TAPES
from torch import Tensor

import diffvbd as dv
from bench import limits_adjoint as limits
from diffvbd import testing
from diffvbd.testing import evaluate, many_digits, relative_error, tolerance

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


@pytest.mark.parametrize("gap", quick_and_slow((max(limits.GAPS), min(limits.GAPS)), limits.GAPS))
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


def test_the_truth_is_one() -> None:
    """120 digits against autograd through the reference, where nothing is stiff."""
    for scene in (limits.volumetric(1.0), limits.volumetric(1.0, "paper"), limits.oblique(0.05)):
        truth = limits.exact(scene, 2)
        expected = testing.reference_result(scene.model, scene.inputs, 2)
        for name, value in truth.values.items():
            assert value.any(), name
            assert relative_error(expected[name], value) <= tolerance("adjoint"), name


@pytest.mark.parametrize("ratio", (1e3, 1e6, 1e8, 1e10))
def test_float32_of_an_inverted_start_is_finite(device: str, ratio: float) -> None:
    """A mirrored body with lam far above mu: sums of blocks have no digits of mu left in float32, and their noise, fed
    back from vertex to vertex, used to grow to NaN in gradients whose size is 1e3 to 1e5."""
    mesh = dv.mesh.cube(3)
    noise = testing.generator("mirrored").uniform(-1e-3, 1e-3, mesh.points.shape)
    x = torch.from_numpy(mesh.points * np.array([1.0, -1.0, 1.0]) + noise).float()
    model = dv.Model(mesh, pinned=mesh.points[:, 0] < 1e-9, dtype=torch.float32, device=device)
    inputs = {"x": x, "v": torch.zeros_like(x), "mu": torch.tensor(1.0), "lam": torch.tensor(ratio), "time_step": 0.2}

    def run(**options: Any) -> tuple[Tensor, Tensor]:
        return dv.step(model, sweeps=20, **options)

    result = evaluate(run, testing.on_device(inputs, device))
    for name, value in result.items():
        assert torch.isfinite(value).all() and value.any(), name


@pytest.mark.parametrize("dtype", (torch.float64, torch.float32), ids=("float64", "float32"))
@pytest.mark.parametrize("tape", ("full", "recompute"))
def test_axes_are_a_vertex_own(device: str, tape: Any, dtype: torch.dtype) -> None:
    """Eight vertices on a floor, and far from them a ramp that touches the origin, where no vertex is: what fills up a
    pack of vertices must not turn the axes of the others."""
    mesh = dv.mesh.cube(2, size=0.2).translate((1.0, 0.11, 0.0))
    floor = dv.FloorBarrier(height=(0.0, 0.0), normal=((0, 1, 0), (1, 1, 0)))
    model = dv.Model(mesh, 500.0, energies=(dv.StableNeoHookean(), floor), device=device, dtype=dtype)
    x = model.rest_points
    v = torch.zeros_like(x)
    v[:, 1] = -0.3

    def gradients(adjoint: Any) -> list[Tensor]:
        a, mu = x.clone().requires_grad_(), torch.tensor(2e4, dtype=dtype, device=device, requires_grad=True)
        end, _ = dv.step(model, a, v, mu=mu, lam=2e4, time_step=0.01, sweeps=2, adjoint=adjoint)
        return list(torch.autograd.grad((end[:, 1] ** 2).sum() + 0.1 * end[:, 0].sum(), (a, mu)))

    # the gradient of mu cancels to a millionth of its terms
    bar = 1e3 * tolerance("adjoint") if dtype == torch.float64 else tolerance("contact_float32")
    for actual, expected in zip(gradients(dv.ReverseSweep(tape)), gradients(dv.ReverseSweep("compact")), strict=True):
        assert expected.any() and relative_error(actual, expected) <= bar
