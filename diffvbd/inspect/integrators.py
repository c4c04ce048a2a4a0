"""What integrators of time have decided: ``diffvbd.integrators``."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

from torch import Tensor

from ..scopes import record_to

__all__ = ["record"]


@contextlib.contextmanager
def record() -> Iterator[list[Tensor]]:
    """Inside, every step with SDIRK2() or BDF2() of a Model with a floor or contact appends which vertices are of a
    body that may touch something which the step does not resolve, and so takes implicit Euler: bool [..., V]. With
    BDF2() such a body takes it in the next step, too, which is not in the list. A backward with checkpoints runs steps
    again, and counts."""
    found: list[Tensor] = []
    with record_to(found, "integrator"):
        yield found
