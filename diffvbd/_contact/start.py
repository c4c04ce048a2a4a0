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

WHOLE = 0.99  # fraction of a displacement from which a vertex counts as not truncated
LEAST = 6  # the smallest fraction is 2^-6, and then 0
FAR = 1e15  # [m] trust-region radius without pairs


class SubstepStart(NamedTuple):
    """Start of the sweeps of a substep; all but x is index data."""

    x: Tensor  # [B, V, 3] [m]
    center: Tensor  # [B, V, 3]  center of the trust region of each vertex [m]
    trust_radius: Tensor  # [B, V]  its radius [m]
    own: tuple  # center and radius of the deformation; empty where bodies have no pairs of their own
    truncated: Tensor  # [B, V] bool: pairs or radii have truncated the displacement
    infeasible: Tensor  # [1] int64: pairs that hinder what is prescribed
    fractions: Tensor  # [B, V]  fraction of its displacement that each vertex went


def start_between(x: Tensor, move: Tensor, was: Tensor, now: Tensor, planes: Tensor | None, origin: Tensor,
                  detection: Any, surface: ContactSurface, rigid: Tensor, own_pairs: bool) -> SubstepStart:  # fmt: skip
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
        body, pinned, unit = surface.body[: x.shape[1]], surface.pinned[: x.shape[1]], surface.unit
        u, at, displacement = detection.u[:, body], x.detach(), move.detach()
        trust_radius = detection.trust_radius[:, body]
        relative = displacement - u
        ratio, deformation_radius = trust_radius / _length(relative), detection.deformation_radius[:, body]
        if own_pairs:
            ratio = torch.minimum(ratio, deformation_radius / _length(displacement - rigid))
        within = _of_units(ratio, pinned, unit)
        first = _fraction(_lower(within, planes, at + u, relative, origin, pinned, unit))
        listed = detection.listed[:4]
        wanted = torch.where(pinned[:, None], displacement, u + first[..., None] * relative).contiguous()
        passed, infeasible = ops_contact.advance(at, wanted, detection.u, at, origin, was.detach(), now.detach(),
                                                 surface.pinned, surface.body, unit, listed)  # fmt: skip
        fraction = first * passed
        truncated = (torch.minimum(within, passed) < WHOLE) & ~pinned
        own = (at + u + fraction[..., None] * (rigid - u), deformation_radius) if own_pairs else ()
    start = _started(x, move, u, fraction, pinned)
    return SubstepStart(start, at + u, trust_radius, own, truncated, infeasible, fraction)


def start_above(x: Tensor, move: Tensor, planes: Tensor | None, origin: Tensor, pinned: Tensor, unit: Tensor
                ) -> SubstepStart:  # fmt: skip
    """The same without pairs: nothing but the floor limits motion."""
    with torch.no_grad():
        free, none = torch.full_like(x[..., 0], FAR), torch.zeros_like(x)
        fraction = _fraction(_lower(free, planes, x.detach(), move.detach(), origin, pinned, unit))
        zero = torch.zeros_like(free, dtype=torch.bool)
    start = _started(x, move, none, fraction, pinned)
    return SubstepStart(start, x.detach(), free, (), zero, zero.new_zeros((1,), dtype=torch.int64), fraction)


def _started(x: Tensor, move: Tensor, u: Tensor, fraction: Tensor, pinned: Tensor) -> Tensor:
    return x + torch.where(pinned[:, None], move, u + fraction[..., None] * (move - u))


def _length(a: Tensor) -> Tensor:
    return a.square().sum(-1).sqrt().clamp(min=torch.finfo(a.dtype).tiny)


def _lower(ratio: Tensor, planes: Tensor | None, x: Tensor, move: Tensor, origin: Tensor, pinned: Tensor, unit: Tensor
           ) -> Tensor:  # fmt: skip
    """The ratio [B, V], or that at which a vertex of its unit has closed FILTER_ETA of its gap to a floor."""
    if planes is None:
        return ratio
    plane = planes.detach().reshape(planes.shape[0], 1, -1, PLANE_SCALARS)
    normal = plane[:, 0, :, :3].mT
    gap = ((x if origin.numel() == 0 else x + origin) @ normal - plane[..., 3]).clamp(min=0)
    toward = -(move @ normal)
    above = torch.where(toward > 0, FILTER_ETA * gap / toward, torch.inf).amin(-1)
    return torch.minimum(ratio, _of_units(above, pinned, unit))


def _fraction(ratio: Tensor) -> Tensor:
    """The largest of 1, 1/2, ..., 2^-LEAST and 0 that is no larger."""
    halved = torch.ceil(-torch.log2(ratio)).clamp(0, LEAST + 1)
    return torch.where(halved > LEAST, 0.0, torch.exp2(-halved))


def _of_units(ratio: Tensor, pinned: Tensor, unit: Tensor) -> Tensor:
    """The smallest ratio of the vertices of each unit that are not pinned, at most 1 [B, V]."""
    ratio, index = torch.where(pinned, 1.0, ratio), unit.long().expand(ratio.shape)
    return torch.ones_like(ratio).scatter_reduce(1, index, ratio, "amin").gather(1, index)
