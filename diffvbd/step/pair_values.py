"""The potentials of pairs and of friction on a floor, each term of its own, without derivatives."""

from __future__ import annotations

import torch
from torch import Tensor

from ..adjoint.contact_lag import Pairs, pair_lag
from .rigid_terms import Scenes, _floor_slip, _log_barrier, _slip, corners_of


def barrier_values(s: Scenes, x: Tensor) -> Tensor:
    """Of the barrier of each listed pair at x [B, V, 3], [pairs] [kg m^2]."""
    state, listed = pair_lag(x, s.collider, s.kappa, s.origin, s.listed), s.listed
    near = state[:, 1] > 0
    if not x.is_cuda:  # few of them push
        rows = near.nonzero()[:, 0]
        listed = listed._replace(pairs=listed.pairs[rows], constants=listed.constants[rows])
        values = _barrier_values(s, x, listed, state[rows], near[rows])
        return values.new_zeros(len(near)).index_copy_(0, rows, values)
    return _barrier_values(s, x, listed, state, near)


def _barrier_values(s: Scenes, x: Tensor, listed: Pairs, state: Tensor, near: Tensor) -> Tensor:
    force, _, n, w = state.split((1, 1, 3, 4), -1)
    scene, corners = corners_of(listed)
    at = torch.cat([x, s.collider], 1)[scene, corners]
    if s.origin.numel():
        at = at + torch.cat([s.origin, torch.zeros_like(s.collider)], 1)[scene, corners]
    gap = (w * ((at - at[:, :1]) * n[:, None]).sum(-1)).sum(-1) - listed.constants[:, 1]
    b, slope, _ = _log_barrier(torch.where(near, gap, 0.5), torch.where(near, listed.constants[:, 0], 1.0))
    # the force carries stiffness and mollifier
    return torch.where(near, s.time_step**2 * force[:, 0] * (b / -slope), 0.0)


def lagged_values(s: Scenes, x: Tensor) -> Tensor:
    """Of friction and damping of each pair that acted at the start of the step, likewise."""
    h = s.time_step
    load, rate, n, w = s.lag.split((1, 1, 3, 4), -1)
    scene, corners = corners_of(s.lagged)
    moved = torch.cat([x - s.x_prev, s.collider - s.collider_prev], 1)[scene, corners]
    m = (w[..., None] * moved).sum(1)
    along = (n * m).sum(-1, keepdim=True)
    slip, _ = _slip(m - along * n, s.friction_eps)
    return h * h * load[:, 0] * slip + 0.5 * h * (rate * along.clamp(max=0) ** 2)[:, 0]


def floor_friction_values(s: Scenes, x: Tensor) -> Tensor:
    """Of friction of each vertex on a floor [B, V]."""
    load, _, value, _ = _floor_slip(s, x)
    return s.time_step**2 * (load * value).sum(-1)
