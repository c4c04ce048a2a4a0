"""Projective dynamics in plain torch: local projections and a dense solve, differentiated by autograd."""

from typing import Any

import torch
from torch import Tensor

POLAR_ITERATIONS = 12  # R <- (R + R^-T) / 2 squares its error, once that is below 1


def step(
    x: Tensor,
    v: Tensor,
    *,
    rest_points: Tensor,
    edges: Tensor,
    tets: Tensor,
    pinned: Tensor,
    mass: Tensor,
    stiffness: Any,
    tet_stiffness: Any,
    rest_length: Any,
    time_step: float,
    sweeps: int,
    force: Tensor | None = None,
    gravity: Any = (0.0, -9.81, 0.0),
    prescribed: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """One time step; every tensor argument but rest_points is differentiable by autograd.

    x, v: [..., V, 3] [m, m/s]; rest_points [V, 3]; edges [C, 2], tets [T, 4], either may be empty; pinned [V] bool.
    mass [kg] broadcasts to [..., V], stiffness [N/m] and rest_length [m] to [..., C], tet_stiffness [Pa] to [..., T];
    force [N], gravity [m/s^2] and prescribed [m] to x. Valid while det F > 0. Source: Bouaziz et al. 2014.
    Returns (x', v').
    """
    h, count = time_step, x.shape[-2]
    mass, stiffness, tet_stiffness, rest_length, gravity = (
        torch.as_tensor(value, dtype=x.dtype, device=x.device)
        for value in (mass, stiffness, tet_stiffness, rest_length, gravity)
    )
    mass = mass.expand(*mass.shape[:-1], count)
    stiffness = stiffness.expand(*stiffness.shape[:-1], len(edges))
    difference = _difference(edges, count, x)  # [C, V]
    gradient, volume = _gradient(rest_points, tets)  # [T, 3, V], [T]
    weight = tet_stiffness * volume

    a = torch.diag_embed(mass)
    a = a + h**2 * torch.einsum("cu,...c,cv->...uv", difference, stiffness, difference)
    a = a + h**2 * torch.einsum("tdu,...t,tdv->...uv", gradient, weight, gradient)
    push = torch.zeros_like(x) if force is None else force
    y = x + h * v + h**2 * (gravity + push / mass.unsqueeze(-1))
    fixed = pinned.unsqueeze(-1)
    y = torch.where(fixed, x if prescribed is None else prescribed, y)

    free = (~pinned).nonzero().flatten()
    system = a[..., free, :][..., free]
    position = y
    for _ in range(sweeps):
        d = difference @ position
        unit = d / torch.linalg.vector_norm(d, dim=-1, keepdim=True)
        f = torch.einsum("...vc,tdv->...tcd", position, gradient)
        rotation = polar(f)
        # A residual of small differences, solved for the change: b - A x would subtract two large numbers, and the
        # position itself would carry the error of the whole solve.
        pull = stiffness.unsqueeze(-1) * (rest_length.unsqueeze(-1) * unit - d)
        residual = mass.unsqueeze(-1) * (y - position)
        residual = residual + h**2 * torch.einsum("cv,...cd->...vd", difference, pull)
        residual = residual + h**2 * torch.einsum("tdv,...t,...tcd->...vc", gradient, weight, rotation - f)
        change = torch.linalg.solve(system, residual[..., free, :])
        position = position.index_add(-2, free, change)
    return position, (position - x) / h


def polar(f: Tensor) -> Tensor:
    """The rotation closest to f [..., 3, 3], det f > 0, by Newton's iteration (Higham 1986)."""
    for _ in range(POLAR_ITERATIONS):
        a, b, c = f.unbind(-1)
        cofactor = torch.stack((torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)), -1)
        f = (f + cofactor / (a * cofactor[..., 0]).sum(-1)[..., None, None]) / 2
    return f


def _difference(edges: Tensor, count: int, like: Tensor) -> Tensor:
    out = like.new_zeros(len(edges), count)
    for row, (a, b) in enumerate(edges.tolist()):
        out[row, a], out[row, b] = 1, -1
    return out


def _gradient(points: Tensor, tets: Tensor) -> tuple[Tensor, Tensor]:
    """Gradients of the shape functions, [T, 3, V], and volumes."""
    out, volume = points.new_zeros(len(tets), 3, len(points)), points.new_zeros(len(tets))
    for row, corners in enumerate(tets.tolist()):
        # Shape functions are affine: their coefficients solve [1 p] c = I.
        affine = torch.cat((points.new_ones(4, 1), points[corners]), 1)
        out[row][:, corners] = torch.linalg.inv(affine)[1:]
        volume[row] = torch.linalg.det(affine) / 6
    return out, volume
