"""Rest quantities of a mesh: volumes, the four scalars per (vertex, tet) pair, masses. Ordinary torch, differentiable.

Written on single components, without matrix products: fast on a million tets, and autocast leaves the precision alone.
"""

from __future__ import annotations

import torch
from torch import Tensor

from .. import ops

_Vector = tuple[Tensor, ...]  # three components


def _cross(a: _Vector, b: _Vector) -> _Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def _dot(a: _Vector, b: _Vector) -> Tensor:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


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
    p = [tuple(corners[..., a, c].contiguous() for c in range(3)) for a in range(4)]
    e1, e2, e3 = (tuple(p[a][c] - p[0][c] for c in range(3)) for a in (1, 2, 3))
    # grad N_a = n_a / (6 V); the normals n_a of the opposite faces sum to zero
    n1, n2, n3 = _cross(e2, e3), _cross(e3, e1), _cross(e1, e2)
    n0 = tuple(-(n1[c] + n2[c] + n3[c]) for c in range(3))
    six_volumes = _dot(e1, n1)
    c6 = 1.0 / six_volumes
    scale = c6 / 6.0
    weights = [_dot(a, b) * scale for a, b in ((n0, n1), (n0, n2), (n0, n3), (n1, n2), (n1, n3), (n2, n3))]
    return torch.stack([*weights, c6], -1), six_volumes / 6.0


def lumped_mass(density: Tensor, volume: Tensor, tets: Tensor, star_ptr: Tensor, star: Tensor) -> Tensor:
    """m_i = sum over incident tets of density V / 4 [kg]; density, volume [B, T] -> [B, V]."""
    quarter = (0.25 * density * volume)[..., None, None]
    return ops.star_sum(quarter.expand(*quarter.shape[:2], 4, 1), tets, star_ptr, star, positive=True)[..., 0]


def shape_gradients(corners: Tensor) -> tuple[Tensor, Tensor]:
    """Gradients of the shape functions of tets at their corners [1/m], shape of corners, and signed volumes [m^3].

    Args:
        corners: Rest positions of the tets' corners [m], shape [..., T, 4, 3].
    """
    p = [tuple(corners[..., a, c].contiguous() for c in range(3)) for a in range(4)]
    e1, e2, e3 = (tuple(p[a][c] - p[0][c] for c in range(3)) for a in (1, 2, 3))
    n1, n2, n3 = _cross(e2, e3), _cross(e3, e1), _cross(e1, e2)
    six_volumes = _dot(e1, n1)
    scale = 1.0 / six_volumes
    rows = [tuple(n[c] * scale for c in range(3)) for n in (n1, n2, n3)]
    first = tuple(-(rows[0][c] + rows[1][c] + rows[2][c]) for c in range(3))
    flat = torch.stack([component for row in (first, *rows) for component in row], -1)
    return flat.unflatten(-1, (4, 3)), six_volumes / 6.0
