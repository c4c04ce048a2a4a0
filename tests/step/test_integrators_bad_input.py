"""Claim: what an integrator cannot take raises, names the argument and not what a solve was given of it, and the same
holds in a rollout."""

from typing import Any

import pytest
import torch
from helpers.bad_input import INF, NAN, raises
from torch import Tensor

import diffvbd as dv
from diffvbd import colliders

SECOND = (dv.SDIRK2(), dv.BDF2())
EVERY = (dv.ImplicitEuler(), *SECOND)
STEP: dict[str, Any] = {"mu": 1e4, "lam": 1e4, "time_step": 0.01, "sweeps": 3}
CUBE = dv.mesh.cube(2, size=0.2)


def held(**options: Any) -> tuple[dv.Model, Tensor, Tensor]:
    model = dv.Model(CUBE, pinned=[0, 1], **options)
    return model, model.rest_points, torch.zeros_like(model.rest_points)


def taken(model: dv.Model, x: Tensor, v: Tensor, way: str, **options: Any) -> Tensor:
    """The end of a step, by dv.step or by a rollout."""
    if way == "step":
        return dv.step(model, x, v, **STEP | options)[0]
    return dv.rollout(model, x, v, steps=1, **STEP | options).x[-1]


@pytest.mark.parametrize("way", ["step", "rollout"])
@pytest.mark.parametrize(
    ("name", "change", "got"),
    [
        ("history.moved", lambda h: {"moved": h.moved.float()}, "torch.float32"),
        ("history.v", lambda h: {"v": h.v.float()}, "torch.float32"),
        ("history.smooth", lambda h: {"smooth": h.smooth.double()}, "torch.float64"),
        ("history.smooth", lambda h: {"smooth": h.smooth.long()}, "torch.int64"),
        ("history.moved", lambda h: {"moved": h.moved.to("meta")}, "meta"),
        ("history.smooth", lambda h: {"smooth": h.smooth.to("meta")}, "meta"),
        ("history.moved", lambda h: {"moved": h.moved.to_sparse()}, "sparse"),
        ("history.moved", lambda h: {"moved": NAN * h.moved}, "nan"),
        ("history.v", lambda h: {"v": INF + h.v}, "inf"),
        ("history", lambda h: {"time_step": None}, "None"),
        ("history", lambda h: {"time_step": 0.0101}, "0.0101"),
    ],
)
def test_a_history_is_checked_like_a_state(way: str, name: str, change: Any, got: str) -> None:
    model, x, v = held()
    x1, v1, history = dv.step(model, x, v, integrator=dv.BDF2(), **STEP)
    wrong = history._replace(**change(history))
    raises(lambda: taken(model, x1, v1, way, integrator=dv.BDF2(), history=wrong), name, got)


def test_the_time_step_of_a_history_is_a_number() -> None:
    model, x, v = held()
    given = STEP | {"time_step": torch.tensor(0.01, dtype=torch.float64)}
    end = dv.rollout(model, x, v, steps=2, integrator=dv.BDF2(), **given)
    assert end.history is not None and type(end.history.time_step) is float


@pytest.mark.parametrize("integrator", EVERY, ids=str)
def test_colliders_that_are_not_finite_are_named(integrator: Any) -> None:
    energies = (dv.StableNeoHookean(), dv.PairBarrier(kappa=1e3, dhat=0.01))
    plane = colliders.Plane((0.0, -0.1, 0.0), (0.0, 1.0, 0.0))
    model, x, v = held(energies=energies, colliders=[plane])
    given = {"colliders": model.collider_points, "colliders_before": model.collider_points}
    for name in given:
        wrong = given | {name: NAN * model.collider_points}
        raises(lambda g=wrong: taken(model, x, v, "step", integrator=integrator, **g), name, "nan")


@pytest.mark.parametrize("way", ["step", "rollout"])
@pytest.mark.parametrize("integrator", SECOND, ids=str)
def test_a_solve_that_is_lost_is_no_wrong_argument(integrator: Any, way: str) -> None:
    model, x, v = held(dtype=torch.float32)
    raises(lambda: taken(model, 1e20 * x, v, way, integrator=integrator), "x, v", "first solve")


@pytest.mark.parametrize("given", [tuple, lambda both: lambda step, x, v: both], ids=["constant", "function"])
def test_a_rollout_takes_prescribed_positions_of_two_solves(given: Any) -> None:
    model, x, v = held()
    ends = (x.clone(), x.clone())
    ends[0][:2, 1] += 0.001
    ends[1][:2, 1] += 0.002
    wanted = taken(model, x, v, "step", integrator=dv.SDIRK2(), prescribed=ends)
    assert torch.equal(taken(model, x, v, "rollout", integrator=dv.SDIRK2(), prescribed=given(ends)), wanted)
    raises(lambda: taken(model, x, v, "rollout", prescribed=given(ends)), "prescribed", "2 with ImplicitEuler")
    for which in (0, 1):
        free = [end.clone() for end in ends]
        free[which][7] += 1
        run = lambda p=tuple(free): taken(model, x, v, "rollout", integrator=dv.SDIRK2(), prescribed=given(p))  # noqa: E731
        raises(run, "prescribed", "vertex 7")


def test_prescribed_positions_of_two_solves_are_watched() -> None:
    model, x, v = held()
    ends = (x.clone(), x.clone())
    mu = torch.tensor(1e4, dtype=x.dtype, requires_grad=True)
    end = dv.rollout(model, x, v, steps=4, checkpoint_every=2, integrator=dv.SDIRK2(), prescribed=ends,
                     **STEP | {"mu": mu})  # fmt: skip
    ends[0].add_(1)
    with pytest.raises(RuntimeError, match="prescribed: changed in place"):
        end.x.sum().backward()


@pytest.mark.parametrize("name", ["history.time_step", "history.smooth", "history.other"])
def test_a_tape_has_no_gradient_of_what_is_not_differentiable(name: str) -> None:
    model, x, v = held()
    x1, v1, history = dv.step(model, x, v, integrator=dv.BDF2(), **STEP)
    run = lambda: dv.step_forward(model, x1, v1, wrt=(name,), integrator=dv.BDF2(), history=history, **STEP)  # noqa: E731
    raises(run, "wrt", f"history.moved, history.v.*got '{name}'")
