"""Parts of coarse corrections of bodies that touch, differentiable: gradient and blocks of inertia, energies of
single vertices, friction on a floor, and barriers, friction and damping of pairs. Twin of csrc/contact/rigid.h."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from .. import ops
from ..adjoint.contact_lag import Pairs, at_corners, of_scene, pair_lag, some_of
from ..adjoint.potential import of_vertices
from ..ops import broadcast
from ..ops.fields import RESTING_MOTION


class Scenes(NamedTuple):
    """Fields of the correction."""

    model: Any
    fields: ops.TouchingFields
    time_step: float
    friction_eps: float  # [m]

    @property
    def listed(self) -> Pairs:
        f = self.fields
        return Pairs(f.pairs, f.constants, f.pair_ptr, f.pair_entry)

    @property
    def lagged(self) -> Pairs:
        f = self.fields
        return Pairs(f.lag_pairs, f.constants, f.lag_ptr, f.lag_entry)


class PairTerms(NamedTuple):
    """Contribution of pairs: gradient [n, 3] by the motion of their weighted corners, its derivative [n, 3, 3] and
    weights [n, 4]."""

    listed: Pairs
    force: Tensor
    stiffness: Tensor
    weights: Tensor
    at_corners: Tensor | None = None  # what is added to the gradient at each corner [n, 4, 3]


def outer(n: Tensor) -> Tensor:
    return n[..., None] * n[..., None, :]


def _slip(u: Tensor, eps: float) -> tuple[Tensor, Tensor]:
    """f1(|u|) / |u| of friction, and that quotient's derivative over |u|, of slips u [..., 3]."""
    square = (u * u).sum(-1)
    moves = square > (RESTING_MOTION * eps) ** 2
    length = torch.where(moves, torch.where(moves, square, torch.ones_like(square)).sqrt(), square.detach().sqrt())
    sticks = length < eps
    rate = torch.where(sticks, (2 - length / eps) / eps, 1 / torch.where(sticks, torch.ones_like(length), length))
    slope = torch.where(sticks, -1 / eps**2, -rate * rate)
    return rate, torch.where(moves, slope / torch.where(moves, length, torch.ones_like(length)), 0.0)


def _slip_stiffness(rate: Tensor, bend: Tensor, n: Tensor, u: Tensor) -> Tensor:
    """Friction's exact derivative by the motion across n [..., 3, 3], of load times what _slip returns."""
    eye = torch.eye(3, dtype=n.dtype, device=n.device)
    return rate[..., None, None] * (eye - outer(n)) + bend[..., None, None] * outer(u)


def log_barrier(gap: Tensor, dhat: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """b / kappa and its first two derivatives, of gaps in (0, dhat)."""
    past, log = gap - dhat, torch.log(gap / dhat)
    part = past / gap
    return -past * past * log, -past * (2 * log + part), -(2 * log + 4 * part - part * part)


def _vertex_energies(s: Scenes) -> list[tuple[Any, tuple[Tensor, float, Tensor | None]]]:
    """The energies of single vertices, each with its data, the time step and the origin."""
    f = s.fields
    out, first, origin = [], 0, f.origin if f.origin.numel() else None
    for energy in s.model.vertex_energies:
        size = energy.count() * (s.model.num_vertices if energy.per_vertex else 1)
        own = f.energy_data[:, first : first + size]
        own = broadcast(own, (len(f.x), size)) if energy.per_vertex else of_vertices(own, f.x)
        out.append((energy, (own, s.time_step, origin)))
        first += size
    return out


def _floor_slip(s: Scenes) -> tuple[Tensor, Tensor, Tensor]:
    """Of friction on a floor: motion along each plane, and load [N] times what _slip returns."""
    load, n = s.fields.floor_lag[..., 0], s.fields.floor_lag[..., 1:]
    travel = (s.fields.x - s.fields.x_prev)[:, :, None]
    u = travel - n * (n * travel).sum(-1, keepdim=True)
    rate, bend = _slip(u, s.friction_eps)
    return u, load * rate, load * bend


def vertex_gradient(s: Scenes) -> Tensor:
    """Of inertia, energies of single vertices and friction on a floor [B, V, 3]; of inertia not at pinned vertices."""
    f = s.fields
    off = torch.where(s.model._pinned[:, None], torch.zeros_like(f.x), f.x - f.y)
    force = broadcast(f.mass, f.x.shape[:2])[..., None] * off
    for energy, rest in _vertex_energies(s):
        force = force + energy.gradient(f.x, f.x_prev, *rest)
    if f.floor_lag.numel():
        u, rate, _ = _floor_slip(s)
        force = force + s.time_step**2 * (rate[..., None] * u).sum(2)
    return force


def vertex_blocks(s: Scenes) -> Tensor | None:
    """Blocks [B, V, 3, 3] of its derivative, without those of inertia; None where there are none."""
    f = s.fields
    parts = [energy.blocks(f.x, f.x_prev, *rest) for energy, rest in _vertex_energies(s)]
    if f.floor_lag.numel():
        u, rate, bend = _floor_slip(s)
        parts.append(s.time_step**2 * _slip_stiffness(rate, bend, f.floor_lag[..., 1:], u).sum(2))
    out = None
    for part in parts:
        out = part if out is None else out + part
    return None if out is None else broadcast(out, (*f.x.shape, 3))


def corners_of(listed: Pairs) -> tuple[Tensor, Tensor]:
    """Scene [n, 1] and corner points [n, 4] of pairs; of rows that no pair fills, the first."""
    rows = listed.pairs.long().clamp(min=0)
    return rows[:, 5:], rows[:, :4]


def _listed(s: Scenes) -> Pairs:
    """The pairs that push: few of those that are listed. All of them where values must not decide sizes."""
    f, listed = s.fields, s.listed
    if f.x.is_cuda:
        return listed
    with torch.no_grad():
        acts = pair_lag(f.x.detach(), f.collider.detach(), f.kappa.detach(), f.origin, listed)[:, 1] > 0
    return some_of(listed, acts)[0]


def pair_terms(s: Scenes) -> list[PairTerms]:
    """Of barriers, and of lagged friction and damping."""
    f, h, h2 = s.fields, s.time_step, s.time_step**2
    points = torch.cat([f.x, f.collider], 1)
    out = []
    if f.pairs.shape[0]:
        listed = _listed(s)
        force, active, n, w = pair_lag(f.x, f.collider, f.kappa, f.origin, listed).split((1, 1, 3, 4), -1)
        at = at_corners(points, listed)
        if f.origin.numel():
            at = at + at_corners(torch.cat([f.origin, torch.zeros_like(f.collider)], 1), listed)
        dhat, offset = listed.constants[:, 0], listed.constants[:, 1]
        near = active[:, 0] > 0
        height = ((at - at[:, :1].detach()) * n[:, None]).sum(-1)
        gap = torch.where(near, (w * height).sum(-1) - offset, 0.5)
        b, _, curvature = log_barrier(gap, torch.where(near, dhat, 1.0))
        kappa = broadcast(f.kappa, near.shape) if f.kappa.shape[0] == 1 else of_scene(f.kappa, listed)
        e, by_corners = _mollifier(at, listed)
        turned = torch.where(near, h2 * kappa * b, 0.0)[:, None, None] * by_corners
        stiffness = torch.where(near, h2 * kappa * e * curvature, 0.0)[:, None, None] * outer(n)
        out.append(PairTerms(listed, torch.where(near[:, None], -h2 * force * n, 0.0), stiffness, w, turned))
    if f.lag.numel():
        load, rate, n, w = f.lag.split((1, 1, 3, 4), -1)
        moved = at_corners(points - torch.cat([f.x_prev, f.collider_prev], 1), s.lagged)
        m = (w[..., None] * moved).sum(1)
        along = (n * m).sum(-1, keepdim=True)
        approach, u = along.clamp(max=0), m - along * n
        slip, bend = (h2 * load[:, 0] * part for part in _slip(u, s.friction_eps))
        stiffness = _slip_stiffness(slip, bend, n, u) + (h * rate)[..., None] * outer(n)
        out.append(PairTerms(s.lagged, slip[:, None] * u + h * rate * approach * n, stiffness, w))
    return out


def _mollifier(at: Tensor, listed: Pairs) -> tuple[Tensor, Tensor]:
    """e = s (2 - s) of pairs [n] with corners [n, 4, 3], and its gradient by these; 1 and zero where nothing is
    mollified. Twin of csrc/contact/geometry.h."""
    threshold = listed.constants[:, 2]
    u, v = at[:, 1] - at[:, 0], at[:, 3] - at[:, 2]
    c = torch.linalg.cross(u, v)
    square = (c * c).sum(-1)
    close = (listed.pairs[:, 4] == 1) & (square < threshold)
    safe = torch.where(close, threshold, 1.0)
    part = square / safe
    slope = torch.where(close, 4 * (1 - part) / safe, 0.0)[:, None]
    by_u, by_v = slope * torch.linalg.cross(v, c), slope * torch.linalg.cross(c, u)
    return torch.where(close, part * (2 - part), 1.0), torch.stack([-by_u, by_u, -by_v, by_v], 1)
