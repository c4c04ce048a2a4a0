"""Claim: a rollout, or a step of a loop, that ends with what is no number or too far away says so, each time, and what is
at fault; and one whose sweeps leave its motion wrong does."""

import warnings
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

import diffvbd as dv
from diffvbd.rollout import end_check
from diffvbd.step.lost import FAR
from diffvbd.step.unsolved import unsolved

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


def test_the_next_rollout_says_it_where_the_device_was_not_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """As on CUDA: a copy that is not there yet is asked for again later, whatever ends meanwhile."""
    model, x, v = bent()
    monkeypatch.setattr(end_check, "may_copy", lambda x: True)
    ready = SimpleNamespace(query=lambda: there)
    model._derived[end_check.ENDED] = [(torch.tensor([good, True]), ready) for good in (True, False, True)]
    there = False
    assert messages(lambda: dv.rollout(model, x, v, steps=1, **SOFT)) == []
    there = True
    with pytest.warns(UserWarning, match="a rollout of this Model before this one ended") as found:
        dv.rollout(model, x, v, steps=1, **SOFT)
    assert found[0].filename == __file__
    assert messages(lambda: dv.rollout(model, x, v, steps=1, **SOFT)) == []


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
