"""Claim: what friction can hold sticks, what it cannot slides, and gradients say so: with few sweeps, however stiff."""

import math
from typing import Any

import pytest
import torch
from torch import Tensor

import diffvbd as dv
from diffvbd.testing import tolerance

COEFFICIENT, CREEP, LOW = 0.5, 1e-3, -5e-4
STEPS, TIME_STEP = 60, 0.01


def block(support: str, bodies: int = 1) -> dv.Model:
    """Cubes in a row over a support; of more than 64 bodies each is corrected by itself."""
    cube = dv.mesh.cube(3, size=0.1)
    cube = cube.translate((0.0, -float(cube.points[:, 1].min()), 0.0))
    mesh = dv.mesh.join([cube.translate((0.2 * k, 0.0, 0.0)) for k in range(bodies)])
    friction = dv.Friction(COEFFICIENT, CREEP)
    if support == "floor":
        return dv.Model(mesh, energies=(dv.StableNeoHookean(), dv.FloorBarrier(LOW, kappa=1e4, dhat=1e-3), friction))
    pairs = dv.PairBarrier(1e4, 1e-3, self_contact=False)
    plane = dv.colliders.Plane((0.0, LOW, 0.0), (0.0, 1.0, 0.0))
    return dv.Model(mesh, energies=(dv.StableNeoHookean(), pairs, friction), colliders=[plane])


def pushed(model: dv.Model, share: float | Tensor, sweeps: int, stiffness: float, steps: int = STEPS) -> dv.Trajectory:
    """By a share of what friction holds."""
    x = model.rest_points
    force = model.mass[:, None] * 9.81 * COEFFICIENT * share * torch.tensor([1.0, 0.0, 0.0], dtype=x.dtype)
    given: dict[str, Any] = {"mu": stiffness, "lam": stiffness, "time_step": TIME_STEP, "sweeps": sweeps}
    return dv.rollout(model, x, torch.zeros_like(x), steps=steps, force=force, **given)


@pytest.mark.parametrize("support", ["floor", "plane"])
@pytest.mark.parametrize(("stiffness", "sweeps"), [(1e5, 10), (1e6, 5), (1e7, 5)])
@pytest.mark.parametrize("share", [0.5, 0.9])
def test_what_holds_creeps_as_smoothed_friction_does(share: float, stiffness: float, sweeps: int, support: str) -> None:
    speed = float(pushed(block(support), share, sweeps, stiffness).v[-1, :, 0].mean())
    assert speed == pytest.approx(CREEP * (1 - math.sqrt(1 - share)), rel=tolerance("contact_motion"))


def test_what_does_not_hold_slides() -> None:
    v = pushed(block("plane"), 1.5, 5, 1e6).v
    gained = float(v[-1, :, 0].mean() - v[STEPS // 2, :, 0].mean())
    expected = 0.5 * COEFFICIENT * 9.81 * (STEPS - STEPS // 2) * TIME_STEP
    assert gained == pytest.approx(expected, rel=tolerance("contact_motion"))


@pytest.mark.parametrize("support", ["floor", "plane"])
def test_the_derivative_of_rest_is_that_of_rest(support: str) -> None:
    """Some fifty times less than that of the coasting which one Newton step with a bound for friction left."""
    share = torch.tensor(0.5, dtype=torch.float64, requires_grad=True)
    speed = pushed(block(support), share, 5, 1e6).v[-1, :, 0].mean()
    (slope,) = torch.autograd.grad(speed, share)
    assert float(slope) == pytest.approx(CREEP / (2 * math.sqrt(1 - 0.5)), rel=tolerance("contact_motion"))


def test_stacks_of_many_bodies_stand() -> None:
    """Thirty-five stacks of two cubes, pushed by half of what friction holds, creep and do not fall. Without a share of
    friction for each side, or with one correction after the sweeps, they slide and fall."""
    cube = dv.mesh.cube(2, size=0.1)
    cube = cube.translate((0.0, -float(cube.points[:, 1].min()), 0.0))
    places = [(0.3 * k, 0.0, 0.0) for k in range(35)] + [(0.3 * k + 0.01, 0.1 - LOW, 0.01) for k in range(35)]
    model = dv.Model(
        dv.mesh.join([cube.translate(place) for place in places]),
        energies=(dv.StableNeoHookean(), dv.FloorBarrier(LOW, kappa=1e4, dhat=1e-3),
                  dv.PairBarrier(1e4, 1e-3, self_contact=False), dv.Friction(COEFFICIENT, CREEP)),
    )  # fmt: skip
    speed = pushed(model, 0.5, 5, 1e6).v[-1, :, 0].reshape(2, 35, -1).mean(-1)
    assert float(speed.abs().max()) < 3 * CREEP
    assert float(speed.mean()) > 0.1 * CREEP
