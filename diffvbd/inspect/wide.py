"""A Model and arguments of a step in float64, for reading: what float32 leaves of a small difference is no digit."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..checks import check_kind, fail
from ..model.inputs import Given
from ..model.model import Model
from ..model.solver import VBD
from ..model.system import System, system_of
from ..step.arguments import Prepared, check_state, collider_state, prepare
from ..step.predict import energy_data


class Wide(NamedTuple):
    """A Model in float64, what does not depend on the state, and collider points at the start and the end of a step
    [B, Vc, 3]."""

    model: System
    prepared: Prepared
    before: Tensor
    colliders: Tensor

    def data(self) -> Tensor:
        """Data of the energies [1 | B, n]."""
        return energy_data(self.model, self.prepared, None)


def widen(model: Model, x: Tensor, solver: VBD | None, given: Given) -> Wide:
    """Inputs checked as those of a step; loads but colliders are not read. Without a solver the time step is 1 s."""
    lead = check_state(model, x, x)
    solver = VBD(1.0, 0) if solver is None else solver
    system, options = system_of(model, solver), {"time_step": solver.time_step, "sweeps": 0}
    prepared = prepare(system, lead, given, **options)
    where = collider_state(system, x, given.loads.get("colliders"), given.loads.get("colliders_before"))
    if where is None:
        none = x.new_zeros((x.shape[:-2].numel(), 0, 3))
        where = none, none
    if model.dtype == torch.float64:
        return Wide(system, prepared, *where)
    double = system.derived("in_float64", lambda: system.to(dtype=torch.float64))
    prepared = prepare(double, lead, Given(*(wide(part) for part in given)), **options)
    return Wide(double, prepared, wide(where[0]), wide(where[1]))


def wide(value: Any) -> Any:
    """Tensors of real numbers in float64, those of a dict, tuple or list, too; anything else as it is."""
    if isinstance(value, Tensor):
        return value.double() if value.is_floating_point() else value
    if isinstance(value, dict):
        return {key: wide(each) for key, each in value.items()}
    return type(value)(wide(each) for each in value) if isinstance(value, (tuple, list)) else value


def check_previous(model: Model, previous: Any, x: Tensor, solver: Any) -> None:
    """Raises where ``previous`` is no state (x, v) with a solver of the step from it."""
    if solver is not None:
        check_kind("solver", solver, VBD)
    if previous is None:
        return
    if not (isinstance(previous, (tuple, list)) and len(previous) == 2):
        shown = f"{len(previous)} values" if isinstance(previous, (tuple, list)) else type(previous).__name__
        raise TypeError(f"previous: expected positions and velocities (x, v), got {shown}")
    try:
        check_state(model, *previous)
    except (ValueError, TypeError) as error:
        raise type(error)(f"previous: {error}") from None
    if solver is None:
        fail("solver", "that of the step where previous is given", None)
    if previous[0].shape != x.shape:
        fail("previous", f"x's shape {list(x.shape)}", f"shape {list(previous[0].shape)}")
