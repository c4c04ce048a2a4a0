"""Intended motion of bodies: the rigid part of each, and how far their vertices deviate from it."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from ..contact.surface import ContactSurface
from ..ops import contact as ops_contact
from ..ops.fields import WAYS


def coasting(x: Tensor, mass: Tensor, move: Tensor, held: Tensor, held_bodies: Tensor, order: Tensor, ptr: Tensor,
             chord: float) -> Tensor:  # fmt: skip
    """The ways ``move`` [B, V, 3] without what stretches free bodies that turn; differentiable in x, mass and move.
    Arguments as for :func:`diffvbd.ops.contact.contact_coast`."""
    given = (t.contiguous() for t in (x, mass, move))
    return ops_contact.coasting(*given, held, held_bodies, order, ptr, chord)


class Motion(NamedTuple):
    """The ways that vertices want to go in a part of a step."""

    move: Tensor  # [B, V, 3] [m]
    fall: Tensor  # [B, V, 3] [m]: what contact may bear of it comes after ``move``
    rigid: Tensor  # [B, V, 3] [m]: of ``move`` a shift and a turn of each body, which brings no two points of it closer
    ways: ops_contact.Ways  # index data

    @property
    def apart(self) -> Tensor:
        """The longest way of a free vertex of each body beside its rigid motion [B, bodies] [m]."""
        return self.ways.longest[WAYS.index("apart")]

    @property
    def stretched(self) -> Tensor:
        """Distance by which the straight paths of a rotation, or of a fraction of it, take a vertex of each body from
        the rotated body [B, bodies] [m]."""
        return self.ways.longest[WAYS.index("stretched")]


def motion_of(surface: ContactSurface, x: Tensor, origin: Tensor, mass: Tensor, move: Tensor, fall: Tensor) -> Motion:
    """Differentiable in what x, mass and move do to ``rigid``.

    Args:
        x, origin: As the sweeps take them.  mass: [1 | B, V] [kg].  move, fall: [B, V, 3] [m].
    """
    x, mass, move = x.contiguous(), mass.contiguous(), move.contiguous()
    index = (surface.held, surface.held_bodies, surface.body_order, surface.body_ptr)
    rigid, longest, sums = ops_contact.rigid_motion(x, mass, move, origin, *index, fall.detach().contiguous())
    return Motion(move, fall, rigid, ops_contact.Ways(rigid.detach(), longest, sums))
