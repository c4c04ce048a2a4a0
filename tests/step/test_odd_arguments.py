"""Claim: rare arguments that are right are taken, and wrong ones are named without sweeps and without steps, too."""

from typing import Any

import numpy as np
import pytest
import torch

import diffvbd as dv

GIVEN: dict[str, Any] = {"mu": 1e4, "lam": 1e4, "time_step": 0.01, "sweeps": 2}
CUBE = dv.mesh.cube(2, size=0.1)


@pytest.mark.parametrize("steps", (0, 2))
@pytest.mark.parametrize("gravity", ([-9.0], -9.0, [[-9.0]], [np.float32(-9)] * 3, np.full(3, -9)), ids=str)
def test_gravity_of_any_shape_that_broadcasts(gravity: Any, steps: int, device: str) -> None:
    model = dv.Model(CUBE, device=device)
    x = model.rest_points
    given = gravity if isinstance(gravity, np.ndarray) or np.shape(gravity) == (3,) else torch.tensor(gravity).to(x)
    wanted = dv.rollout(model, x, x * 0, steps=steps, gravity=(-9.0, -9.0, -9.0), **GIVEN).x
    assert torch.equal(dv.rollout(model, x, x * 0, steps=steps, gravity=given, **GIVEN).x, wanted)
    if steps:
        assert not torch.equal(wanted[-1], x)
        v = torch.zeros_like(x)
        assert torch.equal(dv.step(model, x, v, gravity=given, **GIVEN)[0], wanted[1])


@pytest.mark.parametrize("gravity", ([0.0, 1.0], torch.zeros(4), [True, False, True]), ids=("list", "tensor", "bools"))
def test_gravity_is_looked_at_without_steps_too(gravity: Any) -> None:
    model = dv.Model(CUBE)
    x = model.rest_points
    with pytest.raises((ValueError, TypeError), match="gravity: expected"):
        dv.rollout(model, x, x * 0, steps=0, gravity=gravity, **GIVEN)


@pytest.mark.parametrize("name", ("gravity", "mu"))
def test_a_function_that_returns_no_number_is_named_under_checkpoints(name: str) -> None:
    model = dv.Model(CUBE)
    x = model.rest_points.requires_grad_()
    bad = [0.0, float("nan"), 0.0] if name == "gravity" else float("nan")
    with pytest.raises(ValueError, match=f"{name}: expected .*nan.*in step 0"):
        dv.rollout(model, x, x.detach() * 0, steps=4, checkpoint_every=2, **{**GIVEN, name: lambda step, x, v: bad})


def test_values_that_are_not_finite_under_vmap() -> None:
    model = dv.Model(CUBE)
    x = model.rest_points.expand(2, -1, -1)
    with pytest.raises(ValueError, match="gravity.*expected finite values, got nan"):
        torch.func.vmap(lambda q: dv.step(model, q, q * 0, gravity=(0.0, float("nan"), 0.0), **GIVEN)[0])(x)


@pytest.mark.parametrize("sweeps", (0, 1))
@pytest.mark.parametrize("more", ((), (dv.Friction(0.3),), (dv.PairBarrier(),)), ids=("alone", "friction", "pairs"))
def test_a_start_on_the_wrong_side_of_a_floor(more: tuple, sweeps: int) -> None:
    floor = dv.FloorBarrier(normal=[[0, 1, 0], [0, 1, 0]], height=[-1.0, 0.01])
    model = dv.Model(CUBE, energies=(dv.StableNeoHookean(), floor, *more), pinned=[0])
    x = model.rest_points.expand(2, -1, -1).clone()
    x[0, :, 1] += 0.1
    said = "x: expected every unpinned vertex above floor plane 1, got 3 on or below it in scene 1: vertices "
    with pytest.raises(ValueError, match=said):
        dv.step(model, x, x * 0, **{**GIVEN, "sweeps": sweeps})


def test_a_step_on_a_floor_with_friction_that_leaves_all_bounds_raises() -> None:
    floor = dv.FloorBarrier(normal=[0.6, 0.8, 0], height=-1e-9, kappa=1e3, dhat=0.01)
    model = dv.Model(CUBE, energies=(dv.StableNeoHookean(), floor, dv.Friction(0.3)))
    x, v = model.rest_points, torch.zeros_like(model.rest_points)
    v[:, 1], v[0, 0] = -1e10, -1e10 / 3
    with pytest.raises(RuntimeError, match="positions became non-finite in the step"):
        dv.step(model, x, v, **{**GIVEN, "sweeps": 1})
