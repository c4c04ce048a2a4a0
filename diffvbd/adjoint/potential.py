"""The incremental potential of a step at one state: its gradient, its Hessian, and what the two depend on.

    G(x) = 1/2 sum m |x - y|^2 + h^2 E(x)          [kg m^2]

In plain torch from the arguments of the sweep operator, so that it needs no deformation gradient: with the rest scalars
k_ab and c6 of docs/method.md, section 2, and the edges e_1, e_2, e_3 from the first corner of a tet,

    E = mu/2 sum_ij S_ij e_i.e_j + V [lb/2 (J - 1)^2 - mu (J - 1)]
    J = c6 e_1.(e_2 x e_3),    S_ij = V grad N_i.grad N_j,    lb = mu + lam,    V = 1/(6 c6)
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any, NamedTuple

import torch
from torch import Tensor

from .. import ops
from .._common.constants import ELASTIC
from .._common.context import replaced
from ..couplings import load_of
from ..laws.tets import LawTets
from ..model.moving import MovingBodies, moving_bodies
from ..model.patches import Averaged
from ..model.system import System
from ..ops.fields import ROUNDINGS
from ..ops.sums import Rows

DEPENDS = 11  # what G depends on, as dependence() lists it
PAIRS = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))  # corners (a, b) of k_ab, the first six rest scalars
# a, b and the other two corners c, d, in the order in which det(x_a - x_d, x_b - x_d, x_c - x_d) > 0
_PAIRS = [(0, 1, 2, 3), (0, 2, 3, 1), (0, 3, 1, 2), (1, 2, 0, 3), (1, 3, 2, 0), (2, 3, 0, 1)]
_OF_PAIRS = torch.tensor(_PAIRS, device="cpu").T


def _rolled(vectors: Tensor, by: int) -> Tensor:
    """v_1, v_2, v_3 -> v_(1 + by), v_(2 + by), v_(3 + by), counted in a circle."""
    return vectors.roll(-by, 0)


def _cross(a: Tensor, b: Tensor) -> Tensor:
    return torch.linalg.cross(a, b, dim=1)


class IncrementalPotential:
    """G at the state x. Vectors are [B, V, 3]; entries of pinned vertices count as given, and as zero where asked for.

    Per tet, arrays are [3 edges, 3 components, B, T]: rows of whole meshes, which elementwise operations want.
    """

    def __init__(self, model: System, x: Tensor, fields: ops.SweepFields, time_step: float,
                 averaged: Averaged | None = None, couplings: Tensor | None = None) -> None:  # fmt: skip
        """fields: of the step, without bounds of patches; where its sweeps start does not enter.  averaged: the law
        whose volumes patches average; None: that of the fields.  couplings: the parameters of each coupling, one after
        another [1 | B, n]; None: there are none, or the fields have their bound about x."""
        self.model, self.x, self.h = model, x, time_step
        self.x_prev, self.y, self.data = fields.x_prev, fields.y, fields.energy_data
        self.mu, self.lam, self.mass = fields.mu, fields.lam, fields.mass[..., None]
        self.origin, self.couplings = fields.origin, couplings
        rest = fields.rest
        self.rest = model.rest_scalars if rest is None else rest  # [1 | B, T, 7]
        self.free = (~model._pinned)[:, None].to(x.dtype)

        k = dict(zip(PAIRS, self.rest[..., :6].unbind(-1), strict=True))
        k |= {(b, a): value for (a, b), value in k.items()}
        k |= {(i, i): -(k[i, 0] + k[i, a] + k[i, b]) for i, a, b in ((1, 2, 3), (2, 3, 1), (3, 1, 2))}
        h2 = time_step * time_step
        rows = [torch.stack([k[i, j] for j in (1, 2, 3)]) for i in (1, 2, 3)]
        self._shear = (h2 * self.mu) * torch.stack(rows)  # h^2 mu S, [3, 3, 1 | B, T]
        self.edges = self._edges_of(x)
        self._next, self._last = _rolled(self.edges, 1), _rolled(self.edges, 2)
        self.normals = _cross(self._next, self._last)  # of det = e_1.(e_2 x e_3) with respect to e_i
        self.c6 = self.rest[..., 6]
        self.ratio = self.c6 * (self.edges[0] * self.normals[0]).sum(0)  # J [B, T]
        total = self.mu + self.lam
        self._pressure = (h2 / 6) * (total * (self.ratio - 1) - self.mu)
        self._bulk = (h2 / 6) * total * self.c6
        self.patches = None
        if model.patches is not None:
            own = Averaged(self.lam, self.c6) if averaged is None else averaged
            self.patches = _PatchTerms(self, own)
            det = self.ratio / self.c6
            shift = model.patches.spread(self.patches.ratio) - own.c6 * det
            self._pressure = self._pressure + (h2 / 6) * own.lam * shift
            self._bulk = self._bulk - (h2 / 6) * own.lam * own.c6
        self.own = None  # a law of one's own, which only J above serves
        if model.law is not None:
            self.own = LawTets(model.law.density, ops.tet_gather(x, *model._topology), self.rest, time_step)

    @cached_property
    def coupled(self) -> _CouplingTerms | None:
        return None if self.couplings is None or not self.model.couplings else _CouplingTerms(self, self.couplings)

    @property
    def _others(self) -> list[Any]:
        """What a matrix of tets has no room for."""
        return [terms for terms in (self.patches, self.coupled) if terms is not None]

    def _edges_of(self, x: Tensor) -> Tensor:
        corners = ops.tet_gather(x, *self.model._topology).permute(2, 3, 0, 1).contiguous()
        return corners[1:] - corners[:1]

    def _summed(self, per_edge: Tensor) -> Tensor:
        """Contributions to e_1, e_2, e_3 -> sums over the tets of each vertex, in their order."""
        corners = torch.cat([-per_edge.sum(0, keepdim=True), per_edge])
        return ops.star_sum(corners.permute(2, 3, 0, 1), *self.model._topology)

    def _sheared(self, edges: Tensor) -> Tensor:
        first, second, third = self._shear[:, :, None].unbind(1)
        out = torch.addcmul(first * edges[0], second, edges[1])
        return torch.addcmul(out, third, edges[2])

    def elastic(self) -> Tensor:
        """The part of forces() that is that of the tets [kg m], [B, V, 3]."""
        if self.own is not None:
            return ops.star_sum(self.own.gradient(), *self.model._topology)
        return self._summed(self._sheared(self.edges) + self._pressure * self.normals)

    def forces(self) -> Tensor:
        """h^2 dE/dx [kg m], [B, V, 3]."""
        total = self.elastic()
        for energy, data in self._vertex_energies(self.data):
            total = total + energy.gradient(self.x, self.x_prev, data, self.h, self.origin)
        return total if self.coupled is None else total + self.coupled.gradient

    def inertia(self) -> Tensor:
        """M (x - y) [kg m], [B, V, 3]."""
        return self.mass * (self.x - self.y)

    def product(self, w: Tensor) -> Tensor:
        """Hessian times w, [B, V, 3], rows of pinned vertices included."""
        out = self.tet_product(w) + self.mass * w
        blocks = self.vertex_blocks()
        return self.with_others(w, out if blocks is None else out + (blocks * w[..., None, :]).sum(-1))

    def with_others(self, w: Tensor, out: Tensor) -> Tensor:
        """``out`` and the part of product() that is that of patches and couplings."""
        for terms in self._others:
            out = out + terms.product(w)
        return out

    def elastic_product(self, w: Tensor) -> Tensor:
        """The part of product() that is that of the tets and patches."""
        return self.tet_product(w) if self.patches is None else self.tet_product(w) + self.patches.product(w)

    def tet_product(self, w: Tensor) -> Tensor:
        """The part of product() that is that of single tets."""
        if self.own is not None:
            return ops.star_sum(self.own.product(ops.tet_gather(w, *self.model._topology)), *self.model._topology)
        f = self._edges_of(w)
        turned = _cross(_rolled(f, 1), self._last) + _cross(self._next, _rolled(f, 2))
        stretched = self._bulk * (self.normals * f).sum(0).sum(0)
        return self._summed(self._sheared(f) + self._pressure * turned + stretched * self.normals)

    def vertex_blocks(self) -> Tensor | None:
        """3x3 blocks of the energies of single vertices, [B, V, 3, 3], or None where there are none."""
        if not self.model.vertex_energies:
            return None
        if not hasattr(self, "_blocks"):
            with torch.inference_mode(False), torch.enable_grad():
                # clones: what was made in inference mode cannot be differentiated
                x, x_prev, data = (t.detach().clone() for t in (self.x, self.x_prev, self.data))
                x.requires_grad_()
                origin = None if self.origin is None else self.origin.detach().clone()
                pairs = self._vertex_energies(data)
                total = sum(e.gradient(x, x_prev, part, self.h, origin) for e, part in pairs)
                assert isinstance(total, Tensor)
                columns = [torch.autograd.grad(total[..., c].sum(), x, retain_graph=True)[0] for c in range(3)]
            self._blocks = torch.stack(columns, -1) * self.free[..., None]
        return self._blocks

    def diagonal(self) -> Tensor:
        """The 3x3 blocks on the diagonal, [B, V, 3, 3], of couplings what is above theirs: positive definite wherever
        mu >= 0 and mu + lam >= 0 with StableNeoHookean."""
        return self.with_other_blocks(self.tet_diagonal())

    def with_other_blocks(self, out: Tensor) -> Tensor:
        """``out`` and the part of diagonal() that is that of patches and couplings."""
        for terms in self._others:
            out = out + terms.diagonal
        return out

    def tet_diagonal(self) -> Tensor:
        """The part of diagonal() that is that of single tets and vertices."""
        eye = torch.eye(3, dtype=self.x.dtype, device=self.x.device)
        if self.own is not None:
            blocks = self.own.hessian.diagonal(dim1=2, dim2=3).movedim(-1, 2)
        else:
            shear = torch.cat([self._shear.sum(0).sum(0)[None], self._shear.diagonal().movedim(-1, 0)])  # [4, 1 | B, T]
            normals = self._corner_normals()
            blocks = self._bulk * normals[:, :, None] * normals[:, None] + shear[:, None, None] * eye[..., None, None]
            blocks = blocks.permute(3, 4, 0, 1, 2)
        total = ops.star_sum(blocks.flatten(-2), *self.model._topology).unflatten(-1, (3, 3))
        total = total + self.mass[..., None] * eye
        own = self.vertex_blocks()
        return total if own is None else total + own

    def stiffness(self) -> Tensor:
        """Traces of the blocks on the diagonal [kg], [B, V, 1]."""
        return self.diagonal().diagonal(dim1=-2, dim2=-1).sum(-1, keepdim=True)

    def edge_blocks(self) -> Tensor:
        """Blocks off the diagonal of the tets' Hessians, without what couples the tets of patches: of the corners
        (a, b) of PAIRS, then of (b, a), [B, T, 12, 9]."""
        if self.own is not None:
            one, two = torch.tensor(PAIRS, device=self.x.device).T
            return torch.cat([self.own.hessian[:, :, one, two], self.own.hessian[:, :, two, one]], 2).flatten(-2)
        corners = torch.cat([torch.zeros_like(self.edges[:1]), self.edges])
        normals = self._corner_normals()
        a, b, c, d = _OF_PAIRS.to(self.x.device)
        # n_a = dV6/dx_a changes with x_b by arm x dx_b, the arm being the edge between the other two corners
        arm = self._pressure * (corners[c] - corners[d])  # [6, 3, B, T]
        blocks = self._bulk * normals[a][:, :, None] * normals[b][:, None]  # [6, 3, 3, B, T]
        for k, i, j in ((0, 2, 1), (1, 0, 2), (2, 1, 0)):
            blocks[:, i, j] += arm[:, k]
            blocks[:, j, i] -= arm[:, k]
        rest = self.rest[..., :6].movedim(-1, 0)
        blocks.diagonal(dim1=1, dim2=2).add_(((self.h * self.h) * self.mu * rest)[..., None])
        blocks = blocks.permute(3, 4, 0, 1, 2)
        return torch.cat([blocks, blocks.transpose(-1, -2)], 2).flatten(-2)

    def _corner_normals(self) -> Tensor:
        """Derivatives of six volumes with respect to the four corners, [4, 3, B, T]."""
        return torch.cat([-self.normals.sum(0, keepdim=True), self.normals])

    def dependence(self, w: Tensor, wants: Sequence[bool]) -> list[Tensor | None]:
        """Gradient of -w . dG/dx, with w fixed and zero where pinned, with respect to what G depends on.

        wants: for x_start, x_prev, y, mu, lam, mass, rest, energy_data, lam and c6 that patches average, couplings. The
        first is zero and left to the caller.
        """
        h2 = self.h * self.h
        out: list[Tensor | None] = [None] * DEPENDS
        f = self._edges_of(w)
        bent = (self.normals * f).sum(0).sum(0) / 6  # d(V J) along w, over c6 V = 1/6
        if wants[2]:
            out[2] = self.mass * w
        if wants[5]:
            out[5] = -(w * (self.x - self.y)).sum(-1)
        if self.own is not None:
            out[3], out[4] = torch.zeros_like(self.mu), torch.zeros_like(self.lam)
            if wants[6]:
                out[6] = self.own.of_rest(ops.tet_gather(w, *self.model._topology))
        elif wants[3] or wants[6]:
            corners = [torch.cat([torch.zeros_like(a[:1]), a]) for a in (self.edges, f)]
            stretch = [((corners[0][a] - corners[0][b]) * (corners[1][a] - corners[1][b])).sum(0) for a, b in PAIRS]
            k = self.rest[..., :6].unbind(-1)
            if wants[3]:
                sheared = sum(scalar * s for scalar, s in zip(k, stretch, strict=True))
                out[3] = h2 * (sheared - (self.ratio - 2) * bent)
            if wants[6]:
                shape = torch.broadcast_shapes(bent.shape, self.c6.shape)
                of_c6 = -h2 * (self.mu + self.lam) * (self.ratio / self.c6) * bent
                columns = [h2 * self.mu * s for s in stretch] + [of_c6]
                out[6] = torch.stack([c.expand(shape) for c in columns], -1)
        if wants[4] and self.own is None:
            out[4] = -h2 * (self.ratio - 1) * bent
        if self.patches is not None and (wants[8] or wants[9]):
            out[8], out[9] = self.patches.dependence(bent)
        if self.coupled is not None and wants[10]:
            out[10] = self.coupled.dependence(w)
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
        inputs = data.split(sizes, -1) if energies else ()
        return [
            (e, part if e.per_vertex else of_vertices(part, self.x)) for e, part in zip(energies, inputs, strict=True)
        ]


class _PatchTerms:
    """h^2 sum over patches of L / 2 (J_P - 1)^2, L = sum V lam, at one state, in place of what lam does in their tets
    (model/patches.py)."""

    def __init__(self, at: IncrementalPotential, averaged: Averaged) -> None:
        assert at.model.patches is not None
        self.at, self.of = at, at.model.patches
        self.det = at.ratio / at.c6
        shape = self.det.shape
        self.lam, self.c6 = (ops.broadcast(t, shape) for t in averaged)
        volume = 1 / (6 * self.c6)
        self.volume, self.weight = self.of.sum(volume), self.of.sum(volume * self.lam)  # of patches [m^3], [J]
        self.ratio = self.of.sum(self.det / 6) / self.volume  # J_P

    @cached_property
    def slopes(self) -> Tensor:
        """Derivative of the volume of each patch with respect to each of its vertices [m^2], [B, N, 3]."""
        normals = self.at._corner_normals().permute(2, 3, 0, 1) / 6
        return self.of.of_corners.sum(normals.flatten(1, 2))

    @property
    def stiffness(self) -> Tensor:
        """h^2 times the second derivative with respect to the volume of each patch [kg/m^4], [B, P]."""
        return self.at.h**2 * self.weight / self.volume**2

    def product(self, w: Tensor) -> Tensor:
        """Part of the Hessian that is of rank one in each patch, times w."""
        along = self.of.members.sum((self.slopes * self.of.of_vertices.gather(w)).sum(-1, keepdim=True))
        return self.of.of_vertices.sum(self.of.members.gather(self.stiffness[..., None] * along) * self.slopes)

    @cached_property
    def diagonal(self) -> Tensor:
        """Its blocks on the diagonal, [B, V, 3, 3]."""
        scaled = self.of.members.gather(self.stiffness[..., None]) * self.slopes
        outer = scaled[..., :, None] * self.slopes[..., None, :]
        return self.of.of_vertices.sum(outer.flatten(-2)).unflatten(-1, (3, 3))

    def dependence(self, bent: Tensor) -> tuple[Tensor, Tensor]:
        """Gradient of -w . dE/dx with respect to lam and c6 of each tet, [B, T]; bent: d(V J) along w."""
        with torch.enable_grad():
            lam, c6 = (t.detach().clone().requires_grad_() for t in (self.lam, self.c6))
            volume = 1 / (6 * c6)
            total = self.of.sum(volume)
            strain = self.of.sum(self.det.detach() / 6) / total - 1
            along = self.of.sum(volume * lam) * strain * self.of.sum(bent.detach()) / total
            of_tets = lam * (c6 * self.det.detach() - 1) * bent.detach()
            of_lam, of_c6 = torch.autograd.grad(-(self.at.h**2) * (along.sum() - of_tets.sum()), (lam, c6))
        return of_lam, of_c6


class _CouplingTerms:
    """h^2 times the energies of couplings at one state, whose gradient autograd differentiates."""

    def __init__(self, at: IncrementalPotential, given: Tensor) -> None:
        with torch.enable_grad():
            self.x, self.given = (t.detach().requires_grad_() for t in (at.x, given))
            where = self.x if at.origin is None else self.x + at.origin
            load = at.h * at.h * load_of(at.model.couplings, values_of(at.model, self.given, len(where)), where)
            self._slope, bound = load.split((3, 1), -1)
        self.gradient = self._slope.detach()  # [kg m], [B, V, 3], rows of pinned vertices included
        self.diagonal = torch.diag_embed(bound.detach().expand_as(self.gradient))  # bound of the blocks, [B, V, 3, 3]

    def product(self, w: Tensor) -> Tensor:
        # the Hessian is symmetric: a product with its transpose is one with it
        return torch.autograd.grad(self._slope, self.x, w, retain_graph=True)[0]

    def dependence(self, w: Tensor) -> Tensor:
        """Gradient of -w . dE/dx with respect to the parameters, [1 | B, n]."""
        return torch.autograd.grad(self._slope, self.given, -w, retain_graph=True)[0]


def values_of(model: System, couplings: Tensor, scenes: int) -> list[dict[str, Tensor]]:
    """The parameters of each coupling by key [B, ...], from those of all in one row [1 | B, n]."""
    out, first = [], 0
    couplings = ops.broadcast(couplings, (scenes, couplings.shape[1]))
    for energy in model.couplings:
        out.append({})
        for key, own in model.constants(energy).items():
            out[-1][key] = couplings[:, first : first + own.numel()].unflatten(1, own.shape)
            first += own.numel()
    return out


def of_vertices(data: Tensor, x: Tensor) -> Tensor:
    """Data of a scene [1 | B, n] for each vertex of x [B, V, 3], [B, V, n]; its gradient is summed in a fixed order."""
    return ops.broadcast(data[:, None], (*x.shape[:2], data.shape[-1]))


# --- increase of the incremental potential of each body from one state to another, without grad -----------------------


class IncreaseInputs(NamedTuple):
    """Common data of the comparisons of the potential in one step."""

    model: System
    fields: ops.SweepFields  # detached; where the sweeps start does not enter
    material: Tensor  # [1 | B, blocks, 2, 8], mu and lam of the tets by body [Pa]
    rest: Tensor  # [1 | B, blocks, 7, 8]
    time_step: float
    averaged: Averaged | None  # of a Model with patches, whose part material has not
    energies: int  # which operators, see ops.library_of

    @property
    def bodies(self) -> MovingBodies:
        return bodies_of(self.model)

    def admits(self, x: Tensor, to: Tensor) -> Tensor:
        """Whether the potential of each body lets it go from x to ``to`` [B, V, 3]: it does not rise by more than
        rounding, is a number, and ``to`` is not too near a plane; bool [B, bodies]."""
        increase, size = increase_of_bodies(self, x, to).unbind(-1)
        # a difference, also where both are infinite; False where it is not a number
        return torch.sub(increase, size, alpha=ROUNDINGS * torch.finfo(x.dtype).eps) <= 0

    def increases_potential(self, x: Tensor, to: Tensor) -> Tensor:
        """Vertices of bodies whose potential does not let them go from x to ``to``, bool [B, V]."""
        admitted, bodies = self.admits(x, to), self.bodies
        if bodies.number == 0:
            return admitted.new_zeros(x.shape[:2])
        moves, of = self.model.derived("moving_body", lambda: (bodies.of < bodies.number, bodies.of % bodies.number))
        return moves > admitted[:, of]  # moves and not admitted, in one launch


def bodies_of(model: System) -> MovingBodies:
    """The bodies that move: of a Model whose steps have no use for them, made at the first call."""
    if hasattr(model, "_moving"):
        return model._moving
    return model.derived("moving_bodies", lambda: moving_bodies(
        model._rest_points.cpu().double(), model._topology[0].cpu(), model._pinned.cpu(),
        bool(model.energy_mask & ELASTIC)).to(model.device, model.dtype))  # fmt: skip


def increase_inputs(model: System, fields: ops.SweepFields, time_step: float, averaged: Averaged | None = None,
                    energies: int | None = None) -> IncreaseInputs:  # fmt: skip
    """fields, averaged: as of IncrementalPotential.  energies: Of the step's settings; None: the Model's."""
    # contiguous: a state may be expanded over scenes
    fields = ops.SweepFields(*(t if t is None else t.detach().contiguous() for t in fields))  # pyright: ignore
    if model.patches is not None:
        rest = model.rest_scalars if fields.rest is None else fields.rest
        averaged = Averaged(fields.lam, rest[..., 6]) if averaged is None else Averaged(*(t.detach() for t in averaged))
        fields = replaced(fields, lam=fields.lam - averaged.lam)
    moving = bodies_of(model)
    blocks, lanes = moving.tet.shape
    counts = fields.mu.shape[0], fields.lam.shape[0]
    scenes = max(counts) if min(counts) else 0  # a modulus of no scenes leaves none
    material = fields.mu.new_empty((scenes, blocks, 2, lanes))
    for i, modulus in enumerate((fields.mu, fields.lam)):
        material[:, :, i] = modulus[..., None] if modulus.shape[1] == 1 else modulus[:, moving.tet]
    rest = moving.rest if fields.rest is None else fields.rest[:, moving.tet].transpose(-1, -2).contiguous()
    energies = model.energy_mask if energies is None else energies
    return IncreaseInputs(model, fields, material, rest, time_step, averaged, energies)


def increase_of_bodies(inputs: IncreaseInputs, x: Tensor, to: Tensor) -> Tensor:
    """Increase of the potential of each body from x to ``to`` [B, V, 3] [kg m^2, times h^2], and the sum of the sizes
    of its terms, float64 [B, bodies, 2]; infinite where a vertex would lose more of a gap than a step may."""
    model, moving, f = inputs.model, inputs.bodies, inputs.fields
    origin = x.new_empty((0,)) if f.origin is None else f.origin
    index = (moving.order, moving.ptr, model._other_bodies.of, moving.corner, moving.block_ptr)
    operators = ops.library_of(inputs.energies)
    out = operators.potential_increase(x, to.contiguous(), f.x_prev, f.y, f.mass, f.energy_data, origin,
                                         inputs.material, inputs.rest, *index, list(model._data_count),
                                         inputs.time_step)  # fmt: skip
    return out if inputs.averaged is None else out + _increase_of_patches(inputs, inputs.averaged, x, to)


def _increase_of_patches(inputs: IncreaseInputs, averaged: Averaged, x: Tensor, to: Tensor) -> Tensor:
    """The part of increase_of_bodies() that is that of patches."""
    model, bodies = inputs.model, inputs.bodies
    patches = model.patches
    assert patches is not None

    def by_body() -> Rows:
        vertex = torch.where(model._pinned, -1, bodies.of)[model.tets].amax(1)  # -1: nothing of a tet moves
        body = torch.full((len(patches.of_tets.ptr) - 1,), -1, device=vertex.device)
        body = body.scatter_reduce(0, patches.label, vertex, "amax")
        return Rows.of(torch.where(body < 0, bodies.number, body), bodies.number)

    rows: Rows = model.derived("bodies of patches", by_body)
    # from displacements: the rounding of edges would be that of a step of 1e-16 times the body
    corners, steps = (ops.tet_gather(t, *model._topology) for t in (x.double(), to.double() - x.double()))
    e, f = (c[..., 1:, :] - c[..., :1, :] for c in (corners, steps))
    n = e + f

    def det(a: Tensor, b: Tensor, c: Tensor) -> Tensor:
        return (a * torch.linalg.cross(b, c)).sum(-1)

    # the change itself, which no rounding of the volumes drowns
    change = (det(f[..., 0, :], n[..., 1, :], n[..., 2, :]) + det(e[..., 0, :], f[..., 1, :], n[..., 2, :])
              + det(e[..., 0, :], e[..., 1, :], f[..., 2, :]))  # fmt: skip
    lam, c6 = (ops.broadcast(t.double(), change.shape) for t in averaged)
    volume = 1 / (6 * c6)
    total, weight = patches.sum(volume), inputs.time_step**2 * patches.sum(volume * lam)
    strain = patches.sum(det(*e.unbind(-2)) / 6) / total - 1
    change = patches.sum(change / 6) / total
    more = weight * change * (strain + change / 2)
    size = weight * change.abs() * (1 + strain.abs() + change.abs())
    return rows.sum(torch.stack([more, size], -1))
