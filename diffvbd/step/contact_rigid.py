"""The rigid corrections of a substep (docs/method.md, section 18): one before its sweeps and one after them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import torch
from torch import Tensor

from .. import ops
from ..adjoint.contact import Pairs, sum_of_scenes
from ..model.system import System
from ..ops.contact import Corrected, SubstepStart, rigid_correct, rigid_reverse

# --- the rigid correction of bodies that touch ------------------------------------------------------------------------

_FIELDS = len(ops.TouchingFields._fields)


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


def _run(*args: Any) -> Corrected:
    fields, (model, *options) = ops.TouchingFields(*args[:_FIELDS]), args[_FIELDS:]
    return rigid_correct(fields, model._data_count, *options)


def _reverse(bars: Sequence[Any], saved: Sequence[Any], rest: tuple, needs: Sequence[bool]) -> list[Any]:
    """Adjoints of the fields. saved: These, and what each body took."""
    f, taken, (model, h, eps, majorizes) = ops.TouchingFields(*saved[:_FIELDS]), saved[_FIELDS], rest
    wants = dict(zip(f._fields, needs, strict=True))
    own = rigid_reverse(f, taken, bars[0], model._data_count, h, eps, majorizes, wants["energy_data"])._asdict()
    by_kappa = own.pop("by_kappa")
    if wants["kappa"]:
        own["kappa"] = -sum_of_scenes(by_kappa, listed_of(f), f.x.shape[0])
    return [own.get(name) for name in f._fields]


# Fields; model, time_step, friction_eps, majorizes.
_correct = ops.Differentiable(
    _run, _reverse, arguments=_FIELDS + 4, inputs=_FIELDS, saved=lambda inputs, made: (*inputs[:_FIELDS], made[1]),
    rest=lambda inputs: inputs[_FIELDS:],
)  # fmt: skip


def listed_of(f: ops.TouchingFields) -> Pairs:
    """The pairs with a barrier."""
    return Pairs(f.pairs, f.constants, f.pair_ptr, f.pair_entry)


# --- rigid corrections of a substep -----------------------------------------------------------------------------------

BLOCKED = 0.01  # of its displacement in the step plus dhat: a body that misses more is blocked


def corrected(of: Any, x: Tensor, collider: Tensor, start: SubstepStart, listed: Pairs,
              majorizes: bool = False) -> Corrected:  # fmt: skip
    """State after a rigid correction of every free body; all but x is index data. majorizes: As of rigid_correct().
    Differentiable in ops.TOUCHING_ADJOINTS."""
    numbers = of.prepared.settings.numbers
    eps = 0.0 if of.model.friction is None else numbers.friction_eps  # [m], 0 without friction
    fields = [t.contiguous() for t in touching(of, x, collider, start, listed)]
    return Corrected(*_correct(*fields, of.model, numbers.time_step, eps, majorizes))


def touching(of: Any, x: Tensor, collider: Tensor, start: SubstepStart, listed: Pairs) -> ops.TouchingFields:
    """Fields of the rigid correction, at x [B, V, 3]."""
    lagged, bodies = of.lagged, cast("tuple[Tensor, Tensor, Tensor, Tensor, Tensor]", of.bodies)
    return ops.TouchingFields(
        x, of.x_prev, of.begun.y, of.fields.mass, of.begun.at(x).data, of.origin, *bodies, collider,
        of.before, of.kappa, *listed, of.lag, lagged.pairs, lagged.ptr, lagged.entry, of.floor_lag, start.center,
        start.trust_radius,
    )  # fmt: skip


def is_blocked(of: Any, x: Tensor, back: Tensor) -> Tensor:
    """Vertices [B, V] of bodies blocked at the end, at x [B, V, 3]; back: `remaining` of the last correction."""
    assert of.barrier is not None
    displacement = (x.detach() - of.x_prev.detach()).norm(dim=-1)
    body = of.model.derived("labels", lambda: of.model.body)
    return back[:, body] > BLOCKED * (displacement + of.barrier.dhat)
