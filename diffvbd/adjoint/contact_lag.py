"""What sweeps with contact keep of the start of a step: forces, normals and weights of pairs, differentiable."""

# pyright: reportIncompatibleMethodOverride=false
from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd import Function

from .. import ops
from ..ops import Backward, Direct, not_batched
from ..ops import contact_lag as ops_lag
from ..ops import contact_start as ops_start
from ..ops import detect as ops_contact


class Pairs(NamedTuple):
    """Index data of a detection: which pairs there are; not differentiable. Shapes: detection.detect."""

    pairs: Tensor
    constants: Tensor
    ptr: Tensor
    entry: Tensor


def no_pairs(like: Tensor, corners: int) -> Pairs:
    """An empty list for so many corner points of all scenes."""
    none = torch.zeros((corners + 1,), dtype=torch.int32, device=like.device)
    return Pairs(none[:0].reshape(0, 6), like.new_zeros((0, ops_contact.CONSTANTS)), none, none[:0])


def some_of(listed: Pairs, keep: Tensor) -> tuple[Pairs, Tensor]:
    """Those of listed pairs that ``keep`` names, bool [pairs], and which they are. Where values must not decide sizes,
    on CUDA and compiled, in lists of the same length, with -1 where there is none."""
    exact = not keep.is_cuda and not torch.compiler.is_compiling()
    rows, *kept = ops_start.keep(keep, listed, exact)
    return Pairs(*kept), rows


class _Lag(Function):
    """Normal force, activity, normal and weights of pairs at the start of a step [pairs, 9]."""

    @staticmethod
    def forward(x: Tensor, collider: Tensor, kappa: Tensor, origin: Tensor, listed: Pairs) -> Tensor:
        return ops_lag.lag(x, origin, collider, kappa, *listed)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: Tensor) -> None:
        x, collider, kappa, origin, ctx.listed = inputs
        ctx.save_for_backward(x, origin, collider, kappa)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple:
        x, origin, collider, kappa = ctx.saved_tensors
        points, by_kappa = ops_lag.lag_backward(grads[0].contiguous(), x, origin, collider, kappa, *ctx.listed)
        return (*_of_points(points, x, collider), ops.sum_to(by_kappa, kappa.shape), None, None)


def _of_points(points: Tensor, x: Tensor, collider: Tensor) -> tuple[Tensor, Tensor]:
    """The adjoints of vertices and of colliders."""
    vertices = x.shape[1]
    return points[:, :vertices], ops.sum_to(points[:, vertices:], collider.shape)


class _Rubbing(Direct):
    """Friction and damping of pairs [pairs, 9], and the forces of pairs on corner points [B, N, 3]."""

    @staticmethod
    def forward(x: Tensor, collider: Tensor, kappa: Tensor, friction: Tensor, damping: Tensor, origin: Tensor,
                listed: Pairs) -> tuple[Tensor, Tensor]:  # fmt: skip
        return ops_lag.rubbing(x, origin, collider, kappa, friction, damping, *listed)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: tuple[Tensor, Tensor]) -> None:
        *tensors, ctx.listed = inputs
        ctx.save_for_backward(*tensors)
        ctx.set_materialize_grads(False)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor | None) -> tuple:
        saved = ctx.saved_tensors  # once: a checkpoint gives them once
        for bar in grads:
            if bar is not None:
                not_batched(bar)
        bars = (saved[0].new_empty((0,)) if bar is None else bar for bar in grads)
        return (*_RubbingBackward.apply(*bars, *saved, ctx.listed), None, None)


class _RubbingBackward(Backward):
    @staticmethod
    def forward(lag_bar, push_bar, x, collider, kappa, friction, damping, origin, listed):
        points, *of_scenes = ops_lag.rubbing_backward(lag_bar.contiguous(), push_bar.contiguous(), x, origin, collider,
                                                      kappa, friction, damping, *listed)  # fmt: skip
        sums = (ops.sum_to(b, t.shape) for b, t in zip(of_scenes, (kappa, friction, damping), strict=True))
        return (*_of_points(points, x, collider), *sums)


class _AtCorners(Function):
    @staticmethod
    def forward(points: Tensor, listed: Pairs) -> Tensor:
        rows = listed.pairs.clamp(min=0).long()
        return points[rows[:, 5:], rows[:, :4]]

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: Tensor) -> None:
        ctx.shape, ctx.listed = inputs[0].shape[:2], inputs[1]

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple:
        return sum_at_corners(grads[0], ctx.listed, *ctx.shape), None


class _SumAtCorners(Function):
    @staticmethod
    def forward(values: Tensor, listed: Pairs, scenes: int, points: int) -> Tensor:
        rows = values.flatten(0, 1)[None].contiguous()
        return ops_contact.segment_sum(rows, listed.entry, listed.ptr).reshape(scenes, points, values.shape[-1])

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: Tensor) -> None:
        ctx.listed = inputs[1]

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple:
        return at_corners(grads[0], ctx.listed), None, None, None


def at_corners(points: Tensor, listed: Pairs) -> Tensor:
    """points [B, N, n] of all corner points at those of each pair [pairs, 4, n]; those of a row that no pair fills are
    any, and pass no gradient on."""
    return _AtCorners.apply(points, listed)


def sum_at_corners(values: Tensor, listed: Pairs, scenes: int, points: int) -> Tensor:
    """Sums of values at the corners of pairs [pairs, 4, n] over the pairs of each corner point, [B, N, n] of so many
    scenes and corner points."""
    return _SumAtCorners.apply(values, listed, scenes, points)


class _OfScene(Function):
    """A value of each scene [B] for each pair of a list [pairs]."""

    @staticmethod
    def forward(value: Tensor, listed: Pairs) -> Tensor:
        return value[listed.pairs[:, 5].clamp(min=0).to(torch.int64)]

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: Tensor) -> None:
        ctx.scenes, ctx.listed = inputs[0].shape[0], inputs[1]

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple:
        return sum_of_scenes(grads[0], ctx.listed, ctx.scenes), None


def sum_of_scenes(values: Tensor, listed: Pairs, scenes: int) -> Tensor:
    """Sums of values of pairs [pairs] over those of each scene [B], in a fixed order; values are zero in rows that no
    pair fills."""
    if scenes <= 1:
        return ops.sum_to(values, (1,))[:scenes]
    ptr = listed.ptr  # pairs are sorted by scene, with four entries each
    first = (ptr[:: (ptr.shape[0] - 1) // scenes] // 4).contiguous()
    order = torch.arange(values.shape[0], dtype=torch.int32, device=ptr.device)
    return ops_contact.segment_sum(values[None, :, None].contiguous(), order, first)[0, :, 0]


def of_scene(value: Tensor, listed: Pairs) -> Tensor:
    """value [B], one for each scene, for each pair [pairs]; its gradient is summed in a fixed order."""
    return _OfScene.apply(value, listed)


def pair_lag(x: Tensor, collider: Tensor, kappa: Tensor, origin: Tensor, listed: Pairs) -> Tensor:
    """[pairs, 9]: normal force [N], 1 where closer than dhat, normal (3), weights (4); differentiable in three.

    Args:
        x: [B, V, 3] [m].  collider: [B, Vc, 3] [m].  kappa: [1 | B] [N/m].  origin: [B, V, 3] or empty.
    """
    return _Lag.apply(x.contiguous(), collider.contiguous(), kappa.contiguous(), origin, listed)


def rubbing(x: Tensor, collider: Tensor, kappa: Tensor, friction: Tensor, damping: Tensor, origin: Tensor,
            listed: Pairs) -> tuple[Tensor, Tensor]:  # fmt: skip
    """[pairs, 9]: friction coefficient times normal force [N], damping [N s/m] (energies.damped_share), normal (3),
    weights (4); and the forces of pairs on corner points [B, N, 3] [N]. Differentiable in the first five.

    Args:
        x: [B, V, 3] [m].  collider: [B, Vc, 3] [m].  kappa: [1 | B] [N/m].  friction, damping: [1 | B], or empty.
        origin: [B, V, 3] or empty.
    """
    given = (t.contiguous() for t in (x, collider, kappa, friction, damping))
    return _Rubbing.apply(*given, origin, listed)


ops.ready_signature(_Lag, _OfScene, _AtCorners, _SumAtCorners)
