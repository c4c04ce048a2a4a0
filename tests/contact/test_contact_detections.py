"""Claim: a step that nobody has given a number of detections takes as many as its motion asks for, and an impact keeps
its momentum."""

import math
from typing import Any

import pytest
import torch
from conftest import DEVICES

import diffvbd as dv
from diffvbd.mesh import box, join
from diffvbd.step.contact_cycles import MOST_DETECTIONS, parts_of
from diffvbd.testing.tolerances import tolerance

STEPS = 9
MATERIAL: dict[str, Any] = {"mu": 8e3, "lam": 1.2e4, "gravity": (0.0, 0.0, 0.0)}


def meeting(speed: float, device: str, dtype: torch.dtype = torch.float64, **options: Any) -> tuple[dv.Model, Any, Any]:
    """A small cube thrown at a larger one, off its center."""
    lower, upper = box(4, 0.2), box(4, 0.12).translate((0.04, 0.22, 0.03))
    barrier = dv.PairBarrier(kappa=1e4, dhat=0.01, self_contact=False, **options)
    model = dv.Model(join([lower, upper]), energies=(dv.StableNeoHookean(), barrier), device=device, dtype=dtype)
    v = torch.zeros_like(model.rest_points)
    v[lower.num_vertices :, 1] = -speed
    return model, model.rest_points, v


@pytest.mark.parametrize(("over", "parts"), ((0.0, 1), (1.0, 1), (1.5, 2), (2.0, 2), (2.1, 3), (4.0, 3), (5.0, 4),
                                             (1e9, 4), (math.nan, 1), (math.inf, 1)))  # fmt: skip
def test_one_more_each_time_that_the_way_is_twice_as_long(over: float, parts: int) -> None:
    assert parts_of(torch.tensor([[0.0, over]])) == parts <= MOST_DETECTIONS


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", (torch.float64, torch.float32))
def test_only_fast_motion_beside_others_takes_more_than_one(dtype: torch.dtype, device: str) -> None:
    def counts(speed: float, together: bool) -> list[int]:
        model, x, v = meeting(speed, device, dtype)
        if together:
            v = torch.zeros_like(v)
            v[:, 1] = -speed
        out = []
        for _ in range(3):
            with dv.contact.record() as found:
                x, v = dv.step(model, x, v, time_step=1 / 60, sweeps=4, **MATERIAL)
            out.append(len(found))
            assert len(dv.contact.intersections(model, x)) == 0
        return out

    assert counts(0.5, False) == [1, 1, 1]
    assert counts(20.0, True) == [1, 1, 1]
    fast = counts(7.0, False)
    assert fast[0] > 1 and fast[-1] == 1  # slow again after the impact


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(("speed", "sweeps"), ((5.0, 1), (5.0, 10), (7.0, 1), (7.0, 10)))
def test_an_impact_keeps_its_momentum(speed: float, sweeps: int, device: str) -> None:
    def lost(**options: Any) -> float:
        model, x, v = meeting(speed, device, **options)
        mass = model.mass[:, None]
        first = (mass * v).sum(0)
        for _ in range(STEPS):
            x, v = dv.step(model, x, v, time_step=1 / 60, sweeps=sweeps, **MATERIAL)
        assert float((mass * v)[: len(v) - 64].sum(0).norm()) > 0.2 * float(first.norm())  # they did collide
        return float(((mass * v).sum(0) - first).norm() / first.norm())

    assert lost() <= MOST_DETECTIONS * STEPS * tolerance("momentum")
    if (speed, sweeps) == (7.0, 10):
        assert lost(detections=1) > 0.01
