"""Parts of the matrices of coarse corrections: stiffness and mass in the functions of the bodies
(docs/method.md, section 15).

On the CPU by compiled loops (csrc/coarse/sums.h), on CUDA by products of torch (ops/coarse.py). Either sums in an
order that depends on the Model alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from torch import Tensor

from .. import ops
from ..model.coarse import CoarsePlan
from ..ops import distinct


def coarse_stiffness(plan: CoarsePlan, mu: Tensor, lam: Tensor, gradients: Tensor, volume: Tensor) -> Tensor:
    """sum over the tets of each group of P' K P [1 | B, groups, 3, 3, width, width]: rest_stiffness() of
    csrc/energies/stable_neo_hookean.h, where the gradients are those of the coarse functions.

    mu, lam [1 | B, 1 | T] with lam >= -2/3 mu; gradients [1 | B, T, 4, 3] of the tets' shape functions and volume
    [1 | B, T] at rest.
    """
    return _stiffness(*distinct(mu, lam, gradients, volume), plan)


def coarse_mass(plan: CoarsePlan, mass: Tensor) -> Tensor:
    """W' M W of each body [B, cells], from the masses of vertices [B, V]; 1 on the diagonal of functions that fill up a
    matrix."""
    return _mass(mass.contiguous(), plan)


def _stiffness_reverse(bars: Sequence[Any], saved: Sequence[Any], rest: tuple, needs: Sequence[bool]
                       ) -> Sequence[Tensor]:  # fmt: skip
    (plan,) = rest
    return ops.direct.coarse_stiffness_backward(
        *saved, plan.plan, plan.weights, bars[0], plan.sizes, needs[2] or needs[3]
    )


def _mass_reverse(bars: Sequence[Any], saved: Sequence[Any], rest: tuple, needs: Sequence[bool]) -> Sequence[Tensor]:
    (plan,) = rest
    return (ops.direct.coarse_mass_backward(bars[0], plan.plan, plan.weights, plan.sizes),)


NO_VMAP = "torch.func.vmap of coarse corrections is not supported"
_stiffness = ops.Differentiable(
    lambda mu, lam, gradients, volume, plan: ops.direct.coarse_stiffness(mu, lam, gradients, volume, plan.plan,
                                                                      plan.weights, plan.sizes),
    _stiffness_reverse, arguments=5, inputs=4, vmap=NO_VMAP, batched=True,
)  # fmt: skip
_mass = ops.Differentiable(lambda mass, plan: ops.direct.coarse_mass(mass, plan.plan, plan.weights, plan.sizes),
                           _mass_reverse, arguments=2, inputs=1,
                           vmap=NO_VMAP, batched=True)  # fmt: skip
