"""The two energies of projective dynamics: what a constraint measures, what that projects to, both transposed."""

from __future__ import annotations

import torch
from torch import Tensor

from .sums import FixedSum


class Springs:
    """k/2 |d - L n|^2 with d = xa - xb and n = d / |d|: the energy k/2 (|d| - L)^2 of a spring.

    Where d = 0 there is no direction: n = 0, and so is its derivative.

    Args:
        edges: The two particles of each spring, int64 [C, 2].
        num_points: V.

    Source: Bouaziz et al., "Projective Dynamics", ACM TOG 33(4), 2014.
    """

    def __init__(self, edges: Tensor, num_points: int) -> None:
        self.a, self.b = edges.unbind(1)
        self.collect = FixedSum(torch.cat((self.a, self.b)), num_points)
        self.nodes, self.num_points = edges, num_points

    def measure(self, x: Tensor) -> Tensor:
        """d [m] [..., C, 3] of positions x [m] [..., V, 3]."""
        return x[..., self.a, :] - x[..., self.b, :]

    def transpose(self, bar: Tensor) -> Tensor:
        """Transpose of :meth:`measure`, [..., C, 3] -> [..., V, 3]; of spring forces [N] those on the particles."""
        return self.collect(torch.cat((bar, -bar), -2))

    def project(self, d: Tensor, rest_length: Tensor) -> Tensor:
        """L n [m] [..., C, 3] of d [m] [..., C, 3] and rest lengths L [m] [..., C]."""
        direction, _, _ = direction_of(d)
        return rest_length[..., None] * direction

    def project_vjp(self, d: Tensor, rest_length: Tensor, bar: Tensor) -> tuple[Tensor, Tensor]:
        """Adjoints of d [..., C, 3] and of rest_length [..., C], from that of L n [..., C, 3]."""
        direction, inverse, _ = direction_of(d)
        along = (direction * bar).sum(-1, keepdim=True)
        # n turns only by what is across it; along it, d changes nothing and L everything
        return rest_length[..., None] * inverse * (bar - along * direction), along[..., 0]

    def matrix(self, weight: Tensor) -> Tensor:
        """S^T w S [N/m] [..., V, V] of weights w [N/m] [..., C], S x = d: the same for each of the three components."""
        weight = weight[..., None, None]
        one = torch.ones((1, 2), dtype=weight.dtype, device=weight.device)
        one[:, 1] = -1
        return _assembled(self.nodes, weight * (one[:, :, None] * one[:, None, :]), self.num_points)


class Tets:
    """w/2 |F - R|^2 with the deformation gradient F and the rotation R closest to it (det R = 1); w = stiffness volume.

    F = U S V^T with rotations U, V and singular values s1 >= s2 >= |s3|, where s3 < 0 if det F < 0; R = U V^T. R has no
    derivative where s2 + s3 = 0; below ``GUARD`` s1 the two terms that divide by such a sum are dropped.

    Args:
        tets: Corners, int64 [T, 4], of positive volume.
        points: Rest positions [m], shape [V, 3].

    Attributes:
        gradients: Gradients of the shape functions at rest [1/m], [T, 4, 3]. volume: Of the tets at rest [m^3], [T].

    Source: Bouaziz et al., "Projective Dynamics", ACM TOG 33(4), 2014.
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
        """F = sum over a of x_a grad N_a^T [-] [..., T, 3, 3] of positions x [m] [..., V, 3]."""
        # By edges, because grad N sums to zero: x_a of a body far from the origin would cost F digits, and F - R more.
        corners = x[..., self.nodes, :]
        edges = corners[..., 1:, :] - corners[..., :1, :]
        return edges.transpose(-1, -2) @ self.gradients[:, 1:]

    def transpose(self, bar: Tensor) -> Tensor:
        """Transpose of :meth:`measure`, [..., T, 3, 3] -> [..., V, 3]; of volume times stress [N m] forces [N]."""
        corners = self.gradients @ bar.transpose(-1, -2)  # [..., T, 4, 3]
        return self.collect(corners.transpose(-3, -2).flatten(-3, -2))

    def project(self, f: Tensor) -> Tensor:
        """R [..., T, 3, 3] of F [..., T, 3, 3]; both have no unit."""
        u, _, vt = _signed_svd(f)
        return u @ vt

    def project_vjp(self, f: Tensor, bar: Tensor) -> Tensor:
        """Adjoint of F from that of R, both [..., T, 3, 3]: U [(M - M^T)_ij / (s_i + s_j)] V^T with M = U^T R_bar V.

        For dF = U dA V^T the rotation changes by U W V^T, where W is skew and W_ij (s_i + s_j) = dA_ij - dA_ji.
        """
        u, s, vt = _signed_svd(f)
        m = u.transpose(-1, -2) @ bar @ vt.transpose(-1, -2)
        # Sums, where the derivative of U or V alone divides by differences: finite at rest, where all s are 1.
        sums = s[..., :, None] + s[..., None, :]
        safe = sums > self.GUARD * s[..., :1, None]
        inner = torch.where(safe, (m - m.transpose(-1, -2)) / torch.where(safe, sums, 1.0), 0.0)
        return u @ inner @ vt

    def matrix(self, weight: Tensor) -> Tensor:
        """S^T w S [N/m] [..., V, V] of weights w [N m] [..., T], S x = F: sums of w grad N_a . grad N_b."""
        blocks = self.gradients @ self.gradients.transpose(-1, -2)
        return _assembled(self.nodes, weight[..., None, None] * blocks, self.num_points)


def direction_of(d: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """d / |d| [..., C, 3], 1 / |d| and |d| [..., C, 1] of d [..., C, 3]; where d = 0, all three are 0."""
    length = torch.linalg.vector_norm(d, dim=-1, keepdim=True)
    inverse = torch.where(length > 0, 1 / torch.where(length > 0, length, 1.0), 0.0)
    return d * inverse, inverse, length


def _signed_svd(f: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """U, s, V^T with det(U V^T) = 1; the sign goes into the last column of U and the last singular value."""
    u, s, vt = torch.linalg.svd(f)
    # The smallest singular value takes the sign: of all rotations U V^T that leaves the one closest to F.
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
