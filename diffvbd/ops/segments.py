"""Sums of rows by an index, with the same bits on every run and device."""

# pyright: reportIncompatibleMethodOverride=false
from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd import Function

from . import detect as ops_contact
from .functions import ready_signature

Order = tuple[Tensor, Tensor, Tensor]  # of rows by segment: order, ptr (int32) and the segment of each row


class _SumBy(Function):
    @staticmethod
    def forward(values: Tensor, index: Tensor, count: int) -> Tensor:
        if not values.is_cuda:  # there they are added one after another
            return values.new_zeros((count, values.shape[1])).index_add_(0, index, values)
        ordered, order = torch.sort(index, stable=True)
        ptr = torch.searchsorted(ordered, torch.arange(count + 1, device=index.device))
        rows = values.contiguous()[None]
        return ops_contact.segment_sum(rows, order.to(torch.int32), ptr.to(torch.int32))[0]

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: Tensor) -> None:
        _, ctx.index, _ = inputs

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple:
        return grads[0][ctx.index], None, None


def sum_by(values: Tensor, index: Tensor, count: int) -> Tensor:
    """Rows of ``values`` [n, ...] added up by ``index`` [n], [count, ...]; differentiable in the values."""
    if values.numel() == 0 or count == 0:
        return values.new_zeros((count, *values.shape[1:]))
    flat = values.reshape(values.shape[0], -1)
    return _SumBy.apply(flat, index, count).reshape(count, *values.shape[1:])


class _SumSegments(Function):
    @staticmethod
    def forward(values: Tensor, order: Tensor, ptr: Tensor, index: Tensor) -> Tensor:
        return ops_contact.segment_sum(values.contiguous(), order, ptr)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: Tensor) -> None:
        ctx.index = inputs[3]

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple:
        return grads[0][:, ctx.index], None, None, None


def sum_segments(values: Tensor, order: Tensor, ptr: Tensor, index: Tensor) -> Tensor:
    """Sums of rows of ``values`` [B, V, n] by ``index`` [V], whose order is known: order, ptr int32. Differentiable in
    the values; [B, segments, n]."""
    return _SumSegments.apply(values, order, ptr, index)


class _OfSegments(Function):
    @staticmethod
    def forward(values: Tensor, order: Tensor, ptr: Tensor, index: Tensor) -> Tensor:
        return values.index_select(1, index)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: Tensor) -> None:
        _, ctx.order, ctx.ptr, ctx.index = inputs

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple:
        return sum_segments(grads[0], ctx.order, ctx.ptr, ctx.index), None, None, None


def of_segments(values: Tensor, order: Tensor, ptr: Tensor, index: Tensor) -> Tensor:
    """``values`` [B, segments, n] of the segment of each row, [B, V, n]; arguments and order of sums as above."""
    return _OfSegments.apply(values, order, ptr, index)


ready_signature(_SumBy, _SumSegments, _OfSegments)
