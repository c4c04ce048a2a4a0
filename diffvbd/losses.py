"""Losses on positions: plain torch functions, differentiable in every tensor argument."""

from typing import Any

import torch
from torch import Tensor

from ._common.checks import check_positive, fail, kind_of


def vertex_distance(x: Tensor, target: Tensor) -> Tensor:
    """Mean squared distance between matching points.

    Args:
        x: Positions [m], shape [..., 3]; frames, scenes and vertices may all be leading dimensions.
        target: Positions [m], broadcastable to x.

    Returns:
        Scalar [m^2].

    Raises:
        TypeError: x or target is no tensor.
        ValueError: a target that does not broadcast to x.
    """
    return _apart(x, target).square().sum(-1).mean()


def center_of_mass(x: Tensor, mass: Tensor) -> Tensor:
    """Mass-weighted mean position; compare two of them with `vertex_distance`.

    Args:
        x: Positions [m], shape [..., V, 3].
        mass: Vertex masses [kg], shape [V], for example `model.mass`.

    Returns:
        Positions [m], shape [..., 3].

    Raises:
        TypeError: x or mass is no tensor.
        ValueError: masses of another number than x has vertices.
    """
    _check_tensor("x", x)
    _check_tensor("mass", mass)
    if mass.shape != x.shape[-2:-1]:
        fail("mass", f"shape {list(x.shape[-2:-1])}, a mass for each vertex of x", f"shape {list(mass.shape)}")
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
        TypeError: x or target is no tensor, delta is no number.
        ValueError: a target that does not broadcast to x, delta <= 0.

    Source: Huber, Robust estimation of a location parameter (1964).
    """
    delta = check_positive("delta", delta, "m")
    squared = _apart(x, target).square().sum(-1)
    # The square root is taken of clamped values only: its derivative at r = 0 is infinite.
    linear = delta * (squared.clamp(min=delta**2).sqrt() - 0.5 * delta)
    return torch.where(squared < delta**2, 0.5 * squared, linear).mean()


def _apart(x: Tensor, target: Tensor) -> Tensor:
    """x - target, of x's shape."""
    _check_tensor("x", x)
    _check_tensor("target", target)
    try:
        target = target.expand_as(x)
    except RuntimeError:
        fail("target", f"a shape that broadcasts to {list(x.shape)}", list(target.shape))
    return x - target


def _check_tensor(name: str, value: Any) -> None:
    if not isinstance(value, Tensor):
        raise TypeError(f"{name}: expected a tensor, got {kind_of(value)}")
