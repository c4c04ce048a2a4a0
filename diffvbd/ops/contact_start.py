"""The compiled operators of the start of a part of a step with contact, as in sweep.py."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from .functions import raw_backward, shapes_of
from .load import direct as raw


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


def advance(x: Tensor, move: Tensor, u: Tensor, center: Tensor, origin: Tensor, collider: Tensor, collider_next: Tensor,
            held: Tensor, body: Tensor, room: Tensor, listed: Sequence[Tensor], careful: bool = True,
            whole: bool = False, own: Sequence[Tensor] = ()) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Share of ``move - u`` that each vertex may go at once with all others [B, V], or each body [B, bodies]; how many
    pairs hinder what is prescribed, int64 [1]. Not differentiable.

    Args:
        x, move: [B, V, 3], state and wanted motion [m].  u: Translation of each body's island [B, bodies, 3] [m].
        center, room: [B, V, 3] and [B, V]: how far from where a vertex may go [m].
        listed: pairs, constants, ptr, entry of :func:`contact_detect`.
        careful: Whether the motion does not minimise the barrier.
        whole: Whether all vertices of a body go the same share.
        own: As center and room, beside the rigid motion of the vertex's body; empty where bodies have no own pairs.
    """
    none = x.new_empty((0,))
    return raw.contact_advance(
        x, move, u, center, origin, collider, collider_next, held, body, room, *(own or (none, none)), *listed, careful,
        whole,
    )  # fmt: skip


def narrow(x: Tensor, origin: Tensor, collider: Tensor, room: Tensor, pairs: Tensor, constants: Tensor, ptr: Tensor
           ) -> Tensor:  # fmt: skip
    """``constants`` of listed pairs with their gaps at x in the last column, infinite where sides cannot come within
    reach as long as no vertex goes farther than its room [B, V] [m]. Not differentiable."""
    return raw.contact_narrow(x, origin, collider, room, pairs, constants, ptr)


def gaps(x: Tensor, origin: Tensor, collider: Tensor, pairs: Tensor, constants: Tensor, ptr: Tensor) -> Tensor:
    """Gaps of listed pairs with vertices at x and colliders at ``collider`` [pairs] [m]. Detection's own gaps of planes
    are those at the end of the step. Not differentiable."""
    room = torch.full_like(x[..., 0], torch.inf)  # all can come within reach
    return narrow(x.detach(), origin, collider.detach(), room, pairs, constants, ptr)[:, -1]


def keep(rows: Tensor, listed: Sequence[Tensor], exact: bool) -> tuple[Tensor, ...]:
    """The pairs of a list (pairs, constants, ptr, entry of :func:`contact_detect`) that ``rows`` names, bool [pairs]:
    their indices, int64, and their list. exact: as long as they are many, which the CPU alone can say; else in room for
    all, with -1 where there is none."""
    return raw.contact_keep(rows, *listed, exact)


@shapes_of("contact_keep")
def _(keep, pairs, constants, ptr, entry, exact):
    count = torch.library.get_ctx().new_dynamic_size() if exact else pairs.shape[0]
    sizes = ((count,), (count, pairs.shape[1]), (count, constants.shape[1]), ptr.shape, (4 * count,))
    dtypes = (torch.int64, torch.int32, constants.dtype, torch.int32, torch.int32)
    return tuple(constants.new_empty(size, dtype=dtype) for size, dtype in zip(sizes, dtypes, strict=True))


@shapes_of("contact_narrow")
def _(x, origin, collider, room, pairs, constants, ptr):
    return torch.empty_like(constants)


@shapes_of("contact_advance")
def _(x, move, u, center, origin, collider, collider_next, held, body, room, own_center, own_room, pairs, constants,
      ptr, entry, careful, whole):  # fmt: skip
    return x.new_empty(u.shape[:2] if whole else x.shape[:2]), x.new_empty((1,), dtype=torch.int64)


@shapes_of("contact_translation")
def _(move, mass, x, origin, planes, held, body, body_order, body_ptr, island, lowest):
    return x.new_empty((*island.shape, 3))


@shapes_of("contact_translation_backward")
def _(u_bar, move, mass, x, origin, planes, held, body, body_order, body_ptr, island, lowest):
    scalars = planes.shape[-1] if planes.numel() else 0
    return torch.empty_like(move), x.new_empty(x.shape[:2]), torch.empty_like(x), x.new_empty((x.shape[0], scalars))


for _name in (
    "contact_advance",
    "contact_keep",
    "contact_narrow",
    "contact_translation",
    "contact_translation_backward",
):
    torch.library.register_autograd(f"diffvbd::{_name}", raw_backward)
