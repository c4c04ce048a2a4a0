"""Claim: the gradient of rewards and states by actions is that of central differences, and ends where it is cut."""

import pytest
import torch
from helpers.environments import KINDS, Kind
from torch import Tensor

import diffvbd as dv

STEPS, STEP, MOST = 6, 1e-6, 1e-5  # of the motion; of differences; relative error


@pytest.mark.parametrize("kind", KINDS)
def test_the_gradient_of_rewards_by_actions(kind: Kind) -> None:
    env = kind(2, differentiable=True, sweeps=10)
    random = torch.Generator().manual_seed(1)
    actions, direction = (1.2 * torch.rand(STEPS, 2, kind.actions, generator=random, dtype=torch.float64) - 0.4
                          for _ in range(2))  # fmt: skip

    def value(actions: Tensor) -> Tensor:
        """Rewards, and the observations at the end, of two scenes."""
        env.reset(seed=3)
        out = torch.zeros((), dtype=torch.float64)
        for action in actions:
            observation, reward, *_ = env.step(action)
            out = out + reward.sum()
        return out + 0.1 * observation.sin().sum()

    leaf = actions.clone().requires_grad_()
    (grad,) = torch.autograd.grad(value(leaf), leaf)
    with torch.no_grad():
        difference = (value(actions + STEP * direction) - value(actions - STEP * direction)) / (2 * STEP)
    found = (grad * direction).sum()
    assert abs(found - difference) < MOST * abs(difference)
    assert grad.flatten(1).abs().amax(1).min() > 0  # each step matters


def test_detach_cuts_the_graph() -> None:
    env = dv.envs.Crawler(2, differentiable=True, sweeps=4)
    env.reset(seed=0)
    first, second = (torch.full((2, 4), 0.5, dtype=torch.float64, requires_grad=True) for _ in range(2))
    env.step(first)
    observation = env.detach()
    assert not observation.requires_grad and not any(value.requires_grad for value in env.state.values())
    _, reward, *_ = env.step(second)
    by_first, by_second = torch.autograd.grad(reward.sum(), (first, second), allow_unused=True)
    assert by_first is None and by_second.abs().max() > 0


def test_no_gradient_passes_from_one_episode_to_the_next() -> None:
    env = dv.envs.Crawler(2, differentiable=True, episode_steps=2, sweeps=4)
    env.reset(seed=0)
    actions = [torch.full((2, 4), 0.5, dtype=torch.float64, requires_grad=True) for _ in range(3)]
    rewards = [env.step(action)[1].sum() for action in actions]
    earlier = torch.autograd.grad(rewards[2], actions[:2], allow_unused=True, retain_graph=True)
    assert all(grad is None or not grad.any() for grad in earlier)
    assert torch.autograd.grad(rewards[1], actions[0])[0].abs().max() > 0
