"""GlobalAdjoint: the executed sweeps forward, the derivative of the equation G'(x) = 0 backward.

At a state with dG/dx = 0 at the free vertices, the implicit function theorem gives for the adjoint x_bar of that state

    (d2G/dx2) w = x_bar  at the free vertices, w = 0 at the pinned,          theta_bar = -w . d(dG/dx)/dtheta

and what is left over, x_bar - (d2G/dx2) w at the pinned vertices, is the adjoint of where they are held.
"""

# pyright: reportIncompatibleMethodOverride=false
from __future__ import annotations

import functools
import math
import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd import Function

from .. import ops
from .._common.context import is_captured
from .._common.messages import warn
from ..model.patches import Averaged
from ..model.system import System
from ..ops import is_batched, no_second_derivative, of_inputs
from .potential import DEPENDS, PAIRS, IncrementalPotential
from .routes import GlobalAdjoint, LinearSolve

MAX_ITERATIONS = 10_000  # of a solve whose adjoint does not say
DEFAULT_TOLERANCE = {torch.float64: 1e-10, torch.float32: 1e-5}
CHECK_EVERY = 8  # iterations on CUDA between two looks at whether all scenes have converged: each waits for the device

Operator = Callable[[Tensor], Tensor]

_OF_FIELDS = ops.SweepFields._fields.index("origin")  # x_start ... energy_data


def global_sweep(
    model: System, fields: ops.SweepFields, averaged: Averaged | None, couplings: Tensor, time_step: float,
    adjoint: GlobalAdjoint, run: Callable[[], Tensor],
) -> Tensor:  # fmt: skip
    """Positions where ``run`` ends the step [B, V, 3]; arguments before the time step: as of IncrementalPotential."""
    given = *fields[:_OF_FIELDS], *(averaged or (None, None)), couplings
    return _GlobalSweep.apply(*given, fields.origin, model, time_step, adjoint, run)


class _GlobalSweep(Function):
    @staticmethod
    def forward(ctx: Any, *args: Any) -> Tensor:
        *tensors, ctx.model, ctx.h, ctx.adjoint, run = args
        x = run()
        ctx.save_for_backward(*tensors, x)
        return x

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple:
        if is_batched(grads[0]):  # the solve looks at values
            raise NotImplementedError("adjoint: expected ReverseSweep for batched gradients (is_grads_batched), got "
                                      "GlobalAdjoint, which takes one at a time")  # fmt: skip
        needs = ctx.needs_input_grad[:DEPENDS]
        out = _GlobalBackward.apply(grads[0], *ctx.saved_tensors, ctx.model, ctx.h, ctx.adjoint, needs)
        return of_inputs(out, needs, 5)


class _GlobalBackward(Function):
    @staticmethod
    def forward(ctx: Any, x_bar: Tensor, *args: Any) -> tuple[Tensor, ...]:
        given, (origin, x, model, h, adjoint, needs) = args[:DEPENDS], args[DEPENDS:]
        if is_captured(x):
            raise RuntimeError("adjoint: expected ReverseSweep while a CUDA graph is captured, got GlobalAdjoint, "
                               "whose solve waits for the device")  # fmt: skip
        *averaged, couplings = given[_OF_FIELDS:]
        averaged = None if averaged[0] is None else Averaged(*averaged)
        with torch.autocast(x.device.type, enabled=False):  # which would take the products in half precision
            fields = ops.SweepFields(*given[:_OF_FIELDS], origin=origin)
            potential = IncrementalPotential(model, x, fields, h, averaged, couplings)
            x_bar_free = torch.where(potential.free > 0, x_bar, 0)
            w = solve_adjoint(potential, x_bar_free, adjoint, system(potential, adjoint.assembled), "GlobalAdjoint")
            bars = potential.dependence(w, needs)
            if needs[0]:
                bars[0] = torch.where(potential.free > 0, 0, x_bar - potential.product(w))
        out = []
        for bar, tensor, need in zip(bars, given, needs, strict=True):
            if need and tensor is not None:
                out.append(torch.zeros_like(tensor) if bar is None else ops.sum_to(bar, tensor.shape))
        return tuple(out)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple:
        no_second_derivative()


def solve_adjoint(potential: IncrementalPotential, x_bar: Tensor, adjoint: GlobalAdjoint,
                  operators: tuple[Operator, Operator], name: str, roundings: float = 0.0) -> Tensor:  # fmt: skip
    """w with (d2G/dx2) w = x_bar at the free vertices, w = 0 at the pinned.

    operators: As of system().  name: Of what is differentiated.  roundings: Of a product with the Hessian, which the
    residual may keep whatever the tolerance is, as long as they are of the last half of its digits: where they are
    more, the Hessian has no inverse in these numbers.
    """
    # of order one, so that no square of it leaves the range of its numbers
    size = x_bar.abs().amax((-2, -1), keepdim=True) if x_bar.numel() else x_bar.new_ones((len(x_bar), 1, 1))
    b = x_bar / torch.where(size == 0, 1, size)
    tolerance = adjoint.tolerance or DEFAULT_TOLERANCE[b.dtype]
    limit = adjoint.max_iterations or min(max(10 * 3 * potential.model.num_active, 1), MAX_ITERATIONS)
    product, precondition = operators
    found = conjugate_gradients(product, b, precondition, tolerance, limit)
    error, allowed = found.residual, torch.full_like(found.residual, tolerance)
    if roundings:
        part, eps = potential.stiffness() * found.x, torch.finfo(b.dtype).eps
        kept = roundings * eps * (_dot(part, part) / torch.where(size == 0, 1, _dot(b, b))).sqrt().flatten()
        error = torch.where(kept > math.sqrt(eps), torch.maximum(error, kept), error)
        allowed = torch.maximum(allowed, kept.clamp(max=math.sqrt(eps)))
    scene = int((error / allowed).argmax()) if len(b) else 0
    residual, tolerance = (float(t[scene]) if len(b) else 0.0 for t in (error, allowed))
    if adjoint.report is not None:
        adjoint.report(LinearSolve(found.iterations, residual, residual <= tolerance))
    if not residual <= tolerance:
        if not bool(torch.isfinite(size[scene])):
            text = f"{name}: expected finite adjoints of the positions, got {float(size[scene])} in scene {scene}"
        else:
            text = (
                f"{name}: expected conjugate gradients to meet a relative residual of {tolerance:g}, got "
                f"{residual:.3g} in scene {scene} after {found.iterations} iterations"
                f"{'; the Hessian is not positive definite there' if found.indefinite else ''}"
            )
        if adjoint.on_failure == "raise":
            raise RuntimeError(text)
        warn(text, RuntimeWarning)
    return found.x * size


def system(potential: IncrementalPotential, matrix: bool, shift: Tensor | None = None) -> tuple[Operator, Operator]:
    """Product with the Hessian between free vertices, of single tets by a matrix or without, and with the inverse of
    its diagonal blocks, which preconditions it; functions of [B, V, 3].

    shift: What is added to the diagonal [B, V, 1].
    """
    free, blocks = potential.free, potential.tet_diagonal()
    shift = blocks.new_zeros((1, 1, 1)) if shift is None else shift
    blocks = blocks + shift[..., None] * torch.eye(3, dtype=blocks.dtype, device=blocks.device)
    of_tets = Assembled(potential, blocks) if matrix else None

    def product(w: Tensor) -> Tensor:
        return free * (potential.product(w) + shift * w if of_tets is None else potential.with_others(w, of_tets(w)))

    return product, inverse_blocks(potential.with_other_blocks(blocks), free)


def inverse_blocks(blocks: Tensor, free: Tensor) -> Operator:
    """Product with the inverse of the blocks [B, V, 3, 3] of vertices that are free [V, 1]."""
    eye = torch.eye(3, dtype=blocks.dtype, device=blocks.device)
    # a pinned vertex may have neither mass nor tets, so that its block is zero
    inverse = torch.linalg.inv(torch.where(free[..., None] > 0, blocks, eye)) * free[..., None]
    return lambda r: (inverse @ r[..., None])[..., 0]


class Conjugate(NamedTuple):
    """Result of conjugate_gradients."""

    x: Tensor  # [B, V, 3]
    residual: Tensor  # |b - A x| / |b| of each scene, infinite where it is not a number [B]
    iterations: int  # of the scene that took most
    indefinite: bool  # a direction of negative curvature was met


def _dot(a: Tensor, b: Tensor) -> Tensor:
    return ops.sum_to(a * b, (len(a), 1, 1))


def conjugate_gradients(
    product: Operator, b: Tensor, precondition: Operator, tolerance: float, max_iterations: int
) -> Conjugate:
    """Preconditioned conjugate gradients for each scene of b [B, V, 3] on its own.

    The recurrence may believe in a residual that rounding has not kept, so its end is judged by b - A x; where that is
    too large it starts again from there, as long as this gains a digit. Negative curvature does not end it: the
    system has a solution as long as the matrix has an inverse.

    Source: Hestenes and Stiefel (1952); Saad, Iterative Methods for Sparse Linear Systems, algorithm 9.1.
    """
    size = _dot(b, b)
    goal = tolerance * tolerance * size
    x, r, left, iterations, lowest = torch.zeros_like(b), b, size, 0, torch.zeros_like(size)
    while True:
        some, count, curvature = _cycle(product, r, precondition, goal, max_iterations - iterations)
        x, iterations, lowest = x + some, iterations + count, torch.minimum(lowest, curvature)
        r = b - product(x)
        before, left = left, _dot(r, r)
        missed = ~(left <= goal)
        if count == 0 or iterations >= max_iterations or not bool((missed & (left < 0.01 * before)).any()):
            break
        r = torch.where(missed, r, 0)
    ratio = (left / torch.where(size > 0, size, 1)).sqrt().flatten()
    return Conjugate(x, torch.nan_to_num(ratio, nan=math.inf), iterations, bool((lowest < 0).any()))


def descent_direction(
    product: Operator, b: Tensor, precondition: Operator, tolerance: Tensor, max_iterations: int
) -> tuple[Tensor, Tensor]:
    """Truncated solution of A x = b [B, V, 3], with b . x > 0, and whether negative curvature has ended it, bool [B].

    tolerance: |b - A x| / |b| of each scene at which it ends, [B, 1, 1].
    Source: Nocedal and Wright, Numerical Optimization, algorithm 7.1.
    """
    x, _, lowest = _cycle(product, b, precondition, tolerance.square() * _dot(b, b), max_iterations, descends=True)
    return x, (lowest < 0)[:, 0, 0]


def _cycle(
    product: Operator, r: Tensor, precondition: Operator, goal: Tensor, max_iterations: int, descends: bool = False
) -> tuple[Tensor, int, Tensor]:
    """Solution of A x = r by the recurrence from zero: x, the most iterations of a scene, the lowest curvature met.
    ``descends``: a scene ends before a direction without positive curvature; its first one it goes."""
    x, rr = torch.zeros_like(r), _dot(r, r)
    p = z = precondition(r)
    rz = _dot(r, z)
    zero = torch.zeros_like(rr)
    active, counts, lowest = rr > goal, zero.clone(), zero
    every = CHECK_EVERY if r.is_cuda else 1
    for iteration in range(max_iterations):
        if iteration % every == 0 and not bool(active.any()):
            break
        q = product(p)
        curvature = _dot(p, q)
        lowest = torch.minimum(lowest, curvature)
        if descends:
            curved = active & ~(curvature > 0)
            x = torch.where(curved, p, x) if iteration == 0 else x
            active &= ~curved
        # a scene that has arrived, or broken down, rests
        alpha = torch.where(active, rz / curvature, zero)
        x.addcmul_(alpha, p)
        r = torch.addcmul(r, alpha, q, value=-1)
        counts += active
        z = precondition(r)
        before, rz = rz, _dot(r, z)
        p = torch.addcmul(z, torch.where(active, rz / before, zero), p)
        rr = _dot(r, r)
        active &= rr > goal  # never true of NaN
    return x, int(counts.max()) if len(r) else 0, lowest


class _Structure(NamedTuple):
    """Blocks of the Hessian of one scene that exist, without pinned rows and columns, and what they sum."""

    row_ptr: Tensor  # [V + 1]
    columns: Tensor  # [N]
    on_diagonal: Tensor  # [free] place of the diagonal block of each free vertex
    off_diagonal: Tensor  # [M] places of the others
    terms: Tensor  # [D, M] which of IncrementalPotential.edge_blocks each of these adds up; 12 T stands for none
    free: Tensor  # [free]


def _structure(model: System) -> _Structure:
    count, tets, free = model.num_vertices, model._topology[0], ~model._pinned
    a, b = (list(corners) for corners in zip(*PAIRS, strict=True))
    rows, columns = tets[:, a + b].reshape(-1), tets[:, b + a].reshape(-1)
    key, term = torch.sort(rows * count + columns, stable=True)
    keep = (free[rows] & free[columns])[term]
    key, term = key[keep], term[keep]
    off, place, sizes = torch.unique_consecutive(key, return_inverse=True, return_counts=True)
    vertices = free.nonzero().reshape(-1)
    # place of each term among those of its block
    nth = torch.arange(len(key), device=key.device) - (sizes.cumsum(0) - sizes)[place]
    depth = int(sizes.max()) if len(sizes) else 0
    terms = torch.full((depth, len(off)), 12 * len(tets), device=key.device)
    terms[nth, place] = term
    blocks, order = torch.sort(torch.cat([off, vertices * (count + 1)]))
    where = torch.empty_like(order)
    where[order] = torch.arange(len(order), device=order.device)
    row_ptr = torch.searchsorted(blocks, torch.arange(count + 1, device=blocks.device) * count)
    return _Structure(row_ptr, blocks % max(count, 1), where[len(off) :], where[: len(off)], terms, vertices)


@functools.cache
def _first_matrix() -> None:
    """torch says of the first block-sparse matrix of a process that they are in beta: of this one, unheard."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        none = torch.zeros((1,), dtype=torch.int64, device="cpu")
        values = torch.zeros((0, 3, 3), device="cpu")
        torch.sparse_bsr_tensor(none, none[:0], values, size=(0, 0), check_invariants=False)


class Assembled:
    """The Hessian of all scenes between free vertices, as one sparse matrix of 3x3 blocks."""

    def __init__(self, potential: IncrementalPotential, diagonal: Tensor) -> None:
        model, x = potential.model, potential.x
        if not x.is_cuda and not torch.backends.mkl.is_available():
            raise RuntimeError("assembled: expected a torch with MKL for sparse products on the CPU, got one without; "
                               "use GlobalAdjoint(assembled=False)")  # fmt: skip
        s: _Structure = model.derived("hessian_structure", lambda: _structure(model))
        scenes, count, n = x.shape[0], model.num_vertices, len(s.columns)
        values = x.new_empty((scenes, n, 9))
        values[:, s.on_diagonal] = diagonal[:, s.free].flatten(-2)
        of_tets = potential.edge_blocks().flatten(1, 2)
        of_tets = torch.cat([of_tets, of_tets.new_zeros((scenes, 1, 9))], 1)
        off = x.new_zeros((scenes, len(s.off_diagonal), 9))
        for term in s.terms:  # in a fixed order, where index_add on CUDA would have none
            off += of_tets[:, term]
        values[:, s.off_diagonal] = off
        row_ptr, columns = s.row_ptr, s.columns
        if scenes != 1:
            shift = torch.arange(scenes, device=x.device)[:, None]
            row_ptr = torch.cat([(row_ptr[:-1] + n * shift).reshape(-1), row_ptr.new_full((1,), n * scenes)])
            columns = (columns + count * shift).reshape(-1)
        index = torch.int32 if 9 * n * scenes < 2**31 else torch.int64  # MKL and cuSPARSE convert the other one anew
        _first_matrix()
        self.matrix = torch.sparse_bsr_tensor(
            row_ptr.to(index), columns.to(index), values.reshape(-1, 3, 3), size=(3 * count * scenes,) * 2,
            check_invariants=False)  # fmt: skip

    def __call__(self, w: Tensor) -> Tensor:
        return (self.matrix @ w.reshape(-1)).reshape(w.shape)
