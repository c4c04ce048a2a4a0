"""Detection as a step asks for it: which pairs are near, which bodies move together."""

# pyright: reportIncompatibleMethodOverride=false
from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd import Function

from . import ops_contact, ops_contact_sweep
from .contact_surface import ContactSurface
from .ops import ready_signature
from .pair_barrier import PairBarrier


def detect(x: Tensor, origin: Tensor, was: Tensor, now: Tensor, surface: ContactSurface, barrier: PairBarrier,
           capacity: int) -> tuple[Tensor, ...]:  # fmt: skip
    """Pairs that may come closer than dhat before the next detection, and the nearest pair of each corner point.

    Args:
        x: [B, V, 3] [m], relative to origin [B, V, 3] or empty.  was, now: Collider points [B, Vc, 3] [m].
        capacity: Pairs of all scenes that fit.

    Returns:
        pairs [capacity, 6] int32 (four corner points, kind, scene), constants [capacity, 3] (dhat, offset, threshold of
        the mollifier), ptr [B N + 1] int32 and entry [4 capacity] int32 (4 pair + corner of each corner point);
        near_corners [B, N, 5] int32 (corners, kind), near_values [B, N, 8] (weights, normal, gap); counts [4] int64
        (pairs needed, pairs without a gap, key of one, 0); smallest gap [B].
    """
    s = surface
    return ops_contact.contact_detect(
        x, origin, was, now, s.rest, s.radius, s.triangles, s.edges, s.points, s.planes, s.body, s.held, s.bodies,
        barrier.self_contact, barrier.between_bodies, barrier.dhat, s.reach, s.cap, barrier.gamma, capacity,
    )  # fmt: skip


def islands(x: Tensor, origin: Tensor, move: Tensor, mass: Tensor, was: Tensor, now: Tensor, surface: ContactSurface,
            dhat: float) -> Tensor:  # fmt: skip
    """Island of each body [B, bodies] int32, named by its first body; -1 where it must not be translated."""
    s = surface
    return ops_contact.contact_islands(x, origin, move, mass, was, now, s.planes, s.body, s.body_order, s.body_ptr,
                                       s.held, s.radius, s.bodies, s.cap, dhat)  # fmt: skip


def lowest(x: Tensor, origin: Tensor, data: Tensor, island: Tensor, surface: ContactSurface) -> Tensor:
    """Lowest vertex of each body's island above each plane [B, bodies, planes] int32; ``data`` as FloorBarrier.pack."""
    return ops_contact_sweep.lowest(x, origin, data, surface.body_order, surface.body_ptr, island)


class _BodySum(Function):
    """Vertex values [B, V, C] -> sums over bodies [B, bodies, C], in a fixed order."""

    @staticmethod
    def forward(values: Tensor, order: Tensor, ptr: Tensor, body: Tensor) -> Tensor:
        return ops_contact.segment_sum(values.contiguous(), order, ptr)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: Tensor) -> None:
        ctx.index = inputs[1:]

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple:
        return _OfBody.apply(grads[0], *ctx.index), None, None, None


class _OfBody(Function):
    """Values of bodies [B, bodies, C] -> of their vertices [B, V, C]; the adjoint of _BodySum."""

    @staticmethod
    def forward(values: Tensor, order: Tensor, ptr: Tensor, body: Tensor) -> Tensor:
        return values[:, body]

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: Tensor) -> None:
        ctx.index = inputs[1:]

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple:
        return _BodySum.apply(grads[0], *ctx.index), None, None, None


class _SumInto(Function):
    """Rows [n, C] added into zeros [rows, C] at index [n]; the sort behind it gives the same bits each time."""

    @staticmethod
    def forward(values: Tensor, index: Tensor, rows: int) -> Tensor:
        out = values.new_zeros((rows, values.shape[1]))
        return out.index_put_((index,), values, accumulate=True)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: Tensor) -> None:
        ctx.index = inputs[1]

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple:
        return _PickRows.apply(grads[0], ctx.index), None, None


class _PickRows(Function):
    @staticmethod
    def forward(values: Tensor, index: Tensor) -> Tensor:
        return values[index]

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: Tensor) -> None:
        ctx.rows, ctx.index = inputs[0].shape[0], inputs[1]

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple:
        return _SumInto.apply(grads[0], ctx.index, ctx.rows), None


class Floor(NamedTuple):
    """The planes of a FloorBarrier above which a translation must stay."""

    data: Tensor  # [1 | B, 7 planes], differentiable: see FloorBarrier.pack
    lowest: Tensor  # [B, bodies, planes] int64: vertex of the island that is lowest above a plane


def island_translation(move: Tensor, mass: Tensor, island: Tensor, surface: ContactSurface, x: Tensor, origin: Tensor,
                       floor: Floor | None) -> Tensor:  # fmt: skip
    """Translation of each vertex's island [B, V, 3]: the mass-weighted mean of where its free vertices want to go; down
    a floor's normal at most until the lowest vertex comes within dhat of the plane, so that what rests on a floor is not moved.

    Args:
        move, x: [B, V, 3] [m], differentiable.  mass: [1 | B, V] [kg], differentiable.  island: [B, bodies] int32.
        origin: [B, V, 3] or empty.
    """
    count, bodies = island.shape
    vertices = move.shape[1]
    body = surface.body[:vertices].to(torch.int64)
    weight = torch.where(surface.held[:vertices], 0.0, mass).expand(count, vertices)[..., None]
    sums = _BodySum.apply(torch.cat([weight * move, weight], -1), surface.body_order, surface.body_ptr, body)
    moves = island >= 0
    if bodies > 1:
        scene = torch.arange(count, device=move.device)[:, None]
        index = (scene * bodies + island.clamp(min=0).to(torch.int64)).reshape(-1)
        sums = torch.where(moves[..., None], sums, 0.0).reshape(-1, 4)
        sums = _PickRows.apply(_SumInto.apply(sums, index, count * bodies), index).reshape(count, bodies, 4)
    total = sums[..., 3:]
    translation = torch.where(moves[..., None], sums[..., :3] / torch.where(total > 0, total, 1.0), 0.0)
    if floor is not None:
        translation = _above(translation, x, origin, floor)
    return _OfBody.apply(translation, surface.body_order, surface.body_ptr, body)


def _above(u: Tensor, x: Tensor, origin: Tensor, floor: Floor) -> Tensor:
    """Translations u [B, bodies, 3], held above the planes of a floor."""
    count, bodies, planes = floor.lowest.shape
    data = floor.data.reshape(floor.data.shape[0], 1, planes, 7)
    normal, height, dhat = data[..., :3], data[..., 3], data[..., 5]
    scene = torch.arange(count, device=x.device)[:, None, None]
    rows = (scene * x.shape[1] + floor.lowest).reshape(-1)
    at = _PickRows.apply(x.reshape(-1, 3), rows).reshape(count, bodies, planes, 3)
    if origin.numel() > 0:
        height = height - (normal * origin.reshape(-1, 3)[rows].reshape(at.shape)).sum(-1)
    room = ((normal * at).sum(-1) - height - dhat).clamp(min=0)  # [B, bodies, planes]
    for plane in range(planes):
        n = normal[:, :, plane]
        down = -(n * u).sum(-1)
        u = u + (down - room[..., plane]).clamp(min=0)[..., None] * n
    # planes at an angle: what one has given back, another may have to take
    with torch.no_grad():
        down = -(normal * u[:, :, None]).sum(-1)
        safe = (down <= room * (1 + 1e-6) + torch.finfo(x.dtype).eps).all(-1)
    return torch.where(safe[..., None], u, 0.0)


ready_signature(_BodySum, _OfBody, _SumInto, _PickRows)
