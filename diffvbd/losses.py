"""Losses on positions: plain torch functions, differentiable in every tensor argument."""

import torch
from torch import Tensor


def vertex_distance(x: Tensor, target: Tensor) -> Tensor:
    """Mean squared distance between matching points.

    Args:
        x: Positions [m], shape [..., 3]; frames, scenes and vertices may all be leading dimensions.
        target: Positions [m], broadcastable to x.

    Returns:
        Scalar [m^2].

    Raises:
        ValueError: a target that does not broadcast to x.
    """
    try:
        target = target.expand_as(x)
    except RuntimeError:
        raise ValueError(
            f"target: expected a shape that broadcasts to {list(x.shape)}, got {list(target.shape)}"
        ) from None
    return (x - target).square().sum(-1).mean()


def center_of_mass(x: Tensor, mass: Tensor) -> Tensor:
    """Mass-weighted mean position; compare two of them with `vertex_distance`.

    Args:
        x: Positions [m], shape [..., V, 3].
        mass: Vertex masses [kg], shape [V], for example `model.mass`.

    Returns:
        Positions [m], shape [..., 3].
    """
    return (mass.unsqueeze(-1) * x).sum(-2) / mass.sum()


def huber(x: Tensor, target: Tensor, delta: float) -> Tensor:
    """Mean Huber loss of the distance r between matching points: r^2/2 up to delta, delta (r - delta/2) beyond.

    A few points that are far off (occlusion, wrong correspondence) pull no harder than points at distance delta.

    Args:
        x: Positions [m], shape [..., 3].
        target: Positions [m], broadcastable to x.
        delta: Distance at which the loss turns linear [m].

    Returns:
        Scalar [m^2].

    Raises:
        ValueError: delta <= 0.

    Source: Huber, Robust estimation of a location parameter (1964).
    """
    if not delta > 0:
        raise ValueError(f"delta: expected a positive distance, got {delta}")
    squared = (x - target).square().sum(-1)
    # The square root is taken of clamped values only: its derivative at r = 0 is infinite.
    linear = delta * (squared.clamp(min=delta**2).sqrt() - 0.5 * delta)
    return torch.where(squared < delta**2, 0.5 * squared, linear).mean()
