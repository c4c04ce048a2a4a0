"""The matrices of the coarse corrections of a step (docs/method.md, section 15).

What depends on material, masses and rest shape alone is made once for all steps of a rollout; what turns with the
bodies once a step. The corrections themselves belong to the sweeps (csrc/cpu/coarse.h).
"""

# pyright: reportIncompatibleMethodOverride=false
from __future__ import annotations

from typing import Any, NamedTuple, NoReturn

import torch
from torch import Tensor
from torch.autograd import Function

from .. import ops
from ..mask import VERTEX_ENERGIES
from ..model.material import shape_gradients
from ..model.system import System
from ..ops import coarse as _shapes  # noqa: F401  (registers what torch asks of them)
from ..ops import distinct, no_second_derivative, of_inputs, one_by_one
from ..tuples import replaced
from .coarse_sums import coarse_mass, coarse_stiffness

_TENSORS = 3  # differentiable fields
_FIELDS = len(ops.CoarseFields._fields)


class CoarseParts(NamedTuple):
    """What the matrices of all steps are made of."""

    stiffness: Tensor  # [1 | B, groups, 3, 3, width, width], at rest [N/m]
    mass: Tensor  # [1 | B, cells] [kg]
    rest: Tensor  # [1 | B, blocks, 7, lanes], see CoarsePlan


def coarse_parts(model: System, mu: Tensor, lam: Tensor, mass: Tensor | None, rest: Tensor | None,
                 corners: Tensor | None) -> CoarseParts:  # fmt: skip
    """mu, lam [1 | B, 1 | T]; mass [B, V], rest [B, T, 7] and the tets' corners at rest [B, T, 4, 3] where a step is
    given them, else None."""
    with torch.autocast(mu.device.type, enabled=False):  # which would take the products in half precision
        plan = model._coarse_plan
        least = torch.maximum(lam, mu * (-2 / 3))
        if corners is None and mu.shape[-1] == 1 and lam.shape[-1] == 1:
            unit = model.derived("coarse_unit", lambda: _unit_stiffness(model))
            of_mu, of_lam = (ops.broadcast(m.reshape(-1, *[1] * 5), (len(m), *unit.shape[1:])) for m in (mu, least))
            stiffness = torch.addcmul(of_mu * unit[:1], of_lam, unit[1:])
        else:
            own = corners is None
            shapes = model.derived("coarse_shapes", lambda: _shapes_of(model)) if own else shape_gradients(corners)
            stiffness = coarse_stiffness(plan, mu, least, *shapes)
        lanes = plan.rest if rest is None else rest.detach()[:, plan.tet].transpose(-1, -2).contiguous()
        return CoarseParts(stiffness, plan.mass if mass is None else coarse_mass(plan, mass), lanes)


def _unit_stiffness(model: System) -> Tensor:
    """Of all groups with mu = 1 Pa and lam = 0, and with mu = 0 and lam = 1 Pa."""
    gradients, volume = _shapes_of(model)
    mu = volume.new_tensor([[1.0], [0.0]])
    return coarse_stiffness(model._coarse_plan, mu, 1 - mu, gradients, volume)


def _shapes_of(model: System) -> tuple[Tensor, Tensor]:
    """Gradients of the tets' shape functions and their volumes at the Model's own rest."""
    return shape_gradients(model._rest_points[model._topology[0]][None])


class _Matrix(Function):
    """The matrices, or their Cholesky factors. What comes back for these is the adjoint of the matrices themselves: no
    other operator reads a factor, and the matrices need not be kept."""

    @staticmethod
    def forward(x_prev, stiffness, mass, plan, moments, volume, sizes, time_step, factored):
        return ops.raw.coarse_matrix(x_prev, stiffness, mass, plan, moments, volume, sizes, time_step, factored)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: Tensor) -> None:
        ctx.save_for_backward(*inputs[:_FIELDS])
        ctx.sizes, ctx.time_step, _ = inputs[_FIELDS:]
        ctx.set_materialize_grads(False)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor | None) -> tuple:
        if grads[0] is None:
            return (None,) * (_FIELDS + 3)
        needs = ctx.needs_input_grad[:_TENSORS]
        out = _MatrixBackward.apply(grads[0], *ctx.saved_tensors, ctx.sizes, ctx.time_step, needs)
        return of_inputs(out, needs, _FIELDS + 3 - _TENSORS)

    @staticmethod
    def vmap(info: Any, in_dims: tuple, *args: Any) -> NoReturn:
        raise NotImplementedError("diffvbd: torch.func.vmap of coarse corrections is not supported")


class _MatrixBackward(Function):
    @staticmethod
    def forward(bar, x_prev, stiffness, mass, plan, moments, volume, sizes, time_step, needs):
        fields = (x_prev, stiffness, mass, plan, moments, volume)
        bars = ops.raw.coarse_matrix_backward(*fields, bar.contiguous(), sizes, time_step)
        return tuple(ops.sum_to(b, t.shape) for b, t, need in zip(bars, fields, needs, strict=False) if need)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: tuple[Tensor, ...]) -> None:
        pass

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> NoReturn:
        no_second_derivative()

    @staticmethod
    def vmap(info: Any, in_dims: tuple, *args: Any) -> tuple[tuple[Tensor, ...], tuple[int, ...]]:
        """Several adjoints, one after another."""
        return one_by_one(_MatrixBackward, info.batch_size, in_dims, args)


def with_corrections(model: System, parts: CoarseParts, fields: ops.SweepFields, time_step: float) -> ops.SweepFields:
    """What the sweeps read, with the corrections between them."""
    plan = model._coarse_plan
    matrix = matrix_of(model, parts, fields.x_prev, time_step, factored=not model.energy_mask & VERTEX_ENERGIES)
    return replaced(fields, coarse_factor=matrix, coarse_mass=parts.mass.detach(), coarse_plan=plan.plan,
                           coarse_weights=plan.weights, coarse_rest=parts.rest)  # fmt: skip


def matrix_of(model: System, parts: CoarseParts, x_prev: Tensor, time_step: float, factored: bool) -> Tensor:
    """The matrices of a step from x_prev, or their factors; see SweepFields.coarse_factor."""
    plan, tensors = model._coarse_plan, distinct(x_prev, parts.stiffness.contiguous(), parts.mass)
    return _Matrix.apply(*tensors, plan.plan, plan.moments, plan.volume, plan.sizes, time_step, factored)


def lengths_of(model: System, corrections: Tensor) -> Tensor:
    """Of what an operator has recorded, the length of each body's corrections [B, corrections, bodies]."""
    geometry = model.coarse_geometry
    return corrections.detach().narrow(-1, 3 * geometry.functions, geometry.bodies).clone()


ops.ready_signature(_Matrix, _MatrixBackward)
