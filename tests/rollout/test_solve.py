"""Claim: dv.solve sweeps until the step has converged, says so, and has the derivative of the converged step."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from helpers.two_boxes import ball, two_boxes

import diffvbd as dv
from diffvbd import reference
from diffvbd.testing import build_scene, contact_scenes, evaluate, relative_error, tolerance

CASES = ("plain", "paper", "stiff", "floor_damped", "floor_corner", "anchored", "batch")


def scene_on(device: str, case: str) -> tuple[dv.Model, dv.VBD, dict[str, Any]]:
    scene = build_scene(case, "delaunay")
    return scene.model(device), scene.solver(1), scene.inputs(device=device)


@pytest.mark.parametrize("goal", (1e-4, 1e-9))
@pytest.mark.parametrize("case", CASES)
def test_the_residual_meets_the_tolerance(device: str, case: str, goal: float) -> None:
    """Measured by the reference's potential."""
    model, solver, inputs = scene_on(device, case)
    done = dv.solve(model, solver=solver, tolerance=goal, check_every=5, **inputs)
    assert done.converged and done.sweeps >= 5
    x, v, h = inputs["x"], inputs["v"], solver.time_step
    mass = torch.where(model.mass > 0, model.mass, 1.0)[:, None]
    y = x + h * v + h * h * (inputs["gravity"] + inputs["force"] / mass)
    parameters = {k: t for k, t in inputs.items() if k.startswith(("floor", "anchor"))}
    left = reference.residual(model, done.x, y, inputs["mu"], inputs["lam"], h, x, density=inputs["density"],
                              rest_points=inputs["rest_points"], parameters=parameters)  # fmt: skip
    left, inertia = (torch.where(model.pinned[:, None], 0.0, a) for a in (left, mass * (done.x - y)))
    scale = inertia.flatten(-2).norm(dim=-1) + (left - inertia).flatten(-2).norm(dim=-1)
    residual = float((left.flatten(-2).norm(dim=-1) / scale).max())
    assert residual <= goal
    rel, least = tolerance("reported_residual"), tolerance("linear_residual")
    assert done.residual == pytest.approx(residual, rel=rel, abs=least)


@pytest.mark.parametrize("case", CASES)
def test_it_is_a_step_of_as_many_sweeps(device: str, case: str) -> None:
    model, solver, inputs = scene_on(device, case)
    done = dv.solve(model, solver=solver, tolerance=1e-6, **inputs)
    x, v = dv.step(model, **inputs, solver=replace(solver, sweeps=done.sweeps))
    assert relative_error(done.x, x) <= tolerance("forward")
    assert relative_error(done.v * solver.time_step, v * solver.time_step) <= tolerance("travel")
    assert device != "cpu" or (torch.equal(done.x, x) and torch.equal(done.v, v))


@pytest.mark.parametrize("case", CASES)
def test_its_default_derivative_is_that_of_the_executed_sweeps(device: str, case: str) -> None:
    """At convergence; the two come to it by different ways."""
    model, solver, inputs = scene_on(device, case)

    def run(adjoint: Any) -> dict[str, torch.Tensor]:
        def solved(**options: Any) -> tuple[torch.Tensor, torch.Tensor]:
            done = dv.solve(model, solver=solver, tolerance=1e-13, adjoint=adjoint, on_failure="warn", **options)
            return done.x, done.v

        return evaluate(solved, inputs, solver.time_step)

    implicit, executed = run(dv.GlobalAdjoint(tolerance=1e-13)), run(dv.ReverseSweep())
    names = [name for name in executed if name.startswith("grad_") and bool(executed[name].any())]
    assert {"grad_x", "grad_mu", "grad_rest_points", "grad_force"} <= set(names)
    for name in names:
        assert relative_error(implicit[name], executed[name]) <= tolerance("global_converged"), name


def test_its_gradient_agrees_with_differences(device: str) -> None:
    model, solver, inputs = scene_on(device, "floor_damped")
    keys = ("lam", "density", "gravity", "prescribed", "force", "floor_kappa", "floor_height", "floor_normal")
    fixed = {k: inputs.pop(k) for k in (*keys, "floor_damping", "floor_dhat") if k in inputs}

    def loss(**arguments: Any) -> torch.Tensor:
        done = dv.solve(model, solver=solver, tolerance=1e-13, adjoint=dv.GlobalAdjoint(tolerance=1e-12),
                        **arguments, **fixed)  # fmt: skip
        return done.x.square().sum() + 0.01 * done.v[..., 0].sum()

    check = dv.check_gradients(loss, inputs, verbose=False)
    assert check.ok and all(size > 0 for _, size, *_ in check.rows), str(check)


def test_a_body_at_rest_or_in_free_fall_needs_no_sweep(device: str) -> None:
    """What rounding leaves of a force that is zero does not count."""
    model = dv.Model(dv.mesh.cube(3, split="kuhn"), device=device)
    for height in (0.0, 1e3):
        x = model.rest_points + height
        done = dv.solve(model, x, torch.ones_like(x), dv.VBD(0.01, 1), mu=1e5, lam=1e5)
        assert done.sweeps == 0 and done.converged


def test_not_converging_is_never_silent(device: str) -> None:
    model, solver, inputs = scene_on(device, "stiff")
    message = "solve: expected a residual of at most 1e-09, got .* after 7 sweeps"
    with pytest.raises(RuntimeError, match=message):
        dv.solve(model, solver=solver, tolerance=1e-9, max_sweeps=7, **inputs)
    with pytest.warns(RuntimeWarning, match=message):
        done = dv.solve(model, solver=solver, tolerance=1e-9, max_sweeps=7, on_failure="warn", **inputs)
    assert not done.converged and done.sweeps == 7 and done.residual > 1e-9


BAD = [
    ({"tolerance": 0.0}, ValueError, "tolerance: expected a finite number > 0"),
    ({"tolerance": 1.0}, ValueError, r"tolerance: expected a number in \(0, 1\), got 1.0"),
    ({"tolerance": "1e-3"}, TypeError, "tolerance: expected a number, got str"),
    ({"max_sweeps": -1}, ValueError, "max_sweeps: expected an integer >= 0"),
    ({"check_every": 0}, ValueError, "check_every: expected an integer >= 1"),
    ({"on_failure": "pass"}, ValueError, "on_failure: expected"),
    *(({name: value}, ValueError, f"^{name}: expected finite values")
      for name in ("mu", "lam") for value in (float("nan"), float("inf"))),
    ({"gravity": (0.0, float("nan"), 0.0)}, ValueError, "^gravity: expected finite values, got nan"),
    ({"adjoint": "global"}, TypeError, "adjoint: expected a diffvbd.ReverseSweep, Unrolled or GlobalAdjoint, got str"),
]  # fmt: skip


@pytest.mark.parametrize(("options", "error", "message"), BAD)
def test_bad_arguments_are_named(options: dict, error: type, message: str) -> None:
    model, solver, inputs = scene_on("cpu", "plain")
    with pytest.raises(error, match=message):
        dv.solve(model, solver=solver, **(inputs | options))


def test_float32(device: str) -> None:
    scene = build_scene("floor_damped", "delaunay")
    single = dv.solve(
        scene.model(device).to(dtype=torch.float32),
        solver=scene.solver(1),
        tolerance=1e-4,
        **scene.inputs(torch.float32, device),
    )
    double = dv.solve(scene.model(), solver=scene.solver(1), **scene.inputs())
    assert relative_error(single.x, double.x) <= tolerance("float32_forward") and single.x.dtype == torch.float32


# --- with contact -----------------------------------------------------------------------------------------------------


SOFT: dict[str, Any] = {"mu": 2e4, "lam": 4e4}
STEP = 0.005


def pushed(device: str = "cpu", dtype: torch.dtype = torch.float64) -> tuple[dv.Model, dict[str, Any]]:
    """A sliding box on a ball that moves, another on top of it, in two scenes; no pair holds anything up."""
    model = two_boxes(device, things=[ball()], damping=2.0, reach=0.2, detections=1).to(dtype=dtype)
    x = model.rest_points.expand(2, -1, -1).contiguous()
    v = torch.zeros_like(x)
    v[0, 8:, 0], v[1, :8, 1] = 0.1, 0.02
    path = model.collider_points + x.new_tensor([2e-4, 1e-4, 0.0])
    given = {"x": x, "v": v, "colliders": path, "colliders_before": model.collider_points}
    return model, given


@pytest.mark.parametrize("goal", (1e-4, 1e-8))
def test_the_residual_of_every_body_meets_the_tolerance(device: str, goal: float) -> None:
    model, given = pushed(device)
    done = dv.solve(model, solver=dv.VBD(STEP, 1), tolerance=goal, **given, **SOFT)
    assert done.converged and 0 < done.residual <= goal
    assert dv.contact.status(model).truncated == [0, 0] and dv.contact.status(model).pairs > 0
    x, v = given.pop("x"), given.pop("v")
    told = dv.diagnose(model, done.x, dv.VBD(STEP, 1), previous=(x, v), warn=False, **given, **SOFT)
    assert told.residuals is not None and told.residuals.shape == (2, 2)
    rel, least = tolerance("reported_residual"), tolerance("linear_residual")
    assert float(told.residuals.max()) == pytest.approx(done.residual, rel=rel, abs=least)


def test_it_is_a_step_of_as_many_sweeps_with_contact(device: str) -> None:
    model, given = pushed(device)
    done = dv.solve(model, solver=dv.VBD(STEP, 1), tolerance=1e-6, **given, **SOFT)
    x, v = dv.step(model, **given, **SOFT, solver=dv.VBD(STEP, done.sweeps))
    assert torch.equal(done.x, x) and torch.equal(done.v, v)
    sooner = dv.solve(model, solver=dv.VBD(STEP, 1), tolerance=1e-2, check_every=3, **given, **SOFT)
    assert sooner.sweeps < done.sweeps


def test_its_derivative_is_that_of_the_executed_sweeps(device: str) -> None:
    model, given = pushed(device)
    leaves = {k: t.clone().requires_grad_() for k, t in given.items()}
    leaves["friction"] = torch.tensor(0.4, dtype=torch.float64, device=device, requires_grad=True)

    def gradients(run: Any) -> tuple[torch.Tensor, ...]:
        end = run(**leaves, **SOFT)
        return torch.autograd.grad((end * torch.linspace(0, 1, 3).to(end)).sum(), list(leaves.values()))

    found = dv.solve(model, solver=dv.VBD(STEP, 1), tolerance=1e-6, **given, **SOFT)
    solved = gradients(lambda **options: dv.solve(model, solver=dv.VBD(STEP, 1), tolerance=1e-6, **options).x)
    stepped = gradients(lambda **options: dv.step(model, **options, solver=dv.VBD(STEP, found.sweeps))[0])
    for name, a, b in zip(leaves, solved, stepped, strict=True):
        assert torch.equal(a, b) and a.any(), name


def test_a_step_that_bounds_cut_short_does_not_converge_and_says_so() -> None:
    scene = contact_scenes.fast()
    options: dict[str, Any] = {"mu": 2e4, "lam": 4e4, "max_sweeps": 60}
    with pytest.raises(RuntimeError, match="residual of at most 1e-08, got .* more detections or a larger reach"):
        dv.solve(scene.model, scene.x, 2 * scene.v, dv.VBD(0.01, 1), **options)
    with pytest.warns(RuntimeWarning, match="larger reach"):
        done = dv.solve(scene.model, scene.x, 2 * scene.v, dv.VBD(0.01, 1), on_failure="warn", **options)
    assert not done.converged and done.sweeps == 60 and done.residual > 0.05


def test_too_few_sweeps_for_friction_say_so() -> None:
    model, given = pushed()
    with pytest.raises(RuntimeError, match=r"after 7 sweeps; take more .*larger Friction\(velocity=\)"):
        dv.solve(model, solver=dv.VBD(STEP, 1), max_sweeps=7, **given, **SOFT)
