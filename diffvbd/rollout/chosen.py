"""A rollout whose time step, sweeps and the like come from settings."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from typing import Any

import torch

from ..adjoint.routes import ReverseSweep
from ..checks import check_count, check_positive, fail, is_word
from ..step.arguments import check_state
from ..step.growth import proven
from ..step.met import outcomes
from .pilots import GIVEN, of_time, pilots_of
from .search import ERROR, PATIENCE, found
from .settings import Settings
from .trajectory import PerStep, Trajectory

_OWN = ("time_step", "sweeps", "integrator")  # which settings have


def rollout_with(rollout: Callable[..., Trajectory], *, settings: Any, duration: Any, **given: Any) -> Trajectory:
    """``rollout`` of the arguments ``given`` with the settings, or with those that "auto" finds for them."""
    check_state(given["model"], given["x"], given["v"])
    for name in _OWN:
        if given[name] is not None:
            raise TypeError(f"{name}: expected None beside settings, which have it, got {given[name]!r}")
    if (given["steps"] is None) == (duration is None):
        raise TypeError("duration: expected either duration or steps beside settings")
    if is_word(settings, "auto"):
        if duration is None:
            raise TypeError('duration: expected it beside settings="auto", which chooses the steps')
        settings = _found(rollout, check_positive("duration", duration, "s"), given)
    if not isinstance(settings, Settings):
        raise TypeError(f'settings: expected diffvbd.Settings or "auto", got {type(settings).__name__}')
    if duration is None:
        steps, time_step = check_count("steps", given["steps"]), settings.time_step
    else:
        duration = check_positive("duration", duration, "s")
        steps = settings.steps(duration)
        time_step = duration / steps
    chosen = {"model": settings.applied(given["model"]), "steps": steps, "time_step": time_step,
              "sweeps": settings.sweeps, "integrator": settings.integrator}  # fmt: skip
    if given["adjoint"] is None:
        chosen["adjoint"] = ReverseSweep(settings.tape)
    if is_word(given["checkpoint_every"], "auto"):
        chosen["checkpoint_every"] = settings.checkpoint_every
    sure = settings.predicted is not None and settings.predicted.reached
    try:
        with proven() if sure else nullcontext():
            return rollout(**given | chosen)
    finally:  # the caller asks his own Model for the status of its steps
        if (outcome := outcomes.get(chosen["model"])) is not None:
            outcomes[given["model"]] = outcome


@torch.no_grad()
def _found(rollout: Callable[..., Trajectory], duration: float, given: dict[str, Any]) -> Settings:
    fixed = {name: given[name] for name in GIVEN if given[name] is not None}
    parameters = given["parameters"]
    named = {f'parameters["{k}"]': v for k, v in parameters.items()} if isinstance(parameters, dict) else {}
    for name, value in {**fixed, **named}.items():
        if isinstance(value, PerStep) or of_time(value):
            fail(name, 'a value beside settings="auto", which tries many time steps: use dv.advise, which takes '
                 "functions of time", type(value).__name__)  # fmt: skip
    pilots = pilots_of(rollout, given["model"], given["x"], given["v"], duration, None, False, fixed)
    return found(pilots, ERROR, PATIENCE)
