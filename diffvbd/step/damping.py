"""Viscosity and drag, as other values of what a solve reads anyway (docs/method.md, section 20).

Viscosity: the dissipation potential of a solve over h is that of a second stable Neo-Hookean law with the moduli
viscosity / h and volume_viscosity / h, whose rest shape is where the tets were at the start, times the square of their
volume ratio J there. It depends on F F_start^-1, so no rigid motion is damped. Both laws are polynomials of the tet's
corners with the same terms, and their sum is again a stable Neo-Hookean law, of other moduli and another rest metric:

    r = (S_1 + J S_2) / (S_1 + S_2),    S = 2 mu + lam
    mu = r (mu_1 + mu_2),    lam = r (lam_1 + lam_2),    c6 = c6_1 / r,    r mu k_ab = ... = mu_1 k_ab,1 + mu_2 k_ab,2

Drag: m drag (x - x_start) / h only shifts the predictor y of the step and enlarges the mass.
"""

from __future__ import annotations

import torch
from torch import Tensor

from .. import ops
from .._common.context import replaced
from ..model.material import face_normals, stiffness_weights
from ..model.system import System
from .arguments import Damping, Drag, Prepared
from .coarse import coarse_mass, coarse_parts


def damped(model: System, prepared: Prepared, x: Tensor, reference: Tensor | None = None) -> Prepared:
    """Arguments of a solve from x [..., V, 3] with its damping in moduli, rest metric, mass and drag.

    reference: From where the motion of the solve is measured [..., V, 3]; None: x.
    """
    damping = prepared.damping
    if damping is None:
        return prepared
    if reference is not None and prepared.unrolled is not None:
        raise NotImplementedError("adjoint: expected ReverseSweep for damping with SDIRK2() or BDF2(), got Unrolled")
    out = replaced(prepared, damping=None)
    if damping.drag is not None:
        out = _slowed(model, out, damping.drag, x, reference)
    if damping.viscosity is not None or damping.volume_viscosity is not None:
        out = _viscous(model, out, damping, (x if reference is None else reference).reshape(-1, *x.shape[-2:]))
    return out


def _slowed(model: System, prepared: Prepared, drag: Tensor, x: Tensor, reference: Tensor | None) -> Prepared:
    h = prepared.settings.numbers.time_step
    shape = max(len(drag), len(prepared.mass)), model.num_vertices
    drag = ops.broadcast(drag, shape)
    factor = (1 / (1 + h * drag))[..., None]
    shift = None
    if reference is not None:
        shift = factor * drag[..., None] * (reference - x).reshape(-1, *x.shape[-2:])
    mass = ops.broadcast(prepared.mass, shape) * (1 + h * drag)
    coarse = prepared.coarse
    if coarse is not None:
        coarse = replaced(coarse, mass=coarse_mass(model._coarse_plan, mass))
    return replaced(prepared, mass=mass, coarse=coarse, drag=Drag(factor, shift))


def _viscous(model: System, prepared: Prepared, damping: Damping, start: Tensor) -> Prepared:
    h, rest = prepared.settings.numbers.time_step, prepared.rest
    rest = model.rest_scalars if rest is None else rest
    normals, six_volumes = face_normals(ops.tet_gather(start, *model._topology))
    given = prepared.mu, prepared.lam, damping.viscosity, damping.volume_viscosity
    scenes = max(len(t) for t in (start, rest, *given) if t is not None)
    shape = scenes, model.num_tets

    def of_tets(value: Tensor | None) -> Tensor:
        return start.new_zeros(shape) if value is None else ops.broadcast(value, shape)

    own = ops.broadcast(rest, (*shape, rest.shape[-1]))
    c6, weights = own[..., 6], own[..., :6]
    ratio = c6 * six_volumes
    upright = ratio.detach() > 0  # a tet that starts inside out is not damped in the step
    mu, lam, *rates = (of_tets(value) for value in given)
    all_shear, all_volume = (rate / h for rate in rates)
    shear, volume = (torch.where(upright, rate, 0.0) for rate in (all_shear, all_volume))
    ratio = torch.where(upright, ratio, 1.0)
    elastic, viscous = 2 * mu + lam, 2 * shear + volume
    total = elastic + viscous
    r = torch.where(total > 0, (elastic + ratio * viscous) / torch.where(total > 0, total, 1.0), 1.0)
    both = mu + shear
    share = torch.where(both > 0, shear / torch.where(both > 0, both, 1.0), 0.0)[..., None]
    at_start = torch.stack(stiffness_weights(normals, c6), -1)
    metric = torch.cat([(weights + share * (at_start - weights)) / r[..., None], (c6 / r)[..., None]], -1)
    coarse = prepared.coarse
    if coarse is not None:  # whose matrices are those of the shape at rest
        parts = coarse_parts(model, mu + all_shear, lam + all_volume, None, metric, damping.corners)
        coarse = replaced(parts, mass=coarse.mass)
    return replaced(prepared, mu=r * both, lam=r * (lam + volume), rest=metric, coarse=coarse)
