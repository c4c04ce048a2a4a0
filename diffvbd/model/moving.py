"""The connected bodies that move, as what decides by their potentials takes them."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from .._common.context import replaced
from .bodies import connected
from .coarse import ROW, in_blocks
from .material import rest_metric


class MovingBodies(NamedTuple):
    """The connected bodies that have a vertex to move, with their tets in blocks of 8; constants of a Model."""

    order: Tensor  # int32 [active], vertices that move, by body
    ptr: Tensor  # int32 [bodies + 1]
    of: Tensor  # int64 [V], the body of a vertex that moves; `number` of the others
    tet: Tensor  # int64 [blocks, 8], any at padding
    corner: Tensor  # int32 [blocks, 4, 8], four times a vertex; at padding one vertex of the block four times
    block_ptr: Tensor  # int32 [bodies + 1]
    rest: Tensor  # [1, blocks, 7, 8], of the Model's own rest shape and dtype

    @property
    def number(self) -> int:
        return self.ptr.shape[0] - 1

    def to(self, device: torch.device, dtype: torch.dtype) -> MovingBodies:
        placed = MovingBodies(*(t.to(device) for t in self))
        return replaced(placed, rest=placed.rest.to(dtype))


class MovingVertices(NamedTuple):
    """The vertices that move, by connected body, in the order of the bodies' first vertices; on the CPU."""

    order: Tensor  # int64 [active]
    ptr: Tensor  # int64 [bodies + 1]
    of: Tensor  # int64 [V], the body of each; `number of bodies` where a vertex does not move
    body: Tensor  # int64 [V], the body, also of vertices that do not move; -1 where none moves


def moving_vertices(tets: Tensor, pinned: Tensor) -> MovingVertices:
    """tets int64 [T, 4], pinned bool [V], on the CPU."""
    label = connected(tets, len(pinned))
    roots, of_active = torch.unique(label[~pinned], return_inverse=True)
    count = len(roots)
    of = torch.full((len(pinned),), count).masked_scatter_(~pinned, of_active)
    order = torch.argsort(of, stable=True)[: len(of_active)]
    ptr = torch.cat([of.new_zeros(1), torch.bincount(of_active, minlength=count).cumsum(0)])
    body = torch.full((len(pinned),), -1).index_copy_(0, roots, torch.arange(count))[label]
    return MovingVertices(order, ptr, of, body)


def moving_bodies(points: Tensor, tets: Tensor, pinned: Tensor, elastic: bool) -> MovingBodies:
    """points [V, 3] float64, tets int64 [T, 4], pinned bool [V], on the CPU; elastic: whether tets have energy."""
    order, ptr, of, body = moving_vertices(tets, pinned)
    count = len(ptr) - 1
    of_tet = body[tets[:, 0]] if elastic else torch.full((len(tets),), -1)
    listed = torch.argsort(of_tet, stable=True)[int((of_tet < 0).sum()) :]
    numbers = torch.bincount(of_tet[listed], minlength=count)
    blocks, block_ptr = (torch.from_numpy(a) for a in in_blocks(listed.numpy(), numbers.numpy()))
    tet = blocks.clamp(min=0)
    corner = torch.where(blocks[..., None] >= 0, tets[tet], tets[tet[:, :1]][..., :1]) if len(tet) else tets.new_empty(
        (0, blocks.shape[1], 4))  # fmt: skip
    rest = rest_metric(points[tets][None])[0][0] if len(tets) else points.new_empty((0, 7))
    return MovingBodies(order.int(), ptr.int(), of, tet, (ROW * corner).transpose(1, 2).contiguous().int(),
                        block_ptr.int(), rest[tet].transpose(1, 2)[None].contiguous())  # fmt: skip
