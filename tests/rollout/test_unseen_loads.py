"""Claim: what swings within the steps of pilot runs, so that they do not see it, is not taken for rest."""

import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

import diffvbd as dv
from diffvbd.rollout.between import SWINGS, unseen

DURATION = 0.1
FREQUENCY = 160.0  # [Hz]: with 4 * 2**k steps over 0.1 s the middle of each is a zero, up to k = 2


def beam() -> tuple[dv.Model, Tensor, Callable[[float], Tensor]]:
    body = dv.mesh.beam(4, 2, 2, size=(0.3, 0.1, 0.1))
    model = dv.Model(body, pinned=torch.tensor(body.points[:, 0] < 1e-9))
    push = torch.zeros_like(model.rest_points)
    push[~model.pinned, 1] = 0.5
    return model, model.rest_points, lambda t: push * math.sin(2 * math.pi * FREQUENCY * t)


def test_advice_looks_between_the_steps() -> None:
    model, x, force = beam()
    given = {"mu": 1e5, "lam": 1e5, "gravity": (0.0, 0.0, 0.0), "force": force}
    settings = dv.advise(model, x, 0 * x, duration=DURATION, error=0.1, patience=20.0, **given)
    told = settings.predicted
    assert told is not None and told.reached and settings.steps(DURATION) > 3 * FREQUENCY * DURATION

    def end(steps: int) -> Tensor:
        h = DURATION / steps
        return dv.rollout(model, x, 0 * x, steps=steps, time_step=h, sweeps=20, integrator=dv.SDIRK2(), save="last",
                          mu=1e5, lam=1e5, gravity=(0.0, 0.0, 0.0),
                          force=lambda k, x, v: force((k + 0.5) * h)).x[-1] - x  # fmt: skip

    exact, few = end(1024), end(16)
    assert float(few.norm()) < 0.01 * float(exact.norm())  # which sixteen steps do not see at all
    assert float((end(settings.steps(DURATION)) - exact).norm()) < 0.2 * float(exact.norm())


def test_a_budget_says_so() -> None:
    model, x, force = beam()
    given = {"mu": 1e5, "lam": 1e5, "duration": DURATION, "sweeps": 5}
    for steps, told in ((4, True), (32, False)):
        budget = dv.error_budget(model, x, 0 * x, time_step=DURATION / steps, force=force, **given)
        (share,) = (s for s in budget.shares if s.cause == "time step")
        assert ("whose steps do not see how force swings" in share.note) == told


@pytest.mark.parametrize(
    ("function", "steps", "moves", "is_seen"),
    [
        (lambda t: torch.tensor(math.sin(2 * math.pi * 160 * t)), 8, False, False),
        (lambda t: torch.tensor(math.sin(2 * math.pi * 160 * t)), 64, False, True),
        (lambda t: torch.tensor(3.0), 4, False, True),  # does not change
        (lambda t: 9.81 + 0.1 * math.sin(1e4 * t), 8, False, True),  # a ripple on what does not
        (lambda t: torch.tensor([5.0 + t, math.nan]), 8, True, True),  # moves evenly; others are not read
        (lambda t: torch.tensor([5.0 + 0.001 * math.sin(1e4 * t)]), 8, True, False),  # far away, and shakes there
        (lambda t: torch.tensor(float(t > 0.05)), 64, False, True),  # switched on
        (lambda t: torch.zeros(3), 8, False, True),
        (lambda t: torch.tensor(t), 1, False, True),
    ],
)
def test_what_samples_see(function: Callable[[float], Tensor], steps: int, moves: bool, is_seen: bool) -> None:
    assert (unseen(function, 0.5, steps, DURATION, moves) <= SWINGS) == is_seen
