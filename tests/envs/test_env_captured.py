"""Claim: steps without gradient that are replayed from a CUDA graph are those that are made one by one."""

import pytest
import torch
from helpers.environments import KINDS, Kind

from diffvbd.testing import relative_error

pytestmark = pytest.mark.cuda


@pytest.mark.parametrize("kind", KINDS)
def test_captured_steps_are_eager_steps(kind: Kind) -> None:
    captured = kind(8, device="cuda", episode_steps=7)  # an episode ends on the way
    eager = kind(8, device="cuda", episode_steps=7, differentiable=True)
    random = torch.Generator().manual_seed(1)
    starts = [env.reset(seed=5)[0].clone() for env in (captured, eager)]
    assert torch.equal(*starts)
    for step in range(12):
        action = (2 * torch.rand(8, kind.actions, generator=random, dtype=torch.float64) - 1).cuda()
        found = captured.step(action)
        with torch.no_grad():
            expected = eager.step(action)
        assert captured._graph is not None and eager._graph is None
        for one, two in zip((*found[:4], *found[4].values()), (*expected[:4], *expected[4].values()), strict=True):
            if one.dtype == torch.bool:
                assert torch.equal(one, two)
            else:
                assert relative_error(one, two) < 1e-10
        assert bool(found[3].all()) == (step == 6)
        if step == 8:
            mask = torch.arange(8, device="cuda") < 3
            for env in (captured, eager):
                env.reset(options={"mask": mask})
    for name, value in captured.state.items():
        assert relative_error(value.double(), eager.state[name].double()) < 1e-10, name


def test_what_a_step_returned_stays() -> None:
    env = KINDS[1](4, device="cuda")
    env.reset(seed=0)
    action = torch.ones(4, 4, dtype=torch.float64, device="cuda")
    first, *_ = env.step(action)
    kept = first.clone()
    env.step(-action)
    assert torch.equal(first, kept)


def test_a_scene_whose_positions_are_lost_ends_alone() -> None:
    env = KINDS[1](4, device="cuda")
    env.reset(seed=0)
    action = torch.zeros(4, 4, dtype=torch.float64, device="cuda")
    env.step(action)
    env.state["v"][1] = torch.nan
    observation, reward, terminated, truncated, info = env.step(action)
    assert terminated.tolist() == info["_final_obs"].tolist() == [False, True, False, False] and not truncated.any()
    assert bool(observation.isfinite().all()) and bool(info["final_obs"].isfinite().all()) and reward[1] == 0
    assert env.state["steps"].tolist() == [2, 0, 2, 2] and torch.equal(env.state["x"][1], env.rest)
