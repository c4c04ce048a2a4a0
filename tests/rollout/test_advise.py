"""Advised settings keep the error that was asked for, and say so where none do."""

import dataclasses
import math
from collections.abc import Callable
from typing import Any, cast

import pytest
import torch
from torch import Tensor

import diffvbd as dv
from diffvbd import mesh
from diffvbd.rollout.refine import is_balanced
from diffvbd.rollout.tune import SWINGS, TrialRun, TrialRuns, unseen
from diffvbd.testing.tolerances import tolerance

DURATION = 0.3


def cantilever(modulus: float) -> tuple[dv.Model, dict[str, float]]:
    body = mesh.beam(7, 2, 2, size=(0.6, 0.1, 0.1), split="kuhn")
    return dv.Model(body, pinned=torch.tensor(body.points[:, 0] < 1e-9)), {"mu": modulus, "lam": modulus}


def off(model: dv.Model, settings: dv.VBD, material: dict[str, float], duration: float, **options) -> float:
    """The true error: against a run of very many steps and sweeps."""
    x, v = model.rest_points, torch.zeros_like(model.rest_points)
    runs = TrialRuns(model, x, v, duration, {**material, **options})
    given = runs.run(settings, settings.steps(duration))
    exact = runs.run(dv.VBD(1.0, 40, integrator=dv.SDIRK2()), 4 * max(256, settings.steps(duration)))
    assert given.x is not None and exact.x is not None
    return runs.apart(given.x, exact.x)


@pytest.mark.parametrize("modulus", [2e4, 1e6])
@pytest.mark.parametrize("error", [0.1, 0.01])
def test_the_true_error_is_at_most_what_was_asked(modulus: float, error: float) -> None:
    model, material = cantilever(modulus)
    x, v = model.rest_points, torch.zeros_like(model.rest_points)
    settings = dv.advise(model, x, v, duration=DURATION, error=error, **material)
    told = settings.prediction
    assert told is not None and told.reached and told.error <= error and told.asked == error
    true = off(model, settings, material, DURATION)
    assert 0.02 * error < true <= error
    assert told.seconds > 0 and told.spent > 0
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

    def gradient(settings: dv.VBD, duration: float = 0.2) -> torch.Tensor:
        mu = torch.tensor(material["mu"], dtype=torch.float64, requires_grad=True)
        end = dv.rollout(model, x, v, settings, duration=duration, mu=mu, lam=material["lam"], save="last")
        return torch.autograd.grad((end.x[-1] - x).square().sum(-1).mean(), mu)[0]

    exact = gradient(dv.VBD(0.2 / 512, 40, integrator=dv.SDIRK2()))
    assert exact != 0
    assert abs(gradient(settings) - exact) <= 0.05 * abs(exact)


def test_loads_may_be_functions_of_time() -> None:
    model, material = cantilever(1e5)
    x, v = model.rest_points, torch.zeros_like(model.rest_points)

    def gravity(t: float) -> torch.Tensor:
        return x.new_tensor([0.0, -9.81 * math.cos(20 * t), 0.0])

    settings = dv.advise(model, x, v, duration=0.2, error=0.05, gravity=gravity, **material)
    assert settings.prediction is not None and settings.prediction.reached
    assert off(model, settings, material, 0.2, gravity=gravity) <= 0.05


def test_an_error_that_was_not_reached_is_named() -> None:
    model, material = cantilever(1e8)
    x, v = model.rest_points, torch.zeros_like(model.rest_points)
    settings = dv.advise(model, x, v, duration=1.0, error=1e-3, time_budget=0.2, **material)
    told = settings.prediction
    assert told is not None and not told.reached and told.error > 1e-3
    assert "time_budget" in told.why and "was not reached" in str(settings)


def test_in_single_precision_the_best_run_is_returned_and_rounding_blamed() -> None:
    model, material = cantilever(1e6)
    model = model.to(dtype=torch.float32)
    x, v = model.rest_points, torch.zeros_like(model.rest_points)
    settings = dv.advise(model, x, v, duration=DURATION, error=1e-7, **material)
    told = settings.prediction
    assert told is not None and not told.reached
    assert "as rounding does in torch.float32" in told.why and "time_budget" not in told.why
    assert f"than those of {dataclasses.replace(settings, prediction=None)} make it worse" in told.why


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
        ({"time_budget": 0}, ValueError, "time_budget: expected"),
        ({"sweeps": 3}, TypeError, "sweeps: expected an input of this Model"),
        ({"mu": -1.0}, ValueError, "mu: expected"),
        ({"gravity": dv.per_step(torch.zeros(4, 3, dtype=torch.float64))}, ValueError, "gravity: expected a value or"),
    ],
)
def test_bad_input(given, error, text) -> None:
    model, material = cantilever(1e5)
    x = model.rest_points
    with pytest.raises(error, match=text):
        dv.advise(model, x, torch.zeros_like(x), **{"duration": 0.1, **material} | given)


@pytest.mark.parametrize("integrator", [dv.ImplicitEuler(), dv.SDIRK2(), dv.BDF2()], ids=str)
def test_converged_steps_with_friction_are_known_to_balance(integrator: Any) -> None:
    """The part of a step that SDIRK2 and BDF2 solve smooths friction over what the whole step does."""
    body = mesh.box(2, 0.1, split="kuhn").translate((0, 1e-3, 0))
    energies = (dv.StableNeoHookean(), dv.FloorBarrier(kappa=1e4, dhat=2e-3), dv.Friction(0.4))
    model = dv.Model(body, energies=energies)
    x = model.rest_points
    runs = TrialRuns(model, x, torch.zeros_like(x), 0.01, {"mu": 1e5, "lam": 2e5})
    assert not runs.run(dv.VBD(1.0, 100, integrator=integrator), 100).failure
    assert is_balanced(runs.left())


@pytest.mark.slow
def test_an_impact_that_long_steps_lose_is_not_taken_for_motion() -> None:
    """In long steps a cube that meets another one loses its rebound, and runs of h and h/2 agree on that."""
    one = mesh.box(2, 0.1, split="kuhn")
    model = dv.Model(mesh.join([one, one.translate((0.104, 0.007, 0.003))]),
                     energies=(dv.StableNeoHookean(), dv.PairBarrier(kappa=1e3, dhat=2e-3)))  # fmt: skip
    v = torch.zeros_like(model.rest_points)
    v[: one.num_vertices, 0] = 1.0
    given = {"mu": 2e5, "lam": 2e5, "gravity": (0.0, 0.0, 0.0)}
    settings = dv.advise(model, model.rest_points, v, duration=0.04, error=0.2, time_budget=20.0, **given)
    assert settings.prediction is not None and settings.prediction.reached
    runs = TrialRuns(model, model.rest_points, v, 0.04, given)
    a = runs.run(settings, settings.steps(0.04))
    b = runs.run(settings, 4 * max(64, settings.steps(0.04)))
    assert a.x is not None and b.x is not None and runs.apart(a.x, b.x) <= 0.2


@pytest.mark.slow
@pytest.mark.parametrize("held", [False, True])
def test_what_springs_take_up_is_not_taken_for_lost(held: bool) -> None:
    energies = (dv.StableNeoHookean(), *([dv.Anchor(4.0)] if held else []))
    model = dv.Model(dv.mesh.cube(3, 0.1), energies=energies)
    x, v = model.rest_points, torch.zeros_like(model.rest_points)
    trials = TrialRuns(model, x, v, 0.1, {"young": 1e5, "poisson": 0.3, "gravity": (0.0, 0.0, 0.0)})
    slowed = TrialRun(dv.VBD(0.01, 2), 1, torch.stack([x, x + 0.05]), torch.stack([v + 1.0, v]))
    assert (trials.lost(slowed, 0.01) > 0) != held


def test_a_bounce_that_steps_resolve() -> None:
    """Contact converges with the second power of h once steps resolve it: 1 % can be reached."""
    body = mesh.box(2, 0.1, split="kuhn").translate((0, 4e-3, 0))
    model = dv.Model(body, energies=(dv.StableNeoHookean(), dv.FloorBarrier(kappa=1e5, dhat=2e-3)))
    x, v = model.rest_points, torch.zeros_like(model.rest_points)
    v[:, 1] = -1.0
    material, duration = {"young": 1e6, "poisson": 0.3}, 0.03
    settings = dv.advise(model, x, v, duration=duration, error=0.01, **material)
    assert settings.prediction is not None and settings.prediction.reached
    runs = TrialRuns(model, x, v, duration, dict(material))
    steps = settings.steps(duration)
    given, exact = (
        runs.run(settings if n == steps else dv.VBD(1.0, 20, integrator=dv.SDIRK2()), n) for n in (steps, 6 * steps)
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
        (lambda x, v: x.detach().sum(), True, "with gradient=True, got one without a graph"),
        (lambda x, v: torch.ones((), requires_grad=True), True, "with gradient=True, got one without a graph"),
    ],
)
@pytest.mark.parametrize("judge", ["advise", "budget"])
def test_a_quantity_that_cannot_be_judged_is_named(quantity, gradient: bool, got: str, judge: str) -> None:
    """Before the search: it would run until its time budget ends, and blame the steps."""
    model, material = cantilever(1e5)
    x, v = model.rest_points, torch.zeros_like(model.rest_points)
    given = {"duration": 0.1, "quantity": quantity, "gradient": gradient, **material}
    with pytest.raises(ValueError, match=f"quantity: expected .*{got}"):
        if judge == "advise":
            dv.advise(model, x, v, **given)
        else:
            dv.error_budget(model, x, v, dv.VBD(0.01, 2), **given)


@pytest.mark.parametrize("device", [None, "cpu"])
def test_a_policy_is_refused_on_any_device(device: str | None) -> None:
    model, material = cantilever(1e5)
    x = model.rest_points
    with pytest.raises(TypeError, match="force: expected a function of the time"):
        dv.advise(model, x, 0 * x, duration=0.1, device=device, force=lambda step, x, v: 0 * x, **material)


# --- loads between the steps of trial runs ----------------------------------------------------------------------------


SHORT = 0.1
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
    settings = dv.advise(model, x, 0 * x, duration=SHORT, error=0.1, time_budget=20.0, **given)
    told = settings.prediction
    assert told is not None and told.reached and settings.steps(SHORT) > 3 * FREQUENCY * SHORT

    def end(steps: int) -> Tensor:
        h = SHORT / steps
        return dv.rollout(model, x, 0 * x, dv.VBD(h, 20, integrator=dv.SDIRK2()), steps=steps, save="last", mu=1e5,
                          lam=1e5, gravity=(0.0, 0.0,
                                            0.0), force=lambda k, x, v: force((k + 0.5) * h)).x[-1] - x  # fmt: skip

    exact, few = end(1024), end(16)
    assert float(few.norm()) < 0.01 * float(exact.norm())  # which sixteen steps do not see at all
    assert float((end(settings.steps(SHORT)) - exact).norm()) < 0.2 * float(exact.norm())


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
    assert (unseen(function, 0.5, steps, SHORT, moves) <= SWINGS) == is_seen


RELEASED, EDGE = 0.103, 5e-4  # [s]: after it the push fades within some 2 ms
LONG: dict[str, Any] = {"mu": 1e5, "lam": 1e5, "gravity": (0.0, 0.0, 0.0), "save": "last"}


def released(push: Callable[[Tensor, Tensor], Any], integrator: Any = None, **given: Any) -> tuple[Tensor, Tensor]:
    """How far a cube has come that is pushed until a time, over the closed form [-]; and the same of its derivative."""
    model = dv.Model(dv.mesh.cube(2, size=0.1))
    x = model.rest_points
    time = torch.tensor(RELEASED, dtype=torch.float64, requires_grad=True)
    force = torch.tensor([0.1, 0.0, 0.0], dtype=torch.float64).expand_as(x)
    solver = dv.VBD(0.02, 5, integrator=integrator or dv.SDIRK2())
    end = dv.rollout(model, x, 0 * x, solver, steps=20, force=push(time, force), **LONG, **given).x[-1]
    way = (end - x)[:, 0].mean()
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


def averaged(call: Callable[..., object], name: str, **given: Any) -> object:
    model, x, _ = beam()
    return call(model, x, 0 * x, dv.VBD(0.01, 1), mu=1.0, lam=1.0, **given, **{name: dv.step_average(lambda t: t)})


@pytest.mark.parametrize(
    ("call", "error", "words"),
    [
        (lambda: dv.step_average(cast(Any, 1.0)), TypeError, "function: expected a function of the time"),
        (lambda: dv.step_average(lambda t: t, samples=0), ValueError, "samples: expected"),
        (lambda: averaged(dv.rollout, "prescribed", steps=1), TypeError, "prescribed: expected positions"),
        (lambda: averaged(dv.error_budget, "colliders", duration=0.1), TypeError, "colliders: expected positions"),
    ],
)  # fmt: skip
def test_bad_input_of_a_mean(call: Callable[[], object], error: type[Exception], words: str) -> None:
    with pytest.raises(error, match=words):
        call()
