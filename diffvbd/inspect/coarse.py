"""What coarse corrections have done: ``diffvbd.coarse``."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

from torch import Tensor

from ..scopes import record_to

__all__ = ["record"]


@contextlib.contextmanager
def record() -> Iterator[list[Tensor]]:
    """Inside, every step that ReverseSweep differentiates (the default) appends the lengths of its corrections
    [scenes, corrections, bodies]: 1 is a whole correction, 0 one that was refused, because it would have raised the
    potential or let something cross; bodies that contact joins have one length. A backward with checkpoints runs steps
    again, and counts; so do the parts of :func:`diffvbd.solve`. Steps by Unrolled and GlobalAdjoint append nothing."""
    found: list[Tensor] = []
    with record_to(found, "coarse"):
        yield found
