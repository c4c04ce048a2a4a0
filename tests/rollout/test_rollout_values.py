"""Claim: what cannot be the value of a step is refused in words that help. A Trajectory prints in one line."""

import pytest
import torch

import diffvbd as dv
from diffvbd.testing import build_scene

STEPS, SWEEPS = 6, 3


@pytest.mark.parametrize("name", ["mu", "force", "prescribed"])
def test_values_of_all_steps_without_per_step_say_what_takes_them(name: str) -> None:
    scene = build_scene("anchored")
    model, inputs = scene.model(), scene.inputs()
    whole = inputs[name].expand(*inputs["x"].shape[:-2], *inputs[name].shape[-1 if name == "mu" else -2 :])
    with pytest.raises(ValueError, match=rf"{name}: .*in a rollout, per_step\({name}\) takes one for each step"):
        dv.rollout(model, **(inputs | {name: torch.stack([whole] * STEPS)}), steps=STEPS, sweeps=SWEEPS)


@pytest.mark.parametrize("name", ["mu", "gravity", "prescribed", "rest_points"])
def test_a_function_that_returns_nothing_raises(name: str) -> None:
    """A forgotten return would otherwise be a grip that stays. Of forces, None says that a step has none."""
    scene = build_scene("anchored")
    model, inputs = scene.model(), scene.inputs()
    with pytest.raises(TypeError, match=f"{name}: expected a function that returns the value.*got None at step 0"):
        dv.rollout(model, **(inputs | {name: lambda k, x, v: None}), steps=STEPS, sweeps=SWEEPS)


def test_a_trajectory_prints_in_one_line() -> None:
    scene = build_scene("anchored")
    found = dv.rollout(scene.model(), **scene.inputs(), steps=4, sweeps=1, save=2)
    expected = f"Trajectory(3 frames of steps 0 to 4, x and v of shape {list(found.x.shape)})"
    assert repr(found) == expected


def test_a_force_of_none_is_no_force() -> None:
    scene = build_scene("anchored")
    model, inputs = scene.model(), {k: value for k, value in scene.inputs().items() if k != "force"}
    without = dv.rollout(model, **inputs, steps=STEPS, sweeps=SWEEPS)
    none = dv.rollout(model, **inputs, force=lambda k, x, v: None, steps=STEPS, sweeps=SWEEPS)
    assert torch.equal(none.x, without.x)


def test_an_error_of_a_step_says_which_step_it_was() -> None:
    """A muscle that turns a body inside out does so at some moment."""
    scene = build_scene("anchored")
    model, inputs = scene.model(), scene.inputs()
    rest = inputs["rest_points"] if inputs.get("rest_points") is not None else model.rest_points
    turned = inputs | {"rest_points": lambda k, x, v: rest if k < 2 else -rest}
    with pytest.raises(ValueError, match=r"rest_points: .*at tet \d+ of scene 0, in step 2$"):
        dv.rollout(model, **turned, steps=STEPS, sweeps=SWEEPS)
