"""A soft body that crawls by four muscles."""

from __future__ import annotations

import math

import torch
from torch import Tensor

import diffvbd as dv

from .environment import Environment, State

SIZE = (0.24, 0.06, 0.06)  # [m]
GAP = 0.0035  # of the body over the floor at first [m]
CONTRACTION = 0.25  # of a muscle at an activation of 1
RATE = 0.3  # share of the way to its target that an activation goes in a step
FREQUENCY = 2.0  # of the clock that is observed [Hz]
SPEED, EFFORT = 10.0, 0.02  # reward of 1 m/s, and cost of a mean squared action of 1


class Crawler(Environment):
    """A soft beam of 63 vertices on a floor, with four muscles along it; the reward is its speed along x.

    Muscles fill the lower and upper halves of the rear and of the front half. The fibres of a muscle of activation a
    are free of stress when shortened by a quarter of a; one below 0 lengthens.

    Observations (15): activations, a clock of 2 Hz as sine and cosine, velocity of the body, heights of tail and head
    over its middle, velocities of tail and head along x and y.

    Actions (4): targets of the activations, which follow within some steps.

    Reward: 10 times the speed of the body along x [m/s], less 0.02 of the mean squared action.
    """

    actions, draws, episode_steps = 4, 1, 180
    sweeps = 40  # motion by friction depends on them: the way of a gait is within 3 % of that at 160
    young, friction = (5e4, 7e4), (0.6, 1.0)

    def build(self, dtype: torch.dtype, device: str | torch.device) -> dv.Model:
        mesh = dv.mesh.box((7, 3, 3), SIZE, split="kuhn").translate((-SIZE[0] / 2, GAP, -SIZE[2] / 2))
        floor = dv.FloorBarrier(height=0.0, kappa=1000.0, dhat=0.004)
        energies = (dv.StableNeoHookean(), floor, dv.Friction(0.8, velocity=0.05))
        model = dv.Model(mesh, density=1000.0, energies=energies, dtype=dtype, device=device)
        like = model.rest_points
        center = torch.from_numpy(mesh.points[mesh.tets].mean(1)).to(like)
        front, upper = center[:, 0] > 0, center[:, 1] > GAP + SIZE[1] / 2
        self._muscles = torch.stack([~front & ~upper, ~front & upper, front & ~upper, front & upper]).to(like)  # [4, T]
        self._fibres = torch.zeros(mesh.num_tets, 3, dtype=like.dtype, device=like.device)
        self._fibres[:, 0] = 1.0
        ends = abs(like[:, 0]) > SIZE[0] / 2 - 1e-6
        self._tail, self._head = ((ends & (like[:, 0] * sign > 0)).nonzero()[:, 0] for sign in (-1, 1))
        return model

    def start(self, draws: Tensor) -> State:
        phase = 2 * math.pi * draws[:, 0]
        return {"activation": torch.zeros_like(draws).expand(-1, 4), "phase": phase}

    def act(self, state: State, action: Tensor) -> tuple[dict[str, Tensor], State]:
        activation = state["activation"] + RATE * (action - state["activation"])
        shape = dv.fibre_contraction(self._fibres, CONTRACTION * activation @ self._muscles)
        phase = state["phase"] + 2 * math.pi * FREQUENCY * self.solver.time_step
        return {"stress_free": shape}, {"activation": activation, "phase": phase}

    def observe(self, state: State) -> Tensor:
        x, v, phase = state["x"], state["v"], state["phase"][:, None]
        ends = [x[:, part, 1].mean(1, keepdim=True) - x[..., 1].mean(1, keepdim=True)
                for part in (self._tail, self._head)]  # fmt: skip
        speeds = [v[:, part, :2].mean(1) / 0.3 for part in (self._tail, self._head)]
        body = [phase.sin(), phase.cos(), v.mean(1) / 0.3]
        return torch.cat([state["activation"], *body, *(end / 0.02 for end in ends), *speeds], 1)

    def reward(self, before: State, after: State, action: Tensor) -> Tensor:
        way = (after["x"] - before["x"])[..., 0].mean(1)
        return SPEED * way / self.solver.time_step - EFFORT * action.square().mean(1)
