"""Where constants are made: tensors that outlive the call, whatever modes of torch it is made in."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import torch


@contextlib.contextmanager
def lasting_tensors() -> Iterator[None]:
    """Inside (or in a function that it decorates) tensors are made on the CPU unless a device is named, without a
    graph, and as ordinary ones: those of torch.inference_mode() could never take part in a backward."""
    with torch.inference_mode(False), torch.no_grad(), torch.device("cpu"):
        yield
