"""Settings given to a rollout run what the same arguments run."""

import pytest
import torch

import diffvbd as dv
from diffvbd import mesh

DURATION = 0.05
MATERIAL = {"mu": 1e5, "lam": 1e5}


@pytest.fixture(scope="module")
def beam() -> tuple[dv.Model, torch.Tensor, torch.Tensor]:
    body = mesh.beam(5, 2, 2, size=(0.4, 0.1, 0.1))
    model = dv.Model(body, pinned=torch.tensor(body.points[:, 0] < 1e-9))
    return model, model.rest_points, torch.zeros_like(model.rest_points)


def test_they_stand_for_the_arguments_that_they_name(beam) -> None:
    model, x, v = beam
    settings = dv.Settings(0.011, 4, dv.SDIRK2(), relaxation=1.5, coarse="auto")
    mu = torch.tensor(1e5, dtype=torch.float64, requires_grad=True)
    end = dv.rollout(model, x, v, duration=DURATION, settings=settings, mu=mu, lam=1e5, save="last")
    own = dv.Model(model.mesh, pinned=model.pinned, relaxation=1.5, coarse="auto")
    same = dv.rollout(own, x, v, steps=5, time_step=DURATION / 5, sweeps=4, integrator=dv.SDIRK2(), mu=mu, lam=1e5,
                      save="last")  # fmt: skip
    assert end.steps == [5]
    assert torch.equal(end.x, same.x)
    one, two = (torch.autograd.grad(run.x.square().sum(), mu)[0] for run in (end, same))
    assert one == two != 0


def test_steps_in_place_of_a_duration(beam) -> None:
    model, x, v = beam
    end = dv.rollout(model, x, v, steps=3, settings=dv.Settings(0.01, 5), **MATERIAL)
    same = dv.rollout(model, x, v, steps=3, time_step=0.01, sweeps=5, **MATERIAL)
    assert torch.equal(end.x, same.x)


def test_a_model_that_fits_is_taken_as_it_is(beam) -> None:
    model = beam[0]
    assert dv.Settings(0.01, 5).applied(model) is model
    other = dv.Settings(0.01, 5, relaxation=1.5, block="paper").applied(model)
    assert other is dv.Settings(0.02, 9, relaxation=1.5, block="paper").applied(model)
    assert other.relaxation == 1.5 and other.energies[0].block == "paper" and other.corrects == model.corrects


def test_refine_refines_a_rollout_with_settings(beam) -> None:
    model, x, v = beam
    settings = dv.Settings(0.01, 5)

    def loss() -> torch.Tensor:
        return dv.rollout(model, x, v, duration=DURATION, settings=settings, **MATERIAL).x[-1].square().sum()

    found = dv.refine(loss)
    plain = dv.rollout(model, x, v, steps=10, time_step=0.005, sweeps=10, **MATERIAL).x[-1].square().sum()
    assert found.both == float(plain)


def test_replaced_models_keep_what_was_not_replaced() -> None:
    body = mesh.box(2, 0.1)
    density = torch.linspace(500.0, 900.0, body.num_tets, dtype=torch.float64)
    floor = dv.FloorBarrier(height=-0.2, kappa=torch.tensor(3e3, dtype=torch.float64))
    model = dv.Model(body, density=density, pinned=[1], energies=(dv.StableNeoHookean(), floor), regularization=1e-3)
    other = model.replace(relaxation=1.3)
    assert torch.equal(other.density, density) and torch.equal(other.mass, model.mass)
    assert torch.equal(other.pinned, model.pinned) and other.regularization == model.regularization
    assert other.relaxation == 1.3 and model.relaxation == 1.0
    x = model.rest_points + 0.01
    now = {"time_step": 0.01, "sweeps": 3, **MATERIAL}
    assert torch.equal(dv.step(model, x, x, **now)[0], dv.step(other.replace(relaxation=1.0), x, x, **now)[0])
    touching = model.replace(energies=(*model.energies, dv.PairBarrier()))
    assert touching.contact is not None and not touching.rigid
    with pytest.raises(TypeError, match=r"replace: expected arguments of Model .*, got mesh"):
        model.replace(mesh=body)


@pytest.mark.parametrize(
    ("given", "error", "text"),
    [
        ({"settings": dv.Settings(0.01, 5), "steps": 2, "sweeps": 3}, TypeError, "sweeps: expected None beside"),
        ({"settings": dv.Settings(0.01, 5), "steps": 2, "integrator": dv.SDIRK2()}, TypeError, "integrator: expected"),
        ({"settings": dv.Settings(0.01, 5)}, TypeError, "duration: expected either duration or steps"),
        ({"settings": dv.Settings(0.01, 5), "steps": 2, "duration": 1.0}, TypeError, "duration: expected either"),
        ({"settings": dv.Settings(0.01, 5), "duration": -1.0}, ValueError, "duration: expected"),
        ({"settings": "best", "steps": 2}, TypeError, "settings: expected diffvbd.Settings"),
        ({"settings": "auto", "steps": 2}, TypeError, "duration: expected it beside"),
        ({"settings": dv.Settings(0.01, 5, dtype=torch.float32), "steps": 2}, ValueError, "settings: expected those"),
        ({"duration": 1.0, "time_step": 0.01, "sweeps": 3}, TypeError, "duration: expected it beside settings"),
        ({"steps": 2, "sweeps": 3}, TypeError, "time_step: expected a number"),
        ({"steps": 2, "time_step": 0.01}, TypeError, "sweeps: expected a number"),
        ({"time_step": 0.01, "sweeps": 3}, TypeError, "steps: expected"),
    ],
)
def test_what_does_not_go_together_raises(beam, given, error, text) -> None:
    model, x, v = beam
    with pytest.raises(error, match=text):
        dv.rollout(model, x, v, **MATERIAL, **given)


@pytest.mark.parametrize(
    ("given", "error", "text"),
    [
        ({"time_step": 0.0}, ValueError, "time_step: expected"),
        ({"sweeps": -1}, ValueError, "sweeps: expected"),
        ({"integrator": dv.SDIRK2}, ValueError, "integrator: expected an object"),
        ({"tape": "some"}, ValueError, "tape: expected"),
        ({"block": "other"}, ValueError, "block: expected"),
        ({"relaxation": 2.0}, ValueError, "relaxation: expected a number in"),
        ({"relaxation": None}, TypeError, "relaxation: expected a number, got NoneType"),
        ({"coarse": "yes"}, TypeError, "coarse: expected a diffvbd.CoarseSpace"),
        ({"dtype": "float64"}, ValueError, "dtype: expected torch.float64"),
        ({"checkpoint_every": 0}, ValueError, "checkpoint_every: expected an integer >= 1"),
        ({"checkpoint_every": "all"}, ValueError, 'checkpoint_every: expected "auto"'),
        ({"predicted": 3}, TypeError, "predicted: expected a diffvbd.Prediction"),
    ],
)
def test_settings_are_checked_where_they_are_made(given, error, text) -> None:
    with pytest.raises(error, match=text):
        dv.Settings(**{"time_step": 0.01, "sweeps": 5} | given)


@pytest.mark.parametrize("duration", [0.0, -1.0, float("nan"), float("inf"), "1", None])
def test_steps_of_what_is_no_duration_raise(duration) -> None:
    with pytest.raises((ValueError, TypeError), match="duration: expected"):
        dv.Settings(0.01, 5).steps(duration)


def test_settings_are_applied_to_a_model_only() -> None:
    with pytest.raises(TypeError, match="model: expected a diffvbd.Model, got int"):
        dv.Settings(0.01, 5).applied(3)


def test_a_model_knows_what_contact_did_in_its_rollouts_with_settings() -> None:
    """Another Model takes their steps where settings change it; its status and its room are those of the caller's."""
    body = mesh.box(2, 0.1)
    energies = (dv.StableNeoHookean(), dv.PairBarrier(kappa=1e3, dhat=0.01))
    model = dv.Model(body, energies=energies, colliders=[dv.colliders.Plane((0.0, -0.005, 0.0), (0.0, 1.0, 0.0))])
    x, settings = model.rest_points, dv.Settings(1e-3, 2, relaxation=1.3)
    dv.contact.reserve(model, 1000)
    dv.rollout(model, x, 0 * x, steps=1, settings=settings, **MATERIAL)
    assert dv.contact.status(model).pairs > 0
    other = settings.applied(model)
    assert other is not model and other.surface_of_contact.capacity == 1000
    dv.contact.reserve(model, 2000)
    assert settings.applied(model) is other and other.surface_of_contact.capacity == 2000


def test_steps_over_a_duration() -> None:
    assert dv.Settings(0.01, 5).on(4, 0.1).time_step == 0.1 / 4
    for steps, duration, said in ((0, 0.1, "steps: expected an integer >= 1"), (4, 0.0, "duration: expected")):
        with pytest.raises(ValueError, match=said):
            dv.Settings(0.01, 5).on(steps, duration)
