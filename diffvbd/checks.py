"""Checks of arguments: every failure names the argument, what was expected and what came."""

from __future__ import annotations

import math
import operator
from typing import Any, NoReturn

import numpy as np
import torch
from torch import Tensor


def fail(name: str, expected: str, got: Any) -> NoReturn:
    raise ValueError(f"{name}: expected {expected}, got {got}")


def check_tensor(name: str, value: Any, like: Tensor, what: str = "a tensor", owner: str = "the Model's") -> Tensor:
    """``value`` as a tensor of like's dtype and device; python numbers are converted, other tensors must match."""
    if not isinstance(value, Tensor):
        if isinstance(value, (int, float)) and not isinstance(value, bool):
            return torch.full((), float(value), dtype=like.dtype, device=like.device)
        raise TypeError(f"{name}: expected {what}, got {type(value).__name__}")
    if value.dtype != like.dtype:
        raise TypeError(f"{name}: expected dtype {like.dtype} ({owner}), got {value.dtype}")
    if value.device != like.device:
        raise ValueError(f"{name}: expected device {like.device} ({owner}), got {value.device}")
    return value


def check_broadcast(name: str, value: Tensor, shape: tuple[int, ...]) -> Tensor:
    """Raises unless value broadcasts to shape."""
    ok = value.dim() <= len(shape) and all(
        a in (1, b) for a, b in zip(reversed(value.shape), reversed(shape), strict=False)
    )
    if not ok:
        fail(name, f"a shape that broadcasts to {list(shape)}", f"shape {list(value.shape)}")
    return value


def check_count(name: str, value: Any, minimum: int = 0, maximum: int | None = None) -> int:
    if isinstance(value, bool):
        raise TypeError(f"{name}: expected an integer, got bool")
    try:
        value = operator.index(value)
    except TypeError:
        raise TypeError(f"{name}: expected an integer, got {type(value).__name__} {value!r}") from None
    if value < minimum:
        fail(name, f"an integer >= {minimum}", value)
    if maximum is not None and value > maximum:
        fail(name, f"an integer <= {maximum}", value)
    return value


def check_number(name: str, value: Any) -> float:
    """A finite number >= 0."""
    if isinstance(value, Tensor) and value.numel() == 1:
        value = value.detach().item()
    if isinstance(value, bool) or not isinstance(value, (int, float, np.floating, np.integer)):
        raise TypeError(f"{name}: expected a number, got {type(value).__name__}")
    if not (math.isfinite(value) and value >= 0):
        fail(name, "a finite number >= 0", value)
    return float(value)


def check_positive(name: str, value: Any, unit: str = "") -> float:
    """A finite number > 0, its unit for the message."""
    if check_number(name, value) == 0:
        fail(name, f"a finite number > 0 {unit}".rstrip(), value)
    return float(value)


def vertex_mask(pinned: Any, num_vertices: int) -> Tensor:
    """``pinned``, a bool mask or indices, as a bool mask [V] on the CPU."""
    if pinned is None:
        return torch.zeros(num_vertices, dtype=torch.bool)
    try:
        pinned = torch.as_tensor(pinned).detach().cpu()
    except (TypeError, ValueError, RuntimeError):
        raise TypeError(f"pinned: expected a bool mask or integer indices, got {type(pinned).__name__}") from None
    if pinned.dtype == torch.bool:
        if pinned.shape != (num_vertices,):
            fail("pinned", f"a mask of shape [{num_vertices}] or indices", f"a mask of shape {list(pinned.shape)}")
        return pinned.clone()
    if pinned.numel() and pinned.is_floating_point():
        raise TypeError(f"pinned: expected a bool mask or integer indices, got dtype {pinned.dtype}")
    index = pinned.to(torch.int64).reshape(-1)
    if index.numel() and (int(index.min()) < 0 or int(index.max()) >= num_vertices):
        fail("pinned", f"indices in [0, {num_vertices})", f"{int(index.min())}..{int(index.max())}")
    return torch.zeros(num_vertices, dtype=torch.bool).index_fill(0, index, True)
