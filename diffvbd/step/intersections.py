"""A state whose surfaces intersect is an error: distances, which a step sees, look the same on the wrong side."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ..contact.detection import intersections
from ..model.system import System
from ..scopes import is_captured
from .arguments import collider_state


def check_start(model: System, x: Tensor, colliders: Any, colliders_before: Tensor | None, moving: bool) -> None:
    """Raises where the surfaces of a rollout's initial state intersect; waits for the device. Nothing happens without a
    PairBarrier, under torch.compile, and while a CUDA graph is captured.

    Args:
        x: [..., V, 3] [m].  colliders, colliders_before: As given to the rollout.
        moving: Whether ``colliders`` change from step to step, so that the first of them are not the start.
    """
    if model.surface_of_contact is None or x.numel() == 0 or torch.compiler.is_compiling():
        return
    if torch._C._functorch.peek_interpreter_stack() is not None:  # pyright: ignore[reportAttributeAccessIssue]
        return  # the step says that there are no transforms of it
    if is_captured(x):
        return
    where = collider_state(model, x, None if moving else colliders, colliders_before)
    if where is not None:
        refuse_intersections(model, x.reshape(-1, *x.shape[-2:]), x.new_empty((0,)), where[0],
                             "; checks=dv.Checks(start=False) starts all the same")  # fmt: skip


def advice_to_part(x: Tensor, origin: Tensor, dhat: float) -> str:
    """Advice about surfaces that touch. x: [B, V, 3] [m], relative to origin [B, V, 3] or empty."""
    far = max(float(t.abs().max()) for t in (x, origin) if t.numel())
    rounded = far * torch.finfo(x.dtype).eps
    if rounded > dhat / 2:
        return (f"positions of up to {far:.3g} m are rounded by {rounded:.3g} m as {x.dtype}, dhat is {dhat:g} m: "
                "give x in metres, near the origin")  # fmt: skip
    return f"move them apart, best by about dhat, {dhat:g} m"


def refuse_intersections(model: System, x: Tensor, origin: Tensor, colliders: Tensor, otherwise: str = "") -> None:
    """Raises where an edge of the surfaces passes through a triangle, or a point lies behind a plane.

    Args:
        x: [B, V, 3] [m], relative to origin [B, V, 3] or empty.  colliders: [B, Vc, 3] [m].
        otherwise: What else the message advises.

    Raises:
        ValueError: It names the first crossing of the first scene that has one.
    """
    surface, barrier = model.surface_of_contact, model.contact
    assert surface is not None and barrier is not None
    found = intersections(x, origin, colliders, surface, barrier.self_contact, barrier.between_bodies)
    counts = found.counts.tolist()
    for scene, (crossings, behind) in enumerate(counts):
        if crossings == behind == 0:
            continue
        (edge, triangle), (point, plane) = found.first[scene].tolist()
        if crossings:
            ends, corners = surface.edges[edge].tolist(), surface.triangles[triangle].tolist()
            what = f"the edge of corner points {ends} passes through the triangle {corners}"
        else:
            ends, corners = [int(surface.points[point])], surface.planes[plane].tolist()
            what = f"corner point {ends[0]} lies behind the plane {corners}"
        of_bodies = all(corner < model.num_vertices for corner in ends + corners)
        total, below = (sum(row[k] for row in counts) for k in (0, 1))
        got = [f"{total} edges through triangles"] * bool(total) + [f"{below} points behind planes"] * bool(below)
        raise ValueError(
            f"{'x' if of_bodies else 'x or colliders'}: expected surfaces that do not intersect, got "
            f"{' and '.join(got)}: {what} in scene {scene}, of "
            f"{surface.owners_of(ends[0], corners[0])}. Contact keeps apart what is apart and cannot undo this: "
            f"move the bodies apart (diffvbd.contact.intersections lists what crosses){otherwise}"
        )
