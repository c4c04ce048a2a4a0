"""Which bodies may touch something in a step: a floor, a collider, another body, themselves."""

from __future__ import annotations

import torch
from torch import Tensor

from ..model.model import Model
from ..reference.distance import EDGE_EDGE
from .arguments import Prepared
from .contact import ContactStep
from .predict import Begun
from .rooms import Motion

MARGIN = 2.0  # of the ways that vertices want to go, which forces within bodies change
LEAST = 0.25  # of dhat


@torch.no_grad()
def may_touch(model: Model, begun: Begun, prepared: Prepared, where: tuple[Tensor, Tensor] | None) -> Tensor:
    """Whether the body of each vertex may touch something on its way from begun.x_prev to begun.y, bool [B, V]: where a
    gap is below dhat, or its sides may go that close.

    Args:
        where: Colliders at the start and at the end of the step [B, Vc, 3] [m], of a Model with contact.
    """
    begun = begun.detached()
    way = begun.y - begun.x_prev
    near = torch.zeros_like(way[..., 0], dtype=torch.bool)
    if model.floor is not None:
        near = _near_floor(model, begun, way)
    if model.contact is not None and where is not None:
        near = near | _near_pairs(model, begun, prepared, way, *where)
    first = model._first_of_body.expand(near.shape)
    of_body = torch.zeros_like(way[..., 0]).scatter_reduce(1, first, near.to(way.dtype), "amax")
    return of_body.gather(1, first) > 0


def _near_floor(model: Model, begun: Begun, way: Tensor) -> Tensor:
    assert model.floor is not None
    data = begun.data[:, : model.floor.count()]
    gap, normal, dhat = model.floor.gaps(begun.x_prev, data, begun.origin)
    approach = -(normal * way[:, :, None]).sum(-1).clamp(max=0)
    return (gap - MARGIN * approach < (1 + LEAST) * dhat).any(-1) & ~model._pinned


def _near_pairs(model: Model, begun: Begun, prepared: Prepared, way: Tensor, before: Tensor, after: Tensor) -> Tensor:
    step = ContactStep(model, begun, prepared, before, after)
    assert step.surface is not None
    motion = Motion(step.surface, step.x_prev, step.origin, step.fields.mass, way)
    found = step.detect(step.x_prev, step.before, step.colliders, motion, torch.zeros_like(way), motion.rigid())
    ways = torch.cat([way, after - before], 1)
    *corner, kind, scene = found.listed.pairs.long().unbind(-1)
    rows = torch.arange(len(kind), device=way.device)
    w = [ways[scene, c] for c in corner]
    edges = kind == EDGE_EDGE
    most = way.new_zeros(len(kind))
    for i, j, of in ((0, 1, ~edges), (0, 2, None), (0, 3, None), (1, 2, edges), (1, 3, edges)):  # across the sides
        square = (w[i] - w[j]).square().sum(-1)
        most = torch.maximum(most, square if of is None else torch.where(of, square, 0))
    constants = found.listed.constants
    near = constants[:, -1] - MARGIN * most.sqrt() < (1 + LEAST) * constants[:, 0]
    near = near & (rows < found.listed.ptr[-1] // 4)  # that pairs fill
    total = ways.shape[0] * ways.shape[1]
    out = near.new_zeros(total + len(kind))
    for c in corner:  # a row that is not near has a place of its own
        out[torch.where(near, scene * ways.shape[1] + c, total + rows)] = True
    too_many = found.counts[0] > step.capacity  # of which some are not listed
    return out[:total].reshape(ways.shape[:2])[:, : way.shape[1]] | too_many
