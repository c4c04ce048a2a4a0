"""Claim: a rollout that gains energy from nowhere says so, each time."""

import warnings
from typing import Any

import pytest
import torch
from torch import Tensor

import diffvbd as dv
from diffvbd import reference
from diffvbd.rollout import energy_check
from diffvbd.step.arguments import prepare
from diffvbd.testing import tolerance

STIFF: dict[str, Any] = {"mu": 1e9, "lam": 1e9, "time_step": 0.01, "sweeps": 2}
SOFT: dict[str, Any] = {"mu": 1e4, "lam": 1e4, "time_step": 0.01, "sweeps": 10}


def bent(**options: Any) -> tuple[dv.Model, Tensor, Tensor]:
    """A bar whose velocities bend it."""
    mesh = dv.mesh.box((5, 2, 2), (0.4, 0.1, 0.1))
    model = dv.Model(mesh, **options)
    x = model.rest_points
    v = torch.zeros_like(x)
    v[:, 1] = 20 * x[:, 0].square()
    return model, x, v


def messages(run: Any, of: str = "gained") -> list[str]:
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        run()
    return [str(w.message) for w in found if of in str(w.message)]


# --- energy -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("chunk", [3, energy_check.LEAST_CHUNK])  # tets that are looked at together
def test_energy_is_that_of_the_reference(monkeypatch: pytest.MonkeyPatch, chunk: int) -> None:
    monkeypatch.setattr(energy_check, "LEAST_CHUNK", chunk)
    model, x, v = bent()
    x = x + 0.01 * torch.randn(x.shape, generator=torch.Generator().manual_seed(0), dtype=x.dtype)
    mu, lam = (torch.linspace(1e4, k, model.num_tets, dtype=x.dtype) for k in (2e4, 5e4))
    given = {"mu": mu, "lam": lam, "time_step": 1.0, "sweeps": 1, "rest_points": None, "density": None}
    prepared = prepare(model, (), **given, parameters=None)
    expected = reference.incremental_potential(model, x, x, mu, lam, 1.0)
    expected = expected + 0.5 * (model.mass[:, None] * v.square()).sum()
    found = energy_check.mechanical_energy(model, prepared, x, v)
    assert found.shape == (1,) and expected > 0
    assert abs(found - expected) <= tolerance("energy_gain") * expected
    many = energy_check.mechanical_energy(model, prepared, x.expand(3, -1, -1), v.expand(3, -1, -1))
    assert torch.allclose(many, found, rtol=tolerance("energy_gain"))


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_energy_from_nowhere_is_warned_of_each_time(dtype: torch.dtype) -> None:
    model, x, v = bent(dtype=dtype)
    with pytest.warns(UserWarning, match=r'has gained .* coarse="auto"') as found:
        dv.rollout(model, x, v, steps=10, **STIFF)
    assert {w.filename for w in found} == {__file__}
    for asked in (None, True):
        assert len(messages(lambda asked=asked: dv.rollout(model, x, v, steps=10, check_energy=asked, **STIFF))) == 1


def test_what_helps_helps() -> None:
    model, x, v = bent(coarse="auto", relaxation=1.5)
    assert messages(lambda: dv.rollout(model, x, v, steps=10, check_energy=True, **STIFF | {"sweeps": 100})) == []


def test_nothing_is_said_of_a_scene_that_gains_none_or_is_driven() -> None:
    model, x, v = bent()
    assert messages(lambda: dv.rollout(model, x, v, steps=20, check_energy=True, **SOFT)) == []
    kinds: list[dict[str, Any]] = [{"force": 0 * x}, {"gravity": lambda k, x, v: 0 * x}, {"check_energy": False}]
    for driven in kinds:
        assert messages(lambda d=driven: dv.rollout(model, x, v, steps=20, **STIFF, **d)) == []
    assert messages(lambda: dv.rollout(model, x, v, steps=9, **STIFF)) == []  # too short to be looked at unasked


def test_rest_and_fall_are_no_gain_in_single_precision_or_far_away() -> None:
    for dtype, distance in ((torch.float32, 1.0), (torch.float32, 1e3), (torch.float64, 1e5)):
        model, x, v = bent(dtype=dtype)
        given = {**SOFT, "mu": 1e7, "lam": 1e7}
        end = lambda m=model, x=x + distance, v=0 * v, g=given: dv.rollout(m, x, v, steps=10, check_energy=True, **g)  # noqa: E731
        assert messages(end) == []


@pytest.mark.parametrize("schedule", [None, 3, dv.BinomialCheckpoints(2)])
def test_gradients_are_those_without_a_look(schedule: Any) -> None:
    model, x, v = bent()
    gradients = []
    for asked in (True, False):
        leaf = v.clone().requires_grad_()
        end = dv.rollout(model, x, leaf, steps=10, checkpoint_every=schedule, check_energy=asked, save="last", **SOFT)
        gradients.append(torch.autograd.grad(end.x.square().sum(), leaf)[0])
    assert torch.equal(*gradients) and gradients[0].abs().max() > 0


def test_a_wrong_argument_is_named() -> None:
    model, x, v = bent()
    with pytest.raises(TypeError, match="check_energy: expected a bool or None, got int"):
        dv.rollout(model, x, v, steps=1, check_energy=1, **SOFT)  # pyright: ignore[reportArgumentType]
