"""Claim: dv.solve converges steps with contact, friction and damping in every body, or says why it does not."""

from typing import Any

import pytest
import torch
from helpers.two_boxes import ball, two_boxes

import diffvbd as dv
from diffvbd.testing import contact_scenes, tolerance

SOFT: dict[str, Any] = {"mu": 2e4, "lam": 4e4, "time_step": 0.005}


def pushed(device: str = "cpu", dtype: torch.dtype = torch.float64) -> tuple[dv.Model, dict[str, Any]]:
    """A sliding box on a ball that moves, another on top of it, in two scenes; no pair holds anything up."""
    model = two_boxes(device, things=[ball()], damping=2.0, reach=0.2, detections=1).to(dtype=dtype)
    x = model.rest_points.expand(2, -1, -1).contiguous()
    v = torch.zeros_like(x)
    v[0, 8:, 0], v[1, :8, 1] = 0.1, 0.02
    path = model.collider_points + x.new_tensor([2e-4, 1e-4, 0.0])
    given = {"x": x, "v": v, "colliders": path, "colliders_before": model.collider_points}
    return model, given


@pytest.mark.parametrize("goal", (1e-4, 1e-11))
def test_the_residual_of_every_body_meets_the_tolerance(device: str, goal: float) -> None:
    model, given = pushed(device)
    done = dv.solve(model, tolerance=goal, **given, **SOFT)
    assert done.converged and 0 < done.residual <= goal
    assert dv.contact.status(model).cut == [0, 0] and dv.contact.status(model).pairs > 0
    x, v = given.pop("x"), given.pop("v")
    told = dv.diagnose(model, done.x, previous=(x, v), warn=False, **given, **SOFT)
    assert told.residuals is not None and told.residuals.shape == (2, 2)
    rel, least = tolerance("reported_residual"), tolerance("linear_residual")
    assert float(told.residuals.max()) == pytest.approx(done.residual, rel=rel, abs=least)


def test_it_is_a_step_of_as_many_sweeps(device: str) -> None:
    model, given = pushed(device)
    done = dv.solve(model, tolerance=1e-6, **given, **SOFT)
    x, v = dv.step(model, sweeps=done.sweeps, **given, **SOFT)
    assert torch.equal(done.x, x) and torch.equal(done.v, v)
    sooner = dv.solve(model, tolerance=1e-2, check_every=3, **given, **SOFT)
    assert sooner.sweeps < done.sweeps


def test_its_derivative_is_that_of_the_executed_sweeps(device: str) -> None:
    model, given = pushed(device)
    leaves = {k: t.clone().requires_grad_() for k, t in given.items()}
    leaves["friction"] = torch.tensor(0.4, dtype=torch.float64, device=device, requires_grad=True)

    def gradients(run: Any) -> tuple[torch.Tensor, ...]:
        named = {"friction.coefficient": leaves["friction"]}
        end = run(parameters=named, **{k: t for k, t in leaves.items() if k != "friction"}, **SOFT)
        return torch.autograd.grad((end * torch.linspace(0, 1, 3).to(end)).sum(), list(leaves.values()))

    found = dv.solve(model, tolerance=1e-6, **given, **SOFT)
    solved = gradients(lambda **options: dv.solve(model, tolerance=1e-6, adjoint=dv.ReverseSweep(), **options).x)
    stepped = gradients(lambda **options: dv.step(model, sweeps=found.sweeps, **options)[0])
    for name, a, b in zip(leaves, solved, stepped, strict=True):
        assert torch.equal(a, b) and a.any(), name


def test_a_step_that_bounds_cut_short_does_not_converge_and_says_so() -> None:
    scene = contact_scenes.fast()
    options: dict[str, Any] = {"mu": 2e4, "lam": 4e4, "time_step": 0.01, "max_sweeps": 60}
    with pytest.raises(RuntimeError, match="residual of at most 1e-08, got .* more detections or a larger reach"):
        dv.solve(scene.model, scene.x, scene.v, **options)
    with pytest.warns(RuntimeWarning, match="larger reach"):
        done = dv.solve(scene.model, scene.x, scene.v, on_failure="warn", **options)
    assert not done.converged and done.sweeps == 60 and done.residual > 0.1


def test_too_few_sweeps_for_friction_say_so() -> None:
    model, given = pushed()
    with pytest.raises(RuntimeError, match=r"after 7 sweeps; take more .*larger Friction\(velocity=\)"):
        dv.solve(model, max_sweeps=7, **given, **SOFT)
