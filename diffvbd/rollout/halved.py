"""A scene on the mesh of eight tets for each: what belongs to tets, and to vertices, there."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..checks import fail
from ..energies import Anchor
from ..mesh import subdivide
from ..model.inputs import MODULI
from ..model.model import Model
from .trajectory import PerStep, StepAverage

TETS = 8  # of each


class Halved(NamedTuple):
    """A Model on the subdivided mesh, whose first vertices are those of the mesh."""

    model: Model
    ends: Tensor  # of the edge of each vertex that is new, [E, 2]
    vertices: int  # of the mesh

    def between(self, value: Tensor) -> Tensor:
        """[..., V, n], and its means over the ends of edges behind it."""
        return torch.cat([value, value[..., self.ends, :].mean(-2)], -2)


def halved(model: Model) -> Halved:
    """Raises ValueError for a Model with an Anchor, which holds single vertices."""
    if any(isinstance(e, Anchor) for e in model.energies):
        fail("mesh", "False beside an Anchor, which holds single vertices", "True")
    return model.derived("halved", lambda: _halved(model))


def _halved(model: Model) -> Halved:
    tets, pinned = model.tets.cpu(), model.pinned.cpu()
    ends = torch.cat([tets[:, [i, j]] for i in range(4) for j in range(i)]).sort(1).values.unique(dim=0)
    density = model.density.cpu().repeat_interleave(TETS)
    changes = {"density": density, "pinned": torch.cat([pinned, pinned[ends].all(1)]) if pinned.any() else None}
    fine = Model(subdivide(model.mesh), energies=model.replace().energies, colliders=model.colliders, dtype=model.dtype,
                 device=model.device, **changes)  # fmt: skip
    return Halved(fine, ends.to(model.device), model.num_vertices)


def of_parts(value: Any, tets: int) -> Any:
    """A value of each tet for its eight parts; one of all of them as it is."""
    each = isinstance(value, Tensor) and value.dim() and value.shape[-1] == tets
    return value.repeat_interleave(TETS, -1) if each else value


def on_halved(given: dict[str, Any], model: Model, fine: Halved) -> dict[str, Any]:
    """The inputs of a rollout on the finer mesh. Forces stay at the vertices of the mesh."""
    count = fine.vertices
    tets, pinned = model.num_tets, fine.model.pinned[:, None]

    def mapped(name: str, change: Callable[[Any], Any]) -> Any:
        value = given[name]
        if isinstance(value, PerStep):  # [steps] is a number for each
            return value if value.values.dim() == 1 else PerStep(change(value.values))
        if isinstance(value, StepAverage):
            return value.then(change)
        if callable(value) and not isinstance(value, Tensor):
            return lambda k, x, v: change(value(k, x[..., :count, :], v[..., :count, :]))
        return change(value)

    def pushed(force: Any) -> Any:
        if force is None:
            return None
        rows = force.expand(*force.shape[:-2], count, 3) if force.dim() > 1 else force.expand(count, 3)
        return torch.cat([rows, rows.new_zeros(*rows.shape[:-2], len(fine.ends), 3)], -2)

    def accelerated(gravity: Any) -> Any:
        each = isinstance(gravity, Tensor) and gravity.dim() > 1 and gravity.shape[-2] == count
        return fine.between(gravity) if each else gravity

    def moved(ends: Any) -> Any:
        if ends is None:
            return None
        if not isinstance(ends, Tensor):
            raise NotImplementedError("refine: expected prescribed positions without those of stages")
        return torch.where(pinned, fine.between(ends), torch.nan)

    def shaped(points: Any) -> Any:
        return None if points is None else fine.between(points)

    def of_each(value: Any) -> Any:
        return of_parts(value, tets)

    changes = {"force": pushed, "gravity": accelerated, "prescribed": moved, "rest_points": shaped}
    changes |= dict.fromkeys((*MODULI, "density"), of_each)
    return {name: mapped(name, changes[name]) if name in changes else value for name, value in given.items()}
