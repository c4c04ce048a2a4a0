"""What the rigid correction of bodies that touch is made of: inertia, energies of single vertices, friction on a floor,
and barriers, friction and damping of pairs, each with gradient, blocks and potential. Twin of csrc/contact/pairs.h."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..adjoint.contact_lag import Pairs, of_scene, pair_lag, some_of
from ..adjoint.sums import sum_by
from ..contact.surface import ContactSurface
from ..ops import broadcast

RESTING = 1e-6  # of the motion below which friction is smoothed; twin of kRestingMotion in csrc/contact/pairs.h


class Scenes(NamedTuple):
    """What the correction reads; positions [B, V, 3] [m]."""

    model: Any
    x_prev: Tensor
    y: Tensor
    mass: Tensor  # [1 | B, V] [kg]
    data: Tensor  # of the energies
    origin: Tensor  # [B, V, 3] or empty
    collider_prev: Tensor  # at the start of the step, [B, Vc, 3]
    collider: Tensor  # and now
    kappa: Tensor
    listed: Pairs
    lagged: Pairs
    lag: Tensor  # [pairs, 9]
    floor_lag: Tensor  # [B, V, planes, 4] or empty
    center: Tensor  # from where each vertex has its room
    room: Tensor  # [B, V] [m]
    surface: ContactSurface | None
    time_step: float
    friction_eps: float  # [m]


class PairTerms(NamedTuple):
    """What pairs add: gradient [n, 3] by the first side's motion, its derivative [n, 3, 3], weights [n, 4], and the
    potential [n] of which they are."""

    listed: Pairs
    force: Tensor
    stiffness: Tensor
    weights: Tensor
    value: Tensor
    within: bool  # whether pairs of one body turn it: friction acts along a gap, at an arm of it
    at_corners: Tensor | None = None  # what is added to the gradient at each corner [n, 4, 3]


def outer(n: Tensor) -> Tensor:
    return n[..., None] * n[..., None, :]


def _slip(u: Tensor, eps: float) -> tuple[Tensor, Tensor]:
    """Friction's potential f0 of slips u [..., 3], and f0'(|u|) / |u|."""
    square = (u * u).sum(-1)
    moves = square > (RESTING * eps) ** 2
    length = torch.where(moves, torch.where(moves, square, torch.ones_like(square)).sqrt(), square.detach().sqrt())
    slow = length < eps
    value = torch.where(slow, length**2 / eps - length**3 / (3 * eps**2) + eps / 3, length)
    return value, torch.where(slow, (2 - length / eps) / eps, 1 / torch.where(slow, torch.ones_like(length), length))


def _log_barrier(gap: Tensor, dhat: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """b / kappa and its first two derivatives, of gaps in (0, dhat)."""
    past, log = gap - dhat, torch.log(gap / dhat)
    part = past / gap
    return -past * past * log, -past * (2 * log + part), -(2 * log + 4 * part - part * part)


def vertex_energies(s: Scenes) -> list[tuple[Any, tuple[Tensor, float, Tensor | None]]]:
    """The energies of single vertices, each with its data, the time step and the origin."""
    out, first = [], 0
    for energy in s.model.vertex_energies:
        size = energy.count() * (s.model.num_vertices if energy.per_vertex else 1)
        out.append((energy, (s.data[:, first : first + size], s.time_step, s.origin if s.origin.numel() else None)))
        first += size
    return out


def _off_target(s: Scenes, x: Tensor) -> Tensor:
    return torch.where(s.model._pinned[:, None], torch.zeros_like(x), x - s.y)


def _floor_slip(s: Scenes, x: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Of friction on a floor: load [N] and motion along each plane, and what _slip says of it."""
    load, n = s.floor_lag[..., 0], s.floor_lag[..., 1:]
    travel = (x - s.x_prev)[:, :, None]
    u = travel - n * (n * travel).sum(-1, keepdim=True)
    return load, u, *_slip(u, s.friction_eps)


def _vertex_value(s: Scenes, x: Tensor) -> Tensor:
    """The potential of inertia, energies of single vertices and friction on a floor, of each scene [B]."""
    value = (0.5 * broadcast(s.mass, x.shape[:2]) * (_off_target(s, x) ** 2).sum(-1)).sum(1)
    for energy, rest in vertex_energies(s):
        value = value + energy.value(x, s.x_prev, *rest).sum(1)
    if s.floor_lag.numel():
        load, _, potential, _ = _floor_slip(s, x)
        value = value + s.time_step**2 * (load * potential).sum((1, 2))
    return value


def vertex_gradient(s: Scenes, x: Tensor) -> Tensor:
    """Its gradient [B, V, 3]."""
    force = broadcast(s.mass, x.shape[:2])[..., None] * _off_target(s, x)
    for energy, rest in vertex_energies(s):
        force = force + energy.gradient(x, s.x_prev, *rest)
    if s.floor_lag.numel():
        load, u, _, rate = _floor_slip(s, x)
        force = force + s.time_step**2 * ((load * rate)[..., None] * u).sum(2)
    return force


def vertex_blocks(s: Scenes, x: Tensor) -> Tensor | None:
    """Blocks [B, V, 3, 3] that are at least its derivative, without those of inertia; None where there are none."""
    parts = [energy.blocks(x, s.x_prev, *rest) for energy, rest in vertex_energies(s)]
    if s.floor_lag.numel():
        load, _, _, rate = _floor_slip(s, x)
        across = torch.eye(3, dtype=x.dtype, device=x.device) - outer(s.floor_lag[..., 1:])
        parts.append(s.time_step**2 * ((load * rate)[..., None, None] * across).sum(2))
    out = None
    for part in parts:
        out = part if out is None else out + part
    return None if out is None else broadcast(out, (*x.shape, 3))


def corners_of(listed: Pairs) -> tuple[Tensor, Tensor]:
    """Scene [n, 1] and corner points [n, 4] of pairs; of rows that no pair fills, the first."""
    rows = listed.pairs.long().clamp(min=0)
    return rows[:, 5:], rows[:, :4]


def active_pairs(s: Scenes, x: Tensor) -> Pairs:
    """The listed pairs that push where the vertices are at x: few of them, and the others add nothing. All of them
    where values must not decide sizes."""
    if not s.listed.pairs.shape[0] or x.is_cuda or torch.compiler.is_compiling():
        return s.listed
    with torch.no_grad():
        acts = pair_lag(x.detach(), s.collider.detach(), s.kappa.detach(), s.origin, s.listed)[:, 1] > 0
    return some_of(s.listed, acts.nonzero()[:, 0], x.shape[1] + s.collider.shape[1])


def pair_terms(s: Scenes, x: Tensor) -> list[PairTerms]:
    """Of barriers, and of lagged friction and damping."""
    h, h2 = s.time_step, s.time_step**2
    points = torch.cat([x, s.collider], 1)
    out = []
    if s.listed.pairs.shape[0]:
        force, active, n, w = pair_lag(x, s.collider, s.kappa, s.origin, s.listed).split((1, 1, 3, 4), -1)
        scene, corners = corners_of(s.listed)
        at = points[scene, corners]
        if s.origin.numel():
            at = at + torch.cat([s.origin, torch.zeros_like(s.collider)], 1)[scene, corners]
        dhat, offset = s.listed.constants[:, 0], s.listed.constants[:, 1]
        near = active[:, 0] > 0
        height = ((at - at[:, :1].detach()) * n[:, None]).sum(-1)
        gap = torch.where(near, (w * height).sum(-1) - offset, 0.5)
        b, slope, curvature = _log_barrier(gap, torch.where(near, dhat, 1.0))
        # the force carries stiffness and mollifier: what is left are ratios of the barrier's derivatives
        load = h2 * torch.where(near, force[:, 0] / -slope, 0.0)
        kappa = s.kappa if s.kappa.shape[0] == 1 else of_scene(s.kappa, s.listed)
        turned = torch.where(near, h2 * kappa * b, 0.0)[:, None, None] * _mollifier_gradient(at, s.listed)
        stiffness = (load * curvature)[:, None, None] * outer(n)
        out.append(PairTerms(s.listed, -h2 * force * n, stiffness, w, load * b, False, turned))
    if s.lag.numel():
        load, rate, n, w = s.lag.split((1, 1, 3, 4), -1)
        scene, corners = corners_of(s.lagged)
        moved = points[scene, corners] - torch.cat([s.x_prev, s.collider_prev], 1)[scene, corners]
        m = (w[..., None] * moved).sum(1)
        along = (n * m).sum(-1, keepdim=True)
        approach, u = along.clamp(max=0), m - along * n
        potential, slip = _slip(u, s.friction_eps)
        slip = h2 * load * slip[:, None]
        eye = torch.eye(3, dtype=x.dtype, device=x.device)
        stiffness = slip[..., None] * (eye - outer(n)) + (h * rate)[..., None] * outer(n)
        value = h2 * load[:, 0] * potential + 0.5 * h * (rate * approach**2)[:, 0]
        out.append(PairTerms(s.lagged, slip * u + h * rate * approach * n, stiffness, w, value, True))
    return out


def _mollifier_gradient(at: Tensor, listed: Pairs) -> Tensor:
    """Of e = s (2 - s) by the corners [n, 4, 3] at ``at``; zero where nothing is mollified. Twin of
    csrc/contact/geometry.h."""
    threshold = listed.constants[:, 2]
    u, v = at[:, 1] - at[:, 0], at[:, 3] - at[:, 2]
    c = torch.linalg.cross(u, v)
    square = (c * c).sum(-1)
    close = (listed.pairs[:, 4] == 1) & (square < threshold)
    safe = torch.where(close, threshold, 1.0)
    slope = torch.where(close, 4 * (1 - square / safe) / safe, 0.0)[:, None]
    by_u, by_v = slope * torch.linalg.cross(v, c), slope * torch.linalg.cross(c, u)
    return torch.stack([-by_u, by_u, -by_v, by_v], 1)


def potential(s: Scenes, x: Tensor) -> Tensor:
    """Of each scene [B] [kg m^2], without tets."""
    s = s._replace(listed=active_pairs(s, x))
    value = _vertex_value(s, x)
    for terms in pair_terms(s, x):
        scene = corners_of(terms.listed)[0][:, 0]
        value = value + sum_by(terms.value[:, None], scene, x.shape[0])[:, 0]
    return value
