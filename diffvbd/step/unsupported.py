"""Residual acceleration of each body: what contact at the start of a step does not bear."""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

from ..model.system import System
from ..ops.contact import lift_left


def unsupported(model: System, x: Tensor, origin: Tensor, push: Tensor, mass: Tensor, lift: Tensor,
                floor_data: Tensor | None, time_step: float) -> Tensor:  # fmt: skip
    """Residual of ``lift`` = h^2 a [1 | B, V, 3] once the contact forces at the start of the step have borne their
    part of each body's acceleration: for a body at rest nothing, in flight all of it. Differentiable.

    Without it every step would push a supported body into its support, and the sweeps would have to take it back.

    Args:
        x, origin: As the sweeps take them.  push: Forces of pairs on corner points at x [B, N, 3] [N].
        mass: [1 | B, V] [kg].  floor_data: Of the FloorBarrier [1 | B, 7 planes], or None.  time_step: [s].
    """
    surface = model.surface_of_contact
    assert surface is not None
    planes = x.new_empty((0,)) if floor_data is None else floor_data
    constants = (surface.held_bodies, surface.body_order, surface.body_ptr, time_step)
    at = x.detach() if floor_data is None else x  # without a floor only forces know where vertices are
    given = (t.contiguous() for t in (at, lift, push, mass, planes))
    return lift_left(*given, origin, *constants)


def rests(model: System, x: Tensor, lift: Tensor, raises: Callable[[Tensor, Tensor], Tensor]) -> Tensor | None:
    """Vertices of partly pinned bodies whose potential ``lift`` would increase, bool [B, V]; None
    without such bodies. Elasticity bears the weight of a body at rest, and its potential is convex about there: it
    rises by any fall. Few sweeps do not take the fall back, and what stands on such a body would follow it.

    Args:
        x: Where vertices are without the fall, [B, V, 3] [m].  lift: As :func:`unsupported` returns it.
        raises: As for :func:`diffvbd.contact.start.start_between_planes`.
    """
    assert model.surface_of_contact is not None
    held = model.surface_of_contact.partly_held
    return None if held is None else raises(x, x + lift) & held
