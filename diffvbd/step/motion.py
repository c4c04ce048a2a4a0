"""Where bodies want to go: what of it is a rigid motion of each, and how far their vertices go beside that."""

# pyright: reportIncompatibleMethodOverride=false
from __future__ import annotations

from typing import Any, NamedTuple

from torch import Tensor

from .. import ops
from ..contact.surface import ContactSurface
from ..ops import Backward, Direct, not_batched
from ..ops import motion as ops_motion


class _Motion(Direct):
    """ops.motion.Ways, differentiable in its rigid motion."""

    @staticmethod
    def forward(x: Tensor, mass: Tensor, move: Tensor, origin: Tensor, fall: Tensor, index: tuple) -> tuple:
        return tuple(ops_motion.contact_motion(x, origin, mass, move, fall, *index))

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: tuple) -> None:
        x, mass, move, origin, _, ctx.index = inputs
        ctx.save_for_backward(x, mass, move, origin)
        ctx.mark_non_differentiable(*output[1:])

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple:
        not_batched(grads[0])
        x, mass, move, origin = ctx.saved_tensors
        bars = _MotionBackward.apply(grads[0].contiguous(), x, mass, move, origin, ctx.index)
        return (*(ops.sum_to(bar, t.shape) for bar, t in zip(bars, (x, mass, move), strict=True)), None, None, None)


class _MotionBackward(Backward):
    @staticmethod
    def forward(bar, x, mass, move, origin, index):
        return ops_motion.contact_motion_backward(bar, x, origin, mass, move, *index)


class _Coast(Direct):
    """constants: held, held_bodies, body_order, body_ptr and the chord."""

    @staticmethod
    def forward(x: Tensor, mass: Tensor, move: Tensor, constants: tuple) -> Tensor:
        return ops_motion.contact_coast(x, mass, move, *constants)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: Tensor) -> None:
        *tensors, ctx.constants = inputs
        ctx.save_for_backward(*tensors)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple:
        not_batched(grads[0])
        saved = ctx.saved_tensors
        bars = _CoastBackward.apply(grads[0].contiguous(), *saved, ctx.constants)
        return *(ops.sum_to(bar, t.shape) for bar, t in zip(bars, saved, strict=True)), None


class _CoastBackward(Backward):
    @staticmethod
    def forward(bar, x, mass, move, constants):
        return ops_motion.contact_coast_backward(bar, x, mass, move, *constants)


def coasting(x: Tensor, mass: Tensor, move: Tensor, held: Tensor, held_bodies: Tensor, order: Tensor, ptr: Tensor,
             chord: float) -> Tensor:  # fmt: skip
    """The ways ``move`` [B, V, 3] without what stretches free bodies that turn; differentiable in x, mass and move.
    Arguments as for :func:`diffvbd.ops.motion.contact_coast`."""
    given = (t.contiguous() for t in (x, mass, move))
    return _Coast.apply(*given, (held, held_bodies, order, ptr, chord))


class Motion(NamedTuple):
    """The ways that vertices want to go in a part of a step."""

    move: Tensor  # [B, V, 3] [m]
    fall: Tensor  # [B, V, 3] [m]: what contact may bear of it comes after ``move``
    rigid: Tensor  # [B, V, 3] [m]: of ``move`` a shift and a turn of each body, which brings no two points of it closer
    ways: ops_motion.Ways  # index data

    @property
    def apart(self) -> Tensor:
        """The longest way of a free vertex of each body beside its rigid motion [B, bodies] [m]."""
        return self.ways.longest[ops_motion.WAYS.index("apart")]

    @property
    def stretched(self) -> Tensor:
        """How far the straight ways of a turn, or of a share of it, bring a vertex of each body from the turned body
        [B, bodies] [m]."""
        return self.ways.longest[ops_motion.WAYS.index("stretched")]


def motion_of(surface: ContactSurface, x: Tensor, origin: Tensor, mass: Tensor, move: Tensor, fall: Tensor) -> Motion:
    """Differentiable in what x, mass and move do to ``rigid``.

    Args:
        x, origin: As the sweeps take them.  mass: [1 | B, V] [kg].  move, fall: [B, V, 3] [m].
    """
    x, mass, move = x.contiguous(), mass.contiguous(), move.contiguous()
    index = (surface.held, surface.held_bodies, surface.body_order, surface.body_ptr)
    rigid, longest, sums = _Motion.apply(x, mass, move, origin, fall.detach().contiguous(), index)
    return Motion(move, fall, rigid, ops_motion.Ways(rigid.detach(), longest, sums))
