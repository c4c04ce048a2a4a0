"""What a step leaves, numbers and bytes, and equality of two results to the bit."""

from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor

import diffvbd as dv
from diffvbd.testing import evaluate

TAPES = ("full", "compact", "recompute")


def evaluated(model: dv.Model, inputs: dict[str, Any], solver: dv.VBD) -> dict[str, Tensor]:
    """State and gradients of one step, by `testing.evaluate`."""
    return evaluate(lambda **given: dv.step(model, solver=solver, **given), inputs, solver.time_step)


def assert_same_bits(a: dict[str, Tensor], b: dict[str, Tensor]) -> None:
    assert a.keys() == b.keys()
    for name in a:
        assert a[name].any(), f"{name} vanishes"
        assert torch.equal(a[name], b[name]), name


def saved_bytes(run: Callable[[], Any], given: Iterable[Tensor] = ()) -> int:
    """Bytes of the distinct storages that autograd saves in run(), without those of the given tensors."""
    storages: dict[int, int] = {}
    kept = []

    def pack(t: Tensor) -> Tensor:
        kept.append(t)  # alive, so that no address is used twice
        storages[t.untyped_storage().data_ptr()] = t.untyped_storage().nbytes()
        return t

    with torch.autograd.graph.saved_tensors_hooks(pack, lambda t: t):
        kept.append(run())
    for t in given:
        storages.pop(t.untyped_storage().data_ptr(), None)
    return sum(storages.values())
