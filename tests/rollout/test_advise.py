"""Advised settings keep the error that was asked for, and say so where none do."""

import dataclasses
import math
import warnings
from typing import Any

import pytest
import torch

import diffvbd as dv
from diffvbd import mesh
from diffvbd.rollout import search
from diffvbd.rollout.pilots import Pilots
from diffvbd.rollout.settings import Candidate
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


def test_runs_whose_error_is_known_are_shown_where_it_is_too_large() -> None:
    model, material = cantilever(1e6)
    model = model.to(dtype=torch.float32)  # whose rounding ends the search
    x, v = model.rest_points, torch.zeros_like(model.rest_points)
    told = dv.advise(model, x, v, duration=DURATION, error=1e-7, **material).predicted
    assert told is not None and not told.reached and len(told.others) > 1
    assert all(c.proven and c.error >= told.error for c in told.others)
    assert [c.seconds for c in told.others] == sorted(c.seconds for c in told.others)


def test_it_is_said_what_the_error_is_of() -> None:
    told = dv.Prediction(0.1, 0.08, 1.0, 0.5, False, "", (), 3.0, 7, "(the largest of motion and quantity)")
    text = str(dv.Settings(0.01, 5, predicted=told))
    assert text.splitlines()[1].startswith("error 0.08 (the largest of motion and quantity), not confirmed")
    model, material = cantilever(1e5)
    x, v = model.rest_points, torch.zeros_like(model.rest_points)

    def height(x: torch.Tensor, v: torch.Tensor) -> torch.Tensor:
        return x[:, 1].mean()

    cases: list[tuple[dict[str, Any], str]] = [
        ({}, "of the motion"),
        ({"quantity": height}, "(the largest of motion and quantity)"),
        ({"gradient": True}, "(the largest of motion, quantity and gradient)"),
    ]
    for given, of in cases:
        asked = dv.advise(model, x, v, duration=0.1, error=0.1, **material, **given).predicted
        assert asked is not None and asked.reached and asked.of == of
        names = [str(c.settings) for c in asked.others]
        assert len(set(names)) == len(names)


def test_in_single_precision_the_best_run_is_returned_and_rounding_blamed() -> None:
    model, material = cantilever(1e6)
    model = model.to(dtype=torch.float32)
    x, v = model.rest_points, torch.zeros_like(model.rest_points)
    settings = dv.advise(model, x, v, duration=DURATION, error=1e-7, **material)
    told = settings.predicted
    assert told is not None and not told.reached
    assert "as rounding does in torch.float32" in told.why and "patience" not in told.why
    assert f"than those of {dataclasses.replace(settings, predicted=None)} make it worse" in told.why


def test_a_quantity_that_is_not_finite_later_ends_the_search() -> None:
    model, material = cantilever(1e6)
    x, v = model.rest_points, torch.zeros_like(model.rest_points)
    fails = lambda x, v: (1e-4 + x[-1, 1] - model.rest_points[-1, 1]).sqrt()  # noqa: E731
    told = dv.advise(model, x, v, duration=DURATION, error=0.1, quantity=fails, **material).predicted
    assert told is not None and not told.reached
    assert "quantity is nan after" in told.why and told.runs < 10


def test_a_quantity_of_single_precision_in_a_budget() -> None:
    model, material = cantilever(1e6)
    model = model.to(dtype=torch.float32)
    x, weights = model.rest_points, torch.ones(3, dtype=torch.float32)
    seen = set()

    def quantity(x: torch.Tensor, v: torch.Tensor) -> torch.Tensor:
        seen.add(x.dtype)
        return (x @ weights).square().mean()

    budget = dv.error_budget(model, x, 0 * x, duration=0.04, time_step=0.01, sweeps=5, quantity=quantity,
                             gradient=True, **material)  # fmt: skip
    (share,) = (s for s in budget.shares if s.cause == "precision")
    assert seen == {torch.float32} and share.quantity is not None and share.gradient is not None
    assert share.gradient < 1e-2


def test_auto_in_a_rollout() -> None:
    model, material = cantilever(2e4)
    x, v = model.rest_points, torch.zeros_like(model.rest_points)
    mu = torch.tensor(material["mu"], dtype=torch.float64, requires_grad=True)
    end = dv.rollout(model, x, v, duration=0.1, settings="auto", mu=mu, lam=material["lam"])
    assert end.x.shape[1:] == x.shape
    assert torch.autograd.grad(end.x[-1].square().sum(), mu)[0] != 0
    with pytest.raises(ValueError, match='mu: expected a value beside settings="auto"'):
        dv.rollout(model, x, v, duration=0.1, settings="auto", mu=lambda step, x, v: 1e4, lam=1e4)


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


def test_scenes_over_two_dimensions_with_a_material_each() -> None:
    model, material = cantilever(1e5)
    x = model.rest_points.expand(2, 3, -1, -1)
    mu = torch.tensor([[5e4, 1e5, 2e5], [1e5, 1e5, 4e5]], dtype=torch.float64)[..., None]
    settings = dv.advise(model, x, torch.zeros_like(x), duration=0.1, error=0.1, mu=mu, lam=material["lam"])
    assert settings.predicted is not None and settings.predicted.reached


@pytest.mark.parametrize(("poisson", "over"), [(0.3, True), (0.4999, False)])
def test_nothing_is_over_relaxed_where_a_tet_is_nearly_incompressible(poisson: float, over: bool) -> None:
    """Moduli of each tet, as functions of time, and where they become so only later."""
    model, _ = cantilever(1e5)
    x = model.rest_points
    young = torch.linspace(1e5, 2e5, model.num_tets, dtype=x.dtype)
    ratios = torch.full_like(young, 0.3)
    ratios[3] = poisson
    later = lambda t: ratios if t > 0.01 else torch.full_like(young, 0.3)  # noqa: E731
    for given in ({"young": young, "poisson": ratios}, {"young": lambda t: young, "poisson": lambda t: ratios},
                  {"young": young, "poisson": later}):  # fmt: skip
        settings = dv.advise(model, x, torch.zeros_like(x), duration=0.02, error=0.3, patience=2.0, **given)
        assert ("relaxation" in str(settings)) == over


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


def test_runs_that_leave_forces_over_are_no_reference(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each has more sweeps than the one before, and plain ones once corrections stall."""
    tried: list[dv.Settings] = []
    run = Pilots.run

    def seen(self: Pilots, settings: dv.Settings, *args: Any, **options: Any) -> Any:
        tried.append(settings)
        return run(self, settings, *args, **options)

    model, material = cantilever(1e5)
    monkeypatch.setattr(Pilots, "run", seen)
    monkeypatch.setattr(Pilots, "left", lambda self: 0.5)
    monkeypatch.setattr(search, "MOST_SWEEPS", 50)
    told = dv.advise(model, model.rest_points, 0 * model.rest_points, duration=0.1, error=0.5, **material).predicted
    assert told is not None and not told.reached
    assert told.why.startswith("no reference could be reached: ") and told.why.endswith(
        "leaves 50 % of its forces unbalanced"
    )
    kinds = list(dict.fromkeys((s.sweeps, s.coarse is None) for s in tried))
    assert kinds == [(8, False), (17, False), (17, True), (35, True), (71, True)]


def test_auto_inside_refine() -> None:
    model, material = cantilever(2e4)
    x, v = model.rest_points, torch.zeros_like(model.rest_points)

    def loss() -> torch.Tensor:
        return dv.rollout(model, x, v, duration=0.1, settings="auto", save="last", **material).x[-1].square().sum()

    assert dv.refine(loss).survives
    with pytest.raises(TypeError, match="sweeps: expected a number"):
        dv.refine(lambda: dv.rollout(model, x, v, steps=2, time_step=0.01, **material).x.sum())


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


def test_advice_needs_values_and_graphs() -> None:
    model, _ = cantilever(1e5)
    x = model.rest_points
    given = {"duration": 0.02, "lam": 1e5}
    with torch.inference_mode(), pytest.raises(ValueError, match=r"gradient: expected False inside torch\.inference_m"):
        dv.advise(model, x, 0 * x, gradient=True, mu=1e5, **given)
    with pytest.raises(NotImplementedError, match=r"torch\.func transforms of dv\.advise"):
        auto = lambda mu: dv.rollout(model, x, 0 * x, settings="auto", mu=mu, **given).x  # noqa: E731
        torch.func.vmap(auto)(torch.full((2,), 1e5, dtype=x.dtype))


def test_advice_leaves_warnings_to_the_rollouts_that_follow() -> None:
    body = mesh.sheet(8, 8, (0.14, 0.14), 1e-3)
    model = dv.Model(body, pinned=body.points[:, 0] == 0)
    x = model.rest_points
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        dv.advise(model, x, 0 * x, duration=1 / 60, error=0.5, patience=1e-9, mu=1e5, lam=1e5)
    with pytest.warns(UserWarning, match="too few for tets"):
        dv.rollout(model, x, 0 * x, steps=1, time_step=1 / 60, sweeps=20, mu=1e5, lam=1e5)


def test_parameters_may_be_functions_of_time() -> None:
    energies = (dv.StableNeoHookean(), dv.FloorBarrier(height=-0.01))
    model = dv.Model(mesh.box(2, 0.1, split="kuhn"), energies=energies)
    x, v = model.rest_points, torch.zeros_like(model.rest_points)
    given = {"duration": 0.04, "time_step": 0.01, "sweeps": 2, "mu": 1e4, "lam": 1e4}
    kappa = torch.tensor(1e3, dtype=x.dtype)
    asked: list[float] = []
    of_time = lambda t: asked.append(t) or kappa  # noqa: E731
    ends = [dv.error_budget(model, x, v, parameters={"floor_barrier.kappa": k}, **given) for k in (kappa, of_time)]
    assert [s.motion for s in ends[0].shares] == [s.motion for s in ends[1].shares]
    assert max(asked) == pytest.approx(0.04)
    per_step = dv.per_step(kappa.expand(4))
    with pytest.raises(ValueError, match=r"parameters\[.*kappa.*\]: expected a value or a function of the time"):
        dv.advise(model, x, v, duration=0.04, mu=1e4, lam=1e4, parameters={"floor_barrier.kappa": per_step})
    with pytest.raises(ValueError, match=r'parameters\[.*kappa.*\]: expected a value beside settings="auto"'):
        dv.rollout(model, x, v, duration=0.04, settings="auto", mu=1e4, lam=1e4,
                   parameters={"floor_barrier.kappa": lambda step, x, v: kappa})  # fmt: skip


def test_gradients_by_moduli_that_have_no_part_in_the_motion_are_no_error() -> None:
    """Those of a body in free fall are rounding, which no time step makes smaller."""
    model = dv.Model(mesh.beam(4, 2, 2, size=(0.3, 0.1, 0.1), split="kuhn"))
    x = model.rest_points
    settings = dv.advise(model, x, 0 * x, duration=0.05, gradient=True, patience=20.0, mu=1e5, lam=1e5)
    assert settings.predicted is not None and settings.predicted.reached and settings.steps(0.05) < 32


def test_what_is_exact_in_the_ladder_says_nothing_absurd_of_others() -> None:
    """Free fall: SDIRK2 is exact, so errors of others are no multiple of its own. Implicit Euler is off by h / t."""
    model = dv.Model(mesh.beam(3, 2, 2, size=(0.3, 0.1, 0.1), split="kuhn"))
    x = model.rest_points
    told = dv.advise(model, x, torch.zeros_like(x), duration=0.3, error=0.01, mu=1e5, lam=1e5).predicted
    assert told is not None and told.reached
    steps = [c.settings.time_step for c in told.others if isinstance(c.settings.integrator, dv.ImplicitEuler)]
    assert steps and min(steps) > 1e-4


def test_runs_that_miss_the_error_are_marked() -> None:
    quick, slow = dv.Settings(0.02, 5), dv.Settings(0.005, 5)
    others = (Candidate(quick, 0.05, 0.1, True), Candidate(quick, 0.006, 0.2, False), Candidate(slow, 0.001, 2.0, True))
    told = dv.Prediction(0.01, 0.008, 1.0, 0.5, True, "", others, 3.0, 7)
    *rows, last = str(dataclasses.replace(quick, time_step=0.01, predicted=told)).splitlines()[-5:]
    assert "has not been run to the end" in last
    assert [row.rpartition("  ")[2] for row in rows] == [
        "measured",
        "measured, misses the error",
        "predicted",
        "measured",
    ]
