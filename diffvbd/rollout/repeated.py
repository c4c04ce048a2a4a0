"""Callables of a rollout that a checkpointed segment calls again: whether they return in the backward what they have
returned before."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ..scopes import is_captured

CHANGED = (
    "{}: expected the same value for step {} in the backward as in the rollout, got another one: a function must not "
    "keep state from call to call (an integral, a filter, a hidden state, a random generator of its own), and what it "
    "closes over must not change in place before the backward; checkpoint_every=None calls it once"
)


def repeated(name: str, value: Any) -> Any:
    """``value``; a callable of (step, x, v) so that it raises RuntimeError where it returns something else than for the
    same step before. On CUDA, where a look would wait for the device, what it returns is NaN then."""
    if isinstance(value, Tensor) or not callable(value):
        return value
    seen: dict[int, Any] = {}  # by step

    def called(step: int, x: Tensor, v: Tensor) -> Any:
        found = value(step, x, v)
        if not isinstance(found, Tensor):
            same = _are_equal(seen.setdefault(step, found), found)
        elif is_captured(found):
            return found
        else:
            now = _sums(found)
            close = _are_close(seen.setdefault(step, now), now, found)
            if found.is_cuda:  # the same operations in each run
                return found * torch.where(close, 1.0, torch.nan).to(found.dtype)
            same = bool(close)
        if not same:
            raise RuntimeError(CHANGED.format(name, step))
        return found

    return called


def _sums(value: Tensor) -> Tensor:
    """Two numbers that tell values apart; NaN is that of rows of ``prescribed`` that are not pinned."""
    value = value.detach().double().nan_to_num()
    return torch.stack([value.sum(), value.square().sum()])


def _are_close(before: Any, now: Tensor, value: Tensor) -> Tensor:
    """Whether sums differ by no more than what rounding of the values makes of them."""
    if not isinstance(before, Tensor) or before is now:
        return now.new_full((), before is now, dtype=torch.bool)
    share = torch.finfo(value.dtype if value.is_floating_point() else torch.float64).eps ** 0.5
    scale = torch.stack([(value.numel() * now[1]).sqrt(), now[1]])
    return ((now - before).abs() <= share * scale).all()


def _are_equal(before: Any, now: Any) -> bool:
    """Of numbers and None; of what holds tensors, for the solves of a step, only that it is of one kind."""
    plain = (int, float, type(None))
    return before == now if isinstance(before, plain) and isinstance(now, plain) else type(before) is type(now)
