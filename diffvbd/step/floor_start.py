"""Where the sweeps of a step start that has friction on a floor, and no pairs."""

from __future__ import annotations

import torch
from torch import Tensor

from ..contact.above_floor import above_floor
from ..model.model import Model
from .predict import Begun
from .rigid_contact import bodies_of


def start_on_floor(model: Model, begun: Begun, floor: Tensor | None) -> Tensor:
    """Positions [B, V, 3] [m]: free bodies go as wholes, above the floor. If each vertex went as far as the floor lets
    it by itself, the start would press a body that hits the floor. Differentiable.

    floor: Data of the FloorBarrier [1 | B, 7 planes], or None.
    """
    x, start = begun.x_prev, begun.x_start
    if floor is None:
        return start
    _, _, free, held, body = bodies_of(model)
    body, way = body.long(), begun.y - x
    if model.starts_from == "inertia":
        way = way - begun.lift
    origin = x.new_empty((0,)) if begun.origin is None else begun.origin
    left = above_floor(floor, origin, x, way, held, body, len(free))
    return torch.where(free[body, None], x + left.way(way, body), start)
