"""XPBD of distance constraints in plain torch, one group of constraints after another, differentiated by autograd."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor


def step(
    x: Tensor,
    v: Tensor,
    *,
    edges: Tensor,
    groups: Sequence[Tensor],
    pinned: Tensor,
    mass: Tensor,
    stiffness: Any,
    rest_length: Any,
    time_step: float,
    sweeps: int,
    force: Tensor | None = None,
    gravity: Any = (0.0, -9.81, 0.0),
    prescribed: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """One time step; every tensor argument is differentiable by autograd.

    x, v: [..., V, 3] [m, m/s]; edges [C, 2]; groups: constraints projected together, in order; pinned [V] bool.
    mass [kg] broadcasts to [..., V], stiffness [N/m] and rest_length [m] to [..., C]; force [N], gravity [m/s^2] and
    prescribed [m] to x. Source: Macklin, Mueller, Chentanez 2016. Returns (x', v').
    """
    h = time_step
    mass, stiffness, rest_length, gravity = (
        torch.as_tensor(value, dtype=x.dtype, device=x.device) for value in (mass, stiffness, rest_length, gravity)
    )
    mass = mass.expand(*mass.shape[:-1], x.shape[-2])
    stiffness = stiffness.expand(*stiffness.shape[:-1], len(edges))
    rest_length = rest_length.expand(*rest_length.shape[:-1], len(edges))

    push = torch.zeros_like(x) if force is None else force
    moved = x + h * (v + h * (gravity + push / mass.unsqueeze(-1)))
    position = torch.where(pinned.unsqueeze(-1), x if prescribed is None else prescribed, moved)
    multiplier = [x.new_zeros(*x.shape[:-2], len(group), 1) for group in groups]
    inverse_mass = ((~pinned) / mass).unsqueeze(-1)
    parts = []
    for group in groups:
        first, second = edges[group].unbind(1)
        softness, length = 1 / (stiffness[..., group, None] * h**2), rest_length[..., group, None]
        parts.append((first, second, inverse_mass[..., first, :], inverse_mass[..., second, :], softness, length))
    for _ in range(sweeps):
        for n, (first, second, w_first, w_second, softness, length) in enumerate(parts):
            between = position[..., first, :] - position[..., second, :]
            distance = torch.linalg.vector_norm(between, dim=-1, keepdim=True)
            apart = distance > 0  # where particles meet, direction and derivatives are taken as 0
            unit = torch.where(apart, between / torch.where(apart, distance, 1.0), 0.0)
            added = (length - distance - softness * multiplier[n]) / (w_first + w_second + softness)
            multiplier[n] = multiplier[n] + added
            impulse = added * unit
            position = position.index_add(-2, first, w_first * impulse)
            position = position.index_add(-2, second, -w_second * impulse)
    return position, (position - x) / h
