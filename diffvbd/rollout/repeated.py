"""Functions of a rollout that a checkpointed segment calls again: whether they return in the backward what they have
returned before."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..scopes import is_captured

CHANGED = (
    "{}: expected the same value for step {} in the backward as in the rollout, got another one: a function must not "
    "keep state from call to call (an integral, a filter, a hidden state, a random generator of its own), and what it "
    "closes over must not change in place before the backward; checkpoint_every=None calls it once"
)
STRIDE = (5**0.5 - 1) / 2  # of weights in [0, 1) that differ from place to place


def repeated(name: str, value: Any) -> Any:
    """``value``; a function of (step, x, v) is wrapped to raise RuntimeError where it returns another value than it did
    for that step. Tensors on CUDA, where a look would wait for the device, become NaN in place of that."""
    if isinstance(value, Tensor) or not callable(value):
        return value
    seen: dict[int, Any] = {}  # by step

    def called(step: int, x: Tensor, v: Tensor) -> Any:
        found = value(step, x, v)
        if isinstance(found, Tensor) and is_captured(found):
            return found
        now = _mark_of(found)
        return _matched(found, seen.setdefault(step, now), now, CHANGED.format(name, step))

    return called


def _mark_of(value: Any) -> Any:
    """What tells values apart, and is small: of a tensor two sums. NaN is that of rows of ``prescribed`` that are not
    pinned."""
    if isinstance(value, (tuple, list)):
        return [_mark_of(part) for part in value]
    if isinstance(value, np.ndarray):
        return [value.shape, value.tobytes()]
    if not isinstance(value, Tensor):
        return value if isinstance(value, (int, float, np.number)) else type(value)
    flat = value.detach().double().nan_to_num().flatten()
    weights = torch.arange(len(flat), dtype=flat.dtype, device=flat.device).mul_(STRIDE).frac_()
    return torch.stack([flat @ weights, flat @ flat])


def _matched(found: Any, before: Any, now: Any, changed: str) -> Any:
    """The value if its mark is that of before."""
    if isinstance(now, Tensor) and isinstance(before, Tensor):
        close = _are_close(before, now, found)
        if found.is_cuda:  # the same operations in each run
            return found * torch.where(close, 1.0, torch.nan).to(found.dtype)
        same = bool(close)
    elif isinstance(found, (tuple, list)) and isinstance(before, list) and len(before) == len(found):
        parts = [_matched(*part, changed) for part in zip(found, before, now, strict=True)]
        return tuple(parts) if isinstance(found, tuple) else parts
    else:
        same = type(before) is type(now) and (before == now or (before != before and now != now))  # NaN is itself
    if not same:
        raise RuntimeError(changed)
    return found


def _are_close(before: Tensor, now: Tensor, value: Tensor) -> Tensor:
    """Whether sums differ by no more than what rounding of the values makes of them."""
    if before is now:
        return now.new_ones((), dtype=torch.bool)
    share = torch.finfo(value.dtype if value.is_floating_point() else torch.float64).eps ** 0.5
    scale = torch.stack([(value.numel() * now[1]).sqrt(), now[1]])
    return ((now - before).abs() <= share * scale).all()
