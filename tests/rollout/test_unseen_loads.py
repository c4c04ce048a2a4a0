"""Claim: what swings within the steps of pilot runs, so that they do not see it, is not taken for rest, and the mean of
a load over each step loses no impulse."""

import math
from collections.abc import Callable
from typing import Any, cast

import pytest
import torch
from torch import Tensor

import diffvbd as dv
from diffvbd.rollout.between import SWINGS, unseen
from diffvbd.testing.tolerances import tolerance

DURATION = 0.1
FREQUENCY = 160.0  # [Hz]: with 4 * 2**k steps over 0.1 s the middle of each is a zero, up to k = 2


def beam() -> tuple[dv.Model, Tensor, Callable[[float], Tensor]]:
    body = dv.mesh.beam(4, 2, 2, size=(0.3, 0.1, 0.1))
    model = dv.Model(body, pinned=torch.tensor(body.points[:, 0] < 1e-9))
    push = torch.zeros_like(model.rest_points)
    push[~model.pinned, 1] = 0.5
    return model, model.rest_points, lambda t: push * math.sin(2 * math.pi * FREQUENCY * t)


@pytest.mark.slow
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


RELEASED, EDGE = 0.103, 5e-4  # [s]: after it the push fades within some 2 ms
LONG: dict[str, Any] = {"mu": 1e5, "lam": 1e5, "gravity": (0.0, 0.0, 0.0), "sweeps": 5, "save": "last"}


def released(push: Callable[[Tensor, Tensor], Any], steps: int = 20, **given: Any) -> tuple[Tensor, Tensor]:
    """How far a cube has come that is pushed until a time, over the closed form [-]; and the same of its derivative."""
    model = dv.Model(dv.mesh.cube(2, size=0.1))
    x = model.rest_points
    time = torch.tensor(RELEASED, dtype=torch.float64, requires_grad=True)
    force = torch.tensor([0.1, 0.0, 0.0], dtype=torch.float64).expand_as(x)
    options = {**LONG, "steps": steps, "time_step": 0.4 / steps, "integrator": dv.SDIRK2(), **given}
    way = (dv.rollout(model, x, 0 * x, force=push(time, force), **options).x[-1] - x)[:, 0].mean()
    (slope,) = torch.autograd.grad(way, time)
    whole = 8 * 0.1 / float(model.mass.sum())
    return way.detach() / (whole * RELEASED * (0.4 - RELEASED / 2)), slope / (whole * (0.4 - RELEASED))


def until(time: Tensor, force: Tensor) -> Callable[[float], Tensor]:
    return lambda t: torch.sigmoid((time - t) / EDGE) * force


@pytest.mark.parametrize("given", [{}, {"integrator": dv.BDF2()}, {"checkpoint_every": 3}], ids=str)
def test_the_mean_over_each_step_keeps_impulse_and_derivative(given: dict[str, Any]) -> None:
    way, slope = released(lambda time, force: dv.step_average(until(time, force)), **given)
    assert 0.9 < float(way) < 1.1 and 0.9 < float(slope) < 1.1
    _, lost = released(lambda time, force: lambda k, x, v: until(time, force)((k + 0.5) * 0.02), **given)
    assert abs(float(lost)) < 0.01  # the middle of a step sees no edge


def test_an_integral_does_the_same_for_an_edge_of_no_length() -> None:
    def impulses(time: Tensor, force: Tensor) -> object:
        times = torch.arange(21, dtype=torch.float64) * 0.02
        return dv.per_step((torch.minimum(times, time)[:, None, None] * force).diff(dim=0) / 0.02)

    for share in released(impulses):
        assert float(share) == pytest.approx(1.0, rel=tolerance("contact_motion"))


@pytest.mark.parametrize(
    ("call", "error", "words"),
    [
        (lambda: dv.step_average(cast(Any, 1.0)), TypeError, "function: expected a function of the time"),
        (lambda: dv.step_average(lambda t: t, samples=0), ValueError, "samples: expected"),
        (lambda: dv.rollout(*beam()[:2], 0 * beam()[1], steps=1, time_step=0.01, sweeps=1, mu=1.0, lam=1.0,
                            prescribed=dv.step_average(lambda t: t)), TypeError, "prescribed: expected positions"),
        (lambda: dv.error_budget(*beam()[:2], 0 * beam()[1], duration=0.1, time_step=0.01, sweeps=1, mu=1.0, lam=1.0,
                                 colliders=dv.step_average(lambda t: t)), TypeError, "colliders: expected positions"),
    ],
)  # fmt: skip
def test_bad_input_of_a_mean(call: Callable[[], object], error: type[Exception], words: str) -> None:
    with pytest.raises(error, match=words):
        call()
