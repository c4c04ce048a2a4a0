"""What changes in time between the times at which a rollout asks for it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

SWINGS = 0.5  # of its size: a value that differs by more from a line through its samples is not seen by them
BETWEEN = (0.382, 0.724)  # of a step after a sample, so uneven that no swing vanishes at all of them
MOST_SAMPLES = 512  # steps that are looked at, evenly spread


def unseen(function: Callable[[float], Any], share: float, steps: int, duration: float, moves: bool) -> float:
    """By how much the values of a function of time [s] differ from lines through those that steps see, root mean
    square, over their size.

    Args:
        share: Of each step at which it is asked.
        moves: Whether it is a position, whose size is how far it goes from its first value.
    """
    h, stride = duration / steps, max(1, steps // MOST_SAMPLES)
    lines: list[Tensor] = []
    values: list[Tensor] = []
    for k in range(0, steps - 1, stride):
        before, after = (_value(function, (k + i + share) * h) for i in (0, 1))
        for part in BETWEEN:
            values.append(_value(function, (k + share + part) * h))
            lines.append(before + part * (after - before))
    if not values:
        return 0.0
    line, value = torch.stack(lines), torch.stack(values)
    size = (value - (_value(function, 0.0) if moves else 0.0)).square().mean().sqrt()
    return float((value - line).square().mean().sqrt() / size) if float(size) > 0 else 0.0


def _value(function: Callable[[float], Any], time: float) -> Tensor:
    value = torch.as_tensor(function(time)).detach().double()
    return torch.where(torch.isfinite(value), value, 0.0)  # prescribed positions of what is not pinned may be NaN
