"""Scenes and bodies split over the ranks of torch.distributed: ``diffvbd.distributed``.

torchrun starts the processes and torch moves the data. Here is only what makes bits independent of the number of ranks:
nothing is summed across ranks but in an order that the split has no say in. Without a process group there is one rank.
"""

# pyright: reportIncompatibleMethodOverride=false
from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor
from torch.autograd import Function
from torch.nn.functional import pad

from ._common.checks import check_count, fail

if dist.is_available():
    # The first step of an optimiser imports this. Its defaults then keep the process group alive beyond
    # destroy_process_group, and a program over gloo may abort as it ends. Imported before there is a group, they do
    # not.
    import torch.distributed.nn

__all__ = ["backward", "gathered", "own", "share"]


def share(count: int) -> slice:
    """Rows of ``count`` (scenes, bodies) that belong to this rank: as many as to the others, or one more or less.

    Raises:
        TypeError, ValueError: fewer rows than ranks; no integer.
    """
    count = check_count("count", count)
    if count < _ranks():
        fail("count", f"at least one row for each of {_ranks()} ranks", count)
    return _share(count, _rank())


def own(values: Tensor) -> Tensor:
    """The rows of this rank of a tensor that all ranks have alike.

    The gradient is that of all rows: every rank gets all of it. With `gathered` after it, each rank works on its rows
    and all go on with the same numbers and the same gradient. Whatever a rank's work depends on has to come through
    here if it needs a gradient, one number for all rows as ``own(number.expand(N))``: used as it is, it would get the
    gradient of this rank's rows alone.

    Args:
        values: Shape [N, ...], the same on every rank.

    Returns:
        ``values[share(N)]``.

    Raises:
        ValueError: fewer rows than ranks.
    """
    count = _rows(values)
    share(count)
    return values if _ranks() == 1 else _Own.apply(values)


def gathered(values: Tensor, count: int) -> Tensor:
    """The rows of all ranks, in their order, on every rank.

    What follows must be the same computation on every rank, as that of one loss from all rows: then the gradient of a
    rank's rows is what the rank itself has found for them, and nothing is summed. All ranks have to call it, and to
    call ``backward`` if one does.

    Args:
        values: The rows of this rank, shape [n, ...] with n those of `share`.
        count: Rows N of all ranks together.

    Returns:
        Shape [N, ...].

    Raises:
        ValueError: another number of rows than this rank has of ``count``; fewer rows than ranks.
    """
    part = share(count)
    if _rows(values) != part.stop - part.start:
        fail("values", f"{part.stop - part.start} rows, this rank's of {count}", f"shape {list(values.shape)}")
    return values if _ranks() == 1 else _Gathered.apply(values, count)


def backward(loss: Callable[[slice], Tensor], parameters: Iterable[Tensor], scenes: int, parts: int = 8) -> Tensor:
    """The gradient of a loss over all scenes, added to ``.grad`` of the parameters, with the same bits on any number of
    ranks.

    The scenes are cut into parts, and the parts are dealt to the ranks. A part is evaluated in one go wherever it is,
    so whatever depends on the size of a batch depends on ``parts`` alone: how steps are spread over a CUDA device, how
    often a step looks for contact, sums over scenes in the loss, products of matrices in a network. Gradients of the
    parts are gathered and added in the order of the parts.

    Args:
        loss: Given a slice of the scenes, the share that they have in the loss: a scalar. The loss is the sum of the
            shares of all parts, so a mean has to be divided by ``scenes``.
        parameters: Leaves of any shape that the loss of each part depends on; the same values on every rank.
        scenes: Number of scenes.
        parts: Number of parts, at least that of the ranks and at most that of the scenes. Few make large batches, many
            can be dealt to many ranks; a multiple of the number of ranks deals evenly. Bits depend on it.

    Returns:
        The loss, a scalar, the same on every rank.

    Memory: each rank holds ``parts`` gradients. For networks of very many parameters take DistributedDataParallel,
    whose bits depend on the number of ranks.

    Raises:
        TypeError, ValueError: naming the argument; a loss that is no scalar, or does not depend on a parameter.
    """
    leaves = list(parameters)
    if not leaves or not all(isinstance(p, Tensor) and p.is_leaf and p.requires_grad for p in leaves):
        raise TypeError("parameters: expected leaf tensors that require grad, at least one")
    scenes, parts = check_count("scenes", scenes), check_count("parts", parts)
    if not _ranks() <= parts <= scenes:
        fail("parts", f"from {_ranks()}, one for each rank, to {scenes}, one for each scene", parts)
    rows = []
    for k in range(parts)[share(parts)]:
        value = loss(slice(k * scenes // parts, (k + 1) * scenes // parts))
        if not isinstance(value, Tensor) or value.dim() != 0:
            shape = f"shape {list(value.shape)}" if isinstance(value, Tensor) else type(value).__name__
            fail("loss", "a scalar tensor", shape)
        grads = torch.autograd.grad(value, leaves, allow_unused=True)
        if lost := [k for k, grad in enumerate(grads) if grad is None]:
            fail("loss", "one that depends on every parameter", f"one that does not depend on parameters {lost}")
        rows.append((value.detach(), *grads))
    total, *sums = (_in_order(gathered(torch.stack(column), parts)) for column in zip(*rows, strict=True))
    for leaf, grad in zip(leaves, sums, strict=True):
        leaf.grad = grad if leaf.grad is None else leaf.grad + grad
    return total


def _in_order(rows: Tensor) -> Tensor:
    """The sum of rows, the first first."""
    total = rows[0].clone()
    for row in rows[1:]:
        total += row
    return total


def _ranks() -> int:
    return dist.get_world_size() if dist.is_available() and dist.is_initialized() else 1


def _rank() -> int:
    return dist.get_rank() if _ranks() > 1 else 0


def _share(count: int, rank: int) -> slice:
    ranks = _ranks()
    return slice(rank * count // ranks, (rank + 1) * count // ranks)


def _rows(values: Any) -> int:
    if not isinstance(values, Tensor):
        raise TypeError(f"values: expected a tensor, got {type(values).__name__}")
    if values.dim() == 0:
        fail("values", "shape [N, ...]", "a scalar")
    return values.shape[0]


# torch 2.13 has another name for it
_gather: Any = getattr(dist, "all_gather_single", getattr(dist, "all_gather_into_tensor", None))


class _Gathered(Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor, count: int) -> Tensor:
        ctx.count = count
        sizes = [part.stop - part.start for part in (_share(count, rank) for rank in range(_ranks()))]
        most = max(sizes)  # all send as many rows
        filled = values if values.shape[0] == most else pad(values, (0, 0) * (values.dim() - 1) + (0, 1))
        found = values.new_empty((len(sizes) * most, *values.shape[1:]))
        _gather(found, filled.contiguous())
        if min(sizes) == most:
            return found
        return torch.cat([rows[:size] for rows, size in zip(found.split(most), sizes, strict=True)])

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple:
        return _Own.apply(grads[0]), None


class _Own(Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor) -> Tensor:
        ctx.count = values.shape[0]
        return values[_share(ctx.count, _rank())].clone()

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Tensor:
        return _Gathered.apply(grads[0], ctx.count)
