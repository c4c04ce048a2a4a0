"""The rigid correction of bodies that touch: all bodies of a scene moved, each as a whole, by one Newton step of the
step's potential over their rigid motions.

A rigid motion leaves the energy of the tets as it is. What remains is inertia, the energies of single vertices, the
barriers between bodies and lagged friction and damping: sums over vertices and pairs, and six unknowns for each body.
docs/method.md, section 18.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..adjoint.contact_lag import Pairs, pair_lag
from ..contact.surface import ContactSurface
from ..ops import broadcast
from ..ops import contact_start as ops_contact_start

MOST_COUPLED = 64  # bodies of a scene whose system is solved as one; with more each body takes both sides' stiffness
TRIES = 6  # of shorter motions
LEAST_GAP = 0.1  # of its gap that a vertex keeps above a plane


class Scene(NamedTuple):
    """What the correction reads; positions [B, V, 3]."""

    x_prev: Tensor
    y: Tensor
    mass: Tensor  # [1 | B, V]
    origin: Tensor  # or empty
    collider_prev: Tensor  # at the start of the step, at the detection, and now
    was: Tensor
    collider: Tensor
    kappa: Tensor
    listed: Pairs
    lagged: Pairs
    lag: Tensor
    floor_lag: Tensor
    center: Tensor
    room: Tensor
    surface: ContactSurface
    model: Any
    data: Tensor
    time_step: float
    friction_eps: float


def _cross_matrix(r: Tensor) -> Tensor:
    """[..., 3] -> [..., 3, 3]: the matrix of w -> w x r, which is -[r]x."""
    zero = torch.zeros_like(r[..., 0])
    x, y, z = r.unbind(-1)
    return torch.stack([zero, z, -y, -z, zero, x, y, -x, zero], -1).unflatten(-1, (3, 3))


def _friction_rate(length: Tensor, eps: float) -> Tensor:
    sticks = length < eps
    return torch.where(sticks, (2 - length / eps) / eps, 1 / torch.where(sticks, torch.ones_like(length), length))


def _length(u: Tensor, eps: float) -> Tensor:
    square = (u * u).sum(-1)
    moves = square > (1e-6 * eps) ** 2
    return torch.where(moves, torch.where(moves, square, torch.ones_like(square)).sqrt(), square.detach().sqrt())


def _rotation(w: Tensor) -> Tensor:
    """exp([w]x) of w [..., 3]."""
    square = (w * w).sum(-1)[..., None, None]
    small = square < 1e-8
    safe = torch.where(small, torch.ones_like(square), square)
    angle = safe.sqrt()
    a = torch.where(small, 1 - square / 6, torch.sin(angle) / angle)
    b = torch.where(small, 0.5 - square / 24, (1 - torch.cos(angle)) / safe)
    k = -_cross_matrix(w)
    return torch.eye(3, dtype=w.dtype, device=w.device) + a * k + b * (k @ k)


class _Bodies:
    """Sums over bodies, and which of them move."""

    def __init__(self, s: Scene, x: Tensor) -> None:
        self.count, vertices = s.surface.bodies, x.shape[1]
        self.body = s.surface.body[:vertices].long()
        self.mass = broadcast(s.mass, x.shape[:2])
        pinned = s.model._pinned
        held = x.new_zeros(self.count).index_add(0, self.body, pinned.to(x.dtype)) > 0
        self.total = self.sum(self.mass[..., None])[..., 0]
        self.free = ~held & (self.total > 0)  # [B, bodies]
        whole = self.total.clamp(min=torch.finfo(x.dtype).tiny)[..., None]
        self.center = self.sum(self.mass[..., None] * x) / whole
        self.arm = x - self.center[:, self.body]

    def sum(self, values: Tensor) -> Tensor:
        """[B, V, ...] -> [B, bodies, ...]"""
        return values.new_zeros((values.shape[0], self.count, *values.shape[2:])).index_add(1, self.body, values)


def newton_step(s: Scene, x: Tensor) -> tuple[Tensor, _Bodies]:
    """Turn and shift of each body [B, bodies, 6]."""
    b = _Bodies(s, x)
    h, h2, model = s.time_step, s.time_step**2, s.model
    scenes, nb = x.shape[0], b.count
    eye = torch.eye(3, dtype=x.dtype, device=x.device)
    force = b.mass[..., None] * (x - s.y)
    stiff = b.mass[..., None, None] * eye
    origin = None if s.origin.numel() == 0 else s.origin
    start = 0
    for energy in model.vertex_energies:
        size = energy.count() * (model.num_vertices if energy.per_vertex else 1)
        data = s.data[:, start : start + size]
        start += size
        force = force + energy.gradient(x, s.x_prev, data, h, origin)
        if energy is model.floor:
            normal, kappa, dhat, damping = energy._columns(data)
            gap, before = (energy._gaps(at, data, origin) for at in (x, s.x_prev))
            near = (gap > 0) & (gap < dhat)
            d = torch.where(near, gap, dhat)
            second = -kappa * (2 * torch.log(d / dhat) + 4 * (d - dhat) / d - ((d - dhat) / d) ** 2)
            size = h2 * torch.where(near, second, torch.zeros_like(d)) + h * torch.where(before < dhat, damping, 0.0)
            stiff = stiff + ((size[..., None] * normal)[..., None] * normal[..., None, :]).sum(2)
        elif energy.per_vertex:
            spring = data.reshape(data.shape[0], -1, 4)[..., 0]
            stiff = stiff + h2 * spring[..., None, None] * eye
    if s.floor_lag.numel():
        size, n = s.floor_lag[..., 0], s.floor_lag[..., 1:]
        travel = (x - s.x_prev)[:, :, None]
        u = travel - n * (n * travel).sum(-1, keepdim=True)
        rate = h2 * size * _friction_rate(_length(u, s.friction_eps), s.friction_eps)
        force = force + (rate[..., None] * u).sum(2)
        stiff = stiff + (rate[..., None, None] * (eye - n[..., None] * n[..., None, :])).sum(2)
    jac = torch.cat([_cross_matrix(b.arm), eye.expand(*x.shape[:2], 3, 3)], -1)  # [B, V, 3, 6]
    g = b.sum((jac.transpose(-1, -2) @ force[..., None])[..., 0])
    diagonal = b.sum(jac.transpose(-1, -2) @ stiff @ jac)  # [B, nb, 6, 6]
    coupled = nb <= MOST_COUPLED
    cells = x.new_zeros((scenes * nb * (nb if coupled else 1), 6, 6))
    points = torch.cat([x, s.collider], 1)
    arms = torch.cat([b.arm, torch.zeros_like(s.collider)], 1)
    label = s.surface.body.long()
    moves = torch.cat([b.free, b.free.new_zeros((scenes, label.max() + 1 - nb if label.numel() else 0))], 1)

    def sides(listed: Pairs, w: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Rows of used pairs, scenes, bodies of both sides [n, 2] (-1: does not move), maps [n, 2, 3, 6]."""
        scene, corners = listed.pairs[:, 5].long(), listed.pairs[:, :4].long()
        first = torch.where(listed.pairs[:, 4] == 1, 2, 1)[:, None] > torch.arange(4, device=x.device)
        arm = arms[scene[:, None], corners]
        one = torch.cat([_cross_matrix(arm), eye.expand(*arm.shape[:2], 3, 3)], -1)  # [n, 4, 3, 6]
        maps = w[..., None, None] * one
        both = torch.stack([torch.where(side[..., None, None], maps, 0.0).sum(1) for side in (first, ~first)], 1)
        second = torch.where(listed.pairs[:, 4] == 1, 2, 1)[:, None]
        body = torch.stack([label[corners[:, 0]], label[corners.gather(1, second.long())[:, 0]]], 1)
        there = moves[scene[:, None], body.clamp(max=moves.shape[1] - 1)]
        there = there & (body[:, :1] != body[:, 1:])
        return scene, torch.where(there, body, -1), both, there

    def add(g: Tensor, diagonal: Tensor, cells: Tensor, listed: Pairs, w: Tensor, q: Tensor, S: Tensor):
        scene, body, maps, there = sides(listed, w)
        maps = torch.where(there[..., None, None], maps, 0.0)
        row = scene[:, None] * nb + body.clamp(min=0)
        pull = (maps.transpose(-1, -2) @ q[:, None, :, None])[..., 0]
        g = g.reshape(-1, 6).index_add(0, row.reshape(-1), pull.reshape(-1, 6)).reshape(g.shape)
        pressed = S[:, None] @ maps  # [n, 2, 3, 6]
        for i in range(2):
            own = maps[:, i].transpose(-1, -2)
            if coupled:
                for j in range(2):
                    at = (scene * nb + body[:, i].clamp(min=0)) * nb + body[:, j].clamp(min=0)
                    cells = cells.index_add(0, at, own @ pressed[:, j])
            else:
                twice = torch.where(there.all(1), 2.0, 1.0)[:, None, None]
                cells = cells.index_add(0, row[:, i], twice * (own @ pressed[:, i]))
        return g, diagonal, cells

    if s.listed.pairs.shape[0]:
        state = pair_lag(x, s.collider, s.kappa, s.origin, s.listed)
        load, active, n, w = state.split((1, 1, 3, 4), -1)
        corners, scene = s.listed.pairs[:, :4].long(), s.listed.pairs[:, 5].long()
        at = points[scene[:, None], corners]
        at = at - at[:, :1].detach()
        if origin is not None:
            lifted = torch.cat([s.origin, torch.zeros_like(s.collider)], 1)[scene[:, None], corners]
            at = at + (lifted - lifted[:, :1])
        gap = (w * (at * n[:, None]).sum(-1)).sum(-1) - s.listed.constants[:, 1]
        dhat = s.listed.constants[:, 0]
        near = active[:, 0] > 0
        d = torch.where(near, gap, 0.5 * dhat)
        past, log = d - dhat, torch.log(d / dhat)
        ratio = (2 * log + 4 * past / d - (past / d) ** 2) / (2 * past * log + past**2 / d)
        curvature = torch.where(near, -load[:, 0] * ratio, torch.zeros_like(gap))
        q = -h2 * load * n
        g, diagonal, cells = add(
            g, diagonal, cells, s.listed, w, q, h2 * curvature[:, None, None] * n[..., None] * n[..., None, :]
        )
    if s.lag.numel():
        size, rate, n, w = s.lag.split((1, 1, 3, 4), -1)
        corners, scene = s.lagged.pairs[:, :4].long(), s.lagged.pairs[:, 5].long()
        moved = points[scene[:, None], corners] - torch.cat([s.x_prev, s.collider_prev], 1)[scene[:, None], corners]
        m = (w[..., None] * moved).sum(1)
        along = (n * m).sum(-1, keepdim=True)
        u = m - along * n
        slip = h2 * size * _friction_rate(_length(u, s.friction_eps), s.friction_eps)[:, None]
        q = slip * u + h * rate * along.clamp(max=0) * n
        outer = n[..., None] * n[..., None, :]
        g, diagonal, cells = add(
            g, diagonal, cells, s.lagged, w, q, slip[..., None] * (eye - outer) + (h * rate)[..., None] * outer
        )
    six = torch.eye(6, dtype=x.dtype, device=x.device)
    scale = torch.where(b.free, b.total, torch.ones_like(b.total))
    if coupled:
        matrix = cells.reshape(scenes, nb, nb, 6, 6)
        matrix = matrix + torch.diag_embed(diagonal.permute(0, 2, 3, 1), dim1=1, dim2=2)
        keep = b.free[:, :, None] & b.free[:, None]
        matrix = torch.where(keep[..., None, None], matrix, 0.0)
        fill = torch.where(b.free, 1e-12 * b.total, torch.ones_like(b.total))
        matrix = matrix + torch.diag_embed((fill[:, :, None, None] * six).permute(0, 2, 3, 1), dim1=1, dim2=2)
        matrix = matrix.permute(0, 1, 3, 2, 4).reshape(scenes, 6 * nb, 6 * nb)
        right = torch.where(b.free[..., None], -g, torch.zeros_like(g)).reshape(scenes, 6 * nb, 1)
        z = torch.cholesky_solve(right, torch.linalg.cholesky_ex(matrix)[0]).reshape(scenes, nb, 6)
    else:
        matrix = torch.where(b.free[..., None, None], diagonal + cells.reshape(scenes, nb, 6, 6), six)
        matrix = matrix + (1e-12 * scale)[..., None, None] * six
        right = torch.where(b.free[..., None], -g, torch.zeros_like(g))[..., None]
        z = torch.cholesky_solve(right, torch.linalg.cholesky_ex(matrix)[0])[..., 0]
    return z, b


def potential(s: Scene, x: Tensor) -> Tensor:
    """Of the step at x, without tets, [B] [kg m^2]; not to be differentiated."""
    h, h2, model = s.time_step, s.time_step**2, s.model
    mass = broadcast(s.mass, x.shape[:2])
    total = (0.5 * mass * (x - s.y).square().sum(-1) * (~model._pinned)).sum(1)
    origin = None if s.origin.numel() == 0 else s.origin
    start = 0
    for energy in model.vertex_energies:
        size = energy.count() * (model.num_vertices if energy.per_vertex else 1)
        total = total + energy.value(x, s.x_prev, s.data[:, start : start + size], h, origin).sum(1)
        start += size

    def slip(u: Tensor) -> Tensor:
        length, eps = _length(u, s.friction_eps), s.friction_eps
        slow = length < eps
        return torch.where(slow, length**2 / eps - length**3 / (3 * eps**2) + eps / 3, length)

    if s.floor_lag.numel():
        size, n = s.floor_lag[..., 0], s.floor_lag[..., 1:]
        travel = (x - s.x_prev)[:, :, None]
        total = total + h2 * (size * slip(travel - n * (n * travel).sum(-1, keepdim=True))).sum((1, 2))
    points = torch.cat([x, s.collider], 1)
    if s.listed.pairs.shape[0]:
        state = pair_lag(x, s.collider, s.kappa, s.origin, s.listed)
        load, active, n, w = state.split((1, 1, 3, 4), -1)
        corners, scene = s.listed.pairs[:, :4].long(), s.listed.pairs[:, 5].clamp(min=0).long()
        at = points[scene[:, None], corners]
        at = at - at[:, :1].detach()
        if origin is not None:
            lifted = torch.cat([s.origin, torch.zeros_like(s.collider)], 1)[scene[:, None], corners]
            at = at + (lifted - lifted[:, :1])
        gap = (w * (at * n[:, None]).sum(-1)).sum(-1) - s.listed.constants[:, 1]
        dhat = s.listed.constants[:, 0]
        near = active[:, 0] > 0
        d = torch.where(near, gap, 0.5 * dhat)
        past, log = d - dhat, torch.log(d / dhat)
        value = torch.where(near, load[:, 0] * past**2 * log / (2 * past * log + past**2 / d) * -1, torch.zeros_like(d))
        total = total.index_add(0, scene, -h2 * value * -1)
    if s.lag.numel():
        size, rate, n, w = s.lag.split((1, 1, 3, 4), -1)
        corners, scene = s.lagged.pairs[:, :4].long(), s.lagged.pairs[:, 5].clamp(min=0).long()
        moved = points[scene[:, None], corners] - torch.cat([s.x_prev, s.collider_prev], 1)[scene[:, None], corners]
        m = (w[..., None] * moved).sum(1)
        along = (n * m).sum(-1, keepdim=True)
        damped = (0.5 * h * rate * along.clamp(max=0) ** 2)[:, 0]
        total = total.index_add(0, scene, h2 * size[:, 0] * slip(m - along * n) + damped)
    return total


def _displaced(b: _Bodies, z: Tensor) -> Tensor:
    turn = _rotation(z[..., :3]) - torch.eye(3, dtype=z.dtype, device=z.device)
    return (turn[:, b.body] @ b.arm[..., None])[..., 0] + z[:, b.body, 3:]


def _share(s: Scene, x: Tensor, z: Tensor, b: _Bodies) -> Tensor:
    """What of its motion each body may take [B, bodies]: 1, 1/2, 1/4, ... or 0."""
    with torch.no_grad():
        x = x.detach()
        share = torch.ones_like(b.total)
        none = x.new_zeros((x.shape[0], b.count, 3))
        listed = (s.listed.pairs, s.listed.constants, s.listed.ptr, s.listed.entry)
        still = s.collider.detach()
        floor = s.model.floor
        for attempt in range(TRIES):
            move = _displaced(b, share[..., None] * z.detach())
            got, _ = ops_contact_start.advance(
                x,
                move.contiguous(),
                none,
                s.center,
                s.origin,
                still,
                still,
                s.surface.held,
                s.surface.body,
                s.room,
                listed,
                False,
            )
            if floor is not None:
                data = s.data[:, : floor.count()].detach()
                origin = None if s.origin.numel() == 0 else s.origin
                keeps = floor.admits(x + move, x, data, origin, LEAST_GAP)
                got = torch.where(keeps, got, 0.5 * torch.ones_like(got))
            least = torch.ones_like(share).index_reduce_(1, b.body, got, "amin")
            low = torch.exp2(torch.floor(torch.log2(least.clamp(min=2.0**-8))))
            if attempt + 1 == TRIES or bool((low == 1).all()):
                break
            share = share * low
        return torch.where(low == 1, share, torch.zeros_like(share)) if bool((low < 1).any()) else share


def correct(s: Scene, x: Tensor) -> Tensor:
    z, b = newton_step(s, x)
    b = b
    share = _share(s, x, z, b)
    return x + _displaced(b, share[..., None] * z)
