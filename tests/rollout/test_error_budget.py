"""The budget of an error names the cause that is largest."""

import pytest
import torch
from helpers.tilted_box import SOFT, tilted_box

import diffvbd as dv
from diffvbd import mesh, results
from diffvbd.rollout import tune
from diffvbd.testing.tolerances import tolerance


def cantilever(dtype: torch.dtype = torch.float64) -> tuple[dv.Model, torch.Tensor, torch.Tensor]:
    body = mesh.beam(7, 2, 2, size=(0.6, 0.1, 0.1))
    model = dv.Model(body, pinned=torch.tensor(body.points[:, 0] < 1e-9), dtype=dtype)
    return model, model.rest_points, torch.zeros_like(model.rest_points)


def shares(budget: results.ErrorBudget) -> dict[str, results.Share]:
    return {share.cause: share for share in budget.shares}


SCENE = {"duration": 0.2, "mu": 2e5, "lam": 2e5}


def test_few_sweeps_are_the_cause() -> None:
    model, x, v = cantilever()
    budget = dv.error_budget(model, x, v, dv.VBD(1 / 200, 3), **SCENE)
    assert budget.largest.cause == "sweeps"
    true = dv.rollout(model, x, v, dv.VBD(1 / 200, 1000), steps=40, mu=2e5, lam=2e5, save=10)
    own = dv.rollout(model, x, v, dv.VBD(1 / 200, 3), steps=40, mu=2e5, lam=2e5, save=10)
    expected = (own.x - true.x).square().sum(-1)[1:].mean().sqrt() / (true.x - x).square().sum(-1)[1:].mean().sqrt()
    assert budget.largest.motion == pytest.approx(float(expected), rel=tolerance("cause_of_error"))
    assert budget.truncated is None and budget.friction is None and budget.duration == pytest.approx(0.2)


def test_converged_steps_on_a_floor_are_held_against_converged_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    """Corrections may leave such steps far from converged however many sweeps they have: no reference, then."""
    scene = {"duration": 0.016, **SOFT}
    budget = dv.error_budget(*tilted_box(), dv.VBD(2e-3, 50), **scene)
    assert shares(budget)["sweeps"].motion < tolerance("closed_form") and budget.reached
    monkeypatch.setattr(tune, "MOST_SWEEPS", 1)
    none = dv.error_budget(*tilted_box(), dv.VBD(2e-3, 0), **scene | {"young": 1e9})
    assert not none.reached and "no reference could be reached: " in str(none)
    assert "of its forces unbalanced" in shares(none)["sweeps"].note


@pytest.mark.slow
def test_long_steps_are_the_cause() -> None:
    model, x, v = cantilever()
    budget = dv.error_budget(model, x, v, dv.VBD(1 / 100, 400), quantity=lambda x, v: x[-1, 1], **SCENE)
    found = shares(budget)
    assert budget.largest.cause == "time step" and 10 * found["sweeps"].motion < found["time step"].motion
    assert found["time step"].quantity is not None and found["time step"].gradient is None
    assert budget.total == pytest.approx(found["time step"].motion, rel=tolerance("one_cause_of_error"))
    better = dv.error_budget(model, x, v, dv.VBD(1 / 100, 400, integrator=dv.SDIRK2()), **SCENE)
    assert 5 * shares(better)["time step"].motion < found["time step"].motion


def test_precision_mesh_and_gradients() -> None:
    model, x, v = cantilever(torch.float32)
    budget = dv.error_budget(model, x, v, dv.VBD(1 / 100, 20), fraction=0.5, mesh=True, gradient=True, **SCENE)
    found = shares(budget)
    assert set(found) == {"sweeps", "time step", "precision", "mesh", "all but mesh"}
    assert 0 < found["precision"].motion < tolerance("precision_of_error")
    assert found["mesh"].motion > 0.01  # a beam of one cell is too stiff
    assert all(found[cause].gradient > 0 for cause in ("sweeps", "time step", "precision"))
    assert budget.duration == pytest.approx(0.08)
    assert [s.motion for s in budget.shares[:-1]] == sorted((s.motion for s in budget.shares[:-1]), reverse=True)
    assert all(cause in str(budget) for cause in found)


def test_contact_and_friction() -> None:
    one = mesh.box(2, 0.1)
    body = mesh.join([one, one.translate((0.013, 0.102, 0.011))])
    energies = (dv.StableNeoHookean(), dv.PairBarrier(kappa=1e3, dhat=2e-3), dv.Friction(0.4),
                dv.FloorBarrier(-0.002, kappa=1e3, dhat=2e-3))  # fmt: skip
    model = dv.Model(body, energies=energies)
    v = torch.zeros_like(model.rest_points)
    v[8:, 0] = 0.5
    budget = dv.error_budget(model, model.rest_points, v, dv.VBD(1 / 100, 5), duration=0.08, mu=1e5, lam=1e5)
    assert {"sweeps", "time step", "contact", "all but mesh"} == set(shares(budget))
    assert budget.truncated is not None and 0 <= budget.truncated <= 1
    assert budget.friction is not None and budget.friction >= 0
    assert "of the friction" in str(budget) and "truncated" in str(budget)
    assert 0 < budget.total < 1


@pytest.mark.parametrize(
    ("given", "error", "text"),
    [
        ({"fraction": 0.0}, ValueError, "fraction: expected"),
        ({"fraction": 1.5}, ValueError, "fraction: expected"),
        ({"solver": dv.VBD(1.0, 3)}, ValueError, "solver: expected a time step of at most the duration"),
        ({"solver": None}, TypeError, "solver: expected"),
        ({"quantity": 3}, TypeError, "quantity: expected a function of x and v, got int"),
        ({"gradient": 1}, TypeError, "gradient: expected a bool, got int"),
        ({"mesh": "yes"}, TypeError, "mesh: expected a bool, got str"),
        ({"steps": 3}, TypeError, "steps: expected an input of this Model"),
        ({"mesh": True, "force": torch.zeros(28, 3, dtype=torch.float64)}, ValueError, "force: expected None with"),
    ],
)
def test_bad_input(given, error, text) -> None:
    model, x, v = cantilever()
    with pytest.raises(error, match=text):
        dv.error_budget(model, x, v, **{"solver": dv.VBD(0.05, 3), **SCENE} | given)
