"""What XPBD and projective dynamics share: particles with masses and pins, the predictor, checks of arguments."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from .. import ops
from ..checks import (
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
from ..lasting import lasting_tensors
from ..mesh import TetMesh
from ..model.arguments import checked_device
from ..step.arguments import GRAVITY, acceleration_of


class ParticleSolver:
    """Particles: rest positions (if known), masses and pins.

    What is given here are constants, no tensors that require grad; what is differentiated is an argument of a step.

    Args:
        points: Rest positions [m], shape [V, 3], or the number of particles V.
        mass: [kg], a number or shape [V], > 0 where not pinned; the value that a step uses unless it is given another.
        pinned: Particles that nothing but ``prescribed`` moves: a bool mask [V] or indices.
        dtype, device: Of the solver's constants, and of what its steps take.

    Attributes:
        num_points: V. rest_points [m]: [V, 3] or None. mass [kg]: [V]. pinned: bool [V].

    Raises:
        ValueError, TypeError: naming the argument, what was expected and what came.
    """

    @lasting_tensors()
    def __init__(
        self,
        points: Any,
        mass: Any,
        pinned: Any = None,
        *,
        dtype: torch.dtype = torch.float64,
        device: torch.device | str = "cpu",
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
    quarter = np.repeat(check_positive("density", density, "kg/m^3") * mesh.volume / 4, 4)
    return np.bincount(mesh.tets.reshape(-1), quarter, minlength=mesh.num_vertices)


def checked_mesh(mesh: Any) -> TetMesh:
    check_kind("mesh", mesh, TetMesh)
    return mesh


__all__ = [
    "GRAVITY",
    "ParticleSolver",
    "all_finite",
    "check_finite",
    "checked_edges",
    "checked_mesh",
    "mesh_edges",
    "mesh_mass",
    "numbers",
]
