"""Claim: what rests on a floor keeps its gap, for any number of sweeps and detections and any relaxation.

docs/method.md, section 6: no gap falls below min(first gap, (1 - eta) d*(F)), with d*(F) the gap where the barrier
bears the largest force F that presses a vertex down. These tests take the whole weight of the cube for F.
"""

from typing import Any

import pytest
import torch
from helpers.bearing import bearing_gap
from helpers.marks import slow
from torch import Tensor

import diffvbd as dv
from diffvbd._common.constants import FILTER_ETA
from diffvbd.testing import tolerance

KAPPA, DHAT, DENSITY, START = 1e3, 1e-2, 3000.0, 5e-3
GRAVITY = 9.81
DIRECTIONS = torch.nn.functional.normalize(
    torch.tensor([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [0.48, 0.8, -0.36]], dtype=torch.float64), dim=-1
)


def scenes(*energies: Any) -> tuple[dv.Model, Tensor]:
    """A cube of 27 vertices that stands flat on a plane, in a scene for each direction; model and state."""
    mesh = dv.mesh.cube(3, size=0.2)
    floor = dv.FloorBarrier(kappa=KAPPA, dhat=DHAT)
    model = dv.Model(mesh, density=DENSITY, energies=(dv.StableNeoHookean(), floor, *energies))  # fmt: skip
    turned = []
    for n in DIRECTIONS:  # the columns of an orthonormal matrix whose second is n
        other = torch.linalg.cross(n, torch.eye(3, dtype=n.dtype)[int(n.abs().argmin())])
        other = other / other.norm()
        turned.append(torch.stack([other, n, torch.linalg.cross(other, n)], 1))
    points = model.rest_points - torch.tensor([0.0, float(model.rest_points[:, 1].min()) - START, 0.0]).double()
    x = torch.stack([points @ axes.T for axes in turned])
    return model, x


def step(model: dv.Model, x: Tensor, v: Tensor, sweeps: int, relaxation: float = 1.0) -> tuple[Tensor, Tensor]:
    solver = dv.VBD(0.01, sweeps, relaxation=relaxation, subspace=None)
    return dv.step(model, x, v, solver, mu=2e5, lam=4e5, gravity=-GRAVITY * DIRECTIONS[:, None],
                   floor_normal=DIRECTIONS[:, None])  # fmt: skip


def gaps(x: Tensor) -> Tensor:
    return (x * DIRECTIONS[:, None]).sum(-1)


def check_rest(model: dv.Model, x: Tensor, steps: int, sweeps: int, relaxation: float = 1.0) -> None:
    floor = min(START, least_gap()) * (1 - 1e-9)
    v, highest = torch.zeros_like(x), gaps(x).mean(-1)
    for k in range(steps):
        x, v = step(model, x, v, sweeps, relaxation)
        gap = gaps(x)
        assert gap.min() >= floor, f"step {k}: gap {float(gap.min()):.2e}, {floor:.2e} expected"
        assert (gap.mean(-1) <= highest + tolerance("rest_rise")).all(), f"step {k}: thrown up, energy from nothing"
    assert bool(torch.isfinite(v).all())


def least_gap() -> float:
    return (1 - FILTER_ETA) * bearing_gap(DENSITY * 0.2**3 * GRAVITY, KAPPA, DHAT)


CASES = [(0, 1.0), (1, 0.5), (1, 1.0), (2, 1.6), (3, 1.0), (5, 0.5), (5, 1.6)]


@pytest.mark.parametrize(("sweeps", "relaxation"), CASES)
def test_a_cube_at_rest(sweeps: int, relaxation: float) -> None:
    check_rest(*scenes(), 300, sweeps, relaxation)


PARTS = [(*run, friction) for run in ((0, 2), (1, 2), (1, 4), (2, 1), (4, 2)) for friction in (None, 0.3)]
QUICK = [(0, 2, 0.3), (1, 2, None), (2, 1, 0.3)]


@pytest.mark.parametrize(("sweeps", "detections", "friction"), [a if a in QUICK else slow(*a) for a in PARTS])
def test_a_cube_at_rest_in_parts(sweeps: int, detections: int, friction: float | None) -> None:
    """Floor and pairs: each of R parts has a start, and some no sweep."""
    pairs = dv.PairBarrier(kappa=KAPPA, dhat=DHAT, detections=detections, self_contact=False)
    more = () if friction is None else (dv.Friction(friction),)
    check_rest(*scenes(pairs, *more), 240, sweeps)


def test_without_sweeps_a_body_sinks_to_dhat_and_no_deeper() -> None:
    model, x = scenes()
    x, v = x + (0.02 - START) * DIRECTIONS[:, None], torch.zeros_like(x)
    for _ in range(200):
        x, v = step(model, x, v, 0)
    assert (gaps(x) - DHAT).abs().max() < tolerance("sunk")


@pytest.mark.parametrize("dtype", (torch.float64, torch.float32))
@pytest.mark.parametrize("length", (1e160, 1e-170, 3.0))
def test_a_normal_of_any_length_is_the_same_plane(length: float, dtype: torch.dtype) -> None:
    body = dv.mesh.cube(2, size=0.1).translate((0.0, 0.005, 0.0))

    def end(normal: tuple[float, float, float]) -> Tensor:
        floor = dv.FloorBarrier(normal=normal, kappa=KAPPA, dhat=DHAT)
        model = dv.Model(body, energies=(dv.StableNeoHookean(), floor), dtype=dtype)
        x = model.rest_points
        return dv.step(model, x, 0 * x, dv.VBD(0.01, 2), mu=1e5, lam=1e5)[0]

    assert torch.equal(end((0.0, length, 0.0)), end((0.0, 1.0, 0.0)))
