"""Claim: bad input raises an error that names the argument, what was expected and what came."""

from typing import Any

import numpy as np
import pytest
import torch
from helpers.environments import KINDS

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
]
OPTIONS = [
    ({"mask": torch.ones(3, dtype=torch.bool)}, r"options: expected a bool mask of shape \[2\], got torch.bool of "),
    ({"mask": torch.ones(2)}, r"options: expected a bool mask of shape \[2\], got torch.float32 of shape \[2\]"),
    ({"maks": None}, "options: expected mask alone, got 'maks'"),
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


def test_a_seed_that_is_none() -> None:
    with pytest.raises(ValueError, match="seed: expected an integer >= 0, got -1"):
        Crawler(2, sweeps=1).reset(seed=-1)
