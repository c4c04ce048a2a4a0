"""Two fingers of a robot that lift a soft beam."""

from __future__ import annotations

import torch
from torch import Tensor

import diffvbd as dv

from ..robots.gripper import gripper
from .environment import Environment, State

WIDTH, LENGTH = 0.04, 0.12  # of the beam [m]
GAP = 0.0046  # of the beam over the table at first [m]
DHAT = 0.005  # [m]
SPEEDS = (0.12, 0.03)  # largest of the joints lift and close [m/s]: a finger must not go all of its gap in a step
HEIGHT, LAG, EFFORT = 20.0, 10.0, 0.01  # reward of 1 m, costs of a lag of 1 m and of a mean squared action of 1
DROPPED = 0.04  # lag of the beam behind the hand at which the beam has been lost [m]
# Fingers reach below the table: a lower edge that slides over the beam would dent it, and come too close in fast steps.
FINGER = (0.02, 0.16, 0.05)  # [m]


class SoftLift(Environment):
    """A gripper of two fingers lifts a soft beam of 63 vertices from a narrow table by friction.

    The gripper is a URDF robot of :mod:`diffvbd.robots` with the joints lift and close. The beam weighs 1.9 N; how far
    the fingers must close depends on its modulus and on friction, which are not observed.

    Observations (13): positions of the joints over their limits, height of the beam over where it lay, how far it lags
    behind the hand, its place along x and z, its velocity, its twist and sag as heights of both ends over its middle,
    velocities of both ends along y.

    Actions (2): velocities of lift and close, 1 being 0.12 and 0.03 m/s; positions stay within the limits.

    Reward: 20 times the height of the beam over where it lay [m], less 10 times its lag [m] and 0.01 of the mean
    squared action. An episode ends early where the beam lags by 4 cm. Making one without yourdfpy raises ImportError.
    """

    actions, draws = 2, 3
    young, friction = (1e4, 3e4), (0.4, 0.8)

    def build(self, dtype: torch.dtype, device: str | torch.device) -> dv.Model:
        self.robot = gripper(FINGER, 0.0496, rise=0.1, travel=0.0075, height=0.034)
        # a little off the middle: a beam exactly between the fingers is at a kink
        place = (-WIDTH / 2 + 2e-4, GAP, -LENGTH / 2 + 3e-4)
        mesh = dv.mesh.box((3, 3, 7), (WIDTH, WIDTH, LENGTH), split="kuhn").translate(place)
        energies = (
            dv.StableNeoHookean(),
            dv.FloorBarrier(height=0.0, kappa=400.0, dhat=DHAT),
            dv.PairBarrier(kappa=3000.0, dhat=DHAT, self_contact=False, reach=0.02, detections=1, capacity=800),
            dv.Friction(0.6, velocity=0.01),
        )
        model = dv.Model(mesh, 1000.0, energies=energies, colliders=self.robot.colliders, dtype=dtype, device=device)
        like = model.rest_points
        self._limits, self._speeds = self.robot.limits.to(like), like.new_tensor(SPEEDS)
        self._ends = [(like[:, 2] * sign > LENGTH / 2 - 1e-3).nonzero()[:, 0] for sign in (-1, 1)]
        return model

    def start(self, draws: Tensor) -> State:
        shift = draws.new_zeros(len(draws), 1, 3)
        shift[:, 0, 0], shift[:, 0, 2] = 4e-4 * (draws[:, 0] - 0.5), 4e-3 * (draws[:, 1] - 0.5)
        q = torch.stack([torch.zeros_like(draws[:, 2]), 5e-4 * draws[:, 2]], 1)
        return {"x": self.rest + shift, "q": q}

    def act(self, state: State, action: Tensor) -> tuple[dict[str, Tensor], State]:
        low, high = self._limits.unbind(1)
        q = torch.minimum(torch.maximum(state["q"] + self.solver.time_step * self._speeds * action, low), high)
        return {"colliders": self.robot(q), "colliders_before": self.robot(state["q"])}, {"q": q}

    def _rise(self, state: State) -> Tensor:
        """Height of the beam over where it lay [B] [m]."""
        return state["x"][..., 1].mean(1) - self.rest[:, 1].mean()

    def observe(self, state: State) -> Tensor:
        x, v, rise = state["x"], state["v"], self._rise(state)
        middle = x.mean(1)
        ends = torch.stack([x[:, part, 1].mean(1) - middle[:, 1] for part in self._ends], 1)
        speeds = torch.stack([v[:, part, 1].mean(1) for part in self._ends], 1)
        heights = torch.stack([rise / 0.1, (state["q"][:, 0] - rise) / 0.02], 1)
        place = middle[:, ::2] / 0.005
        return torch.cat(
            [state["q"] / self._limits[:, 1], heights, place, v.mean(1) / 0.1, ends / 0.02, speeds / 0.1], 1
        )

    def reward(self, before: State, after: State, action: Tensor) -> Tensor:
        rise = self._rise(after)
        return HEIGHT * rise - LAG * (after["q"][:, 0] - rise).abs() - EFFORT * action.square().mean(1)

    def failed(self, state: State) -> Tensor:
        return state["q"][:, 0] - self._rise(state) > DROPPED
