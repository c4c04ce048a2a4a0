"""Vertex Block Descent as a composition of block updates: one color of a Model is one update. Plain torch."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from .._common.checks import check_broadcast, check_kind, check_tensor, check_time_step, fail, name_value
from .._common.constants import SATURATION_EPS
from ..energies import StableNeoHookean
from ..model.material import rest_metric
from ..model.model import Model
from ..model.solver import VBD
from .compose import Bars, BlockUpdate, Solver, Tensors, _tensors
from .particles import FixedSum, check_finite, dot, placed

# (j, k, l) such that (j, i, k, l) is an even permutation of the corners, for i = 0, 1, 2, 3
_OTHERS = torch.tensor([[1, 3, 2], [0, 2, 3], [0, 3, 1], [0, 1, 2]], device="cpu")
_EDGES = {(0, 1): 0, (0, 2): 1, (0, 3): 2, (1, 2): 3, (1, 3): 4, (2, 3): 5}  # columns of rest_metric
_COLUMNS = torch.tensor(
    [[_EDGES[min(i, a), max(i, a)] for a in o] for i, o in enumerate(_OTHERS.tolist())], device="cpu"
)


@dataclass(frozen=True)
class Block:
    """Gradient and Hessian block of the n vertices of a color, and what their P (vertex, tet) pairs were made of.

    Source: docs/method.md, section 2; a tet seen from its vertex i, whose other vertices are j, k, l.
    """

    mass: Tensor  # m_i [..., n, 1]
    offset: Tensor  # x_i - y_i [..., n, 3]
    gradient: Tensor  # g [..., n, 3]
    hessian: Tensor  # H [..., n, 3, 3]
    mu: Tensor  # of each pair [..., P, 1]; lb = lam + mu, lh: what stands along n in the block
    lb: Tensor
    lh: Tensor
    normal: Tensor  # n = (x_k - x_j) x (x_l - x_j) [..., P, 3]
    spoke: Tensor  # D = x_i - x_j
    edge_k: Tensor  # x_k - x_j
    edge_l: Tensor  # x_l - x_j
    stretch: Tensor  # V F grad N_i = sum over a of k_ia (x_a - x_i)
    det: Tensor  # J [..., P, 1]


@dataclass
class PairBars:
    """Gradient of phi = p . (g + H d_raw) per (vertex, tet) pair, without h^2; None stands for zero."""

    own: Tensor  # with respect to x_i [..., P, 3]
    normal: Tensor  # n
    stretch: Tensor | None  # V F grad N_i
    mu: Tensor  # [..., P, 1]
    lam: Tensor


class VertexBlock(BlockUpdate):
    """Newton update of all vertices of one color, with the hand-derived adjoint of the paper.

    State: (x,), positions [m], [..., V, 3]. Parameters: (y, mu, lam, mass): predictor [m] [..., V, 3], Lame parameters
    [Pa] that broadcast to [..., T], masses [kg] that broadcast to [..., V].

    ``saturation_vjp``, ``gradient_tangent`` and ``hessian_tangent`` are the three parts of the adjoint, each a method
    of its own so that a subclass can leave one out.

    Source: paper, eqs. 2-3 and 7-13; docs/method.md, sections 2, 3 and 5.
    """

    def __init__(self, model: Model, solver: VBD, vertices: Tensor) -> None:
        check_elastic(model)
        self.vertices, self.rows = vertices, (vertices,)
        self.factor = check_time_step(solver.time_step, model.mass.dtype) ** 2
        self.exact = solver.block == "exact"
        self.relaxation, self.saturation = solver.relaxation, solver.saturation
        self.regularization = solver.regularization
        self.num_vertices, self.num_tets = model.num_vertices, model.num_tets
        self._pairs(model, vertices)

    def _pairs(self, model: Model, vertices: Tensor) -> None:
        """Indices and rest scalars of the pairs of a vertex of this color and a tet around it."""
        device = vertices.device
        position = torch.full((model.num_vertices,), -1, dtype=torch.int64, device=device)
        position[vertices] = torch.arange(vertices.numel(), device=device)
        # No tet has two vertices of one color, so a tet makes one pair at most.
        self.tet, local = (position[model.tets] >= 0).nonzero(as_tuple=True)
        # The other corners in an order that makes J positive at rest from each of the four vertices.
        corners = model.tets[self.tet]
        self.i = corners.gather(1, local[:, None])[:, 0]
        self.j, self.k, self.l = corners.gather(1, _OTHERS.to(device)[local]).unbind(1)
        rest = rest_metric(model.rest_points[corners][None])[0][0]
        self.weights = rest.gather(1, _COLUMNS.to(device)[local])  # k_ij, k_ik, k_il [P, 3]
        self.k_ii = -self.weights.sum(1, keepdim=True)
        self.c6 = rest[:, 6:]
        self.owner = position[self.i]
        self.to_block = FixedSum(self.owner, vertices.numel())
        self.to_vertices = FixedSum(torch.cat((self.i, self.j, self.k, self.l)), model.num_vertices)
        self.to_tets = FixedSum(self.tet, model.num_tets)

    def assemble(self, x: Tensor, y: Tensor, mu: Tensor, lam: Tensor, mass: Tensor) -> Block:
        """Gradient [N s^2] and block [kg] of every vertex of the color at the state x; arguments as in the class."""
        mu, lam = (m.expand(*m.shape[:-1], self.num_tets)[..., self.tet, None] for m in (mu, lam))
        lb = lam + mu
        lh = lb if self.exact else lam
        xi, xj, xk, xl = (x[..., index, :] for index in (self.i, self.j, self.k, self.l))
        edge_k, edge_l, spoke = xk - xj, xl - xj, xi - xj
        normal = torch.linalg.cross(edge_k, edge_l)
        det = self.c6 * dot(normal, spoke)
        w_j, w_k, w_l = self.weights.split(1, 1)
        stretch = w_j * (xj - xi) + w_k * (xk - xi) + w_l * (xl - xi)
        gradient = mu * stretch + (lb * (det - 1) - mu) / 6 * normal
        # J is linear in x_i, so the exact block of a tet has no term with its second derivative.
        eye = torch.eye(3, dtype=x.dtype, device=x.device)
        outer = normal[..., :, None] * normal[..., None, :]
        block = (mu * self.k_ii)[..., None] * eye + (lh * self.c6 / 6)[..., None] * outer
        m = mass.expand(*mass.shape[:-1], self.num_vertices)[..., self.vertices, None]
        offset = x[..., self.vertices, :] - y[..., self.vertices, :]
        gradient = m * offset + self.factor * self.to_block(gradient)
        block = self.factor * self.to_block(block.flatten(-2)).unflatten(-1, (3, 3))
        # Regularization stands in the block only: it shortens the update, and does not move its fixed point.
        block = (m + self.regularization)[..., None] * eye + block
        return Block(m, offset, gradient, block, mu, lb, lh, normal, spoke, edge_k, edge_l, stretch, det)

    def update(self, state: Tensors, parameters: Tensors) -> Bars:
        (x,) = state
        block = self.assemble(x, *_shaped(parameters))
        raw = -_solve(block.hessian, block.gradient)
        return (x[..., self.vertices, :] + self.relaxation * self.saturated(raw),)

    def saturated(self, raw: Tensor) -> Tensor:
        """s d_raw with s = c / (|d_raw| + c + eps)."""
        return raw if self.saturation is None else _scale(raw, self.saturation) * raw

    def vjp(self, state: Tensors, rows_bar: Bars, parameters: Tensors) -> tuple[Bars, Bars]:
        (x,), (out_bar,) = state, rows_bar
        assert out_bar is not None
        y, mu, lam, mass = _shaped(parameters)
        block = self.assemble(x, y, mu, lam, mass)
        raw = -_solve(block.hessian, block.gradient)
        p = _solve(block.hessian, self.saturation_vjp(self.relaxation * out_bar, raw))
        pair_p, pair_raw = p[..., self.owner, :], raw[..., self.owner, :]
        one, two = self.gradient_tangent(block, pair_p), self.hessian_tangent(block, pair_p, pair_raw)
        pairs = PairBars(one.own + two.own, one.normal + two.normal, one.stretch, one.mu + two.mu, one.lam + two.lam)

        rows = self.vertices
        inertia = placed(block.mass * p, rows, self.num_vertices)
        x_bar = placed(out_bar, rows, self.num_vertices) - inertia - self.factor * self.scatter(block, pairs)
        mass_bar = placed(-dot(block.offset + raw, p)[..., 0], rows, self.num_vertices, dim=-1)
        mu_bar, lam_bar = (-self.factor * self.to_tets(bar)[..., 0] for bar in (pairs.mu, pairs.lam))
        return (x_bar,), (inertia, mu_bar, lam_bar, mass_bar)

    def saturation_vjp(self, z: Tensor, raw: Tensor) -> Tensor:
        """Adjoint of d_raw [..., n, 3] from that of the saturated update (paper, eq. 13)."""
        if self.saturation is None:
            return z
        s = _scale(raw, self.saturation)
        # s changes with the length of d_raw; at length 0, where that has no derivative, the factor d_raw is 0
        length = torch.linalg.vector_norm(raw, dim=-1, keepdim=True)
        direction = torch.where(length > 0, raw / torch.where(length > 0, length, 1.0), 0.0)
        return s * z - s**2 / self.saturation * dot(raw, z) * direction

    def gradient_tangent(self, b: Block, p: Tensor) -> PairBars:
        """From p . g with n and x_i independent (stage 1 of the paper)."""
        np = dot(b.normal, p)
        volume = b.lb * self.c6 / 6 * np
        return PairBars(
            own=volume * b.normal,
            normal=((b.lb * (b.det - 1) - b.mu) / 6) * p + volume * b.spoke,
            stretch=b.mu * p,
            mu=dot(b.stretch, p) + (b.det - 2) / 6 * np,
            lam=(b.det - 1) / 6 * np,
        )

    def hessian_tangent(self, b: Block, p: Tensor, raw: Tensor) -> PairBars:
        """From p . H d_raw (stage 2): the block depends on the state through n only."""
        np, nd = dot(b.normal, p), dot(b.normal, raw)
        along = self.c6 / 6 * np * nd
        return PairBars(
            own=torch.zeros_like(p),
            normal=b.lh * self.c6 / 6 * (nd * p + np * raw),
            stretch=None,
            mu=self.k_ii * dot(raw, p) + (along if self.exact else 0.0),
            lam=along,
        )

    def scatter(self, b: Block, pairs: PairBars) -> Tensor:
        """Gradient of phi with respect to the positions of all vertices, [..., V, 3]."""
        to_k = torch.linalg.cross(b.edge_l, pairs.normal)
        to_l = torch.linalg.cross(pairs.normal, b.edge_k)
        to_i = pairs.own
        # phi depends on differences of positions only: what the four vertices get sums to zero
        to_j = -(to_i + to_k + to_l)
        if pairs.stretch is not None:
            w_j, w_k, w_l = self.weights.split(1, 1)
            to_i, to_j = to_i + self.k_ii * pairs.stretch, to_j + w_j * pairs.stretch
            to_k, to_l = to_k + w_k * pairs.stretch, to_l + w_l * pairs.stretch
        return self.to_vertices(torch.cat((to_i, to_j, to_k, to_l), -2))


def vertex_block_descent(model: Model, solver: VBD, update: type[VertexBlock] = VertexBlock) -> Solver:
    """The sweep of :func:`diffvbd.step` as a composition of its colors.

    ``descent((x,), (y, mu, lam, mass), sweeps=K)`` equals the sweep that a step executes between predictor and
    velocity; shapes and units in :class:`VertexBlock`. For study and for comparison: it is many times slower than
    ``step``.

    Args:
        model: A Model whose only energy is StableNeoHookean, on any device.
        solver: Its time step, relaxation, block, saturation and regularization are taken.
        update: A subclass of VertexBlock to use in its place.

    Raises:
        TypeError: model is no Model, or solver no VBD.
        ValueError: model has other energies than one StableNeoHookean.
            In the solver's call, naming them: state or parameters of other shapes, or (looked at on the CPU only) not
            finite, mu < 0, mu + lam < 0, or a mass that is not > 0 where the Model is not pinned.
    """
    check_elastic(model)
    check_kind("solver", solver, VBD)
    if not (isinstance(update, type) and issubclass(update, VertexBlock)):
        raise TypeError(f"update: expected VertexBlock or a subclass, got {update!r}")
    bounds = model.color_ptr.tolist()
    colors = (model.color_vertices[a:b] for a, b in zip(bounds[:-1], bounds[1:], strict=True))
    return _ColorSolver(model, (update(model, solver, vertices) for vertices in colors))


class _ColorSolver(Solver):
    """Looks at its arguments once for all colors and sweeps."""

    def __init__(self, model: Model, updates: Iterable[BlockUpdate]) -> None:
        super().__init__(updates)
        self.model = model

    def __call__(
        self, state: Tensor | Sequence[Tensor], parameters: Tensor | Sequence[Tensor] = (), *, sweeps: int
    ) -> Any:
        model, tensors, given = self.model, _tensors("state", state), _tensors("parameters", parameters)
        if len(tensors) != 1:
            fail("state", "1 tensor (x)", len(tensors))
        if len(given) != 4:
            fail("parameters", "4 tensors (y, mu, lam, mass)", len(given))
        x, own = check_tensor("x", tensors[0], model.mass), (model.num_vertices, 3)
        lead = tuple(x.shape[:-2])
        shapes = {"y": own, "mu": (model.num_tets,), "lam": (model.num_tets,), "mass": own[:1]}
        for name, value in (("x", x), ("y", given[0])):
            if isinstance(value, Tensor) and value.shape[-2:] != own:
                fail(name, f"shape [..., {own[0]}, 3]", f"shape {list(value.shape)}")
        for (name, shape), value in zip(shapes.items(), given, strict=True):
            check_broadcast(name, check_tensor(name, value, model.mass), (*lead, *shape))
        if not x.is_cuda:  # on CUDA a look would wait for the device
            _check_values(model, x.detach(), *(t.detach() for t in given))
        return super().__call__(state, given, sweeps=sweeps)


def _check_values(model: Model, x: Tensor, y: Tensor, mu: Tensor, lam: Tensor, mass: Tensor) -> None:
    check_finite(x=x, y=y, lam=lam)
    name_value("mu", "finite numbers >= 0 Pa", mu, mu >= 0)
    name_value("lam", "mu + lam >= 0 Pa", mu + lam, mu + lam >= 0)
    # The block of a vertex without mass may be singular; those that are pinned have none.
    mass = mass.expand(*mass.shape[:-1], model.num_vertices)
    used = torch.where(model.pinned, 1.0, mass)
    name_value("mass", "finite numbers > 0 kg where not pinned", used, used > 0)


def check_elastic(model: Model) -> None:
    """Raises where a Model has other energies than the one that VertexBlock knows."""
    check_kind("model", model, Model)
    names = [type(energy).__name__ for energy in model.energies]
    if len(names) != 1 or not isinstance(model.energies[0], StableNeoHookean):
        fail("model", "a StableNeoHookean as its only energy", f"{names or 'none'}")
    if model.patches is not None:
        fail("model", "a StableNeoHookean without patches", repr(model.energies[0]))
    if model.rigid_bodies is not None:
        fail("model", "no rigid bodies", f"{len(model.rigid_bodies.numbers)}")


def _shaped(parameters: Tensors) -> Tensors:
    """y, mu, lam, mass; numbers for all tets or vertices as tensors of one entry."""
    y, *scalars = parameters
    return (y, *(s[None] if s.dim() == 0 else s for s in scalars))


def _solve(matrix: Tensor, rhs: Tensor) -> Tensor:
    return torch.linalg.solve(matrix, rhs[..., None])[..., 0]


def _scale(raw: Tensor, limit: float) -> Tensor:
    return limit / (torch.linalg.vector_norm(raw, dim=-1, keepdim=True) + limit + SATURATION_EPS)
