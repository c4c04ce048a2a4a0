"""Coarse corrections of bodies that couplings join (docs/method.md, section 21).

Bounds that are separable over vertices hide that bodies may move as a whole. A correction has the couplings
themselves: their gradient, their second derivative by the coarse functions of all bodies that they join, and what they
become along its step. The operator of plain corrections solves and finds a length, with the gradient in y; the length
is shortened where the couplings' own change asks for it."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from .. import ops
from .._common.context import looks_at, not_compiled, replaced
from ..adjoint.potential import IncreaseInputs, bodies_of, increase_of_bodies
from ..couplings import Coupling
from ..model.system import System
from ..ops.sums import Rows
from .coarse import products
from .couplings import Coupled

HALVINGS = 6  # of a correction, after which it is not made
ROUNDINGS = 8.0  # of the terms of the potential, by which it may seem to increase


class _Functions(NamedTuple):
    """The vectors of a coupling's N terms in the coarse functions: those of each of G groups of joined bodies."""

    term: Tensor  # int64 [G, n], N: none
    weights: Tensor  # [G, n, M, F]
    cell: Tensor  # int64 [G 9 F F], where in the matrices of all bodies; one beyond the last: nowhere


@not_compiled
def _functions_of(model: System, energy: Coupling) -> _Functions:
    geometry, (index, weights) = model.coarse_geometry, energy.differences()
    shape, counts = index.shape, np.diff(geometry.function_ptr)
    body_of = np.repeat(np.arange(geometry.bodies), counts)
    of_vertex = np.full(model.num_vertices, -1)
    of_vertex[geometry.vertex] = body_of[geometry.function]
    # a vertex of no weight only fills up
    of_term = np.where(weights != 0, of_vertex[index], -1).reshape(len(index), -1).max(1)
    bodies, group = np.unique(of_term[of_term >= 0], return_inverse=True)
    number = np.bincount(group, minlength=len(bodies))
    width = int(counts[bodies].max(initial=0))
    term = np.full((len(bodies), number.max(initial=0)), len(index))
    term[np.arange(term.shape[1]) < number[:, None]] = np.flatnonzero(of_term >= 0)[np.argsort(group, kind="stable")]

    # of the vertices that it has, their functions counted from the first of their body
    vertices, own = np.unique(index, return_inverse=True)
    dense = np.zeros((len(vertices), width))
    body, row = of_vertex[geometry.vertex], np.searchsorted(vertices, geometry.vertex).clip(max=len(vertices) - 1)
    some = (vertices[row] == geometry.vertex) & np.isin(body, bodies)
    dense[row[some], (geometry.function - geometry.function_ptr[body])[some]] = geometry.weight[some]
    out = np.zeros((shape[0] + 1, shape[1], width))
    for j in range(shape[2]):
        out[:-1] += weights[..., j, None] * dense[own.reshape(shape)[..., j]]

    mass_ptr = np.concatenate(([0], np.cumsum(counts**2)))
    row = np.arange(3 * width)
    inside = row < 3 * counts[bodies][:, None]
    cell = 9 * mass_ptr[bodies][:, None, None] + row[:, None] * (3 * counts[bodies][:, None, None]) + row
    cell = np.where(inside[:, :, None] & inside[:, None], cell, 9 * mass_ptr[-1])
    placed = [torch.from_numpy(a).to(model.device) for a in (term, out[term], cell.reshape(-1))]
    return _Functions(placed[0], placed[1].to(model.dtype), placed[2])


def _stiffness(model: System, coupled: Coupled, x: Tensor, like: Tensor) -> Tensor:
    """Second derivative of the couplings in the coarse functions at x [N/m], laid out as the matrices ``like``."""
    out = like.new_zeros((len(x), like.shape[1] + 1))
    for k, (energy, values) in enumerate(zip(model.couplings, coupled.values, strict=True)):
        curvature = energy.curvature(coupled.place(x), values)
        if curvature is None:
            continue
        of: _Functions = model.derived(f"functions of coupling {k}", lambda e=energy: _functions_of(model, e))
        # a row of zeros stands for no term
        rate, slope = (torch.cat([t, t.new_zeros(len(t), 1, *t.shape[2:])], 1)[:, of.term] for t in curvature[:2])
        weights = of.weights.expand(len(x), *of.weights.shape)
        along = products(weights, slope.expand(*weights.shape[:4], 3)).flatten(-2)  # [B, G, n, 3 F]
        matrix = products(along, rate[..., None] * along)
        if curvature.across is not None:
            across = torch.cat([curvature.across, torch.zeros_like(curvature.across[:, :1])], 1)[:, of.term]
            right = across[..., None] * weights[..., None, None, :]
            right = products(weights.flatten(2, 3), right.flatten(2, 3).flatten(3)).unflatten(-1, (3, 3, -1))
            matrix = matrix + right.permute(0, 1, 2, 3, 5, 4).flatten(4, 5).flatten(2, 3)
        out = out.index_add(1, of.cell, matrix.flatten(1))
    return out[:, :-1]


class _Joined(NamedTuple):
    """Groups of joined bodies: those of bodies that move, of terms of all couplings, of vertices and of the bodies of
    the coarse space."""

    of_bodies: Rows
    of_terms: Rows
    of_vertices: Tensor  # int64 [V]
    of_corrected: Tensor  # int64 [bodies]


@not_compiled
def _joined(model: System) -> _Joined:
    labels, moving = model.joined, bodies_of(model)
    count = int(labels.max()) + 1
    first = moving.order.cpu().long()[moving.ptr.cpu().long()[:-1]]
    vertices = []
    for energy in model.couplings:
        index, weights = energy.differences()
        some = np.take_along_axis(index.reshape(len(index), -1),
                                  (weights != 0).reshape(len(index), -1).argmax(1)[:, None], 1)[:, 0]  # fmt: skip
        vertices.append(torch.from_numpy(some))
    of_terms, geometry = Rows.of(labels[torch.cat(vertices)], count), model.coarse_geometry
    corrected = labels.new_zeros(geometry.bodies)
    body = np.searchsorted(geometry.function_ptr, geometry.function, side="right") - 1
    corrected[body] = labels[torch.from_numpy(geometry.vertex)]
    of_bodies, device = Rows.of(labels[first], count), model.device
    return _Joined(of_bodies.to(device), of_terms.to(device), labels.to(device), corrected.to(device))


def corrected(model: System, coupled: Coupled, inputs: IncreaseInputs, fields: ops.SweepFields, x: Tensor,
              run: Callable[[Tensor, ops.SweepFields], tuple[Tensor, Tensor]]) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Positions after a correction from x [B, V, 3], and what it did.

    inputs, fields: Of the step without the couplings.  run: The operator, from a state with such fields.
    """
    h2 = inputs.time_step**2
    assert fields.coarse_factor is not None
    pull = coupled.load(x)[..., :3]
    mass = torch.where(fields.mass != 0, fields.mass, 1.0)[..., None]  # a vertex without mass does not move
    matrix = fields.coarse_factor + h2 * _stiffness(model, coupled, x, fields.coarse_factor)
    end, done = run(x, replaced(fields, y=fields.y - h2 * pull / mass, coarse_factor=matrix, energy_data=coupled.data))
    joined: _Joined = model.derived("joined", lambda: _joined(model))
    with torch.no_grad():
        share, done = _share(coupled, inputs, joined, x.detach(), end.detach()), done.clone()
        lengths = done.narrow(-1, 3 * model.coarse_geometry.functions, model.coarse_geometry.bodies)
        lengths *= share[:, joined.of_corrected].mT
    lengths = share[:, joined.of_vertices]
    return torch.where(lengths == 1, end, x + lengths * (end - x)), done


def _share(coupled: Coupled, inputs: IncreaseInputs, joined: _Joined, x: Tensor, end: Tensor) -> Tensor:
    """The first of 1, 1/2, ... of the step from x to ``end`` that lowers the potential of each group of joined bodies,
    or 0 [B, groups, 1]. All but the couplings counts as convex along it."""
    before, h2 = coupled.terms(x).double(), inputs.time_step**2
    others, size = joined.of_bodies.sum(increase_of_bodies(inputs, x, end)).split(1, -1)
    size = size + joined.of_terms.sum(h2 * before.abs()[..., None])
    slack = ROUNDINGS * torch.finfo(x.dtype).eps * size
    share, found = torch.ones_like(others), torch.zeros_like(others, dtype=torch.bool)
    for _ in range(HALVINGS):
        there = x + share[:, joined.of_vertices].to(x.dtype) * (end - x)
        change = joined.of_terms.sum(h2 * (coupled.terms(there).double() - before)[..., None])
        found = found | (share * others + change <= slack)
        share = torch.where(found, share, share / 2)
        if looks_at(found) and bool(found.all()):
            break
    return torch.where(found, share, 0.0).to(x.dtype)
