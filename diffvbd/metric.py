"""Rest quantities of a mesh: volumes, the four scalars per (vertex, tet) pair, masses. Ordinary torch, differentiable.

Written without matrix products, so that autocast leaves the precision alone.
"""

from __future__ import annotations

import torch
from torch import Tensor

from . import ops


def cross(a: Tensor, b: Tensor) -> Tensor:
    """Cross product over the last dimension, [..., 3]."""
    ax, ay, az = a.unbind(-1)
    bx, by, bz = b.unbind(-1)
    return torch.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], -1)


def rest_metric(corners: Tensor) -> tuple[Tensor, Tensor]:
    """Rest scalars and volumes of tets.

    Args:
        corners: Rest positions of the tets' corners [m], shape [B, T, 4, 3].

    Returns:
        rest: k01 k02 k03 k12 k13 k23 [m] and c6 [1/m^3] of each tet, shape [B, T, 7], where
            k_ab = V grad N_a . grad N_b and c6 = 1 / (6 V).
        volume: Signed volumes V [m^3], shape [B, T].

    Source: docs/method.md, section 2.
    """
    p0 = corners[..., 0, :]
    e1, e2, e3 = (corners[..., a, :] - p0 for a in (1, 2, 3))
    # grad N_a = n_a / (6 V); the normals n_a of the opposite faces sum to zero
    n1, n2, n3 = cross(e2, e3), cross(e3, e1), cross(e1, e2)
    n0 = -(n1 + n2 + n3)
    six_volumes = (e1 * n1).sum(-1)
    normals = (n0, n1, n2, n3)
    pairs = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))
    dots = torch.stack([(normals[a] * normals[b]).sum(-1) for a, b in pairs], -1)
    weights = dots / (6.0 * six_volumes)[..., None]
    return torch.cat([weights, (1.0 / six_volumes)[..., None]], -1), six_volumes / 6.0


def lumped_mass(density: Tensor, volume: Tensor, tets: Tensor, star_ptr: Tensor, star: Tensor) -> Tensor:
    """m_i = sum over incident tets of density V / 4 [kg]; density, volume [B, T] -> [B, V]."""
    quarter = (0.25 * density * volume)[..., None, None]
    return ops.star_sum(quarter.expand(*quarter.shape[:2], 4, 1), tets, star_ptr, star)[..., 0]
