"""The rigid corrections of a substep (docs/method.md, section 18): one before its sweeps, one after them, and more of
blocked bodies after the last sweeps."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from .. import ops
from .._common.context import is_captured, replaced
from .._contact.start import SubstepStart
from ..adjoint.contact import Pairs, sum_of_scenes
from ..model.system import System
from ..ops import contact as ops_rigid
from ..ops.contact import Moved, left_alone
from ..ops.fields import most_grouped

# --- the rigid correction of bodies that touch ------------------------------------------------------------------------

_FIELDS = len(ops.TouchingFields._fields)


class Corrected(NamedTuple):
    """State after corrections; all but x is index data."""

    x: Tensor  # [B, V, 3]
    fractions: list[Tensor]  # step fractions of each correction [B, bodies]
    back: Tensor  # translation that each did not take of its last motion [B, bodies] [m]


class Which(NamedTuple):
    """Bodies that a correction moves; see ops.contact.rigid_system."""

    moving: Tensor | None = None  # bool [B, bodies]; None: all
    alone: bool = False


# more(count, moved, groups): bodies of the next correction, after `count` of them, from the results of the last one;
# None ends them.
More = Callable[[int, ops_rigid.Moved, Tensor], Which | None]


def once(*_: Any) -> None:
    """Ends the corrections after the first."""


def correct(model: System, fields: ops.TouchingFields, time_step: float, friction_eps: float,
            more: More = once) -> Corrected:  # fmt: skip
    """State after the rigid correction of every free body, by an admissible step fraction, and after those that
    ``more`` adds. friction_eps: [m], 0 without friction. Differentiable in ops.TOUCHING_ADJOINTS."""
    fields = ops.TouchingFields(*[t.contiguous() for t in fields])
    kept = torch.is_grad_enabled() and any([t.requires_grad for t in fields])
    x, back, *rest = _correct(*fields, model, time_step, friction_eps, more, kept)
    fractions = _made(fields.x, rest).fraction if kept else rest
    return Corrected(x, [fraction.to(x.dtype) for fraction in fractions], back)


def _made(x: Tensor, flat: Sequence[Tensor]) -> ops_rigid.Made:
    """Corrections from the saved list: motion, fraction, factor and groups of each, and between two of them the state
    before the second. x: State before the first."""
    return ops_rigid.Made([x, *flat[4::5]], *(flat[k::5] for k in range(4)))


def bodies_of(model: System) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """order, ptr, free, pinned and body of ops.TouchingFields."""
    return model.derived("touching_bodies", lambda: _bodies_of(model))


def _bodies_of(model: System) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    surface, count = model.surface_of_contact, model.mesh.num_bodies
    pins = torch.zeros((count,), dtype=torch.int64, device=model.device).index_add(0, model.body, model._pinned.long())
    free = pins == 0
    if surface is not None:
        return surface.body_order, surface.body_ptr, free, surface.pinned, surface.body
    body, order = torch.sort(model.body, stable=True)
    ptr = torch.searchsorted(body, torch.arange(count + 1, device=body.device))
    return order.to(torch.int32), ptr.to(torch.int32), free, model._pinned, model.body.to(torch.int32)


def _run(*args: Any) -> tuple[Tensor, ...]:
    fields, (model, time_step, friction_eps, more, kept) = ops.TouchingFields(*args[:_FIELDS]), args[_FIELDS:]
    options, made, count, back = (model._data_count, time_step, friction_eps), [], 0, fields.x
    which: Which | None = Which()
    while which is not None:
        if count and kept:
            made.append(fields.x)
        centers, motion, factor, groups = ops_rigid.rigid_system(fields, *options, which.moving, which.alone)
        end = ops_rigid.rigid_move(fields, centers, motion, *options, which.moving)
        made.extend([motion, end.fraction, factor, groups] if kept else [end.fraction])
        back = end.remaining if which.moving is None else torch.where(end.moved, end.remaining, back)
        count, fields = count + 1, replaced(fields, x=end.x)
        which = more(count, end, groups)
    return fields.x, back, *made


def _reverse(bars: Sequence[Any], saved: Sequence[Any], rest: tuple, needs: Sequence[bool]) -> list[Any]:
    f = ops.TouchingFields(*saved[:_FIELDS])
    return _adjoints(f, bars[0], _made(f.x, saved[_FIELDS:]), needs, *rest)


def _adjoints(f: ops.TouchingFields, x_bar: Tensor, made: ops_rigid.Made, needs: Sequence[bool], model: System,
              time_step: float, friction_eps: float) -> list[Tensor | None]:  # fmt: skip
    """Adjoints of the fields."""
    wants = dict(zip(f._fields, needs, strict=True))
    own = ops_rigid.rigid_reverse(f, made, x_bar, model._data_count, time_step, friction_eps,
                                  wants["energy_data"])._asdict()  # fmt: skip
    by_kappa = own.pop("by_kappa")
    if wants["kappa"]:
        own["kappa"] = -sum_of_scenes(by_kappa, listed_of(f), f.x.shape[0])
    return [own.get(name) for name in f._fields]


# Fields; model, time_step, friction_eps, more, kept.
_correct = ops.Differentiable(
    _run, _reverse, arguments=_FIELDS + 5, inputs=_FIELDS, saved=lambda inputs, made: (*inputs[:_FIELDS], *made[2:]),
    rest=lambda inputs: inputs[_FIELDS:-2],
)  # fmt: skip


def listed_of(f: ops.TouchingFields) -> Pairs:
    """The pairs with a barrier."""
    return Pairs(f.pairs, f.constants, f.pair_ptr, f.pair_entry)


# --- rigid corrections of a substep -----------------------------------------------------------------------------------

# Rigid corrections after the last sweeps while bodies are blocked: they first approach the blocking bodies, then push
# them. A row of four cubes that meet at 3 m/s lost 14 % of its momentum with one correction and none with three; at
# 10 m/s that takes five.
BLOCKED_CORRECTIONS = 5
# The same where touching bodies are too many to be corrected together. In stacks of two with friction the upper body
# creeps at 3.4 mm/s with 3, 2.0 with 4 and 1.1 with 6; stacks of four fell with 6.
LEFT_CORRECTIONS = 8
BLOCKED = 0.01  # of its displacement in the step plus dhat: a body that misses more is blocked


def corrected(of: Any, x: Tensor, collider: Tensor, start: SubstepStart, listed: Pairs, more: More = once) -> Corrected:
    """State after the rigid correction of all free bodies, and after those that ``more`` adds."""
    numbers = of.prepared.settings.numbers
    eps = 0.0 if of.model.friction is None else numbers.friction_eps
    return correct(of.model, touching(of, x, collider, start, listed), numbers.time_step, eps, more)


def touching(of: Any, x: Tensor, collider: Tensor, start: SubstepStart, listed: Pairs) -> ops.TouchingFields:
    """Fields of the rigid correction, at x [B, V, 3]."""
    lagged = of.lagged
    return ops.TouchingFields(
        x, of.x_prev, of.begun.y, of.fields.mass, of.begun.at(x).data, of.origin, *bodies_of(of.model), collider,
        of.before, of.kappa, *listed, of.lag, lagged.pairs, lagged.ptr, lagged.entry, of.floor_lag, start.center,
        start.trust_radius,
    )  # fmt: skip


def corrected_after(of: Any, x: Tensor, collider: Tensor, start: SubstepStart, listed: Pairs, last: bool) -> Corrected:
    """State after the corrections that follow the sweeps of a substep. last: Whether these are the last sweeps."""
    # coarse sweeps leave a stiff body rotated; after one Newton step a free body still gained spin
    least = 1 if of.prepared.coarse is None else 2
    bodies = len(bodies_of(of.model)[2])
    grouped, captured = bodies <= most_grouped(bodies), is_captured(x)

    def more(count: int, end: Moved, groups: Tensor) -> Which | None:
        if count < least:
            return Which()
        if not last or of.barrier is None or count >= (BLOCKED_CORRECTIONS if grouped else LEFT_CORRECTIONS):
            return None
        alone = count >= BLOCKED_CORRECTIONS
        left = None if grouped else left_alone(groups)
        if not captured:
            some_blocked = not alone and bool(end.blocked.any())
            if not some_blocked and (left is None or not bool(left.any())):
                return None
            alone = not some_blocked
        return Which(end.blocked if left is None else left if alone else end.blocked | left, alone)

    return corrected(of, x, collider, start, listed, more)


def is_blocked(of: Any, x: Tensor, back: Tensor) -> Tensor:
    """Vertices [B, V] of bodies blocked at the end, at x [B, V, 3]; back: Of Corrected."""
    assert of.barrier is not None
    displacement = (x.detach() - of.x_prev.detach()).norm(dim=-1)
    body = of.model.derived("labels", lambda: of.model.body)
    return back[:, body] > BLOCKED * (displacement + of.barrier.dhat)
