"""The compiled operators of the beginning of a step, as in sweep.py."""

from __future__ import annotations

import torch

from .functions import raw_backward
from .rigid import scalars_of_data

STARTS = {"inertia": 0, "predictor": 1, "auto": 2}  # twins of From in csrc/start/begin.h


@torch.library.register_fake("diffvbd::begin")
def _(x, v, acceleration, held, mass, energy_data, origin, mu, lam, rest, pinned, order, ptr, spread, groups, other,
      other_order, other_ptr, other_tets, other_tet_ptr, other_groups, data_count, time_step, filter_eta, start,
      filters):  # fmt: skip
    scenes = x.shape[0] if start == STARTS["auto"] else 0
    return torch.empty_like(x), torch.empty_like(x), x.new_empty((scenes, other_ptr.shape[0] - 1), dtype=torch.uint8)


@torch.library.register_fake("diffvbd::begin_backward")
def _(x_start_bar, y_bar, falls, x, v, acceleration, held, mass, energy_data, origin, pinned, order, ptr, spread,
      groups, other, others, data_count, time_step, filter_eta, start, filters, wants):  # fmt: skip
    b, vertices = x.shape[:2]
    shared, own = scalars_of_data(data_count)

    def wanted(flag, *shape):
        return x.new_empty(shape if flag else (0,))

    bodies, rows = (spread.shape[0], vertices) if wants[2] else (0, 0)
    return (torch.empty_like(x), torch.empty_like(x), wanted(wants[0], *x.shape), wanted(wants[1], *x.shape),
            x.new_empty((b, vertices)), x.new_empty((b, bodies, shared)), x.new_empty((b, rows, own)),
            x.new_empty((b, rows if filters else 0, data_count[0])))  # fmt: skip


for _name in ("begin", "begin_backward"):
    torch.library.register_autograd(f"diffvbd::{_name}", raw_backward)
