"""The static potential of a scene at one state: elastic energy, barriers and couplings, less the work of the loads.

    U(x) = E(x) - f . x          [J]

It is the incremental potential with h = 1 and without masses, with the barrier of pairs added. In float64 throughout,
because what vanishes at rest is a difference of forces that are far larger.
"""

from __future__ import annotations

from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor

from .. import ops
from .._contact.pair_forces import NearPairs, corner_points, near_pairs, pair_energy, safe_fraction
from .._contact.surface import ContactSurface
from ..model.system import System
from .implicit import Operator, system
from .potential import DEPENDS, IncreaseInputs, IncrementalPotential, increase_of_bodies, values_of

CLOSED = 0.8  # of a gap, at most, in one iteration
REACH = 0.5  # of the trust-region radius of steps, which a vertex goes at most in one iteration
SINGULAR = 1e-12  # of the largest eigenvalue of a coarse matrix; smaller ones are rounding of free motions, left alone


class Statics(NamedTuple):
    """What the static potential depends on, all float64."""

    load: Tensor  # [B, V, 3] [N], zero where pinned
    mu: Tensor  # [1 | B, 1 | T] [Pa]
    lam: Tensor  # [1 | B, 1 | T] [Pa]
    rest: Tensor  # [1 | B, T, 7]
    data: Tensor  # [1 | B, n], of the energies of vertices, without damping
    colliders: Tensor  # [B, Vc, 3] [m]
    kappa: Tensor  # [1 | B] [N/m], of pairs
    couplings: Tensor  # [1 | B, n], the parameters of each coupling, one after another

    def fields(self, x: Tensor) -> ops.SweepFields:
        massless = x.new_zeros((1, x.shape[1]))
        return ops.SweepFields(x, x, x, self.mu, self.lam, massless, self.rest, self.data, None)


def _surface_of(model: System) -> ContactSurface | None:
    """The surfaces of a Model with pairs, in float64."""
    surface = model.surface_of_contact
    if surface is None or model.contact is None:
        return None
    return model.derived("surface in float64", lambda: surface.to(model.device, torch.float64))


class StaticPotential(IncrementalPotential):
    """U at the state x [B, V, 3]."""

    def __init__(self, model: System, x: Tensor, given: Statics) -> None:
        super().__init__(model, x, given.fields(x), 1.0, couplings=given.couplings)
        self.given = given

    @cached_property
    def coupling_terms(self) -> Tensor:
        """Terms [J] of the energies of couplings, [B, n]; their sum is the energy but for a constant."""
        values, none = values_of(self.model, self.given.couplings, len(self.x)), [self.x.new_zeros((len(self.x), 0))]
        parts = [energy.terms(self.x, own) for energy, own in zip(self.model.couplings, values, strict=True)]
        return torch.cat(parts or none, -1)

    @cached_property
    def points(self) -> Tensor:
        return corner_points(self.x, None, self.given.colliders)

    @cached_property
    def pairs(self) -> NearPairs | None:
        """Pairs closer than dhat, None where there are none."""
        pairs = self._near(None)
        return pairs if pairs is not None and len(pairs.scene) else None

    def _near(self, most: Tensor | None) -> NearPairs | None:
        """Pairs closer than dhat, or that may come so close where no vertex goes farther than ``most`` [B, 1] [m]."""
        surface, barrier, at = _surface_of(self.model), self.model.contact, self.given.colliders
        if surface is None or barrier is None:
            return None
        radius = None if most is None else most.expand(-1, surface.bodies + 1).contiguous()
        return near_pairs(self.x, None, at, at, surface, barrier, radius)

    def _with_colliders(self, w: Tensor) -> Tensor:
        """Motion of the vertices [B, V, 3] as one of all corner points [B, N, 3]."""
        return torch.cat([w, w.new_zeros(len(w), self.points.shape[1] - w.shape[1], 3)], 1)

    def _on_vertices(self, pairs: NearPairs, on_corners: Tensor) -> Tensor:
        return pairs.summed(on_corners, self.points)[:, : self.x.shape[1]]

    def _pair_gradient(self, pairs: NearPairs, at: Tensor, kappa: Tensor) -> Tensor:
        """Gradient of the barrier of each pair [Q, 4, 3], differentiable in corners ``at`` and in kappa."""
        energy = pair_energy(pairs, at, kappa).sum()
        return torch.autograd.grad(energy, at, create_graph=True, materialize_grads=True)[0]

    def pair_energies(self) -> Tensor:
        """Of each scene [J], [B]."""
        total = self.x.new_zeros(len(self.x))
        if self.pairs is None:
            return total
        return total.index_add(0, self.pairs.scene, pair_energy(self.pairs, self.pairs.positions(self.points),
                                                                self.given.kappa))  # fmt: skip

    def internal(self) -> Tensor:
        """dE/dx [N], [B, V, 3], rows of pinned vertices included."""
        total = self.forces()
        if self.pairs is None:
            return total
        with torch.enable_grad():
            at = self.pairs.positions(self.points).requires_grad_()
            slope = self._pair_gradient(self.pairs, at, self.given.kappa)
        return total + self._on_vertices(self.pairs, slope.detach())

    @cached_property
    def pair_blocks(self) -> Tensor:
        """Hessian of the barrier of each pair [Q, 12, 12]."""
        assert self.pairs is not None
        with torch.enable_grad():
            at = self.pairs.positions(self.points).requires_grad_()
            slope = self._pair_gradient(self.pairs, at, self.given.kappa).flatten(1)
            rows = torch.eye(12, dtype=at.dtype, device=at.device)[:, None].expand(12, *slope.shape)
            (blocks,) = torch.autograd.grad(slope, at, rows, is_grads_batched=True)
        return blocks.flatten(2).movedim(0, 1)

    def with_others(self, w: Tensor, out: Tensor) -> Tensor:
        """``out`` and the part of product() that is that of patches, couplings and pairs."""
        out = super().with_others(w, out)
        if self.pairs is not None:
            at = self.pairs.positions(self._with_colliders(w)).reshape(-1, 12, 1)
            out = out + self._on_vertices(self.pairs, (self.pair_blocks @ at).reshape(-1, 4, 3))
        return out

    @cached_property
    def pair_diagonal(self) -> Tensor:
        """The blocks of pairs on the diagonal, [B, V, 3, 3], without what is negative in them."""
        assert self.pairs is not None
        blocks = self.pair_blocks.reshape(-1, 4, 3, 4, 3).diagonal(dim1=1, dim2=3).movedim(-1, 1)
        value, vector = torch.linalg.eigh(blocks)
        blocks = (vector * value.clamp(min=0)[..., None, :]) @ vector.mT
        return self._on_vertices(self.pairs, blocks.flatten(-2)).unflatten(-1, (3, 3))

    def with_other_blocks(self, out: Tensor) -> Tensor:
        out = super().with_other_blocks(out)
        return out if self.pairs is None else out + self.pair_diagonal

    def increase(self, inputs: IncreaseInputs, to: StaticPotential) -> tuple[Tensor, Tensor]:
        """Increase of U from here to another state with the same pinned positions, and the sum of the sizes of its
        terms [J], both [B]; infinite where a vertex would come too near a plane."""
        more, size = increase_of_bodies(inputs, self.x, to.x).sum(1).unbind(-1)
        work = self.given.load * (to.x - self.x)
        before, after = self.pair_energies(), to.pair_energies()
        more, size = more - work.sum((1, 2)) + after - before, size + work.abs().sum((1, 2)) + after + before
        size = size if self.own is None else size + self.own.size
        before, after = self.coupling_terms, to.coupling_terms
        return more + (after - before).sum(-1), size + before.abs().sum(-1) + after.abs().sum(-1)

    def admissible(self, move: Tensor) -> Tensor:
        """Largest fraction, at most 1, of a motion [B, V, 3] on which no gap of a floor or pair closes, [B]."""
        fraction, floor = self.x.new_ones(len(self.x)), self.model.floor
        if floor is not None:
            gap, normal, *_ = floor.gaps(self.x, self.data[:, : floor.count()], None)
            toward = -(move[:, :, None] * normal).sum(-1)
            limit = torch.where((toward > 0) & (self.free > 0), CLOSED * gap / toward, 1.0)
            fraction = torch.minimum(fraction, limit.flatten(1).amin(1))
        surface = _surface_of(self.model)
        if surface is not None:
            # no farther than so that few pairs are listed
            most = move.norm(dim=-1).amax(-1)
            reach = REACH * float(surface.max_trust_radius.amin())
            fraction = torch.minimum(fraction, reach / most.clamp(min=reach))
            move = fraction[:, None, None] * move
            pairs = self._near((fraction * most)[:, None])
            assert pairs is not None
            fraction = fraction * safe_fraction(pairs, self.points, self._with_colliders(move), CLOSED)
        return fraction

    def depends(self, w: Tensor) -> Statics:
        """Gradient of -w . dU/dx, with w fixed and zero where pinned, with respect to what U depends on."""
        _, _, _, mu, lam, _, rest, data, of_lam, of_c6, couplings = self.dependence(w, [True] * DEPENDS)
        assert mu is not None and lam is not None and rest is not None
        if of_lam is not None and of_c6 is not None:  # patches average the law itself
            lam, rest = lam + of_lam, torch.cat([rest[..., :6], rest[..., 6:] + of_c6[..., None]], -1)
        colliders, kappa = torch.zeros_like(self.given.colliders), torch.zeros_like(self.given.kappa)
        if self.pairs is not None:
            with torch.enable_grad():
                colliders, kappa = (t.detach().requires_grad_() for t in (self.given.colliders, self.given.kappa))
                at = self.pairs.positions(corner_points(self.x, None, colliders))
                slope = self._pair_gradient(self.pairs, at, kappa)
                along = -(slope * self.pairs.positions(self._with_colliders(w))).sum()
                colliders, kappa = torch.autograd.grad(along, (colliders, kappa), materialize_grads=True)
        data = torch.zeros_like(self.data) if data is None else data
        couplings = torch.zeros_like(self.given.couplings) if couplings is None else couplings
        return Statics(w, mu, lam, rest, data, colliders, kappa, couplings)


def newton_operators(at: StaticPotential, shift: Tensor | None = None) -> tuple[Operator, Operator]:
    """Product with the Hessian of U between free vertices, ``shift`` [B, V, 1] added to its diagonal, and what
    preconditions it: the inverse of its diagonal blocks and, with a coarse subspace, of its projection on that."""
    stored = at.x.is_cuda or torch.backends.mkl.is_available()  # sparse products on a CPU need MKL
    product, smooth = system(at, stored, shift)
    weights = _coarse_functions(at.model)
    if weights is None:
        return product, smooth
    (count, functions), scenes = weights.shape, len(at.x)
    eye = torch.eye(3, dtype=at.x.dtype, device=at.x.device)
    columns = (weights[:, None, :, None] * eye[:, None]).reshape(count, 3, 3 * functions)
    image = torch.stack([product(c.expand(scenes, -1, -1)).flatten(1) for c in columns.unbind(-1)], -1)
    matrix = columns.flatten(0, 1).T @ image
    value, vector = torch.linalg.eigh((matrix + matrix.mT) / 2)
    value = value.abs()  # positive definite, whatever the Hessian is
    value = torch.where(value > SINGULAR * value.amax(-1, keepdim=True), value, torch.inf)

    def precondition(r: Tensor) -> Tensor:
        coarse = (weights.T @ r).reshape(scenes, -1, 1)
        coarse = vector @ ((vector.mT @ coarse) / value[..., None])
        return smooth(r) + weights @ coarse.reshape(scenes, functions, 3)

    return product, precondition


def _coarse_functions(model: System) -> Tensor | None:
    """Values of the functions of a coarse subspace at the vertices, zero where pinned, [V, functions]."""
    if model.coarse is None or not model.coarse_geometry.bodies:
        return None

    def build() -> Tensor:
        g = model.coarse_geometry
        weights = torch.zeros(model.num_vertices, g.functions, dtype=torch.float64, device="cpu")
        weights[torch.from_numpy(g.vertex), torch.from_numpy(g.function)] = torch.from_numpy(g.weight)
        return weights[:, ~torch.from_numpy(g.filling)].to(model.device)

    return model.derived("coarse functions", build)
