"""Claim: each scene has a material and a friction of its own, from the ranges given, and they matter."""

import pytest
import torch
from helpers.environments import KINDS, Kind

import diffvbd as dv

# Actions with which the scenes move: the fingers close and lift, the muscles contract, the pusher pushes.
MOVING = {"SoftLift": [0.5, 1.0], "Crawler": [1.0, -1.0, 0.5, 0.2], "TactilePush": [1.0, 0.2]}


def run(env: dv.envs.Environment, steps: int = 12) -> torch.Tensor:
    """Observations after some steps, of scenes that all begin as the first one but for material and friction."""
    env.reset(seed=0)
    for name in set(env.state) - {"mu", "lam", "friction"}:
        env.state[name] = env.state[name][:1].expand_as(env.state[name]).clone()
    action = torch.tensor([MOVING[type(env).__name__]] * env.num_envs, dtype=torch.float64)
    for _ in range(steps):
        observation, *_ = env.step(action)
    return observation


@pytest.mark.parametrize("kind", KINDS)
def test_material_and_friction_matter(kind: Kind) -> None:
    same = run(kind(3, young=(4e4, 4e4), friction=(0.5, 0.5), sweeps=10))
    young = run(kind(3, young=(2e4, 8e4), friction=(0.5, 0.5), sweeps=10))
    friction = run(kind(3, young=(4e4, 4e4), friction=(0.1, 0.9), sweeps=10))
    assert torch.equal(same[0], same[1]) and torch.equal(same[0], same[2])
    for found in (young, friction):
        assert (found[0] - found[1]).abs().max() > 1e-4 and (found[0] - found[2]).abs().max() > 1e-4


@pytest.mark.parametrize("kind", KINDS)
def test_draws_lie_in_their_ranges(kind: Kind) -> None:
    env = kind(64, young=(2e4, 3e4), friction=(0.2, 0.4), sweeps=1)
    young, poisson = dv.young_poisson(env.state["mu"][:, 0], env.state["lam"][:, 0])  # of the block, in TactilePush
    assert (
        2e4 <= young.min() < 2.2e4 and 2.8e4 < young.max() <= 3e4 and torch.allclose(poisson, poisson.new_tensor(0.4))
    )
    assert 0.2 <= env.state["friction"].min() < 0.24 and 0.36 < env.state["friction"].max() <= 0.4
