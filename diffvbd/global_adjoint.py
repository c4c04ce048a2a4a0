"""GlobalAdjoint: the executed sweeps forward, the derivative of the equation G'(x) = 0 backward.

At a state with dG/dx = 0 at the free vertices, the implicit function theorem gives for the adjoint x_bar of that state

    (d2G/dx2) w = x_bar  at the free vertices, w = 0 at the pinned,          theta_bar = -w . d(dG/dx)/dtheta

and what is left over, x_bar - (d2G/dx2) w at the pinned vertices, is the adjoint of where they are held.
"""

# pyright: reportIncompatibleMethodOverride=false
from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from typing import Any, NamedTuple, cast

import torch
from torch import Tensor
from torch.autograd import Function

from . import ops
from .adjoints import GlobalAdjoint, LinearSolve
from .incremental import IncrementalPotential
from .model import Model
from .sweeps import SweepTensors, no_second_derivative, of_inputs, sweep

MAX_ITERATIONS = 10_000  # of a solve whose adjoint does not say
CHECK_EVERY = 8  # iterations on CUDA between two looks at whether all scenes have converged: each waits for the device

_DIFFERENTIABLE = 8  # as in sweeps.py: x_start, x_prev, y, mu, lam, mass, rest, energy_data


def global_sweep(
    model: Model, tensors: SweepTensors, settings: ops.SweepSettings, adjoint: GlobalAdjoint, debug_step: int = -1
) -> Tensor:
    """Positions after the sweeps [B, V, 3]; ``tensors`` are the nine arguments of sweeps.sweep."""
    return _GlobalSweep.apply(*tensors, model, settings, adjoint, debug_step)


class _GlobalSweep(Function):
    @staticmethod
    def forward(ctx: Any, *args: Any) -> Tensor:
        tensors = cast(SweepTensors, args[:9])
        model, settings, adjoint, debug_step = args[9:]
        x = sweep(*tensors, model._packed_rest, model._plan, settings, tape_policy=ops.NO_TAPE, debug_step=debug_step)
        ctx.save_for_backward(*tensors, x)
        ctx.model, ctx.h, ctx.adjoint = model, settings.numbers[0], adjoint
        return x

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple:
        needs = ctx.needs_input_grad[:_DIFFERENTIABLE]
        out = _GlobalBackward.apply(grads[0], *ctx.saved_tensors, ctx.model, ctx.h, ctx.adjoint, needs)
        return of_inputs(out, needs, 5)


class _GlobalBackward(Function):
    @staticmethod
    def forward(ctx: Any, x_bar: Tensor, *args: Any) -> tuple[Tensor, ...]:
        *tensors, x, model, h, adjoint, needs = args
        if x.is_cuda and torch.cuda.is_current_stream_capturing():
            raise RuntimeError("adjoint: expected ReverseSweep while a CUDA graph is captured, got GlobalAdjoint, "
                               "whose solve waits for the device")  # fmt: skip
        potential = IncrementalPotential(model, x, tensors, h)
        w = _solve(potential, potential.free * x_bar, adjoint)
        bars = potential.dependence(w, needs)
        if needs[0]:
            bars[0] = (1 - potential.free) * (x_bar - potential.product(w))
        out = []
        for bar, tensor, need in zip(bars, tensors, needs, strict=False):
            if need:
                out.append(torch.zeros_like(tensor) if bar is None else ops.sum_to(bar, tensor.shape))
        return tuple(out)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple:
        no_second_derivative()


def _solve(potential: IncrementalPotential, b: Tensor, adjoint: GlobalAdjoint) -> Tensor:
    """w with (d2G/dx2) w = b, both zero where pinned."""
    free = potential.free
    product = assembled(potential) if adjoint.assembled else lambda w: free * potential.product(w)
    # a pinned vertex may have neither mass nor tets, so that its block is zero
    blocks = potential.diagonal()
    eye = torch.eye(3, dtype=b.dtype, device=b.device)
    inverse = torch.linalg.inv(torch.where(free[..., None] > 0, blocks, eye)) * free[..., None]
    unknowns = 3 * potential.model.num_active
    limit = adjoint.max_iterations or min(max(10 * unknowns, 1), MAX_ITERATIONS)
    solution = conjugate_gradients(product, b, lambda r: (inverse * r[..., None, :]).sum(-1), adjoint.tolerance, limit)
    if adjoint.report is not None:
        residual = _relative(b - product(solution.x), b)
        adjoint.report(LinearSolve(solution.iterations, float(residual.max()) if len(b) else 0.0, solution.converged))
    if not solution.converged:
        worst = _relative(b - product(solution.x), b)
        text = (
            f"GlobalAdjoint: expected conjugate gradients to meet a relative residual of {adjoint.tolerance:g}, got "
            f"{float(worst.max()):.3g} in scene {int(worst.argmax())} after {solution.iterations} iterations"
            f"{'; the Hessian is not positive definite there' if solution.indefinite else ''}"
        )
        if adjoint.on_failure == "raise":
            raise RuntimeError(text)
        warnings.warn(text, RuntimeWarning, stacklevel=2)
    return solution.x


class Conjugate(NamedTuple):
    """Result of conjugate_gradients: x [B, V, 3], the most iterations of a scene, and what came of them."""

    x: Tensor
    iterations: int
    converged: bool
    indefinite: bool  # a direction of no or negative curvature was met


def _dot(a: Tensor, b: Tensor) -> Tensor:
    return (a * b).sum((-2, -1), keepdim=True)


def _relative(r: Tensor, b: Tensor) -> Tensor:
    """|r| / |b| of each scene, 0 for b = 0; NaN counts as infinite."""
    size = _dot(b, b).sqrt()
    ratio = _dot(r, r).sqrt() / torch.where(size > 0, size, torch.ones_like(size))
    return torch.nan_to_num(ratio, nan=math.inf, posinf=math.inf).flatten()


def conjugate_gradients(
    product: Callable[[Tensor], Tensor],
    b: Tensor,
    precondition: Callable[[Tensor], Tensor],
    tolerance: float,
    max_iterations: int,
) -> Conjugate:
    """Preconditioned conjugate gradients for each scene of b [B, V, 3] on its own; one that has converged rests.

    Ends where |r| <= tolerance |b| for the residual r of the recurrence. A direction of negative curvature does not end
    it: the system has a solution as long as the matrix has an inverse.

    Source: Hestenes and Stiefel (1952); Saad, Iterative Methods for Sparse Linear Systems, algorithm 9.1.
    """
    x, r = torch.zeros_like(b), b
    goal = tolerance * tolerance * _dot(b, b)
    z = precondition(r)
    p, rz = z, _dot(r, z)
    active = ~(_dot(r, r) <= goal)  # a NaN stays active and is reported
    counts = torch.zeros_like(goal)
    indefinite = torch.zeros_like(active)
    every = CHECK_EVERY if b.is_cuda else 1
    for iteration in range(max_iterations):
        if iteration % every == 0 and not bool(active.any()):
            break
        q = product(p)
        curvature = _dot(p, q)
        indefinite = indefinite | (active & ~(curvature > 0))
        # a scene that rests divides by one and moves by zero
        alpha = torch.where(active, rz, 0) / torch.where(active & (curvature != 0), curvature, 1)
        x, r = x + alpha * p, r - alpha * q
        counts = counts + active
        z = precondition(r)
        previous, rz = rz, _dot(r, z)
        p = z + torch.where(active, rz, 0) / torch.where(active & (previous != 0), previous, 1) * p
        active = active & ~(_dot(r, r) <= goal)
    return Conjugate(x, int(counts.max()) if len(b) else 0, not bool(active.any()), bool(indefinite.any()))


class _Structure(NamedTuple):
    """Which blocks of the Hessian of one scene exist, pinned rows and columns left out, and what they sum."""

    row_ptr: Tensor  # [V + 1] int64
    columns: Tensor  # [N]
    on_diagonal: Tensor  # [free] place of the diagonal block of each free vertex
    off_diagonal: Tensor  # [M] places of the others
    terms: Tensor  # [D, M] which (tet, corner, corner) each of these adds up; 16 T stands for none
    free: Tensor  # [free]


def _structure(model: Model) -> _Structure:
    count, tets, free = model.num_vertices, model.tets, ~model.pinned
    rows, columns = (t.reshape(-1) for t in torch.broadcast_tensors(tets[:, :, None], tets[:, None, :]))
    key, term = torch.sort(rows * count + columns, stable=True)
    keep = (free[rows] & free[columns] & (rows != columns))[term]
    key, term = key[keep], term[keep]
    off, place, sizes = torch.unique_consecutive(key, return_inverse=True, return_counts=True)
    vertices = free.nonzero().reshape(-1)
    # place of each term among those of its block
    nth = torch.arange(len(key), device=key.device) - (sizes.cumsum(0) - sizes)[place]
    depth = int(sizes.max()) if len(sizes) else 0
    terms = torch.full((depth, len(off)), 16 * len(tets), device=key.device)
    terms[nth, place] = term
    blocks, order = torch.sort(torch.cat([off, vertices * (count + 1)]))
    where = torch.empty_like(order)
    where[order] = torch.arange(len(order), device=order.device)
    row_ptr = torch.searchsorted(blocks, torch.arange(count + 1, device=blocks.device) * count)
    return _Structure(row_ptr, blocks % max(count, 1), where[len(off) :], where[: len(off)], terms, vertices)


def assembled(potential: IncrementalPotential) -> Callable[[Tensor], Tensor]:
    """The Hessian of all scenes as one sparse matrix of 3x3 blocks; returns the product with it."""
    model, x = potential.model, potential.x
    s: _Structure = model.derived("hessian_structure", lambda: _structure(model))
    if not x.is_cuda and not torch.backends.mkl.is_available():
        raise RuntimeError("assembled: expected a torch with MKL for sparse products on the CPU, got one without; use "
                           "GlobalAdjoint(assembled=False)")  # fmt: skip
    scenes, count, n = x.shape[0], model.num_vertices, len(s.columns)
    values = x.new_zeros((scenes, n, 9))
    values[:, s.on_diagonal] = potential.diagonal()[:, s.free].flatten(-2)
    of_tets = potential.tet_blocks().flatten(-2).flatten(1, 3)
    of_tets = torch.cat([of_tets, of_tets.new_zeros((scenes, 1, 9))], 1)
    off = x.new_zeros((scenes, len(s.off_diagonal), 9))
    for term in s.terms:  # in a fixed order, where index_add on CUDA would have none
        off += of_tets[:, term]
    values[:, s.off_diagonal] = off
    shift = torch.arange(scenes, device=x.device)[:, None]
    row_ptr = torch.cat([(s.row_ptr[:-1] + n * shift).reshape(-1), s.row_ptr.new_tensor([n * scenes])])
    columns = (s.columns + count * shift).reshape(-1)
    index = torch.int32 if 9 * n * scenes < 2**31 else torch.int64  # cuSPARSE and MKL convert the other one anew
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*(beta state|nvariant checks).*")
        matrix = torch.sparse_bsr_tensor(row_ptr.to(index), columns.to(index), values.reshape(-1, 3, 3),
                                         size=(3 * count * scenes,) * 2, check_invariants=False)  # fmt: skip
    return lambda w: (matrix @ w.reshape(-1)).reshape(w.shape)
