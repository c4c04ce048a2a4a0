"""Claim: a rollout, or a step of a loop, that ends with what is no number or too far away says so, each time, and what
is at fault; so does one whose sweeps leave its motion wrong, and one that bends tets too thin for it."""

import warnings
from typing import Any

import pytest
import torch
from torch import Tensor

import diffvbd as dv
from diffvbd.step.lost import FAR

MEASURES_GROWTH = True  # see conftest.py

SOFT: dict[str, Any] = {"mu": 1e4, "lam": 1e4, "time_step": 0.01, "sweeps": 10}


def bent(**options: Any) -> tuple[dv.Model, Tensor, Tensor]:
    """A bar whose velocities bend it."""
    model = dv.Model(dv.mesh.box((5, 2, 2), (0.4, 0.1, 0.1)), **options)
    x = model.rest_points
    v = torch.zeros_like(x)
    v[:, 1] = 20 * x[:, 0].square()
    return model, x, v


def messages(run: Any) -> list[str]:
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        run()
    return [str(w.message) for w in found]


# --- what is no number, or far away -----------------------------------------------------------------------------------


def lost() -> tuple[dv.Model, Tensor, Tensor]:
    """A state so stretched that a step in single precision has no number for it."""
    model, x, v = bent(dtype=torch.float32)
    return model, 1e20 * x, v


def test_an_end_that_is_no_number_is_warned_of() -> None:
    model, x, v = lost()
    for _ in range(2):  # each time
        with pytest.warns(UserWarning, match="x: the rollout ended with positions or velocities that are not") as found:
            end = dv.rollout(model, x, v, steps=1, save="last", **SOFT)
        assert not bool(torch.isfinite(end.x).all())
        assert found[0].filename == __file__
    with pytest.raises(ValueError, match="expected finite values"):
        dv.rollout(model, x, v, steps=2, **SOFT)
    assert messages(lambda: dv.rollout(model, 1e-20 * x, v, steps=1, **SOFT)) == []


@pytest.mark.cuda
def test_the_next_rollout_says_it_on_cuda() -> None:
    model, x, v = lost()
    model, x, v = model.to("cuda"), x.cuda(), v.cuda()
    assert messages(lambda: dv.rollout(model, x, v, steps=2, **SOFT)) == []
    torch.cuda.synchronize()
    with pytest.warns(UserWarning, match="before this one ended"):
        dv.rollout(model, 1e-20 * x, v, steps=1, **SOFT)
    torch.cuda.synchronize()
    assert messages(lambda: dv.rollout(model, 1e-20 * x, v, steps=1, **SOFT)) == []


def driven(force: Any, steps: int = 30) -> list[str]:
    model, x, v = bent()
    return messages(lambda: dv.rollout(model, x, 0 * v, steps=steps, force=force, gravity=(0.0, -1.0, 0.0), **SOFT))


def test_a_force_that_explodes_is_blamed() -> None:
    """An explicit drag of 50 N s/m: each step turns velocities round and makes more of them."""
    for _ in range(2):  # each time
        (text,) = driven(lambda k, x, v: -50.0 * v, steps=20)
        assert f"more than {FAR:g} body sizes" in text and "force: in one step it changes velocities by more" in text
    with pytest.raises(
        ValueError, match=r"expected finite values.*\(in step \d+\), which the steps before made; force:"
    ):
        driven(lambda k, x, v: -50.0 * v, steps=200)
    with pytest.raises(ValueError, match=r"force: expected finite values, got nan .*\(in step 3\)"):
        driven(lambda k, x, v: torch.full_like(x, torch.nan) if k == 3 else 0 * x)
    assert driven(lambda k, x, v: -0.5 * v) == []


def test_sweeps_and_time_steps_are_blamed() -> None:
    model = dv.Model(dv.mesh.beam(7, 2, 2, size=(0.6, 0.1, 0.1)), relaxation=1.7)
    x, v = model.rest_points, 0 * model.rest_points
    v[:, 1] = torch.sin(9 * x[:, 0])
    said = messages(lambda: dv.rollout(model, x, v, steps=16, mu=1e8, lam=4e8, time_step=0.01, sweeps=2,
                                       integrator=dv.SDIRK2(), gravity=(0.0, 0.0, 0.0)))  # fmt: skip
    assert any("more than 1000 body sizes" in text and "sweeps: so few let vibrations grow" in text for text in said)


def test_a_flight_is_not_lost() -> None:
    model, x, v = bent()
    flight: dict[str, Any] = {"mu": 10.0, "lam": 10.0, "time_step": 0.9, "sweeps": 1}
    assert messages(lambda: dv.rollout(model, x, 0 * v + 500.0, steps=9, **flight)) == []


# --- what sweeps leave ------------------------------------------------------------------------------------------------


def swinging(sweeps: int, **options: Any) -> tuple[Tensor, list[str]]:
    mesh = dv.mesh.beam(6, 3, 3, size=(0.4, 0.05, 0.05))
    model = dv.Model(mesh, pinned=mesh.points[:, 0] < 1e-9, **options)
    x, frames = model.rest_points, []
    said = messages(lambda: frames.append(dv.rollout(model, x, 0 * x, steps=60, young=1e6, poisson=0.3,
                                                     time_step=0.005, sweeps=sweeps).x))  # fmt: skip
    return frames[0], said


def test_motion_that_sweeps_leave_wrong_is_warned_of_and_what_is_right_is_not() -> None:
    coarse: dict[str, Any] = {"coarse": "auto", "relaxation": 1.5}
    right, said = swinging(100, **coarse)
    assert said == []
    for sweeps, options, wrong in ((10, {}, True), (300, {"relaxation": 1.5}, False), (20, coarse, False)):
        motion, said = swinging(sweeps, **options)
        error = float((motion - right).norm() / (right - right[0]).norm())
        assert (error > 0.05) == wrong == any("the motion may be off by" in text for text in said)
        assert all('coarse="auto"' in text for text in said)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_what_rests_or_has_no_sweeps_to_judge_is_not_doubted(dtype: torch.dtype) -> None:
    model = dv.Model(
        dv.mesh.box(3, 0.2), dtype=dtype, energies=(dv.StableNeoHookean(), dv.FloorBarrier(-0.004, kappa=1e4))
    )
    x, v = model.rest_points, torch.zeros_like(model.rest_points)
    many: dict[str, Any] = SOFT | {"sweeps": 100}
    end = dv.rollout(model, x, v, steps=60, save="last", check_energy=False, **many)
    for frames in (10, 40):
        assert messages(lambda n=frames: dv.rollout(model, end.x[-1], end.v[-1], steps=n, **SOFT)) == []
