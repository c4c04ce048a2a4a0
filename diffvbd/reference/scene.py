"""The differentiable inputs of a run, resolved once: rest metric, masses, materials, energy parameters."""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ..checks import input_name
from .layout import Layout, cross, dot


@dataclass(frozen=True)
class Scene:
    """What stays the same over the steps of one run. Component-major; leading dimensions are scenes."""

    model: Any
    layout: Layout
    like: Tensor  # decides dtype and device
    time_step: float
    mu: Tensor  # [..., T]
    lam: Tensor  # [..., T]
    rest_points: Tensor  # [..., 3, V]
    shape_gradients: Tensor  # [..., 4, 3, T] grad N_a
    volume: Tensor  # [..., T]
    mass: Tensor  # [..., V]
    parameters: dict[str, Any]

    def parameter(self, energy: Any, key: str) -> Tensor:
        """An energy parameter as a tensor: the caller's if one is given, else the energy's own constant."""
        return self.tensor(self.parameters.get(input_name(energy, key), getattr(energy, key)))

    def tensor(self, value: Any) -> Tensor:
        return torch.as_tensor(value, dtype=self.like.dtype, device=self.like.device)


def build_scene(
    model: Any,
    layout: Layout,
    like: Tensor,
    *,
    mu: Any,
    lam: Any,
    time_step: float,
    rest_points: Tensor | None,
    density: Any,
    parameters: dict[str, Any] | None,
) -> Scene:
    """Resolve the inputs of a run (shapes as in `step`) for the dtype and device of `like`."""

    def per_tet(value: Any) -> Tensor:
        value = torch.as_tensor(value, dtype=like.dtype, device=like.device)
        value = value.expand(*value.shape[:-1], layout.tets.shape[1])
        return value if layout.order is None else value[..., layout.order]

    points = torch.as_tensor(model.rest_points if rest_points is None else rest_points, device=like.device)
    points = points.to(like).transpose(-1, -2)
    gradients, volume = shape_functions(points, layout.tets)
    corner_mass = per_tet(model.density if density is None else density) * volume / 4
    mass = corner_mass.new_zeros(*corner_mass.shape[:-1], points.shape[-1])
    for corner in layout.tets:
        mass = mass.index_add(-1, corner, corner_mass)
    return Scene(
        model=model,
        layout=layout,
        like=like,
        time_step=time_step,
        mu=per_tet(mu),
        lam=per_tet(lam),
        rest_points=points,
        shape_gradients=gradients,
        volume=volume,
        mass=mass,
        parameters=dict(parameters or {}),
    )


def shape_functions(points: Tensor, tets: Tensor) -> tuple[Tensor, Tensor]:
    """Gradients of the shape functions [..., 4, 3, T] and volumes [..., T] of tets [4, T] at points [..., 3, V]."""
    a, b, c, d = (points[..., corner] for corner in tets)
    # Rows of Dm^-1, Dm = [b-a, c-a, d-a], are the gradients of the shape functions of b, c, d.
    b, c, d = b - a, c - a, d - a
    area_b, area_c, area_d = cross(c, d), cross(d, b), cross(b, c)
    det = dot(b, area_b).unsqueeze(-2)
    of_b, of_c, of_d = area_b / det, area_c / det, area_d / det
    return torch.stack((-(of_b + of_c + of_d), of_b, of_c, of_d), -3), det.squeeze(-2) / 6
