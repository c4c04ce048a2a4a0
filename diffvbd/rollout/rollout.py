"""Many steps, with checkpointing: what backpropagation through time keeps is chosen, not suffered."""

from __future__ import annotations

import sys
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from typing import Any, Literal

import torch
from torch import Tensor

from .._common.checks import (
    check_bool,
    check_count,
    check_function,
    check_kind,
    check_positive,
    check_save,
    check_tensor,
    fail,
    kind_of,
)
from .._common.context import looks_at, recorders, refinement, replaced
from .._common.messages import is_own
from ..adjoint.routes import Adjoint, check_adjoint
from ..model.model import Model
from ..model.solver import MAX_SWEEPS, VBD
from ..model.system import System
from ..step.advance import advance
from ..step.arguments import (
    LOADS,
    Given,
    acceleration_of,
    check_prescribed,
    check_staged,
    check_state,
    given_of,
    prepare,
    step_settings,
)
from ..step.contact import check_start as refuse_start
from ..step.integrators import History, check_history, solves_of, take
from ..step.residual import ErrorEstimate, error_of, of_steps
from ..step.warnings import proven, system_for, warn_of_inverted_bodies, warn_of_leaps, warn_of_sweeps
from .checks import Checks, check_checks, look_at_contact, look_at_end, look_at_energy, warn_of_last_end
from .memory import BinomialCheckpoints, Segment, choose_schedule, run_segments
from .refine import LOOKS, rollout_finer
from .trajectory import PerStep, StepAverage, Trajectory, refuse_average, repeated, stacked


def rollout(
    model: Model,
    x: Tensor,
    v: Tensor,
    solver: VBD,
    *,
    steps: int | None = None,
    duration: float | None = None,
    save: Literal["all", "last"] | int = "all",
    observe: Callable[[int, Tensor, Tensor], Any] | None = None,
    checkpoint_every: int | BinomialCheckpoints | Literal["auto"] | None = "auto",
    adjoint: Adjoint | None = None,
    history: History | None = None,
    checks: Checks | None = None,
    progress: bool = False,
    **inputs: Any,
) -> Trajectory:
    """Many steps; the gradient is that of calling :func:`diffvbd.step` in a loop.

    Args:
        model, x, v, solver, adjoint: As in :func:`diffvbd.step`.
        steps: Number of steps >= 0.
        duration: In place of steps, the time [s]: as many equal steps as the solver's time_step asks for.
        inputs: As in step, constant in time; or wrapped in :func:`per_step` or :func:`step_average`; or a function of
            (step, x, v), step = 0 ... steps - 1 and the state before it, that returns the value for that step (None
            only for a step without ``force``).
            A function may close over tensors and modules that require grad: they get gradients under every schedule. A
            checkpointed segment calls it again in the backward, where it must return the same: no state that it keeps
            from call to call, nothing that has changed in place since. ``prescribed`` may also have the initial x where
            a vertex is not pinned. ``colliders`` are a tensor, and rest there, or per_step or a function: where they
            are at the end of each step, in a tensor [..., Vc, 3] that broadcasts over scenes. Their velocity follows
            from these; ``colliders_before``: where they are at the start; None: the Model's collider_points.
        save: Which frames the trajectory holds: ``"all"`` (steps + 1 frames, from the initial state), every n-th and
            the last, or only the ``"last"``.
        observe: Called after each step as observe(step, x, v) with step = 1 ... steps; its results (a tensor, or a
            tuple, list or dict of tensors) are stacked and differentiable, so that long rollouts need not keep frames.
        checkpoint_every: Between checkpoints of n steps only states are kept, and the segment is run again in the
            backward: n keeps steps / n states and the tapes of n steps. ``None`` keeps all tapes.
            :class:`diffvbd.BinomialCheckpoints` keeps a given number of states and one tape. ``"auto"`` keeps all tapes
            while they fit 2 GiB, else takes n near sqrt(steps). See :func:`diffvbd.memory`. Inside torch.func
            transforms, where torch has no checkpoints, ``"auto"`` and ``None`` keep all tapes.
        history: With BDF2(), the ``history`` of the Trajectory that this rollout continues.
        checks: What is looked at, see :class:`diffvbd.Checks`; None: the default ones.
        progress: Print progress to stderr.

    Raises:
        ValueError, TypeError: As step; also where a per_step value has another number of steps, or surfaces intersect.
        RuntimeError: In the backward, under checkpoints, where an argument has changed in place, or a function returns
            another value than before (for a tensor on CUDA the gradient is NaN).
        NotImplementedError: ``Checks(errors=True)`` with contact or friction; another ``checkpoint_every`` than
            ``"auto"`` and ``None`` inside torch.func transforms.
    """
    check_kind("model", model, Model)
    check_kind("solver", solver, VBD)
    if (steps is None) == (duration is None):
        raise TypeError(f"steps: expected either steps or duration, got {'neither' if steps is None else 'both'}")
    if duration is None:
        steps = check_count("steps", steps, maximum=MAX_SWEEPS)
    else:
        steps = solver.steps(duration)
        solver = replace(solver, time_step=check_positive("duration", duration, "s") / steps)
    options = {"save": save, "observe": observe, "checkpoint_every": checkpoint_every, "adjoint": adjoint,
               "history": history, "checks": checks, "progress": progress}  # fmt: skip
    if (finer := refinement()) is not None:  # inside dv.refine
        return rollout_finer(rollout, finer, model, x, v, solver, steps, inputs, options)
    with proven() if solver.prediction is not None and solver.prediction.reached else nullcontext():
        return _rollout(model, x, v, solver, steps, given_of(model, inputs), **options)


def _rollout(model: Model, x: Tensor, v: Tensor, solver: VBD, steps: int, inputs: Given, *, save: Any, observe: Any,
             checkpoint_every: Any, adjoint: Adjoint | None, history: History | None, checks: Checks | None,
             progress: bool) -> Trajectory:  # fmt: skip
    """A rollout of so many steps of the solver's length."""
    save, checks = check_save(save), check_checks(checks, model)
    if observe is not None:
        check_function("observe", observe, "step", "x", "v")
    check_bool("progress", progress)
    lead, model = check_state(model, x, v), system_for(model, solver)
    scheme, adjoint, time_step = solver.integrator, check_adjoint(adjoint, solver.tape), solver.time_step
    check_history(scheme, history, x, time_step)
    _check_values(inputs, steps)
    # What a checkpointed segment reads again must not change in between: lists and dicts are copied. Plain dicts and
    # functions of them: torch.compile takes no object of ours along.
    material, own, loads = ({k: _frozen(v, time_step) for k, v in part.items()} for part in inputs)
    if not _changes(loads["gravity"]):
        loads["gravity"] = acceleration_of(loads["gravity"], x)  # once, not in each step
    # once: what a checkpoint runs again must run as it did, whatever regime() says by then
    execution = step_settings(model, lead, time_step, solver.sweeps)
    h = execution.numbers.time_step
    chosen: dict[str, Any] = {"time_step": time_step, "sweeps": solver.sweeps, "adjoint": adjoint,
                              "settings": execution}  # fmt: skip
    anew = any(_changes(value) for value in (*material.values(), *own.values()))
    fixed = None if anew else prepare(model, lead, Given(material, own, {}), **chosen)
    if fixed is not None and steps:
        warn_of_sweeps(model, fixed, scheme)
    for value in _tensors(loads["prescribed"]):
        check_prescribed(model, value, x)
    if checks.start and steps:
        refuse_start(model, x, loads["colliders"], loads["colliders_before"], _changes(loads["colliders"]))
        if looks_at(x):
            warn_of_inverted_bodies(model, x)
            warn_of_leaps(model, v, time_step)

    scenes = x.numel() // max(1, 3 * model.num_vertices)
    every, adjoint = choose_schedule(checkpoint_every, adjoint, model, scenes, steps, solves_of(scheme) * solver.sweeps)
    # A segment that runs again reads these anew: autograd cannot see that they were changed in between.
    again = every is not None and torch.is_grad_enabled() and not torch.compiler.is_compiling()
    versions = _versions({**material, **own, **loads}) if again else []
    if again:
        material, own, loads = ({k: repeated(k, v) for k, v in part.items()} for part in (material, own, loads))
    bar = _Progress(steps) if progress else None
    errors: dict[int, ErrorEstimate] = {}  # by step: a segment that runs again finds them
    contact = look_at_contact(checks.contact, model, x, steps)
    driving = [k for k in ("force", "prescribed", "colliders") if loads[k] is not None]
    driving += ["gravity"] if _changes(loads["gravity"]) else []
    energy = look_at_energy(checks.energy, model, x, v, steps, fixed, loads["gravity"], driving)
    warn_of_last_end(model, x)
    asked = () if torch.compiler.is_compiling() else recorders("solve")
    solves: dict[int, Any] = {}  # by step, of a few: a segment that runs again finds them
    ending = look_at_end(checks.energy, model, scheme, x, v, steps, execution)

    outer, moves = x, _is_function(loads["colliders"])

    def segment(first: int, end: int, x: Tensor, v: Tensor, *before: Tensor) -> Segment:
        for name, tensor, version in versions:
            if tensor._version != version:
                raise RuntimeError(f"{name}: changed in place between the rollout and its backward")
        frames, observed = [], []
        points = before[-1] if moves else None  # of the colliders that a function moves
        before = before[:-1] if moves else before
        past = History(before[0], before[1], before[2], h) if before else None
        for k in range(first, end):
            run = partial(advance, adjoint=adjoint, index=k)
            try:
                now = prepare(model, lead, _at_step(material, own, k, x, v), **chosen) if fixed is None else fixed
                given = _to_advance(model, loads, k, x, v, outer, points)
                points = given["colliders"] if moves else None
                check_staged(scheme, given)
                v_before = v
                x, v, past, solve = take(scheme, model, x, v, past, now, given, run)
            except (ValueError, TypeError) as error:
                if type(error) not in (ValueError, TypeError):  # another one may take other arguments
                    raise
                more = "" if ending is None else ending.explain(error, x, v)
                raise type(error)(f"{error} (in step {k}){more}") from (None if is_own(error) else error)
            if checks.errors and k not in errors:
                errors[k] = error_of(model, solve.x, solve.v, solve.prepared,
                                     **{name: solve.given[name] for name in LOADS})  # fmt: skip
            if asked and k % -(-steps // LOOKS) == 0 and k not in solves:
                solves[k] = (model, replaced(solve, x=solve.x.detach(), v=solve.v.detach()), x.detach())
            if energy is not None:
                energy.see(k + 1, x, v)
            if ending is not None:
                ending.see(k + 1, now, given["force"], solve, v_before, x, v)
            if contact is not None:
                contact.see(k + 1, solve, x)
            if save == "all" or k + 1 == steps or (save != "last" and (k + 1) % save == 0):
                frames.append((k + 1, x, v))
            if observe is not None:
                observed.append(observe(k + 1, x, v))
            if bar is not None:
                bar.show(k + 1)
        return Segment((x, v, *(past[:3] if past else ()), *([] if points is None else [points])), frames, observed)

    begins = [_first_points(model, loads, x)] if moves else []
    done = run_segments(
        segment, steps, (x, v, *(history[:3] if history else ()), *begins), every if torch.is_grad_enabled() else None
    )
    _, _, *past = done.end[:-1] if moves else done.end
    if contact is not None:
        contact.warn()
    if energy is not None:
        energy.warn()
    for found in asked:
        found.extend(solves.values())
    if ending is not None:
        ending.warn(done.end[0], done.end[1], loads["gravity"])
        ending.forget()
    frames = ([] if save == "last" and steps > 0 else [(0, x, v)]) + done.frames
    trajectory = Trajectory(
        x=torch.stack([f[1] for f in frames]),
        v=torch.stack([f[2] for f in frames]),
        steps=[f[0] for f in frames],
        observations=stacked(done.observed),
        errors=of_steps([errors[k] for k in range(steps)], model, x, solver.sweeps) if checks.errors else None,
        history=History(past[0], past[1], past[2], h) if past else None,
    )
    if not torch.compiler.is_compiling():
        for heard in recorders("rollout"):  # of a viewer, which has no use for the graph
            heard[:] = [(model.model, Trajectory(trajectory.x.detach(), trajectory.v.detach(), trajectory.steps))]
    return trajectory


# --- values of each step ----------------------------------------------------------------------------------------------


def _check_values(inputs: Given, steps: int) -> None:
    """Raises for values that cannot be those of so many steps."""
    colliders = inputs.loads["colliders"]
    for name in ("prescribed", "colliders"):
        refuse_average(name, inputs.loads[name])
    before = inputs.loads["colliders_before"]
    if before is not None and not isinstance(before, Tensor):
        raise TypeError(f"colliders_before: expected a tensor, got {kind_of(before)}")
    if before is not None and not (_changes(colliders) or isinstance(colliders, PerStep)):
        raise TypeError("colliders_before: expected it with colliders per_step or by a function, whose start it is")
    for part in inputs:
        for name, value in part.items():
            if isinstance(value, PerStep) and value.values.shape[0] != steps:
                fail(name, f"{steps} steps in per_step", f"shape {list(value.values.shape)}")
            if _changes(value) and not isinstance(value, StepAverage):
                check_function(name, value, "step", "x", "v")


def _at_step(material: dict[str, Any], own: dict[str, Any], k: int, x: Tensor, v: Tensor) -> Given:
    """The material and the parameters of energies in step k."""
    now = [{name: _at(name, value, k, x, v) for name, value in part.items()} for part in (material, own)]
    return Given(now[0], now[1], {})


def _to_advance(model: System, loads: dict[str, Any], k: int, x: Tensor, v: Tensor, start: Tensor,
                points: Tensor | None) -> dict[str, Any]:  # fmt: skip
    """The loads of step k; ``start``: x before the first step.  points: Where the step before has left colliders that
    a function moves."""
    now = {name: _at(name, value, k, x, v) for name, value in loads.items()}
    if _changes(loads["prescribed"]) and not isinstance(loads["prescribed"], _Steps):
        for value in _tensors(now["prescribed"]):
            check_prescribed(model, value, x, start)
    now["colliders_before"] = None
    if isinstance(loads["colliders"], _Steps):
        before = loads["colliders_before"]
        first = model.collider_points if before is None else before
        now["colliders_before"] = loads["colliders"][k - 1] if k else first
    elif points is not None:
        found, count = check_tensor("colliders", now["colliders"], x), len(model.collider_points)
        if found.shape[-2:] != (count, 3):  # one point for all corners of a surface would be none
            fail("colliders", f"a function that returns shape [..., {count}, 3]", f"shape {list(found.shape)}")
        # a copy: the function may write the next positions into the same tensor
        now["colliders"], now["colliders_before"] = found.clone(), points
    return now


def _first_points(model: System, loads: dict[str, Any], x: Tensor) -> Tensor:
    before = loads["colliders_before"]
    return model.collider_points if before is None else check_tensor("colliders_before", before, x).clone()


def _versions(inputs: dict[str, Any]) -> list[tuple[str, Tensor, int]]:
    """(name, tensor, version) of all tensors whose changes in place can be seen."""
    found = [(name, t) for name, value in inputs.items() for t in _tensors(value)]
    return [(name, t, t._version) for name, t in found if not t.is_inference()]


class _Steps(tuple):
    """The tensors of a per_step value, one for each step."""


def _tensors(value: Any) -> list[Tensor]:
    """Those of a value, which may be that of each step, or a tuple of one for each solve of a step."""
    parts = value if isinstance(value, tuple) else (value,)
    return [part for part in parts if isinstance(part, Tensor)]


def _frozen(value: Any, time_step: float) -> Any:
    if isinstance(value, StepAverage):
        return value.over(time_step)
    if isinstance(value, PerStep):  # unbind: the backward of values[k] would fill a tensor of all steps at every step
        return _Steps(value.values.unbind(0))
    return tuple(value) if isinstance(value, list) else value


def _changes(value: Any) -> bool:
    return isinstance(value, _Steps) or _is_function(value)


def _is_function(value: Any) -> bool:
    return callable(value) and not isinstance(value, Tensor)


def _at(name: str, value: Any, k: int, x: Tensor, v: Tensor) -> Any:
    if isinstance(value, _Steps):
        return value[k]
    if not _changes(value):
        return value
    found = value(k, x, v)
    if found is None and name != "force":  # a forgotten return: None would stand for the default
        raise TypeError(f"{name}: expected a function that returns the value for a step, got None")
    return found


# --- what a rollout prints --------------------------------------------------------------------------------------------


class _Progress:
    """One line on a terminal, ten in a log. Steps that a backward runs again are not counted twice."""

    def __init__(self, steps: int) -> None:
        self.steps, self.shown, self.terminal = steps, 0, sys.stderr.isatty()

    def show(self, k: int) -> None:
        if k <= self.shown:
            return
        last, self.shown = self.shown, k
        if self.terminal:
            print(f"\rstep {k}/{self.steps}", end="\n" if k == self.steps else "", file=sys.stderr, flush=True)
        elif 10 * k // self.steps > 10 * last // self.steps:
            print(f"step {k}/{self.steps}", file=sys.stderr, flush=True)
