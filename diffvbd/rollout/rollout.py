"""Many steps, with checkpointing: what backpropagation through time keeps is chosen, not suffered."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import partial
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from ..adjoint.routes import Adjoint, check_adjoint
from ..checks import check_bool, check_count, check_function, fail, is_word
from ..model.model import Model
from ..model.warnings import warn_of_inverted_bodies
from ..said import is_own
from ..scopes import looks_at, recorders, refinement
from ..step.advance import advance
from ..step.arguments import GRAVITY, MAX_SWEEPS, acceleration_of, check_prescribed, check_state, prepare, step_settings
from ..step.estimate import ErrorEstimate, check_estimable, error_of, of_steps
from ..step.growth import warn_of_sweeps
from ..step.held_up import cut_share
from ..step.integrators import (
    History,
    Integrator,
    check_history,
    check_integrator,
    check_staged,
    solves_of,
    take,
)
from ..step.intersections import check_start as refuse_start
from ..tuples import replaced
from .checkpoints import BinomialCheckpoints, Segment, choose_schedule, run_segments
from .chosen import rollout_with
from .contact_check import checks_contact, warn_of_contact
from .end_check import look_at_end, warn_of_last_end
from .energy_check import look_at_energy
from .finer import rollout_finer
from .reference import LOOKS
from .repeated import repeated
from .settings import Settings
from .trajectory import PerStep, StepAverage, Trajectory, refuse_average, stacked

# these enter through prepare(), the others through advance()
_STATIC = ("mu", "lam", "young", "poisson", "rest_points", "density")
_LOADS = ("force", "gravity", "prescribed")


def rollout(
    model: Model,
    x: Tensor,
    v: Tensor,
    *,
    steps: int | None = None,
    mu: Any = None,
    lam: Any = None,
    young: Any = None,
    poisson: Any = None,
    time_step: float | None = None,
    sweeps: int | None = None,
    settings: Settings | Literal["auto"] | None = None,
    duration: float | None = None,
    force: Any = None,
    gravity: Any = GRAVITY,
    prescribed: Any = None,
    colliders: Any = None,
    colliders_before: Tensor | None = None,
    rest_points: Any = None,
    density: Any = None,
    parameters: dict[str, Any] | None = None,
    adjoint: Adjoint | None = None,
    integrator: Integrator | None = None,
    history: History | None = None,
    checkpoint_every: int | BinomialCheckpoints | Literal["auto"] | None = "auto",
    save: Literal["all", "last"] | int = "all",
    observe: Callable[[Tensor, Tensor, int], Any] | None = None,
    progress: bool = False,
    estimate_errors: bool = False,
    check_contact: bool | None = None,
    check_energy: bool | None = None,
    check_start: bool = True,
) -> Trajectory:
    """Runs ``steps`` steps; the gradient is that of calling :func:`diffvbd.step` in a loop.

    Args:
        model, x, v, time_step, sweeps, adjoint, integrator: As in :func:`diffvbd.step`. With BDF2() the rollout keeps
            the history; ``history`` continues an earlier one, whose Trajectory has it.
        steps: Number of steps >= 0.
        settings: In place of time_step, sweeps, integrator and of the Model's relaxation, coarse and acceleration: what
            :func:`diffvbd.advise` returned, or a :class:`diffvbd.Settings` of your own. ``"auto"`` asks for an error of
            0.01 first, which takes some rollouts, up to tens, each time: for one call, not for a training loop.
        duration: With settings, the time [s] in place of steps: as many equal steps as their time_step asks for.
        colliders: Corner points of the Model's colliders [m]: constant, they rest there; in :func:`per_step`, where
            they are at the end of each step.
        colliders_before: Where per_step colliders are at the start; None: the Model's collider_points.
        mu, lam, young, poisson, force, gravity, prescribed, rest_points, density, parameters: As in step, constant in
            time; or wrapped in :func:`per_step` or :func:`step_average`; or a callable of (step, x, v) that returns the
            value for that step (None only for a step without ``force``).
            A callable may close over tensors and modules that require grad: they get gradients under every schedule. A
            checkpointed segment calls it again in the backward, where it must return the same: no state that it keeps
            from call to call, nothing that has changed in place since. ``prescribed`` may also have the initial x where
            a vertex is not pinned.
        checkpoint_every: Between checkpoints of n steps only states are kept, and the segment is run again in the
            backward: n keeps steps / n states and the tapes of n steps. ``None`` keeps all tapes.
            :class:`diffvbd.BinomialCheckpoints` keeps a given number of states and one tape. ``"auto"`` keeps all tapes
            while they fit diffvbd.rollout.checkpoints.TAPE_BUDGET, else takes n near sqrt(steps). See
            ``model.memory``. Inside torch.func transforms, where torch has no checkpoints, ``"auto"`` and ``None`` keep
            all tapes.
        save: Which frames the trajectory holds: ``"all"`` (steps + 1 frames, from the initial state), every n-th and
            the last, or only the ``"last"``.
        observe: Called after each step as observe(x, v, step) with step = 1 ... steps; its results (a tensor, or a
            tuple, list or dict of tensors) are stacked and differentiable, so that long rollouts need not keep frames.
        progress: Print progress to stderr.
        estimate_errors: Also return how far from converged each step ends (:class:`diffvbd.ErrorEstimate`). Each step
            is swept twice for it, the second time without a tape, once under every schedule; states and gradients are
            the same.
        check_contact: Whether to warn (UserWarning) where pairs held up more than 1 % of vertices in a step, or the
            last one left more than 5 % of what friction can bear unbalanced. None: on the CPU, after ten steps or more.
            A look costs about a step and on CUDA waits for the device; nothing that is compiled or captured is looked
            at.
        check_energy: Whether to warn (UserWarning) where a scene that only gravity drives has 5 % more energy (where
            barriers push at the start, twice as much) than it began with and gravity gave it; where, without pairs, the
            sweeps leave the motion off by an estimated 2 %; where thin tets bend. True: energy after any
            step. None: on the CPU, of ten steps or more, after six of them, most of them early (with a floor 12, with
            contact up to 64). A rollout that ends with what is not finite, or too far away, always warns.
        check_start: With a PairBarrier, raise where surfaces intersect at the start: edges through triangles, or
            vertices behind a Plane. Contact keeps apart what is apart, and no step notices what is not. It costs a
            quarter of one detection or less on the CPU and, on CUDA, waits for the device once. Under torch.compile,
            and while a CUDA graph is captured, nothing is checked: run the rollout once before the capture. On the CPU
            it also warns (UserWarning) where all tets of a body are inverted.

    Raises:
        ValueError, TypeError: As step; also where a per_step value has another number of steps, or surfaces intersect.
        RuntimeError: In the backward, under checkpoints, where an argument has changed in place, or a callable returns
            another value than before (for a tensor on CUDA the gradient is NaN).
        NotImplementedError: ``estimate_errors`` with contact or friction; another ``checkpoint_every`` than ``"auto"``
            and ``None`` inside torch.func transforms.
    """
    if settings is not None:
        return rollout_with(rollout, **locals())
    if duration is not None:
        raise TypeError("duration: expected it beside settings only; without them give steps and time_step")
    if time_step is None or sweeps is None:
        raise TypeError(f"{'time_step' if time_step is None else 'sweeps'}: expected a number, or settings, got None")
    if (finer := refinement()) is not None:  # inside dv.refine
        return rollout_finer(rollout, **locals())
    steps = check_count("steps", steps, maximum=MAX_SWEEPS)
    save = _checked_save(save)
    _check_estimates(estimate_errors, model)
    for name, asked in (("check_contact", check_contact), ("check_energy", check_energy)):
        if not isinstance(asked, bool | None):
            raise TypeError(f"{name}: expected a bool or None, got {type(asked).__name__}")
    if observe is not None:
        check_function("observe", observe, "x", "v", "step")
    check_bool("check_start", check_start)
    lead, adjoint, scheme = check_state(model, x, v), check_adjoint(adjoint), check_integrator(integrator)
    check_history(scheme, history, x, time_step)
    options = {"mu": mu, "lam": lam, "young": young, "poisson": poisson, "rest_points": rest_points,
               "density": density, "force": force, "gravity": gravity, "prescribed": prescribed,
               "colliders": colliders}  # fmt: skip
    _check_values(options, parameters, colliders_before, steps)
    options, parameters = ({name: value.over(time_step) if isinstance(value, StepAverage) else value
                            for name, value in given.items()} for given in (options, parameters or {}))  # fmt: skip
    # What a checkpointed segment reads again must not change in between: lists and dicts are copied. Plain dicts and
    # functions of them: torch.compile takes no object of ours along.
    options, own = ({k: _frozen(v) for k, v in given.items()} for given in (options, parameters))
    if not _changes(options["gravity"]):
        options["gravity"] = acceleration_of(options["gravity"], x)  # once, not in each step
    # once: what a checkpoint runs again must run as it did, whatever dv.regime says by then
    execution = step_settings(model, lead, time_step, sweeps)
    h = execution.numbers.time_step
    chosen: dict[str, Any] = {"time_step": time_step, "sweeps": sweeps, "adjoint": adjoint, "settings": execution}
    anew = any(_changes(value) for value in (*(options[k] for k in _STATIC), *own.values()))
    fixed = None if anew else prepare(model, lead, **chosen, **_to_prepare(options, own, 0, x, v))
    if fixed is not None and steps:
        warn_of_sweeps(model, fixed, scheme)
    for value in _tensors(options["prescribed"]):
        check_prescribed(model, value, x)
    if check_start and steps:
        refuse_start(model, x, options["colliders"], colliders_before, _changes(options["colliders"]))
        if looks_at(x):
            warn_of_inverted_bodies(model, x)

    scenes = x.numel() // max(1, 3 * model.num_vertices)
    every, adjoint = choose_schedule(checkpoint_every, adjoint, model, scenes, steps, solves_of(scheme) * sweeps)
    # A segment that runs again reads these anew: autograd cannot see that they were changed in between.
    read = {**options, "colliders_before": colliders_before}
    again = every is not None and torch.is_grad_enabled() and not torch.compiler.is_compiling()
    versions = _versions(read, own) if again else []
    if again:
        options = {name: repeated(name, value) for name, value in options.items()}
        own = {name: repeated(f'parameters["{name}"]', value) for name, value in own.items()}
    bar = _Progress(steps) if progress else None
    errors: dict[int, ErrorEstimate] = {}  # by step: a segment that runs again finds them
    last: list[Any] = []  # what the last step went from, and to
    cuts: list[Tensor] = []  # of each step, for the warning of contact
    looks = checks_contact(check_contact, model, x, steps)
    driven = any(options[k] is not None for k in ("force", "prescribed", "colliders")) or _changes(options["gravity"])
    energy = None if driven else look_at_energy(check_energy, model, x, v, steps, fixed, options["gravity"])
    warn_of_last_end(model, x)
    asked = () if torch.compiler.is_compiling() else recorders("solve")
    solves: dict[int, Any] = {}  # by step, of a few: a segment that runs again finds them
    ending = look_at_end(check_energy, model, scheme, x, v, steps, execution)

    outer = x

    def segment(first: int, end: int, x: Tensor, v: Tensor, *before: Tensor) -> Segment:
        _check_versions(versions)
        frames, observed = [], []
        past = History(before[0], before[1], before[2], h) if before else None
        for k in range(first, end):
            run = partial(advance, adjoint=adjoint, index=k)
            try:
                now = prepare(model, lead, **chosen, **_to_prepare(options, own, k, x, v)) if fixed is None else fixed
                given = _to_advance(model, options, k, x, v, outer, colliders_before)
                check_staged(scheme, given)
                v_before = v
                x, v, past, solve = take(scheme, model, x, v, past, now, given, run)
            except (ValueError, TypeError) as error:
                if type(error) not in (ValueError, TypeError):  # another one may take other arguments
                    raise
                more = "" if ending is None else ending.explain(error, x, v)
                raise type(error)(f"{error} (in step {k}){more}") from (None if is_own(error) else error)
            if estimate_errors and k not in errors:
                loads = {name: solve.given[name] for name in _LOADS}
                errors[k] = error_of(model, solve.x, solve.v, solve.prepared, **loads)
            if asked and k % -(-steps // LOOKS) == 0 and k not in solves:
                solves[k] = (model, replaced(solve, x=solve.x.detach(), v=solve.v.detach()), x.detach())
            if energy is not None:
                energy.see(k + 1, x, v)
            if ending is not None:
                ending.see(k + 1, now, given["force"], solve, v_before, x, v)
            if looks and not last:  # not in a segment that runs again
                cuts.append(cut_share(model))
            if looks and k + 1 == steps and not last:
                last.extend(((solve.x, solve.v), x, solve.prepared, solve.given))
            if save == "all" or k + 1 == steps or (save != "last" and (k + 1) % save == 0):
                frames.append((k + 1, x, v))
            if observe is not None:
                observed.append(observe(x, v, k + 1))
            if bar is not None:
                bar.show(k + 1)
        return Segment((x, v, *(past[:3] if past else ())), frames, observed)

    done = run_segments(
        segment, steps, (x, v, *(history[:3] if history else ())), every if torch.is_grad_enabled() else None
    )
    if last:
        warn_of_contact(model, cuts, *last)
        last[:] = [None]  # of no use any more: no tape is held, and a segment that runs again keeps nothing
    if energy is not None:
        energy.warn()
    for found in asked:
        found.extend(solves.values())
    if ending is not None:
        ending.warn(done.end[0], done.end[1], options["gravity"])
        ending.forget()
    frames = ([] if save == "last" and steps > 0 else [(0, x, v)]) + done.frames
    trajectory = Trajectory(
        x=torch.stack([f[1] for f in frames]),
        v=torch.stack([f[2] for f in frames]),
        steps=[f[0] for f in frames],
        observations=stacked(done.observed),
        errors=of_steps([errors[k] for k in range(steps)], model, x, sweeps) if estimate_errors else None,
        history=History(done.end[2], done.end[3], done.end[4], h) if len(done.end) > 2 else None,
    )
    if not torch.compiler.is_compiling():
        for heard in recorders("rollout"):  # of a viewer, which has no use for the graph
            heard[:] = [(model, Trajectory(trajectory.x.detach(), trajectory.v.detach(), trajectory.steps))]
    return trajectory


# --- values of each step ----------------------------------------------------------------------------------------------


def _checked_save(save: Any) -> Any:
    if is_word(save, "all", "last"):
        return save
    if not isinstance(save, (int, np.integer)) or isinstance(save, bool) or save <= 0:
        fail("save", '"all", "last" or an integer > 0', repr(save))
    return int(save)


def _check_estimates(asked: Any, model: Any) -> None:
    check_bool("estimate_errors", asked)
    if asked and isinstance(model, Model):
        check_estimable(model, "estimate_errors")


def _check_values(
    options: dict[str, Any], parameters: dict[str, Any] | None, colliders_before: Tensor | None, steps: int
) -> None:
    """Raises for values that cannot be those of so many steps."""
    colliders = options["colliders"]
    for name in ("prescribed", "colliders"):
        refuse_average(name, options[name])
    if _changes(colliders) and not isinstance(colliders, PerStep):
        raise TypeError("colliders: expected a tensor or per_step, got a callable: a step needs where they come from")
    if colliders_before is not None and not isinstance(colliders, PerStep):
        raise TypeError("colliders_before: expected it beside per_step colliders, which it is the start of")
    if parameters is not None and not isinstance(parameters, dict):
        raise TypeError(f"parameters: expected a dict of tensors by name, got {type(parameters).__name__}")
    for name, value in {**options, **_named(parameters or {})}.items():
        if isinstance(value, PerStep) and value.values.shape[0] != steps:
            fail(name, f"{steps} steps in per_step", f"shape {list(value.values.shape)}")
        if _changes(value) and not isinstance(value, StepAverage):
            check_function(name, value, "step", "x", "v")


def _to_prepare(options: dict[str, Any], parameters: dict[str, Any], k: int, x: Tensor, v: Tensor) -> dict[str, Any]:
    """What enters step k through prepare()."""
    now = {name: _at(name, options[name], k, x, v) for name in _STATIC}
    return now | {"parameters": {name: _at(name, value, k, x, v) for name, value in parameters.items()}}


def _to_advance(model: Model, options: dict[str, Any], k: int, x: Tensor, v: Tensor, start: Tensor,
                colliders_before: Tensor | None) -> dict[str, Any]:  # fmt: skip
    """What enters step k through advance(); ``start``: x before the first step."""
    now = {name: _at(name, options[name], k, x, v) for name in (*_LOADS, "colliders")}
    if _changes(options["prescribed"]) and not isinstance(options["prescribed"], _Steps):
        for value in _tensors(now["prescribed"]):
            check_prescribed(model, value, x, start)
    now["colliders_before"] = None
    if isinstance(options["colliders"], _Steps):
        first = model.collider_points if colliders_before is None else colliders_before
        now["colliders_before"] = options["colliders"][k - 1] if k else first
    return now


def _versions(options: dict[str, Any], parameters: dict[str, Any]) -> list[tuple[str, Tensor, int]]:
    """(name, tensor, version) of all tensors whose changes in place can be seen."""
    found = [(name, t) for name, value in {**options, **_named(parameters)}.items() for t in _tensors(value)]
    return [(name, t, t._version) for name, t in found if not t.is_inference()]


def _check_versions(versions: list[tuple[str, Tensor, int]]) -> None:
    for name, tensor, version in versions:
        if tensor._version != version:
            raise RuntimeError(f"{name}: changed in place between the rollout and its backward")


def _named(parameters: dict[str, Any]) -> dict[str, Any]:
    """Energy parameters by the name that an error gives them."""
    return {f'parameters["{k}"]': value for k, value in parameters.items()}


class _Steps(tuple):
    """The tensors of a per_step value, one for each step."""


def _tensors(value: Any) -> list[Tensor]:
    """Those of a value, which may be that of each step, or a tuple of one for each solve of a step."""
    parts = value if isinstance(value, tuple) else (value,)
    return [part for part in parts if isinstance(part, Tensor)]


def _frozen(value: Any) -> Any:
    if isinstance(value, PerStep):  # unbind: the backward of values[k] would fill a tensor of all steps at every step
        return _Steps(value.values.unbind(0))
    return tuple(value) if isinstance(value, list) else value


def _changes(value: Any) -> bool:
    return isinstance(value, _Steps) or (callable(value) and not isinstance(value, Tensor))


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
