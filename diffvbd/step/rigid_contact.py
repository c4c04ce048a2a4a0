"""The rigid correction of bodies that touch: all bodies of a scene moved, each as a whole, by one Newton step of the
step's potential over their rigid motions.

    min over (w_b, t_b)   1/2 sum m |x - y|^2 + energies of single vertices + barriers, friction and damping of pairs

A rigid motion leaves the energy of the tets as it is, so that this costs sums over vertices and pairs, and six unknowns
a body. It is what few sweeps do worst: they see neighbours, not the body. The share of its motion that each body takes
is decided, not differentiated. docs/method.md, section 18.
"""

# pyright: reportIncompatibleMethodOverride=false
from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from .. import ops
from ..adjoint.contact_lag import sum_of_scenes
from ..model.model import Model
from ..ops import Backward, Direct, no_transforms, of_inputs
from ..ops import contact_rigid as ops_rigid
from .rigid_terms import Scenes

_FIELDS = len(ops.TouchingFields._fields)


class Corrected(NamedTuple):
    """What a correction returns; all but x is index data."""

    x: Tensor  # [B, V, 3]
    share: Tensor  # of its motion that each body took [B, bodies]; the next as ops.contact_rigid.Moved has them
    moved: Tensor
    held: Tensor
    left: Tensor
    groups: Tensor  # as ops.contact_rigid has them


def correct(model: Model, fields: ops.TouchingFields, time_step: float, friction_eps: float,
            moving: Tensor | None = None, alone: bool = False) -> Corrected:  # fmt: skip
    """After every free body has been moved, as far as pairs, floors and the potential let it. friction_eps: [m], 0
    without friction. moving, alone: As for ops.contact_rigid.rigid_system. Differentiable in ops.TOUCHING_ADJOINTS."""
    fields = ops.TouchingFields(*(t.contiguous() for t in fields))
    out = _Correct.apply(*fields, model, time_step, friction_eps, moving, alone)
    x, share, _, _, groups, moved, held, left = out
    return Corrected(x, share.to(x.dtype), moved, held, left, groups)


def bodies_of(model: Model) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """order, ptr, free, held and body of ops.TouchingFields."""
    return model.derived("touching_bodies", lambda: _bodies_of(model))


def _bodies_of(model: Model) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    surface, count = model.surface_of_contact, model.mesh.num_bodies
    pins = torch.zeros((count,), dtype=torch.int64, device=model.device).index_add(0, model.body, model._pinned.long())
    free = pins == 0
    if surface is not None:
        return surface.body_order, surface.body_ptr, free, surface.held, surface.body
    body, order = torch.sort(model.body, stable=True)
    ptr = torch.searchsorted(body, torch.arange(count + 1, device=body.device))
    return order.to(torch.int32), ptr.to(torch.int32), free, model._pinned, model.body.to(torch.int32)


class _Correct(Direct):
    @staticmethod
    def forward(x, x_prev, y, mass, energy_data, origin, order, ptr, free, held, body, collider, collider_prev, kappa,
                pairs, constants, pair_ptr, pair_entry, lag, lag_pairs, lag_ptr, lag_entry, floor_lag, center, room,
                model, time_step, friction_eps, moving, alone):  # fmt: skip
        fields = ops.TouchingFields(x, x_prev, y, mass, energy_data, origin, order, ptr, free, held, body, collider,
                                    collider_prev, kappa, pairs, constants, pair_ptr, pair_entry, lag, lag_pairs,
                                    lag_ptr, lag_entry, floor_lag, center, room)  # fmt: skip
        counts = model._data_count
        centers, motion, factor, groups = ops_rigid.rigid_system(fields, counts, time_step, friction_eps, moving, alone)
        end = ops_rigid.rigid_move(fields, centers, motion, counts, time_step, friction_eps, moving)
        return end.x, end.share, motion, factor, groups, end.moved, end.held, end.left

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: tuple[Tensor, ...]) -> None:
        ctx.save_for_backward(*inputs[:_FIELDS], *output[1:5])
        ctx.options = inputs[_FIELDS:-2]
        ctx.mark_non_differentiable(*output[1:])
        ctx.set_materialize_grads(False)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor | None) -> tuple:
        if grads[0] is None:
            return (None,) * (_FIELDS + 5)
        ops.not_batched(grads[0])
        needs = ctx.needs_input_grad[:_FIELDS]
        out = _CorrectBackward.apply(grads[0], *ctx.saved_tensors, *ctx.options, needs)
        return of_inputs(out if isinstance(out, tuple) else (out,), needs, 5)

    @staticmethod
    def vmap(info: Any, in_dims: tuple, *args: Any) -> Any:
        no_transforms()


class _CorrectBackward(Backward):
    @staticmethod
    def forward(x_bar, x, x_prev, y, mass, energy_data, origin, order, ptr, free, held, body, collider, collider_prev,
                kappa, pairs, constants, pair_ptr, pair_entry, lag, lag_pairs, lag_ptr, lag_entry, floor_lag, center,
                room, share, motion, factor, groups, model, time_step, friction_eps, needs):  # fmt: skip
        # torch.compile counts these arguments: *args would get the context as well
        fields = ops.TouchingFields(x, x_prev, y, mass, energy_data, origin, order, ptr, free, held, body, collider,
                                    collider_prev, kappa, pairs, constants, pair_ptr, pair_entry, lag, lag_pairs,
                                    lag_ptr, lag_entry, floor_lag, center, room)  # fmt: skip
        s = Scenes(model, fields, time_step, friction_eps or 1.0)  # which loads that are zero do not read
        return _adjoints(s, x_bar, share, motion, factor, groups, needs)


def _adjoints(s: Scenes, x_bar: Tensor, share: Tensor, motion: Tensor, factor: Tensor, groups: Tensor,
              needs: Sequence[bool]) -> tuple[Tensor, ...]:  # fmt: skip
    """Of the fields that need one. With H d = -g, the adjoint of d is that of -l . (g + H d), where H l is the adjoint
    of d: a sum over vertices and pairs."""
    f, (scenes, vertices) = s.fields, s.fields.x.shape[:2]
    wants = dict(zip(ops.TouchingFields._fields, needs, strict=True))
    own = ops_rigid.rigid_reverse(f, motion, share, factor, groups, x_bar, s.model._data_count, s.time_step,
                                  s.friction_eps, wants["energy_data"])  # fmt: skip
    out: dict[str, Callable[[], Tensor]] = {  # few are wanted, and each is a launch
        "x": lambda: own.x,
        "x_prev": lambda: own.x_prev,
        "y": lambda: own.y,
        "mass": lambda: own.mass,
        "energy_data": lambda: own.energy_data,
        "collider": lambda: -own.by_x[:, vertices:],
        "collider_prev": lambda: own.since[:, vertices:] if len(own.since) else torch.zeros_like(f.collider),
        "kappa": lambda: -sum_of_scenes(own.by_kappa, s.listed, scenes),
        "lag": lambda: own.lag_bar,
        "floor_lag": lambda: own.floor_lag,
    }
    bars = []
    for name, t in zip(f._fields, f, strict=True):
        if wants[name]:
            bar = out[name]() if name in out else t.new_empty((0,))
            bars.append(ops.sum_to(bar, t.shape) if bar.numel() else torch.zeros_like(t))
    return tuple(bars)
