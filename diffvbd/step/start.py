"""Where a step begins: the predictor y = x + h v + h^2 a, and where its sweeps start.

A body that is corrected coasts: all of its vertices go one share of h v less what in h v is a turn (on straight lines
it would stretch the body), as far as planes let it, and the body is corrected there (rigid.py). Where planes hold it
back and steps are short, its vertices go each by itself instead. Any other body starts from y or from x + h v, every
vertex as far as planes let it. Few sweeps hardly move a stiff body away from its start, so "auto" takes, for each body
and step, the one of lower incremental potential: y where a body is soft or flies, x + h v where its pins carry it.
docs/method.md, sections 6, 14.
"""

# pyright: reportIncompatibleMethodOverride=false
from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd import Function

from .. import ops
from ..model.bodies import Bodies, OtherBodies
from ..ops import distinct, no_second_derivative, of_inputs, one_by_one
from ..ops import rigid as ops_rigid
from ..ops.begin import STARTS
from ..safeguards import FILTER_ETA
from ..tuples import replaced
from .rigid import folded, needed

_TENSORS = 6  # differentiable fields: x, v, acceleration, prescribed, mass, energy_data
_SCENES = 10  # and origin, mu, lam, rest: what has a scene dimension
_FIELDS = len(ops.BeginFields._fields)


class _Begin(Function):
    @staticmethod
    def forward(x, v, acceleration, prescribed, mass, energy_data, origin, mu, lam, rest, pinned, order, ptr, spread,
                tets, tet_ptr, other, other_order, other_ptr, other_tets, other_tet_ptr, groups, other_groups,
                options):  # fmt: skip
        # torch.compile counts these arguments: *args would get the context as well
        fields = ops.BeginFields(x, v, acceleration, prescribed, mass, energy_data, origin, mu, lam, rest, pinned,
                                 order, ptr, spread, tets, tet_ptr, other, other_order, other_ptr, other_tets,
                                 other_tet_ptr)  # fmt: skip
        return ops.raw.begin(*ops.as_list(fields, x), groups, other_groups, *options)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: tuple[Tensor, Tensor, Tensor, Tensor]) -> None:
        read = replaced(ops.BeginFields(*inputs[:_FIELDS]), mu=None, lam=None, rest=None)  # by the backward
        ctx.save_for_backward(*output[2:], *read)
        ctx.options = (inputs[_FIELDS], *inputs[-1][:-1])  # `parts` shows in what was decided
        ctx.mark_non_differentiable(*output[2:])

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple:
        needs = ctx.needs_input_grad[:_TENSORS]
        out = _BeginBackward.apply(*grads[:2], *ctx.saved_tensors, ctx.options, needs)
        return of_inputs(out, needs, len(ctx.needs_input_grad) - _TENSORS)

    @staticmethod
    def vmap(info: Any, in_dims: tuple, *args: Any) -> tuple[tuple[Tensor, ...], tuple[int, ...]]:
        tensors, _ = folded(info.batch_size, args[:_SCENES], in_dims, 2)
        out = _Begin.apply(*tensors, *args[_SCENES:])
        shapes = [(info.batch_size, t.shape[0] // info.batch_size) for t in out]  # decisions may have no scene
        return tuple(t.unflatten(0, shape) for t, shape in zip(out, shapes, strict=True)), (0,) * len(out)


class _BeginBackward(Function):
    @staticmethod
    def forward(x_start_bar, y_bar, falls, alone, x, v, acceleration, prescribed, mass, energy_data, origin, mu, lam,
                rest, pinned, order, ptr, spread, tets, tet_ptr, other, other_order, other_ptr, other_tets,
                other_tet_ptr, options, needs):  # fmt: skip
        fields = ops.BeginFields(x, v, acceleration, prescribed, mass, energy_data, origin, mu, lam, rest, pinned,
                                 order, ptr, spread, tets, tet_ptr, other, other_order, other_ptr, other_tets,
                                 other_tet_ptr)  # fmt: skip
        wants = (needs[2], needs[3], needs[5])
        *bars, shared, own, planes = ops.raw.begin_backward(
            *ops.as_list(fields, x), x_start_bar.contiguous(), y_bar.contiguous(), falls, alone, *options, wants
        )
        data_out = energy_data
        if needs[5]:
            data_out = ops_rigid.join_data(shared, own, options[1])
            if planes.numel():  # the first energy's data
                of_planes = ops.sum_to(planes, (planes.shape[0], 1, planes.shape[2]))[:, 0]
                count = planes.shape[2]
                first, others_out = data_out.narrow(1, 0, count), data_out.narrow(1, count, data_out.shape[1] - count)
                data_out = torch.cat([first + of_planes, others_out], 1)
        return needed((*bars, data_out), fields, needs)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: tuple[Tensor, ...]) -> None:
        pass

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Any:
        no_second_derivative()

    @staticmethod
    def vmap(info: Any, in_dims: tuple, *args: Any) -> tuple[tuple[Tensor, ...], tuple[int, ...]]:
        """Several adjoints, one after another."""
        return one_by_one(_BeginBackward, info.batch_size, in_dims, args)


def begin(
    x: Tensor, v: Tensor, acceleration: Tensor, prescribed: Tensor | None, mass: Tensor, energy_data: Tensor,
    origin: Tensor | None, mu: Tensor, lam: Tensor, rest: Tensor | None, pinned: Tensor, bodies: Bodies,
    others: OtherBodies, data_count: tuple[int, ...], time_step: float, chord: float, *, start: str, filters: bool,
    parts: bool,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Where the sweeps start and the predictor [m], both [B, V, 3]; differentiable in the first six tensors.

    Args:
        x, v: State [m, m/s], [B, V, 3].  acceleration: [1 | B, 1 | V, 3] [m/s^2].
        prescribed: Where pinned vertices go [m], [1 | B, V, 3]; None: they stay.
        mass, energy_data, origin, mu, lam: As in ops.SweepFields.  pinned: bool [V].
        rest: [1 | B, T, 7], or None where tets have no energy; like mu and lam looked at by choices alone.
        chord: How far back along its way h v a vertex is taken to have been, over h: 1 where v = (x - x_prev) / h.
        start: "auto", "predictor" or "inertia", of the bodies that are not corrected.
        filters: Whether the planes of a floor hold back a start.
        parts: Whether bodies that are held back may start vertex by vertex, for which there must be filters.
    """
    # what choices look at must not seem to want a gradient: there is none, and compiled autograd adds it up
    looked_at = (t if t is None else t.detach() for t in (mu, lam, rest))
    tensors = distinct(x, v, acceleration, prescribed, mass, energy_data, origin, *looked_at)
    *listed, groups = bodies
    *listed_others, other_groups = others
    options = (data_count, time_step, FILTER_ETA, chord, STARTS[start], filters)
    x_start, y, *_ = _Begin.apply(*tensors, pinned, *listed, *listed_others, groups, other_groups, (*options, parts))
    return x_start, y


ops.ready_signature(_Begin, _BeginBackward)
