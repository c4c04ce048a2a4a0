"""What the matrices of coarse corrections are made of: stiffness and mass in the functions of the bodies
(docs/method.md, section 15).

On the CPU by compiled loops (csrc/coarse/sums.h), on CUDA by products of torch (ops/coarse_cuda.py). Either sums in an
order that depends on the Model alone.
"""

# pyright: reportIncompatibleMethodOverride=false
from __future__ import annotations

from typing import Any, NoReturn

from torch import Tensor
from torch.autograd import Function

from .. import ops
from ..model.coarse import CoarsePlan
from ..ops import coarse as _shapes  # noqa: F401  (registers what torch asks of them)
from ..ops import distinct, no_second_derivative, of_inputs, one_by_one


def coarse_stiffness(plan: CoarsePlan, mu: Tensor, lam: Tensor, gradients: Tensor, volume: Tensor) -> Tensor:
    """sum over the tets of each group of P' K P [1 | B, groups, 3, 3, width, width]: rest_stiffness() of
    csrc/energies/stable_neo_hookean.h, where the gradients are those of the coarse functions.

    mu, lam [1 | B, 1 | T] with lam >= -2/3 mu; gradients [1 | B, T, 4, 3] of the tets' shape functions and volume
    [1 | B, T] at rest.
    """
    return _Stiffness.apply(*distinct(mu, lam, gradients, volume), plan)


def coarse_mass(plan: CoarsePlan, mass: Tensor) -> Tensor:
    """W' M W of each body [B, cells], from the masses of vertices [B, V]; 1 on the diagonal of functions that fill up a
    matrix."""
    return _Mass.apply(mass.contiguous(), plan)


class _Once(Function):
    """Has no second derivative and no batches of functorch, but several adjoints one after another."""

    @staticmethod
    def vmap(info: Any, in_dims: tuple, *args: Any) -> NoReturn:
        raise NotImplementedError("diffvbd: torch.func.vmap of coarse corrections is not supported")


class _Reverse(Function):
    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: Any) -> None:
        pass

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> NoReturn:
        no_second_derivative()


class _Stiffness(_Once):
    @staticmethod
    def forward(mu, lam, gradients, volume, plan):
        return ops.raw.coarse_stiffness(mu, lam, gradients, volume, plan.plan, plan.weights, plan.sizes)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: Tensor) -> None:
        ctx.save_for_backward(*inputs[:4])
        ctx.plan = inputs[4]

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple:
        needs = ctx.needs_input_grad[:4]
        return of_inputs(_StiffnessBackward.apply(grads[0], *ctx.saved_tensors, ctx.plan, needs), needs, 1)


class _StiffnessBackward(_Reverse):
    @staticmethod
    def forward(bar, mu, lam, gradients, volume, plan, needs):
        fields, rest = (mu, lam, gradients, volume), needs[2] or needs[3]
        bar = bar.contiguous()
        bars = ops.raw.coarse_stiffness_backward(*fields, plan.plan, plan.weights, bar, plan.sizes, rest)
        return tuple(ops.sum_to(b, t.shape) for b, t, need in zip(bars, fields, needs, strict=True) if need)

    @staticmethod
    def vmap(info: Any, in_dims: tuple, *args: Any) -> tuple[tuple[Tensor, ...], tuple[int, ...]]:
        return one_by_one(_StiffnessBackward, info.batch_size, in_dims, args)


class _Mass(_Once):
    @staticmethod
    def forward(mass, plan):
        return ops.raw.coarse_mass(mass, plan.plan, plan.weights, plan.sizes)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: Tensor) -> None:
        ctx.plan = inputs[1]

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple:
        return _MassBackward.apply(grads[0], ctx.plan), None


class _MassBackward(_Reverse):
    @staticmethod
    def forward(bar, plan):
        return ops.raw.coarse_mass_backward(bar.contiguous(), plan.plan, plan.weights, plan.sizes)

    @staticmethod
    def vmap(info: Any, in_dims: tuple, *args: Any) -> tuple[Tensor, int]:
        (out,), (dim,) = one_by_one(_MassBackward, info.batch_size, in_dims, args)
        return out, dim


ops.ready_signature(_Stiffness, _StiffnessBackward, _Mass, _MassBackward)
