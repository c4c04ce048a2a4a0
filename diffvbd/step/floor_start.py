"""Start of the sweeps of a step with friction on a floor and no pairs."""

from __future__ import annotations

from functools import partial

import torch
from torch import Tensor

from ..contact.above_floor import above_floor
from ..model.system import System
from ..ops import broadcast
from .arguments import Prepared
from .motion import coasting
from .predict import Begun
from .rigid_contact import bodies_of

PLANE, DHAT = 7, 5  # numbers of a plane of a FloorBarrier, and which of them is dhat


def start_on_floor(model: System, begun: Begun, floor: Tensor | None, mass: Tensor, prepared: Prepared
                   ) -> Tensor:  # fmt: skip
    """Positions [B, V, 3] [m]: free bodies go as wholes, above the floor. If each vertex went as far as the floor lets
    it by itself, the start would press a body that hits the floor. Differentiable.

    floor: Data of the FloorBarrier [1 | B, 7 planes], or None.  mass: [1 | B, V] [kg].
    """
    x, start = begun.x_prev, begun.x_start
    if floor is None:
        return start
    order, ptr, free, held, body = bodies_of(model)
    body, lift = body[: x.shape[1]].long(), broadcast(begun.lift, x.shape)
    way = prepared.ways(partial(coasting, x, mass, begun.y - x - lift, held, ~free, order, ptr))
    if model.starts_from != "inertia":
        way = way + _borne(floor, x if begun.origin is None else x + begun.origin, lift, body, len(free))
    none = x.new_empty((0,))
    origin = none if begun.origin is None else begun.origin
    left, _ = above_floor(x, none, way, floor, origin, held, order, ptr)
    return torch.where(free[body, None], x + left, start)


def _borne(floor: Tensor, x: Tensor, lift: Tensor, body: Tensor, bodies: int) -> Tensor:
    """``lift`` = h^2 a [B, V, 3] without what pushes a body into a plane within dhat, which bears it. Of a body at rest
    nothing is left, on a slope what draws it down the slope."""
    planes = floor.reshape(floor.shape[0], 1, -1, PLANE)
    normal = planes[:, 0, :, :3]
    with torch.no_grad():
        close = (x @ normal.mT - planes[..., 3] < planes[..., DHAT]).to(x.dtype)
        near = close.new_zeros((len(x), bodies, close.shape[-1]))
        near = near.scatter_reduce(1, body[:, None].expand(close.shape), close, "amax")[:, body]
    return lift - (near * (lift @ normal.mT).clamp(max=0)) @ normal
