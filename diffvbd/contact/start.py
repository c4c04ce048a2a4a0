"""Where a part of a step with contact starts: translations of islands, what the floor lets through, how far all may go
at once."""

# pyright: reportIncompatibleMethodOverride=false
from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd import Function

from .. import ops
from ..ops import contact_start as ops_contact_start
from ..ops import detect as ops_contact
from ..ops import no_second_derivative, not_batched
from ..ops.segments import of_segments
from ..safeguards import FILTER_ETA
from .above_floor import SHORT, above_floor
from .surface import ContactSurface


class _Translation(Function):
    """Translation of each body's island [B, bodies, 3]."""

    @staticmethod
    def forward(move: Tensor, mass: Tensor, x: Tensor, planes: Tensor, origin: Tensor, index: tuple) -> Tensor:
        return ops_contact_start.translation(move, mass, x, origin, planes, *index)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: Tensor) -> None:
        *tensors, ctx.index = inputs
        ctx.save_for_backward(*tensors)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple:
        not_batched(grads[0])
        move, mass, x, planes, origin = ctx.saved_tensors
        out = _TranslationBackward.apply(grads[0].contiguous(), move, mass, x, origin, planes, ctx.index)
        return (*(ops.sum_to(bar, t.shape) for bar, t in zip(out, (move, mass, x, planes), strict=True)), None, None)


class _Last(Function):
    """A backward that has no derivative of its own."""

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: Any) -> None:
        pass

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Any:
        no_second_derivative()


class _TranslationBackward(_Last):
    @staticmethod
    def forward(u_bar, move, mass, x, origin, planes, index):
        move_bar, mass_bar, x_bar, planes_bar = ops_contact_start.translation_backward(
            u_bar, move, mass, x, origin, planes, *index
        )
        return move_bar, mass_bar, x_bar, planes_bar if planes.numel() else planes.clone()


class _Target(Function):
    """Where each vertex wants to be: its wish, less what the floor takes from the way beside its island's [B, V, 3]."""

    @staticmethod
    def forward(x: Tensor, move: Tensor, u: Tensor, planes: Tensor, origin: Tensor, surface: ContactSurface) -> Tensor:
        return ops_contact_start.start(x, move, u, planes, origin, surface.held, surface.body, FILTER_ETA)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: Tensor) -> None:
        *tensors, ctx.surface = inputs
        ctx.save_for_backward(*tensors)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple:
        not_batched(grads[0])
        wants_planes = ctx.needs_input_grad[3]
        out = _TargetBackward.apply(grads[0].contiguous(), *ctx.saved_tensors, ctx.surface, wants_planes)
        return (*out[:3], out[3] if wants_planes else None, None, None)


class _TargetBackward(_Last):
    @staticmethod
    def forward(bar, x, move, u, planes, origin, surface, wants_planes):
        x_bar, move_bar, u_bar, planes_bar = ops_contact_start.start_backward(
            bar, x, move, u, planes, origin, surface.held, surface.body, FILTER_ETA, wants_planes
        )
        u_bar = ops_contact.segment_sum(u_bar, surface.body_order, surface.body_ptr)
        if wants_planes:
            planes_bar = ops.sum_to(planes_bar, (planes_bar.shape[0], 1, planes_bar.shape[2]))[:, 0]
            planes_bar = ops.sum_to(planes_bar, planes.shape)
        return x_bar, move_bar, u_bar, planes_bar


class PartStart(NamedTuple):
    """Where the sweeps of a part start."""

    x: Tensor  # [B, V, 3] [m]
    center: Tensor  # [B, V, 3]  from where each vertex has its room [m]; a number, not a function of the start
    room: Tensor  # [B, V]  how far from there it may go [m]
    own: tuple  # the same beside the rigid motion of its body; empty where bodies have no pairs of their own
    frames: Tensor | None  # [B, bodies]: share that pairs let each body go of its rigid motion above the floor
    short: Tensor  # [B, V] bool: pairs have held up more than a hundredth of its way
    stuck: Tensor  # [1] int64: pairs that hinder what is prescribed
    shares: Tensor  # [2, B, V]: of the two ways, that vertices went


def share_within(way: Tensor, stretch: Tensor, room: Tensor) -> Tensor:
    """The largest share s of a rigid motion, at most 1, with s way + s^2 stretch <= room: so sweeps have the room to
    take back what the straight ways of a turn stretch a body by. Of each body [B, bodies] [m]."""
    root = (way * way + 4 * stretch * room).sqrt()
    return (2 * room / (way + root).clamp(min=torch.finfo(way.dtype).tiny)).clamp(max=1)


BENT = 0.1  # share of the room of its own that a body may bend by, whatever that does to its potential
DEEP_BENT = 0.5  # the same of a body that planes or pairs hold up on its way as a whole, even if its potential falls


def start_between_planes(x: Tensor, move: Tensor, fall: Tensor, mass: Tensor, was: Tensor, now: Tensor,
                         planes: Tensor | None, origin: Tensor, detection: Any, surface: ContactSurface,
                         rigid: Tensor, stretch: Tensor, largest: Callable[[Tensor], Tensor],
                         raises: Callable[[Tensor, Tensor], Tensor], own_pairs: bool) -> PartStart:  # fmt: skip
    """Every vertex as far along its way as pairs and floor let all go at once: by ``rigid`` each body as a whole, then
    by what is left of ``move``, then by ``fall``. A way of its own bends a body. A free one that a floor stops does not
    go it; one of which pairs hold some up, or that with self-contact takes much of the room in which the sweeps may
    take it back, goes it only where that does not raise its potential.

    Args:
        x, move, fall: [B, V, 3] [m].  mass: [1 | B, V] [kg].
        was, now: Collider points before and during the sweeps, [B, Vc, 3] [m].
        planes: Data of the FloorBarrier [1 | B, 7 planes], or None; differentiable as x, move, fall and mass.
        origin: [B, V, 3] or empty.  detection: of the step.
        rigid: Where rigid motions of bodies would take their vertices, as a way [B, V, 3] [m], differentiable.
        stretch: By how much the straight ways of that stretch each body, and what sweeps need to take it back
            [B, bodies] [m].  largest: Of ways [B, V, 3], the longest of a free vertex of each body, not
            differentiated.
        raises: Of two states [B, V, 3], which vertices are of a body whose potential is higher in the second [B, V].
        own_pairs: Whether bodies have pairs of their own, and rooms for them.
    """
    floor = x.new_empty((0,)) if planes is None else planes
    index = (surface.held, surface.body, surface.body_order, surface.body_ptr, detection.island, detection.lowest)
    u = _Translation.apply(move, mass.contiguous(), x, floor, origin, index)
    body, pinned = surface.body[: x.shape[1]].long(), surface.held[: x.shape[1], None]
    room, listed = detection.room[:, body].contiguous(), detection.listed
    listed = (listed.pairs, listed.constants, listed.ptr, listed.entry)
    order = (surface.body_order, surface.body_ptr, body)
    still, carried = torch.zeros_like(u), of_segments(u, *order)
    center = torch.where(pinned, x, x + carried).detach()
    shares, stuck = [], []

    def advance(at: Tensor, way: Tensor, by: Tensor, center: Tensor, **options: Any) -> Tensor:
        """Shares of a way; colliders and what is prescribed go in the first."""
        here = now if stuck else was
        share, hindered = ops_contact_start.advance(
            at.detach().contiguous(), way.contiguous(), by, center.contiguous(), origin, here.detach(), now.detach(),
            surface.held, surface.body, room, listed, **options,
        )  # fmt: skip
        stuck.append(hindered)
        return share

    def target_of(at: Tensor, way: Tensor, by: Tensor) -> Tensor:
        return _Target.apply(at, way, by, floor, origin, surface) if floor.numel() else at + way

    def least_of_body(value: Tensor) -> Tensor:
        value = value.expand(x.shape[:2])
        out = value.new_ones((value.shape[0], surface.bodies)).scatter_reduce(
            1, body.expand(value.shape), value, "amin"
        )
        return out[:, body]

    def any_of_body(vertices: Tensor) -> Tensor:
        return least_of_body((~vertices).to(x.dtype)) == 0

    def any_at_all(vertices: Tensor) -> bool:
        return vertices.is_cuda or bool(vertices.any())  # on CUDA to know would mean to wait

    free = ~any_of_body(pinned[:, 0])
    # bodies first, each as a whole
    target, base, own = target_of(x, move, u), torch.where(pinned, x, x + carried), ()
    beside = rigid - carried
    limit = share_within(largest(beside), stretch, detection.room[:, :-1])
    if own_pairs:
        limit = torch.minimum(limit, share_within(torch.zeros_like(stretch), stretch, detection.own_room[:, :-1]))
    above = above_floor(floor, origin, base, beside, pinned[:, 0], order, surface.bodies)
    beside = above.way(beside, order)
    with torch.no_grad():
        ways = carried + limit[:, body, None] * beside
        frames = limit * advance(x, torch.where(pinned, move, ways), u.detach(), x.detach(), whole=True)
        stopped = above.stopped[:, body]
        limited = (limit < SHORT)[:, body] & free
        held_up = stopped | (frames[:, body] < SHORT)
    base = torch.where(pinned, target, base + frames[:, body, None] * beside)
    if own_pairs:
        own = (base.detach().contiguous(), detection.own_room[:, body].contiguous())
    at = base
    for number in range(2):
        if number:
            target = target_of(at, fall, still)
        with torch.no_grad():
            way, here, rests = target - at, torch.where(pinned, target, at), torch.zeros_like(free)
            if number == 0 and own:
                square = way.square().sum(-1)
                bends, deep = (any_of_body(square > (part * own[1]) ** 2) for part in (BENT, DEEP_BENT))
                rests = deep & held_up
                if any_at_all(bends & free & ~rests):
                    rests = rests | (bends & raises(here, target))
            if number == 0:
                rests = free & (rests | stopped | limited)
                way = torch.where(rests[..., None], 0.0, way)
            share = torch.where(rests, 0.0, advance(at, way, still, center, own=own))
            if number == 0:
                bent = free & ~rests & (least_of_body(share) < SHORT)
                if any_at_all(bent):
                    bent = bent & raises(here, torch.where(pinned, target, at + share[..., None] * way))
                if any_at_all(bent):
                    stuck.pop()  # once more, with those at rest: what let the others pass may have been their motion
                    way = torch.where(bent[..., None], 0.0, way)
                    share = torch.where(bent | rests, 0.0, advance(at, way, still, center, own=own))
            shares.append(share)
        at = torch.where(pinned, target, at + share[..., None] * (target - at))
    again = ~pinned[:, 0] & ~(free & stopped)  # what a floor stops does not try again
    short = (torch.minimum(*shares) < SHORT) & again
    return PartStart(at, center, room, own, frames, short, sum(stuck[1:], stuck[0]), torch.stack(shares))


ops.ready_signature(_Translation, _TranslationBackward, _Target, _TargetBackward)
