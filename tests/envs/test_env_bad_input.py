"""Claim: bad input raises an error that names the argument, what was expected and what came."""

from typing import Any

import numpy as np
import pytest
import torch
from helpers.environments import KINDS

import diffvbd as dv

Crawler = KINDS[1]
CONSTRUCTOR = [
    ({"num_envs": 0}, "num_envs: expected an integer >= 1, got 0"),
    ({"num_envs": 2.5}, "num_envs: expected an integer, got float"),
    ({"differentiable": 1}, "differentiable: expected a bool, got int"),
    ({"young": 3e4}, "young: expected two numbers, the least and the largest, got 30000.0"),
    ({"young": (0.0, 1e4)}, "young: expected a finite number > 0, got 0"),
    ({"friction": (0.9, 0.1)}, "friction: expected the least before the largest, got 0.9, 0.1"),
    ({"episode_steps": 0}, "episode_steps: expected an integer >= 1, got 0"),
    ({"dtype": torch.float16}, "dtype: expected torch.float64 or torch.float32, got torch.float16"),
]
ACTIONS = [
    (torch.zeros(2, 3, dtype=torch.float64), r"actions: expected shape \[2, 4\], got \[2, 3\]"),
    (np.zeros((3, 4)), r"actions: expected shape \[2, 4\], got \[3, 4\]"),
    (torch.zeros(2, 4), "actions: expected dtype torch.float64"),
    ([[0.0] * 4] * 2, "actions: expected a tensor or an array, got list"),
    (torch.full((2, 4), torch.nan, dtype=torch.float64), "actions: expected numbers, got nan at action 0 of scene 0"),
    (np.full((2, 4), 1j), "actions: expected an array of numbers of real numbers, got dtype torch.complex128"),
]
OPTIONS = [
    ({"mask": torch.ones(3, dtype=torch.bool)}, r"options: expected a bool mask of shape \[2\], got torch.bool of "),
    ({"mask": torch.ones(2)}, r"options: expected a bool mask of shape \[2\], got torch.float32 of shape \[2\]"),
    ({"maks": None}, "options: expected mask alone, got 'maks'"),
    ({"mask": [True, False], "reset_mask": [True, True]}, "options: expected mask alone, got 'mask', 'reset_mask'"),
    ("mask", "options: expected a dict, got str"),
]


@pytest.mark.parametrize(("given", "message"), CONSTRUCTOR)
def test_of_the_constructor(given: dict[str, Any], message: str) -> None:
    with pytest.raises((ValueError, TypeError), match=message):
        Crawler(**{"num_envs": 2, **given})


@pytest.fixture(scope="module")
def env() -> Any:
    return Crawler(2, sweeps=1)


@pytest.mark.parametrize(("actions", "message"), ACTIONS)
def test_of_a_step(env: Any, actions: Any, message: str) -> None:
    with pytest.raises((ValueError, TypeError), match=message):
        env.step(actions)


@pytest.mark.parametrize(("options", "message"), OPTIONS)
def test_of_a_reset(env: Any, options: Any, message: str) -> None:
    with pytest.raises((ValueError, TypeError), match=message):
        env.reset(options=options)


def test_a_refused_reset_draws_nothing(env: Any) -> None:
    before = env._generator.get_state()
    with pytest.raises(ValueError, match="options: expected mask alone"):
        env.reset(seed=9, options={"maks": None})
    assert torch.equal(env._generator.get_state(), before)


@pytest.mark.parametrize(("name", "wrong", "message"), [
    ("reward", lambda self, *_: torch.zeros(2, 1, dtype=torch.float64), r"reward: expected 2 scenes in 1 dimension, "),
    ("reward", lambda self, *_: torch.zeros(2), "reward: expected torch.float64, got torch.float32"),
    ("observe", lambda self, *_: torch.zeros(2, dtype=torch.float64), "observe: expected 2 scenes in 2 dimensions, "),
    ("failed", lambda self, *_: torch.zeros(2), r"failed: expected bool of shape \[2\], got torch.float32"),
])  # fmt: skip
def test_of_a_subclass(name: str, wrong: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        type("Wrong", (Crawler,), {name: wrong})(2, sweeps=1)


def test_rigid_bodies_need_no_law_and_no_friction() -> None:
    class Pushed(dv.envs.Environment):
        actions = 1

        def build(self, dtype: Any, device: Any) -> dv.Model:
            cube = dv.mesh.cube(3, size=0.1).translate((0.0, 0.004, 0.0))
            return dv.Model(cube, energies=(dv.FloorBarrier(),), rigid=[0], dtype=dtype, device=device)

        def start(self, draws: Any) -> Any:
            return {}

        def act(self, state: Any, action: Any) -> Any:
            along = torch.tensor([1.0, 0.0, 0.0], dtype=action.dtype, device=action.device)
            return {"force": self.model.wrench(state["x"], 0, force=action * along)}, {}

        def observe(self, state: Any) -> Any:
            return state["x"].mean(1)

        def reward(self, before: Any, after: Any, action: Any) -> Any:
            return after["v"][..., 0].mean(1)

    env = Pushed(2, differentiable=True)
    action = torch.tensor([[0.5], [-0.2]], dtype=torch.float64, requires_grad=True)
    _, reward, *_ = env.step(action)
    assert reward[0] > 0 > reward[1] and torch.autograd.grad(reward.sum(), action)[0].min() > 0


def test_a_seed_that_is_none() -> None:
    with pytest.raises(ValueError, match="seed: expected an integer >= 0, got -1"):
        Crawler(2, sweeps=1).reset(seed=-1)
