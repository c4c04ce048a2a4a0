"""Motion that is lost: vertices where nothing could have taken them, or nowhere, and what is at fault."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from ..model.integrators import Integrator
from ..model.system import System
from ..ops import broadcast
from ..said import is_silent, page, warn
from ..scopes import looks_at
from .arguments import Prepared
from .growth import growth_message

FAR = 1e3  # sizes of the Model at rest


def size_of(model: System) -> float:
    """Diagonal of the Model's box at rest [m]."""
    return model.derived("size", lambda: float((model._rest_points.amax(0) - model._rest_points.amin(0)).norm()))


def reach_of(model: System, start: tuple[Tensor, ...], x: Tensor, gravity: Any, duration: float) -> Tensor:
    """How far the farthest vertex is from where it began, over the Model's size, beside what its velocity, gravity and
    its pins may have given it [-]."""
    x0, v0 = (t.detach() for t in start)
    moved = (x.detach() - x0).abs()
    away = torch.where(model._pinned[:, None], 0.0, moved).amax()
    carried = torch.where(model._pinned[:, None], moved, 0.0).amax() + duration * v0.abs().amax()
    if isinstance(gravity, Tensor):
        carried = carried + 0.5 * duration**2 * gravity.detach().abs().amax()
    return (away - carried) / max(size_of(model), torch.finfo(x.dtype).tiny)


def notice_loss(model: System, prepared: Prepared, integrator: Integrator, v: Tensor, force: Any, end: Tensor) -> None:
    """Warns (UserWarning) where a step made one by one ends at positions that are not finite, or spread over more than
    FAR sizes of the Model; on the CPU. v: Before the step.

    A rollout looks at its own end, and tells from where it began how far is too far.
    """
    if end.is_cuda or not end.numel() or not looks_at(end) or is_silent():
        return
    low, high = (t.item() for t in end.detach().aminmax())
    if high - low <= FAR * size_of(model):
        return
    x = end.detach()
    spread = float((x.amax(-2) - x.amin(-2)).amax()) if math.isfinite(high - low) else math.inf
    if not spread <= FAR * size_of(model):
        where = f"spread over {spread:.3g} m" if spread < math.inf else "not finite"
        warn(f"x: this step ended with positions that are {where}: "
             f"{fault_of(model, prepared, integrator, v, force)}; " + page("numerics.md"))  # fmt: skip


def fault_of(model: System, prepared: Prepared, integrator: Integrator, v: Tensor, force: Any) -> str:
    """What made a step lose its bounds, and what to do. v: Before it."""
    with torch.no_grad():
        if isinstance(force, Tensor):
            mass = prepared.mass[..., None].clamp(min=torch.finfo(v.dtype).tiny)
            push = broadcast(force.detach(), v.shape).reshape(-1, *v.shape[-2:]) / mass
            push = prepared.settings.numbers.time_step * torch.where(model._pinned[:, None], 0.0, push)
            if not float(push.norm()) <= float(v.detach().norm()):
                return ("force: in one step it changes velocities by more than they are, as an explicit drag or spring "
                        "does that is too strong for the step; limit it, or take a smaller time_step")  # fmt: skip
        if growth_message(model, prepared, integrator):
            return "sweeps: so few let vibrations grow in every step; take more, or a smaller relaxation or time_step"
    return "time step: too long for these speeds and loads; take a smaller time_step"
