"""Particles, edges and projections that XPBD and projective dynamics share, and sums in a fixed order."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from .. import ops
from .._common.checks import (
    check_broadcast,
    check_count,
    check_dtype,
    check_kind,
    check_positive,
    check_readable,
    check_tensor,
    check_time_step,
    fail,
    name_value,
    refuse_gradient,
    vertex_mask,
)
from .._common.context import lasting_tensors
from ..mesh import TetMesh
from ..model.arguments import checked_device
from ..step.arguments import acceleration_of


class FixedSum:
    """Adds values [..., m, c] up at ``index`` [m] -> [..., size, c], each row in the order of ``index``.

    By a table of each row's values, which keeps the order on CUDA, too. It has ``size`` times the largest number of
    values of one row, and a call gathers as many values: little for meshes, but for a star of 3000 springs the table
    has 72 MB, and each call gathers 216 MB in float64.
    """

    def __init__(self, index: Tensor, size: int) -> None:
        order = torch.argsort(index, stable=True)
        count = torch.bincount(index, minlength=size)
        most = int(count.max()) if size else 0
        place = torch.arange(index.numel(), device=index.device) - (torch.cumsum(count, 0) - count)[index[order]]
        # A row with fewer values reads the zero that is appended to them.
        self.table = torch.full((size, most), index.numel(), dtype=torch.int64, device=index.device)
        self.table[index[order], place] = order

    def __call__(self, values: Tensor) -> Tensor:
        zero = values.new_zeros((*values.shape[:-2], 1, values.shape[-1]))
        return torch.cat((values, zero), -2)[..., self.table, :].sum(-2)


def placed(values: Tensor, index: Tensor, size: int, dim: int = -2) -> Tensor:
    """Zeros with ``values`` at the distinct rows ``index`` of dimension ``dim``, which has ``size`` rows."""
    shape = list(values.shape)
    shape[dim] = size
    out = values.new_zeros(shape)
    out[(..., index, *(slice(None),) * (-1 - dim))] = values
    return out


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
        along = dot(direction, bar)
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
    signs = torch.ones_like(s)
    # The smallest singular value takes the sign: of all rotations U V^T that leaves the one closest to F.
    signs[..., 2] = torch.where(torch.linalg.det(u @ vt) < 0, -1.0, 1.0)
    return u * signs[..., None, :], s * signs, vt


def _assembled(nodes: Tensor, blocks: Tensor, size: int) -> Tensor:
    """Element matrices [..., E, n, n] added up at their nodes [E, n]; in a fixed order."""
    place = nodes[:, :, None] * size + nodes[:, None, :]
    used, inverse = place.reshape(-1).unique(return_inverse=True)
    values = FixedSum(inverse, used.numel())(blocks.flatten(-3)[..., None])[..., 0]
    out = blocks.new_zeros((*blocks.shape[:-3], size * size))
    out[..., used] = values
    return out.unflatten(-1, (size, size))


class ParticleSolver:
    """Particles and edges: rest positions and rest lengths (if known), masses and pins; arguments as in ``XPBD``.

    Attributes:
        num_points: V. rest_points [m]: [V, 3] or None. mass [kg]: [V]. pinned: bool [V]. edges: int64 [C, 2].
        rest_length [m]: [C] or None.
    """

    @lasting_tensors()
    def __init__(
        self,
        points: Any,
        mass: Any,
        edges: Any,
        pinned: Any,
        dtype: torch.dtype,
        device: torch.device | str,
    ) -> None:
        check_dtype(dtype)
        device = checked_device(device)
        self.rest_points: Tensor | None = None
        if isinstance(points, bool) or not isinstance(points, (int, np.integer)):
            self.rest_points = numbers("points", points, dtype, device)
            if self.rest_points.dim() != 2 or self.rest_points.shape[1] != 3:
                fail("points", "shape [V, 3], or a number of particles", f"shape {list(self.rest_points.shape)}")
            points = self.rest_points.shape[0]
        points = self.num_points = check_count("points", points, 0, 2**31 - 1)
        self.pinned = vertex_mask(pinned, points).to(device)
        mass = numbers("mass", mass, dtype, device)
        if mass.shape not in ((), (points,)):
            fail("mass", f"a number or shape [{points}]", f"shape {list(mass.shape)}")
        self.mass = mass.expand(points).clone()
        self._check_mass(self.mass)
        self.edges = checked_edges(edges, points, device)
        self.rest_length: Tensor | None = None
        if self.rest_points is not None:
            ends = self.rest_points[self.edges]
            self.rest_length = torch.linalg.vector_norm(ends[:, 0] - ends[:, 1], dim=-1)

    def _check_mass(self, mass: Tensor) -> None:
        wrong = ~(torch.isfinite(mass) & (mass > 0) | self.pinned)
        if bool(wrong.any()):
            fail("mass", "finite numbers > 0 kg where not pinned", float(mass[wrong][0]))

    def begin(
        self,
        x: Tensor,
        v: Tensor,
        *,
        mass: float | Tensor | None,
        time_step: float,
        force: Tensor | None,
        gravity: Sequence[float] | Tensor,
        prescribed: Tensor | None,
    ) -> tuple[Tensor, Tensor]:
        """Predictor y = x + h v + h^2 (gravity + force / m) [m], pinned particles in place, shape of x; and masses."""
        for name, value in (("x", x), ("v", v)):
            self.tensor(name, value)
            if value.dim() < 2 or value.shape[-2:] != (self.num_points, 3):
                fail(name, f"shape [..., {self.num_points}, 3]", f"shape {list(value.shape)}")
        if v.shape != x.shape:
            fail("v", f"x's shape {list(x.shape)}", f"shape {list(v.shape)}")
        h, pinned = check_time_step(time_step, self.mass.dtype), self.pinned[:, None]
        masses = self.mass if mass is None else self.per("mass", mass, x, self.num_points)
        if mass is not None and not masses.is_cuda:  # on CUDA a look would wait for the device
            self._check_mass(masses.detach())
        gravity = self.like("gravity", gravity if isinstance(gravity, Tensor) else acceleration_of(gravity, x), x)
        acceleration = gravity
        if force is not None:
            # Pinned particles may have no mass: neither 0 / 0 nor its NaN may reach a gradient.
            force = torch.where(pinned, 0.0, self.like("force", force, x))
            acceleration = acceleration + force / torch.where(self.pinned, 1.0, masses)[..., None]
        # The predictor is also where sweeps start; pinned particles keep the place that they have in it.
        held_at = x if prescribed is None else self.like("prescribed", prescribed, x)
        y = torch.where(pinned, held_at, x + h * v + (h * h) * acceleration)
        # One look at what they make tells whether to look at each: values that are not used may be NaN.
        if not y.is_cuda and not (all_finite(y) and all_finite(x)):
            check_finite(x=x, v=v, gravity=gravity, force=force, prescribed=prescribed)
            fail("x, v, force, mass, time_step", "a finite predictor x + h v + h^2 (gravity + force / m)", "NaN or Inf")
        return y, masses

    def lengths(self, rest_length: float | Tensor | None, x: Tensor) -> Tensor:
        """Rest lengths of a step [m], [..., C]."""
        count = self.edges.shape[0]
        if rest_length is None and self.rest_length is None and count:
            fail("rest_length", "a value, because the solver was made without rest positions", None)
        given = self.rest_length if rest_length is None else rest_length
        return self.per("rest_length", x.new_zeros(0) if given is None else given, x, count, ">= 0")

    def tensor(self, name: str, value: Any) -> Tensor:
        """``value`` as a tensor of the solver's dtype and device; numbers are converted, other tensors must match."""
        return check_tensor(name, value, self.mass, owner="the solver's")

    def like(self, name: str, value: Any, x: Tensor) -> Tensor:
        """A value that broadcasts to x, broadcast."""
        return ops.broadcast(check_broadcast(name, self.tensor(name, value), tuple(x.shape)), x.shape)

    def per(self, name: str, value: Any, x: Tensor, count: int, least: str = "") -> Tensor:
        """A value that broadcasts to x.shape[:-2] + (count,), as [..., count].

        ``least``: "> 0" (and perhaps inf), ">= 0" (and finite), or no check.
        """
        value = check_broadcast(name, self.tensor(name, value), (*x.shape[:-2], count))
        value = value.reshape(1) if value.dim() == 0 else value
        if least and not value.is_cuda:  # on CUDA a look would wait for the device
            wrong = ~((value > 0) if least == "> 0" else (value >= 0) & torch.isfinite(value))
            if bool(wrong.any()):
                fail(name, f"{'' if least == '> 0' else 'finite '}numbers {least}", float(value.detach()[wrong][0]))
        return ops.broadcast(value, (*value.shape[:-1], count))


def dot(a: Tensor, b: Tensor) -> Tensor:
    """[..., c] each -> [..., 1]."""
    return (a * b).sum(-1, keepdim=True)


def all_finite(value: Tensor) -> bool:
    return bool(torch.isfinite(value).all())


def check_finite(**values: Any) -> None:
    """Raises ValueError for the first tensor that is not finite."""
    for name, value in values.items():
        if isinstance(value, Tensor):
            name_value(name, "finite values", value.detach(), torch.isfinite(value))


def numbers(name: str, value: Any, dtype: torch.dtype, device: torch.device | str) -> Tensor:
    """Constants of a solver as a tensor of its own."""
    refuse_gradient(name, value, "a step takes what is differentiated")
    try:
        if not isinstance(value, Tensor):
            value = torch.from_numpy(np.array(value, dtype=np.float64))  # a copy, of what may be write-protected
        check_readable(name, value)
        out = value.detach().to(device, dtype)
    except (TypeError, ValueError, RuntimeError, OverflowError):
        raise TypeError(f"{name}: expected numbers, got {type(value).__name__}") from None
    if not bool(torch.isfinite(out).all()):
        fail(name, "finite numbers", "NaN or Inf")
    return out


def checked_edges(edges: Any, num_points: int, device: torch.device | str) -> Tensor:
    """Pairs of different particles, int64 [C, 2]."""
    try:
        out = torch.as_tensor(edges).to(device)
    except (TypeError, ValueError, RuntimeError):
        raise TypeError(f"edges: expected pairs of indices, got {type(edges).__name__}") from None
    if out.numel() == 0:  # an empty list has neither two columns nor an integer dtype
        return torch.zeros((0, 2), dtype=torch.int64, device=device)
    if out.is_floating_point() or out.dtype == torch.bool:
        raise TypeError(f"edges: expected integers, got {out.dtype}")
    if out.dim() != 2 or out.shape[1] != 2:
        fail("edges", "shape [C, 2]", f"shape {list(out.shape)}")
    wrong = (out < 0).any(1) | (out >= num_points).any(1) | (out[:, 0] == out[:, 1])
    if bool(wrong.any()):
        fail("edges", f"two different indices from 0 to {num_points - 1}", out[wrong][0].tolist())
    return out.to(torch.int64)


def mesh_edges(mesh: TetMesh) -> np.ndarray:
    """The edges of a mesh, each once, lower vertex first, sorted, shape [C, 2]."""
    edges = mesh.tets[:, [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]]].reshape(-1, 2)
    return np.unique(np.sort(edges, axis=1), axis=0)


def mesh_mass(mesh: TetMesh, density: float) -> np.ndarray:
    """Lumped masses m_i = sum of density V / 4 over the tets of a vertex [kg], shape [V]; constants."""
    check_kind("mesh", mesh, TetMesh)
    quarter = np.repeat(check_positive("density", density, "kg/m^3") * mesh.volume / 4, 4)
    return np.bincount(mesh.tets.reshape(-1), quarter, minlength=mesh.num_vertices)
