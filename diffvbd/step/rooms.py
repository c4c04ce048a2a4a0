"""How far the bodies of a scene may go until pairs are found again, and how far contact lets them fall."""

from __future__ import annotations

import torch
from torch import Tensor

from ..adjoint.contact_lag import Pairs, pair_lag
from ..adjoint.sums import sum_by
from ..contact import detection as search
from ..contact.barrier import PairBarrier
from ..contact.start import PartStart
from ..contact.surface import ContactSurface
from ..model.model import Model
from ..ops import broadcast

ROOM = 1.5  # how far a vertex may go, over how far the farthest of its body wants to
LEAST_ROOM = 1.0  # of dhat, beside that: as far as a barrier that starts compressed may push


def _tiny(x: Tensor) -> float:
    return torch.finfo(x.dtype).tiny


def _by_body(values: Tensor, surface: ContactSurface) -> Tensor:
    """Sums over the vertices of each body, [B, V, n] -> [B, bodies, n]."""
    scenes, vertices, _ = values.shape
    scene = surface.bodies * torch.arange(scenes, device=values.device)[:, None]
    rows = (scene + surface.body[:vertices].long()).reshape(-1)
    return sum_by(values.flatten(0, 1), rows, scenes * surface.bodies).unflatten(0, (scenes, surface.bodies))


@torch.no_grad()
def rooms_of_sweeps(surface: ContactSurface, barrier: PairBarrier, start: PartStart, mass: Tensor, begin: Tensor,
                    move: Tensor, fall: Tensor) -> Tensor:  # fmt: skip
    """How far the sweeps may carry a vertex from its start [B, V] [m]: as far as a barrier pushes, weight pulls,
    elasticity takes back what its body deforms by on the way and, of what pairs have held up, all. Index data.

    Args:
        start: The part's; its rooms bound the whole way.  mass: [1 | B, V].
        begin: Where the part began.  move, fall: Where each vertex wanted to go from there. All [B, V, 3] [m].
    """
    mass, begin, move, fall, at = (t.detach() for t in (mass, begin, move, fall, start.x))
    scenes, vertices = at.shape[:2]
    body, free = surface.body[:vertices].long(), ~surface.held[:vertices]
    weight = torch.where(free, broadcast(mass, (scenes, vertices)), 0.0)[..., None]
    sums = _by_body(torch.cat([weight * move, weight], -1), surface)
    mean = (sums[..., :3] / sums[..., 3:].clamp(min=_tiny(at)))[:, body]
    rows = broadcast(body[None], (scenes, vertices))

    def largest(way: Tensor) -> Tensor:
        length = torch.where(free, way.square().sum(-1).sqrt(), 0.0)
        return length.new_zeros((scenes, surface.bodies)).scatter_reduce(1, rows, length, "amax")

    wish = largest(fall) + largest(move - mean) + ROOM * largest(begin + move + fall - at) + LEAST_ROOM * barrier.dhat
    left = (start.room - (at - start.center).square().sum(-1).sqrt()).clamp(min=0)
    return torch.where(free, torch.minimum(left, wish[:, body]), 0.0)


@torch.no_grad()
def rooms(surface: ContactSurface, barrier: PairBarrier, x: Tensor, origin: Tensor, mass: Tensor, was: Tensor,
          now: Tensor, move: Tensor, fall: Tensor, any_direction: bool) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Island of each body [B, bodies], and how far its vertices may go beside the island's translation, with the
    largest of a scene in the last column [B, bodies + 1] [m]. Index data.

    Room follows from where a body wants to go: pairs that could meet within it are listed, and what does not want to
    move relative to its neighbours lists few.

    Args:
        x, origin: As the sweeps take them.  mass: [1 | B, V].  was, now: Collider points [B, Vc, 3] [m].
        move, fall: Where each vertex wants to go, [B, V, 3] [m] both.  any_direction: As for detection.islands.
    """
    x, mass, was, now, move, fall = (t.detach() for t in (x, mass, was, now, move, fall))
    scenes, vertices = x.shape[:2]
    body, free = surface.body[:vertices].long(), ~surface.held[:vertices]
    weight = torch.where(free, broadcast(mass, (scenes, vertices)), 0.0)[..., None]
    sums = _by_body(torch.cat([weight * move, weight], -1), surface)
    rows = broadcast(body[None], (scenes, vertices))

    def largest(way: Tensor) -> Tensor:
        length = torch.where(free, way.square().sum(-1).sqrt(), 0.0)
        return length.new_zeros((scenes, surface.bodies)).scatter_reduce(1, rows, length, "amax")

    falls = largest(fall) + LEAST_ROOM * barrier.dhat

    # What is prescribed goes where it goes: pairs with it are listed however far that is.
    driven = torch.where(free, 0.0, move.square().sum(-1).sqrt())
    driven = driven.new_zeros((scenes, surface.bodies)).scatter_reduce(1, rows, driven, "amax")
    pushed = driven.new_zeros((scenes, 1))
    if was.shape[1]:
        pushed = (now - was).square().sum(-1).sqrt().amax(1, keepdim=True)

    def room_beside(u: Tensor) -> Tensor:
        room = (ROOM * largest(move - u[:, body]) + falls).clamp(max=surface.most_room)
        return torch.maximum(room, driven) + pushed

    def islands(room: Tensor) -> tuple[Tensor, Tensor]:
        most = room.amax(1, keepdim=True) if surface.bodies else room.new_zeros((scenes, 1))
        room = torch.cat([room, most], 1)
        found = search.islands(x, origin, move, mass.contiguous(), was, now, surface, barrier.dhat, room, any_direction)
        return found, room

    # Islands depend on the rooms, and rooms on what an island leaves of a motion: hence twice.
    room = room_beside(sums[..., :3] / sums[..., 3:].clamp(min=_tiny(x)))
    island = islands(room)[0].long()
    same = (island[:, :, None] == island[:, None]) & (island >= 0)[:, None]
    joined = same.to(x.dtype) @ sums
    u = joined[..., :3] / joined[..., 3:].clamp(min=_tiny(x))
    return islands(torch.maximum(room, room_beside(torch.where((island >= 0)[..., None], u, 0.0))))


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
    used = listed.pairs[:, 5:] >= 0
    pushes = torch.where(used, force * w, 0.0)[..., None] * n[:, None]  # [pairs, 4, 3]
    points = vertices + collider.shape[1]
    index = (points * listed.pairs[:, 5:].long() + listed.pairs[:, :4].long()).clamp(min=0)
    total = sum_by(pushes.flatten(0, 1), index.flatten(), scenes * points).unflatten(0, (scenes, points))[:, :vertices]
    if floor_data is not None and model.floor is not None:
        size, normal = model.floor.normal_force(x, floor_data, origin if origin.numel() else None)
        total = total + (size[..., None] * broadcast(normal[:, None], (*size.shape, 3))).sum(2)
    free, mass = ~model._pinned, broadcast(mass, (scenes, vertices))[..., None]
    columns = torch.cat([mass * lift, time_step * time_step * total, mass, torch.zeros_like(mass)], -1)
    held = torch.cat([torch.zeros_like(columns[..., :-1]), torch.ones_like(mass)], -1)
    sums = _by_body(torch.where(free[:, None], columns, held), surface)
    whole = sums[..., 6:7].clamp(min=_tiny(x))
    own, borne = sums[..., :3] / whole, sums[..., 3:6] / whole
    square = (borne * borne).sum(-1, keepdim=True)
    share = (-(own * borne).sum(-1, keepdim=True) / square.clamp(min=_tiny(x))).clamp(0, 1)
    taken = torch.where(sums[..., 7:] > 0, 0.0, share * borne)  # a body with pinned vertices hangs from them
    return torch.where(free[:, None], lift + taken[:, surface.body[:vertices].long()], lift)
