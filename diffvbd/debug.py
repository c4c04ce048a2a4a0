"""debug_checks(): the switch, and what it costs only where it is on."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from typing import Any

import torch
from torch import Tensor

from . import ops, scopes
from .model import Model
from .scopes import checking
from .sweeps import sweep


@contextlib.contextmanager
def debug_checks(enabled: bool = True) -> Iterator[None]:
    """Inside, a position that is not finite raises RuntimeError naming step, sweep, color, vertex and scene.

    Off (the default) it costs nothing. On CUDA the CPU repeats each step to find out, and values that a step cannot
    work with raise only here, because looking at them waits for the device. It holds for the thread or task that is
    inside, and for the backward of what ran there; a step under torch.compile checks while any thread is inside.
    """
    with scopes.checks(enabled):
        yield


def looks_at(value: Tensor) -> bool:
    """Whether values may be looked at now. On CUDA that waits for the device; compiled and transformed ones cannot."""
    if torch.compiler.is_compiling():
        return False
    transformed = torch._C._functorch.peek_interpreter_stack()  # pyright: ignore[reportAttributeAccessIssue]
    return transformed is None and (checking() or not value.is_cuda)


def check_on_cpu(model: Model, tensors: Sequence[Any], settings: ops.SweepSettings, index: int) -> None:
    """The CPU repeats a step and names what is wrong with it."""
    twin = model._on_cpu()
    settings = settings._replace(sizes=twin._sizes, launch=())
    with torch.no_grad():
        here: list[Any] = [t if t is None else t.detach().cpu() for t in tensors]
        repeated: Any = sweep
        repeated(*here, twin._packed_rest, twin._plan, settings, tape_policy=ops.NO_TAPE, debug_step=index)
