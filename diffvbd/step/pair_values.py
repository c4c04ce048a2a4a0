"""The potentials of pairs and of friction on a floor, each term of its own, without derivatives."""

from __future__ import annotations

import torch
from torch import Tensor

from ..adjoint.contact_lag import Pairs, pair_lag
from ..tuples import replaced
from .rigid_terms import Scenes, corners_of, log_barrier


def barrier_values(s: Scenes, x: Tensor) -> Tensor:
    """Of the barrier of each listed pair at x [B, V, 3], [pairs] [kg m^2]."""
    f, listed = s.fields, s.listed
    state = pair_lag(x, f.collider, f.kappa, f.origin, listed)
    near = state[:, 1] > 0
    if not x.is_cuda:  # few of them push
        rows = near.nonzero()[:, 0]
        listed = replaced(listed, pairs=listed.pairs[rows], constants=listed.constants[rows])
        values = _barrier_values(s, x, listed, state[rows], near[rows])
        return values.new_zeros(len(near)).index_copy_(0, rows, values)
    return _barrier_values(s, x, listed, state, near)


def _barrier_values(s: Scenes, x: Tensor, listed: Pairs, state: Tensor, near: Tensor) -> Tensor:
    force, _, n, w = state.split((1, 1, 3, 4), -1)
    scene, corners = corners_of(listed)
    f = s.fields
    at = torch.cat([x, f.collider], 1)[scene, corners]
    if f.origin.numel():
        at = at + torch.cat([f.origin, torch.zeros_like(f.collider)], 1)[scene, corners]
    gap = (w * ((at - at[:, :1]) * n[:, None]).sum(-1)).sum(-1) - listed.constants[:, 1]
    b, slope, _ = log_barrier(torch.where(near, gap, 0.5), torch.where(near, listed.constants[:, 0], 1.0))
    # the force carries stiffness and mollifier
    return torch.where(near, s.time_step**2 * force[:, 0] * (b / -slope), 0.0)


def lagged_values(s: Scenes, x: Tensor) -> Tensor:
    """Of friction and damping of each pair that was close at the start of the step, likewise."""
    f, h = s.fields, s.time_step
    load, rate, n, w = f.lag.split((1, 1, 3, 4), -1)
    scene, corners = corners_of(s.lagged)
    moved = torch.cat([x - f.x_prev, f.collider - f.collider_prev], 1)[scene, corners]
    m = (w[..., None] * moved).sum(1)
    along = (n * m).sum(-1, keepdim=True)
    slip = _slip_value(m - along * n, s.friction_eps)
    return h * h * load[:, 0] * slip + 0.5 * h * (rate * along.clamp(max=0) ** 2)[:, 0]


def floor_friction_values(s: Scenes, x: Tensor) -> Tensor:
    """Of friction of each vertex on a floor [B, V]."""
    load, n = s.fields.floor_lag[..., 0], s.fields.floor_lag[..., 1:]
    travel = (x - s.fields.x_prev)[:, :, None]
    u = travel - n * (n * travel).sum(-1, keepdim=True)
    return s.time_step**2 * (load * _slip_value(u, s.friction_eps)).sum(-1)


def _slip_value(u: Tensor, eps: float) -> Tensor:
    """Friction's potential f0 of slips u [..., 3]; twin of slip_value in csrc/contact/rigid.h."""
    length = u.square().sum(-1).sqrt()
    return torch.where(length < eps, length**2 * (1 / eps - length / (3 * eps**2)) + eps / 3, length)
