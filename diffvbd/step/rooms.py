"""How far the bodies of a scene may go until pairs are found again, and how far contact lets them fall."""

from __future__ import annotations

import torch
from torch import Tensor

from ..adjoint.contact_lag import Pairs, pair_lag, sum_at_corners
from ..contact.barrier import PairBarrier
from ..contact.start import PartStart
from ..contact.surface import ContactSurface
from ..model.model import Model
from ..ops import broadcast
from ..ops import detect as ops_contact
from ..ops.motion import RoomsOfBodies, contact_rooms
from ..ops.segments import of_segments, sum_segments
from .motion import Motion

ROOM = 1.5  # how far a vertex may go, over how far the farthest of its body wants to
LEAST_ROOM = 1.0  # of dhat, beside that: as far as a barrier that starts compressed may push


def _tiny(x: Tensor) -> float:
    return torch.finfo(x.dtype).tiny


def _by_body(values: Tensor, surface: ContactSurface) -> Tensor:
    """Sums over the vertices of each body, [B, V, n] -> [B, bodies, n]."""
    return sum_segments(values, surface.body_order, surface.body_ptr, surface.body[: values.shape[1]].long())


def longest(surface: ContactSurface, way: Tensor) -> Tensor:
    way = way.detach().contiguous()
    return ops_contact.longest_ways(way, ~surface.held[: way.shape[1]], surface.body_order, surface.body_ptr)


@torch.no_grad()
def rooms(motion: Motion, surface: ContactSurface, barrier: PairBarrier, x: Tensor, origin: Tensor, mass: Tensor,
          was: Tensor, now: Tensor, floor: Tensor | None, any_direction: bool) -> RoomsOfBodies:  # fmt: skip
    """How far bodies may go until pairs are found again. Index data.

    Args:
        motion: Where each vertex wants to go.  x, origin: As the sweeps take them.  mass: [1 | B, V] [kg].
        was, now: Collider points [B, Vc, 3] [m].  floor: Data of the FloorBarrier, or None.
        any_direction: Whether the floor has planes across the axes, along which a translation may be turned.
    """
    s, dhat = surface, barrier.dhat
    floor = x.new_empty((0,)) if floor is None else floor.detach().contiguous()
    return contact_rooms(
        x.detach(), origin, mass.detach().contiguous(), motion.move.detach().contiguous(), s.held, s.body_order,
        s.body_ptr, motion.ways, floor, was.detach(), now.detach(), s.planes, s.body, s.radius, s.most_room,
        s.most_room_alone, s.most_own_room, s.least_own_room, dhat, ROOM, LEAST_ROOM * dhat, any_direction,
        barrier.self_contact,
    )  # fmt: skip


@torch.no_grad()
def rooms_of_sweeps(motion: Motion, surface: ContactSurface, barrier: PairBarrier, start: PartStart, x: Tensor,
                    begin: Tensor) -> Tensor:  # fmt: skip
    """How far the sweeps may carry a vertex from where they find it [B, V] [m]: as far as a barrier pushes, weight
    pulls, elasticity takes back what bodies deform by on the way and, of what pairs have held up, all; the most of a
    scene, since bodies push one another. Index data.

    Args:
        motion, fall: What the part wanted.  start: Its start, whose rooms bound the whole way.
        x, begin: Where the sweeps begin, and where the part began.  rigid: Motion.rigid(). All [B, V, 3] [m].
    """
    far = begin + motion.move + motion.fall - start.x.detach()
    wish = longest(surface, motion.fall) + motion.apart + ROOM * longest(surface, far)
    wish = wish + longest(surface, x - start.x.detach()) + ROOM * motion.stretched
    wish = LEAST_ROOM * barrier.dhat + (wish.amax(1, keepdim=True).expand_as(wish) if surface.bodies else wish)
    left = start.room - (x - start.center).square().sum(-1).sqrt()
    if start.own:
        center, room = start.own
        left = torch.minimum(left, room - (x - center).square().sum(-1).sqrt())
    body = surface.body[: x.shape[1]].long()
    return torch.where(surface.held[: x.shape[1]], 0.0, torch.minimum(left, wish[:, body]).clamp(min=0))


def unsupported(model: Model, x: Tensor, origin: Tensor, collider: Tensor, kappa: Tensor, mass: Tensor, lift: Tensor,
                floor_data: Tensor | None, listed: Pairs, time_step: float) -> Tensor:  # fmt: skip
    """What is left of ``lift`` = h^2 a [B, V, 3] once the contact forces at the start of the step have borne their part
    of each body's acceleration: for a body at rest nothing, in flight all of it. Differentiable.

    Without it every step would push a supported body into its support, and the sweeps would have to take it back.
    """
    surface = model.surface_of_contact
    assert surface is not None
    scenes, vertices = x.shape[:2]
    force, _, n, w = pair_lag(x, collider, kappa, origin, listed).split((1, 1, 3, 4), -1)
    points = vertices + collider.shape[1]
    total = sum_at_corners((force * w)[..., None] * n[:, None], listed, scenes, points)[:, :vertices]
    if floor_data is not None and model.floor is not None:
        size, normal = model.floor.normal_force(x, floor_data, origin if origin.numel() else None)
        total = total + (size[..., None] * broadcast(normal[:, None], (*size.shape, 3))).sum(2)
    free, mass = ~model._pinned, broadcast(mass, (scenes, vertices))[..., None]
    columns = torch.cat([mass * lift, time_step * time_step * total, mass, torch.zeros_like(mass)], -1)
    held = torch.cat([torch.zeros_like(columns[..., :-1]), torch.ones_like(mass)], -1)
    sums = _by_body(torch.where(free[:, None], columns, held), surface)
    whole = sums[..., 6:7].clamp(min=_tiny(x))
    own, borne = sums[..., :3] / whole, sums[..., 3:6] / whole
    # what bears less than rounding of the body's own acceleration bears nothing: its square may be no number
    size = borne.detach().abs().amax(-1, keepdim=True)
    bears = size > torch.finfo(x.dtype).eps * own.detach().abs().amax(-1, keepdim=True)
    size = torch.where(bears, size, 1.0)
    unit = torch.where(bears, borne / size, 1.0)
    share = -(own / size * unit).sum(-1, keepdim=True) / (unit * unit).sum(-1, keepdim=True)
    share = torch.where(bears, share.clamp(0, 1), 0.0)
    taken = torch.where(sums[..., 7:] > 0, 0.0, share * borne)  # a body with pinned vertices hangs from them
    taken = of_segments(taken, surface.body_order, surface.body_ptr, surface.body[:vertices].long())
    return torch.where(free[:, None], lift + taken, lift)
