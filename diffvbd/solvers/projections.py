"""The two energies of projective dynamics: what a constraint measures, what that projects to, both transposed."""

from __future__ import annotations

import torch
from torch import Tensor

from .sums import FixedSum


class Springs:
    """k/2 |d - L n|^2 with d = xa - xb and n = d / |d|: the energy k/2 (|d| - L)^2 of a spring.

    Where d = 0 there is no direction: n = 0, and so is its derivative.
    """

    def __init__(self, edges: Tensor, num_points: int) -> None:
        self.a, self.b = edges.unbind(1)
        self.collect = FixedSum(torch.cat((self.a, self.b)), num_points)
        self.nodes, self.num_points = edges, num_points

    def measure(self, x: Tensor) -> Tensor:
        """d [..., C, 3] [m]."""
        return x[..., self.a, :] - x[..., self.b, :]

    def transpose(self, bar: Tensor) -> Tensor:
        """Transpose of :meth:`measure`, [..., V, 3]."""
        return self.collect(torch.cat((bar, -bar), -2))

    def project(self, d: Tensor, rest_length: Tensor) -> Tensor:
        """L n [..., C, 3]."""
        direction, _ = _direction(d)
        return rest_length[..., None] * direction

    def project_vjp(self, d: Tensor, rest_length: Tensor, bar: Tensor) -> tuple[Tensor, Tensor]:
        """Adjoints of d and of rest_length."""
        direction, inverse = _direction(d)
        along = (direction * bar).sum(-1, keepdim=True)
        return rest_length[..., None] * inverse * (bar - along * direction), along[..., 0]

    def matrix(self, weight: Tensor) -> Tensor:
        """Sum of weight d^T d as a matrix over the particles, [..., V, V]."""
        weight = weight[..., None, None]
        one = torch.ones((1, 2), dtype=weight.dtype, device=weight.device)
        one[:, 1] = -1
        return _assembled(self.nodes, weight * (one[:, :, None] * one[:, None, :]), self.num_points)


class Tets:
    """w/2 |F - R|^2 with the deformation gradient F and the rotation R closest to it (det R = 1); w = stiffness volume.

    F = U S V^T with rotations U, V and singular values s1 >= s2 >= |s3|, where s3 < 0 if det F < 0; R = U V^T. R has no
    derivative where s2 + s3 = 0; below ``GUARD`` s1 the two terms that divide by such a sum are dropped.
    """

    GUARD = 1e-12  # relative; above it the terms are exact, however large

    def __init__(self, tets: Tensor, points: Tensor) -> None:
        edges = points[tets[:, 1:]] - points[tets[:, :1]]  # rows: edges of a tet
        inner = torch.linalg.inv(edges).transpose(-1, -2)  # rows: grad N of corners 1, 2, 3
        self.gradients = torch.cat((-inner.sum(1, keepdim=True), inner), 1)  # [T, 4, 3]
        self.volume = torch.linalg.det(edges) / 6
        self.collect = FixedSum(tets.T.reshape(-1), points.shape[0])
        self.nodes, self.num_points = tets, points.shape[0]

    def measure(self, x: Tensor) -> Tensor:
        """F = sum over a of x_a grad N_a^T, [..., T, 3, 3]."""
        return x[..., self.nodes, :].transpose(-1, -2) @ self.gradients

    def transpose(self, bar: Tensor) -> Tensor:
        """Transpose of :meth:`measure`, [..., V, 3]."""
        corners = self.gradients @ bar.transpose(-1, -2)  # [..., T, 4, 3]
        return self.collect(corners.transpose(-3, -2).flatten(-3, -2))

    def project(self, f: Tensor) -> Tensor:
        """R [..., T, 3, 3]."""
        u, _, vt = _signed_svd(f)
        return u @ vt

    def project_vjp(self, f: Tensor, bar: Tensor) -> Tensor:
        """Adjoint of F: U [(M - M^T)_ij / (s_i + s_j)] V^T with M = U^T R_bar V.

        For dF = U dA V^T the rotation changes by U W V^T, where W is skew and W_ij (s_i + s_j) = dA_ij - dA_ji.
        """
        u, s, vt = _signed_svd(f)
        m = u.transpose(-1, -2) @ bar @ vt.transpose(-1, -2)
        sums = s[..., :, None] + s[..., None, :]
        safe = sums > self.GUARD * s[..., :1, None]
        inner = torch.where(safe, (m - m.transpose(-1, -2)) / torch.where(safe, sums, 1.0), 0.0)
        return u @ inner @ vt

    def matrix(self, weight: Tensor) -> Tensor:
        """Sum of weight grad N_a . grad N_b as a matrix over the particles, [..., V, V]."""
        blocks = self.gradients @ self.gradients.transpose(-1, -2)
        return _assembled(self.nodes, weight[..., None, None] * blocks, self.num_points)


def _direction(d: Tensor) -> tuple[Tensor, Tensor]:
    """d / |d| and 1 / |d|, both 0 where d = 0."""
    length = torch.linalg.vector_norm(d, dim=-1, keepdim=True)
    inverse = torch.where(length > 0, 1 / torch.where(length > 0, length, 1.0), 0.0)
    return d * inverse, inverse


def _signed_svd(f: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """U, s, V^T with det(U V^T) = 1; the sign goes into the last column of U and the last singular value."""
    u, s, vt = torch.linalg.svd(f)
    last = torch.where(torch.linalg.det(u @ vt) < 0, -1.0, 1.0)
    signs = torch.ones_like(s)
    signs[..., 2] = last
    return u * signs[..., None, :], s * signs, vt


def _assembled(nodes: Tensor, blocks: Tensor, size: int) -> Tensor:
    """Element matrices [..., E, n, n] added up at their nodes [E, n]; in a fixed order."""
    place = nodes[:, :, None] * size + nodes[:, None, :]
    used, inverse = place.reshape(-1).unique(return_inverse=True)
    values = FixedSum(inverse, used.numel())(blocks.flatten(-3)[..., None])[..., 0]
    out = blocks.new_zeros((*blocks.shape[:-3], size * size))
    out[..., used] = values
    return out.unflatten(-1, (size, size))
