"""The compiled operators of the beginning of a step, as in sweep.py."""

from __future__ import annotations

import torch

from .fields import BeginFields
from .functions import raw_backward, shapes_of
from .rigid import scalars_of_data

STARTS = {"inertia": 0, "predictor": 1, "auto": 2}  # twins of From in csrc/start/begin.h


_FIELDS = len(BeginFields._fields)


@shapes_of("begin")
def _(*arguments):
    f = BeginFields(*arguments[:_FIELDS])
    *_, start, _, parts = arguments[_FIELDS:]

    def decisions(made, ptr):
        return f.x.new_empty((f.x.shape[0] if made else 0, ptr.shape[0] - 1), dtype=torch.uint8)

    falls, alone = decisions(start == STARTS["auto"], f.other_ptr), decisions(parts, f.ptr)
    return torch.empty_like(f.x), torch.empty_like(f.x), falls, alone


@shapes_of("begin_backward")
def _(*arguments):
    f = BeginFields(*arguments[:_FIELDS])
    _, _, _, _, _, data_count, _, _, _, _, filters, wants = arguments[_FIELDS:]
    x, (b, v) = f.x, f.x.shape[:2]
    shared, own = scalars_of_data(data_count)

    def wanted(flag, *shape):
        return x.new_empty(shape if flag else (0,))

    bodies, rows = (f.spread.shape[0], v) if wants[2] else (0, 0)
    return (torch.empty_like(x), torch.empty_like(x), wanted(wants[0], *x.shape), wanted(wants[1], *x.shape),
            x.new_empty((b, v)), x.new_empty((b, bodies, shared)), x.new_empty((b, rows, own)),
            x.new_empty((b, rows if filters else 0, data_count[0])))  # fmt: skip


for _name in ("begin", "begin_backward"):
    torch.library.register_autograd(f"diffvbd::{_name}", raw_backward)
