"""Sums over stars, segments and indices, with the same bits on every run and device."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from .autograd import Linear, direct, sum_to
from .load import raw


@contextlib.contextmanager
def one_thread(like: Tensor) -> Iterator[None]:
    """On the CPU, dense algebra of torch in one thread: MKL splits products and factors by their number. Code that
    torch.compile makes runs as it is."""
    threads = 1 if like.is_cuda or torch.compiler.is_compiling() else torch.get_num_threads()
    if threads == 1:
        yield
        return
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


_broadcast = Linear(lambda tensor, shape: tensor.expand(shape).contiguous(),
                    lambda bar, shape, _: sum_to(bar, shape), 2,
                    lambda info, tensor, shape: _broadcast(tensor, (info.batch_size, *shape)))  # fmt: skip


def broadcast(tensor: Tensor, shape: Sequence[int]) -> Tensor:
    """Broadcasts like torch.expand; the gradient of the expanded dimensions is summed in a fixed order."""
    shape = tuple(shape)
    if tuple(tensor.shape) == shape:
        return tensor
    if not tensor.requires_grad:
        return tensor.expand(shape)
    return _broadcast(tensor.reshape((1,) * (len(shape) - tensor.dim()) + tuple(tensor.shape)), shape)


def _folded(function: Linear, values: Tensor, *mesh: Any) -> Tensor:
    return function(values.flatten(0, 1), *mesh).unflatten(0, values.shape[:2])


_tet_gather = Linear(lambda values, tets, star_ptr, star: raw.tet_gather(values.contiguous(), tets),
                     lambda bar, _, *mesh: _star_sum(bar, *mesh, False), 4,
                     lambda info, *args: _folded(_tet_gather, *args))  # fmt: skip
_star_sum = Linear(lambda values, tets, star_ptr, star, positive: raw.star_sum(values.contiguous(), star_ptr, star,
                                                                               positive),
                   lambda bar, _, tets, star_ptr, star, positive: _tet_gather(bar, tets, star_ptr, star), 5,
                   lambda info, *args: _folded(_star_sum, *args))  # fmt: skip


def tet_gather(values: Tensor, tets: Tensor, star_ptr: Tensor, star: Tensor) -> Tensor:
    """Vertex values [B, V, C] -> values of the tets' corners [B, T, 4, C]; its adjoint is star_sum."""
    return _tet_gather(values, tets, star_ptr, star)


def star_sum(values: Tensor, tets: Tensor, star_ptr: Tensor, star: Tensor, *, positive: bool = False) -> Tensor:
    """Corner values [B, T, 4, C] -> sums over the tets of each vertex [B, V, C], in the order of the tets.

    With ``positive`` the values are masses: one that is not finite and > 0 raises ValueError.
    """
    return _star_sum(values, tets, star_ptr, star, positive)


def segment_sum(values: Tensor, order: Tensor, ptr: Tensor) -> Tensor:
    """[B, V, C] -> [B, S, C]: sums of ``values[:, order[ptr[s] : ptr[s + 1]]]``, in an order that shapes alone decide.

    Args:
        values: [B, V, C], float64 or float32.
        order, ptr: Rows of ``values``, segment by segment, and the first of each segment [S + 1].

    Raises:
        ValueError: A tensor with the wrong shape, dtype or device.
    """
    return direct.segment_sum(values, order, ptr)


def sum_by(values: Tensor, index: Tensor, count: int) -> Tensor:
    """Rows of ``values`` [n, ...] added up by ``index`` [n], [count, ...]. Not differentiable."""
    out = values.new_zeros((count, *values.shape[1:]))
    if not values.is_cuda or values.numel() == 0:  # on the CPU they are added one after another
        return out.index_add_(0, index, values)
    ordered, order = torch.sort(index, stable=True)
    ptr = torch.searchsorted(ordered, torch.arange(count + 1, device=index.device))
    rows = values.reshape(1, len(values), -1).contiguous()
    return segment_sum(rows, order.to(torch.int32), ptr.to(torch.int32))[0].reshape(out.shape)


class Rows(NamedTuple):
    """Rows of values, each of which belongs to one group; sums and gathers in a fixed order."""

    group: Tensor  # of each row, [rows / 4, 4]: filled up with 0, because the operators work on corners of tets
    ptr: Tensor  # [groups + 1]
    entry: Tensor  # [rows]: those of each group, ascending
    rows: int

    @classmethod
    def of(cls, group: Tensor, groups: int) -> Rows:
        """group [rows] int64; rows of group ``groups`` belong to none."""
        key, order = torch.sort(group.to(torch.int32), stable=True)
        ptr = torch.searchsorted(key, torch.arange(groups + 1, dtype=torch.int32, device=group.device))
        filled = pad(torch.where(group < groups, group, 0), (0, -group.shape[0] % 4))
        return cls(filled.reshape(-1, 4), ptr, order.to(torch.int32), group.shape[0])

    def to(self, device: torch.device) -> Rows:
        """A copy on a device."""
        return Rows(self.group.to(device), self.ptr.to(device), self.entry.to(device), self.rows)

    def gather(self, values: Tensor) -> Tensor:
        """Values of the groups [B, groups, C] -> of their rows [B, rows, C]; rows of no group get some group's."""
        return tet_gather(values, self.group, self.ptr, self.entry).flatten(1, 2)[:, : self.rows]

    def sum(self, values: Tensor) -> Tensor:
        """Values of rows [B, rows, C] -> sums of the groups [B, groups, C]."""
        corners = pad(values, (0, 0, 0, 4 * self.group.shape[0] - self.rows)).unflatten(1, (-1, 4))
        return star_sum(corners, self.group, self.ptr, self.entry)
