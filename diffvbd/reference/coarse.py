"""The coarse correction of a step, in plain torch: one Newton step in fixed functions of each body, and its length.

    (W^T (M + H) W + h^2 sum over groups of R_g (W^T K_g W) R_g^T) a = W^T dG,        z <- z - s_b W a

W [V, F] holds the functions, H the blocks of the energies of vertices at z, K_g the stiffness of a group of tets at
rest, R_g their mean rotation at the start of the step. The length s_b of each body is the first of 1, 1/2, ... that
lowers the incremental potential G enough; it counts as a constant. Everything else is differentiated by autograd. Rows
of a system are ordered by function, then component.
"""

from typing import Any

import torch
from torch import Tensor

from .energies import Law, StableNeoHookean
from .rigid import admits, axial, cross_matrix, turning_stiffness
from .scene import Scene, dot, shape_functions

HALVINGS = 8  # lengths that are tried: 1 to 1/128
DECREASE = 1e-4  # share of the decrease to first order that the potential must make
ROUNDING = 8  # ulps of the potential's terms by which it may rise all the same
REFUSALS = 2  # corrections of a body without an admissible length, after which the step makes no more of it
LEAST_TURN = 1e-3  # share of a group's volume: what its mean gradient must determine a turn by
LEAST_LAM = -2 / 3  # of mu: below it the stiffness of a tet at rest is not positive


class Coarse:
    """The coarse correction of a run; ``energies``: the reference formulas, all of them; ``forces``: of pairs, whose
    part of the matrix the caller adds.

    ``scene.model.coarse_geometry`` says which functions and groups there are.
    """

    def __init__(self, scene: Scene, energies: list[Any], forces: list[Any] | tuple = (),
                 couplings: list[Any] | tuple = ()) -> None:  # fmt: skip
        geometry, tets = scene.model.coarse_geometry, scene.layout.tets
        self.scene, self.energies, self.couplings = scene, [*energies, *forces], couplings
        self.of_vertices = [e for e in energies if not isinstance(e, StableNeoHookean)]

        def index(values: Any) -> Tensor:
            return torch.as_tensor(values, dtype=torch.int64, device=scene.like.device)

        ptr, vertex, function = (index(a) for a in (geometry.function_ptr, geometry.vertex, geometry.function))
        self.bodies, functions = len(ptr) - 1, int(ptr[-1])
        of_body = ptr.tolist()
        self.own = [slice(start, stop) for start, stop in zip(of_body[:-1], of_body[1:], strict=True)]
        self.filling = scene.tensor(geometry.filling)
        weight = scene.like.new_zeros(scene.rest_points.shape[-1], functions)
        self.weight = weight.index_put((vertex, function), scene.tensor(geometry.weight))

        group = index(geometry.tet_group)
        self.group = group if scene.layout.order is None else group[scene.layout.order]
        self.group_body = index(geometry.group_body)
        self.body_of_function = torch.repeat_interleave(torch.arange(self.bodies, device=ptr.device), ptr.diff())
        # bodies of vertices; one number more stands for none
        listed = (self.group >= 0).nonzero()[:, 0]
        self.body = torch.full((len(weight),), self.bodies, device=ptr.device)
        self.body[tets[:, listed]] = self.group_body[self.group[listed]]
        self.body[vertex] = self.body_of_function[function]
        self.moved = [torch.unique(vertex[self.body[vertex] == b]) for b in range(self.bodies)]

        inertia = torch.einsum("vf,...v,vk->...fk", self.weight, scene.mass, self.weight) + torch.diag(self.filling)
        one = torch.eye(3, dtype=weight.dtype, device=weight.device)
        self.inertia = torch.einsum("...fk,ij->...fikj", inertia, one)
        self.stiffness = [self._stiffness(b) for b in range(self.bodies)]
        self.gradients, self.volume = shape_functions(scene.tensor(scene.model.rest_points).T, tets)

    def _stiffness(self, body: int) -> Tensor:
        """W^T K_g W of the groups of a body, [..., groups, n, 3, n, 3]. Between functions of gradients a, b in a tet:
        V (mu (b a^T + (a.b) 1) + lam a b^T)."""
        scene, own = self.scene, self.own[body]
        softest = LEAST_LAM * scene.mu
        lam = torch.where(scene.lam >= softest, scene.lam, softest)
        one = torch.eye(3, dtype=self.weight.dtype, device=self.weight.device)
        out = []
        for g in (self.group_body == body).nonzero()[:, 0].tolist():
            members = (self.group == g).nonzero()[:, 0]
            corners = self.weight[scene.layout.tets[:, members], own]  # [4, t, n]
            slopes = torch.einsum("ctf,...cit->...fit", corners, scene.shape_gradients[..., members])
            of_mu, of_lam = ((scene.volume * modulus)[..., members] for modulus in (scene.mu, lam))
            k = torch.einsum("...t,...fjt,...kit->...fikj", of_mu, slopes, slopes)
            k = k + torch.einsum("...t,...fct,...kct,ij->...fikj", of_mu, slopes, slopes, one)
            k = k + torch.einsum("...t,...fit,...kjt->...fikj", of_lam, slopes, slopes)
            for law in (e for e in self.energies if isinstance(e, Law) and e.density.fibre):
                along, size = law.fibres[..., members], (scene.volume * law.fibre_modulus())[..., members]
                rate = (slopes * along[..., None, :, :]).sum(-2)
                k = k + torch.einsum("...t,...ft,...it,...kt,...jt->...fikj", size, rate, along, rate, along)
            out.append(k)
        return torch.stack(out, -5)

    def rotations(self, x_prev: Tensor) -> Tensor:
        """Mean rotation of each group at positions [..., 3, V], [..., G, 3, 3]; against the Model's own rest shape."""
        listed = (self.group >= 0).nonzero()[:, 0]
        tets, group, volume = self.scene.layout.tets[:, listed], self.group[listed], self.volume[listed]
        f = torch.einsum("...ict,cjt,t->...ijt", x_prev[..., tets], self.gradients[..., listed], volume)
        f = f.new_zeros(*f.shape[:-1], len(self.group_body)).index_add(-1, group, f)
        size = volume.new_zeros(len(self.group_body)).index_add(-1, group, volume)
        return nearest_rotation(f.movedim(-1, -3), LEAST_TURN * size)

    def begin(self, x_prev: Tensor) -> Tensor:
        """The matrix of a step that starts at x_prev [..., 3, V], [..., 3F, 3F]."""
        turn, h = self.rotations(x_prev), self.scene.time_step
        turned = []
        for body, stiffness in enumerate(self.stiffness):
            r = turn[..., self.group_body == body, :, :]
            turned.append(h**2 * torch.einsum("...gia,...gfakb,...gjb->...fikj", r, stiffness, r))
        lead = torch.broadcast_shapes(turn.shape[:-3], self.inertia.shape[:-4], *(k.shape[:-4] for k in turned))
        matrix = self.inertia.expand(*lead, *self.inertia.shape[-4:]).clone()
        for own, part in zip(self.own, turned, strict=True):
            matrix[..., own, :, own, :] += part
        return matrix.flatten(-4, -3).flatten(-2, -1)

    def correct(
        self,
        state: Tensor,
        y: Tensor,
        x_prev: Tensor,
        matrix: Tensor,
        steps: Tensor | None = None,
        skipped: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """The state after one correction, and s [..., bodies].

        state, y, x_prev [..., 3, V]; matrix: what `begin` made; steps: s, instead of a search for it; skipped, bool
        [..., bodies]: those that get s = 0 without a search.
        """
        rows = torch.einsum("vf,...iv->...fi", self.weight, self._gradient(state, y, x_prev)).flatten(-2)
        a = torch.linalg.solve(matrix + self._pressed(state, x_prev), rows.unsqueeze(-1)).squeeze(-1)
        p = -torch.einsum("vf,...fi->...iv", self.weight, a.unflatten(-1, (-1, 3)))
        if steps is None:
            with torch.no_grad():
                of_function = -(rows * a).unflatten(-1, (-1, 3)).sum(-1)
                slope = of_function.new_zeros(*a.shape[:-1], self.bodies)
                slope = slope.index_add(-1, self.body_of_function, of_function)
                steps = self._search(state, p, y, x_prev, slope, skipped)
        lengths = self._of_vertices(steps)
        return torch.where(lengths > 0, state + lengths * p, state), steps

    def _pressed(self, state: Tensor, x_prev: Tensor) -> Tensor:
        """Addition of the energies of vertices to the matrix [..., 3F, 3F]: W^T H W of their blocks."""
        total = torch.zeros_like(state).repeat_interleave(3, -2)  # [..., 9, V]
        for k, color in enumerate(self.scene.layout.colors):
            for energy in self.of_vertices:
                block = getattr(energy, "exact_block", energy.block)(k, state, x_prev)
                total = total.index_add(-1, color.vertices, block)
        xx, xy, xz, yy, yz, zz = total[..., 3:, :].unbind(-2)
        rows = [torch.stack(r, -2) for r in ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))]
        out = torch.einsum("vf,...ijv,vg->...figj", self.weight, torch.stack(rows, -3), self.weight)
        for energy in self.couplings:
            whole = self.scene.time_step**2 * energy.curvature(state)
            whole = whole.unflatten(-1, (-1, 3)).unflatten(-3, (-1, 3))
            out = out + torch.einsum("vf,...viuj,ug->...figj", self.weight, whole, self.weight)
        return out.flatten(-4, -3).flatten(-2, -1)

    def _gradient(self, state: Tensor, y: Tensor, x_prev: Tensor) -> Tensor:
        """dG [..., 3, V], by the formulas that sweeps use; zero at pinned vertices that are where they belong."""
        total = self.scene.mass.unsqueeze(-2) * (state - y)
        for k, color in enumerate(self.scene.layout.colors):
            for energy in self.energies:
                total = total.index_add(-1, color.vertices, energy.block(k, state, x_prev)[..., :3, :])
        for energy in self.couplings:
            total = total + energy.gradient(state)
        return total

    def _of_vertices(self, values: Tensor) -> Tensor:
        """Values [..., bodies] at the vertices of each body, [..., 1, V]; 0 at others."""
        return torch.cat((values, values.new_zeros(*values.shape[:-1], 1)), -1)[..., None, self.body]

    def _terms(self, z: Tensor, y: Tensor, x_prev: Tensor) -> list[tuple[Tensor, Tensor]]:
        """The terms of G, but for constants, and the body of each, in several parts [..., n], [n]."""
        inertia = self.scene.mass / 2 * dot(z - y, z - y)
        parts = [energy.terms(z, x_prev) for energy in self.energies]
        for energy in self.couplings:
            some = (energy.acts_on & (self.body < self.bodies)).int().argmax(-1)
            parts.append((self.scene.time_step**2 * energy.own(z), some))
        return [(inertia, self.body), *((terms, self.body[vertex]) for terms, vertex in parts)]

    def _search(
        self, state: Tensor, p: Tensor, y: Tensor, x_prev: Tensor, slope: Tensor, skipped: Tensor | None
    ) -> Tensor:
        """The first of 1, 1/2, ... by which each body may move along p; 0 where none will do."""
        before = self._terms(state, y, x_prev)

        def per_body(parts: list[tuple[Tensor, Tensor]]) -> Tensor:
            total = slope.new_zeros(*slope.shape[:-1], self.bodies + 1)
            for terms, body in parts:
                total = total.index_add(-1, body, terms.expand(*slope.shape[:-1], -1))
            return total[..., :-1]

        slack = ROUNDING * torch.finfo(state.dtype).eps * per_body([(terms.abs(), body) for terms, body in before])
        s, found = torch.ones_like(slope), torch.zeros_like(slope, dtype=torch.bool)
        for _ in range(HALVINGS):
            there = state + self._of_vertices(s) * p
            after = self._terms(there, y, x_prev)
            increase = per_body([(b - a, body) for (a, body), (b, _) in zip(before, after, strict=True)])
            admitted = [admits(self.energies, there, state, moved) for moved in self.moved]
            good = increase <= DECREASE * s * slope + slack
            if admitted:
                good = good & torch.stack(torch.broadcast_tensors(*admitted), -1)
            found = found | good
            s = torch.where(found, s, s / 2)
        return torch.where(found if skipped is None else found & ~skipped, s, 0.0)


def nearest_rotation(f: Tensor, least: Tensor) -> Tensor:
    """The rotation nearest to each of f [..., 3, 3], differentiable also where singular values are equal.

    Where the sum of the two smallest, the last with the sign of det f, is at most `least`: the identity, a constant.
    """
    one = torch.eye(3, dtype=f.dtype, device=f.device)
    with torch.no_grad():
        u, values, vh = torch.linalg.svd(f)
        sign = torch.linalg.det(u @ vh).sign()
        turn = torch.cat((u[..., :2], sign[..., None, None] * u[..., 2:]), -1) @ vh
        good = (values[..., 1] + sign * values[..., 2] > least)[..., None, None]
    # One step of Newton's method from the solution: of no length, but it carries the derivative.
    m = turn.mT @ f
    w = torch.linalg.solve(torch.where(good, turning_stiffness(m), one), torch.where(good[..., 0], axial(m), 0.0))
    return torch.where(good, turn + turn @ cross_matrix(w), one)
