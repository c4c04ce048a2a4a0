"""The coarse correction of bodies that touch: the functions of all bodies of a scene moved together by one Newton step,
whose matrix has, beside inertia and stiffness at rest, what pairs and floors press back with.

    (P'MP + h^2 sum of R_g K_g R_g' + P'(blocks of pairs, friction and vertex energies)P) a = P' dG,    x <- x - s P a

Without those blocks stiff contact leaves lengths s next to nothing (docs/method.md, section 16).
"""

# pyright: reportIncompatibleMethodOverride=false
from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd import Function

from .. import ops
from ..adjoint.contact_lag import sum_at_corners
from ..adjoint.potential import IncrementalPotential
from ..model.system import System
from ..ops.sums import Order, of_segments, one_thread, sum_by, sum_segments
from ..tuples import replaced
from .rigid_terms import Scenes, corners_of, pair_terms, vertex_blocks, vertex_gradient
from .trials import Trials

REFUSALS = 2  # corrections of a set without an admissible length, after which a part makes no more of it


class Space(NamedTuple):
    """The functions W [V, F] of a Model, row by row, and of which body they are; constants."""

    vertex: Tensor  # int64 [entries]
    function: Tensor  # int64 [entries]
    by_vertex: Order  # of the entries
    by_function: Order
    weight: Tensor  # [entries]
    body: Tensor  # int64 [F], of those that move; their number where a function only fills up
    of_coarse: Tensor  # int64 [coarse bodies], the moving body of each
    dense: Tensor  # int64 [9 cells], where the packed matrices of all bodies stand in one [3F, 3F]
    functions: int

    def restricted(self, g: Tensor) -> Tensor:
        """P' g: [B, V, 3] -> [B, F, 3]."""
        return sum_segments(self.weight[:, None] * of_segments(g, *self.by_vertex), *self.by_function)

    def prolonged(self, a: Tensor) -> Tensor:
        """P a: [B, F, 3] -> [B, V, 3]."""
        return sum_segments(self.weight[:, None] * of_segments(a, *self.by_function), *self.by_vertex)


def space_of(model: System) -> Space:
    return model.derived("contact_space", lambda: _space(model))


def _space(model: System) -> Space:
    g, moving = model.coarse_geometry, model._moving
    vertex, function = (torch.from_numpy(a).to(model.device, torch.int64) for a in (g.vertex, g.function))
    weight = torch.from_numpy(g.weight).to(model.device, model.dtype)
    body = torch.full((g.functions,), moving.number, device=model.device)
    body[function] = moving.of[vertex]
    ptr = torch.from_numpy(g.function_ptr).to(model.device, torch.int64)
    dense = []
    for first, last in zip(g.function_ptr[:-1].tolist(), g.function_ptr[1:].tolist(), strict=True):
        rows = torch.arange(3 * first, 3 * last)
        dense.append((3 * g.functions * rows[:, None] + rows).reshape(-1))
    orders = (_order(vertex, model.num_vertices), _order(function, g.functions))
    return Space(
        vertex, function, *orders, weight, body, body[ptr[:-1]], torch.cat(dense).to(model.device), g.functions
    )


def _order(index: Tensor, count: int) -> Order:
    ordered, order = torch.sort(index, stable=True)
    ptr = torch.searchsorted(ordered, torch.arange(count + 1, device=index.device))
    return order.to(torch.int32), ptr.to(torch.int32), index


class Corrections:
    """The coarse corrections of one part of a step; ``packed``: the matrices of all bodies, differentiable."""

    def __init__(self, trials: Trials, fields: ops.SweepFields, packed: Tensor, scenes: Scenes) -> None:
        self.trials, self.fields, self.packed, self.scenes = trials, fields, packed, scenes
        self.constants = replaced(fields, **{k: None if t is None else t.detach() for k, t in fields._asdict().items()})
        if fields.rest is None:  # made on first use, which must not be in a backward that is being compiled
            self.constants = replaced(self.constants, rest=scenes.model.rest_scalars)
        self.space = space_of(scenes.model)
        self.matrix = _dense(packed.detach(), self.space)
        self.refused = torch.zeros_like(trials.bodies.ptr[:-1])[None]
        self.set_of = trials.bodies.of_body[:, self.space.body]  # of each function [B, F]

    def correct(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """x [B, V, 3] after a correction, and its length for each body of the coarse space [B, bodies]."""
        over = self.refused >= REFUSALS
        if not x.is_cuda and bool(over.all()):
            return x, self._of_bodies(torch.zeros_like(over, dtype=x.dtype))
        r, presses = self._gradient(x)
        with torch.no_grad():
            a = self._solved(presses, r)
            way = -self.space.prolonged(a)
            slope = sum_by(-(r * a).sum(-1).reshape(-1, 1).double(), self.set_of.reshape(-1), over.shape[1] + 1)[:-1, 0]
            length = torch.where(over | self._lost(), 0.0, self.trials.lengths(x, way, slope))
            self.refused = self.refused + (length == 0)
        if torch.is_grad_enabled():
            way = -self.space.prolonged(self._differentiable(a, r, presses))
        of_vertex = torch.cat([length, length.new_zeros((1, 1))], 1)[0][self.trials.bodies.of].reshape(*x.shape[:2], 1)
        return torch.where(of_vertex > 0, x + of_vertex * way, x), self._of_bodies(length)

    def _of_bodies(self, length: Tensor) -> Tensor:
        return length[0][self.trials.bodies.of_body[:, self.space.of_coarse]]

    def _gradient(self, x: Tensor) -> tuple[Tensor, list[_Press]]:
        """P' dG [B, F, 3], and what presses back."""
        s, f = replaced(self.scenes, fields=replaced(self.scenes.fields, x=x)), self.fields
        force = _Elastic.apply(x, f.mu, f.lam, f.rest, self.constants, s.model, s.time_step) + vertex_gradient(s)
        scenes, vertices = x.shape[:2]
        presses = []
        blocks = vertex_blocks(s)
        if blocks is not None:
            presses.append(_at_vertices(blocks))
        for terms in pair_terms(s):
            scene, corners = corners_of(terms.listed)
            moves = corners < vertices
            rows = vertices * scene + torch.where(moves, corners, 0)  # what does not move is of its scene, too
            weights = torch.where(moves, terms.weights, 0.0)
            pulled = terms.weights[..., None] * terms.force[:, None]
            if terms.at_corners is not None:
                pulled = pulled + terms.at_corners
            force = force + sum_at_corners(pulled, terms.listed, scenes, s.fields.body.shape[0])[:, :vertices]
            presses.append(_Press(rows, weights, terms.stiffness))
        return self.space.restricted(force), presses

    def _solved(self, presses: list[_Press], r: Tensor) -> Tensor:
        """a [B, F, 3]; keeps the factor, in double precision: single has no room for the range of stiffnesses."""
        scenes, unknowns = r.shape[0], 3 * self.space.functions
        matrix = self.matrix.expand(scenes, unknowns, unknowns).double()
        for press in presses:
            matrix = matrix + press.assembled(self.space, scenes, self.scenes.fields.x_prev.shape[1])
        with one_thread(matrix):
            factor = torch.linalg.cholesky_ex(matrix)[0]
        # of a matrix that is not positive definite no correction comes, and nothing goes back through it
        self.solved = torch.isfinite(factor).flatten(1).all(1)[:, None, None]
        self.cholesky = torch.where(self.solved, factor, torch.eye(unknowns, dtype=factor.dtype, device=r.device))
        return self._back(r)

    def _lost(self) -> Tensor:
        """The sets of scenes without a correction, bool [sets]."""
        lost = (~self.solved[:, :, 0]).expand(self.set_of.shape).double()
        return sum_by(lost.reshape(-1, 1), self.set_of.reshape(-1), self.refused.shape[1] + 1)[:-1, 0] > 0

    def _back(self, r: Tensor) -> Tensor:
        right = torch.where(self.solved, r, 0.0).double().reshape(r.shape[0], -1, 1)
        return _Back.apply(self.cholesky, right).reshape(r.shape).to(r.dtype)

    def _differentiable(self, a: Tensor, r: Tensor, presses: list[_Press]) -> Tensor:
        """a with its derivatives: one more step, r - A a being zero, with the matrix as it was. It has no length, even
        where it would have one, because the matrix is nearly singular: what was judged is what is done."""
        pushed = _Product.apply(self.packed, a, self.space)
        way = self.space.prolonged(a)
        for press in presses:
            pushed = pushed + self.space.restricted(press.product(way))
        step = self._back(r - pushed)
        return a + (step - step.detach())


class _Press(NamedTuple):
    """Stiffness against motions sum_k w_k x_k of some vertices."""

    rows: Tensor  # int64 [n, k], among the vertices of all scenes
    weights: Tensor  # [n, k]
    stiffness: Tensor  # [n, 3, 3], times h^2

    def product(self, way: Tensor) -> Tensor:
        """[B, V, 3] -> [B, V, 3]"""
        flat = way.flatten(0, 1)
        moved = (self.weights[..., None] * flat[self.rows]).sum(1)
        force = (self.stiffness * moved[:, None]).sum(-1)
        pulled = self.weights[..., None] * force[:, None]
        return sum_by(pulled.reshape(-1, 3), self.rows.reshape(-1), len(flat)).reshape(way.shape)

    def assembled(self, space: Space, scenes: int, vertices: int) -> Tensor:
        """P' H P [B, 3F, 3F]."""
        dense = torch.zeros((vertices, space.functions), dtype=space.weight.dtype, device=space.weight.device)
        dense[space.vertex, space.function] = space.weight
        moved = (self.weights[..., None] * dense[self.rows % vertices]).sum(1)  # [n, F]
        scene, out = self.rows[:, 0] // vertices, []
        for n in range(scenes):
            own = torch.where((scene == n)[:, None], moved, 0.0) if scenes > 1 else moved
            with one_thread(own):
                upper = {(i, j): own.mT @ (self.stiffness[:, i, j, None] * own) for i in range(3) for j in range(i, 3)}
            blocks = [torch.stack([upper[min(i, j), max(i, j)] for j in range(3)], -1) for i in range(3)]
            out.append(torch.stack(blocks, 1).reshape(3 * space.functions, -1))
        return torch.stack(out)


def _at_vertices(blocks: Tensor) -> _Press:
    """Of blocks [B, V, 3, 3]; where values may decide sizes, of those that are not zero."""
    flat = blocks.flatten(0, 1)
    rows = torch.arange(len(flat), device=flat.device)
    if not flat.is_cuda:
        rows = (flat != 0).flatten(1).any(1).nonzero()[:, 0]
        flat = flat[rows]
    return _Press(rows[:, None], torch.ones_like(flat[:, :1, 0]), flat)


def _dense(packed: Tensor, space: Space) -> Tensor:
    """The matrices of all bodies as one [B, 3F, 3F]."""
    unknowns = 3 * space.functions
    out = packed.new_zeros((len(packed), unknowns * unknowns))
    out[:, space.dense] = packed
    return out.reshape(-1, unknowns, unknowns)


class _Back(Function):
    """(L L')^-1 b of a factor that is a constant."""

    @staticmethod
    def forward(factor: Tensor, right: Tensor) -> Tensor:
        with one_thread(factor):
            half = torch.linalg.solve_triangular(factor, right, upper=False)
            return torch.linalg.solve_triangular(factor.mT, half, upper=True)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: Tensor) -> None:
        ctx.save_for_backward(inputs[0])

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple:
        return None, _Back.apply(*ctx.saved_tensors, grads[0])


class _Product(Function):
    """A a [B, F, 3] of the matrices without presses."""

    @staticmethod
    def forward(packed: Tensor, a: Tensor, space: Space) -> Tensor:
        matrix = _dense(packed, space)
        with one_thread(matrix):
            return (matrix @ a.reshape(len(a), -1, 1)).reshape(a.shape)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: Tensor) -> None:
        packed, a, ctx.space = inputs
        ctx.shape = packed.shape
        ctx.save_for_backward(a)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple:
        (a,) = ctx.saved_tensors
        unknowns = 3 * ctx.space.functions
        row, column = ctx.space.dense // unknowns, ctx.space.dense % unknowns
        bar = grads[0].reshape(len(a), -1)[:, row] * a.reshape(len(a), -1)[:, column]
        return ops.sum_to(bar, ctx.shape), None, None


class _Elastic(Function):
    """The gradient of the tets' energy times h^2 [B, V, 3]."""

    @staticmethod
    def forward(
        x: Tensor, mu: Tensor, lam: Tensor, rest: Tensor | None, fields: Any, model: System, h: float
    ) -> Tensor:
        return IncrementalPotential(model, x, fields, h).elastic()

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: Tensor) -> None:
        x, mu, lam, rest, ctx.fields, ctx.model, ctx.h = inputs
        ctx.shapes = [None if t is None else t.shape for t in (mu, lam, rest)]
        ctx.save_for_backward(x)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple:
        (x,) = ctx.saved_tensors
        w, needs = grads[0].contiguous(), ctx.needs_input_grad
        potential = IncrementalPotential(ctx.model, x, ctx.fields, ctx.h)
        bars = potential.dependence(w, (False, False, False, needs[1], needs[2], False, needs[3], False))
        bars = [None if bar is None else ops.sum_to(-bar, shape)
                for bar, shape in zip((bars[3], bars[4], bars[6]), ctx.shapes, strict=True)]  # fmt: skip
        return potential.elastic_product(w) if needs[0] else None, *bars, None, None, None
