"""Claim: what cannot be the value of a step is refused in words that help. A Trajectory prints in one line."""

from collections.abc import Callable
from typing import Any

import numpy as np
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
    with pytest.raises(TypeError, match=f"{name}: expected a function that returns the value.*got None .in step 0"):
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
    with pytest.raises(ValueError, match=r"rest_points: .*at tet \d+ of scene 0 .in step 2.$"):
        dv.rollout(model, **turned, steps=STEPS, sweeps=SWEEPS)


@pytest.mark.parametrize(
    ("name", "function"), [("mu", lambda k: 1e4), ("force", lambda x, v: 0.0), ("parameters", lambda: 1e3)]
)
def test_a_function_of_other_arguments_raises(name: str, function: Callable[..., Any]) -> None:
    scene = build_scene("anchored")
    value = {"anchor.stiffness": function} if name == "parameters" else function
    with pytest.raises(TypeError, match=rf"{name}.*: expected a function of step, x, v: too many positional"):
        dv.rollout(scene.model(), **(scene.inputs() | {name: value}), steps=STEPS, sweeps=SWEEPS)


@pytest.mark.parametrize(
    ("observe", "says"),
    [
        (lambda x, v: x, "expected a function of x, v, step: too many positional"),
        (lambda step, x, v: x, "expected a function of x, v, step in this order, got step, x, v"),
        (lambda step, *rest, x=None: step, "expected a function of x, v, step in this order, got step"),
        (3, "expected a function of x, v, step, got int"),
        (lambda x, v, k: {str(k): x}, r"with the keys \['1'\] after each .* keys \['2'\] after step 2"),
        (lambda x, v, k: (x,) * (5 - k), "expected a tuple of 4 after each .* got a tuple of 3 after step 2"),
        (lambda x, v, k: (x,) * k, "expected a tuple of 1 after each .* got a tuple of 2 after step 2"),
        (lambda x, v, k: {"a": x} if k == 1 else x, r"with the keys \['a'\] after each .* got a tensor of shape"),
        (lambda x, v, k: None if k == 1 else x, "expected None after each .* got a tensor of shape"),
        (lambda x, v, k: {"a": x[:k]}, r"a tensor of shape \[1, .* after each .* \[2, .* after step 2"),
    ],
)
def test_what_observe_returns_is_alike_after_each_step(observe: Any, says: str) -> None:
    scene = build_scene("anchored")
    with pytest.raises((TypeError, ValueError), match=f"observe: .*{says}"):
        dv.rollout(scene.model(), **scene.inputs(), steps=3, sweeps=1, observe=observe)


def test_save_takes_words_and_integers() -> None:
    scene = build_scene("anchored")
    given = {**scene.inputs(), "steps": 5, "sweeps": 1}
    assert dv.rollout(scene.model(), **given, save=np.int64(2)).steps == [0, 2, 4, 5]
    for bad in (np.arange(2), torch.arange(2), 2.0, True, 0, "some"):
        with pytest.raises(ValueError, match='save: expected "all", "last" or an integer > 0, got'):
            dv.rollout(scene.model(), **given, save=bad)
    with pytest.raises(TypeError, match="checkpoint_every: expected an integer, got ndarray"):
        dv.rollout(scene.model(), **given, checkpoint_every=np.arange(2))  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("name", ["force", "prescribed"])
def test_a_function_that_returns_no_finite_number_is_named(name: str) -> None:
    model = dv.Model(dv.mesh.cube(), pinned=[0])
    x, given = model.rest_points, {"mu": 1e4, "lam": 1e4, "time_step": 0.01, name: lambda k, x, v: float("inf")}
    with pytest.raises(ValueError, match=f"^{name}: expected finite values, got inf"):
        dv.rollout(model, x, 0 * x, **given, steps=STEPS, sweeps=SWEEPS)
    with pytest.raises(ValueError, match=f"^{name}: expected finite values, got inf"):
        dv.solve(model, x, 0 * x, **(given | {name: float("inf")}))
