"""A Model and arguments of a step in float64, for reading: what float32 leaves of a small difference is no digit."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..checks import fail
from ..model.model import Model
from ..step.arguments import Prepared, check_state, collider_state, prepare
from ..step.predict import energy_data

_MATERIAL = ("mu", "lam", "young", "poisson", "rest_points", "density", "parameters")


class Wide(NamedTuple):
    """A Model in float64, what does not depend on the state, and collider points at the start and the end of a step
    [B, Vc, 3]."""

    model: Model
    prepared: Prepared
    before: Tensor
    colliders: Tensor

    def data(self) -> Tensor:
        """Data of the energies [1 | B, n]."""
        return energy_data(self.model, self.prepared, None)


def widen(model: Model, x: Tensor, time_step: float | None, colliders: Any, colliders_before: Any, **material: Any
          ) -> Wide:  # fmt: skip
    """Arguments checked as those of a step; ``material``: those of ``mu`` to ``parameters`` that there are."""
    lead = check_state(model, x, x)
    options: dict[str, Any] = dict.fromkeys(_MATERIAL) | material
    options |= {"time_step": 1.0 if time_step is None else time_step, "sweeps": 0}
    prepared, where = prepare(model, lead, **options), collider_state(model, x, colliders, colliders_before)
    if where is None:
        none = x.new_zeros((x.shape[:-2].numel(), 0, 3))
        where = none, none
    if model.dtype == torch.float64:
        return Wide(model, prepared, *where)
    double = model.derived("in_float64", lambda: model.to(dtype=torch.float64))
    prepared = prepare(double, lead, **{name: wide(value) for name, value in options.items()})
    return Wide(double, prepared, wide(where[0]), wide(where[1]))


def wide(value: Any) -> Any:
    """Tensors of real numbers in float64, those of a dict, tuple or list, too; anything else as it is."""
    if isinstance(value, Tensor):
        return value.double() if value.is_floating_point() else value
    if isinstance(value, dict):
        return {key: wide(each) for key, each in value.items()}
    return type(value)(wide(each) for each in value) if isinstance(value, (tuple, list)) else value


def check_previous(model: Model, previous: Any, x: Tensor, time_step: Any) -> None:
    """Raises where ``previous`` is no state (x, v) beside a time step."""
    if previous is None:
        return
    if not (isinstance(previous, (tuple, list)) and len(previous) == 2):
        shown = f"{len(previous)} values" if isinstance(previous, (tuple, list)) else type(previous).__name__
        raise TypeError(f"previous: expected positions and velocities (x, v), got {shown}")
    try:
        check_state(model, *previous)
    except (ValueError, TypeError) as error:
        raise type(error)(f"previous: {error}") from None
    if time_step is None:
        fail("time_step", "a number in [s] where previous is given", None)
    if previous[0].shape != x.shape:
        fail("previous", f"x's shape {list(x.shape)}", f"shape {list(previous[0].shape)}")
