"""Constants: tensors that outlive the call, whatever modes of torch it is made in."""

from __future__ import annotations

import contextlib
import copy
import dataclasses
from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor


@contextlib.contextmanager
def lasting_tensors() -> Iterator[None]:
    """Inside (or in a function that it decorates) tensors are made on the CPU unless a device is named, without a
    graph, and as ordinary ones: those of torch.inference_mode() could never take part in a backward."""
    with torch.inference_mode(False), torch.no_grad(), torch.device("cpu"):
        yield


def lasting(value: Any) -> Any:
    """``value`` with ordinary tensors in place of those of torch.inference_mode(), in tuples, dicts and dataclasses
    too."""
    if isinstance(value, Tensor):
        return value.clone() if value.is_inference() else value
    if isinstance(value, dict):
        return {key: lasting(each) for key, each in value.items()}
    if type(value) in (tuple, list):
        return type(value)(lasting(each) for each in value)
    if isinstance(value, tuple) and hasattr(value, "_fields"):  # a NamedTuple
        return type(value)(*(lasting(each) for each in value))
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        kept = {f.name: getattr(value, f.name) for f in dataclasses.fields(value)}
        made = {name: lasting(each) for name, each in kept.items()}
        if any(made[name] is not kept[name] for name in kept):
            out = copy.copy(value)
            out.__dict__.update(made)  # as it is: its own checks have passed
            return out
    return value
