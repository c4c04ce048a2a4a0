"""The matrices of the coarse corrections of a step (docs/method.md, section 15).

What depends on material, masses and rest shape alone is made once for all steps of a rollout; what turns with the
bodies once a step. The corrections themselves belong to the sweeps (csrc/cpu/coarse.h).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from .. import ops
from .._common.constants import VERTEX_ENERGIES
from .._common.context import not_compiled, replaced
from ..model.coarse import CoarsePlan
from ..model.material import shape_gradients
from ..model.system import System
from ..ops import distinct
from ..ops.sums import one_thread
from .law import LawInputs

# --- parts of the matrices of coarse corrections ----------------------------------------------------------------------


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


# --- corrections of a step --------------------------------------------------------------------------------------------

COARSE_FIELDS = ("coarse_factor", "coarse_mass", "coarse_plan", "coarse_weights", "coarse_rest")
_TENSORS = 3  # differentiable fields
_FIELDS = len(ops.CoarseFields._fields)


class CoarseParts(NamedTuple):
    """Parts of the matrices of all steps."""

    stiffness: Tensor  # [1 | B, groups, 3, 3, width, width], at rest [N/m]
    mass: Tensor  # [1 | B, cells] [kg]
    rest: Tensor  # [1 | B, blocks, 7, lanes], see CoarsePlan
    fibres: Tensor | None  # their share of the stiffness


def coarse_parts(model: System, mu: Tensor, lam: Tensor, mass: Tensor | None, rest: Tensor | None,
                 corners: Tensor | None, fibres: Tensor | None = None) -> CoarseParts:  # fmt: skip
    """mu, lam [1 | B, 1 | T]; mass [B, V], rest [B, T, 7] and the tets' corners at rest [B, T, 4, 3] where a step is
    given them, else None; fibres: of fibre_stiffness(), of a law that has some."""
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
        stiffness = stiffness if fibres is None else stiffness + fibres
        lanes = plan.rest if rest is None else in_lanes(model, rest)
        return CoarseParts(stiffness, plan.mass if mass is None else coarse_mass(plan, mass), lanes, fibres)


class _FibreIndex(NamedTuple):
    """Constants of a Model with a law that has fibres; n tets with a vertex to move."""

    tet: Tensor  # int64 [n]
    weights: Tensor  # [n, 4, width] of the functions of the tet's group at its corners
    members: Tensor  # int64 [groups, most], which of the n tets are of each group; n: none


@not_compiled
def _fibre_index(model: System) -> _FibreIndex:
    g, tets = model.coarse_geometry, model._topology[0].cpu().numpy()
    tet = np.flatnonzero(g.tet_group >= 0)
    group = g.tet_group[tet]
    key = g.vertex * g.functions + g.function
    order, function = np.argsort(key), g.group_functions[group][:, None]
    wanted = tets[tet][:, :, None] * g.functions + function
    at = order[np.minimum(np.searchsorted(key[order], wanted), len(key) - 1)]
    weights = np.where((key[at] == wanted) & (function >= 0), g.weight[at], 0.0)
    by_group, counts = np.argsort(group, kind="stable"), np.bincount(group, minlength=len(g.group_body))
    members = np.full((len(counts), counts.max(initial=0)), len(tet))
    members[np.arange(members.shape[1]) < counts[:, None]] = by_group
    placed = [torch.from_numpy(a).to(model.device) for a in (tet, weights, members)]
    return _FibreIndex(placed[0], placed[1].to(model._mass), placed[2])


def fibre_stiffness(model: System, law: LawInputs, corners: Tensor | None) -> Tensor | None:
    """The share of a law's fibres in the stiffness of CoarseParts: of V k (a0 . grad N)^2 a0 a0' in each tet at rest,
    k of Density.fibre_modulus(). None without fibres. corners: as of coarse_parts()."""
    if model.law is None or law.a0 is None:
        return None
    with torch.autocast(law.a0.device.type, enabled=False):
        modulus = model.law.density.fibre_modulus(law.values, law.a0.new_ones(1, 1))
        return _fibre_stiffness(model, modulus, law.a0, corners)


def _fibre_stiffness(model: System, modulus: Tensor, a0: Tensor, corners: Tensor | None) -> Tensor:
    index: _FibreIndex = model.derived("coarse_fibres", lambda: _fibre_index(model))
    own = corners is None
    gradients, volume = model.derived("coarse_shapes", lambda: _shapes_of(model)) if own else shape_gradients(corners)
    scenes, tets = max(map(len, (modulus, a0, gradients))), model.num_tets
    a0 = ops.broadcast(a0, (scenes, tets, 3))[:, index.tet]
    size = ops.broadcast(modulus * volume, (scenes, tets))[:, index.tet]
    along = (ops.broadcast(gradients, (scenes, tets, 4, 3))[:, index.tet] * a0[:, :, None]).sum(-1)
    slopes = (along[..., None] * index.weights).sum(2)  # of each function along the fibre
    right = (a0[..., None] * slopes[:, :, None]).flatten(2)
    # a row of zeros stands for no tet
    left, right = (torch.cat([t, t.new_zeros(scenes, 1, t.shape[-1])], 1)[:, index.members]
                   for t in (size[..., None] * right, right))  # fmt: skip
    return products(left, right).unflatten(-1, (3, -1)).unflatten(-3, (3, -1)).transpose(-3, -2)


def _run_products(a: Tensor, b: Tensor) -> Tensor:
    with one_thread(a):
        return a.mT @ b


def _products_reverse(bars: Sequence[Any], saved: Sequence[Any], rest: tuple, needs: Sequence[bool]
                      ) -> Sequence[Tensor]:  # fmt: skip
    a, b = saved
    with one_thread(a):
        return b @ bars[0].mT, a @ bars[0]


products = ops.Differentiable(_run_products, _products_reverse, arguments=2, inputs=2, vmap=NO_VMAP, batched=True)


def in_lanes(model: System, rest: Tensor) -> Tensor:
    """Rest scalars [1 | B, T, 7] as the corrections read them [1 | B, blocks, 7, lanes]."""
    return rest.detach()[:, model._coarse_plan.tet].transpose(-1, -2).contiguous()


def _unit_stiffness(model: System) -> Tensor:
    """Of all groups with mu = 1 Pa and lam = 0, and with mu = 0 and lam = 1 Pa."""
    gradients, volume = _shapes_of(model)
    mu = volume.new_tensor([[1.0], [0.0]])
    return coarse_stiffness(model._coarse_plan, mu, 1 - mu, gradients, volume)


def _shapes_of(model: System) -> tuple[Tensor, Tensor]:
    """Gradients of the tets' shape functions and their volumes at the Model's own rest."""
    return shape_gradients(model._rest_points[model._topology[0]][None])


def _reverse(bars: Sequence[Any], saved: Sequence[Any], rest: tuple, needs: Sequence[bool]) -> Sequence[Tensor]:
    sizes, time_step, _ = rest
    return ops.direct.coarse_matrix_backward(*saved, bars[0], sizes, time_step)


# The matrices, or their Cholesky factors. What comes back for these is the adjoint of the matrices themselves: no other
# operator reads a factor, and the matrices need not be kept. Fields; sizes, time_step, factored.
_matrix = ops.Differentiable(ops.direct.coarse_matrix, _reverse, arguments=_FIELDS + 3, inputs=_TENSORS,
                             tensors=_FIELDS, vmap=NO_VMAP, batched=True)  # fmt: skip


def with_corrections(model: System, parts: CoarseParts, fields: ops.SweepFields, time_step: float) -> ops.SweepFields:
    """Fields of the sweeps, with the corrections between them."""
    plan = model._coarse_plan
    matrix = matrix_of(model, parts, fields.x_prev, time_step, factored=not model.energy_mask & VERTEX_ENERGIES)
    return replaced(fields, coarse_factor=matrix, coarse_mass=parts.mass.detach(), coarse_plan=plan.plan,
                           coarse_weights=plan.weights, coarse_rest=parts.rest)  # fmt: skip


def matrix_of(model: System, parts: CoarseParts, x_prev: Tensor, time_step: float, factored: bool) -> Tensor:
    """The matrices of a step from x_prev, or their factors; see SweepFields.coarse_factor."""
    plan, tensors = model._coarse_plan, distinct(x_prev, parts.stiffness.contiguous(), parts.mass)
    return _matrix(*tensors, plan.plan, plan.moments, plan.volume, plan.sizes, time_step, factored)


def lengths_of(model: System, corrections: Tensor) -> Tensor:
    """Of what an operator has recorded, the length of each body's corrections [B, corrections, bodies]."""
    geometry = model.coarse_geometry
    return corrections.detach().narrow(-1, 3 * geometry.functions, geometry.bodies).clone()
