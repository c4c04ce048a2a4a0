"""Smoothed Coulomb friction with the normal force and the normal of the start of the step (Li et al. 2020)."""

from typing import Any

import torch
from torch import Tensor

from .distance import log_barrier
from .energies import FloorBarrier
from .layout import dot, outer6, take
from .scene import Scene

RESTING = 1e-6  # of the motion below which friction is smoothed


def smoothed(slip: Tensor, reach: float) -> tuple[Tensor, Tensor, Tensor]:
    """f0(|u|) [m] of slips u [..., 3, n], f = f0'(|u|) / |u| [1/m] and f'(|u|) / |u|: below `reach` quadratic, above it
    Coulomb's |u|."""
    square = dot(slip, slip)
    moves = square > (RESTING * reach) ** 2
    # |u| has a kink at 0: where only rounding moves, its derivative is taken as 0
    length = torch.where(moves, torch.where(moves, square, 1.0).sqrt(), square.detach().sqrt())
    slow = length < reach
    potential = torch.where(slow, length**2 / reach - length**3 / (3 * reach**2) + reach / 3, length)
    rate = torch.where(slow, (2 - length / reach) / reach, 1 / torch.where(slow, 1.0, length))
    slope = torch.where(slow, -1 / reach**2, -rate * rate)
    return potential, rate, torch.where(moves, slope / torch.where(moves, length, 1.0), 0.0)


def tangential6(normal: Tensor) -> Tensor:
    """Upper triangle of I - n n^T: [..., 3, n] -> [..., 6, n]."""
    return normal.new_tensor([1, 0, 0, 1, 0, 1])[:, None] - outer6(normal)


class FloorFriction:
    """mu_f lambda f0(|u|) per plane: lambda the barrier's force at x_prev, u the slip since x_prev."""

    def __init__(self, scene: Scene, floor: FloorBarrier) -> None:
        friction = scene.model.friction
        self.scene, self.floor = scene, floor
        self.coefficient = scene.parameter(friction, "coefficient")[..., None, None]
        self.reach = scene.time_step * friction.velocity

    def _full(self, x: Tensor, x_prev: Tensor) -> tuple[Tensor, Tensor]:
        """h^2 times the friction that full slip meets [..., planes, n], and the slip [..., planes, 3, n]."""
        floor, x_prev = self.floor, x_prev.unsqueeze(-3)
        gap = dot(floor.normal, x_prev) - floor.height
        _, first, _ = log_barrier(gap, floor.kappa, floor.dhat)
        travel = x.unsqueeze(-3) - x_prev
        slip = travel - floor.normal * dot(floor.normal, travel).unsqueeze(-2)
        return -(self.scene.time_step**2) * self.coefficient * first, slip

    def block(self, k: int, x: Tensor, x_prev: Tensor) -> Tensor:
        vertices = self.scene.layout.colors[k].vertices
        weight, slip = self._full(take(x, vertices), take(x_prev, vertices))
        weight = (weight * smoothed(slip, self.reach)[1]).unsqueeze(-2)
        across = tangential6(self.floor.normal)
        return torch.cat(((weight * slip).sum(-3), (weight * across).sum(-3)), -2)

    def on_vertices(self, x: Tensor, x_prev: Tensor) -> tuple[Tensor, Tensor]:
        """Gradient [..., 3, V] and its exact derivative [..., 6, V]."""
        weight, slip = self._full(x, x_prev)
        _, rate, bend = smoothed(slip, self.reach)
        across, along = tangential6(self.floor.normal), outer6(slip)
        rate, bend = (weight * rate).unsqueeze(-2), (weight * bend).unsqueeze(-2)
        return (rate * slip).sum(-3), (rate * across + bend * along).sum(-3)

    def exact_block(self, k: int, x: Tensor, x_prev: Tensor) -> Tensor:
        """As block, with that derivative, which corrections take."""
        vertices = self.scene.layout.colors[k].vertices
        return torch.cat(self.on_vertices(take(x, vertices), take(x_prev, vertices)), -2)

    def energy(self, x: Tensor, x_prev: Tensor) -> Tensor:
        return self.terms(x, x_prev)[0].sum(-1)

    def terms(self, x: Tensor, x_prev: Tensor) -> tuple[Tensor, Tensor]:
        free = ~self.scene.model.pinned
        weight, slip = self._full(x[..., free], x_prev[..., free])
        total = weight * smoothed(slip, self.reach)[0]
        return total.flatten(-2), free.nonzero()[:, 0].repeat(total.shape[-2])


def floor_friction(scene: Scene, energies: list[Any]) -> list[FloorFriction]:
    """The friction of the floor among `energies`, where the model has both."""
    if getattr(scene.model, "friction", None) is None:
        return []
    return [FloorFriction(scene, energy) for energy in energies if isinstance(energy, FloorBarrier)]
