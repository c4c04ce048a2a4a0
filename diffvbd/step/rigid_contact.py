"""The rigid correction of bodies that touch: all bodies of a scene moved, each as a whole, by one Newton step of the
step's potential over their rigid motions.

    min over (w_b, t_b)   1/2 sum m |x - y|^2 + energies of single vertices + barriers, friction and damping of pairs

A rigid motion leaves the energy of the tets as it is, so that this costs sums over vertices and pairs, and six unknowns
a body. It is what few sweeps do worst: they see neighbours, not the body. docs/method.md, section 18.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ..adjoint.contact_lag import Pairs, pair_lag
from ..adjoint.sums import sum_by
from ..ops import broadcast
from ..ops import contact_start as ops_start
from .rigid_terms import (
    Scenes,
    active_pairs,
    corners_of,
    pair_terms,
    potential,
    vertex_blocks,
    vertex_energies,
    vertex_gradient,
)

MOST_COUPLED = 64  # bodies of a scene that are solved for together; with more of them, one side of a pair at a time
TRIES = 5  # of motions, each half as long for some bodies, or none for them
LEAST_GAP = 0.1  # of its gap that a vertex keeps above a plane of the floor
SPREADS = 4  # how often a shorter motion is handed on to the bodies that one touches
RISE = 1e-9  # of the potential, that counts as none
LEAST_STIFFNESS = 1e-12  # of its mass, that keeps the system of a body definite


def correct(s: Scenes, x: Tensor) -> tuple[Tensor, Tensor]:
    """x [B, V, 3] after every free body has been moved, as far as pairs, floors and the potential let it; and the share
    of its motion that each took [B, bodies]."""
    bodies = _Bodies(s, x)
    motion = _newton_step(s._replace(listed=active_pairs(s, x)), bodies, x)
    share = _share(s, bodies, x, motion)
    return x + bodies.displaced(share[..., None] * motion), share


class _Bodies:
    """The bodies of all scenes, which of them move, and where their vertices are from their centers of mass."""

    def __init__(self, s: Scenes, x: Tensor) -> None:
        self.body = s.model.body
        self.count = s.model.mesh.num_bodies
        self.scenes = x.shape[0]
        rows = self.body + self.count * torch.arange(self.scenes, device=x.device)[:, None]
        self.rows = rows.reshape(-1)  # of the body of each vertex
        mass = broadcast(s.mass, x.shape[:2])
        self.mass = self.sum(mass[..., None])[..., 0]
        held = self.sum(broadcast(s.model._pinned.to(x.dtype)[None, :, None], (*x.shape[:2], 1)))[..., 0]
        self.free = (held == 0) & (self.mass > 0)
        whole = self.mass.clamp(min=torch.finfo(x.dtype).tiny)[..., None]
        self.arm = x - (self.sum(mass[..., None] * x) / whole)[:, self.body]

    def sum(self, values: Tensor) -> Tensor:
        """[B, V, ...] -> [B, bodies, ...]"""
        return sum_by(values.flatten(0, 1), self.rows, self.scenes * self.count).unflatten(0, (self.scenes, self.count))

    def least(self, values: Tensor) -> Tensor:
        """[B, V] -> [B, bodies]"""
        out = torch.ones_like(self.mass).reshape(-1)
        return out.scatter_reduce(0, self.rows, values.reshape(-1), "amin").reshape(self.mass.shape)

    def stiffness(self, s: Scenes, blocks: Tensor | None) -> Tensor:
        """Of inertia and of blocks [B, V, 3, 3] against turns and shifts of each body [B, bodies, 6, 6]."""
        mass = broadcast(s.mass, self.arm.shape[:2])
        spread = self.sum((mass[..., None] * self.arm)[..., None] * self.arm[..., None, :])
        eye = torch.eye(3, dtype=spread.dtype, device=spread.device)
        inertia = spread.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None] * eye - spread
        zero = torch.zeros_like(inertia)
        upper, lower = torch.cat([inertia, zero], -1), torch.cat([zero, self.mass[..., None, None] * eye], -1)
        out = torch.cat([upper, lower], -2)
        if blocks is None:
            return out
        flat, arm, rows = blocks.flatten(0, 1), self.arm.flatten(0, 1), self.rows
        if not arm.is_cuda and not torch.compiler.is_compiling():  # few vertices are near a floor
            used = (flat != 0).any(-1).any(-1).nonzero()[:, 0]
            flat, arm, rows = flat[used], arm[used], rows[used]
        maps = _turning(arm)
        return out + sum_by(maps.mT @ flat @ maps, rows, self.scenes * self.count).reshape(out.shape)

    def displaced(self, motion: Tensor) -> Tensor:
        """What a turn and a shift of each body [B, bodies, 6] do to its vertices, exactly, [B, V, 3]."""
        w, shift = motion.split(3, -1)
        square = (w * w).sum(-1, keepdim=True)
        small = square < 1e-8
        safe = torch.where(small, torch.ones_like(square), square)
        angle = safe.sqrt()
        first = torch.where(small, 1 - square / 6, torch.sin(angle) / angle)
        second = torch.where(small, 0.5 - square / 24, (1 - torch.cos(angle)) / safe)
        w, first, second, shift = (t[:, self.body] for t in (w, first, second, shift))
        turned = torch.linalg.cross(w, self.arm)
        return first * turned + second * torch.linalg.cross(w, turned) + shift


def _turning(r: Tensor) -> Tensor:
    """[..., 3] -> [..., 3, 6]: how a point at r from the center moves with a turn and a shift."""
    zero, eye = torch.zeros_like(r[..., 0]), torch.eye(3, dtype=r.dtype, device=r.device)
    x, y, z = r.unbind(-1)
    turn = torch.stack([zero, z, -y, -z, zero, x, y, -x, zero], -1).unflatten(-1, (3, 3))
    return torch.cat([turn, eye.expand(turn.shape)], -1)


def _sides(s: Scenes, bodies: _Bodies, listed: Pairs, within: bool) -> tuple[Tensor, Tensor]:
    """Rows of the bodies of both sides of pairs [n, 2], -1 where one does not move or, unless ``within``, both are one;
    and how corners move with the body of each side [n, 2, 4, 3, 6], zero where they are of the other."""
    surface = s.surface
    assert surface is not None
    scene, corners = corners_of(listed)
    kind = listed.pairs[:, 4:5]
    sides = torch.where(kind == 1, 2, 1)
    first = sides > torch.arange(4, device=kind.device)
    lead = torch.cat([corners[:, :1], corners.gather(1, sides)], 1)
    body = surface.body.long()[lead]
    mesh = body < bodies.count
    rows = scene * bodies.count + body.clamp(max=bodies.count - 1)
    there = mesh & bodies.free.reshape(-1)[rows] & (kind >= 0)
    if not within:
        there = there & (body[:, :1] != body[:, 1:])
    arms = bodies.arm[scene, corners.clamp(max=bodies.arm.shape[1] - 1)]
    of_side = torch.stack([first, ~first], 1) & there[..., None]
    return torch.where(there, rows, -1), torch.where(of_side[..., None, None], _turning(arms)[:, None], 0.0)


def _newton_step(s: Scenes, bodies: _Bodies, x: Tensor) -> Tensor:
    """Turn and shift of each body [B, bodies, 6]."""
    n, rows = bodies.count, bodies.scenes * bodies.count
    together = n <= MOST_COUPLED
    force = vertex_gradient(s, x)
    g = bodies.sum(torch.cat([torch.linalg.cross(bodies.arm, force), force], -1)).reshape(rows, 6)
    own, across = bodies.stiffness(s, vertex_blocks(s, x)).reshape(rows, 6, 6), []
    for terms in pair_terms(s, x):
        row, corners = _sides(s, bodies, terms.listed, terms.within)
        maps = (terms.weights[:, None, :, None, None] * corners).sum(2)
        at = row.clamp(min=0)
        pulled = (maps.mT @ terms.force[:, None, :, None])[..., 0]
        if terms.at_corners is not None:
            pulled = pulled + (corners.mT @ terms.at_corners[:, None, ..., None])[..., 0].sum(2)
        g = g + sum_by(pulled.flatten(0, 1), at.flatten(), rows)
        pressed = terms.stiffness[:, None] @ maps
        # where sides are not solved for together, each bears what both would: then no step is too long
        twice = 1.0 if together else torch.where((row >= 0).all(1), 2.0, 1.0)[:, None, None, None]
        own = own + sum_by((maps.mT @ (twice * pressed)).flatten(0, 1), at.flatten(), rows)
        if together:
            cell = at[:, 0] * n + at[:, 1] % n
            across.append(sum_by(maps[:, 0].mT @ pressed[:, 1], cell, rows * n))
    free = bodies.free.reshape(-1)
    six = torch.eye(6, dtype=x.dtype, device=x.device)
    fill = torch.where(free, LEAST_STIFFNESS * bodies.mass.reshape(-1), 1.0)
    own = torch.where(free[:, None, None], own, 0.0) + fill[:, None, None] * six
    g = torch.where(free[:, None], -g, 0.0)
    if not together or not across:
        return _solved(own, g[..., None]).reshape(bodies.scenes, n, 6)
    between = sum(across[1:], across[0]).reshape(bodies.scenes, n, n, 6, 6)
    matrix = between + between.permute(0, 2, 1, 4, 3)
    matrix = matrix + torch.diag_embed(own.reshape(bodies.scenes, n, 6, 6).permute(0, 2, 3, 1), dim1=1, dim2=2)
    matrix = matrix.permute(0, 1, 3, 2, 4).reshape(bodies.scenes, 6 * n, 6 * n)
    return _solved(matrix, g.reshape(bodies.scenes, 6 * n, 1)).reshape(bodies.scenes, n, 6)


def _solved(matrix: Tensor, right: Tensor) -> Tensor:
    factor = torch.linalg.cholesky_ex(matrix)[0]  # torch.cholesky_solve cannot be captured in a CUDA graph
    half = torch.linalg.solve_triangular(factor, right, upper=False)
    return torch.linalg.solve_triangular(factor.mT, half, upper=True)[..., 0]


@torch.no_grad()
def _share(s: Scenes, bodies: _Bodies, x: Tensor, motion: Tensor) -> Tensor:
    """What of its motion each body takes [B, bodies]: 1, 1/2, 1/4, ... or 0, so that nothing crosses and no scene's
    potential rises. It is decided, not differentiated."""
    x, motion = x.detach(), motion.detach()
    share, taken = torch.ones_like(bodies.mass), torch.zeros_like(bodies.mass)
    motion = torch.where(torch.isfinite(motion).all(-1, keepdim=True), motion, 0.0)
    before = potential(s, x)
    touching = _touching(s, bodies, x)
    for attempt in range(TRIES):
        move = bodies.displaced(share[..., None] * motion)
        fits = bodies.least(_fits(s, x, move)) >= 1
        safe = fits.all(1) & (potential(s, x + move) <= before + RISE * before.abs())
        taken = torch.where(safe[:, None] & (taken == 0), share, taken)
        if not x.is_cuda and not torch.compiler.is_compiling() and bool((safe | (taken > 0).all(1)).all()):
            break
        # what is blocked moves half as far, and then not at all; what raises the potential, all half as far
        held = torch.where(fits, 1.0, 0.5 if attempt == 0 else 0.0)
        low = torch.where(fits.all(1, keepdim=True) & ~safe[:, None], 0.5, held)
        for _ in range(SPREADS):
            for row in touching:
                pair = low.reshape(-1)[row].amin(1)
                flat = low.reshape(-1)
                for side in range(2):
                    flat = flat.scatter_reduce(0, row[:, side], pair, "amin")
                low = flat.reshape(low.shape)
        share = share * low
    return taken


def _touching(s: Scenes, bodies: _Bodies, x: Tensor) -> list[Tensor]:
    """Rows of bodies between which a pair acts [n, 2]; where none does, of one body twice."""
    s = s._replace(listed=active_pairs(s, x))
    if not s.listed.pairs.shape[0]:
        return []
    state = pair_lag(x, s.collider, s.kappa, s.origin, s.listed)
    row, _ = _sides(s, bodies, s.listed, within=False)
    acts = (state[:, 1] > 0) & (row >= 0).all(1)
    return [torch.where(acts[:, None], row, 0)]


def _fits(s: Scenes, x: Tensor, move: Tensor) -> Tensor:
    """1 where a vertex may move so [B, V], less elsewhere."""
    out = torch.ones_like(x[..., 0])
    if s.surface is not None:
        none = x.new_zeros((x.shape[0], s.surface.bodies, 3))
        listed = (s.listed.pairs, s.listed.constants, s.listed.ptr, s.listed.entry)
        collider = s.collider.detach()
        out, *_ = ops_start.advance(x.contiguous(), move.contiguous(), none, s.center, s.origin, collider, collider,
                                   s.surface.held, s.surface.body, s.room, listed, careful=False)  # fmt: skip
    for energy, (data, _, origin) in vertex_energies(s):
        keeps = energy.admits(x + move, x, data.detach(), origin, LEAST_GAP)
        if keeps is not None:
            out = torch.where(keeps | s.model._pinned, out, torch.zeros_like(out))
    return out
