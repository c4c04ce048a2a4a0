"""Start of a step: the predictor y = x + h v + h^2 a, and where its sweeps start.

A body that is corrected coasts: all of its vertices go one share of h v less what in h v is a turn (on straight lines
it would stretch the body), as far as planes let it, and the body is corrected there (rigid.py). Where planes hold it
back and steps are short, its vertices go each by itself instead. Any other body starts from y or from x + h v, every
vertex as far as planes let it. Few sweeps hardly move a stiff body away from its start, so "auto" takes, for each body
and step, the one of lower incremental potential: y where a body is soft or flies, x + h v where its pins carry it.
docs/method.md, sections 6, 14.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from .. import ops
from ..model.bodies import Bodies, OtherBodies
from ..ops import STARTS, distinct
from ..ops.contact import join_data
from ..safeguards import FILTER_ETA
from ..tuples import replaced

_TENSORS = 6  # differentiable fields: x, v, acceleration, prescribed, mass, energy_data
_SCENES = 10  # and origin, mu, lam, rest: what has a scene dimension
_FIELDS = len(ops.BeginFields._fields)


def _run(*args: Any) -> tuple[Tensor, ...]:
    groups, other_groups, options = args[_FIELDS:]
    return ops.direct.begin(*ops.as_list(ops.BeginFields(*args[:_FIELDS]), args[0]), groups, other_groups, *options)


def _reverse(bars: Sequence[Tensor | None], saved: Sequence[Any], rest: tuple, needs: Sequence[bool]) -> list[Any]:
    fields, (falls, alone), (groups, options) = ops.BeginFields(*saved[:_FIELDS]), saved[_FIELDS:], rest
    x_start_bar, y_bar = (torch.zeros_like(fields.x) if bar is None else bar for bar in bars)
    wants = (needs[2], needs[3], needs[5])
    *out, shared, own, planes = ops.direct.begin_backward(
        *ops.as_list(fields, fields.x), x_start_bar, y_bar, falls, alone, groups, *options[:-1], wants
    )
    data_out = None
    if needs[5]:
        data_out = join_data(shared, own, options[0])
        if planes.numel():  # the first energy's data
            of_planes = ops.sum_to(planes, (planes.shape[0], 1, planes.shape[2]))[:, 0]
            count = planes.shape[2]
            first, others_out = data_out.narrow(1, 0, count), data_out.narrow(1, count, data_out.shape[1] - count)
            data_out = torch.cat([first + of_planes, others_out], 1)
    return [*out, data_out]


def _vmap(apply: Any, info: Any, in_dims: tuple, *args: Any) -> tuple[tuple[Tensor, ...], tuple[int, ...]]:
    tensors, _ = ops.folded(info.batch_size, args[:_SCENES], in_dims, 2)
    out = apply(*tensors, *args[_SCENES:])
    shapes = [(info.batch_size, t.shape[0] // info.batch_size) for t in out]  # decisions may have no scene
    return tuple(t.unflatten(0, shape) for t, shape in zip(out, shapes, strict=True)), (0,) * len(out)


def _saved(inputs: tuple, made: tuple) -> tuple:
    read = replaced(ops.BeginFields(*inputs[:_FIELDS]), mu=None, lam=None, rest=None)  # by the reverse
    return *read, *made[2:]


# Fields; groups, other_groups, (data_count, time_step, filter_eta, chord, start, filters, parts).
_begin = ops.Differentiable(
    _run, _reverse, arguments=_FIELDS + 3, inputs=_TENSORS, outputs=2, saved=_saved,
    rest=lambda inputs: (inputs[_FIELDS], inputs[-1]), vmap=_vmap, batched=True,
)  # fmt: skip


def begin(
    x: Tensor, v: Tensor, acceleration: Tensor, prescribed: Tensor | None, mass: Tensor, energy_data: Tensor,
    origin: Tensor | None, mu: Tensor, lam: Tensor, rest: Tensor | None, pinned: Tensor, bodies: Bodies,
    others: OtherBodies, data_count: tuple[int, ...], time_step: float, chord: float, *, start: str, filters: bool,
    parts: bool,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Start of the sweeps and predictor [m], both [B, V, 3]; differentiable in the first six tensors.

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
    looked_at = mu.detach(), lam.detach(), rest if rest is None else rest.detach()
    tensors = distinct(x, v, acceleration, prescribed, mass, energy_data, origin, *looked_at)
    *listed, groups = bodies
    *listed_others, other_groups = others
    options = (data_count, time_step, FILTER_ETA, chord, STARTS[start], filters)
    x_start, y, *_ = _begin(*tensors, pinned, *listed, *listed_others, groups, other_groups, (*options, parts))
    return x_start, y
