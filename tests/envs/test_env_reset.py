"""Claim: a reset by a mask leaves the other scenes as they are, to the bit, and a seed repeats an episode."""

import pytest
import torch
from helpers.environments import KINDS, Kind


def actions_of(kind: Kind, steps: int, device: str = "cpu") -> torch.Tensor:
    generator = torch.Generator().manual_seed(1)
    return (2 * torch.rand(steps, 4, kind.actions, generator=generator, dtype=torch.float64) - 1).to(device)


@pytest.mark.usefixtures("one_regime")
@pytest.mark.parametrize("kind", KINDS)
def test_a_masked_reset_leaves_the_other_scenes_alone(kind: Kind, device: str) -> None:
    one, two = (kind(4, device=device, sweeps=4) for _ in range(2))
    given = actions_of(kind, 6, device)
    mask = torch.tensor([False, True, False, True], device=device)
    for env in (one, two):
        env.reset(seed=0)
        for action in given[:3]:
            env.step(action)
    before = {name: value.clone() for name, value in one.state.items()}
    observation, _ = one.reset(options={"mask": mask})
    for name, value in one.state.items():
        assert torch.equal(value[~mask], before[name][~mask]), name
    assert (one.state["steps"][mask] == 0).all() and (one.state["mu"][mask] != before["mu"][mask]).any(1).all()
    assert not one.state["v"][mask].any()
    for action in given[3:]:  # what the others do next does not change, either
        observation, reward, *_ = one.step(action)
        expected, expected_reward, *_ = two.step(action)
        assert torch.equal(observation[~mask], expected[~mask]) and torch.equal(reward[~mask], expected_reward[~mask])
    assert not torch.equal(observation[mask], expected[mask])


@pytest.mark.parametrize("kind", KINDS)
def test_a_seed_repeats_an_episode(kind: Kind) -> None:
    env, found = kind(4, sweeps=2), []
    for seed in (3, 3, 4):
        env.reset(seed=seed)
        env.step(actions_of(kind, 1)[0])
        found.append({name: value.clone() for name, value in env.state.items()})
    assert all(torch.equal(value, found[1][name]) for name, value in found[0].items())
    assert not torch.equal(found[0]["x"], found[2]["x"]) and not torch.equal(found[0]["mu"], found[2]["mu"])


def test_gymnasiums_own_name_of_the_mask() -> None:
    env = KINDS[1](2, sweeps=2)
    env.step(torch.zeros(2, 4, dtype=torch.float64))
    env.reset(options={"reset_mask": torch.tensor([True, False])})
    assert env.state["steps"].tolist() == [0, 1]
