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
from ..couplings import load_of
from ..model.system import System
from .implicit import Assembled, Operator, inverse_blocks
from .potential import IncreaseInputs, IncrementalPotential, increase_of_bodies

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
        super().__init__(model, x, given.fields(x), 1.0)
        self.given = given

    def _values(self, couplings: Tensor) -> list[dict[str, Tensor]]:
        """Parameters of each coupling by key, [B, ...]."""
        out, first = [], 0
        couplings = ops.broadcast(couplings, (len(self.x), couplings.shape[1]))
        for energy in self.model.couplings:
            out.append({})
            for key, own in self.model.constants(energy).items():
                out[-1][key] = couplings[:, first : first + own.numel()].unflatten(1, own.shape)
                first += own.numel()
        return out

    @cached_property
    def coupling_terms(self) -> Tensor:
        """Terms [J] of the energies of couplings, [B, n]; their sum is the energy but for a constant."""
        return self._terms(self.x, self.given.couplings)

    def _terms(self, x: Tensor, couplings: Tensor) -> Tensor:
        values, none = self._values(couplings), [x.new_zeros((len(x), 0))]
        parts = [energy.terms(x, own) for energy, own in zip(self.model.couplings, values, strict=True)]
        return torch.cat(parts or none, -1)

    @cached_property
    def _coupled(self) -> tuple[Tensor, Tensor, Tensor]:
        """x, the parameters of couplings, and the gradient of their energies [N], which autograd differentiates."""
        with torch.enable_grad():
            x, couplings = (t.detach().requires_grad_() for t in (self.x, self.given.couplings))
            (slope,) = torch.autograd.grad(self._terms(x, couplings).sum(), x, create_graph=True)
            return x, couplings, slope

    def coupled(self) -> Tensor:
        """The gradient of the energies of couplings [N], [B, V, 3], rows of pinned vertices included."""
        return self._coupled[2].detach() if self.model.couplings else torch.zeros_like(self.x)

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
        """dE/dx of all but couplings [N], [B, V, 3], rows of pinned vertices included."""
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

    def product(self, w: Tensor) -> Tensor:
        return self.with_others(w, super().product(w))

    def with_others(self, w: Tensor, out: Tensor) -> Tensor:
        """``out`` and the part of product() that is that of pairs and couplings."""
        if self.pairs is not None:
            at = self.pairs.positions(self._with_colliders(w)).reshape(-1, 12, 1)
            out = out + self._on_vertices(self.pairs, (self.pair_blocks @ at).reshape(-1, 4, 3))
        if self.model.couplings:
            x, _, slope = self._coupled  # the Hessian is symmetric: a product with its transpose is one with it
            out = out + torch.autograd.grad(slope, x, w, retain_graph=True)[0]
        return out

    @cached_property
    def other_diagonal(self) -> Tensor:
        """The blocks on the diagonal of pairs, [B, V, 3, 3], without what is negative in them, and the bound of
        couplings, which is above theirs."""
        total = self.x.new_zeros(*self.x.shape, 3)
        if self.model.couplings:
            bound = load_of(self.model.couplings, self._values(self.given.couplings), self.x)[..., 3:]
            total.diagonal(dim1=-2, dim2=-1).add_(bound)
        if self.pairs is None:
            return total
        blocks = self.pair_blocks.reshape(-1, 4, 3, 4, 3).diagonal(dim1=1, dim2=3).movedim(-1, 1)
        value, vector = torch.linalg.eigh(blocks)
        blocks = (vector * value.clamp(min=0)[..., None, :]) @ vector.mT
        return total + self._on_vertices(self.pairs, blocks.flatten(-2)).unflatten(-1, (3, 3))

    def diagonal(self) -> Tensor:
        return super().diagonal() + self.other_diagonal

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
        _, _, _, mu, lam, _, rest, data = self.dependence(w, [True] * 8)
        colliders, kappa = torch.zeros_like(self.given.colliders), torch.zeros_like(self.given.kappa)
        if self.pairs is not None:
            with torch.enable_grad():
                colliders, kappa = (t.detach().requires_grad_() for t in (self.given.colliders, self.given.kappa))
                at = self.pairs.positions(corner_points(self.x, None, colliders))
                slope = self._pair_gradient(self.pairs, at, kappa)
                along = -(slope * self.pairs.positions(self._with_colliders(w))).sum()
                colliders, kappa = torch.autograd.grad(along, (colliders, kappa), materialize_grads=True)
        couplings = self.given.couplings
        if self.model.couplings:
            _, couplings, slope = self._coupled
            (couplings,) = torch.autograd.grad(slope, couplings, -w, retain_graph=True)
        data = torch.zeros_like(self.data) if data is None else data
        assert mu is not None and lam is not None and rest is not None
        return Statics(w, mu, lam, rest, data, colliders, kappa, couplings)


def newton_operators(at: StaticPotential, shift: Tensor | None = None) -> tuple[Operator, Operator]:
    """Product with the Hessian of U between free vertices, ``shift`` [B, V, 1] added to its diagonal, and what
    preconditions it: the inverse of its diagonal blocks and, with a coarse subspace, of its projection on that."""
    eye = torch.eye(3, dtype=at.x.dtype, device=at.x.device)
    shift = at.x.new_zeros((1, 1, 1)) if shift is None else shift
    blocks = at.diagonal() + shift[..., None] * eye
    smooth = inverse_blocks(blocks, at.free)
    stored = at.x.is_cuda or torch.backends.mkl.is_available()  # sparse products on a CPU need MKL
    of_tets = blocks - at.other_diagonal
    of_tets = of_tets if at.patches is None else of_tets - at.patches.diagonal
    elastic = Assembled(at, of_tets) if stored else (
        lambda w: IncrementalPotential.product(at, w) + shift * w)  # fmt: skip

    def product(w: Tensor) -> Tensor:
        out = elastic(w)
        if stored and at.patches is not None:  # a matrix of tets has no room for what couples several
            out = out + at.patches.product(w)
        return at.free * at.with_others(w, out)

    weights = _coarse_functions(at.model)
    if weights is None:
        return product, smooth
    (count, functions), scenes = weights.shape, len(at.x)
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
