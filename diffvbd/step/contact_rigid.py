"""The rigid corrections of a substep (docs/method.md, section 18): one before its sweeps, one after them, and more of
blocked bodies."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from .. import ops
from .._common.context import is_captured, replaced
from ..adjoint.contact import Pairs, sum_of_scenes
from ..model.system import System
from ..ops.contact import SubstepStart, rigid_correct, rigid_reverse

# --- the rigid correction of bodies that touch ------------------------------------------------------------------------

_FIELDS = len(ops.TouchingFields._fields)


class Corrections(NamedTuple):
    """State after corrections; all but x is index data."""

    x: Tensor  # [B, V, 3]
    fractions: list[Tensor]  # step fractions of each correction [B, bodies]
    back: Tensor  # translation that each did not take of its last motion [B, bodies] [m]


def correct(model: System, fields: ops.TouchingFields, time_step: float, friction_eps: float, most: int = 1,
            majorizes: bool = False) -> Corrections:  # fmt: skip
    """State after a rigid correction of every free body by an admissible step fraction, and after those of blocked
    bodies, or solved for alone, that follow until there are ``most``. friction_eps: [m], 0 without friction.
    majorizes: As of rigid_correct().
    Differentiable in ops.TOUCHING_ADJOINTS."""
    fields = ops.TouchingFields(*[t.contiguous() for t in fields])
    kept = torch.is_grad_enabled() and any([t.requires_grad for t in fields])
    x, back, *made = _correct(*fields, model, time_step, friction_eps, majorizes, most, kept)
    return Corrections(x, [fraction.to(x.dtype) for fraction in (made[::2] if kept else made)], back)


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
    fields, (model, h, eps, majorizes, most, kept) = ops.TouchingFields(*args[:_FIELDS]), args[_FIELDS:]
    made, back, moving, captured = [], fields.x, None, is_captured(fields.x)
    for count in range(1, most + 1):
        end = rigid_correct(fields, model._data_count, h, eps, majorizes, moving)
        made.append(end.fraction)
        back = end.remaining if moving is None else torch.where(end.moved, end.remaining, back)
        fields = replaced(fields, x=end.x)
        moving = end.blocked | end.alone
        if count == most or not (captured or bool(moving.any())):
            break
        if kept:
            made.append(end.x)
    return fields.x, back, *made


def _reverse(bars: Sequence[Any], saved: Sequence[Any], rest: tuple, needs: Sequence[bool]) -> list[Any]:
    """Adjoints of the fields. saved: These, and of each correction its fraction, between two of them the state."""
    f, made, (model, h, eps, majorizes) = ops.TouchingFields(*saved[:_FIELDS]), saved[_FIELDS:], rest
    wants = dict(zip(f._fields, needs, strict=True))
    own = rigid_reverse(f, [f.x, *made[1::2]], made[::2], bars[0], model._data_count, h, eps, majorizes,
                        wants["energy_data"])._asdict()  # fmt: skip
    by_kappa = own.pop("by_kappa")
    if wants["kappa"]:
        own["kappa"] = -sum_of_scenes(by_kappa, listed_of(f), f.x.shape[0])
    return [own.get(name) for name in f._fields]


# Fields; model, time_step, friction_eps, majorizes, most, kept.
_correct = ops.Differentiable(
    _run, _reverse, arguments=_FIELDS + 6, inputs=_FIELDS, saved=lambda inputs, made: (*inputs[:_FIELDS], *made[2:]),
    rest=lambda inputs: inputs[_FIELDS:-2],
)  # fmt: skip


def listed_of(f: ops.TouchingFields) -> Pairs:
    """The pairs with a barrier."""
    return Pairs(f.pairs, f.constants, f.pair_ptr, f.pair_entry)


# --- rigid corrections of a substep -----------------------------------------------------------------------------------

# Rigid corrections after sweeps while bodies are blocked, which first approach the blocking bodies and then push them,
# or are solved for alone. Four cubes in a row that meet at 3 m/s lose momentum with one correction, and ten with coarse
# corrections with five.
MOST_CORRECTIONS = 6
BLOCKED = 0.01  # of its displacement in the step plus dhat: a body that misses more is blocked


def corrected(of: Any, x: Tensor, collider: Tensor, start: SubstepStart, listed: Pairs, most: int = 1,
              majorizes: bool = False) -> Corrections:  # fmt: skip
    """State after the rigid corrections of a step; most and majorizes as of correct()."""
    numbers = of.prepared.settings.numbers
    eps = 0.0 if of.model.friction is None else numbers.friction_eps
    return correct(of.model, touching(of, x, collider, start, listed), numbers.time_step, eps, most, majorizes)


def touching(of: Any, x: Tensor, collider: Tensor, start: SubstepStart, listed: Pairs) -> ops.TouchingFields:
    """Fields of the rigid correction, at x [B, V, 3]."""
    lagged = of.lagged
    return ops.TouchingFields(
        x, of.x_prev, of.begun.y, of.fields.mass, of.begun.at(x).data, of.origin, *bodies_of(of.model), collider,
        of.before, of.kappa, *listed, of.lag, lagged.pairs, lagged.ptr, lagged.entry, of.floor_lag, start.center,
        start.trust_radius,
    )  # fmt: skip


def is_blocked(of: Any, x: Tensor, back: Tensor) -> Tensor:
    """Vertices [B, V] of bodies blocked at the end, at x [B, V, 3]; back: Of Corrected."""
    assert of.barrier is not None
    displacement = (x.detach() - of.x_prev.detach()).norm(dim=-1)
    body = of.model.derived("labels", lambda: of.model.body)
    return back[:, body] > BLOCKED * (displacement + of.barrier.dhat)
