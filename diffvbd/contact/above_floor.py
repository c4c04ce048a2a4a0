"""What floors leave of the ways of bodies that move as wholes."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ..ops.segments import Order, of_segments

SHORT = 0.99  # share of a way that counts as all of it
KEPT = 0.9  # share of a gap above a floor that rigid motion may close
DEEP, KEPT_DEEP = 0.1, 0.1  # part of dhat below which that is less, because sweeps open such a gap slowly
ROUNDINGS = 8  # of the terms of a gap, below which its sign is not safe (Plane::guard in csrc/energies/floor_barrier.h)
PLANE, DHAT = 7, 5  # numbers of a plane of a FloorBarrier, and which of them is dhat


class AboveFloor(NamedTuple):
    """What a floor leaves of the way of each body as a whole: a share of it, and beside that a shift off the floor."""

    share: Tensor  # [B, bodies]; 1 but between planes that a shift does not suit
    shift: Tensor  # [B, bodies, 3] [m]
    stopped: Tensor  # [B, bodies] bool: it loses more than a hundredth of what a vertex moves toward a plane
    takes: bool = True  # False where it is known to take nothing

    def way(self, way: Tensor, of: Order) -> Tensor:
        """What is left of ways [B, V, 3] of vertices."""
        if not self.takes:
            return way
        share, shift = of_segments(torch.cat([self.share[..., None], self.shift], -1), *of).split((1, 3), -1)
        return share * way + shift


def above_floor(floor: Tensor, origin: Tensor, at: Tensor, way: Tensor, held: Tensor, of: Order, bodies: int
                ) -> AboveFloor:  # fmt: skip
    """How bodies go ways [B, V, 3] as wholes above a floor: shifted along its normals until no vertex closes more than
    a part of its gap, which leaves sliding and turning as they are. Differentiable, evenly where several vertices
    decide. docs/method.md, section 12.

    Args:
        floor: Data of a FloorBarrier [1 | B, 7 planes], or empty.  origin: [B, V, 3] or empty.  at: [B, V, 3] [m].
        held: Of each vertex [V], whether something else moves it.  of: Vertices by body, see of_segments.
    """
    body = of[2]
    scenes = at.shape[0]

    def nothing() -> AboveFloor:
        ones = at.new_ones((scenes, bodies))
        return AboveFloor(ones, at.new_zeros((scenes, bodies, 3)), ones < 1, takes=False)

    if not floor.numel():
        return nothing()
    planes = floor.reshape(floor.shape[0], 1, -1, PLANE)
    normal, p = planes[:, 0, :, :3], at + origin if origin.numel() else at
    gap, toward = p @ normal.mT - planes[..., 3], -(way @ normal.mT)  # [B, V, P]
    size = (p.abs() @ normal.abs().mT + planes[..., 3].abs()).detach()
    gap, deep = (gap - ROUNDINGS * torch.finfo(at.dtype).eps * size).clamp(min=0), DEEP * planes[..., DHAT]
    room = KEPT * (gap - deep).clamp(min=0) + KEPT_DEEP * torch.minimum(gap, deep)
    index = body[:, None].expand(gap.shape)

    def of_bodies(values: Tensor, start: float, reduction: str) -> Tensor:
        return values.new_full((scenes, bodies, values.shape[-1]), start).scatter_reduce(1, index, values, reduction)

    closes = (toward > room) & ~held[:, None]
    if not (at.is_cuda or bool(closes.any())):  # on CUDA to know would mean to wait
        return nothing()
    shift = of_bodies(torch.where(closes, toward - room, 0.0), 0.0, "amax") @ normal
    share = of_bodies(torch.where(closes, room / torch.where(closes, toward, 1.0), 1.0), 1.0, "amin").amin(-1)
    with torch.no_grad():
        left, least = toward - (shift @ normal.mT)[:, body], 8 * torch.finfo(at.dtype).eps * toward.abs()
        good = of_bodies(((left <= room + least) | held[:, None]).to(at.dtype), 1.0, "amin").amin(-1) > 0
        stopped = share < SHORT
    return AboveFloor(torch.where(good, 1.0, share), torch.where(good[..., None], shift, 0.0), stopped)
