"""Where a part of a step with contact starts: smallest gaps, translations of islands, bounds, as autograd functions."""

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


class Start(NamedTuple):
    bounds: Tensor  # [B, V, 4]  center and radius [m]
    x: Tensor  # [B, V, 3]  where the sweeps start [m]
    move: Tensor  # [B, V, 3]  what is left to go [m]
    outside: Tensor  # [B, V] uint8: the bound has cut the motion


class _NearGap(Function):
    """Smallest gap of each vertex [B, V]. The value is the one detection found; by the envelope theorem its derivative
    is that of the distance with weights and normal held."""

    @staticmethod
    def forward(x: Tensor, was: Tensor, now: Tensor, corners: Tensor, values: Tensor, plane_points: Tensor) -> Tensor:
        return values[:, : x.shape[1], 7].clone()

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: Tensor) -> None:
        x, _, _, *index = inputs
        ctx.vertices, ctx.index = x.shape[1], index

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple:
        not_batched(grads[0])
        corners, values, plane_points = ctx.index
        own = values[:, : ctx.vertices]
        rows = (grads[0][..., None] * own[..., :4])[..., None] * own[..., None, 4:7]  # [B, V, 4, 3]
        count, points = corners.shape[:2]
        scene = torch.arange(count, device=corners.device)[:, None, None] * points
        index = (corners[:, : ctx.vertices, :4].to(torch.int64) + scene).reshape(-1)
        # in float64, which torch adds one after another; float32 it adds by atomics on the CPU
        sums = values.new_zeros((count * points, 3), dtype=torch.float64)
        sums = sums.index_put_((index,), rows.reshape(-1, 3).double(), accumulate=True)
        sums = sums.to(values.dtype).reshape(count, points, 3)
        x_bar, colliders = sums[:, : ctx.vertices], sums[:, ctx.vertices :]
        of_plane = plane_points[ctx.vertices :, None]
        needs = ctx.needs_input_grad
        was_bar = colliders.masked_fill(of_plane, 0.0) if needs[1] else None
        now_bar = colliders.masked_fill(~of_plane, 0.0) if needs[2] else None
        return x_bar, was_bar, now_bar, None, None, None


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


class _Start(Function):
    @staticmethod
    def forward(x, move, goal, u, gap, planes, near, origin, surface, gamma):
        return ops_contact_start.start(x, move, goal, u, near, origin, planes, surface.held, surface.body, gamma,
                                       surface.cap, FILTER_ETA)  # fmt: skip

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: tuple) -> None:
        x, move, goal, u, _, planes, near, origin, ctx.surface, ctx.gamma = inputs
        ctx.save_for_backward(x, move, goal, u, near, origin, planes)
        ctx.mark_non_differentiable(output[3])

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple:
        for grad in grads[:3]:
            not_batched(grad)
        bars = [g.contiguous() for g in grads[:3]]
        out = _StartBackward.apply(*bars, *ctx.saved_tensors, ctx.surface, ctx.gamma, ctx.needs_input_grad[5])
        return (*out[:5], out[5] if ctx.needs_input_grad[5] else None, None, None, None, None)


class _StartBackward(_Last):
    @staticmethod
    def forward(bounds_bar, start_bar, left_bar, x, move, goal, u, near, origin, planes, surface, gamma, wants_planes):
        x_bar, move_bar, goal_bar, u_bar, gap_bar, planes_bar = ops_contact_start.start_backward(
            (bounds_bar, start_bar, left_bar), x, move, goal, u, near, origin, planes, surface.held, surface.body,
            gamma, surface.cap, FILTER_ETA, wants_planes,
        )  # fmt: skip
        u_bar = ops_contact.segment_sum(u_bar, surface.body_order, surface.body_ptr)
        if wants_planes:
            planes_bar = ops.sum_to(planes_bar, (planes_bar.shape[0], 1, planes_bar.shape[2]))[:, 0]
            planes_bar = ops.sum_to(planes_bar, planes.shape)
        return x_bar, move_bar, goal_bar, u_bar, gap_bar, planes_bar


def start_part(x: Tensor, move: Tensor, goal: Tensor, mass: Tensor, was: Tensor, now: Tensor, planes: Tensor | None,
               origin: Tensor, detection: Any, surface: ContactSurface, gamma: float) -> Start:  # fmt: skip
    """Bounds until the next detection, and every vertex as far toward where it wants to go as bound and floor let it.

    Args:
        x, move: [B, V, 3] [m], state and wanted motion; goal: where pinned vertices are put [m].
        mass: [1 | B, V] [kg].  was, now: Collider points before and during the part, [B, Vc, 3] [m].
        planes: Data of the FloorBarrier [1 | B, 7 planes], or None; differentiable as all of the above.
        origin: [B, V, 3] or empty.  detection: of contact_step.  gamma: Share of a gap.
    """
    none = x.new_empty((0,))
    floor = none if planes is None else planes
    index = (surface.held, surface.body, surface.body_order, surface.body_ptr, detection.island, detection.lowest)
    gap = _NearGap.apply(x, was, now, detection.near_corners, detection.near_values, surface.plane_points)
    u = _Translation.apply(move, mass.contiguous(), x, floor, origin, index)
    return Start(*_Start.apply(x, move, goal, u, gap, floor, detection.near_values, origin, surface, gamma))


ops.ready_signature(_NearGap, _Translation, _TranslationBackward, _Start, _StartBackward)
