"""What changes in time between the times at which a rollout asks for it."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

SWINGS = 0.5  # of its size: a value that differs by more from a line through its samples is not seen by them
LOOKS = 3  # at a step, at other places of each: nothing that repeats with the steps hides between them
GOLDEN = (math.sqrt(5) - 1) / 2  # whose multiples are spread evenly over [0, 1)
MOST_STEPS = 64  # that are looked at, evenly spread


def unseen(function: Callable[[float], Any], share: float, steps: int, duration: float, moves: bool) -> float:
    """By how much the values of a function of time [s] differ from lines through those that steps see, root mean
    square, over their size.

    Args:
        share: Of each step at which it is asked.
        moves: Whether it is a position, whose size is how far it goes from its first value.
    """
    h, stride = duration / steps, max(1, -(-steps // MOST_STEPS))
    lines: list[Tensor] = []
    values: list[Tensor] = []
    for k in range(0, steps - 1, stride):
        before, after = (_value(function, (k + i + share) * h) for i in (0, 1))
        for _ in range(LOOKS):
            part = GOLDEN * (len(values) + 1) % 1.0
            values.append(_value(function, (k + share + part) * h))
            lines.append(before + part * (after - before))
    if not values:
        return 0.0
    line, value = torch.stack(lines), torch.stack(values)
    size = (value - (_value(function, 0.0) if moves else 0.0)).square().mean().sqrt()
    return float((value - line).square().mean().sqrt() / size) if float(size) > 0 else 0.0


def _value(function: Callable[[float], Any], time: float) -> Tensor:
    given = function(time)
    value = torch.as_tensor(0.0 if given is None else given).detach().double()
    return torch.where(torch.isfinite(value), value, 0.0)  # prescribed positions of what is not pinned may be NaN
