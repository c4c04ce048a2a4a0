"""The incremental potential of a step at one state: its gradient, its Hessian, and what the two depend on.

    G(x) = 1/2 sum m |x - y|^2 + h^2 E(x)          [kg m^2]

In plain torch from the arguments of the sweep operator, so that it needs no deformation gradient: with the rest scalars
k_ab and c6 of docs/method.md, section 2, and the edges e_1, e_2, e_3 from the first corner of a tet,

    E = mu/2 sum_ij S_ij e_i.e_j + V [lb/2 (J - 1)^2 - mu (J - 1)]
    J = c6 e_1.(e_2 x e_3),    S_ij = V grad N_i.grad N_j,    lb = mu + lam,    V = 1/(6 c6)
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from . import ops
from .metric import rest_metric
from .model import Model

_PAIRS = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))  # corners of k_ab, the first six rest scalars


def _rolled(vectors: Tensor, by: int) -> Tensor:
    """v_1, v_2, v_3 -> v_(1 + by), v_(2 + by), v_(3 + by), counted in a circle."""
    return vectors.roll(-by, 0)


def _cross(a: Tensor, b: Tensor) -> Tensor:
    return torch.linalg.cross(a, b, dim=1)


class IncrementalPotential:
    """G at the state x. Vectors are [B, V, 3]; entries of pinned vertices count as given, and as zero where asked for.

    Per tet, arrays are [3 edges, 3 components, B, T]: rows of whole meshes, which elementwise operations want.
    """

    def __init__(self, model: Model, x: Tensor, tensors: Sequence[Any], time_step: float) -> None:
        """tensors: the arguments of sweeps.sweep, of which the first (the start of the sweep) does not enter."""
        _, self.x_prev, self.y, mu, lam, mass, rest, self.data, origin = tensors
        self.model, self.x, self.h = model, x, time_step
        self.mu, self.lam, self.mass = mu, lam, mass[..., None]
        self.origin = origin if origin.numel() else None
        self.rest = model.derived("rest", lambda: _metric(model)) if rest is None else rest  # [1 | B, T, 7]
        self.free = (~model.pinned)[:, None].to(x.dtype)

        k = dict(zip(_PAIRS, self.rest[..., :6].unbind(-1), strict=True))
        k |= {(b, a): value for (a, b), value in k.items()}
        k |= {(i, i): -(k[i, 0] + k[i, a] + k[i, b]) for i, a, b in ((1, 2, 3), (2, 3, 1), (3, 1, 2))}
        h2 = time_step * time_step
        rows = [torch.stack([k[i, j] for j in (1, 2, 3)]) for i in (1, 2, 3)]
        self._shear = (h2 * mu) * torch.stack(rows)  # h^2 mu S, [3, 3, 1 | B, T]
        self.edges = self._edges_of(x)
        self._next, self._last = _rolled(self.edges, 1), _rolled(self.edges, 2)
        self.normals = _cross(self._next, self._last)  # of det = e_1.(e_2 x e_3) with respect to e_i
        self.c6 = self.rest[..., 6]
        self.ratio = self.c6 * (self.edges[0] * self.normals[0]).sum(0)  # J [B, T]
        total = mu + lam
        self._pressure = (h2 / 6) * (total * (self.ratio - 1) - mu)
        self._bulk = (h2 / 6) * total * self.c6

    def _edges_of(self, x: Tensor) -> Tensor:
        corners = ops.tet_gather(x, *self.model._topology).permute(2, 3, 0, 1)
        return corners[1:] - corners[:1]

    def _summed(self, per_edge: Tensor) -> Tensor:
        """Contributions to e_1, e_2, e_3 -> sums over the tets of each vertex, in their order."""
        corners = torch.cat([-per_edge.sum(0, keepdim=True), per_edge])
        return ops.star_sum(corners.permute(2, 3, 0, 1), *self.model._topology)

    def _sheared(self, edges: Tensor) -> Tensor:
        return (self._shear[:, :, None] * edges[None]).sum(1)

    def forces(self) -> Tensor:
        """h^2 dE/dx [kg m], [B, V, 3]."""
        total = self._summed(self._sheared(self.edges) + self._pressure * self.normals)
        for energy, data in self._vertex_energies(self.data):
            total = total + energy.gradient(self.x, self.x_prev, data, self.h, self.origin)
        return total

    def inertia(self) -> Tensor:
        """M (x - y) [kg m], [B, V, 3]."""
        return self.mass * (self.x - self.y)

    def product(self, w: Tensor) -> Tensor:
        """Hessian times w, [B, V, 3], rows of pinned vertices included."""
        f = self._edges_of(w)
        turned = _cross(_rolled(f, 1), self._last) + _cross(self._next, _rolled(f, 2))
        stretched = self._bulk * (self.normals * f).sum((0, 1))
        out = self._summed(self._sheared(f) + self._pressure * turned + stretched * self.normals)
        out = out + self.mass * w
        blocks = self.vertex_blocks()
        return out if blocks is None else out + (blocks * w[..., None, :]).sum(-1)

    def vertex_blocks(self) -> Tensor | None:
        """3x3 blocks of the energies of single vertices, [B, V, 3, 3], or None where there are none."""
        if not self.model.vertex_energies:
            return None
        if not hasattr(self, "_blocks"):
            with torch.enable_grad():
                x = self.x.detach().requires_grad_()
                pairs = self._vertex_energies(self.data.detach())
                total = sum(e.gradient(x, self.x_prev.detach(), data, self.h, self.origin) for e, data in pairs)
                assert isinstance(total, Tensor)
                columns = [torch.autograd.grad(total[..., c].sum(), x, retain_graph=True)[0] for c in range(3)]
            self._blocks = torch.stack(columns, -1) * self.free[..., None]
        return self._blocks

    def diagonal(self) -> Tensor:
        """The 3x3 blocks on the diagonal, [B, V, 3, 3]: positive definite wherever mu >= 0 and mu + lam >= 0."""
        shear = torch.stack([self._shear[i, i] for i in range(3)])
        shear = torch.cat([self._shear.sum((0, 1))[None], shear])  # [4, 1 | B, T]
        normals = torch.cat([-self.normals.sum(0, keepdim=True), self.normals])
        eye = torch.eye(3, dtype=shear.dtype, device=shear.device)[..., None, None]
        blocks = shear[:, None, None] * eye + self._bulk * normals[:, :, None] * normals[:, None]  # [4, 3, 3, B, T]
        return self._with_inertia(ops.star_sum(blocks.permute(3, 4, 0, 1, 2).flatten(-2), *self.model._topology))

    def _with_inertia(self, blocks: Tensor) -> Tensor:
        """[B, V, 9] of the tets -> [B, V, 3, 3] of everything."""
        eye = torch.eye(3, dtype=blocks.dtype, device=blocks.device)
        blocks = blocks.unflatten(-1, (3, 3)) + self.mass[..., None] * eye
        own = self.vertex_blocks()
        return blocks if own is None else blocks + own

    def tet_blocks(self) -> Tensor:
        """Hessians of the tets, [B, T, 4, 4, 3, 3]."""
        size = self.edges.shape[2:]
        eye = torch.eye(3, dtype=self.x.dtype, device=self.x.device)[..., None, None]
        inner = self._shear[:, :, None, None] * eye + self._bulk * (
            self.normals[:, None, :, None] * self.normals[None, :, None, :]
        )
        inner = inner.expand(3, 3, 3, 3, *size).clone()
        for i in range(3):  # n_i = e_(i+1) x e_(i+2)
            after, last = (i + 1) % 3, (i + 2) % 3
            inner[i, after] -= self._pressure * _skew(self.edges[last])
            inner[i, last] += self._pressure * _skew(self.edges[after])
        first = -inner.sum(0, keepdim=True)
        rows = torch.cat([first, inner])  # [4, 3, 3, 3, B, T]
        full = torch.cat([-rows.sum(1, keepdim=True), rows], 1)
        return full.permute(4, 5, 0, 1, 2, 3)

    def dependence(self, w: Tensor, wants: Sequence[bool]) -> list[Tensor | None]:
        """Gradient of -w . dG/dx, with w fixed and zero where pinned, with respect to the arguments of the sweep.

        wants: for x_start, x_prev, y, mu, lam, mass, rest, energy_data. The first is zero and left to the caller.
        """
        h2 = self.h * self.h
        out: list[Tensor | None] = [None] * 8
        f = self._edges_of(w)
        bent = (self.normals * f).sum((0, 1)) / 6  # d(V J) along w, over c6 V = 1/6
        if wants[2]:
            out[2] = self.mass * w
        if wants[5]:
            out[5] = -(w * (self.x - self.y)).sum(-1)
        if wants[3] or wants[6]:
            corners = [torch.cat([torch.zeros_like(a[:1]), a]) for a in (self.edges, f)]
            stretch = [((corners[0][a] - corners[0][b]) * (corners[1][a] - corners[1][b])).sum(0) for a, b in _PAIRS]
            k = self.rest[..., :6].unbind(-1)
            if wants[3]:
                sheared = sum(scalar * s for scalar, s in zip(k, stretch, strict=True))
                out[3] = h2 * (sheared - (self.ratio - 2) * bent)
            if wants[6]:
                shape = torch.broadcast_shapes(bent.shape, self.c6.shape)
                of_c6 = -h2 * (self.mu + self.lam) * (self.ratio / self.c6) * bent
                columns = [h2 * self.mu * s for s in stretch] + [of_c6]
                out[6] = torch.stack([c.expand(shape) for c in columns], -1)
        if wants[4]:
            out[4] = -h2 * (self.ratio - 1) * bent
        if self.model.vertex_energies and (wants[1] or wants[7]):
            with torch.enable_grad():
                x_prev, data = (t.detach().requires_grad_() for t in (self.x_prev, self.data))
                pairs = self._vertex_energies(data)
                total = sum(e.gradient(self.x.detach(), x_prev, d, self.h, self.origin) for e, d in pairs)
                assert isinstance(total, Tensor)
                out[1], out[7] = torch.autograd.grad(-(w * total).sum(), (x_prev, data), allow_unused=True)
        return out

    def _vertex_energies(self, data: Tensor) -> list[tuple[Any, Tensor]]:
        """Each energy of single vertices with its part of the data [1 | B, n]."""
        energies = self.model.vertex_energies
        sizes = [e.count() * (self.model.num_vertices if e.per_vertex else 1) for e in energies]
        return list(zip(energies, data.split(sizes, -1), strict=True)) if energies else []


def _skew(a: Tensor) -> Tensor:
    """[3, ...] -> the matrix [3, 3, ...] of b -> a x b."""
    x, y, z = a
    no = torch.zeros_like(x)
    return torch.stack([torch.stack([no, -z, y]), torch.stack([z, no, -x]), torch.stack([-y, x, no])])


def _metric(model: Model) -> Tensor:
    """The Model's rest scalars [1, T, 7], rounded once from float64."""
    points = torch.from_numpy(model.mesh.points.copy())[None].to(model.device)
    rest, _ = rest_metric(ops.tet_gather(points, *model._topology))
    return rest.to(model.dtype)
