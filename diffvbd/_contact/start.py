"""The start of a substep with contact: each free body goes a fraction of its displacement as a whole (docs/method.md,
section 12)."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from .._common.constants import FILTER_ETA
from .._contact.surface import ContactSurface
from ..ops import contact as ops_contact
from ..ops.fields import PLANE_SCALARS

SHORT = 0.99  # fraction of a displacement below which a vertex is truncated
LEAST = 6  # the smallest fraction is 2^-6, and then 0
FAR = 1e15  # [m] trust-region radius without pairs


class PartStart(NamedTuple):
    """Start of the sweeps of a substep; all but x is index data."""

    x: Tensor  # [B, V, 3] [m]
    center: Tensor  # [B, V, 3]  center of the trust region of each vertex [m]
    room: Tensor  # [B, V]  its radius [m]
    own: tuple  # center and radius of the deformation; empty where bodies have no pairs of their own
    short: Tensor  # [B, V] bool: pairs or radii have truncated the displacement
    stuck: Tensor  # [1] int64: pairs that hinder what is prescribed
    shares: Tensor  # [B, V]  fraction of its displacement that each vertex went


def start_between(x: Tensor, move: Tensor, was: Tensor, now: Tensor, planes: Tensor | None, origin: Tensor,
                  detection: Any, surface: ContactSurface, rigid: Tensor, own_pairs: bool) -> PartStart:  # fmt: skip
    """``x + u + f (move - u)``, differentiable in x and move. The fraction f is the largest of 1, 1/2, ..., 1/64 and 0
    that keeps pairs, floors and radii: one for each free body, one for each vertex of a body that is pinned.

    Args:
        x, move: [B, V, 3] [m].  was, now: Collider points before and during the sweeps, [B, Vc, 3] [m].
        planes: Data of the FloorBarrier [1 | B, 7 planes], or None.  origin: [B, V, 3] or empty.
        detection: Of the substep: pairs, islands and their translations u, radii.
        rigid: Rigid motion of each body, as a displacement [B, V, 3] [m].
        own_pairs: Whether bodies have pairs of their own, and deformation radii for them.
    """
    with torch.no_grad():
        body, held, unit = surface.body[: x.shape[1]], surface.held[: x.shape[1]], surface.unit
        u, at, way = detection.u[:, body], x.detach(), move.detach()
        room = detection.room[:, body]
        relative = way - u
        ratio = room / _length(relative)
        if own_pairs:
            own_room = detection.own_room[:, body]
            ratio = torch.minimum(ratio, own_room / _length(way - rigid))
        within = _of_units(_fraction(ratio), held, unit)
        above = _of_units(_fraction(_above(planes, at + u, relative, origin)), held, unit)
        first = torch.minimum(within, above)
        listed = detection.listed[:4]
        wanted = torch.where(held[:, None], way, u + first[..., None] * relative).contiguous()
        passed, stuck = ops_contact.advance(at, wanted, detection.u, at, origin, was.detach(), now.detach(),
                                            surface.held, surface.body, unit, listed)  # fmt: skip
        share = first * passed
        short = (torch.minimum(within, passed) < SHORT) & ~held
        own = (at + u + share[..., None] * (rigid - u), own_room) if own_pairs else ()
    return PartStart(_started(x, move, u, share, held), at + u, room, own, short, stuck, share)


def start_above(x: Tensor, move: Tensor, planes: Tensor | None, origin: Tensor, held: Tensor, unit: Tensor
                ) -> PartStart:  # fmt: skip
    """The same without pairs: nothing but the floor limits motion."""
    with torch.no_grad():
        share = _of_units(_fraction(_above(planes, x.detach(), move.detach(), origin)), held, unit)
        free, zero = torch.full_like(share, FAR), torch.zeros_like(share, dtype=torch.bool)
    start = _started(x, move, torch.zeros_like(x), share, held)
    return PartStart(start, x.detach(), free, (), zero, zero.new_zeros((1,), dtype=torch.int64), share)


def _started(x: Tensor, move: Tensor, u: Tensor, share: Tensor, held: Tensor) -> Tensor:
    return x + torch.where(held[:, None], move, u + share[..., None] * (move - u))


def _length(a: Tensor) -> Tensor:
    return a.square().sum(-1).sqrt().clamp(min=torch.finfo(a.dtype).tiny)


def _above(planes: Tensor | None, x: Tensor, move: Tensor, origin: Tensor) -> Tensor:
    """Fraction of its displacement after which a vertex has closed FILTER_ETA of its gap to a plane of the floor."""
    if planes is None:
        return torch.ones_like(x[..., 0])
    plane = planes.detach().reshape(planes.shape[0], 1, -1, PLANE_SCALARS)
    normal = plane[:, 0, :, :3].mT
    gap = ((x if origin.numel() == 0 else x + origin) @ normal - plane[..., 3]).clamp(min=0)
    toward = -(move @ normal)
    return torch.where(toward > 0, FILTER_ETA * gap / toward, torch.inf).amin(-1)


def _fraction(ratio: Tensor) -> Tensor:
    """The largest of 1, 1/2, ..., 2^-LEAST and 0 that is no larger; 0 of what is no number."""
    halved = torch.nan_to_num(-torch.log2(ratio).floor(), nan=LEAST + 1.0).clamp(0, LEAST + 1)
    return torch.where(halved > LEAST, 0.0, torch.ldexp(torch.ones_like(ratio), -halved))


def _of_units(fraction: Tensor, held: Tensor, unit: Tensor) -> Tensor:
    """The smallest fraction of the vertices of each unit that are not held [B, V]."""
    fraction, index = torch.where(held, 1.0, fraction), unit.long().expand(fraction.shape)
    return torch.ones_like(fraction).scatter_reduce(1, index, fraction, "amin").gather(1, index)
