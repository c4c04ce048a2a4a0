"""Rest quantities of a mesh: volumes, the four scalars per (vertex, tet) pair, masses. Ordinary torch, differentiable.

Written on single components, without matrix products: fast on a million tets, and autocast leaves the precision alone.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from .. import ops
from .._common.checks import NUMBERS, check_broadcast, check_readable, check_tensor, fail, name_value, to_float
from .._common.context import looks_at

_Vector = tuple[Tensor, ...]  # three components


def cross(a: _Vector, b: _Vector) -> _Vector:
    """By components, as dot()."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def dot(a: _Vector, b: _Vector) -> Tensor:
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
    normals, six_volumes = face_normals(corners)
    c6 = 1.0 / six_volumes
    return torch.stack([*stiffness_weights(normals, c6), c6], -1), six_volumes / 6.0


def face_normals(corners: Tensor) -> tuple[list[_Vector], Tensor]:
    """Normals n_a [m^2] of the faces opposite the corners of tets, by components, and 6 V [m^3].

    grad N_a = n_a / (6 V); the four normals sum to zero. corners: [..., T, 4, 3].
    """
    p = [tuple(corners[..., a, c].contiguous() for c in range(3)) for a in range(4)]
    e1, e2, e3 = (tuple(p[a][c] - p[0][c] for c in range(3)) for a in (1, 2, 3))
    n1, n2, n3 = cross(e2, e3), cross(e3, e1), cross(e1, e2)
    n0 = tuple(-(n1[c] + n2[c] + n3[c]) for c in range(3))
    return [n0, n1, n2, n3], dot(e1, n1)


def stiffness_weights(normals: list[_Vector], c6: Tensor) -> list[Tensor]:
    """k01 k02 k03 k12 k13 k23 = c6 / 6 n_a . n_b [m]."""
    scale = c6 / 6.0
    return [dot(normals[a], normals[b]) * scale for a, b in ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))]


def lumped_mass(density: Tensor, volume: Tensor, tets: Tensor, star_ptr: Tensor, star: Tensor) -> Tensor:
    """m_i = sum over incident tets of density V / 4 [kg]; density, volume [B, T] -> [B, V]."""
    quarter = (0.25 * density * volume)[..., None, None]
    return ops.star_sum(quarter.expand(*quarter.shape[:2], 4, 1), tets, star_ptr, star, positive=True)[..., 0]


def shape_gradients(corners: Tensor) -> tuple[Tensor, Tensor]:
    """Gradients of the shape functions of tets at their corners [1/m], shape of corners, and signed volumes [m^3].

    Args:
        corners: Rest positions of the tets' corners [m], shape [..., T, 4, 3].
    """
    normals, six_volumes = face_normals(corners)
    scale = 1.0 / six_volumes
    flat = torch.stack([component * scale for normal in normals for component in normal], -1)
    return flat.unflatten(-1, (4, 3)), six_volumes / 6.0


# --- stress-free deformation ------------------------------------------------------------------------------------------


def deformed(corners: Tensor, by: Tensor) -> Tensor:
    """Corners of tets [B, T, 4, 3] whose edges from the first corner a deformation [B, T, 3, 3] has turned and
    stretched; the first corner becomes the origin."""
    edges = corners[..., 1:, :] - corners[..., :1, :]
    out = sum(by[..., None, :, c] * edges[..., c, None] for c in range(3))
    assert isinstance(out, Tensor)
    return torch.cat([torch.zeros_like(out[..., :1, :]), out], -2)


def determinant(matrix: Tensor) -> Tensor:
    """Of matrices [..., 3, 3], without LAPACK."""
    rows = [tuple(matrix[..., r, c] for c in range(3)) for r in range(3)]
    return dot(rows[0], cross(rows[1], rows[2]))


def fibre_contraction(directions: Tensor, activation: float | Tensor) -> Tensor:
    """Stress-free deformation of contracting fibres, for the input ``stress_free``.

        G = (1 - a) d d^T + (1 - a)^(-1/2) (I - d d^T)

    At rest a tet is shorter by the fraction a along its fibre and thicker across it, at the same volume.

    Args:
        directions: Fibres d at rest, of any length but 0, shape [..., T, 3].
        activation: a < 1 [-], a number or a tensor that broadcasts to directions.shape[:-1]; a < 0 extends.

    Returns:
        G [..., T, 3, 3], differentiable in both.

    Raises:
        ValueError, TypeError: Naming the argument, what was expected and what came. Values of tensors on CUDA are
            looked at only inside debug_checks().

    Source: multiplicative decomposition F = F_e G (Rodriguez, Hoger, McCulloch 1994).
    """
    if not isinstance(directions, Tensor) or not directions.is_floating_point():
        raise TypeError(f"directions: expected a tensor of floating point, got {type(directions).__name__}")
    if directions.dim() < 1 or directions.shape[-1] != 3:
        fail("directions", "shape [..., T, 3]", f"shape {list(directions.shape)}")
    square = directions.square().sum(-1, keepdim=True)
    _check("directions", square, "directions of finite length > 0", square > 0)
    activation = _value("activation", activation)
    _check("activation", activation, "numbers below 1", activation < 1)
    along = 1 - torch.as_tensor(activation, dtype=directions.dtype, device=directions.device)
    try:
        along = along.expand(torch.broadcast_shapes(along.shape, directions.shape[:-1]))[..., None, None]
    except RuntimeError:
        fail("activation", f"a shape that broadcasts to {list(directions.shape[:-1])}", f"shape {list(along.shape)}")
    unit = directions / square.sqrt()
    fibre = unit[..., :, None] * unit[..., None, :]
    eye = torch.eye(3, dtype=unit.dtype, device=unit.device)
    return along * fibre + along.rsqrt() * (eye - fibre)


# --- young's modulus and poisson's ratio in place of the lame parameters ----------------------------------------------


def lame(young: float | Tensor, poisson: float | Tensor) -> tuple[Any, Any]:
    """Lame parameters of a linear isotropic material; near the rest shape it is what the bodies are made of.

        mu = E / (2 (1 + nu)),    lam = E nu / ((1 + nu) (1 - 2 nu))

    Args:
        young: Young's modulus E >= 0 [Pa], a number or a tensor of any shape.
        poisson: Poisson's ratio nu in (-1, 0.5) [-], likewise; the two broadcast together.

    Returns:
        mu and lam [Pa]: numbers where both arguments are, else tensors, differentiable by torch.

    Raises:
        ValueError, TypeError: Naming the argument, what was expected and what came. Values of tensors on CUDA are
            looked at only inside debug_checks().
    """
    young, poisson = _values(young=young, poisson=poisson)
    _check("young", young, "finite numbers >= 0 Pa", young >= 0)
    _check("poisson", poisson, "numbers above -1 and below 0.5", (poisson > -1) & (poisson < 0.5))
    young, poisson = _alike(young, poisson)
    mu = young / (2 * (1 + poisson))
    return mu, 2 * mu * poisson / (1 - 2 * poisson)


def young_poisson(mu: float | Tensor, lam: float | Tensor) -> tuple[Any, Any]:
    """Young's modulus E [Pa] and Poisson's ratio nu [-] of Lame parameters, the inverse of :func:`lame`.

        E = mu (3 lam + 2 mu) / (lam + mu),    nu = lam / (2 (lam + mu))

    Args:
        mu: Shear modulus >= 0 [Pa], a number or a tensor of any shape.
        lam: First Lame parameter [Pa], likewise; the two broadcast together, and mu + lam > 0.

    Returns:
        E and nu: numbers where both arguments are, else tensors, differentiable by torch.

    Raises:
        ValueError, TypeError: As :func:`lame`.
    """
    mu, lam = _values(mu=mu, lam=lam)
    _check("mu", mu, "finite numbers >= 0 Pa", mu >= 0)
    mu, lam = _alike(mu, lam)
    total = lam + mu
    _check("lam", total, "mu + lam > 0 Pa, finite", total > 0)
    return mu * (3 * lam + 2 * mu) / total, lam / (2 * total)


def moduli_of(model: Any, lead: tuple[int, ...], mu: Any, lam: Any, young: Any, poisson: Any) -> tuple[Any, Any]:
    """mu and lam of a step that was given either pair; ``lead``: shape of the scenes."""
    if young is None and poisson is None:
        for name, value in (("mu", mu), ("lam", lam)):
            if value is None:
                raise TypeError(f"{name}: expected a number or a tensor (mu and lam, or young and poisson), got None")
        return mu, lam
    for name, value in (("mu", mu), ("lam", lam)):
        if value is not None:
            raise TypeError(f"{name}: expected mu and lam, or young and poisson, got a mixture of both")
    pair = {"young": young, "poisson": poisson}
    for name, value in pair.items():
        if value is None:
            raise TypeError(f"{name}: expected a number or a tensor (young and poisson together), got None")
        if isinstance(value, Tensor):
            check_tensor(name, value, model._mass)
            check_broadcast(name, value, (*lead, model.num_tets), len(lead))
    if isinstance(young, Tensor) != isinstance(poisson, Tensor):
        pair = {name: check_tensor(name, value, model._mass) for name, value in pair.items()}
    return lame(pair["young"], pair["poisson"])


def _values(**given: Any) -> list[Any]:
    """Two values that broadcast together."""
    values = [_value(name, value) for name, value in given.items()]
    if all(isinstance(value, Tensor) for value in values):
        try:
            torch.broadcast_shapes(*(value.shape for value in values))
        except RuntimeError:
            (first, one), (name, other) = zip(given, values, strict=True)
            fail(name, f"a shape that broadcasts with {list(one.shape)}, that of {first}", f"shape {list(other.shape)}")
    return values


def _alike(*values: Any) -> tuple[Any, ...]:
    """Tensors of one shape, whose gradients are summed in a fixed order; numbers as they are."""
    if not all(isinstance(value, Tensor) for value in values):
        return values
    shape = torch.broadcast_shapes(*(value.shape for value in values))
    return tuple(ops.broadcast(value, shape) for value in values)


def _value(name: str, value: Any) -> Any:
    """A number as a float, a tensor as it is."""
    if isinstance(value, Tensor):
        check_readable(name, value)
        if not value.is_floating_point():
            raise TypeError(f"{name}: expected a number or a tensor of floating point, got {value.dtype}")
        return value
    if isinstance(value, bool) or not isinstance(value, NUMBERS):
        raise TypeError(f"{name}: expected a number or a tensor, got {type(value).__name__}")
    return to_float(name, value)


def _check(name: str, value: Any, expected: str, good: Any) -> None:
    if not isinstance(value, Tensor):
        if not (good and math.isfinite(value)):
            fail(name, expected, f"{value:g}")
    elif looks_at(value):
        name_value(name, expected, value.detach(), good)


# --- shapes of tets: how thin those of a mesh are, and which of a state are inside out --------------------------------


def height_of_tets(model: Any) -> np.ndarray:
    """The shortest of each tet's four heights [m], [T]."""
    return _shapes_of_tets(model)[0]


def thinness(model: Any) -> tuple[float, float]:
    """Longest edge over shortest height [-], and that height [m], of the median tet."""
    height, sides = _shapes_of_tets(model)
    return float(np.median(sides.max(1) / height)), float(np.median(height))


def _shapes_of_tets(model: Any) -> tuple[np.ndarray, np.ndarray]:
    corners = model.mesh.points[model.mesh.tets]
    edges = corners[:, 1:] - corners[:, :1]
    normals = np.stack([np.cross(edges[:, i], edges[:, j]) for i, j in ((1, 2), (2, 0), (0, 1))], 1)
    volume = np.abs((edges[:, 0] * normals[:, 0]).sum(-1))
    normals = np.concatenate([normals, -normals.sum(1, keepdims=True)], 1)
    height = volume / np.linalg.norm(normals, axis=-1).max(1)
    sides = np.linalg.norm(corners[:, [0, 0, 0, 1, 1, 2]] - corners[:, [1, 2, 3, 2, 3, 3]], axis=-1)
    return height, sides


def inside_out(tets: Tensor, x: Tensor) -> Tensor:
    """Tets [T, 4] of states [..., V, 3] with a volume of 0 or less, bool [..., T]."""
    corners = x.detach()[..., tets, :]
    a, b, c = (corners[..., 1:, :] - corners[..., :1, :]).unbind(-2)
    return (torch.linalg.cross(a, b) * c).sum(-1) <= 0
