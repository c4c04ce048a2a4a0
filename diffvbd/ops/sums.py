"""Sums and gathers over tets, stars and rows as autograd functions, each in an order that depends on shapes alone."""

# pyright: reportIncompatibleMethodOverride=false
from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.autograd import Function

from .functions import raw_backward, ready_signature, shapes_of
from .load import raw


@shapes_of("tet_gather")
def _(values, tets):
    return values.new_empty((values.shape[0], tets.shape[0], 4, values.shape[2]))


@shapes_of("star_sum")
def _(values, star_ptr, star, positive):
    return values.new_empty((values.shape[0], star_ptr.shape[0] - 1, values.shape[3]))


@shapes_of("row_sum")
def _(values):
    return values.new_empty((values.shape[0],))


for _name in ("tet_gather", "star_sum", "row_sum"):
    torch.library.register_autograd(f"diffvbd::{_name}", raw_backward)


@contextlib.contextmanager
def one_thread(like: Tensor) -> Iterator[None]:
    """On the CPU, dense algebra of torch in one thread: MKL splits products and factors by their number."""
    threads = torch.get_num_threads()
    if like.is_cuda or threads == 1:
        yield
        return
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


class _RowSum(Function):
    """[rows, columns] -> [rows], summed in an order that depends on nothing but the shape."""

    @staticmethod
    def forward(values: Tensor) -> Tensor:
        return raw.row_sum(values.contiguous())

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: Tensor) -> None:
        ctx.columns = inputs[0].shape[1]

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Tensor:
        return grads[0][:, None].expand(-1, ctx.columns)

    @staticmethod
    def vmap(info: Any, in_dims: tuple, values: Tensor) -> tuple[Tensor, int]:
        values = values.movedim(in_dims[0], 0)
        return _RowSum.apply(values.flatten(0, 1)).unflatten(0, values.shape[:2]), 0


def sum_to(tensor: Tensor, shape: Sequence[int]) -> Tensor:
    """Sums the dimensions in which ``shape`` has 1 (same number of dimensions), in a fixed order."""
    reduced = [d for d, n in enumerate(shape) if n == 1 and tensor.shape[d] != 1]
    if not reduced:
        return tensor
    kept = [d for d in range(tensor.dim()) if d not in reduced]
    rows, columns = (math.prod([tensor.shape[d] for d in dims]) for dims in (kept, reduced))
    return _RowSum.apply(tensor.permute(*kept, *reduced).reshape(rows, columns)).reshape(shape)


class _Broadcast(Function):
    """expand() to a shape of as many dimensions, with a fixed-order sum in the backward."""

    @staticmethod
    def forward(tensor: Tensor, shape: tuple[int, ...]) -> Tensor:
        return tensor.expand(shape).contiguous()

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: Tensor) -> None:
        ctx.shape = tuple(inputs[0].shape)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple:
        return sum_to(grads[0], ctx.shape), None

    @staticmethod
    def vmap(info: Any, in_dims: tuple, tensor: Tensor, shape: tuple[int, ...]) -> tuple[Tensor, int]:
        return _Broadcast.apply(tensor.movedim(in_dims[0], 0), (info.batch_size, *shape)), 0


def broadcast(tensor: Tensor, shape: Sequence[int]) -> Tensor:
    """Broadcasts like torch.expand; the gradient of the expanded dimensions is summed in a fixed order."""
    shape = tuple(shape)
    if tuple(tensor.shape) == shape:
        return tensor
    if not tensor.requires_grad:
        return tensor.expand(shape)
    return _Broadcast.apply(tensor.reshape((1,) * (len(shape) - tensor.dim()) + tuple(tensor.shape)), shape)


class _TetGather(Function):
    @staticmethod
    def forward(values: Tensor, tets: Tensor, star_ptr: Tensor, star: Tensor) -> Tensor:
        return raw.tet_gather(values.contiguous(), tets)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: Tensor) -> None:
        ctx.mesh = inputs[1:]

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple:
        return _StarSum.apply(grads[0], *ctx.mesh, False), None, None, None

    @staticmethod
    def vmap(info: Any, in_dims: tuple, values: Tensor, *mesh: Tensor) -> tuple[Tensor, int]:
        values = values.movedim(in_dims[0], 0)
        return _TetGather.apply(values.flatten(0, 1), *mesh).unflatten(0, values.shape[:2]), 0


class _StarSum(Function):
    @staticmethod
    def forward(values: Tensor, tets: Tensor, star_ptr: Tensor, star: Tensor, positive: bool) -> Tensor:
        return raw.star_sum(values.contiguous(), star_ptr, star, positive)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: Tensor) -> None:
        ctx.mesh = inputs[1:4]

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple:
        return _TetGather.apply(grads[0], *ctx.mesh), None, None, None, None

    @staticmethod
    def vmap(info: Any, in_dims: tuple, values: Tensor, *mesh: Any) -> tuple[Tensor, int]:
        values = values.movedim(in_dims[0], 0)
        return _StarSum.apply(values.flatten(0, 1), *mesh).unflatten(0, values.shape[:2]), 0


def tet_gather(values: Tensor, tets: Tensor, star_ptr: Tensor, star: Tensor) -> Tensor:
    """Vertex values [B, V, C] -> values of the tets' corners [B, T, 4, C]; its adjoint is star_sum."""
    return _TetGather.apply(values, tets, star_ptr, star)


def star_sum(values: Tensor, tets: Tensor, star_ptr: Tensor, star: Tensor, *, positive: bool = False) -> Tensor:
    """Corner values [B, T, 4, C] -> sums over the tets of each vertex [B, V, C], in the order of the tets.

    With ``positive`` the values are masses: one that is not finite and > 0 raises ValueError.
    """
    return _StarSum.apply(values, tets, star_ptr, star, positive)


ready_signature(_RowSum, _Broadcast, _TetGather, _StarSum)
