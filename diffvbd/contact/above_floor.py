"""Displacements of whole bodies as floors limit them, differentiable."""

from __future__ import annotations

from torch import Tensor

from ..ops.contact import ways_above_floor


def above_floor(x: Tensor, u: Tensor, way: Tensor, planes: Tensor, origin: Tensor, held: Tensor, order: Tensor,
                ptr: Tensor) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Displacements of whole bodies as a floor limits them, less u [B, V, 3] [m], and which bodies it stops [B,
    bodies]: they are shifted along its normals until no vertex closes more than a part of its gap, which leaves sliding
    and turning as they are. Differentiable, evenly where several vertices decide. docs/method.md, section 12.

    Args:
        x, way: [B, V, 3] [m].  u: [B, bodies, 3] [m], part of the way, which the floor lets pass; or empty.
        planes: Data of a FloorBarrier [1 | B, 7 planes], or empty.  origin: [B, V, 3] [m] or empty.
        held: [V] bool, whether something else moves a vertex.
        order, ptr: Vertices by body [V], and the first of each [bodies + 1], int32.
    """
    return ways_above_floor(x.contiguous(), u, way.contiguous(), planes.contiguous(), origin, held, order, ptr)
