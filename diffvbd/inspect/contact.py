"""State of contact, and contact between whole bodies: ``diffvbd.contact``."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from .._common.checks import check_count, check_kind, check_readable, fail
from .._contact.barrier import PairBarrier
from .._contact.detection import intersections as find
from .._contact.surface import build_surface
from ..model.model import Model
from ..step.contact import Detection, outcomes
from .forces import ForceParts, Forces, forces
from .penalty import Bodies, center_of_mass_penalty

__all__ = [
    "Bodies",
    "Detection",
    "ForceParts",
    "Forces",
    "Status",
    "center_of_mass_penalty",
    "forces",
    "intersections",
    "reserve",
    "status",
]


@dataclass(frozen=True)
class Status:
    """State of contact after the latest step of a Model.

    Attributes:
        pairs: The most pairs of one detection, of all scenes.
        capacity: Pairs that fit, of all scenes; with more, an eager step has raised, a captured one returned NaN. On
            the CPU, without a ``capacity`` of the PairBarrier, lists are as long as they must be, up to so many.
        touching: Pairs without a gap that detections found (an eager step has raised, a captured one returned NaN in
            their scenes).
        infeasible: Pairs that prescribed vertices and moving colliders would bring too close (likewise).
        truncated: Truncated vertices, [scenes]: those that contact limited in the last sweep (at the start of
            the step if there are no sweeps) or with their body in the last rigid correction. They lost velocity that
            no force took.
        smallest_gap: The smallest gap that a detection found [m], or the search distance, [scenes].
    """

    pairs: int
    capacity: int
    touching: int
    infeasible: int
    truncated: list[int]
    smallest_gap: list[float]

    @property
    def overflowed(self) -> bool:
        return self.pairs > self.capacity


def status(model: Model) -> Status:
    """State of contact after the latest step of ``model``, in a replayed CUDA graph that of the replay; a backward with
    checkpoints runs steps again, and counts. Waits for the device.

    Raises:
        ValueError: If the Model has taken no step with contact yet.
    """
    check_kind("model", model, Model)
    outcome = outcomes.get(model)
    if outcome is None:
        fail("model", "one that has taken a step with a PairBarrier", "none so far")
    return Status(
        pairs=int(outcome.counts[:, 0].max()),
        capacity=outcome.capacity,
        touching=int(outcome.counts[:, 1].sum()),
        infeasible=int(outcome.infeasible.sum()),
        truncated=outcome.truncated.sum(-1).tolist(),
        smallest_gap=outcome.smallest.min(0).values.tolist(),
    )


def reserve(model: Model, pairs: int) -> None:
    """Capacity of the lists of a Model for ``pairs`` pairs per scene, from its next step on. A captured graph keeps the
    capacity that it was captured with. Without a ``capacity`` of the PairBarrier an eager step still takes more where
    it needs more.

    Raises:
        ValueError, TypeError: If the Model has no PairBarrier, or for a number < 1.
    """
    check_kind("model", model, Model)
    surface = model.surface_of_contact
    if surface is None or model.contact is None:
        fail("model", "a PairBarrier among its energies", "none")
    pairs = check_count("pairs", pairs, 1, 2**26)
    model.surface_of_contact = replace(surface, capacity=pairs)
    if model.contact.capacity is None:  # it still grows by itself
        return
    barrier = replace(model.contact, capacity=pairs)
    model._set_energies(tuple(barrier if e is model.contact else e for e in model.energies))
    for name in [name for name, value in model._derived.items() if isinstance(value, Model)]:
        del model._derived[name]  # Systems of the old barrier
    for energy in model.parametric_energies:  # here, so that a step that is captured copies nothing from the host
        model.constants(energy)


def intersections(model: Model, x: Tensor) -> Tensor:
    """Edges of the bodies' surfaces that pass through a triangle, [n, 3] int64 on the CPU: scene, edge row, triangle
    row of the surface.

    Whatever contact the Model has, every edge is compared with the triangles whose boxes it meets and with which it
    shares no vertex, in double precision; for checking a start or a result. An edge and a triangle with features that
    are one place of the material at rest (a crack, doubled vertices) do not count.

    Args:
        x: Positions [m], shape [..., V, 3].

    Raises:
        ValueError: For another shape, or positions that are not finite.
        TypeError: For no Model, and for anything but a dense tensor of real numbers.
    """
    check_kind("model", model, Model)
    if not isinstance(x, Tensor):
        raise TypeError(f"x: expected a tensor, got {type(x).__name__}")
    check_readable("x", x)
    if not x.is_floating_point():
        raise TypeError(f"x: expected real numbers, got dtype {x.dtype}")
    if x.shape[-2:] != (model.num_vertices, 3):
        fail("x", f"shape [..., {model.num_vertices}, 3]", f"shape {list(x.shape)}")
    points = x.detach().reshape(x.shape[:-2].numel(), model.num_vertices, 3).to(torch.float64)
    bad = int((~torch.isfinite(points)).any(-1).sum())
    if bad:
        fail("x", "finite positions", f"{bad} that are not")
    surface = build_surface(model.mesh, torch.zeros(model.num_vertices, dtype=torch.bool), PairBarrier(), ())
    surface = surface.to(x.device, torch.float64)
    none = points.new_empty((0,))
    search = partial(find, points, none, points[:, :0], surface, self_contact=True, between_bodies=True)
    found = search(capacity=len(surface.edges))
    count = int(found.counts[:, 0].sum())
    if count > len(found.pairs):
        found = search(capacity=count)
    return found.pairs[:count].long().cpu()
