"""Recording what steps decide: ``diffvbd.record``."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any, Literal

from .._common import context as scopes
from .._common.checks import check_bool, fail, is_word
from .._common.context import record_to


@contextlib.contextmanager
def record(kind: Literal["subspace", "contact", "integrator"]) -> Iterator[list[Any]]:
    """A list, to which each step inside the ``with`` appends what it has decided.

    A backward with checkpoints runs steps again, and counts; so do the parts of :func:`diffvbd.solve`. Steps of other
    threads and tasks are not recorded.

    Args:
        kind: ``"subspace"``: the step fractions of its coarse corrections [scenes, corrections, bodies], where
            ReverseSweep differentiates it (the default): 1 is a whole correction, 0 one that was refused, because it
            would have increased the potential or let something cross; bodies that contact or couplings join have one
            fraction.
            ``"contact"``: its detections (:class:`diffvbd.contact.Detection`), which pairs were near; also those under
            torch.compile. ``"integrator"``: with SDIRK2() or BDF2() and a floor or contact, which vertices are of a
            body that may touch something which the step does not resolve, and so takes implicit Euler: bool [..., V].

    Raises:
        ValueError: For another kind.
    """
    if not is_word(kind, "subspace", "contact", "integrator"):
        fail("kind", '"subspace", "contact" or "integrator"', repr(kind))
    found: list[Any] = []
    with record_to(found, kind):
        yield found


# --- debug_checks() ---------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def debug_checks(enabled: bool = True) -> Iterator[None]:
    """A context in which a position that is not finite raises RuntimeError with step, sweep, color, vertex and scene.

    Off (the default) it costs nothing. On CUDA the CPU repeats each step to find out, and values that a step cannot
    work with raise only here, because looking at them waits for the device. It holds for the thread or task that is
    inside, and for the backward of what ran there; a step under torch.compile checks while any thread is inside.
    """
    check_bool("enabled", enabled)
    with scopes.checks(enabled):
        yield
