"""The function that a step descends, and its gradient."""

from typing import Any

import torch
from torch import Tensor

from .energies import build_energies
from .layout import build_layout
from .scene import build_scene


def incremental_potential(
    model: Any,
    x: Tensor,
    y: Tensor,
    mu: Any,
    lam: Any,
    time_step: float,
    x_prev: Tensor | None = None,
    *,
    rest_points: Tensor | None = None,
    density: Any = None,
    parameters: dict[str, Any] | None = None,
) -> Tensor:
    """G(x) = 1/2 sum m |x - y|^2 + h^2 E(x), h^2-scaled [kg m^2], shape x.shape[:-2].

    x, y: positions and predictor [m], [..., V, 3]; mu, lam [Pa] as in `step`. E is elastic energy (zero at rest) plus
    barriers (inf at a gap <= 0 of an unpinned vertex) and anchors. x_prev: state at the start of the step, for the
    lagged damping of a floor; None stands for x itself, where the damping vanishes.
    """
    scene = build_scene(
        model,
        build_layout(model),
        x,
        mu=mu,
        lam=lam,
        time_step=time_step,
        rest_points=rest_points,
        density=density,
        parameters=parameters,
    )
    rows = x.transpose(-1, -2)
    lagged = rows if x_prev is None else x_prev.transpose(-1, -2)
    total = (scene.mass / 2 * ((x - y) ** 2).sum(-1)).sum(-1)
    for energy in build_energies(scene):
        total = total + energy.energy(rows, lagged)
    return total


def residual(
    model: Any, x: Tensor, y: Tensor, mu: Any, lam: Any, time_step: float, *args: Any, **options: Any
) -> Tensor:
    """dG/dx [kg m], [..., V, 3], by autograd, detached; arguments as in `incremental_potential`. Zero at unpinned
    vertices of a converged step; at a pinned vertex it is h^2 times the force that holds it (for y = x there)."""
    with torch.enable_grad():
        x = x.detach().requires_grad_()
        total = incremental_potential(model, x, y, mu, lam, time_step, *args, **options)
        (gradient,) = torch.autograd.grad(total.sum(), x)
    return gradient
