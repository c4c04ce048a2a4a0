"""What contact at the start of a step leaves of the acceleration of each body."""

# pyright: reportIncompatibleMethodOverride=false
from __future__ import annotations

from collections.abc import Callable
from typing import Any

from torch import Tensor

from .. import ops
from ..model.system import System
from ..ops import Backward, Direct, not_batched
from ..ops import unsupported as ops_unsupported


class _Unsupported(Direct):
    """The lift that is left [B, V, 3]. constants: held_bodies, body_order, body_ptr and the time step."""

    @staticmethod
    def forward(x: Tensor, lift: Tensor, force: Tensor, mass: Tensor, planes: Tensor, origin: Tensor,
                constants: tuple) -> Tensor:  # fmt: skip
        return ops_unsupported.unsupported(x, origin, lift, force, mass, planes, *constants)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: Tensor) -> None:
        *tensors, ctx.constants = inputs
        ctx.save_for_backward(*tensors)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple:
        not_batched(grads[0])
        wants_planes = ctx.needs_input_grad[4]
        x_bar, lift_bar, force_bar, mass_bar, planes_bar = _UnsupportedBackward.apply(
            grads[0].contiguous(), *ctx.saved_tensors, ctx.constants, wants_planes
        )
        return (
            x_bar if x_bar.numel() else None,
            lift_bar,
            force_bar,
            mass_bar,
            planes_bar if wants_planes else None,
            None,
            None,
        )


class _UnsupportedBackward(Backward):
    @staticmethod
    def forward(bar, x, lift, force, mass, planes, origin, constants, wants_planes):
        x_bar, lift_bar, force_bar, mass_bar, planes_bar = ops_unsupported.unsupported_backward(
            bar, x, origin, lift, force, mass, planes, *constants, wants_planes=wants_planes
        )
        lift_bar, mass_bar = ops.sum_to(lift_bar, lift.shape), ops.sum_to(mass_bar, mass.shape)
        if wants_planes:
            planes_bar = ops.sum_to(planes_bar, (planes.shape[0], 1, planes_bar.shape[2])).reshape(planes.shape)
        return x_bar, lift_bar, force_bar, mass_bar, planes_bar


def unsupported(model: System, x: Tensor, origin: Tensor, push: Tensor, mass: Tensor, lift: Tensor,
                floor_data: Tensor | None, time_step: float) -> Tensor:  # fmt: skip
    """What is left of ``lift`` = h^2 a [1 | B, V, 3] once the contact forces at the start of the step have borne their
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
    return _Unsupported.apply(*given, origin, constants)


def rests(model: System, x: Tensor, lift: Tensor, raises: Callable[[Tensor, Tensor], Tensor]) -> Tensor | None:
    """Which vertices are of bodies that are held somewhere and whose potential ``lift`` would raise, bool [B, V]; None
    without such bodies. Elasticity bears the weight of a body at rest, and its potential is convex about there: it
    rises by any fall. Few sweeps do not take the fall back, and what stands on such a body would follow it.

    Args:
        x: Where vertices are without the fall, [B, V, 3] [m].  lift: As :func:`unsupported` returns it.
        raises: As for :func:`diffvbd.contact.start.start_between_planes`.
    """
    assert model.surface_of_contact is not None
    held = model.surface_of_contact.partly_held
    return None if held is None else raises(x, x + lift) & held
