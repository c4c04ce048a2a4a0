"""Claim: `diagnose(previous=)` tells, body by body, what a step with contact left unbalanced, and of friction apart."""

from typing import Any

import pytest
import torch
from helpers.two_boxes import two_boxes

import diffvbd as dv
from diffvbd.mesh import box, join
from diffvbd.testing import contact_scenes, tolerance

SOFT: dict[str, Any] = {"mu": 2e4, "lam": 4e4, "time_step": 0.005}


def test_more_sweeps_leave_less(device: str) -> None:
    scene = contact_scenes.batched()
    model = scene.model.to(device)
    given = {k: v.to(device) for k, v in scene.inputs.items()}
    density = given.pop("density")
    parameters = {k: v.to(device) for k, v in scene.parameters.items()}
    x, v = scene.x.to(device), scene.v.to(device)
    options: dict[str, Any] = {**given, "time_step": 0.01, "gravity": contact_scenes.GRAVITY, "parameters": parameters}
    assert density.shape == (3, model.num_tets)
    found = []
    for sweeps in (2, 20, 500):
        end, _ = dv.step(model, x, v, sweeps=sweeps, **options)
        found.append(dv.diagnose(model, end, previous=(x, v), warn=False, **options))
    for less, more in zip(found[:-1], found[1:], strict=True):
        assert (more.residuals < less.residuals).all() and more.unbalanced < less.unbalanced
        assert (more.friction_residuals < less.friction_residuals).all()
    assert found[0].residuals.shape == found[0].friction_residuals.shape == (3, 2)
    # scene 0 is held up by no pair, so that its sweeps converge
    assert float(found[-1].residuals[0].max()) <= tolerance("closed_form")
    assert float(found[-1].friction_residuals[0].max()) <= tolerance("closed_form")


def grip() -> tuple[dv.Model, dict[str, Any], torch.Tensor, torch.Tensor]:
    """A block between two pinned ones that press on it, and a body far away in free fall; sticks by friction."""
    blocks = [box(2, 0.1), *(box(2, 0.08).translate((at, 0.01, 0.01)) for at in (-0.085, 0.105)),
              box(2, 0.1).translate((1.0, 0.0, 0.0))]  # fmt: skip
    energies = (dv.StableNeoHookean(), dv.PairBarrier(1e3, 0.01, self_contact=False), dv.Friction(0.6, 0.01))
    model = dv.Model(join(blocks), density=100.0, pinned=list(range(8, 24)), energies=energies)
    x = model.rest_points
    return model, {"mu": 2e4, "lam": 4e4, "time_step": 1 / 240}, x, torch.zeros_like(x)


def test_friction_that_has_not_converged_is_named() -> None:
    model, options, x, v = grip()
    few, _ = dv.step(model, x, v, sweeps=1, **options)
    few[:8, 1] -= 1e-3  # it slips
    with pytest.warns(UserWarning) as warned:
        bad = dv.diagnose(model, few, previous=(x, v), **options)
    texts = [str(w.message) for w in warned]
    assert any("of the forces of body 0 unbalanced" in t for t in texts), texts
    assert any("friction has not converged" in t and "body 0" in t for t in texts), texts
    assert bad.residuals.tolist()[1:] == [0.0, 0.0, 0.0]  # pinned, pinned, and falling: no more than rounding
    assert bad.friction_residuals[0] > 0.05 and not bad.friction_residuals[1:].any()
    assert "left-over share of friction" in str(bad)

    goal = tolerance("closed_form")
    done = dv.solve(model, x, v, tolerance=goal, **options)
    good = dv.diagnose(model, done.x, previous=(x, v), **options)
    assert float(good.residuals.max()) <= goal and not any("unbalanced" in m or "friction" in m for m in good.messages)
    assert float(good.friction_residuals.max()) <= tolerance("minimum")


def test_bodies_without_contact_have_residuals_too() -> None:
    model = dv.Model(join([box(2, 0.2), box(2, 0.2).translate((1.0, 0, 0))]), pinned=[0, 1, 8, 9])
    x = model.rest_points
    end, _ = dv.step(model, x, 0 * x, sweeps=2, **SOFT)
    told = dv.diagnose(model, end, previous=(x, 0 * x), warn=False, **SOFT)
    assert told.residuals.shape == (2,) and (told.residuals > 0).all() and told.friction_residuals is None


@pytest.mark.parametrize("name", ["force", "gravity"])
def test_loads_that_are_not_finite_are_named(name: str) -> None:
    model = two_boxes()
    x = model.rest_points
    load = torch.full((3,), torch.nan, dtype=x.dtype)
    with pytest.raises(ValueError, match=f"{name}: expected finite values, got nan"):
        dv.diagnose(model, x, previous=(x, 0 * x), **{name: load}, **SOFT)


def test_the_estimate_of_an_error_raises_with_contact() -> None:
    model = two_boxes()
    x = model.rest_points
    with pytest.raises(NotImplementedError, match="sweeps: the error of a step with contact"):
        dv.diagnose(model, x, previous=(x, 0 * x), sweeps=5, warn=False, **SOFT)
    with pytest.raises(ValueError, match="colliders: expected a Model with colliders"):
        dv.diagnose(model, x, previous=(x, 0 * x), colliders=x[:1], warn=False, **SOFT)
