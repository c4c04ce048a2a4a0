"""Where the sweeps of a step with contact start: islands, bodies as wholes, what supports bear."""

from typing import Any

import torch
from torch import Tensor

from .distance import log_barrier
from .energies import FloorBarrier
from .layout import dot
from .rigid import turned
from .scene import Scene


def corner_points(x: Tensor, colliders: Tensor) -> Tensor:
    """Positions [B, N, 3] of all corner points from a state [..., 3, V] and colliders [B, Vc, 3]."""
    return torch.cat((x.transpose(-1, -2).reshape(len(colliders), -1, 3), colliders), 1)


class Translation:
    """Of the island of each vertex [..., 3, V]: the mean of where its vertices want to go, above the floor."""

    def __init__(self, scene: Scene, part: Any, x: Tensor, wanted: Tensor, floor: FloorBarrier | None) -> None:
        rows = wanted.transpose(-1, -2).reshape(len(part.island), x.shape[-1], 3)
        u = self._mean(scene, part, rows).transpose(-1, -2).reshape(x.shape)
        if floor is not None and part.lowest is not None:
            u = self._above(floor, u, x, part.lowest[:, scene.model.body].reshape(*x.shape[:-2], x.shape[-1], -1))
        self.u = u

    @staticmethod
    def _mean(scene: Scene, part: Any, wanted: Tensor) -> Tensor:
        """u [B, V, 3]: mean of `wanted` [B, V, 3], weighted by mass, over the vertices of a vertex's island."""
        model = scene.model
        label = part.island[:, model.body]
        moves = label >= 0
        label = label.clamp(min=0)
        mass = scene.mass.expand(scene.like.shape[:-1]).reshape(label.shape)
        mass = torch.where(model.pinned, 0.0, mass)
        columns = torch.cat((mass[..., None] * wanted, mass[..., None]), -1)
        index = label[..., None].expand_as(columns)
        sums = columns.new_zeros(len(label), part.island.shape[1], 4).scatter_add(1, index, columns).gather(1, index)
        total = torch.where(moves, sums[..., 3], 1.0)
        return torch.where(moves[..., None], sums[..., :3] / total[..., None], 0.0)

    @staticmethod
    def _above(floor: FloorBarrier, u: Tensor, x: Tensor, lowest: Tensor) -> Tensor:
        """u [..., 3, V], down at most until the lowest vertex [..., V, planes] comes within dhat of a plane."""
        lead, count = x.shape[:-2], x.shape[-1]
        gap = floor.gap(x)  # [..., planes, V]
        room = (gap.gather(-1, lowest.transpose(-1, -2)) - floor.dhat).clamp(min=0)
        normal = floor.normal.expand(*lead, *floor.normal.shape[-3:]).expand(*lead, -1, 3, count)
        slack = 8 * torch.finfo(x.dtype).eps * dot(u, u).detach().sqrt().unsqueeze(-2)
        for plane in range(room.shape[-2]):
            n = normal[..., plane, :, :]
            u = u + (-dot(n, u) - room[..., plane, :]).clamp(min=0).unsqueeze(-2) * n
        down = -dot(normal, u.unsqueeze(-3))
        safe = (down <= room * (1 + 1e-6) + slack).all(-2)
        return torch.where(safe.unsqueeze(-2), u, 0.0)


def unsupported(scene: Scene, pairs: Any, floor: FloorBarrier | None, x: Tensor, colliders: Tensor, lift: Tensor
                ) -> Tensor:  # fmt: skip
    """What barriers at the start of the step leave of the ways [..., 3, V] that bodies want to fall."""
    model, scenes, count = scene.model, len(colliders), int(scene.model.body.max()) + 1
    points = corner_points(x, colliders)
    gap, slope, e, _ = pairs.measures(points, torch.arange(len(pairs.kind), device=x.device))
    kappa = pairs.per_pair(scene.parameter(model.contact, "kappa"))
    _, first, _ = log_barrier(gap, kappa, pairs.dhat)
    push = -(e * first)[:, None, None] * slope
    force = torch.zeros_like(points).index_put((pairs.batch[:, None], pairs.corners), push, accumulate=True)
    force = force[:, : x.shape[-1]]
    if floor is not None:
        _, slope, _ = log_barrier(floor.gap(x), floor.kappa, floor.dhat)
        lifted = -(slope.unsqueeze(-2) * floor.normal).sum(-3)
        force = force + lifted.transpose(-1, -2).reshape(force.shape)
    mass = scene.mass.expand(*x.shape[:-2], x.shape[-1]).reshape(scenes, -1, 1)
    way = lift.transpose(-1, -2).reshape(force.shape)
    free = ~model.pinned
    columns = torch.where(free[:, None], torch.cat([mass * way, scene.time_step**2 * force, mass], -1), 0.0)
    sums = columns.new_zeros(scenes, count, 7).index_add(1, model.body, columns)
    own, borne = (sums[..., i : i + 3] / sums[..., 6:].clamp(min=1e-300) for i in (0, 3))
    square = (borne**2).sum(-1, keepdim=True)
    share = (-(own * borne).sum(-1, keepdim=True) / square.clamp(min=1e-300)).clamp(0, 1)
    pinned = torch.zeros(count, device=x.device).index_add(0, model.body, model.pinned.float()) > 0
    taken = torch.where(pinned[:, None], 0.0, share * borne)[:, model.body]
    way = torch.where(free[:, None], way + taken, way)
    return way.transpose(-1, -2).reshape(x.shape)


def rigid_way(scene: Scene, x: Tensor, move: Tensor) -> Tensor:
    """The shift and the linearised turn of each body that have the momenta of the ways [..., 3, V]."""
    model, way, at = scene.model, move.transpose(-1, -2), x.transpose(-1, -2)
    mass = scene.mass.expand(at.shape[:-1])[..., None]
    eye, out = torch.eye(3).to(x), torch.zeros_like(at)
    for body in range(int(model.body.max()) + 1):
        own = model.body == body
        if bool(model.pinned[own].any()):
            continue
        m, d, p = mass[..., own, :], way[..., own, :], at[..., own, :]
        whole = m.sum(-2, keepdim=True)
        arm, shift = p - (m * p).sum(-2, keepdim=True) / whole, (m * d).sum(-2, keepdim=True) / whole
        spread = (m[..., None] * arm[..., None] * arm[..., None, :]).sum(-3)
        size = spread.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]
        momentum = (m * torch.linalg.cross(arm, d)).sum(-2)
        turn = torch.linalg.solve((1 + 1e-9) * size * eye - spread, momentum)
        out = out.index_add(-2, own.nonzero()[:, 0], shift + torch.linalg.cross(turn[..., None, :].expand_as(arm), arm))
    return out.transpose(-1, -2)


def coasted(scene: Scene, x: Tensor, way: Tensor, free: Tensor, chord: float) -> Tensor:
    """The ways [..., 3, V] of free bodies without what stretches them. free: bool [V]."""
    model = scene.model
    mass = scene.mass.expand(x[..., 0, :].shape).unsqueeze(-2)
    for number in model.body[free].unique().tolist():
        own = (model.body == number).nonzero()[:, 0]
        mine = turned(mass[..., own], x[..., own], way[..., own], chord)
        way = way.index_copy(-1, own, mine)
    return way


SHORT = 0.99  # share of a way that counts as all of it
KEPT, DEEP, KEPT_DEEP = 0.9, 0.1, 0.1  # of a gap; of dhat, and of a gap below that


def above_floor(floor: FloorBarrier, model: Any, x: Tensor, way: Tensor) -> tuple[Tensor, Tensor]:
    """What the floor leaves of the ways [..., 3, V] of bodies as wholes, and which vertices are of bodies that it stops
    [..., V]."""
    lead, out, stopped = x.shape[:-2], way, torch.zeros_like(x[..., 0, :], dtype=torch.bool)
    deep, gap = DEEP * floor.dhat, floor.gap(x)  # [..., planes, V]
    room = KEPT * (gap - deep).clamp(min=0) + KEPT_DEEP * torch.minimum(gap, deep)
    normal = floor.normal.expand(*lead, *floor.normal.shape[-3:])  # [..., planes, 3, 1]
    toward = -(normal * way.unsqueeze(-3)).sum(-2)
    for number in range(int(model.body.max()) + 1):
        own = (model.body == number) & ~model.pinned
        if not bool(own.any()):
            continue
        off, left = toward[..., own] - room[..., own], room[..., own] / toward[..., own].clamp(min=1e-300)
        shift = (off.amax(-1).clamp(min=0)[..., None, None] * normal).sum(-3)  # [..., 3, 1]
        share = torch.where(off > 0, left, 1.0).amin((-2, -1))
        past = off - (normal * shift.unsqueeze(-3)).sum(-2)
        rounding = 1e-12 * (toward[..., own].abs() + shift.abs().sum(-2).unsqueeze(-2))
        good = (past <= rounding).all(-1).all(-1)[..., None, None]
        mine = torch.where(good, way + shift, share[..., None, None] * way)
        out = torch.where(model.body == number, mine, out)
        stopped = stopped | ((model.body == number) & (share < SHORT)[..., None])
    return out, stopped
