"""The rigid correction of bodies that touch, in plain torch; the twin of csrc/subspace/rigid_step.h."""

from typing import Any

import torch
from torch import Tensor

from .distance import EDGE_EDGE
from .energies import FloorFriction, StableNeoHookean
from .scene import Scene

LEAST_INERTIA = 1e-11  # of its sum of m r^2, that keeps the turn of a body definite


class Correction:
    """The rigid correction of bodies that touch: one Newton step of the potential over a turn and a shift of every body
    without pinned vertices, all of a scene together. Of inertia and vertex energies the gradient is autograd's and the
    blocks are those of vertex updates."""

    def __init__(self, scene: Scene, energies: list[Any], forces: list[Any], y: Tensor, x_prev: Tensor) -> None:
        """forces: terms of pairs, each with its `on_corners`."""
        model, self.scene, self.y, self.x_prev = scene.model, scene, y, x_prev
        self.single = [e for e in energies if not isinstance(e, (StableNeoHookean, FloorFriction))]
        self.floors = [e for e in energies if isinstance(e, FloorFriction)]
        self.forces = forces
        self.body, self.count = model.body, int(model.body.max()) + 1
        pinned = torch.zeros(self.count).index_add(0, self.body.cpu(), model.pinned.cpu().float()) > 0
        self.free = ~pinned.to(y.device)

    def __call__(self, x: Tensor, taken: Tensor, majorizes: bool = False) -> Tensor:
        """The state [..., 3, V] after each body has moved. taken: [B, bodies, 2], its fraction of its motion, and a
        number of the island whose common shift it takes whole, or -1. majorizes: Whether friction has the stiffness of
        a vertex's block."""
        fraction, group = taken.to(x).unbind(-1)
        lead, rows = x.shape[:-2], x.transpose(-1, -2).reshape(len(fraction), -1, 3)
        mass = self.scene.mass.expand(*lead, x.shape[-1]).reshape(len(fraction), -1)
        total = mass.new_zeros(len(fraction), self.count).index_add(1, self.body, mass)
        center = rows.new_zeros(len(fraction), self.count, 3).index_add(1, self.body, mass[..., None] * rows)
        arm = rows - (center / total[..., None])[:, self.body]

        def state(motion: Tensor) -> Tensor:
            turn = torch.linalg.matrix_exp(_cross_matrix(motion[..., :3]))
            moved = (
                rows + ((turn[:, self.body] - torch.eye(3).to(x)) @ arm[..., None])[..., 0] + motion[:, self.body, 3:]
            )
            return moved.transpose(-1, -2).reshape(x.shape)

        z = x.new_zeros(len(fraction), self.count, 6)
        jacobian = torch.cat([-_cross_matrix(arm), torch.eye(3).to(x).expand(*arm.shape, 3)], -1)  # [B, V, 3, 6]
        g, blocks = self._single(x, state, z, jacobian, mass)
        at = torch.arange(self.count, device=x.device)
        matrix = x.new_zeros(len(fraction), self.count, self.count, 6, 6)
        matrix = matrix.index_put((_scenes(len(fraction), at), at, at), blocks, accumulate=True)
        for term in self.forces:
            force, stiffness = term.on_corners(x, majorizes)
            g, matrix = self._add(term.pairs, term.turns_its_body, force, stiffness, jacobian, g, matrix)
        for floor in self.floors:
            force, stiffness = floor.on_vertices(x, self.x_prev, bend=not majorizes)
            pull = jacobian.mT @ force.transpose(-1, -2).reshape(*jacobian.shape[:2], 3, 1)
            g = g.index_add(1, self.body, pull[..., 0])
            pressed = jacobian.mT @ _full(stiffness).reshape(*jacobian.shape[:2], 3, 3) @ jacobian
            own = pressed.new_zeros(len(g), self.count, 6, 6).index_add(1, self.body, pressed)
            matrix = matrix.index_put((_scenes(len(g), at), at, at), own, accumulate=True)
        spread = torch.zeros_like(total).index_add(1, self.body, mass * arm.square().sum(-1))
        least = torch.stack([spread] * 3 + [torch.zeros_like(total)] * 3, -1)  # turn, shift
        g, matrix = self._of_free(g, matrix, least)
        motion = -torch.linalg.solve(matrix, g).reshape(z.shape)
        moves = (fraction != 0)[..., None]  # the others may have no motion: their matrix may be indefinite
        motion = fraction[..., None] * torch.where(moves, motion, 0.0)
        common = self._common(rows, mass, total, motion[..., 3:], group)
        return state(motion) + common[:, self.body].transpose(-1, -2).reshape(x.shape)

    def _common(self, rows: Tensor, mass: Tensor, total: Tensor, shift: Tensor, group: Tensor) -> Tensor:
        """The mean of y - x less that of the shifts [B, bodies, 3], by mass, over the island of each body; zero where
        it has none."""
        y = self.y.transpose(-1, -2).reshape(rows.shape)
        off = torch.zeros_like(total)[..., None].expand(-1, -1, 3).index_add(1, self.body, mass[..., None] * (y - rows))
        off = off - total[..., None] * shift
        same = ((group[:, :, None] == group[:, None]) & (group >= 0)[:, None]).to(rows)
        return (same @ off) / torch.where(group[..., None] >= 0, same @ total[..., None], 1.0)

    def _of_free(self, g: Tensor, matrix: Tensor, least: Tensor) -> tuple[Tensor, Tensor]:
        """Entries of others are zero, and their part of the matrix is the identity."""
        free = self.free.to(g.device)
        both = (free[:, None] & free)[..., None, None]
        at = torch.arange(self.count, device=g.device)
        fill = torch.where(free[:, None], LEAST_INERTIA * least, 1.0)[..., None] * torch.eye(6).to(g)
        matrix = torch.where(both, matrix, 0.0).index_put((_scenes(len(g), at), at, at), fill, accumulate=True)
        g = torch.where(free[:, None], g, 0.0).reshape(len(g), -1, 1)
        return g, matrix.permute(0, 1, 3, 2, 4).reshape(len(g), 6 * self.count, -1)

    def _single(self, x: Tensor, state: Any, z: Tensor, jacobian: Tensor, mass: Tensor) -> tuple[Tensor, Tensor]:
        """Gradient [B, bodies, 6] and blocks [B, bodies, 6, 6] of inertia and the energies of single vertices."""
        tracked = z.clone().requires_grad_()
        off = torch.where(self.scene.model.pinned, 0.0, state(tracked) - self.y)
        value = (self.scene.mass.unsqueeze(-2) / 2 * off**2).sum((-2, -1))
        for energy in self.single:
            value = value + energy.energy(state(tracked), self.x_prev)
        (g,) = torch.autograd.grad(value.sum(), tracked, create_graph=True)
        total = torch.zeros_like(x).repeat_interleave(3, -2)  # [..., 9, V]
        for k, color in enumerate(self.scene.layout.colors):
            for energy in self.single:
                total = total.index_add(-1, color.vertices, energy.block(k, x, self.x_prev))
        own = _full(total[..., 3:, :]).reshape(*jacobian.shape[:2], 3, 3) + mass[..., None, None] * torch.eye(3).to(x)
        blocks = jacobian.mT @ own @ jacobian
        return g, blocks.new_zeros(len(z), self.count, 6, 6).index_add(1, self.body, blocks)

    def _add(self, p: Any, within: bool, force: Tensor, stiffness: Tensor, jacobian: Tensor, g: Tensor, matrix: Tensor
             ) -> tuple[Tensor, Tensor]:  # fmt: skip
        vertices = jacobian.shape[1]
        mesh = p.corners < vertices
        corners = torch.where(mesh, p.corners, 0)
        body = self.body[corners]
        scene = p.batch[:, None].expand_as(corners)
        maps = torch.where(mesh[..., None, None], jacobian[scene, corners], 0.0)  # [Q, 4, 3, 6]
        if not within:
            second = torch.where(p.kind == EDGE_EDGE, 2, 1)
            both = mesh[:, :1] & mesh.gather(1, second[:, None])
            apart = (body[:, :1] != body.gather(1, second[:, None])) | ~both
            maps = torch.where(apart[..., None, None], maps, 0.0)
        pull = (maps.mT @ force[..., None])[..., 0]
        g = g.index_put((scene, body), pull, accumulate=True)
        pressed = maps.mT[:, :, None] @ stiffness @ maps[:, None]  # [Q, 4, 4, 6, 6]
        rows = (scene[:, :, None].expand(-1, 4, 4), body[:, :, None].expand(-1, 4, 4), body[:, None].expand(-1, 4, 4))
        return g, matrix.index_put(rows, pressed, accumulate=True)


def _full(six: Tensor) -> Tensor:
    """Symmetric [..., 6, n] as [..., n, 3, 3]."""
    xx, xy, xz, yy, yz, zz = six.unbind(-2)
    return torch.stack([torch.stack(r, -1) for r in ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))], -2)


def _scenes(scenes: int, at: Tensor) -> Tensor:
    """Scenes [B, 1] beside an index of bodies."""
    return torch.arange(scenes, device=at.device)[:, None].expand(scenes, len(at))


def _cross_matrix(w: Tensor) -> Tensor:
    """[w]x, [..., 3, 3]."""
    zero = torch.zeros_like(w[..., 0])
    x, y, z = w.unbind(-1)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).unflatten(-1, (3, 3))
