"""What floors leave of the ways of bodies that move as wholes, differentiable."""

# pyright: reportIncompatibleMethodOverride=false
from __future__ import annotations

from typing import Any

from torch import Tensor

from .. import ops
from ..ops import Backward, Direct, contact_part, not_batched


class _AboveFloor(Direct):
    @staticmethod
    def forward(x: Tensor, u: Tensor, way: Tensor, planes: Tensor, origin: Tensor, held: Tensor, order: Tensor,
                ptr: Tensor) -> tuple[Tensor, Tensor]:  # fmt: skip
        return contact_part.above_floor(x, u, way, planes, origin, held, order, ptr)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: tuple) -> None:
        ctx.mark_non_differentiable(output[1])
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(*inputs)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor | None) -> tuple:
        bar, saved = grads[0], ctx.saved_tensors
        if bar is None:
            return (None,) * 8
        not_batched(bar)
        planes = saved[3]
        wants_planes = ctx.needs_input_grad[3] and planes.numel() > 0
        x, u, way, own = _AboveFloorBackward.apply(bar.contiguous(), *saved, wants_planes)
        return x, u if ctx.needs_input_grad[1] else None, way, of_planes(own, planes, wants_planes), *(None,) * 4


class _AboveFloorBackward(Backward):
    @staticmethod
    def forward(bar, x, u, way, planes, origin, held, order, ptr, wants_planes):
        return contact_part.above_floor_backward(bar, x, u, way, planes, origin, held, order, ptr, wants_planes)


def of_planes(own: Tensor, planes: Tensor, wanted: bool) -> Tensor | None:
    """Adjoints of planes [1 | B, 7 planes] from what each body or vertex adds, ``own`` [B, n, 7 planes]."""
    if not wanted:
        return None
    return ops.sum_to(ops.sum_to(own, (own.shape[0], 1, own.shape[2]))[:, 0], planes.shape)


def above_floor(x: Tensor, u: Tensor, way: Tensor, planes: Tensor, origin: Tensor, held: Tensor, order: Tensor,
                ptr: Tensor) -> tuple[Tensor, Tensor]:  # fmt: skip
    """What a floor leaves of ways of bodies as wholes, less u [B, V, 3] [m], and which bodies it stops [B, bodies]:
    they are shifted along its normals until no vertex closes more than a part of its gap, which leaves sliding and
    turning as they are. Differentiable, evenly where several vertices decide. docs/method.md, section 12.

    Args:
        x, way: [B, V, 3] [m].  u: [B, bodies, 3] [m], part of the way, which the floor lets pass; or empty.
        planes: Data of a FloorBarrier [1 | B, 7 planes], or empty.  origin: [B, V, 3] [m] or empty.
        held: [V] bool, whether something else moves a vertex.
        order, ptr: Vertices by body [V], and the first of each [bodies + 1], int32.
    """
    return _AboveFloor.apply(x.contiguous(), u, way.contiguous(), planes.contiguous(), origin, held, order, ptr)
