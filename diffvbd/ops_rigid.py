"""The compiled operators of the rigid correction, in the form of ops.py."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from . import ops
from .energies import VERTEX_ENERGIES

LARGEST = (64, 16384)  # vertices of a body that a part of a warp, and a block, of a CUDA device work on


class Bodies(NamedTuple):
    """The bodies that are corrected: connected, with no pinned vertex. Smallest first."""

    order: Tensor  # int32 [listed], their vertices
    ptr: Tensor  # int32 [bodies + 1]
    spread: Tensor  # float64 [bodies], squared radius of gyration at rest [m^2]
    groups: tuple[int, int, int]  # how many are small, medium and large, by LARGEST
    member: Tensor  # int64 [V], the body of each vertex; of the others the number of bodies

    @property
    def number(self) -> int:
        return self.ptr.shape[0] - 1

    def to(self, device: torch.device) -> Bodies:
        order, ptr, spread, groups, member = self
        return Bodies(order.to(device), ptr.to(device), spread.to(device), groups, member.to(device))

    @property
    def arguments(self) -> tuple[Tensor, Tensor, Tensor, tuple[int, int, int]]:
        """What the operators take."""
        return self[:4]


def find_bodies(points: Tensor, tets: Tensor, pinned: Tensor) -> Bodies:
    """Connected sets of tets without a pinned vertex; points [V, 3], tets int64 [T, 4], pinned bool [V], on the CPU."""
    count = points.shape[0]
    label = torch.arange(count)
    while True:  # every vertex takes the lowest label of its tets, and that label's own: paths halve each time
        low = label[tets].amin(1) if len(tets) else label[:0]
        new = label.scatter_reduce(0, tets.reshape(-1), low.repeat_interleave(4), "amin")
        new = new[new]
        if torch.equal(new, label):
            break
        label = new
    held = torch.zeros(count, dtype=torch.bool).index_fill_(0, label[pinned], True)
    loose = torch.ones(count, dtype=torch.bool)
    loose[tets.reshape(-1)] = False  # isolated vertices are pinned, but for those that no tet has
    listed = (~held[label] & ~loose).nonzero().reshape(-1)
    roots, of_body, size = torch.unique(label[listed], return_inverse=True, return_counts=True)
    rank = torch.argsort(size, stable=True)
    place = torch.empty_like(rank).index_copy_(0, rank, torch.arange(len(roots)))
    of_body, size = place[of_body], size[rank]
    order = listed[torch.argsort(of_body, stable=True)]
    of_body = torch.sort(of_body, stable=True).values
    ptr = torch.cat([size.new_zeros(1), size.cumsum(0)])
    center = points.new_zeros((len(size), 3)).index_add_(0, of_body, points[order]) / size[:, None]
    square = (points[order] - center[of_body]).square().sum(-1)
    spread = points.new_zeros(len(size)).index_add_(0, of_body, square) / size
    small, medium = (int((size <= largest).sum()) for largest in LARGEST)
    member = torch.full((count,), len(size)).index_copy_(0, order, of_body)
    return Bodies(order.int(), ptr.int(), spread.double(), (small, medium - small, len(size) - medium), member)


def correct(x: Tensor, x_prev: Tensor, y: Tensor, mass: Tensor, data: Tensor, origin: Tensor, bodies: tuple,
            data_count: Sequence[int], time_step: float) -> Tensor:  # fmt: skip
    """Positions after the correction of every listed body [B, V, 3]; bodies: Bodies.arguments, the others as in
    csrc/ops.cpp."""
    return ops.raw.rigid(x, x_prev, y, mass, data, origin, *bodies, data_count, time_step)


def correct_backward(x_bar: Tensor, x: Tensor, x_prev: Tensor, y: Tensor, mass: Tensor, data: Tensor, origin: Tensor,
                     bodies: tuple, data_count: Sequence[int], time_step: float, wants_data: bool
                     ) -> tuple[Tensor, ...]:  # fmt: skip
    """Adjoints of x, x_prev (empty without data), y, mass, the data of scenes by body and of vertices."""
    return ops.raw.rigid_backward(x_bar, x, x_prev, y, mass, data, origin, *bodies, data_count, time_step, wants_data)


def _scalars_of_data(data_count: Sequence[int]) -> tuple[int, int]:
    """Scalars of energy data that a scene has, and that each vertex has."""
    counts = list(zip(VERTEX_ENERGIES, data_count, strict=True))
    return sum(n for e, n in counts if not e.per_vertex), sum(n for e, n in counts if e.per_vertex)


def join_data(shared: Tensor, own: Tensor, data_count: Sequence[int]) -> Tensor:
    """Adjoints by body [B, bodies, scalars of a scene] and by vertex [B, V, scalars of a vertex] -> of data [B, n]."""
    total = ops.sum_to(shared, (shared.shape[0], 1, shared.shape[2]))[:, 0]
    parts, at = [], {False: 0, True: 0}
    for energy, count in zip(VERTEX_ENERGIES, data_count, strict=True):
        rows, start = (own if energy.per_vertex else total), at[energy.per_vertex]
        parts.append(rows[..., start : start + count].flatten(1))
        at[energy.per_vertex] += count
    return torch.cat(parts, -1)


@torch.library.register_fake("diffvbd::rigid")
def _(x, x_prev, y, mass, energy_data, origin, order, ptr, spread, groups, data_count, time_step):
    return torch.empty_like(x)


@torch.library.register_fake("diffvbd::rigid_backward")
def _(x_bar, x, x_prev, y, mass, energy_data, origin, order, ptr, spread, groups, data_count, time_step, wants_data):
    b, v = x.shape[:2]
    shared, own = _scalars_of_data(data_count)
    x_prev_bar = torch.empty_like(x) if energy_data.numel() else x.new_empty((0,))
    return (torch.empty_like(x), x_prev_bar, torch.empty_like(x), x.new_empty((b, v)),
            x.new_empty((b, spread.shape[0] if wants_data else 0, shared)),
            x.new_empty((b, v if wants_data else 0, own)))  # fmt: skip


for _name in ("rigid", "rigid_backward"):
    torch.library.register_autograd(f"diffvbd::{_name}", ops.raw_backward)
