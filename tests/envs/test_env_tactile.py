"""Claim: what the fingertip of TactilePush feels is the force of contact."""

import torch
from torch import Tensor

import diffvbd as dv
from diffvbd.envs.tactile_push import PAD

F64 = torch.float64


def felt_and_true(steps: int) -> tuple[Tensor, Tensor]:
    """Forces on the fingertip [B, 3] [N]: by its four cells, and of contact."""
    env = dv.envs.TactilePush(2)
    env.reset(seed=0)
    action = torch.tensor([[1.0, 0.0], [1.0, 0.4]], dtype=F64)
    for _ in range(steps):
        before = env.state
        env.step(action)
    inputs, _ = env.act(before, action)
    forces = dv.contact.forces(env.model, env.state["x"], env.solver, previous=(before["x"], before["v"]),
                               friction=env.state["friction"], **inputs)  # fmt: skip
    return env.tractions(env.state).mean(1) * PAD[1] * PAD[2], forces.bodies.total[:, 1]


def test_the_cells_feel_the_force_of_contact() -> None:
    felt, true = felt_and_true(25)
    assert (true[:, 0] < -0.1).all() and abs(true[1, 2]) > 0.01
    assert ((felt - true)[:, [0, 2]].norm(dim=1) < 0.06 * true.norm(dim=1)).all(), (felt, true)


def test_nothing_is_felt_before_contact() -> None:
    env = dv.envs.TactilePush(2)
    env.reset(seed=0)
    assert env.tractions(env.state).abs().max() < 100.0  # its weight alone [Pa]
