"""The rigid correction of bodies that touch: all bodies of a scene moved, each as a whole, by one Newton step of the
step's potential over their rigid motions.

    min over (w_b, t_b)   1/2 sum m |x - y|^2 + energies of single vertices + barriers, friction and damping of pairs

A rigid motion leaves the energy of the tets as it is, so that this costs sums over vertices and pairs, and six unknowns
a body. It is what few sweeps do worst: they see neighbours, not the body. The share of its motion that each body takes
is decided, not differentiated. docs/method.md, section 18.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from .. import ops
from ..adjoint.contact_lag import sum_of_scenes
from ..model.system import System
from ..ops import contact as ops_rigid
from ..tuples import replaced
from .rigid_terms import Scenes

_FIELDS = len(ops.TouchingFields._fields)


class Corrected(NamedTuple):
    """State after corrections; all but x is index data."""

    x: Tensor  # [B, V, 3]
    shares: list[Tensor]  # of its motion that each body took of each [B, bodies]
    back: Tensor  # how much of its last shift each did not take [B, bodies] [m]


class Which(NamedTuple):
    """Bodies that a correction is to move, as of ops.contact.rigid_system."""

    moving: Tensor | None = None  # bool [B, bodies]; None: all
    alone: bool = False


# more(count, moved, groups): which bodies the next correction moves, after `count` of them, by what the last one
# returned; None ends them.
More = Callable[[int, ops_rigid.Moved, Tensor], Which | None]


def once(*_: Any) -> None:
    """One correction, and no more."""


def correct(model: System, fields: ops.TouchingFields, time_step: float, friction_eps: float,
            more: More = once) -> Corrected:  # fmt: skip
    """After every free body has been moved, as far as pairs, floors and the potential let it, and then again as
    ``more`` says. friction_eps: [m], 0 without friction. Differentiable in ops.TOUCHING_ADJOINTS."""
    fields = ops.TouchingFields(*(t.contiguous() for t in fields))
    kept = torch.is_grad_enabled() and any(t.requires_grad for t in fields)
    x, back, *rest = _correct(*fields, model, time_step, friction_eps, more, kept)
    shares = _made(fields.x, rest).share if kept else rest
    return Corrected(x, [share.to(x.dtype) for share in shares], back)


def _made(x: Tensor, flat: Sequence[Tensor]) -> ops_rigid.Made:
    """Takes apart what _Correct keeps: motion, share, factor and groups of each correction, and between two of them
    where the second began. x: Where the first did."""
    return ops_rigid.Made([x, *flat[4::5]], *(flat[k::5] for k in range(4)))


def bodies_of(model: System) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """order, ptr, free, held and body of ops.TouchingFields."""
    return model.derived("touching_bodies", lambda: _bodies_of(model))


def _bodies_of(model: System) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    surface, count = model.surface_of_contact, model.mesh.num_bodies
    pins = torch.zeros((count,), dtype=torch.int64, device=model.device).index_add(0, model.body, model._pinned.long())
    free = pins == 0
    if surface is not None:
        return surface.body_order, surface.body_ptr, free, surface.held, surface.body
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
        made.extend([motion, end.share, factor, groups] if kept else [end.share])
        back = end.left if which.moving is None else torch.where(end.moved, end.left, back)
        count, fields = count + 1, replaced(fields, x=end.x)
        which = more(count, end, groups)
    return fields.x, back, *made


def _reverse(bars: Sequence[Any], saved: Sequence[Any], rest: tuple, needs: Sequence[bool]) -> list[Any]:
    model, time_step, friction_eps = rest
    s = Scenes(model, ops.TouchingFields(*saved[:_FIELDS]), time_step,
               friction_eps or 1.0)  # which loads that are zero do not read  # fmt: skip
    return _adjoints(s, bars[0], _made(saved[0], saved[_FIELDS:]), needs)


# Fields; model, time_step, friction_eps, more, kept.
_correct = ops.Differentiable(
    _run, _reverse, arguments=_FIELDS + 5, inputs=_FIELDS, saved=lambda inputs, made: (*inputs[:_FIELDS], *made[2:]),
    rest=lambda inputs: inputs[_FIELDS:-2],
)  # fmt: skip


def _adjoints(s: Scenes, x_bar: Tensor, made: ops_rigid.Made, needs: Sequence[bool]) -> list[Tensor | None]:
    """Of the fields. With H d = -g, the adjoint of d is that of -l . (g + H d), where H l is the adjoint
    of d: a sum over vertices and pairs."""
    f = s.fields
    wants = dict(zip(ops.TouchingFields._fields, needs, strict=True))
    own = ops_rigid.rigid_reverse(f, made, x_bar, s.model._data_count, s.time_step, s.friction_eps,
                                  wants["energy_data"])._asdict()  # fmt: skip
    by_kappa = own.pop("by_kappa")
    if wants["kappa"]:
        own["kappa"] = -sum_of_scenes(by_kappa, s.listed, f.x.shape[0])
    return [own.get(name) for name in f._fields]
