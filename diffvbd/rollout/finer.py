"""A rollout over the same time with smaller steps and more sweeps, as dv.refine runs it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from ..model.model import Model
from ..scopes import refined
from ..step.integrators import History, is_step_of
from .trajectory import PerStep, Trajectory, stacked

# given at the steps of the caller and held over the smaller ones; `prescribed` and `colliders` move in between
_HELD = ("mu", "lam", "young", "poisson", "force", "gravity", "rest_points", "density")


def rollout_finer(rollout: Callable[..., Trajectory], *, factors: tuple[int, int, list[int]],
                  **given: Any) -> Trajectory:  # fmt: skip
    """``rollout`` of the arguments ``given``, with factors[0] times the steps and factors[1] times the sweeps.

    The result looks like that of ``rollout(**given)``: the same frames, and observations at the same times. What is
    given per step, or by a callable, is asked at the steps of ``given`` and held in between; prescribed vertices and
    colliders go in straight lines between the ends of these.
    """
    parts, more_sweeps, ran = factors
    given = {name: value for name, value in given.items() if name not in ("settings", "duration")}  # none
    ran.append(given["steps"])
    if parts == 1:
        with refined(None):
            return rollout(**given | {"sweeps": more_sweeps * given["sweeps"]})
    # dv.refine has run this as it stands before, which has checked the arguments
    model, steps = given["model"], given["steps"]
    if given["estimate_errors"]:
        raise NotImplementedError("refine: expected rollouts without estimate_errors")
    time_step, history = given["time_step"] / parts, given["history"]
    if isinstance(history, History) and not is_step_of(history, time_step):  # but that of a refined rollout before
        raise NotImplementedError("refine: expected rollouts that begin without a history of larger steps")
    finer = dict(given)
    for name in _HELD:
        finer[name] = _held(given[name], parts)
    finer["parameters"] = {name: _held(value, parts) for name, value in (given["parameters"] or {}).items()}
    finer["prescribed"] = _moving(given["prescribed"], parts, model)
    if isinstance(given["colliders"], PerStep):
        first = model.collider_points if given["colliders_before"] is None else given["colliders_before"]
        finer["colliders"] = _between(given["colliders"].values, first, parts)
    observe, observed = given["observe"], []

    def observe_some(x: Tensor, v: Tensor, step: int) -> None:
        if step % parts == 0:
            observed.append(observe(x, v, step // parts))

    save = given["save"]
    finer |= {
        "steps": parts * steps,
        "time_step": time_step,
        "sweeps": more_sweeps * given["sweeps"],
        "save": save if save == "last" else parts * (1 if save == "all" else save),
        "observe": None if observe is None else observe_some,
        "progress": False,
    }
    with refined(None):
        found = rollout(**finer)
    return Trajectory(found.x, found.v, [step // parts for step in found.steps], stacked(observed), None, found.history)


def _asked(value: Any, parts: int) -> Callable[[int, Tensor, Tensor], Any]:
    """A callable of smaller steps that asks ``value`` at the first of each of its steps only."""
    last: list[Any] = []

    def ask(step: int, x: Tensor, v: Tensor) -> Any:
        if step % parts == 0:
            last[:] = [value(step // parts, x, v)]
        return last[0]

    return ask


def _held(value: Any, parts: int) -> Any:
    if isinstance(value, PerStep):
        return PerStep(value.values.repeat_interleave(parts, 0))
    return _asked(value, parts) if callable(value) and not isinstance(value, Tensor) else value


def _moving(value: Any, parts: int, model: Model) -> Any:
    """Where pinned vertices are at the end of each smaller step."""
    if value is None:
        return None
    ends = _asked(value, parts) if callable(value) and not isinstance(value, (Tensor, PerStep)) else None
    begun: list[Tensor] = []
    pinned = model.pinned[:, None]

    def now(step: int, x: Tensor, v: Tensor) -> Tensor:
        if step % parts == 0:
            begun[:] = [x]
        if ends is not None:
            end = ends(step, x, v)
        else:
            end = value.values[step // parts] if isinstance(value, PerStep) else value
        if not isinstance(end, Tensor):
            raise NotImplementedError("refine: expected prescribed positions without those of stages")
        way = begun[0] + (end - begun[0]) * ((step % parts + 1) / parts)
        # a policy has given elsewhere where vertices were: that is checked in the first smaller step, and old in others
        return torch.where(pinned, way, end if step % parts == 0 else x)

    return now


def _between(ends: Tensor, first: Tensor, parts: int) -> PerStep:
    """Where colliders are at the end of each smaller step."""
    if len(ends) == 0:
        return PerStep(ends)
    begins = torch.cat([first.expand_as(ends[0])[None], ends[:-1]])
    shares = torch.arange(1, parts + 1, dtype=ends.dtype, device=ends.device) / parts
    ways = torch.stack([begins + share * (ends - begins) for share in shares], dim=1)
    return PerStep(ways.flatten(0, 1))
