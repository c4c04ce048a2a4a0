"""Where a part of a step with contact starts: translations of islands, what the floor lets through, how far all may go
at once."""

# pyright: reportIncompatibleMethodOverride=false
from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd import Function

from .. import ops
from ..ops import contact_start as ops_contact_start
from ..ops import detect as ops_contact
from ..ops import no_second_derivative, not_batched
from ..safeguards import FILTER_ETA
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
    own_center: Tensor  # [B, V, 3]  where the rigid motion of its body has taken it [m], a number as well
    own_room: Tensor | None  # [B, V]  how far from there it may go; None: bodies have no pairs of their own
    short: Tensor  # [B, V] bool: pairs have held up more than a hundredth of its way
    stuck: Tensor  # [1] int64: pairs that hinder what is prescribed
    shares: Tensor  # [2, B, V]: of the two ways, that vertices went


SHORT = 0.99  # share of a way that counts as all of it


def start_between_planes(x: Tensor, move: Tensor, fall: Tensor, mass: Tensor, was: Tensor, now: Tensor,
                         planes: Tensor | None, origin: Tensor, detection: Any, surface: ContactSurface,
                         rigid: Tensor | None) -> PartStart:  # fmt: skip
    """Every vertex as far along its way as pairs and floor let all go at once: first by ``move``, then by ``fall``.

    Args:
        x, move, fall: [B, V, 3] [m].  mass: [1 | B, V] [kg].
        was, now: Collider points before and during the sweeps, [B, Vc, 3] [m].
        planes: Data of the FloorBarrier [1 | B, 7 planes], or None; differentiable as x, move, fall and mass.
        origin: [B, V, 3] or empty.  detection: of the step.
        rigid: Where rigid motions of bodies would take their vertices, as a way [B, V, 3] [m]; None without
            self-contact.
    """
    floor = x.new_empty((0,)) if planes is None else planes
    index = (surface.held, surface.body, surface.body_order, surface.body_ptr, detection.island, detection.lowest)
    u = _Translation.apply(move, mass.contiguous(), x, floor, origin, index)
    body = surface.body[: x.shape[1]].long()
    pinned = surface.held[: x.shape[1], None]
    room, listed = detection.room[:, body].contiguous(), detection.listed
    listed = (listed.pairs, listed.constants, listed.ptr, listed.entry)
    at, center, still = x, x.detach(), torch.zeros_like(u)
    own_center = center
    own_room = None if rigid is None else detection.own_room[:, body].contiguous()
    frame = None if rigid is None else (rigid - u.detach()[:, body]).contiguous()
    shares, stuck = [], []
    for way, by, here in ((move, u, was), (fall, still, now)):
        target = at + way
        if floor.numel():
            target = _Target.apply(at, way, by, floor, origin, surface)
        with torch.no_grad():
            share, frames, hindered = ops_contact_start.advance(
                at.detach().contiguous(), (target - at).detach().contiguous(), by.detach(), center, origin,
                here.detach(), now.detach(), surface.held, surface.body, room, listed,
                frame=() if frame is None or own_room is None else (frame, own_center, own_room),
            )  # fmt: skip
            if frame is not None:
                own_center = (own_center + by[:, body] + frames[:, body, None] * frame).contiguous()
                frame = torch.zeros_like(frame)
        shares.append(share)
        stuck.append(hindered)
        base = at + by[:, body]
        at = torch.where(pinned, target, base + share[..., None] * (target - base))
        center = torch.where(pinned, center, center + by.detach()[:, body]).contiguous()
    short = (torch.minimum(*shares) < SHORT) & ~pinned[:, 0]
    return PartStart(at, center, room, own_center, own_room, short, stuck[0] + stuck[1], torch.stack(shares))


ops.ready_signature(_Translation, _TranslationBackward, _Target, _TargetBackward)
