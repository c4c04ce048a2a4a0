"""Viscosity and drag, as other values of what a solve reads anyway (docs/method.md, section 20).

Viscosity: the dissipation potential of a solve over h is that of a second stable Neo-Hookean law with the moduli
viscosity / h and volume_viscosity / h, whose rest shape is where the tets were at the start, times the square of their
volume ratio J there. It depends on F F_start^-1, so no rigid motion is damped. Both laws are polynomials of the tet's
corners with the same terms, and their sum is again a stable Neo-Hookean law, of other moduli and another rest metric:

    r = (S_1 + J S_2) / (S_1 + S_2),    S = 2 mu + lam
    mu = r (mu_1 + mu_2),    lam = r (lam_1 + lam_2),    c6 = c6_1 / r,    r mu k_ab = ... = mu_1 k_ab,1 + mu_2 k_ab,2

With a law of one's own the second law stays apart. Its metric n_a . n_b c6 / (6 J), c6 / J and its moduli times J are
more scalars of the rest shape. The law is compiled once more for them.

Drag: m drag (x - x_start) / h only shifts the predictor y of the step and enlarges the mass.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from .. import ops
from .._common.context import replaced
from ..laws.tets import first_viscous
from ..model.material import determinant, face_normals, stiffness_weights
from ..model.system import System
from .arguments import Damping, Drag, Prepared
from .coarse import coarse_mass, coarse_parts

GRAM = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))  # products of two edges
LEAST = 1e-30  # [Pa] a shear modulus that no motion notices, by which 0 Pa has a derivative, too


class Reference(NamedTuple):
    """From where the motion of a solve is measured, as a scheme extrapolates it from two states [..., V, 3].

    Positions are extrapolated for drag. For viscosity the products of edges are, one + weight (two - one), which no
    rotation changes: extrapolated positions of a body that turns are no shape of it.
    """

    position: Tensor
    one: Tensor
    two: Tensor
    weight: float


def damped(model: System, prepared: Prepared, x: Tensor, reference: Reference | None = None) -> Prepared:
    """Arguments of a solve from x [..., V, 3] with its damping in moduli, rest metric, mass and drag.

    reference: None: the motion is measured from x.
    """
    damping = prepared.damping
    if damping is None:
        return prepared
    if reference is not None and prepared.unrolled is not None:
        raise NotImplementedError("adjoint: expected ReverseSweep for damping with SDIRK2() or BDF2(), got Unrolled")
    out = replaced(prepared, damping=None)
    if damping.drag is not None:
        out = _slowed(model, out, damping.drag, x, None if reference is None else reference.position)
    if damping.viscosity is not None or damping.volume_viscosity is not None:
        if reference is None:
            normals, six_volumes = face_normals(_corners(model, x))
            products = torch.stack(stiffness_weights(normals, torch.full_like(six_volumes, 6.0)), -1)
        else:
            products, six_volumes = _extrapolated(model, reference)
        out = _viscous(model, out, damping, products, six_volumes)
    return out


def _corners(model: System, x: Tensor) -> Tensor:
    return ops.tet_gather(x.reshape(-1, *x.shape[-2:]), *model._topology)


def _extrapolated(model: System, reference: Reference) -> tuple[Tensor, Tensor]:
    """n_a . n_b [m^4], [B, T, 6], and 6 V [m^3], [B, T], 0 where there is no such tet, of extrapolated products of
    edges."""
    edges = [c[..., 1:, :] - c[..., :1, :] for c in (_corners(model, reference.one), _corners(model, reference.two))]
    one, two = ([(e[..., a, :] * e[..., b, :]).sum(-1) for a, b in GRAM] for e in edges)
    xx, xy, xz, yy, yz, zz = (p + reference.weight * (q - p) for p, q in zip(one, two, strict=True))
    # cofactors: products of the normals n_1, n_2, n_3; n_0 = -(n_1 + n_2 + n_3)
    n11, n22, n33 = yy * zz - yz * yz, xx * zz - xz * xz, xx * yy - xy * xy
    n12, n13, n23 = xz * yz - xy * zz, xy * yz - xz * yy, xy * xz - yz * xx
    products = [-(n11 + n12 + n13), -(n12 + n22 + n23), -(n13 + n23 + n33), n12, n13, n23]
    square = xx * n11 + xy * n12 + xz * n13
    exists = (square.detach() > 0) & (n33.detach() > 0) & (determinant(edges[0].detach()) > 0)
    return torch.stack(products, -1), torch.where(exists, torch.where(exists, square, 1.0).sqrt(), 0.0)


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


def _viscous(model: System, prepared: Prepared, damping: Damping, products: Tensor, six_volumes: Tensor) -> Prepared:
    """products: n_a . n_b of the tets' faces where the motion starts [B, T, 6]; six_volumes: 6 V there [B, T]."""
    h, rest = prepared.settings.numbers.time_step, prepared.rest
    rest = model.rest_scalars if rest is None else rest
    given = *damping.moduli, damping.viscosity, damping.volume_viscosity
    scenes = max(len(t) for t in (products, rest, *given) if t is not None)
    shape = scenes, model.num_tets

    def of_tets(value: Tensor | None) -> Tensor:
        return products.new_zeros(shape) if value is None else ops.broadcast(value, shape)

    own = ops.broadcast(rest, (*shape, rest.shape[-1]))
    c6, weights = own[..., 6], own[..., :6]
    ratio = c6 * six_volumes
    upright = ratio.detach() > 0  # a tet that starts inside out is not damped in the step
    mu, lam, *rates = (of_tets(value) for value in given)
    all_shear, all_volume = (rate / h for rate in rates)
    shear, volume = (torch.where(upright, rate, 0.0) for rate in (all_shear, all_volume))
    ratio = torch.where(upright, ratio, 1.0)
    at_start = (c6 / 6)[..., None] * products
    out: dict[str, Any] = {}
    if model.law is not None:
        density, first = model.law.density, first_viscous(model.law.density)
        second = [at_start / ratio[..., None], torch.stack([c6 / ratio, ratio * shear, ratio * volume], -1)]
        metric = torch.cat([own[..., :first], *second, own[..., first:]], -1)
        bits = ops.bits_of_law(density, model.dtype, model.device, viscous=True)
        energies = ops.own_bits(prepared.settings.energies) | bits
        out["settings"] = replaced(prepared.settings, energies=energies)
    else:
        elastic, viscous = 2 * mu + lam, 2 * shear + volume
        total = elastic + viscous
        r = torch.where(total > 0, (elastic + ratio * viscous) / torch.where(total > 0, total, 1.0), 1.0)
        both = mu + shear + LEAST
        share = (shear / both)[..., None]
        metric = torch.cat([(weights + share * (at_start - weights)) / r[..., None], (c6 / r)[..., None]], -1)
        out |= {"mu": r * both, "lam": r * (lam + volume)}
    coarse = prepared.coarse
    if coarse is not None:  # whose matrices are those of the shape at rest
        parts = coarse_parts(model, mu + all_shear, lam + all_volume, None, metric, damping.corners,
                             coarse.fibres)  # fmt: skip
        coarse = replaced(parts, mass=coarse.mass)
    return replaced(prepared, rest=metric, coarse=coarse, **out)
