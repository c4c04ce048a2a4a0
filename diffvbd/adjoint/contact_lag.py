"""Lagged contact: what sweeps keep of the start of a step: forces, normals and weights of pairs, differentiable."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from .. import ops
from ..ops import contact as ops_contact
from ..ops.fields import CONSTANTS
from ..ops.sums import segment_sum


class Pairs(NamedTuple):
    """Index data of a detection: which pairs there are; not differentiable. Shapes: detection.detect."""

    pairs: Tensor
    constants: Tensor
    ptr: Tensor
    entry: Tensor


def no_pairs(like: Tensor, corners: int) -> Pairs:
    """An empty list for so many corner points of all scenes."""
    none = torch.zeros((corners + 1,), dtype=torch.int32, device=like.device)
    return Pairs(none[:0].reshape(0, 6), like.new_zeros((0, CONSTANTS)), none, none[:0])


def some_of(listed: Pairs, keep: Tensor) -> tuple[Pairs, Tensor]:
    """Those of listed pairs that ``keep`` names, bool [pairs], and which they are. Where values must not decide sizes,
    on CUDA and compiled, in lists of the same length, with -1 where there is none."""
    exact = not keep.is_cuda and not torch.compiler.is_compiling()
    rows, *kept = ops_contact.keep(keep, listed, exact)
    return Pairs(*kept), rows


def _gather_corners(points: Tensor, listed: Pairs) -> Tensor:
    rows = listed.pairs.clamp(min=0).long()
    return points[rows[:, 5:], rows[:, :4]]


def _add_corners(values: Tensor, listed: Pairs, scenes: int, points: int) -> Tensor:
    rows = values.flatten(0, 1)[None].contiguous()
    return segment_sum(rows, listed.entry, listed.ptr).reshape(scenes, points, values.shape[-1])


_at_corners = ops.Linear(_gather_corners, lambda bar, shape, listed: sum_at_corners(bar, listed, *shape[:2]), 2)
_sum_at_corners = ops.Linear(_add_corners, lambda bar, _, listed, scenes, points: at_corners(bar, listed), 4)
_of_scene = ops.Linear(lambda value, listed: value[listed.pairs[:, 5].clamp(min=0).to(torch.int64)],
                       lambda bar, shape, listed: sum_of_scenes(bar, listed, shape[0]), 2)  # fmt: skip


def at_corners(points: Tensor, listed: Pairs) -> Tensor:
    """points [B, N, n] of all corner points at those of each pair [pairs, 4, n]; those of a row that no pair fills are
    any, and pass no gradient on."""
    return _at_corners(points, listed)


def sum_at_corners(values: Tensor, listed: Pairs, scenes: int, points: int) -> Tensor:
    """Sums of values at the corners of pairs [pairs, 4, n] over the pairs of each corner point, [B, N, n] of so many
    scenes and corner points."""
    return _sum_at_corners(values, listed, scenes, points)


def sum_of_scenes(values: Tensor, listed: Pairs, scenes: int) -> Tensor:
    """Sums of values of pairs [pairs] over those of each scene [B], in a fixed order; values are zero in rows that no
    pair fills."""
    if scenes <= 1:
        return ops.sum_to(values, (1,))[:scenes]
    ptr = listed.ptr  # pairs are sorted by scene, with four entries each
    first = (ptr[:: (ptr.shape[0] - 1) // scenes] // 4).contiguous()
    order = torch.arange(values.shape[0], dtype=torch.int32, device=ptr.device)
    return segment_sum(values[None, :, None].contiguous(), order, first)[0, :, 0]


def of_scene(value: Tensor, listed: Pairs) -> Tensor:
    """value [B], one for each scene, for each pair [pairs]; its gradient is summed in a fixed order."""
    return _of_scene(value, listed)


def pair_lag(x: Tensor, collider: Tensor, kappa: Tensor, origin: Tensor, listed: Pairs) -> Tensor:
    """[pairs, 9]: normal force [N], 1 where closer than dhat, normal (3), weights (4); differentiable in three.

    Args:
        x: [B, V, 3] [m].  collider: [B, Vc, 3] [m].  kappa: [1 | B] [N/m].  origin: [B, V, 3] or empty.
    """
    return ops_contact.pair_lag(x.contiguous(), collider.contiguous(), kappa.contiguous(), origin, *listed)


def rubbing(x: Tensor, collider: Tensor, kappa: Tensor, friction: Tensor, damping: Tensor, origin: Tensor,
            listed: Pairs) -> tuple[Tensor, Tensor]:  # fmt: skip
    """[pairs, 9]: friction coefficient times normal force [N], damping [N s/m] (energies.damped_share), normal (3),
    weights (4); and the forces of pairs on corner points [B, N, 3] [N]. Differentiable in the first five.

    Args:
        x: [B, V, 3] [m].  collider: [B, Vc, 3] [m].  kappa: [1 | B] [N/m].  friction, damping: [1 | B], or empty.
        origin: [B, V, 3] or empty.
    """
    given = (t.contiguous() for t in (x, collider, kappa, friction, damping))
    return ops_contact.pair_rubbing(*given, origin, *listed)
