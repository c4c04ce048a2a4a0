"""The compiled operators that sweeps with contact start from: lagged pairs, lowest vertices."""

from __future__ import annotations

import torch
from torch import Tensor

from .functions import raw_backward, shapes_of
from .load import direct as raw
from .sweep import LAG_SCALARS

PLANE_SCALARS = 7  # twin of kPlaneScalars in csrc/contact/lowest.h


def lag(x: Tensor, origin: Tensor, collider: Tensor, kappa: Tensor, pairs: Tensor, constants: Tensor, ptr: Tensor,
        entry: Tensor) -> Tensor:  # fmt: skip
    """Normal force, activity, normal and weights of each pair, [pairs, 9]."""
    return raw.contact_lag(x, origin, collider, kappa, pairs, constants, ptr, entry)


def lag_backward(bar: Tensor, x: Tensor, origin: Tensor, collider: Tensor, kappa: Tensor, pairs: Tensor,
                 constants: Tensor, ptr: Tensor, entry: Tensor) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Adjoints of where corner points are [B, N, 3], the vertices first, and of kappa [B]."""
    return raw.contact_lag_backward(bar, x, origin, collider, kappa, pairs, constants, ptr, entry)


def rubbing(x: Tensor, origin: Tensor, collider: Tensor, kappa: Tensor, friction: Tensor, damping: Tensor,
            pairs: Tensor, constants: Tensor, ptr: Tensor, entry: Tensor) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Friction coefficient times normal force [N], damping [N s/m], normal and weights of each pair, [pairs, 9]; and
    the forces of pairs on corner points [B, N, 3] [N]. friction, damping: [1 | B], or empty without."""
    return raw.contact_rubbing(x, origin, collider, kappa, friction, damping, pairs, constants, ptr, entry)


def rubbing_backward(lag_bar: Tensor, push_bar: Tensor, x: Tensor, origin: Tensor, collider: Tensor, kappa: Tensor,
                     friction: Tensor, damping: Tensor, pairs: Tensor, constants: Tensor, ptr: Tensor, entry: Tensor
                     ) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
    """Adjoints of where corner points are [B, N, 3], of kappa [B], and of friction and damping [B], or empty. Either
    of the first two arguments may be empty."""
    return raw.contact_rubbing_backward(lag_bar, push_bar, x, origin, collider, kappa, friction, damping, pairs,
                                        constants, ptr, entry)  # fmt: skip


def lowest(x: Tensor, origin: Tensor, planes: Tensor, body_order: Tensor, body_ptr: Tensor, island: Tensor
           ) -> Tensor:  # fmt: skip
    """Lowest vertex above each plane, of the island that each body is in, [B, bodies, planes] int32."""
    return raw.contact_lowest(x, origin, planes, body_order, body_ptr, island)


@shapes_of("contact_lag")
def _(x, origin, collider, kappa, pairs, constants, ptr, entry):
    return x.new_empty((pairs.shape[0], LAG_SCALARS))


@shapes_of("contact_lag_backward")
def _(bar, x, origin, collider, kappa, pairs, constants, ptr, entry):
    return _points(x, collider), x.new_empty((x.shape[0],))


@shapes_of("contact_rubbing")
def _(x, origin, collider, kappa, friction, damping, pairs, constants, ptr, entry):
    return x.new_empty((pairs.shape[0], LAG_SCALARS)), _points(x, collider)


@shapes_of("contact_rubbing_backward")
def _(lag_bar, push_bar, x, origin, collider, kappa, friction, damping, pairs, constants, ptr, entry):
    of_scenes = (x.new_empty((x.shape[0] if t.numel() else 0,)) for t in (kappa, friction, damping))
    return _points(x, collider), *of_scenes


def _points(x: Tensor, collider: Tensor) -> Tensor:
    """One vector for each corner point."""
    colliders = collider.shape[1] if collider.dim() == 3 else 0
    return x.new_empty((x.shape[0], x.shape[1] + colliders, 3))


@shapes_of("contact_lowest")
def _(x, origin, planes, body_order, body_ptr, island):
    return x.new_empty((*island.shape, planes.shape[-1] // PLANE_SCALARS), dtype=torch.int32)


for _name in ("contact_lag", "contact_lag_backward", "contact_rubbing", "contact_rubbing_backward", "contact_lowest"):
    torch.library.register_autograd(f"diffvbd::{_name}", raw_backward)
