"""Settings given to a rollout run what the same arguments run."""

import pytest
import torch

import diffvbd as dv
from diffvbd import mesh

MATERIAL = {"mu": 1e5, "lam": 1e5}


@pytest.fixture(scope="module")
def beam() -> tuple[dv.Model, torch.Tensor, torch.Tensor]:
    body = mesh.beam(5, 2, 2, size=(0.4, 0.1, 0.1))
    model = dv.Model(body, pinned=torch.tensor(body.points[:, 0] < 1e-9))
    return model, model.rest_points, torch.zeros_like(model.rest_points)


# TODO62: dtype=torch.float32 of Settings is gone
@pytest.mark.parametrize(
    ("given", "error", "text"),
    [
        ({"settings": dv.VBD(0.01, 5), "steps": 2, "sweeps": 3}, TypeError, "sweeps: expected None beside"),
        ({"settings": dv.VBD(0.01, 5), "steps": 2, "integrator": dv.SDIRK2()}, TypeError, "integrator: expected"),
        ({"settings": dv.VBD(0.01, 5)}, TypeError, "duration: expected either duration or steps"),
        ({"settings": dv.VBD(0.01, 5), "steps": 2, "duration": 1.0}, TypeError, "duration: expected either"),
        ({"settings": dv.VBD(0.01, 5), "duration": -1.0}, ValueError, "duration: expected"),
        ({"settings": "best", "steps": 2}, TypeError, "settings: expected diffvbd.Settings"),
        ({"settings": "auto", "steps": 2}, TypeError, "duration: expected it beside"),
        ({"settings": dv.VBD(0.01, 5), "steps": 2}, ValueError, "settings: expected those"),
        ({"duration": 1.0, "time_step": 0.01, "sweeps": 3}, TypeError, "duration: expected it beside settings"),
        ({"steps": 2, "sweeps": 3}, TypeError, "time_step: expected a number"),
        ({"steps": 2, "time_step": 0.01}, TypeError, "sweeps: expected a number"),
        ({"time_step": 0.01, "sweeps": 3}, TypeError, "steps: expected"),
    ],
)
def test_what_does_not_go_together_raises(beam, given, error, text) -> None:
    model, x, v = beam
    with pytest.raises(error, match=text):
        # TODO62: the solver of this call
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
        ({"acceleration": 5}, TypeError, "acceleration: expected a diffvbd.Anderson"),
        ({"dtype": "float64"}, ValueError, "dtype: expected torch.float64"),
        ({"checkpoint_every": 0}, ValueError, "checkpoint_every: expected an integer >= 1"),
        ({"checkpoint_every": "all"}, ValueError, 'checkpoint_every: expected "auto"'),
        ({"predicted": 3}, TypeError, "predicted: expected a diffvbd.Prediction"),
    ],
)
def test_settings_are_checked_where_they_are_made(given, error, text) -> None:
    with pytest.raises(error, match=text):
        dv.VBD(**{"time_step": 0.01, "sweeps": 5} | given)


@pytest.mark.parametrize("duration", [0.0, -1.0, float("nan"), float("inf"), "1", None])
def test_steps_of_what_is_no_duration_raise(duration) -> None:
    with pytest.raises((ValueError, TypeError), match="duration: expected"):
        dv.VBD(0.01, 5).steps(duration)


def test_steps_over_a_duration() -> None:
    assert dv.VBD(0.01, 5).on(4, 0.1).time_step == 0.1 / 4
    for steps, duration, said in ((0, 0.1, "steps: expected an integer >= 1"), (4, 0.0, "duration: expected")):
        with pytest.raises(ValueError, match=said):
            dv.VBD(0.01, 5).on(steps, duration)
