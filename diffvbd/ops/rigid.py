"""Shapes of the compiled operators of the rigid correction, and how adjoints of its data are joined."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ..energies import VERTEX_ENERGIES
from .fields import RigidFields
from .functions import raw_backward, shapes_of
from .sums import sum_to


def scalars_of_data(data_count: Sequence[int]) -> tuple[int, int]:
    """Scalars of energy data that a scene has, and that each vertex has."""
    counts = list(zip(VERTEX_ENERGIES, data_count, strict=True))
    return sum(n for e, n in counts if not e.per_vertex), sum(n for e, n in counts if e.per_vertex)


def join_data(shared: Tensor, own: Tensor, data_count: Sequence[int]) -> Tensor:
    """Adjoints by body [B, bodies, scalars of a scene] and by vertex [B, V, scalars of a vertex] -> of data [B, n]."""
    total = sum_to(shared, (shared.shape[0], 1, shared.shape[2]))[:, 0]
    parts, at = [], {False: 0, True: 0}
    for energy, count in zip(VERTEX_ENERGIES, data_count, strict=True):
        rows, start = (own if energy.per_vertex else total), at[energy.per_vertex]
        part = rows.narrow(-1, start, count)  # not rows[...] nor flatten(), which is_grads_batched cannot do
        parts.append(part.reshape(part.shape[0], -1) if energy.per_vertex else part)
        at[energy.per_vertex] += count
    return torch.cat(parts, -1)


_FIELDS = len(RigidFields._fields)


@shapes_of("rigid")
def _(*arguments):
    return torch.empty_like(arguments[0]), torch.empty_like(arguments[0])


@shapes_of("rigid_backward")
def _(*arguments):
    f = RigidFields(*arguments[:_FIELDS])
    _, v_bar, _, data_count, _, wants_data = arguments[_FIELDS:]
    x, (b, v) = f.x, f.x.shape[:2]
    shared, own = scalars_of_data(data_count)
    x_prev_bar = torch.empty_like(x) if f.energy_data.numel() or v_bar.numel() else x.new_empty((0,))
    return (torch.empty_like(x), x_prev_bar, torch.empty_like(x), x.new_empty((b, v)),
            x.new_empty((b, f.spread.shape[0] if wants_data else 0, shared)),
            x.new_empty((b, v if wants_data else 0, own)))  # fmt: skip


for _name in ("rigid", "rigid_backward"):
    torch.library.register_autograd(f"diffvbd::{_name}", raw_backward)
