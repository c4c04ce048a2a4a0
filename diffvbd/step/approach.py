"""Bodies that may touch something in a step, which a scheme must not extrapolate: a floor, a collider, another body,
themselves."""

from __future__ import annotations

import torch
from torch import Tensor

from ..checks import input_name
from ..energies import barrier_curvature
from ..model.system import System
from ..reference.distance import EDGE_EDGE, POINT_PLANE
from .arguments import Prepared
from .contact import ContactStep
from .motion import motion_of
from .predict import Begun

MARGIN = 2.0  # of the ways that vertices want to go, which forces within bodies change
LEAST = 0.25  # of dhat
# What a step resolves: bounds within which no impact of bench/integrators.py gains energy (docs/method.md, 19).
SLOW = 1.0  # of a gap: ways of its sides
SOFT = 10.0  # of the mass: h^2 times a barrier's curvature


@torch.no_grad()
def may_touch(model: System, begun: Begun, prepared: Prepared, where: tuple[Tensor, Tensor] | None) -> Tensor:
    """Whether the body of each vertex may touch something on its way from begun.x_prev to begun.y, bool [B, V]: where a
    gap is below dhat, or its sides may go that close, unless the step resolves the barrier.

    Args:
        where: Colliders at the start and at the end of the step [B, Vc, 3] [m], of a Model with contact.
    """
    begun = begun.detached()
    way = begun.y - begun.x_prev
    near = torch.zeros_like(way[..., 0], dtype=torch.bool)
    if model.floor is not None:
        near = _near_floor(model, begun, prepared, way)
    if model.contact is not None and where is not None:
        near = near | _near_pairs(model, begun, prepared, way, *where)
    first = model._first_of_body.expand(near.shape)
    of_body = torch.zeros_like(way[..., 0]).scatter_reduce(1, first, near.to(way.dtype), "amax")
    return of_body.gather(1, first) > 0


def _extrapolates(model: System, prepared: Prepared) -> bool:
    """Whether contact has forces of gaps alone: those of velocities are measured from the start of a solve."""
    damped = (
        input_name(e, "damping") in prepared.parameters or e.damping > 0 for e in (model.floor, model.contact) if e
    )
    return model.friction is None and not any(damped)


def _resolved(gap: Tensor, kappa: Tensor, dhat: Tensor, way: Tensor, mass: Tensor, h: float) -> Tensor:
    """Whether a step of h resolves a barrier, so that its force may be extrapolated: its sides move by less than the
    gap [m], and its curvature where they may end, over masses [kg], vibrates slowly."""
    slow = way < SLOW * torch.minimum(gap, dhat)
    return slow & (h * h * barrier_curvature(gap - way, kappa, dhat) < SOFT * mass)


def _near_floor(model: System, begun: Begun, prepared: Prepared, way: Tensor) -> Tensor:
    assert model.floor is not None
    data = begun.data[:, : model.floor.count()]
    gap, normal, kappa, dhat = model.floor.gaps(begun.x_prev, data, begun.origin)
    along = (normal * way[:, :, None]).sum(-1)
    near = gap - MARGIN * (-along).clamp(min=0) < (1 + LEAST) * dhat
    if _extrapolates(model, prepared):
        h = prepared.settings.numbers.time_step
        near = near & ~_resolved(gap, kappa, dhat, along.abs(), prepared.mass[..., None], h)
    return near.any(-1) & ~model._pinned


def _near_pairs(model: System, begun: Begun, prepared: Prepared, way: Tensor, before: Tensor, after: Tensor) -> Tensor:
    step = ContactStep(model, begun, prepared, before, after)
    assert step.surface is not None
    motion = motion_of(step.surface, step.x_prev, step.origin, step.fields.mass, way, torch.zeros_like(way))
    found = step.detect(step.x_prev, step.before, step.colliders, motion)
    ways = torch.cat([way, after - before], 1)
    *corner, kind, scene = found.listed.pairs.long().unbind(-1)
    rows = torch.arange(len(kind), device=way.device)
    at = torch.cat([step.x_prev if begun.origin is None else step.x_prev + step.origin, before], 1)
    most = _way_between(kind, [ways[scene, c] for c in corner], [at[scene, c] for c in corner])
    gap, dhat = step.gaps_before(found.listed), found.listed.constants[:, 0]
    near = gap - MARGIN * most < (1 + LEAST) * dhat
    near = near & (rows < found.listed.ptr[-1] // 4)  # that pairs fill
    if _extrapolates(model, prepared):
        # colliders do not give way: their masses count as infinite
        mass = torch.cat([prepared.mass.expand(way.shape[:2]), torch.full_like(after[..., 0], torch.inf)], 1)
        lightest = torch.stack([mass[scene, c] for c in corner]).amin(0)
        kappa, h = step.kappa.expand(way.shape[0])[scene], prepared.settings.numbers.time_step
        near = near & ~_resolved(gap, kappa, dhat, most, lightest, h)
    total = ways.shape[0] * ways.shape[1]
    out = near.new_zeros(total + len(kind))
    for c in corner:  # a row that is not near has a place of its own
        out[torch.where(near, scene * ways.shape[1] + c, total + rows)] = True
    too_many = found.counts[0] > step.capacity  # of which some are not listed
    return out[:total].reshape(ways.shape[:2])[:, : way.shape[1]] | too_many


def _way_between(kind: Tensor, way: list[Tensor], at: list[Tensor]) -> Tensor:
    """Relative displacement of the sides of pairs [m]: the longest of their corners' across them; for a
    plane, which may turn about points far away, the way of the vertex relative to the plane's point below it."""
    edges = kind == EDGE_EDGE
    square = way[0].new_zeros(len(kind))
    for i, j, of in ((0, 1, ~edges), (0, 2, None), (0, 3, None), (1, 2, edges), (1, 3, edges)):
        across = (way[i] - way[j]).square().sum(-1)
        square = torch.maximum(square, across if of is None else torch.where(of, across, 0))
    p, a, b, c = at
    first, second, own = b - a, c - a, p - a
    products = [(s * t).sum(-1) for s, t in ((first, first), (first, second), (second, second))]
    along = [(s * own).sum(-1) for s in (first, second)]
    inverse = 1 / (products[0] * products[2] - products[1].square())
    share = [(products[2] * along[0] - products[1] * along[1]) * inverse,
             (products[0] * along[1] - products[1] * along[0]) * inverse]  # fmt: skip
    below = way[1] + share[0][:, None] * (way[2] - way[1]) + share[1][:, None] * (way[3] - way[1])
    return torch.where(kind == POINT_PLANE, (way[0] - below).square().sum(-1), square).sqrt()
