"""The rigid correction of bodies that touch: all bodies of a scene moved, each as a whole, by one Newton step of the
step's potential over their rigid motions.

    min over (w_b, t_b)   1/2 sum m |x - y|^2 + energies of single vertices + barriers, friction and damping of pairs

A rigid motion leaves the energy of the tets as it is, so that this costs sums over vertices and pairs, and six unknowns
a body. It is what few sweeps do worst: they see neighbours, not the body. The share of its motion that each body takes
is decided, not differentiated. docs/method.md, section 18.
"""

# pyright: reportIncompatibleMethodOverride=false
from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.autograd import Function

from .. import ops
from ..adjoint.contact_lag import Pairs, of_scene, sum_at_corners
from ..model.model import Model
from ..ops import broadcast, no_second_derivative, no_transforms, of_inputs
from ..ops import contact_rigid as ops_rigid
from ..ops.segments import Order, of_segments, sum_segments
from .rigid_terms import Scenes, vertex_blocks, vertex_gradient

# of a body's mass and sum of m r^2, that keeps its system definite; twin of kLeastInertia in csrc/contact/rigid.h
LEAST_INERTIA = 1e-11
_FIELDS = len(ops.TouchingFields._fields)


def correct(model: Model, fields: ops.TouchingFields, time_step: float, friction_eps: float) -> tuple[Tensor, Tensor]:
    """x [B, V, 3] after every free body has been moved, as far as pairs, floors and the potential let it; and the share
    of its motion that each took [B, bodies]. friction_eps: [m], 0 without friction. Differentiable in
    ops.TOUCHING_ADJOINTS."""
    fields = ops.TouchingFields(*(t.contiguous() for t in fields))
    x, share, *_ = _Correct.apply(*fields, model, time_step, friction_eps)
    return x, share.to(x.dtype)


def bodies_of(model: Model) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """order, ptr, free, held and body of ops.TouchingFields."""
    return model.derived("touching_bodies", lambda: _bodies_of(model))


def _bodies_of(model: Model) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    surface, count = model.surface_of_contact, model.mesh.num_bodies
    pins = torch.zeros((count,), dtype=torch.int64, device=model.device).index_add(0, model.body, model._pinned.long())
    free = pins == 0
    if surface is not None:
        return surface.body_order, surface.body_ptr, free, surface.held, surface.body
    body, order = torch.sort(model.body, stable=True)
    ptr = torch.searchsorted(body, torch.arange(count + 1, device=body.device))
    return order.to(torch.int32), ptr.to(torch.int32), free, model._pinned, model.body.to(torch.int32)


class _Correct(Function):
    @staticmethod
    def forward(x, x_prev, y, mass, energy_data, origin, order, ptr, free, held, body, collider, collider_prev, kappa,
                pairs, constants, pair_ptr, pair_entry, lag, lag_pairs, lag_ptr, lag_entry, floor_lag, center, room,
                model, time_step, friction_eps):  # fmt: skip
        fields = ops.TouchingFields(x, x_prev, y, mass, energy_data, origin, order, ptr, free, held, body, collider,
                                    collider_prev, kappa, pairs, constants, pair_ptr, pair_entry, lag, lag_pairs,
                                    lag_ptr, lag_entry, floor_lag, center, room)  # fmt: skip
        counts = model._data_count
        centers, motion, factor = ops_rigid.rigid_system(fields, counts, time_step, friction_eps)
        end, share = ops_rigid.rigid_move(fields, centers, motion, counts, time_step, friction_eps)
        return end, share, motion, factor

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: tuple[Tensor, ...]) -> None:
        ctx.save_for_backward(*inputs[:_FIELDS], *output[1:])
        ctx.options = inputs[_FIELDS:]
        ctx.mark_non_differentiable(*output[1:])
        ctx.set_materialize_grads(False)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor | None) -> tuple:
        if grads[0] is None:
            return (None,) * (_FIELDS + 3)
        ops.not_batched(grads[0])
        needs = ctx.needs_input_grad[:_FIELDS]
        out = _CorrectBackward.apply(grads[0], *ctx.saved_tensors, *ctx.options, needs)
        return of_inputs(out if isinstance(out, tuple) else (out,), needs, 3)

    @staticmethod
    def vmap(info: Any, in_dims: tuple, *args: Any) -> Any:
        no_transforms()


class _CorrectBackward(Function):
    @staticmethod
    def forward(x_bar, *saved):
        *tensors, share, motion, factor, model, time_step, friction_eps, needs = saved
        friction_eps = friction_eps or 1.0  # of loads that are zero
        if not x_bar.is_cuda:
            s = Scenes(model, ops.TouchingFields(*(t.detach() for t in tensors)), time_step, friction_eps)
            return _compiled_adjoints(s, x_bar, share, motion, factor, needs)
        with torch.enable_grad():
            fields = ops.TouchingFields(*(t.detach().requires_grad_(need and t.is_floating_point())
                                          for t, need in zip(tensors, needs, strict=True)))  # fmt: skip
            return _adjoints(Scenes(model, fields, time_step, friction_eps), x_bar, share, motion, factor, needs)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: tuple[Tensor, ...]) -> None:
        pass

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Any:
        no_second_derivative()


def _adjoints(s: Scenes, x_bar: Tensor, share: Tensor, motion: Tensor, factor: Tensor, needs: Sequence[bool]
              ) -> tuple[Tensor, ...]:  # fmt: skip
    """Of the fields that need one. With H d = -g, the adjoint of d is that of -l . (g + H d), where H l is the adjoint
    of d: a sum over vertices, derived by autograd, and over pairs, derived by the compiled operator."""
    f = s.fields
    body = f.body[: f.x.shape[1]].long()
    leaf = motion.to(f.x.dtype).requires_grad_()
    arm, whole = _arms(f, body)
    end = f.x + _displaced(share.to(f.x.dtype)[..., None] * leaf, arm, (f.order, f.ptr, body))
    wanted = [t for t, need in zip(f, needs, strict=True) if need]
    *first, bar = torch.autograd.grad(end, (*wanted, leaf), x_bar, allow_unused=True, retain_graph=True)
    solution = ops_rigid.rigid_solve(factor, bar.to(factor.dtype))
    # of a matrix that was not positive definite no motion came, and nothing goes back through it
    moved = f.free & torch.isfinite(solution).all(-1)
    solution = torch.where(moved[..., None], solution, 0.0).to(f.x.dtype)
    virtual = -_virtual_work(s, solution, leaf.detach(), arm, whole, body)
    second = torch.autograd.grad(virtual, wanted, allow_unused=True)
    return tuple(_sum(pair, t) for pair, t in zip(zip(first, second, strict=True), wanted, strict=True))


def _compiled_adjoints(s: Scenes, x_bar: Tensor, share: Tensor, motion: Tensor, factor: Tensor, needs: Sequence[bool]
                       ) -> tuple[Tensor, ...]:  # fmt: skip
    """The same by compiled operators, which the CPU has."""
    f, (scenes, vertices) = s.fields, s.fields.x.shape[:2]
    wants = dict(zip(ops.TouchingFields._fields, needs, strict=True))
    options = s.model._data_count, s.time_step, s.friction_eps
    end = ops_rigid.rigid_end_backward(f, motion, share, factor, x_bar, *options)
    barrier, by_kappa, friction, by_lag = ops_rigid.rigid_backward(f, end.p, end.q, *options)
    # of corner points: by where they are, by how they have moved, by p and by q
    by_x, by_way, by_p, by_q = (torch.zeros_like(end.p) for _ in range(4))
    if len(barrier):
        by_x, by_p, by_q = sum_at_corners(barrier, s.listed, *end.p.shape[:2]).split(3, -1)
    if len(friction):
        by_way, also_p, also_q = sum_at_corners(friction, s.lagged, *end.p.shape[:2]).split(3, -1)
        by_p, by_q = by_p + also_p, by_q + also_q
    own = ops_rigid.rigid_vertices_backward(f, motion, end.solution, by_p, by_q, *options, wants["energy_data"])
    to_points = by_x + by_way
    out = {
        "x": end.x + own.x - to_points[:, :vertices],
        "x_prev": own.x_prev + by_way[:, :vertices],
        "y": own.y,
        "mass": end.mass + own.mass,
        "energy_data": own.energy_data,
        "collider": -to_points[:, vertices:],
        "collider_prev": by_way[:, vertices:],
        "kappa": -_of_scenes(by_kappa, s.listed, scenes),
        "lag": -by_lag,
        "floor_lag": own.floor_lag,
    }
    none = f.x.new_empty((0,))
    bars = [(out.get(name, none), t) for name, t in zip(f._fields, f, strict=True) if wants[name]]
    return tuple(ops.sum_to(bar, t.shape) if bar.numel() else torch.zeros_like(t) for bar, t in bars)


def _of_scenes(values: Tensor, listed: Pairs, scenes: int) -> Tensor:
    """Sums over the pairs of each scene [B]; values are zero in rows that no pair fills."""
    return values.new_zeros((scenes,)).index_add_(0, listed.pairs[:, 5].long().clamp(min=0), values)


def _sum(parts: tuple[Tensor | None, ...], like: Tensor) -> Tensor:
    out = torch.zeros_like(like)
    for part in parts:
        out = out if part is None else out + part
    return out.detach()


def _arms(f: ops.TouchingFields, body: Tensor) -> tuple[Tensor, Tensor]:
    """Where vertices are from the centers of mass of their bodies [B, V, 3], and the masses of these [B, bodies]."""
    mass = broadcast(f.mass, f.x.shape[:2])[..., None]
    sums = sum_segments(torch.cat([mass, mass * f.x], -1), f.order, f.ptr, body)
    whole = sums[..., :1].clamp(min=torch.finfo(f.x.dtype).tiny)
    return f.x - of_segments(sums[..., 1:] / whole, f.order, f.ptr, body), sums[..., 0]


def _displaced(motion: Tensor, arm: Tensor, of: Order) -> Tensor:
    """What a turn and a shift of each body [B, bodies, 6] do to its vertices, exactly, [B, V, 3]."""
    w, shift = motion.split(3, -1)
    square = (w * w).sum(-1, keepdim=True)
    small = square < 1e-8
    safe = torch.where(small, torch.ones_like(square), square)
    angle = safe.sqrt()
    first = torch.where(small, 1 - square / 6, torch.sin(angle) / angle)
    second = torch.where(small, 0.5 - square / 24, (1 - torch.cos(angle)) / safe)
    w, first, second, shift = of_segments(torch.cat([w, first, second, shift], -1), *of).split((3, 1, 1, 3), -1)
    turned = torch.linalg.cross(w, arm)
    return first * turned + second * torch.linalg.cross(w, turned) + shift


def _virtual_work(s: Scenes, p: Tensor, q: Tensor, arm: Tensor, whole: Tensor, body: Tensor) -> Tensor:
    """p . (gradient + matrix q + friction after q), for motions p and q of all bodies [B, bodies, 6]."""
    f = s.fields
    at_p, at_q = (torch.linalg.cross(m[:, body, :3], arm) + m[:, body, 3:] for m in (p, q))
    mass = broadcast(f.mass, f.x.shape[:2])[..., None]
    own, blocks = vertex_gradient(s, at_q) + mass * at_q, vertex_blocks(s, friction=False)
    if blocks is not None:
        own = own + (blocks * at_q[..., None, :]).sum(-1)
    spread = sum_segments(mass * arm.square().sum(-1, keepdim=True), f.order, f.ptr, body)
    least = (p * q * torch.cat([spread.expand(*whole.shape, 3), whole[..., None].expand(*whole.shape, 3)], -1)).sum()
    work = (at_p * own).sum() + LEAST_INERTIA * least
    return work + _work_of_pairs(s, at_p, at_q)


def _work_of_pairs(s: Scenes, at_p: Tensor, at_q: Tensor) -> Tensor:
    """A scalar with the derivatives of what pairs add to the virtual work, but another value."""
    f, rest = s.fields, torch.zeros_like(s.fields.collider)
    at_p, at_q, points = (torch.cat([t, u], 1) for t, u in ((at_p, rest), (at_q, rest), (f.x, f.collider)))
    found = ops_rigid.rigid_backward(
        ops.TouchingFields(*(t.detach() for t in f)), at_p.detach(), at_q.detach(), s.model._data_count, s.time_step,
        s.friction_eps,
    )  # fmt: skip
    barrier, by_kappa, friction, by_lag = found

    def at_all(rows: Tensor, listed: Pairs) -> tuple[Tensor, ...]:
        return sum_at_corners(rows, listed, *points.shape[:2]).split(3, -1)

    work = points.new_zeros(())
    if len(barrier):
        by_x, by_p, by_q = at_all(barrier, s.listed)
        kappa = f.kappa if f.kappa.shape[0] == 1 else of_scene(f.kappa, s.listed)
        work = work + (by_x * points + by_p * at_p + by_q * at_q).sum() + (kappa * by_kappa).sum()
    if len(friction):
        by_x, by_p, by_q = at_all(friction, s.lagged)
        since = points - torch.cat([f.x_prev, f.collider_prev], 1)
        work = work + (by_x * since + by_p * at_p + by_q * at_q).sum() + (f.lag * by_lag).sum()
    return work


ops.ready_signature(_Correct)
