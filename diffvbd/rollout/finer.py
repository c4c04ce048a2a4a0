"""A rollout over the same time with smaller steps, more sweeps or smaller tets, as dv.refine runs it."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from ..model.model import Model
from ..model.solver import VBD
from ..scopes import Finer, record_to, refined
from ..step.integrators import History, is_step_of
from .checks import check_checks
from .halved import halved, on_halved
from .reference import unbalanced, with_other_sweeps
from .trajectory import PerStep, StepAverage, Trajectory, stacked

_MOVING = ("prescribed", "colliders", "colliders_before")  # other inputs are held over the smaller steps


def rollout_finer(rollout: Callable[..., Trajectory], finer: Finer, model: Model, x: Tensor, v: Tensor, solver: VBD,
                  steps: int, inputs: dict[str, Any], options: dict[str, Any]) -> Trajectory:  # fmt: skip
    """``rollout`` of these arguments, as much finer as ``finer`` says.

    The result looks like that of the rollout itself: the same vertices, frames, and observations at the same times.
    What is given per step, or by a function, is asked at the steps of the caller and held in between; prescribed
    vertices and colliders go in straight lines between the ends of these.
    """
    parts, vertices, asked = finer.steps, model.num_vertices if finer.mesh else None, steps
    options = dict(options)
    if parts > 1 or finer.mesh:
        # dv.refine has run this as it stands before, which has checked the arguments
        if check_checks(options["checks"], model).errors:
            raise NotImplementedError("refine: expected rollouts without Checks(errors=True)")
        options |= {"progress": False}
    if finer.mesh:
        fine = halved(model)
        inputs, x, v, options["history"] = on_halved(inputs, model, fine), fine.between(x), fine.between(v), None
        model = fine.model
    if parts > 1:
        solver = replace(solver, time_step=solver.time_step / parts)
        history, save = options["history"], options["save"]
        if isinstance(history, History) and not is_step_of(history, solver.time_step):  # but that of a refined rollout
            raise NotImplementedError("refine: expected rollouts that begin without a history of larger steps")
        options["save"] = save if save == "last" else parts * (1 if save == "all" else save)
        inputs, steps = _of_smaller_steps(inputs, parts, model), parts * steps
    solver = replace(solver, sweeps=finer.sweeps * solver.sweeps)
    if finer.others:
        solver = with_other_sweeps(model, solver)
    observe, observed = options["observe"], []

    def observe_some(step: int, x: Tensor, v: Tensor) -> None:
        if step % parts == 0:
            observed.append(observe(step // parts, x[..., :vertices, :], v[..., :vertices, :]))

    solves: list[Any] = []
    looks = record_to(solves, "solve") if finer.sweeps > 1 else nullcontext()
    options["observe"] = None if observe is None else observe_some
    with refined(None), looks:
        found = rollout(model, x, v, solver, steps=steps, **options, **inputs)
    finer.ran.append((asked, unbalanced(solves)))
    history = None if finer.mesh else found.history
    return Trajectory(found.x[..., :vertices, :], found.v[..., :vertices, :],
                      [step // parts for step in found.steps], stacked(observed), found.errors, history)  # fmt: skip


def _of_smaller_steps(inputs: dict[str, Any], parts: int, model: Model) -> dict[str, Any]:
    out = {name: value if name in _MOVING else _held(value, parts) for name, value in inputs.items()}
    if "prescribed" in out:
        out["prescribed"] = _moving(out["prescribed"], parts, model)
    if isinstance(out.get("colliders"), PerStep):
        before = out.get("colliders_before")
        first = model.collider_points if before is None else before
        out["colliders"] = _between(out["colliders"].values, first, parts)
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
