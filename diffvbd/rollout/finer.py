"""A rollout over the same time with smaller steps, more sweeps or smaller tets, as dv.refine runs it."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from typing import Any

import torch
from torch import Tensor

from ..model.model import Model
from ..scopes import Finer, record_to, refined
from ..step.integrators import History, is_step_of
from .halved import halved, on_halved
from .reference import unbalanced, with_other_sweeps
from .trajectory import PerStep, StepAverage, Trajectory, stacked

# given at the steps of the caller and held over the smaller ones; `prescribed` and `colliders` move in between
_HELD = ("mu", "lam", "young", "poisson", "force", "gravity", "rest_points", "density")


def rollout_finer(rollout: Callable[..., Trajectory], *, finer: Finer, **given: Any) -> Trajectory:
    """``rollout`` of the arguments ``given``, as much finer as ``finer`` says.

    The result looks like that of ``rollout(**given)``: the same vertices, frames, and observations at the same times.
    What is given per step, or by a callable, is asked at the steps of ``given`` and held in between; prescribed
    vertices and colliders go in straight lines between the ends of these.
    """
    given = {name: value for name, value in given.items() if name not in ("settings", "duration")}  # none
    steps, parts, vertices = given["steps"], finer.steps, given["model"].num_vertices if finer.mesh else None
    if parts > 1 or finer.mesh:
        # dv.refine has run this as it stands before, which has checked the arguments
        if given["estimate_errors"]:
            raise NotImplementedError("refine: expected rollouts without estimate_errors")
        given |= {"progress": False}
    if finer.mesh:
        given = on_halved(given, halved(given["model"])) | {"history": None}
    if parts > 1:
        given = _of_smaller_steps(given, parts)
    given["sweeps"] = finer.sweeps * given["sweeps"]
    if finer.others:
        given["model"] = with_other_sweeps(given["model"])
    observe, observed = given["observe"], []

    def observe_some(x: Tensor, v: Tensor, step: int) -> None:
        if step % parts == 0:
            observed.append(observe(x[..., :vertices, :], v[..., :vertices, :], step // parts))

    solves: list[Any] = []
    looks = record_to(solves, "solve") if finer.sweeps > 1 else nullcontext()
    with refined(None), looks:
        found = rollout(**given | {"observe": None if observe is None else observe_some})
    finer.ran.append((steps, unbalanced(solves)))
    history = None if finer.mesh else found.history
    return Trajectory(found.x[..., :vertices, :], found.v[..., :vertices, :],
                      [step // parts for step in found.steps], stacked(observed), found.errors, history)  # fmt: skip


def _of_smaller_steps(given: dict[str, Any], parts: int) -> dict[str, Any]:
    time_step, history = given["time_step"] / parts, given["history"]
    if isinstance(history, History) and not is_step_of(history, time_step):  # but that of a refined rollout before
        raise NotImplementedError("refine: expected rollouts that begin without a history of larger steps")
    save, model = given["save"], given["model"]
    out = given | {
        "steps": parts * given["steps"],
        "time_step": time_step,
        "save": save if save == "last" else parts * (1 if save == "all" else save),
    }
    for name in _HELD:
        out[name] = _held(given[name], parts)
    out["parameters"] = {name: _held(value, parts) for name, value in (given["parameters"] or {}).items()}
    out["prescribed"] = _moving(given["prescribed"], parts, model)
    if isinstance(given["colliders"], PerStep):
        first = model.collider_points if given["colliders_before"] is None else given["colliders_before"]
        out["colliders"] = _between(given["colliders"].values, first, parts)
    return out


def _kept(value: Callable[[int, Tensor, Tensor], Any], parts: int) -> Callable[[int, Tensor, Tensor], Any]:
    """A callable of smaller steps that asks ``value`` at the first of each of its steps only. A segment of a
    checkpointed rollout may begin at another: with gradients all answers are kept."""
    answers: dict[int, Any] = {}

    def ask(step: int, x: Tensor, v: Tensor) -> Any:
        if step % parts == 0:
            if not torch.is_grad_enabled():
                answers.clear()
            answers[step // parts] = value(step // parts, x, v)
        return answers[step // parts]

    return ask


def _held(value: Any, parts: int) -> Any:
    if isinstance(value, PerStep):
        return PerStep(value.values.repeat_interleave(parts, 0))
    if isinstance(value, StepAverage):  # over the smaller steps
        return value
    return _kept(value, parts) if callable(value) and not isinstance(value, Tensor) else value


def _moving(value: Any, parts: int, model: Model) -> Any:
    """Where pinned vertices are at the end of each smaller step."""
    if value is None:
        return None
    ends = _kept(value, parts) if callable(value) and not isinstance(value, (Tensor, PerStep)) else None
    begun = _kept(lambda step, x, v: x, parts)
    pinned = model.pinned[:, None]

    def now(step: int, x: Tensor, v: Tensor) -> Tensor:
        begin = begun(step, x, v)
        if ends is not None:
            end = ends(step, x, v)
        else:
            end = value.values[step // parts] if isinstance(value, PerStep) else value
        if not isinstance(end, Tensor):
            raise NotImplementedError("refine: expected prescribed positions without those of stages")
        way = begin + (end - begin) * ((step % parts + 1) / parts)
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
