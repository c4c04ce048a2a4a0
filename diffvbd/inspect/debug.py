"""debug_checks(): the switch."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

from .. import scopes


@contextlib.contextmanager
def debug_checks(enabled: bool = True) -> Iterator[None]:
    """Inside, a position that is not finite raises RuntimeError naming step, sweep, color, vertex and scene.

    Off (the default) it costs nothing. On CUDA the CPU repeats each step to find out, and values that a step cannot
    work with raise only here, because looking at them waits for the device. It holds for the thread or task that is
    inside, and for the backward of what ran there; a step under torch.compile checks while any thread is inside.
    """
    with scopes.checks(enabled):
        yield
