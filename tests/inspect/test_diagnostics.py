"""`diagnose` names each limit that a state, a step or a Model crosses, and nothing else."""

import dataclasses
import warnings
from typing import Any

import pytest
import torch
from helpers.two_boxes import two_boxes

import diffvbd as dv
from diffvbd.inspect.diagnose import collapse_stretch, diagnose
from diffvbd.mesh import box, join
from diffvbd.testing import contact_scenes, tolerance

MATERIAL: dict[str, Any] = {"mu": 1e5, "lam": 1.5e5}


def cube(size: float = 1.0, **options) -> dv.Model:
    mesh = dv.mesh.cube(3, size=size, split="kuhn")
    return dv.Model(mesh, pinned=mesh.points[:, 0] < 1e-9 * size, **options)


def only(messages: list[str], word: str) -> None:
    assert len(messages) == 1 and word in messages[0], messages


def test_rest_state_is_clean() -> None:
    model = cube()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        result = diagnose(model, model.rest_points, dv.VBD(1 / 60, 1), **MATERIAL)
    assert result.ok
    assert result.smallest_volume_ratio == pytest.approx(1)
    assert result.largest_strain < tolerance("geometry")
    assert "smallest J" in str(result)


@pytest.mark.parametrize("ratio", [0.0, 1.0, 100.0])
def test_collapse_is_found_below_the_critical_stretch_only(ratio: float) -> None:
    model = cube()
    mu, lam = 1e4, 1e4 * ratio
    s = float(collapse_stretch(torch.tensor(mu).double(), torch.tensor(lam).double()))
    assert s**3 + s**2 + s == pytest.approx(1 / (1 + ratio))
    for stretch, lost in ((0.99 * s, True), (1.01 * s, False)):
        result = diagnose(model, stretch * model.rest_points, mu=mu, lam=lam, warn=False)
        assert result.collapsing.all() == lost and result.collapsing.any() == lost
        assert result.collapse_margin == pytest.approx(stretch / s)
        assert any("F = 0" in m for m in result.messages) == lost


def test_inverted_tets_are_counted_in_every_scene() -> None:
    model = cube()
    x = torch.stack([model.rest_points, model.rest_points * torch.tensor([-1.0, 1.0, 1.0])])
    result = diagnose(model, x, warn=False, **MATERIAL)
    assert result.inverted.sum(-1).tolist() == [0, model.num_tets]
    only(result.messages, "inverted")


def test_strain_and_nonfinite_positions() -> None:
    model = cube()
    only(diagnose(model, 100 * model.rest_points, warn=False, **MATERIAL).messages, "strain")
    x = model.rest_points.clone()
    x[5, 1] = float("nan")
    result = diagnose(model, x, warn=False, **MATERIAL)
    assert result.nonfinite.nonzero().tolist() == [[5]]
    assert "NaN" in result.messages[0]


def test_settings_that_do_not_promise_descent() -> None:
    model = cube()

    def messages(lam: float = 1.5e5, **options) -> list[str]:
        solver = dv.VBD(1 / 60, 1, **options)
        return diagnose(model, model.rest_points, solver, mu=1e5, lam=lam, warn=False).messages

    only(messages(lam=5e4, block="paper"), "lam < mu")
    only(messages(block="paper", relaxation=1.6), "relaxation")
    only(messages(relaxation=1.9), "relaxation")
    assert any("bulk modulus" in m for m in messages(lam=-8e4))
    assert messages(lam=5e4) == []


def test_leftover_force_falls_with_sweeps_and_knows_every_energy() -> None:
    mesh = dv.mesh.cube(3, split="kuhn")
    floor = dv.FloorBarrier(height=-0.01, kappa=1e4)
    model = dv.Model(mesh, energies=(dv.StableNeoHookean(), floor, dv.Anchor(100.0)))
    x, v = model.rest_points, torch.zeros_like(model.rest_points)
    force = torch.full_like(x, 3.0)
    options: dict[str, Any] = {"force": force, **MATERIAL}
    left = []
    for sweeps in (1, 10, 1000):
        solver = dv.VBD(1 / 60, sweeps)
        end, _ = dv.step(model, x, v, solver, **options)
        left.append(diagnose(model, end, solver, previous=(x, v), warn=False, **options).unbalanced)
    assert left[0] > left[1] > left[2]
    assert left[2] < tolerance("closed_form")
    stiff: dict[str, Any] = {"mu": 1e8, "lam": 1e8}
    solver = dv.VBD(1 / 60, 1)
    end, _ = dv.step(model, x, v, solver, **stiff)
    with pytest.warns(UserWarning, match="sweeps or a smaller time step, or relaxation between"):
        diagnose(model, end, solver, previous=(x, v), **stiff)
    with pytest.warns(UserWarning, match="sweeps or a smaller time step$"):
        diagnose(model, end, dataclasses.replace(solver, relaxation=1.6), previous=(x, v), **stiff)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_a_free_fall_leaves_no_force(dtype: torch.dtype) -> None:
    model = dv.Model(dv.mesh.cube(3, size=0.1, split="kuhn"), dtype=dtype)
    given: dict[str, Any] = {"mu": 1e5, "lam": 1e5}
    x, v = model.rest_points, torch.zeros_like(model.rest_points)
    motion = dv.rollout(model, x, v, dv.VBD(0.01, 10), steps=20, **given)
    found = dv.diagnose(
        model, motion.x[-1], dv.VBD(0.01, 1), previous=(motion.x[-2], motion.v[-2]), warn=False, **given
    )
    assert (motion.x[-1] - x)[:, 1].max() < -0.1 and found.unbalanced == 0.0 and found.ok


def test_pinned_reactions_are_no_residual() -> None:
    model = cube()
    x, v = model.rest_points, torch.zeros_like(model.rest_points)
    prescribed = torch.where(model.pinned[:, None], x + 0.01, torch.nan)
    solver = dv.VBD(1 / 60, 2000)
    end, _ = dv.step(model, x, v, solver, prescribed=prescribed, **MATERIAL)
    result = diagnose(model, end, solver, previous=(x, v), prescribed=prescribed, warn=False, **MATERIAL)
    assert result.unbalanced is not None and result.unbalanced < tolerance("closed_form")


def test_courant_number_counts_elements_per_step() -> None:
    model = cube()
    result = diagnose(model, model.rest_points, dv.VBD(0.1, 1), **MATERIAL, warn=False)
    # the shortest height of a Kuhn tet with legs a is a / sqrt(2)
    assert result.courant == pytest.approx(0.1 * (3.5e5 / 1000) ** 0.5 / (0.5 / 2**0.5))
    assert diagnose(model, model.rest_points, warn=False, **MATERIAL).courant is None


def test_bad_arguments() -> None:
    model = cube()
    x = model.rest_points
    with pytest.raises(ValueError, match="solver"):
        diagnose(model, x, previous=(x, x), **MATERIAL)
    with pytest.raises(ValueError, match="x: expected shape"):
        diagnose(model, x[:-1], **MATERIAL)
    for mu, error in ((torch.ones(7, dtype=x.dtype), ValueError), (float("nan"), ValueError), ("soft", TypeError)):
        with pytest.raises(error, match="^mu: expected"):
            diagnose(model, x, mu=mu, lam=1e4)  # pyright: ignore[reportArgumentType]


# --- `diagnose(previous=)` tells, body by body, what a step with contact left unbalanced, and of friction apart ---


SOFT: dict[str, Any] = {"mu": 2e4, "lam": 4e4}


def test_more_sweeps_leave_less(device: str) -> None:
    scene = contact_scenes.batched()
    model = scene.model.to(device)
    given = {k: v.to(device) for k, v in {**scene.inputs, **scene.parameters}.items()}
    given["gravity"] = contact_scenes.GRAVITY
    x, v = scene.x.to(device), scene.v.to(device)
    found = []
    for sweeps in (2, 20, 500):
        end, _ = dv.step(model, x, v, scene.solver(sweeps), **given)
        found.append(dv.diagnose(model, end, scene.solver(sweeps), previous=(x, v), warn=False, **given))
    for less, more in zip(found[:-1], found[1:], strict=True):
        assert (more.residuals < less.residuals).all() and more.unbalanced < less.unbalanced
        assert (more.friction_residuals < less.friction_residuals).all()
    assert found[0].residuals.shape == found[0].friction_residuals.shape == (3, 2)
    # scene 0 is held up by no pair, so that its sweeps converge
    assert float(found[-1].residuals[0].max()) <= tolerance("closed_form")
    assert float(found[-1].friction_residuals[0].max()) <= tolerance("closed_form")


def grip() -> dv.Model:
    """A block between two pinned ones that press on it, and a body far away in free fall; sticks by friction."""
    blocks = [box(2, 0.1), *(box(2, 0.08).translate((at, 0.01, 0.01)) for at in (-0.085, 0.105)),
              box(2, 0.1).translate((1.0, 0.0, 0.0))]  # fmt: skip
    energies = (dv.StableNeoHookean(), dv.PairBarrier(1e3, 0.01, self_contact=False), dv.Friction(0.6, 0.01))
    return dv.Model(join(blocks), density=100.0, pinned=list(range(8, 24)), energies=energies)


def test_friction_that_has_not_converged_is_named() -> None:
    model, solver = grip(), dv.VBD(1 / 240, 8)
    x = model.rest_points
    v = torch.zeros_like(x)
    few, _ = dv.step(model, x, v, solver, **SOFT)
    few[:8, 1] -= 1e-3  # it slips
    with pytest.warns(UserWarning) as warned:
        bad = dv.diagnose(model, few, solver, previous=(x, v), **SOFT)
    texts = [str(w.message) for w in warned]
    assert any("of the forces of body 0 unbalanced" in t for t in texts), texts
    assert any("friction has not converged" in t and "body 0" in t for t in texts), texts
    assert bad.residuals is not None and bad.friction_residuals is not None
    assert bad.residuals.tolist()[1:] == [0.0, 0.0, 0.0]  # pinned, pinned, and falling: no more than rounding
    assert bad.friction_residuals[0] > 0.05 and not bad.friction_residuals[1:].any()
    assert "left-over share of friction" in str(bad)

    goal = tolerance("closed_form")
    done = dv.solve(model, x, v, solver, tolerance=goal, **SOFT)
    good = dv.diagnose(model, done.x, solver, previous=(x, v), **SOFT)
    assert good.residuals is not None and good.friction_residuals is not None
    assert float(good.residuals.max()) <= goal and not any("unbalanced" in m or "friction" in m for m in good.messages)
    assert float(good.friction_residuals.max()) <= tolerance("minimum")


def test_bodies_without_contact_have_residuals_too() -> None:
    model = dv.Model(join([box(2, 0.2), box(2, 0.2).translate((1.0, 0, 0))]), pinned=[0, 1, 8, 9])
    x = model.rest_points
    solver = dv.VBD(0.005, 2)
    end, _ = dv.step(model, x, 0 * x, solver, **SOFT)
    told = dv.diagnose(model, end, solver, previous=(x, 0 * x), warn=False, **SOFT)
    assert told.residuals is not None and told.friction_residuals is None
    assert told.residuals.shape == (2,) and (told.residuals > 0).all()


@pytest.mark.parametrize("name", ["force", "gravity"])
def test_loads_that_are_not_finite_are_named(name: str) -> None:
    model = two_boxes()
    x = model.rest_points
    load = torch.full((3,), torch.nan, dtype=x.dtype)
    with pytest.raises(ValueError, match=f"{name}: expected finite values, got nan"):
        dv.diagnose(model, x, dv.VBD(0.005, 1), previous=(x, 0 * x), **{name: load}, **SOFT)


def test_no_error_is_estimated_with_contact() -> None:
    model, solver = two_boxes(), dv.VBD(0.005, 5)
    x = model.rest_points
    told = dv.diagnose(model, x, solver, previous=(x, 0 * x), warn=False, **SOFT)
    assert told.errors is None and told.relative_error is None
    with pytest.raises(ValueError, match="colliders: expected a Model with colliders"):
        dv.diagnose(model, x, solver, previous=(x, 0 * x), colliders=x[:1], warn=False, **SOFT)
