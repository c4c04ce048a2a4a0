"""Claim: environments are those of gymnasium's vector interface, with tensors of the right shape, dtype and device, and
a scene whose episode ends begins anew in the same step."""

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode
from helpers.environments import KINDS, Kind

import diffvbd as dv


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("kind", KINDS)
def test_spaces_and_shapes(kind: Kind, dtype: torch.dtype, device: str) -> None:
    env = kind(3, dtype=dtype, device=device, sweeps=4)
    assert isinstance(env, gymnasium.vector.VectorEnv) and env.num_envs == 3
    assert env.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    numbers = np.float64 if dtype == torch.float64 else np.float32
    for space, single in ((env.observation_space, env.single_observation_space),
                          (env.action_space, env.single_action_space)):  # fmt: skip
        assert space.dtype == single.dtype == numbers and space.shape == (3, *(single.shape or ()))
    observation, info = env.reset(seed=0)
    assert observation.shape == env.observation_space.shape and info == {}
    env.action_space.seed(0)
    for action in (env.action_space.sample(), torch.as_tensor(env.action_space.sample(), device=device)):
        observation, reward, terminated, truncated, info = env.step(action)
        for value in (observation, reward, info["final_obs"], env.state["x"]):
            assert value.dtype == dtype and value.device.type == device and bool(value.isfinite().all())
            assert not value.requires_grad
        assert observation.shape == info["final_obs"].shape == env.observation_space.shape
        assert reward.shape == terminated.shape == truncated.shape == (3,)
        assert terminated.dtype == truncated.dtype == torch.bool and not (terminated | truncated).any()


def test_an_episode_that_ends_begins_anew_in_the_same_step() -> None:
    env = dv.envs.Crawler(2, episode_steps=2, sweeps=2)
    env.reset(seed=0)
    action = torch.ones(2, 4, dtype=torch.float64)
    _, _, _, truncated, _ = env.step(action)
    assert not truncated.any()
    material = env.state["mu"].clone()
    observation, _, terminated, truncated, info = env.step(action)
    assert truncated.all() and info["_final_obs"].all() and not terminated.any()
    assert (env.state["steps"] == 0).all() and torch.equal(env.state["x"][0], env.rest)
    assert (observation[:, :4] == 0).all() and (info["final_obs"][:, :4] > 0).all()  # activations
    assert (env.state["mu"] != material).all()


def test_a_beam_that_is_left_behind_ends_its_episode() -> None:
    env = dv.envs.SoftLift(2, sweeps=4)
    env.reset(seed=0)
    lift = torch.tensor([[1.0, 0.0], [0.0, 0.0]], dtype=torch.float64)  # without closing the fingers
    ended = torch.zeros(2, dtype=torch.bool)
    for _ in range(40):
        _, _, terminated, _, _ = env.step(lift)
        ended |= terminated
    assert ended.tolist() == [True, False]
