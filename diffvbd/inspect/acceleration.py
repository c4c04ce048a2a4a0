"""What Anderson acceleration has done: ``diffvbd.acceleration``."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

from torch import Tensor

from ..scopes import record_to

__all__ = ["record"]


@contextlib.contextmanager
def record() -> Iterator[list[Tensor]]:
    """Inside, every step of a Model with an acceleration that ReverseSweep differentiates (the default) appends, for
    each combination of its iterates and each connected body with a vertex to move, whether the body took it: bool
    [scenes, combinations, bodies], bodies in the order of their first vertices. It does not where its potential would
    have risen, or something would have crossed. A backward with checkpoints runs steps again, and counts; so do the
    parts of :func:`diffvbd.solve`. Steps by Unrolled and GlobalAdjoint append nothing."""
    found: list[Tensor] = []
    with record_to(found, "anderson"):
        yield found
