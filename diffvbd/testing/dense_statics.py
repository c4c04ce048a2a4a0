"""An independent solver of static problems: dense Newton on the energy, written with deformation gradients."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from ..couplings import Pressure, Springs, Tendons
from ..embedding import Embedding
from ..model.model import Model

Energy = Callable[[Tensor], Tensor]


def potential(model: Model, load: Tensor, mu: Any, lam: Any, more: Energy | None = None) -> Energy:
    """U(x) [J] of positions [V, 3]: stable Neo-Hookean tets, less the work of the load [V, 3], and ``more``."""
    tets, rest = model.tets, model.rest_points
    edges = (rest[tets[:, 1:]] - rest[tets[:, :1]]).mT
    inverse, volume = torch.linalg.inv(edges), torch.linalg.det(edges) / 6

    def energy(x: Tensor) -> Tensor:
        f = (x[tets[:, 1:]] - x[tets[:, :1]]).mT @ inverse
        j = (f[..., 0] * torch.linalg.cross(f[..., 1], f[..., 2])).sum(-1) - 1
        psi = mu / 2 * (f.square().sum((-2, -1)) - 3) - mu * j + (mu + lam) / 2 * j.square()
        total = (volume * psi).sum() - (load * x).sum()
        return total if more is None else total + more(x)

    return energy


def barrier(gap: Tensor, kappa: float, dhat: float) -> Tensor:
    """Log barrier [J] of gaps, infinite where one has closed."""
    inside = torch.where(gap < dhat, gap, dhat).clamp(min=1e-300)
    return torch.where(gap > 0, -kappa * (inside - dhat) ** 2 * torch.log(inside / dhat), torch.inf)


def weight(model: Model) -> Tensor:
    """Gravity of the vertices [N], [V, 3], from the volumes of tets."""
    tets, rest = model.tets, model.rest_points
    volume = torch.linalg.det((rest[tets[:, 1:]] - rest[tets[:, :1]]).mT) / 6
    mass = rest.new_zeros(len(rest)).index_add(0, tets.reshape(-1), (model.density * volume / 4).repeat_interleave(4))
    return mass[:, None] * torch.tensor([0.0, -9.81, 0.0], dtype=rest.dtype)


def residual(model: Model, energy: Energy, load: Tensor, x: Tensor) -> float:
    """Force left over at free vertices over the sizes of all internal forces and of the load."""
    at = x.detach().requires_grad_()
    (left,) = torch.autograd.grad(energy(at), at)
    free = ~model.pinned[:, None]
    return float((free * left).norm() / ((left + free * load).norm() + (free * load).norm()))


def newton(model: Model, energy: Energy, x: Tensor, iterations: int = 200) -> Tensor:
    """The minimum of U from x [V, 3], with the pinned vertices where they are."""
    unknown = (~model.pinned).repeat_interleave(3).nonzero()[:, 0]

    def of_free(values: Tensor) -> Tensor:
        return energy(x.reshape(-1).index_put((unknown,), values).reshape(-1, 3))

    now = x.reshape(-1)[unknown]
    for _ in range(iterations):
        gradient, hessian = torch.func.grad(of_free)(now), torch.func.hessian(of_free)(now)
        value, vector = torch.linalg.eigh(hessian)
        step = -vector @ ((vector.mT @ gradient) / value.abs().clamp(min=1e-12 * float(value.abs().max())))
        before, fraction = of_free(now), 1.0
        while not of_free(now + fraction * step) <= before + 1e-4 * fraction * (gradient @ step) + 1e-13 * before.abs():
            fraction /= 2
            if fraction < 1e-9:
                break
        now = now + fraction * step
        if float((fraction * step).norm()) < 1e-11 * float(x.norm()):
            break
    return x.reshape(-1).index_put((unknown,), now).reshape(-1, 3)


def points_of(embedding: Embedding, x: Tensor) -> Tensor:
    return (embedding.weights[..., None] * x[embedding.vertices]).sum(1)


def volume_of(x: Tensor, triangles: Tensor) -> Tensor:
    a, b, c = x[triangles].unbind(1)
    return (a * torch.linalg.cross(b, c)).sum() / 6


def coupling_energy(model: Model, x: Tensor, values: dict[str, Any]) -> Tensor:
    """Energy [J] of all couplings of a Model, from the definitions."""
    total = x.new_zeros(())
    for energy in model.couplings:
        if isinstance(energy, Springs):
            second = energy.second
            second = points_of(second, x) if isinstance(second, Embedding) else values["spring_points"]
            longer = (points_of(energy.first, x) - second).norm(dim=-1) - values["spring_rest_length"]
            longer = longer.clamp(min=0) if energy.tension_only else longer
            total = total + (values["spring_stiffness"] / 2 * longer**2).sum()
        elif isinstance(energy, Tendons):
            points = points_of(energy.points, x)
            lengths = [(points[r[1:]] - points[r[:-1]]).norm(dim=-1).sum() for r in map(list, energy.routes)]
            longer = (torch.stack(lengths) - values["tendon_rest_length"]).clamp(min=0)
            total = total + (values["tendon_stiffness"] / 2 * longer**2).sum()
        elif isinstance(energy, Pressure):
            for triangles in energy.surfaces:
                now, rest = (volume_of(points, torch.as_tensor(triangles.copy())) for points in (x, model.rest_points))
                p = values["pressure"].sum()
                total = total - p * now
                if energy.gas:
                    total = total + p * now + 101_325.0 * now - (p + 101_325.0) * rest * torch.log(now / rest)
    return total
