"""The compiled operators of the start of a part of a step with contact, as in sweep.py."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from .functions import raw_backward, shapes_of
from .load import raw


def translation(move: Tensor, mass: Tensor, x: Tensor, origin: Tensor, planes: Tensor, held: Tensor, body: Tensor,
                body_order: Tensor, body_ptr: Tensor, island: Tensor, lowest: Tensor) -> Tensor:  # fmt: skip
    """Translation of each body's island [B, bodies, 3]; arguments in the order of csrc/bind/schema.cpp."""
    return raw.contact_translation(move, mass, x, origin, planes, held, body, body_order, body_ptr, island, lowest)


def translation_backward(u_bar: Tensor, move: Tensor, mass: Tensor, x: Tensor, origin: Tensor, planes: Tensor,
                         held: Tensor, body: Tensor, body_order: Tensor, body_ptr: Tensor, island: Tensor,
                         lowest: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
    """Adjoints of move [B, V, 3], mass [B, V], x [B, V, 3], planes [B, 7 planes]."""
    return raw.contact_translation_backward(
        u_bar, move, mass, x, origin, planes, held, body, body_order, body_ptr, island, lowest
    )


def start(x: Tensor, move: Tensor, goal: Tensor, u: Tensor, near: Tensor, origin: Tensor, planes: Tensor, held: Tensor,
          body: Tensor, gamma: float, cap: float, filter_eta: float) -> tuple[Tensor, ...]:  # fmt: skip
    """Bounds [B, V, 4], start [B, V, 3], what is left to go [B, V, 3], where the bound has cut, uint8 [B, V]."""
    return raw.contact_start(x, move, goal, u, near, origin, planes, held, body, gamma, cap, filter_eta)


def start_backward(bars: Sequence[Tensor], x: Tensor, move: Tensor, goal: Tensor, u: Tensor, near: Tensor,
                   origin: Tensor, planes: Tensor, held: Tensor, body: Tensor, gamma: float, cap: float,
                   filter_eta: float, wants_planes: bool) -> tuple[Tensor, ...]:  # fmt: skip
    """Adjoints of x, move, goal, u (for each vertex) [B, V, 3], gap [B, V], planes [B, V, 7 planes or 0]."""
    return raw.contact_start_backward(
        *bars, x, move, goal, u, near, origin, planes, held, body, gamma, cap, filter_eta, wants_planes
    )


@shapes_of("contact_translation")
def _(move, mass, x, origin, planes, held, body, body_order, body_ptr, island, lowest):
    return x.new_empty((*island.shape, 3))


@shapes_of("contact_translation_backward")
def _(u_bar, move, mass, x, origin, planes, held, body, body_order, body_ptr, island, lowest):
    scalars = planes.shape[-1] if planes.numel() else 0
    return torch.empty_like(move), x.new_empty(x.shape[:2]), torch.empty_like(x), x.new_empty((x.shape[0], scalars))


@shapes_of("contact_start")
def _(x, move, goal, u, near, origin, planes, held, body, gamma, cap, filter_eta):
    bounds = x.new_empty((*x.shape[:2], 4))
    return bounds, torch.empty_like(x), torch.empty_like(x), x.new_empty(x.shape[:2], dtype=torch.uint8)


@shapes_of("contact_start_backward")
def _(bounds_bar, start_bar, move_bar, x, move, goal, u, near, origin, planes, held, body, gamma, cap, filter_eta,
      wants_planes):  # fmt: skip
    scalars = planes.shape[-1] if wants_planes else 0
    vectors = (torch.empty_like(x) for _ in range(4))
    return (*vectors, x.new_empty(x.shape[:2]), x.new_empty((*x.shape[:2], scalars)))


for _name in ("contact_translation", "contact_translation_backward", "contact_start", "contact_start_backward"):
    torch.library.register_autograd(f"diffvbd::{_name}", raw_backward)
