"""Claim: under checkpoints no function of a rollout gives a wrong gradient because it returns something else when the
backward calls it again: the CPU raises, and a GPU returns NaN."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import diffvbd as dv

MESH = dv.mesh.beam(3, 2, 2, size=(0.3, 0.1, 0.1))
SCHEDULES = (None, 3, dv.BinomialCheckpoints(2))


def end(model: dv.Model, force: Callable[[int, Tensor, Tensor], Any], schedule: Any) -> Tensor:
    x = model.rest_points
    motion = dv.rollout(model, x, torch.zeros_like(x), steps=7, mu=1e5, lam=1e5, time_step=0.01, sweeps=3, force=force,
                        checkpoint_every=schedule, save="last")  # fmt: skip
    return motion.x[-1, :, 1].sum()


def beam(device: str) -> dv.Model:
    return dv.Model(MESH, pinned=MESH.points[:, 0] == 0, device=device)


def assert_refused(loss: Tensor, weight: Tensor) -> None:
    if weight.is_cuda:
        assert torch.autograd.grad(loss, weight)[0].isnan().all()
    else:
        with pytest.raises(RuntimeError, match="force: expected the same value for step"):
            torch.autograd.grad(loss, weight)


def test_weights_that_change_in_place(device: str) -> None:
    model = beam(device)
    p = model.rest_points.new_tensor(0.3).requires_grad_()
    loss = end(model, lambda k, x, v: -10.0 * p * v, 3)
    with torch.no_grad():
        p.mul_(2)
    assert_refused(loss, p)


@pytest.mark.parametrize("schedule", SCHEDULES[1:], ids=str)
@pytest.mark.parametrize("kind", ["integral", "noise"])
def test_state_of_its_own(kind: str, schedule: Any, device: str) -> None:
    model, rng = beam(device), np.random.default_rng(0)
    p, rest = model.rest_points.new_tensor(5.0).requires_grad_(), model.rest_points
    kept = torch.zeros_like(rest)

    def force(k: int, x: Tensor, v: Tensor) -> Tensor:
        nonlocal kept
        kept = kept + 0.01 * (rest - x.detach()) if kind == "integral" else rest.new_tensor(rng.normal(size=x.shape))
        return p * kept

    assert torch.autograd.grad(end(model, force, None), p)[0].abs() > 0  # called once
    assert_refused(end(model, force, schedule), p)


@pytest.mark.parametrize("schedule", SCHEDULES, ids=str)
def test_what_repeats_itself_passes(schedule: Any, device: str) -> None:
    """Dropout, whose random numbers torch keeps; None; infinite values are named as ever."""
    model = beam(device)
    p = model.rest_points.new_tensor(5.0).requires_grad_()

    def gradient(schedule: Any) -> Tensor:
        torch.manual_seed(0)
        force = lambda k, x, v: None if k == 2 else torch.nn.functional.dropout(p * v + 1.0, 0.5)  # noqa: E731
        return torch.autograd.grad(end(model, force, schedule), p)[0]

    assert gradient(None).abs() > 0 and torch.equal(gradient(schedule), gradient(None))
    if device == "cpu":
        with pytest.raises(ValueError, match="force: expected finite values"):
            end(model, lambda k, x, v: p * torch.full_like(x, torch.inf), schedule)
