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
    x: Tensor  # [B, V, 3]  where the sweeps start [m]
    left: Tensor  # [B, V, 3]  what is left to go [m]
    center: Tensor  # [B, V, 3]  from where it may go
    room: Tensor  # [B, V]  as far as this [m]
    cut: Tensor  # [B, 1, V] uint8: the way was not free
    stuck: Tensor  # [1] int64: pairs that hinder what is prescribed


def start_between_planes(x: Tensor, move: Tensor, fall: Tensor, mass: Tensor, was: Tensor, now: Tensor,
                         planes: Tensor | None, origin: Tensor, detection: Any, surface: ContactSurface, room: Tensor
                         ) -> PartStart:  # fmt: skip
    """Every vertex as far along its way as pairs and floor let all go at once: first by ``move``, then by ``fall``."""
    none = x.new_empty((0,))
    floor = none if planes is None else planes
    index = (surface.held, surface.body, surface.body_order, surface.body_ptr, detection.island, detection.lowest)
    u = _Translation.apply(move, mass.contiguous(), x, floor, origin, index)
    vertices = x.shape[1]
    body = surface.body[:vertices].long()
    own_room = room[:, body].contiguous()
    listed = (detection.listed.pairs, detection.listed.constants, detection.listed.ptr, detection.listed.entry)
    pinned = surface.held[:vertices, None]
    at, center, stuck, cut = x, x.detach(), None, None
    for n, way in enumerate((move, fall)):
        by = u if n == 0 else torch.zeros_like(u)
        here = was if n == 0 else now
        if floor.numel():
            target = _Target.apply(at, way, by, floor, origin, surface)
        else:
            target = at + way
        with torch.no_grad():
            share, held_up = ops_contact_start.advance(
                at.detach().contiguous(), (target - at).detach().contiguous(), by.detach(), center, origin,
                here.detach(), now.detach(), surface.held, surface.body, own_room, listed,
            )  # fmt: skip
            stuck = held_up if stuck is None else stuck + held_up
            short = (share < 0.99) & ~pinned[:, 0]
            cut = short if cut is None else cut | short
        base = at + by[:, body]
        moved = base + share[..., None] * (target - base)
        at = torch.where(pinned, target, moved)
        if n == 0:
            center = torch.where(pinned, x, x + u[:, body]).detach().contiguous()
    assert stuck is not None and cut is not None
    return PartStart(at, move + fall - (at - x), center, own_room, cut.to(torch.uint8)[:, None], stuck)


ops.ready_signature(_Translation, _TranslationBackward, _Target, _TargetBackward)
