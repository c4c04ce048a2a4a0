"""Whether what an optimisation found holds with smaller steps, more sweeps and a finer mesh, and so its gradient."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from .._common.checks import check_bool, check_positive, fail, to_float
from .._common.constants import ELASTIC
from .._common.context import Finer, record_to, refined
from .._common.messages import percent
from ..energies import StableNeoHookean
from ..mesh import subdivide
from ..model.model import Model
from ..model.solver import VBD
from ..step.arguments import OF_TETS
from ..step.integrators import History, is_step_of
from ..step.residual import UNBALANCED, left_of_solve, share
from .checks import check_checks
from .trajectory import PerStep, StepAverage, Trajectory, mapped, stacked

MOST = 16  # times the sweeps, until the forces of the finest run balance
STEPS = (0.01, 0.1)  # of a parameter, of central differences
HELPS = {"K": "more sweeps", "2 K": "more sweeps", "h": "smaller steps", "h/2": "smaller steps",
         "mesh": "a finer mesh"}  # fmt: skip


@dataclass(frozen=True)
class GradientTest:
    """Error of the gradient with respect to a parameter, see :func:`diffvbd.refine`: shares of the gradient, or of the
    largest slope of the loss within a tenth of the parameter, if that is larger [-].

    Attributes:
        finer: From that of each finer run, by name.
        differences: From central differences of 1 % and 10 % of the parameter, along the gradient, by that share;
            without those that cannot be taken: of a parameter that is 0, or where the loss raises ValueError.
    """

    finer: dict[str, float]
    differences: dict[str, float]


@dataclass(frozen=True)
class Refinement:
    """A loss as it was optimised and as finer settings see it, see :func:`diffvbd.refine`. As text: one line.

    Attributes:
        loss: With the settings that the loss has.
        more_sweeps: With twice the sweeps.
        smaller_steps: With half the time step.
        both: With both, and with up to 16 times the sweeps until the forces of its steps balance.
        before: The loss where the optimisation began, or None.
        tolerance: The share of the gain, or without ``before`` of the loss, that may be lost; and of a gradient.
        mesh: As both, on the mesh of eight tets for each; None where that was not asked for.
        gradients: A check for each parameter of ``gradient``.
        left: Share of the forces that the steps of ``both`` and ``mesh`` left over [-].
        sweeps: How many times the sweeps they took.
        survives: Whether none of the finer ones loses more, the forces of their steps balance, and the gradients hold.
    """

    loss: float
    more_sweeps: float
    smaller_steps: float
    both: float
    before: float | None
    tolerance: float
    mesh: float | None = None
    gradients: tuple[GradientTest, ...] = ()
    left: float = 0.0
    sweeps: int = 2

    @property
    def survives(self) -> bool:
        return not self._unstable and is_balanced(self.left)

    @property
    def tested(self) -> str:
        """A sentence on the tests and their outcome, such as ``K, h: stable; gradient, mesh: not tested``."""
        tests, unstable = (
            {"K": True, "h": True, "mesh": self.mesh is not None, "gradient": self.gradients},
            self._unstable,
        )
        found = {"stable": [name for name, run in tests.items() if run and name not in unstable],
                 "not stable": unstable, "not tested": [name for name, run in tests.items() if not run]}  # fmt: skip
        return "; ".join(f"{', '.join(names)}: {what}" for what, names in found.items() if names)

    @property
    def _unstable(self) -> list[str]:
        finer = {"K": self.more_sweeps, "h": self.smaller_steps}
        out = [name for name, value in finer.items() if not self._keeps(value, self.loss)]
        if not out and not self._keeps(self.both, self.loss):
            out = list(finer)
        if self.mesh is not None and not self._keeps(self.mesh, self.both):
            out.append("mesh")
        worst = max((max(*c.finer.values(), *c.differences.values(), 0.0) for c in self.gradients), default=0.0)
        return out if worst <= self.tolerance else [*out, "gradient"]

    def _keeps(self, finer: float, coarser: float) -> bool:
        """Whether a loss with finer settings has lost no more than may be."""
        scale = abs(self.loss) if self.before is None else self.before - self.loss
        lost = finer - coarser if self.before is not None else abs(finer - coarser)
        return math.isfinite(lost) and lost <= self.tolerance * scale

    def __str__(self) -> str:
        began = "" if self.before is None else f" (it began at {self.before:.3g})"
        both = "both" if self.sweeps == 2 else f"h/2 and {self.sweeps} K"
        text = (
            f"{'survives' if self.survives else 'does not survive'} refinement ({self.tested}): loss {self.loss:.3g}"
            f"{began}; with 2 K {self.more_sweeps:.3g}, with h/2 {self.smaller_steps:.3g}, with {both} {self.both:.3g}"
        )
        text += "" if self.mesh is None else f", and eight tets for each {self.mesh:.3g}"
        for number, check in enumerate(self.gradients):
            off = [f"{name} {percent(share)}" for name, share in check.finer.items()]
            off += [f"a difference of {name} {percent(share)}" for name, share in check.differences.items()]
            text += f"; gradient[{number}] is off from {', '.join(off)}"
        if self.survives:
            finer = (self.more_sweeps, self.smaller_steps, self.both, self.loss if self.mesh is None else self.mesh)
            better = self.loss - min(finer)
            if self.before is None or better <= self.tolerance * (self.before - self.loss):
                return text
            return f"{text}: what was gained is kept, but the settings are too coarse to say how much it is"
        if not math.isfinite(self.loss):
            return f"{text}: the loss itself is not finite"
        needed = [what for what in dict.fromkeys(HELPS.values()) if what in self._helps]
        if not is_balanced(self.left):
            text += f": no reference could be reached, {self.sweeps} K leave {percent(self.left)} of the forces"
            text, needed = f"{text} unbalanced", needed or [HELPS["K"]]
        advice = f"optimise on with {' and '.join(needed)}" if needed else "the loss has kinks or jumps here"
        return f"{text}: {advice}"

    @property
    def _helps(self) -> set[str]:
        """Causes that change the loss, or its gradient; of the latter the mesh only where the finest run on the mesh of
        the loss does not."""
        off = {name for check in self.gradients for name, share in check.finer.items() if not share <= self.tolerance}
        off -= {"mesh"} if "both" in off else set()
        return {HELPS[name] for name in {*self._unstable, *off} if name in HELPS}


def refine(
    loss: Callable[[], Tensor | float],
    *,
    before: Tensor | float | None = None,
    tolerance: float = 0.1,
    gradient: Tensor | Sequence[Tensor] | None = None,
    mesh: bool = False,
) -> Refinement:
    """An optimised result, evaluated once more with twice the sweeps and half the time step, and if asked on a finer
    mesh and with its gradient.

    An optimiser may find what only coarse settings reward. Such a result loses what it gained when its motion is
    simulated better: do not trust it, and optimise with smaller steps, more sweeps or smaller tets.

    ``loss`` is called four times, without gradients. Every :func:`diffvbd.rollout` in it runs over the same time and
    returns frames and observations of the same times, so that the loss itself need not change. What it gives per step,
    or by a callable, is asked at its own steps and held in between; prescribed vertices and colliders go in straight
    lines between their ends. The finest run is a reference once its steps leave at most 1 % of their forces
    unbalanced: until then it is called again with 4, 8 and 16 times the sweeps, and where twice as many leave more than
    half of it with plain sweeps in place of coarse corrections, or the other way round.

    Args:
        loss: A function without arguments that returns a scalar, such as the closure of an optimiser, with the
            optimised parameters in place.
        before: The loss where the optimisation began, a scalar: a number or a tensor of shape []. With it, the result
            survives if it keeps 1 - ``tolerance`` of what it gained; without it, if the loss changes by at most
            ``tolerance`` of itself.
        tolerance: See ``before``; in (0, 1). With ``gradient`` also the share of the gradient, or of the largest slope
            of the loss within a tenth of the parameter, by which the gradient may differ.
        gradient: A parameter, or several: leaf tensors that require grad, which ``loss`` reads and does not
            differentiate itself. Each gradient is compared with those of the finer runs, and with central differences
            of 1 % and 10 % of the parameter (of each of its elements at most, along the gradient), which show a kink or
            a trend that the derivative does not follow: four more calls for each.
        mesh: Whether to call the loss once more on subdivided meshes, which takes sixteen times a run and more. Forces
            stay at the vertices of the mesh; a rollout that continues another begins from what that returned.

    Raises:
        ValueError, TypeError: ``loss`` runs no rollout or does not return a scalar; ``before`` is not finite or not
            above the loss; ``gradient`` has what is no parameter of the loss; ``mesh`` with an Anchor.
        NotImplementedError: ``loss`` calls step or solve, which are not refined, continues a BDF2 history that is not
            its own, has ``Checks(errors=True)``, or prescribes positions of stages.
    """
    if not callable(loss):
        raise TypeError(f"loss: expected a function without arguments, got {type(loss).__name__}")
    share = check_positive("tolerance", tolerance)
    if share >= 1:
        fail("tolerance", "a share in (0, 1)", repr(tolerance))
    began = None if before is None else _scalar("before", before)
    if began is not None and not math.isfinite(began):
        fail("before", "a finite loss", began)
    check_bool("mesh", mesh)
    runs = _Runs(loss, _parameters(gradient))
    once = runs.run("own", Finer(1, 1, []))
    if began is not None and not began > once:
        fail("before", f"a loss above that of the result, {once:.3g}", f"{began:.3g}")
    more_sweeps, smaller_steps = runs.run("2 K", Finer(1, 2, [])), runs.run("h/2", Finer(2, 1, []))
    both = runs.balanced("both", mesh=False)
    finest = runs.balanced("mesh", mesh=True) if mesh else None
    checks = tuple(runs.check(number, once) for number in range(len(runs.parameters)))
    return Refinement(once, more_sweeps, smaller_steps, both, began, share, finest, checks, runs.left, runs.sweeps)


class _Runs:
    """Calls of a loss with finer settings, with its gradients where there are parameters."""

    def __init__(self, loss: Callable[[], Any], parameters: list[Tensor]) -> None:
        self.loss, self.parameters = loss, parameters
        self.gradients: dict[str, tuple[Tensor, ...]] = {}  # by the name of a run
        self.left, self.sweeps, self.others = 0.0, 2, False

    def run(self, name: str, finer: Finer) -> float:
        """The loss; its gradients are kept by ``name``, none for ""."""
        differentiates = bool(self.parameters and name)
        # what is compiled runs as it is written, or it would be compiled for each of the runs
        with torch.compiler.set_stance("force_eager"), refined(finer), torch.set_grad_enabled(differentiates):
            value = self.loss()
            found = _scalar("loss", value)
            if not sum(steps for steps, _ in finer.ran):
                fail("loss", "a function that runs dv.rollout, which is what is refined", "one that ran no step of one")
            if not differentiates:
                return found
            if not isinstance(value, Tensor) or not value.requires_grad:
                fail("loss", "a scalar with a graph where gradient is given", "one without")
            gradients = torch.autograd.grad(value.sum(), self.parameters, allow_unused=True)
        for number, gradient in enumerate(gradients):
            if gradient is None:
                fail(f"gradient[{number}]", "a parameter of the loss", "one on which it does not depend")
        self.gradients[name] = gradients  # type: ignore[assignment]
        return found

    def balanced(self, name: str, mesh: bool) -> float:
        """The loss with half the step and with sweeps until the forces of its steps balance."""
        left = math.inf
        while True:
            finer = Finer(2, self.sweeps, [], self.others, mesh)
            found = self.run(name, finer)
            left, before = max(share for _, share in finer.ran), left
            if is_balanced(left) or self.sweeps >= MOST:
                self.left = max(self.left, left)
                return found
            self.sweeps *= 2
            self.others ^= left > STALLED * before

    def check(self, number: int, loss: float) -> GradientTest:
        """The gradient with respect to a parameter, in units of its elements."""
        parameter = self.parameters[number]
        kept, own = parameter.detach().clone(), self.gradients["own"][number]
        unit = kept.abs() if kept.any() else torch.ones_like(kept)
        scaled = unit * own
        largest = scaled.abs().max()
        way = scaled / largest if largest > 0 else torch.ones_like(scaled)  # at most one unit of each element
        along, steepest, slopes = float((scaled * way).sum()), 0.0, {}
        for step in STEPS if kept.any() else ():
            try:
                ahead, behind = (self._moved(parameter, kept + sign * step * unit * way) for sign in (1, -1))
            except ValueError:  # beyond what the loss can have, as of Poisson's ratio near 0.5
                continue
            slopes[f"{100 * step:g} %"] = (ahead - behind) / (2 * step)
            steepest = max(steepest, abs(ahead - loss) / step, abs(loss - behind) / step)

        def share(off: float, size: float) -> float:
            return 0.0 if off == 0 else off / size if size > 0 and math.isfinite(off) else math.inf

        finer = {}
        for name, gradients in self.gradients.items():
            if name != "own":
                better = unit * gradients[number]
                off, size = float((better - scaled).norm()), float(better.norm())
                finer[name] = share(off, max(size, steepest / float(way.norm())))
        return GradientTest(finer, {name: share(abs(slope - along), steepest) for name, slope in slopes.items()})

    def _moved(self, parameter: Tensor, value: Tensor) -> float:
        """The loss with another value of a parameter."""
        kept = parameter.detach().clone()
        try:
            parameter.data.copy_(value)  # .data: no graph of the caller's shall see a new version
            return self.run("", Finer(1, 1, []))
        finally:
            parameter.data.copy_(kept)


def _parameters(given: Any) -> list[Tensor]:
    parameters = [given] if isinstance(given, Tensor) else [] if given is None else given
    if not isinstance(parameters, Sequence) or isinstance(parameters, str):
        raise TypeError(f"gradient: expected a tensor or a list of tensors, got {type(given).__name__}")
    for number, parameter in enumerate(parameters):
        good = isinstance(parameter, Tensor) and parameter.is_leaf and parameter.requires_grad and parameter.numel() > 0
        if not good:
            got = "another tensor" if isinstance(parameter, Tensor) else type(parameter).__name__
            raise TypeError(f"gradient[{number}]: expected a leaf tensor that requires grad, got {got}")
    return list(parameters)


def _scalar(name: str, value: Tensor | float) -> float:
    if isinstance(value, Tensor):
        if value.numel() != 1:
            fail(name, "a scalar", f"shape {list(value.shape)}")
        return float(value.detach())
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise TypeError(f"{name}: expected a scalar, got {type(value).__name__}")
    return to_float(name, value)


# --- a rollout over the same time with smaller steps, more sweeps or smaller tets, as dv.refine -----------------------

NO_STAGES = "refine: expected prescribed positions without those of stages"
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
    if finer.others and (solver.coarse is not None or takes_corrections(model, solver) and not model.touches):
        # plain sweeps in place of coarse corrections, or corrections, where they are cheap, in place of plain ones
        solver = replace(solver, subspace="coarse" if solver.coarse is None else "rigid")
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
    elif callable(out.get("colliders")) and not isinstance(out["colliders"], Tensor):
        before = out.get("colliders_before")
        out["colliders"] = _led(out["colliders"], model.collider_points if before is None else before, parts)
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
    if isinstance(value, (Tensor, StepAverage)) or not callable(value):  # an average is over the smaller steps
        return value
    return _kept(value, parts)


def _moving(value: Any, parts: int, model: Model) -> Any:
    """Positions of pinned vertices at the end of each smaller step."""
    if value is None:
        return None

    def given(step: int, x: Tensor, v: Tensor) -> Any:
        if isinstance(value, PerStep):
            return value.values[step]
        return value(step, x, v) if callable(value) and not isinstance(value, Tensor) else value

    begun, ends = _kept(lambda step, x, v: x, parts), _kept(given, parts)
    pinned = model.pinned[:, None]

    def now(step: int, x: Tensor, v: Tensor) -> Tensor:
        begin, end = begun(step, x, v), ends(step, x, v)
        if not isinstance(end, Tensor):
            raise NotImplementedError(NO_STAGES)
        way = begin + (end - begin) * ((step % parts + 1) / parts)
        # a policy has given elsewhere where vertices were: that is checked in the first smaller step, and old in others
        return torch.where(pinned, way, end if step % parts == 0 else x)

    return now


def _led(value: Callable[[int, Tensor, Tensor], Any], first: Tensor, parts: int) -> Callable[..., Tensor]:
    """Positions of colliders that a function moves, at the end of each smaller step."""
    ends, begins = _kept(value, parts), {0: first}

    def now(step: int, x: Tensor, v: Tensor) -> Tensor:
        asked, end = step // parts, ends(step, x, v)
        begins[asked + 1] = end.clone()  # the function may write the next positions into the same tensor
        return begins[asked] + (end - begins[asked]) * ((step % parts + 1) / parts)

    return now


def _between(ends: Tensor, first: Tensor, parts: int) -> PerStep:
    """Positions of colliders at the end of each smaller step."""
    if len(ends) == 0:
        return PerStep(ends)
    begins = torch.cat([first.expand_as(ends[0])[None], ends[:-1]])
    shares = torch.arange(1, parts + 1, dtype=ends.dtype, device=ends.device) / parts
    ways = torch.stack([begins + share * (ends - begins) for share in shares], dim=1)
    return PerStep(ways.flatten(0, 1))


# --- a scene on the mesh of eight tets for each -----------------------------------------------------------------------

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
    """Raises ValueError for a Model with an energy that has data of each vertex, such as an Anchor, or labels of
    tets."""
    for energy in model.vertex_energies:
        if energy.per_vertex:
            kind = type(model.couplings[0] if model.couplings else energy).__name__
            fail("mesh", f"False: the {kind} acts on vertices, which a finer mesh has not", "True")
    for energy in model.energies:
        if isinstance(energy, StableNeoHookean) and isinstance(energy.patches, Tensor):
            fail("mesh", 'False: a finer mesh has other patches than the labels; take patches="auto"', "True")
    return model.derived("halved", lambda: _halved(model))


def _halved(model: Model) -> Halved:
    tets, pinned = model.tets.cpu(), model.pinned.cpu()
    ends = torch.cat([tets[:, [i, j]] for i in range(4) for j in range(i)]).sort(1).values.unique(dim=0)
    density = model.density.cpu().repeat_interleave(TETS)
    rigid = () if model.rigid_bodies is None else model.rigid_bodies.numbers
    pinned = torch.cat([pinned, pinned[ends].all(1)]) if pinned.any() else None
    changes = {"density": density, "rigid": rigid, "pinned": pinned}
    fine = Model(subdivide(model.mesh), energies=model.replace().energies, colliders=model.colliders, dtype=model.dtype,
                 device=model.device, **changes)  # fmt: skip
    return Halved(fine, ends.to(model.device), model.num_vertices)


def each(value: Any, count: int, axis: int = -1) -> bool:
    """Whether there is a value for each of so many vertices or tets, and not one for all."""
    return isinstance(value, Tensor) and value.dim() >= -axis and value.shape[axis] == count


def of_parts(value: Any, tets: int, axis: int = -1) -> Any:
    """A value of each tet for its eight parts; one of all of them as it is."""
    return value.repeat_interleave(TETS, axis) if each(value, tets, axis) else value


def on_halved(given: dict[str, Any], model: Model, fine: Halved) -> dict[str, Any]:
    """The inputs of a rollout on the finer mesh. Forces stay at the vertices of the mesh."""
    count = fine.vertices
    tets, pinned = model.num_tets, fine.model.pinned[:, None]

    def changed(value: Any, change: Callable[[Any], Any]) -> Any:
        if isinstance(value, PerStep) and value.values.dim() == 1:  # [steps] is a number for each
            return value
        if isinstance(value, (Tensor, StepAverage)) or not callable(value):
            return mapped(value, change)
        return lambda k, x, v: change(value(k, x[..., :count, :], v[..., :count, :]))

    def pushed(force: Any) -> Any:
        if force is None:
            return None
        rows = force.expand(*force.shape[:-2], count, 3) if force.dim() > 1 else force.expand(count, 3)
        return torch.cat([rows, rows.new_zeros(*rows.shape[:-2], len(fine.ends), 3)], -2)

    def accelerated(gravity: Any) -> Any:
        each = isinstance(gravity, Tensor) and gravity.dim() > 1 and gravity.shape[-2] == count
        return fine.between(gravity) if each else gravity

    def moved(ends: Any) -> Any:
        if isinstance(ends, Tensor):
            return torch.where(pinned, fine.between(ends), torch.nan)
        if ends is not None:
            raise NotImplementedError(NO_STAGES)
        return None

    changes = {"force": pushed, "gravity": accelerated, "prescribed": moved,
               "rest_points": lambda points: None if points is None else fine.between(points)}  # fmt: skip
    changes |= dict.fromkeys(OF_TETS, lambda value: of_parts(value, tets))
    changes["stress_free"] = lambda value: None if value is None else of_parts(value, tets, -3)
    changes["drag"] = lambda value: fine.between(value[..., None])[..., 0] if each(value, count) else value
    return {name: changed(value, changes[name]) if name in changes else value for name, value in given.items()}


# --- when a run may be called a reference -----------------------------------------------------------------------------

MOST_SWEEPS = 1300
LOOKS = 64  # at steps of a run, evenly spread
STALLED = 0.9  # of what was left over: more than this part of it after twice the sweeps


def unbalanced(seen: list[Any]) -> float:
    """The force that solves left over, all together, over all of their forces [-]: of the worst scene, with contact of
    the worst body. Steps with large forces, such as those of an impact, weigh more than those in flight.

    seen: of solves that a rollout recorded (kind "solve"), each (Model, Solve, positions after it).
    """
    if not seen:
        return 0.0
    found = [left_of_solve(model, (s.x, s.v), end, s.prepared, s.given) for model, s, end in seen]
    left, whole = (torch.stack(parts).sum(0) for parts in zip(*found, strict=True))
    return float(torch.nan_to_num(share(left, whole), nan=math.inf).max()) if left.numel() else 0.0


def is_balanced(left: float) -> bool:
    """Whether the steps of a run leave so little over that others may be held against it."""
    return left <= UNBALANCED


def takes_corrections(model: Model, solver: VBD) -> bool:
    """Whether coarse corrections are defined."""
    return bool(model.energy_mask & ELASTIC) and solver.block == "exact" and solver.saturation is None


def with_more_sweeps(settings: VBD, left: float, before: float) -> VBD:
    """Those of the next attempt: twice the sweeps, or plain ones where more with corrections have not helped.

    left, before: unbalanced() of the last two runs.
    """
    if settings.coarse is not None and not is_balanced(left) and left > STALLED * before:
        return replace(settings, subspace="rigid", relaxation=1.0)
    return replace(settings, sweeps=2 * settings.sweeps + 1)


def unreached(settings: VBD, left: float) -> str:
    return f"no reference could be reached: {settings} leaves {percent(left)} of its forces unbalanced"
