"""The rigid corrections of a part of a step (docs/method.md, section 18): one before its sweeps, one after them, and
after the last sweeps more of what did not get all the way."""

from __future__ import annotations

from typing import TYPE_CHECKING

from torch import Tensor

from .. import ops
from ..ops.contact import Moved, left_alone
from ..ops.fields import most_grouped
from ..scopes import is_captured
from .rigid_contact import Corrected, More, Which, bodies_of, correct, once

if TYPE_CHECKING:
    from ..adjoint.contact_lag import Pairs
    from ..contact.start import PartStart
    from .contact import ContactStep

# Rigid corrections after the last sweeps, with the first, as long as bodies were held up on their way: they come close
# to those that held them up, and then push them. Of a row of four cubes that meet at 3 m/s the motion lost 14 % of its
# momentum with one correction and nothing with three; at 10 m/s that takes five.
HELD_CORRECTIONS = 5
# And where bodies are left alone, as those that touch are too many. In stacks of two that rub the upper one creeps at
# 3.4 mm/s with 3, 2.0 with 4 and 1.1 with 6; stacks of four fell with 6.
LEFT_CORRECTIONS = 8
HELD = 0.01  # of its way in the step and of dhat: by more than that a body has been held up


def corrected(of: ContactStep, x: Tensor, collider: Tensor, start: PartStart, listed: Pairs,
              more: More = once) -> Corrected:  # fmt: skip
    """After the rigid correction of all free bodies, and after others, as ``more`` says."""
    numbers = of.prepared.settings.numbers
    eps = 0.0 if of.model.friction is None else numbers.friction_eps
    return correct(of.model, touching(of, x, collider, start, listed), numbers.time_step, eps, more)


def touching(of: ContactStep, x: Tensor, collider: Tensor, start: PartStart, listed: Pairs) -> ops.TouchingFields:
    """Parts of all potentials of whole bodies, at x [B, V, 3]."""
    lagged = of.lagged
    return ops.TouchingFields(
        x, of.x_prev, of.begun.y, of.fields.mass, of.begun.data, of.origin, *bodies_of(of.model), collider, of.before,
        of.kappa, *listed, of.lag, lagged.pairs, lagged.ptr, lagged.entry, of.floor_lag, start.center, start.room,
    )  # fmt: skip


def corrected_after(of: ContactStep, x: Tensor, collider: Tensor, start: PartStart, listed: Pairs, last: bool
                    ) -> Corrected:  # fmt: skip
    """After the corrections that follow the sweeps of a part. last: Whether these are the last sweeps."""
    # coarse sweeps leave a stiff body turned, and one Newton step leaves so much of that that a free body gained spin
    least = 1 if of.prepared.coarse is None else 2
    bodies = of.model.mesh.num_bodies
    grouped, captured = bodies <= most_grouped(bodies), is_captured(x)

    def more(count: int, end: Moved, groups: Tensor) -> Which | None:
        if count < least:
            return Which()
        if not last or of.barrier is None or count >= (HELD_CORRECTIONS if grouped else LEFT_CORRECTIONS):
            return None
        alone = count >= HELD_CORRECTIONS
        left = None if grouped else left_alone(groups)
        if not captured:
            some_held = not alone and bool(end.held.any())
            if not some_held and (left is None or not bool(left.any())):
                return None
            alone = not some_held
        return Which(end.held if left is None else left if alone else end.held | left, alone)

    return corrected(of, x, collider, start, listed, more)


def is_cut(of: ContactStep, x: Tensor, back: Tensor) -> Tensor:
    """The vertices [B, V] of bodies that were held up at the end, at x [B, V, 3]; back: of Corrected."""
    assert of.barrier is not None
    way = (x.detach() - of.x_prev.detach()).norm(dim=-1)
    body = of.model.derived("labels", lambda: of.model.body)
    return back[:, body] > HELD * (way + of.barrier.dhat)
