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
                 constants: Tensor, ptr: Tensor, entry: Tensor) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """Adjoints of x [B, V, 3], collider [B, Vc, 3] and kappa [B]."""
    return raw.contact_lag_backward(bar, x, origin, collider, kappa, pairs, constants, ptr, entry)


def lowest(x: Tensor, origin: Tensor, planes: Tensor, body_order: Tensor, body_ptr: Tensor, island: Tensor
           ) -> Tensor:  # fmt: skip
    """Lowest vertex above each plane, of the island that each body is in, [B, bodies, planes] int32."""
    return raw.contact_lowest(x, origin, planes, body_order, body_ptr, island)


@shapes_of("contact_lag")
def _(x, origin, collider, kappa, pairs, constants, ptr, entry):
    return x.new_empty((pairs.shape[0], LAG_SCALARS))


@shapes_of("contact_lag_backward")
def _(bar, x, origin, collider, kappa, pairs, constants, ptr, entry):
    colliders = collider.shape[1] if collider.dim() == 3 else 0
    return torch.empty_like(x), x.new_empty((x.shape[0], colliders, 3)), x.new_empty((x.shape[0],))


@shapes_of("contact_lowest")
def _(x, origin, planes, body_order, body_ptr, island):
    return x.new_empty((*island.shape, planes.shape[-1] // PLANE_SCALARS), dtype=torch.int32)


for _name in ("contact_lag", "contact_lag_backward", "contact_lowest"):
    torch.library.register_autograd(f"diffvbd::{_name}", raw_backward)
