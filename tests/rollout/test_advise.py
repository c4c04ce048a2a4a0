"""Advised settings keep the error that was asked for, and say so where none do."""

import dataclasses
import math

import pytest
import torch

import diffvbd as dv
from diffvbd import mesh
from diffvbd.rollout.pilots import Pilots
from diffvbd.testing.tolerances import tolerance

DURATION = 0.3


def cantilever(modulus: float) -> tuple[dv.Model, dict[str, float]]:
    body = mesh.beam(7, 2, 2, size=(0.6, 0.1, 0.1), split="kuhn")
    return dv.Model(body, pinned=torch.tensor(body.points[:, 0] < 1e-9)), {"mu": modulus, "lam": modulus}


def off(model: dv.Model, settings: dv.Settings, material: dict[str, float], duration: float, **options) -> float:
    """The true error: against a run of very many steps and sweeps."""
    x, v = model.rest_points, torch.zeros_like(model.rest_points)
    runs = Pilots(dv.rollout, model, x, v, duration, {**material, **options})
    given = runs.run(settings, settings.steps(duration))
    exact = runs.run(dv.Settings(1.0, 40, dv.SDIRK2()), 4 * max(256, settings.steps(duration)))
    assert given.x is not None and exact.x is not None
    return runs.apart(given.x, exact.x)


@pytest.mark.parametrize("modulus", [2e4, 1e6])
@pytest.mark.parametrize("error", [0.1, 0.01])
def test_the_true_error_is_at_most_what_was_asked(modulus: float, error: float) -> None:
    model, material = cantilever(modulus)
    x, v = model.rest_points, torch.zeros_like(model.rest_points)
    settings = dv.advise(model, x, v, duration=DURATION, error=error, **material)
    told = settings.predicted
    assert told is not None and told.reached and told.error <= error and told.asked == error
    true = off(model, settings, material, DURATION)
    assert 0.02 * error < true <= error
    assert settings.dtype == model.dtype and told.seconds > 0 and told.spent > 0
    text = str(settings)
    assert "of the motion" in text and "s per second of motion" in text and len(text.splitlines()) > 6


def test_stiff_scenes_are_not_taken_for_resting_ones() -> None:
    """At long steps an L-stable integrator damps all of a vibration away, and runs of h and h/2 agree: on rest."""
    model, material = cantilever(1e8)
    x, v = model.rest_points, torch.zeros_like(model.rest_points)
    settings = dv.advise(model, x, v, duration=0.1, error=0.1, **material)
    assert settings.time_step < tolerance("resolved_vibration")
    assert off(model, settings, material, 0.1) <= 0.1


def test_gradients_are_kept_too() -> None:
    model, material = cantilever(1e5)
    x, v = model.rest_points, torch.zeros_like(model.rest_points)
    settings = dv.advise(model, x, v, duration=0.2, error=0.05, gradient=True, **material)

    def gradient(settings: dv.Settings, duration: float = 0.2) -> torch.Tensor:
        mu = torch.tensor(material["mu"], dtype=torch.float64, requires_grad=True)
        end = dv.rollout(model, x, v, duration=duration, settings=settings, mu=mu, lam=material["lam"], save="last")
        return torch.autograd.grad((end.x[-1] - x).square().sum(-1).mean(), mu)[0]

    exact = gradient(dv.Settings(0.2 / 512, 40, dv.SDIRK2()))
    assert exact != 0
    assert abs(gradient(settings) - exact) <= 0.05 * abs(exact)


def test_loads_may_be_functions_of_time() -> None:
    model, material = cantilever(1e5)
    x, v = model.rest_points, torch.zeros_like(model.rest_points)

    def gravity(t: float) -> torch.Tensor:
        return x.new_tensor([0.0, -9.81 * math.cos(20 * t), 0.0])

    settings = dv.advise(model, x, v, duration=0.2, error=0.05, gravity=gravity, **material)
    assert settings.predicted is not None and settings.predicted.reached
    assert off(model, settings, material, 0.2, gravity=gravity) <= 0.05


def test_an_error_that_cannot_be_had_is_said() -> None:
    model, material = cantilever(1e8)
    x, v = model.rest_points, torch.zeros_like(model.rest_points)
    settings = dv.advise(model, x, v, duration=1.0, error=1e-3, patience=0.2, **material)
    told = settings.predicted
    assert told is not None and not told.reached and told.error > 1e-3
    assert "patience" in told.why and "cannot be had" in str(settings)


def test_in_single_precision_the_best_run_is_returned_and_rounding_blamed() -> None:
    model, material = cantilever(1e6)
    model = model.to(dtype=torch.float32)
    x, v = model.rest_points, torch.zeros_like(model.rest_points)
    settings = dv.advise(model, x, v, duration=DURATION, error=1e-7, **material)
    told = settings.predicted
    assert told is not None and not told.reached
    assert "as rounding does in torch.float32" in told.why and "patience" not in told.why
    assert f"than those of {dataclasses.replace(settings, predicted=None)} make it worse" in told.why


@pytest.mark.parametrize(
    ("given", "error", "text"),
    [
        ({"error": 0.0}, ValueError, "error: expected"),
        ({"error": 1.0}, ValueError, r"error: expected a share of the motion in \(0, 1\)"),
        ({"duration": 0.0}, ValueError, "duration: expected"),
        ({"duration": 1e-300}, ValueError, "duration: expected a number of seconds of which 0.001 is a time step"),
        ({"gradient": 1}, TypeError, "gradient: expected a bool"),
        ({"quantity": 3}, TypeError, "quantity: expected a function"),
        ({"quantity": lambda motion: 0.0}, TypeError, "quantity: expected a function of the last state, lambda x, v"),
        ({"force": lambda step, x, v: None}, TypeError, r"force: expected a function of the time \[s\] alone"),
        ({"quantity": lambda x, v: x}, ValueError, "quantity: expected a function that returns a scalar"),
        ({"patience": 0}, ValueError, "patience: expected"),
        ({"sweeps": 3}, TypeError, "sweeps: expected an argument among"),
        ({"mu": -1.0}, ValueError, "mu: expected"),
        ({"gravity": dv.per_step(torch.zeros(4, 3, dtype=torch.float64))}, ValueError, "gravity: expected a value or"),
    ],
)
def test_bad_input(given, error, text) -> None:
    model, material = cantilever(1e5)
    x = model.rest_points
    with pytest.raises(error, match=text):
        dv.advise(model, x, torch.zeros_like(x), **{"duration": 0.1, **material} | given)


@pytest.mark.slow
def test_an_impact_that_long_steps_lose_is_not_taken_for_motion() -> None:
    """In long steps a cube that meets another one loses its rebound, and runs of h and h/2 agree on that."""
    one = mesh.box(2, 0.1, split="kuhn")
    model = dv.Model(mesh.join([one, one.translate((0.104, 0.007, 0.003))]),
                     energies=(dv.StableNeoHookean(), dv.PairBarrier(kappa=1e3, dhat=2e-3)))  # fmt: skip
    v = torch.zeros_like(model.rest_points)
    v[: one.num_vertices, 0] = 1.0
    given = {"mu": 2e5, "lam": 2e5, "gravity": (0.0, 0.0, 0.0)}
    settings = dv.advise(model, model.rest_points, v, duration=0.04, error=0.2, patience=20.0, **given)
    assert settings.predicted is not None and settings.predicted.reached
    runs = Pilots(dv.rollout, model, model.rest_points, v, 0.04, given)
    a = runs.run(settings, settings.steps(0.04))
    b = runs.run(settings, 4 * max(64, settings.steps(0.04)))
    assert a.x is not None and b.x is not None and runs.apart(a.x, b.x) <= 0.2


@pytest.mark.slow
def test_a_bounce_that_steps_resolve() -> None:
    """Contact converges with the second power of h once steps resolve it: 1 % can be had, and is kept."""
    body = mesh.box(2, 0.1, split="kuhn").translate((0, 4e-3, 0))
    model = dv.Model(body, energies=(dv.StableNeoHookean(), dv.FloorBarrier(kappa=1e5, dhat=2e-3)))
    x, v = model.rest_points, torch.zeros_like(model.rest_points)
    v[:, 1] = -1.0
    material, duration = {"young": 1e6, "poisson": 0.3}, 0.03
    settings = dv.advise(model, x, v, duration=duration, error=0.01, **material)
    assert settings.predicted is not None and settings.predicted.reached
    runs = Pilots(dv.rollout, model, x, v, duration, dict(material))
    steps = settings.steps(duration)
    given, exact = (
        runs.run(settings if n == steps else dv.Settings(1.0, 20, dv.SDIRK2()), n) for n in (steps, 6 * steps)
    )
    assert given.x is not None and exact.x is not None and given.v is not None
    error = runs.apart(given.x, exact.x)
    assert 0.01 / 20 < error <= 0.01
    assert float(given.v[-1, :, 1].mean()) > 0.3  # it has been thrown back


@pytest.mark.parametrize(
    ("quantity", "gradient", "got"),
    [
        (lambda x, v: x, False, r"scalar tensor, got shape \[28, 3\]"),
        (lambda x, v: 1.0, False, "scalar tensor, got float"),
        (lambda x, v: (x > 0).sum(), False, "floating scalar, got torch.int64"),
        (lambda x, v: (x > 0).any(), False, "floating scalar, got torch.bool"),
        (lambda x, v: math.nan * x.sum(), False, "finite value after the first step, got nan"),
        (lambda x, v: x.detach().sum(), True, "beside gradient=True, got one without a graph"),
        (lambda x, v: torch.ones((), requires_grad=True), True, "beside gradient=True, got one without a graph"),
    ],
)
@pytest.mark.parametrize("judge", ["advise", "budget"])
def test_a_quantity_that_cannot_be_judged_is_named(quantity, gradient: bool, got: str, judge: str) -> None:
    """Before the search: it would run until its patience ends, and blame the steps."""
    model, material = cantilever(1e5)
    x, v = model.rest_points, torch.zeros_like(model.rest_points)
    given = {"duration": 0.1, "quantity": quantity, "gradient": gradient, **material}
    with pytest.raises(ValueError, match=f"quantity: expected .*{got}"):
        if judge == "advise":
            dv.advise(model, x, v, **given)
        else:
            dv.error_budget(model, x, v, time_step=0.01, sweeps=2, **given)


@pytest.mark.parametrize("device", [None, "cpu"])
def test_a_policy_is_refused_on_any_device(device: str | None) -> None:
    model, material = cantilever(1e5)
    x = model.rest_points
    with pytest.raises(TypeError, match="force: expected a function of the time"):
        dv.advise(model, x, 0 * x, duration=0.1, device=device, force=lambda step, x, v: 0 * x, **material)
