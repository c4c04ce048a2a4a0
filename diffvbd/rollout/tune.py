"""Accuracy of a rollout: a solver that stays within an error (advise), and the error by cause (error_budget)."""

from __future__ import annotations

import inspect
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from .._common.checks import check_bool, check_count, check_kind, check_number, check_positive, check_time_step, fail
from .._common.context import record_to, refined, refuse_transforms, silence
from .._common.messages import log_progress, percent
from .._contact.barrier import PairBarrier
from ..model.model import Model
from ..model.solver import BDF2, SDIRK2, VBD, ImplicitEuler, Integrator
from ..model.system import system_of
from ..step.arguments import GRAVITY, MATERIAL, MODULI, OF_TETS, Prepared, check_state, given_of, material_of, prepare
from ..step.integrators import SAME_TIME_STEP, Solve
from ..step.residual import truncated_fraction
from ..step.warnings import is_nearly_incompressible
from .checks import NONE, mechanical_energy, unbalanced_friction
from .refine import (
    MOST_SWEEPS,
    halved,
    is_balanced,
    of_parts,
    takes_corrections,
    unbalanced,
    unreached,
    with_more_sweeps,
)
from .rollout import rollout
from .trajectory import PerStep, StepAverage, Trajectory, mapped, refuse_average


@dataclass(frozen=True)
class Candidate:
    """A solver that :func:`diffvbd.advise` has considered.

    Attributes:
        solver: The solver.
        error: Of the motion, or the largest of motion, quantity and gradient [-], as for the advised ones.
        seconds: Of one rollout over the duration [s], with its backward if gradients were asked for.
        proven: Whether they were run over the whole duration; otherwise error and seconds are predicted from a part.
    """

    solver: VBD
    error: float
    seconds: float
    proven: bool


@dataclass(frozen=True)
class Prediction:
    """Prediction of :func:`diffvbd.advise` for the solver that it returns; ``print(solver)`` shows a table with the
    runners-up.

    Attributes:
        asked: The error that was asked for [-].
        error: The predicted one [-]: root mean square over vertices and over four times of the distance to the exact
            motion of the mesh, over that of the motion itself; with a quantity or gradients the largest of theirs.
        seconds: Time of one rollout over ``duration`` [s], with its backward if gradients were asked for.
        duration: [s], of motion.
        reached: Whether ``error`` is known to be at most ``asked``.
        why: One line: why these, or why the error was not reached.
        others: The runners-up, fastest first; if the error was not reached, the other runs with an estimate.
        spent: What all trial runs took [s].
        runs: How many there were.
        of: What ``error`` is an error of, in words that follow its number.
    """

    asked: float
    error: float
    seconds: float
    duration: float
    reached: bool
    why: str
    others: tuple[Candidate, ...]
    spent: float
    runs: int
    of: str = "of the motion"

    @property
    def seconds_per_second(self) -> float:
        """Time per second of motion."""
        return self.seconds / self.duration

    @property
    def cost(self) -> float:
        """Time of the trial runs over that of one advised rollout."""
        return self.spent / self.seconds if self.seconds > 0 else math.inf

    def told(self, line: str) -> str:
        """The lines below a solver, whose text is ``line``: what they promise, why, and the runners-up."""
        verdict = f"error {self.error:.2g} {self.of}"
        if not self.reached:
            verdict += ", not confirmed" if self.error <= self.asked else f": {self.asked:g} was not reached"
        rows = [("solver", "error", "s per s of motion", "")]
        runs = [(line, self, "measured"), *((str(c.solver), c, self._status(c)) for c in self.others)]
        rows += [(text, f"{run.error:.1e}", f"{run.seconds / self.duration:.3g}", note) for text, run, note in runs]
        cost = f"{self.runs} trial runs took {self.spent:.2g} s, {self.cost:.1f} rollouts of this solver"
        first = f"{verdict}, {self.seconds_per_second:.3g} s per second of motion"
        lines = [first, self.why, cost, "", *aligned(rows)]
        if self.reached and any(not c.proven and c.seconds < self.seconds for c in self.others):
            lines.append("What is predicted has not been run to the end, and may miss the error.")
        return "\n".join(lines)

    def _status(self, candidate: Candidate) -> str:
        if not candidate.proven:
            return "predicted"
        misses = self.reached and candidate.seconds < self.seconds
        return "measured, misses the error" if misses else "measured"


def aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """The lines of a table whose columns are as wide as their widest cell."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join(map(str.ljust, row, widths)).rstrip() for row in rows]


def on(solver: VBD, steps: int, duration: float) -> VBD:
    """The solver with ``steps`` steps over ``duration`` [s], without a prediction."""
    steps, duration = check_count("steps", steps, minimum=1), check_positive("duration", duration, "s")
    return replace(solver, time_step=duration / steps, prediction=None)


# --- what changes in time between the times at which a rollout asks for it --------------------------------------------

SWINGS = 0.5  # of its size: a value that differs by more from a line through its samples is not seen by them
LOOKS = 3  # at a step, at other places of each: nothing that repeats with the steps hides between them
GOLDEN = (math.sqrt(5) - 1) / 2  # whose multiples are spread evenly over [0, 1)
MOST_SAMPLED = 64  # that are looked at, evenly spread


def unseen(function: Callable[[float], Any], share: float, steps: int, duration: float, moves: bool) -> float:
    """Difference of a function of time [s] from lines through the values that steps see, root mean
    square, over their size.

    Args:
        share: Of each step at which it is asked.
        moves: Whether it is a position, whose size is how far it goes from its first value.
    """
    h, stride = duration / steps, max(1, -(-steps // MOST_SAMPLED))
    lines: list[Tensor] = []
    values: list[Tensor] = []
    for k in range(0, steps - 1, stride):
        before, after = (_value(function, (k + i + share) * h) for i in (0, 1))
        for _ in range(LOOKS):
            part = GOLDEN * (len(values) + 1) % 1.0
            values.append(_value(function, (k + share + part) * h))
            lines.append(before + part * (after - before))
    if not values:
        return 0.0
    line, value = torch.stack(lines), torch.stack(values)
    size = (value - (_value(function, 0.0) if moves else 0.0)).square().mean().sqrt()
    return float((value - line).square().mean().sqrt() / size) if float(size) > 0 else 0.0


def _value(function: Callable[[float], Any], time: float) -> Tensor:
    given = function(time)
    value = torch.as_tensor(0.0 if given is None else given).detach().double()
    return torch.where(torch.isfinite(value), value, 0.0)  # prescribed positions of what is not pinned may be NaN


# --- trial runs -------------------------------------------------------------------------------------------------------

SHORTEST = 1e-3  # of the duration: the step that is taken to see whether arguments are good
FRAMES = 4  # at which two runs are compared, equally spaced over the duration
STILL = 1e-4  # of the size of the scene: a motion below it counts as one of this size
NO_PART = 1e-8  # of quantity over modulus: a gradient below it counts as one of this size
LOADS = ("force", "gravity")
MOVING = ("prescribed", "colliders")
NO_FRAMES = torch.empty(0)
PLAIN = VBD(1.0, 1)
Quantity = Callable[[Tensor, Tensor], Tensor]


@dataclass
class TrialRun:
    """A run: its frames, and what it took."""

    settings: VBD
    steps: int
    x: Tensor = NO_FRAMES  # [FRAMES + 1, ..., V, 3], the first is the start
    v: Tensor = NO_FRAMES
    seconds: float = math.inf
    quantity: Tensor | None = None
    gradient: tuple[Tensor, ...] = ()
    failure: str = ""  # why there are no frames


@dataclass
class TrialRuns:
    """Runs of one scene.

    What changes in time is a function of the time [s]: it is asked for loads at the middle of each step, for prescribed
    vertices and colliders at its end.
    """

    model: Model
    x: Tensor
    v: Tensor
    duration: float
    given: dict[str, Any]
    quantity: Quantity | None = None
    wrt: Sequence[str] | None = None  # of the material: gradients with respect to them and a velocity of the whole
    spent: float = 0.0  # [s]
    runs: int = 0
    progress: bool = False  # whether each run is logged
    _ready: set[str] = field(default_factory=set)
    _solves: list[Any] = field(default_factory=list)  # of the last run

    def __post_init__(self) -> None:
        self.duration = check_positive("duration", self.duration, "s")
        limits, h = torch.finfo(self.model.dtype), SHORTEST * self.duration
        if not limits.tiny <= h * h <= limits.max:
            fail("duration", f"a number of seconds of which {SHORTEST:g} is a time step", self.duration)
        for name, value in self.given.items():
            if name in MOVING:
                refuse_average(name, value)
            if isinstance(value, PerStep):
                fail(name, "a value or a function of the time [s], since time steps vary", "per_step")
            if of_time(value) and not _takes(value, 1):
                got = "one of other arguments, such as a rollout takes"
                raise TypeError(f"{name}: expected a function of the time [s] alone, since time steps vary, got {got}: "
                                "lambda t: ... can replace one of the step, not of the state")  # fmt: skip

    # --- running ------------------------------------------------------------------------------------------------------

    def execute(self, *arguments: Any, **options: Any) -> Trajectory:
        """A rollout as it stands, also inside dv.refine."""
        with refined(None):
            return rollout(*arguments, **options)

    def check(self) -> None:
        """One short step: raises what rollout raises of the arguments."""
        h = SHORTEST * self.duration
        given = self.at_steps(dict(self.given), h, 1, 0.0)
        with silence():
            end = self.execute(self.model, self.x, self.v, VBD(h, 1), steps=1, save="last", **given)
        if self.quantity is None:
            return
        leaves = [t[-1].detach().requires_grad_(self.wrt is not None) for t in (end.x, end.v)]
        with torch.set_grad_enabled(self.wrt is not None):
            value = self.quantity(*leaves)
        if not (isinstance(value, Tensor) and value.numel() == 1):
            got = f"shape {list(value.shape)}" if isinstance(value, Tensor) else type(value).__name__
            fail("quantity", "a function that returns a scalar tensor", got)
        if not value.is_floating_point():
            fail("quantity", "a function that returns a floating scalar", f"{value.dtype}")
        if not bool(torch.isfinite(value)):
            fail("quantity", "a finite value after the first step", float(value))
        if self.wrt is None:
            return
        found = torch.autograd.grad(value, leaves, allow_unused=True) if value.requires_grad else (None, None)
        if all(gradient is None for gradient in found):
            fail("quantity", "a function that torch can differentiate, with gradient=True", "one without a graph")

    def run(self, settings: VBD, steps: int, quarter: int | None = None, start: TrialRun | None = None) -> TrialRun:
        """``steps`` steps over the whole duration, or a quarter of them from frame ``quarter`` of ``start``."""
        settings = on(settings, steps, self.duration)
        part, first = (steps, 0) if quarter is None else (steps // FRAMES, quarter)
        x, v = (self.x, self.v) if start is None or quarter is None else (start.x[quarter], start.v[quarter])
        began = first * self.duration / FRAMES
        differentiate = self.wrt is not None and quarter is None
        with silence():
            try:
                self._warm(settings, x, v, began)
                clock = time.perf_counter()
                traj, value, gradient = self._rollout(settings, x, v, part, began, FRAMES if quarter is None else 1,
                                                      differentiate)  # fmt: skip
                self._wait()
            except (RuntimeError, ValueError, torch.OutOfMemoryError) as error:
                return TrialRun(settings, steps, failure=f"{settings}: {error}")
        seconds = time.perf_counter() - clock
        self.spent += seconds
        self.runs += 1
        if self.progress:
            log_progress("trial run %d: %s, %.2g s", self.runs, settings, seconds)
        x, v, failure = traj.x.detach(), traj.v.detach(), ""
        if not bool(torch.isfinite(x[-1]).all()):
            failure = "positions that are not finite"
        elif value is not None and not bool(torch.isfinite(value)):
            failure = f"quantity is {float(value)} after {part} steps"
        if failure:
            return TrialRun(settings, steps, seconds=seconds, failure=f"{settings}: {failure}")
        return TrialRun(settings, steps, x, v, seconds * steps / part, value, gradient)

    def _rollout(self, settings: VBD, x: Tensor, v: Tensor, steps: int, began: float, frames: int, differentiate: bool
                 ) -> tuple[Trajectory, Tensor | None, tuple[Tensor, ...]]:  # fmt: skip
        model, given, leaves = self.model, dict(self.given), []
        if differentiate:
            # one velocity for all: those of single vertices excite what no time step resolves
            leaves = [torch.zeros(3, dtype=model.dtype, device=model.device, requires_grad=True)]
            for name in self.wrt or ():
                leaf = torch.as_tensor(given[name], dtype=model.dtype, device=model.device).detach().clone()
                leaves.append(leaf.requires_grad_())
                given[name] = leaf
            with torch.enable_grad():
                v = torch.where(model.pinned[:, None], v, v + leaves[0])
        given = self.at_steps(given, settings.time_step, steps, began)
        self._solves = []
        with torch.set_grad_enabled(differentiate), record_to(self._solves, "solve"):
            out = self.execute(model, x, v, settings, steps=steps, save=max(1, steps // frames), checks=NONE, **given)
            value = None if self.quantity is None else self.quantity(out.x[-1], out.v[-1])
            gradient = torch.autograd.grad(value, leaves) if leaves else ()  # type: ignore[arg-type]
        return out, None if value is None else value.detach(), gradient

    def _warm(self, settings: VBD, x: Tensor, v: Tensor, began: float) -> None:
        """The first step of a solver arranges what later ones find: it is not timed."""
        key = f"{settings.key} {settings.integrator}"
        if key not in self._ready:
            self._ready.add(key)
            with torch.no_grad():
                self._rollout(settings, x, v, 1, began, 1, False)
            self._wait()

    def _wait(self) -> None:
        if self.x.is_cuda:
            torch.cuda.synchronize(self.x.device)

    def at_steps(self, given: dict[str, Any], h: float, steps: int, began: float) -> dict[str, Any]:
        """Functions of time as the rollout takes them."""

        def timed(function: Callable[[float], Any], share: float) -> Callable[[int, Tensor, Tensor], Any]:
            if isinstance(function, StepAverage):
                return function.over(h, began)
            return lambda step, x, v: function(began + (step + share) * h)

        out = {name: value for name, value in given.items() if value is not None}
        for name, value in given.items():
            if of_time(value) and name == "colliders":
                out[name] = PerStep(torch.stack([value(began + (k + 1) * h) for k in range(steps)]))
                out["colliders_before"] = value(began)
            elif of_time(value):
                out[name] = timed(value, share_of(name))
        return out

    def swinging(self, steps: int) -> str:
        """The name of what swings within steps, so that they do not see it; "" if nothing does."""
        for name in filter(lambda name: of_time(self.given[name]), self.given):
            clock = time.perf_counter()
            apart = unseen(self.given[name], share_of(name), steps, self.duration, name in MOVING)
            self.spent += time.perf_counter() - clock
            if apart > SWINGS:
                return name
        return ""

    def left(self) -> float:
        """The force that the last run left over, over its forces [-]."""
        return unbalanced(self._solves)

    # --- comparing ----------------------------------------------------------------------------------------------------

    def motion(self, frames: Tensor) -> Tensor:
        """Root mean square way from the start of each scene [...] [m], over vertices and frames."""
        way, flat = (frames[1:] - self.x).square().sum(-1).mean((0, -1)).sqrt(), self.x.reshape(-1, 3)
        return way.clamp(min=STILL * float((flat.amax(0) - flat.amin(0)).norm()))

    def apart(self, a: Tensor, b: Tensor) -> float:
        """Root mean square distance of two runs over the motion of the second, in the worst scene."""
        distance = (a[1:] - b[1:]).square().sum(-1).mean((0, -1)).sqrt()
        worst = float((distance / self.motion(b)).max())
        return worst if math.isfinite(worst) else math.inf

    def gradients_apart(self, a: TrialRun, b: TrialRun) -> list[float]:
        """Relative distances of the gradients of two runs. With respect to moduli that have no part in the motion, as
        of a body in free fall, they are rounding: what is below a tiny part of quantity over modulus counts as that."""
        out = []
        for name, u, w in zip((None, *(self.wrt or ())), a.gradient, b.gradient, strict=False):
            least = 0.0
            if name is not None and b.quantity is not None:
                modulus = float(torch.as_tensor(self.given[name]).double().norm())
                least = NO_PART * abs(float(b.quantity)) / modulus if modulus > 0 else 0.0
            out.append(relative(u, w, least))
        return out

    # --- energy -------------------------------------------------------------------------------------------------------

    @cached_property
    def conserves(self) -> bool:
        """Whether the exact motion keeps the energy() below, so that what a run loses is what it damps."""
        names = {*MATERIAL, "prescribed", "colliders"} - {*MODULI}
        other = any(self.given.get(name) is not None for name in names)
        dampings = (torch.as_tensor(getattr(energy, "damping", 0.0)) for energy in self.model.energies)
        damped = self.model.friction is not None or any(bool((damping > 0).any()) for damping in dampings)
        stored = any(energy is not self.model.floor for energy in self.model.vertex_energies)  # of springs, too
        return not (changes(self.given) or other or damped or stored)

    def prepared_at(self, time: float) -> Prepared:
        """The material of the scene at a time [s]."""
        given = self.at_steps({name: self.given.get(name) for name in MODULI}, 0.0, 0, time)
        values = {name: value(0, self.x, self.v) if of_time(value) else value for name, value in given.items()}
        return prepare(
            system_of(self.model, PLAIN), tuple(self.x.shape[:-2]), material_of(**values), time_step=1.0, sweeps=1
        )

    def energy(self, x: Tensor, v: Tensor) -> Tensor:
        """Kinetic, elastic and of loads [...] [J] of each scene; contact, which is short, counts as none."""
        gravity, force = self.given.get("gravity"), self.given.get("force")
        gravity = torch.as_tensor(GRAVITY if gravity is None else gravity, device=x.device)
        load = self.model.mass.double()[:, None] * gravity.double()
        if force is not None:
            load = load + torch.as_tensor(force).to(load)
        stored = mechanical_energy(system_of(self.model, PLAIN), self.prepared_at(0.0), x, v).reshape(x.shape[:-2])
        return stored - (load * x.double()).sum((-1, -2))

    def lost(self, run: TrialRun, seconds: float) -> float:
        """Distance that the energy E which a run has lost would carry the scene in some seconds, sqrt(2 E / m) t, over
        its motion. Zero where energy says nothing."""
        if not self.conserves:
            return 0.0
        lost = (self.energy(run.x[0], run.v[0]) - self.energy(run.x[-1], run.v[-1])).clamp(min=0)
        mass = float(self.model.mass[~self.model.pinned].sum())
        way = (2 * lost / max(mass, 1e-300)).sqrt() * seconds
        return float((way / self.motion(run.x)).max())


def trials_of(model: Model, x: Tensor, v: Tensor, duration: float,
              quantity: Quantity | None, gradient: bool, given: dict[str, Any], progress: bool = False
              ) -> TrialRuns:  # fmt: skip
    """Trial runs of a scene, with the gradients that are asked for. A first short step raises what rollout raises of
    the arguments."""
    refuse_transforms("dv.advise and dv.error_budget, which look at values")
    given_of(model, given)
    check_bool("gradient", gradient)
    check_bool("progress", progress)
    if gradient and torch.is_inference_mode_enabled():
        fail("gradient", "False inside torch.inference_mode(), which records nothing", "True")
    if quantity is not None and not callable(quantity):
        raise TypeError(f"quantity: expected a function of x and v, got {type(quantity).__name__}")
    if quantity is not None and not _takes(quantity, 2):
        raise TypeError("quantity: expected a function of the last state, lambda x, v: ..., got one of other arguments")
    if x.numel() == 0:
        fail("x", "a scene with a vertex, whose motion can be judged", f"shape {list(x.shape)}")
    x, v = x.detach(), v.detach()
    if gradient and quantity is None:  # the mean squared way
        quantity = lambda end, _: (end - x).square().sum(-1).mean()  # noqa: E731
    material = [name for name in MODULI if given.get(name) is not None]
    wrt = [name for name in material if not of_time(given[name])]
    given = {name: value.detach() if isinstance(value, Tensor) else value for name, value in given.items()}
    trials = TrialRuns(model, x, v, duration, given, quantity, wrt if gradient else None, progress=progress)
    trials.check()
    return trials


def of_time(value: Any) -> bool:
    return callable(value) and not isinstance(value, Tensor)


def share_of(name: str) -> float:
    """Of a step at which an input that is a function of time is asked for."""
    return 0.5 if name in LOADS else 1.0


def _takes(function: Callable[..., Any], count: int) -> bool:
    """Whether a function can be called with so many arguments; True where Python does not know."""
    try:
        inspect.signature(function).bind(*range(count))
    except TypeError:
        return False
    except ValueError:
        pass
    return True


def changes(given: dict[str, Any]) -> bool:
    """Whether anything that is given changes in time."""
    return any(map(of_time, given.values()))


def converted(value: Any, **to: Any) -> Any:
    """Tensors, those in a dict and what functions return, on another device or of another floating dtype."""

    def change(found: Any) -> Any:
        if isinstance(found, dict):
            return {name: converted(part, **to) for name, part in found.items()}
        floats = isinstance(found, Tensor) and found.is_floating_point()
        kinds = {name: kind for name, kind in to.items() if floats or name != "dtype"}
        return found.to(**kinds) if isinstance(found, Tensor) else found

    return mapped(value, change)


def relative(a: Tensor, b: Tensor, least: float = 0.0) -> float:
    """|a - b| / |b|, of which |b| counts as ``least`` at least."""
    size = max(float(b.norm()), least)
    apart = float((a - b).norm())
    return 0.0 if apart == 0 else apart / size if size > 0 else math.inf


# --- the search for solvers that stay within an error -----------------------------------------------------------------

LONGEST = 0.1  # [s] of the first time step of the refinement
MOST_STEPS = 2**17
FEWEST_THAT_RUN = 256  # steps: fewer than these may fail
ORDERS = (0.5, 2.0)  # that are believed
CLEAN = 0.6  # least order of two levels in a row from which the motion counts as resolved
AIM = 0.6  # of the wanted error that a candidate is given
COSTS = 8.0  # times the advised rollout that all runs may take,
FREE = 1.0  # [s] or so long,
MORE = 2.0  # or so many times what the refinement has taken: where that is long, much faster settings are worth a look
LIKELY = 4  # of the candidates, at which that much is spent
MUCH = 0.5  # of the time of the fastest proven, that what is run to the end beyond the usual may take
NEAR = 10.0  # times the wanted error: runs of the refinement that are shown
ROUNDING = 1e-3  # of the wanted error: runs of the refinement below that, as of a free fall, compare with nothing
SAFE = 0.8  # of the wanted error that a run with impacts may show: the runs it is held against show less than there is
TOO_FINE = 0.1  # of the wanted error: candidates below it try fewer steps
WHOLE = 0.95  # of what the longest steps lose at an impact: runs that lose as much do not resolve it
ERROR, TIME_BUDGET = 0.01, 120.0  # what is asked for where nothing else is [-], [s]
STUCK = 6  # levels of the refinement that do not come closer: there is no limit to find


def start_of(trials: TrialRuns) -> VBD:
    """Solver of the refinement: well converged and never far from the fastest."""
    if not takes_corrections(trials.model, PLAIN):
        return VBD(1.0, 40, integrator=SDIRK2())
    relaxation = 1.5 if _may_over_relax(trials) else 1.0
    return VBD(1.0, 8, integrator=SDIRK2(), relaxation=relaxation, subspace="coarse")


def candidates_of(trials: TrialRuns) -> list[VBD]:
    """Solvers that might be faster than the refinement's, the likeliest first."""
    model, sdirk, bdf, euler = trials.model, SDIRK2(), BDF2(), ImplicitEuler()
    corrects = takes_corrections(model, PLAIN)
    over, over_coarse = (1.6, 1.5) if corrects and _may_over_relax(trials) else (1.0, 1.0)

    def plain(scheme: Integrator, *sweeps: int) -> list[VBD]:
        return [VBD(1.0, k, integrator=scheme, relaxation=over) for k in sweeps]

    def coarse(scheme: Integrator, *sweeps: int) -> list[VBD]:
        return [VBD(1.0, k, integrator=scheme, relaxation=over_coarse, subspace="coarse") for k in sweeps]

    out = []
    if corrects:
        out += [*coarse(sdirk, 2), *coarse(euler, 2), *coarse(bdf, 2), *coarse(sdirk, 5)]
    out += [*plain(sdirk, 10), *plain(euler, 5), *plain(bdf, 5), *plain(sdirk, 5, 20), *plain(bdf, 10, 20),
            *plain(euler, 10, 20)]  # fmt: skip
    return out


def _may_over_relax(trials: TrialRuns) -> bool:
    """Whether no pairs or friction act, and no tet comes near incompressible, at any of some times where moduli
    change."""
    if trials.model.touches:
        return False
    if trials.model.mesh.num_tets == 0:
        return True
    changing = any(of_time(trials.given.get(name)) for name in MODULI)
    times = [trials.duration * k / FRAMES for k in range(FRAMES + 1)] if changing else [0.0]
    return not any(is_nearly_incompressible(p.mu, p.lam) for p in map(trials.prepared_at, times))


class _Search:
    def __init__(self, trials: TrialRuns, error: float, time_budget: float) -> None:
        self.trials, self.error, self.time_budget = trials, error, time_budget
        self.order = 1.0
        # impacts come early or late by up to a step: nothing can be extrapolated until steps resolve them
        self.smooth = not (trials.model.touches or trials.model.floor is not None)
        self.most = error if self.smooth else SAFE * error  # that a run may show
        self.clean = False  # whether the last two runs can be extrapolated
        self.levels: list[TrialRun] = []
        self.estimates: list[tuple[float, TrialRun]] = []  # of levels from the third on: what is asked for, and the run
        self.proven: list[Candidate] = []
        self.predicted: list[Candidate] = []
        others = ", quantity and gradient" if trials.wrt is not None else " and quantity" if trials.quantity else ""
        self.of = f"(the largest of motion{others})" if others else "of the motion"

    def run(self) -> VBD:
        reached, why = self._climb()
        if reached:
            self._rank()
            self._prove()
            self.proven.sort(key=lambda c: c.seconds)
            best = next(c for c in self.proven if c.error <= self.most)
            before, last = (run.settings for run in self.levels[-2:])
            limit = f"the limit of {before} and {last}" if self.clean else f"{last}"
            why = (f"the fastest of the runs below that stay within the error; their errors are distances to {limit}, "
                   f"and {self.uncertain:.1g} by which that may be off")  # fmt: skip
            if self.trials.spent > 0.9 * self.time_budget:
                why += f"; {self.time_budget:g} s of trial runs (time_budget) ended the search for faster ones"
        else:
            least = (math.inf, self.levels[-1] if self.levels else None)
            error, now = min(self.estimates, key=lambda e: e[0], default=least)
            settings = on(start_of(self.trials), FRAMES, self.trials.duration) if now is None else now.settings
            best = Candidate(settings, error, math.inf if now is None else now.seconds, now is not None)
            self.proven = [Candidate(r.settings, e, r.seconds, True) for e, r in self.estimates if r is not now]
        once = {str(c.solver): c for c in sorted(self.proven, key=lambda c: -c.seconds)}  # of two runs the faster
        once.pop(str(best.solver), None)
        tried = {str(best.solver), *once}
        rest = [*once.values(), *(c for c in self.predicted if str(c.solver) not in tried)]
        others = tuple(sorted(rest, key=lambda c: c.seconds))
        told = Prediction(self.error, best.error, best.seconds, self.trials.duration, reached, why, others,
                          self.trials.spent, self.trials.runs, self.of)  # fmt: skip
        return replace(best.solver, prediction=told)

    # --- the refinement -----------------------------------------------------------------------------------------------

    def _climb(self) -> tuple[bool, str]:
        """Runs with more steps each time until the last one has half of the wanted error, or why it cannot be."""
        p, settings = self.trials, start_of(self.trials)
        steps = FRAMES * max(1, math.ceil(p.duration / (FRAMES * LONGEST)))
        apart: list[float] = []
        left = math.inf  # of forces, by the run that was last taken for the reference
        unseen = "what changes in time" if changes(p.given) else ""
        while True:
            if steps > MOST_STEPS:
                swings = f"{unseen} swings within each of {MOST_STEPS} steps, which do not see it"
                return False, swings if unseen and self.levels else f"{MOST_STEPS} steps are not enough"
            if p.spent > self.time_budget:
                return False, f"{self.time_budget:g} s of trial runs were not enough: a larger time_budget may do"
            now = p.run(settings, steps)
            if now.failure and not self.levels and steps < FEWEST_THAT_RUN:  # long steps may fail where short do not
                steps *= 2
                continue
            if now.failure:
                return False, f"a run failed: {now.failure}"
            if unseen:
                unseen, apart = p.swinging(steps), []
                self.levels = [now] if unseen else []  # runs that do not see it tell nothing of others
                if unseen:
                    steps *= 2
                    continue
            self.levels.append(now)
            if len(self.levels) > 1:
                apart.append(self._distance(self.levels[-2], now))
            if len(apart) > 1:
                error = max(self._remaining(apart), self._unresolved())
                self.estimates.append((error, now))
                if error <= 0.5 * self.error:
                    left, before = p.left(), left
                    if settings.sweeps > MOST_SWEEPS and not is_balanced(left):
                        return False, unreached(now.settings, left)
                    more = self._with_more_sweeps(settings, left, before)
                    if more is None:
                        return True, ""
                    if more.failure:
                        return False, f"a run failed: {more.failure}"
                    settings = more.settings
                    self.estimates.pop()  # more sweeps moved it: it was none
                    self.levels[-2:] = [more]
                    apart[-2:] = [self._distance(self.levels[-2], more)]
                    continue
                if self._is_rounding():
                    return False, (f"shorter steps than those of {min(self.estimates, key=lambda e: e[0])[1].settings} "
                                   f"make it worse, as rounding does in {p.model.dtype}")  # fmt: skip
                if len(apart) > STUCK and min(apart[-2:]) > 0.7 * max(apart[-STUCK:]):  # no closer over several levels
                    cause = "it holds vibrations down to the shortest that the mesh can carry"
                    if not self.smooth:
                        cause = "what touches when, and what sticks, depends on ever smaller differences"
                    return False, (f"runs of h and h/2 stay {apart[-1]:.2g} {self.of} apart however small h is: "
                                   f"{cause}")  # fmt: skip
            steps *= 2

    def _remaining(self, apart: list[float]) -> float:
        """The error of the last run, by the order that the last runs show. It is believed where two levels in a row
        agree on one: a single pair of runs may agree by luck."""
        low, high = ORDERS
        last = [max(a, 1e-300) for a in apart[-3:]]
        shown = [math.log2(a / b) for a, b in zip(last, last[1:], strict=False)]
        self.order = min(max(min(shown), low), high)
        self.clean = len(shown) > 1 and min(shown) >= CLEAN
        if self.clean:
            return apart[-1] / (2**self.order - 1)
        return max(apart[-2:]) / (2 ** min(self.order, 1.0) - 1)

    def _unresolved(self) -> float:
        """Motion that is lost with energy, and that runs which agree may therefore both lack. Vibrations swing within a
        step: they are resolved once halving it halves the energy lost. A rebound lasts: none is resolved while as much
        is lost as in the longest steps."""
        p, last = self.trials, self.levels[-1]
        if self.smooth:
            # the root of the energy times the step: sqrt(2) x 2 where the energy halves
            now, before = (p.lost(run, p.duration / run.steps) for run in (last, self.levels[-2]))
            return 0.0 if now < before / (2 * math.sqrt(2)) else now
        now, first = (p.lost(run, 0.5 * p.duration) for run in (last, self.levels[0]))
        return 0.0 if now < WHOLE * first else now

    def _with_more_sweeps(self, settings: VBD, left: float, before: float) -> TrialRun | None:
        """The run before the last once more with twice the sweeps, if those move it by more than a quarter of the
        error: with the sweeps of the refinement it might come close to a limit of its own. Or if the last run left
        forces over; then with plain sweeps where more of them with corrections have left as much."""
        last = self.levels[-2]
        more = self.trials.run(with_more_sweeps(settings, left, before), last.steps)
        if is_balanced(left) and (more.failure or self._distance(last, more) <= 0.25 * self.error):
            return None
        return more

    def _is_rounding(self) -> bool:
        """Whether the last runs are further from one another than longer steps were."""
        errors = [error for error, _ in self.estimates]
        single = self.trials.model.dtype == torch.float32
        return single and self.smooth and len(errors) > 2 and min(errors[-2:]) > 2 * min(errors[:-2])

    def _distance(self, a: TrialRun, b: TrialRun) -> float:
        """Of motion, quantity and gradient, the largest."""
        out = [self.trials.apart(a.x, b.x), *self.trials.gradients_apart(a, b)]
        if a.quantity is not None and b.quantity is not None:
            out.append(relative(a.quantity, b.quantity))
        return max(out)

    @property
    def reference(self) -> TrialRun:
        """The last run of the refinement; where the motion is smooth or resolved, extrapolated from the last two."""
        a, b = self.levels[-2:]
        share = 1 / (2**self.order - 1) if self.clean else 0.0

        def beyond(u: Any, w: Any) -> Any:
            return None if u is None else w + share * (w - u)

        gradient = tuple(beyond(u, w) for u, w in zip(a.gradient, b.gradient, strict=True))
        return replace(b, x=beyond(a.x, b.x), quantity=beyond(a.quantity, b.quantity), gradient=gradient)

    # --- candidates ---------------------------------------------------------------------------------------------------

    def _rank(self) -> None:
        p, last = self.trials, self.levels[-1]
        reference = self.reference
        uncertain = (0.5 if self.clean else 1.0) * self.estimates[-1][0]
        self.aim = AIM * (self.error - uncertain)
        for run in self.levels:
            error = self._distance(run, reference) + uncertain
            if error <= NEAR * self.error or run is last:
                self.proven.append(Candidate(run.settings, error, run.seconds, True))
        self.uncertain, self.truth = uncertain, reference
        self.climbed = p.spent
        # with as many steps as the refinement takes for an error nearest to the wanted one, before its last run
        levels = [(max(self._distance(run, reference), 1e-300), run) for run in self.levels[:-1]]
        level, near = min(levels, key=lambda entry: abs(math.log(entry[0] / self.error)))
        # a quarter says what a candidate's error is over that of the refinement, which then must be no rounding
        compares = self.smooth and level > ROUNDING * self.error
        predict = self._by_quarter(level, near) if compares else self._by_whole
        if self.smooth and not compares:
            self.order = max(ORDERS)  # that of rounding means nothing
        self.plans: list[tuple[float, int, VBD]] = []
        for number, settings in enumerate(candidates_of(p)):
            allowed = self._allowed(self._least(), more=number < LIKELY)
            if p.spent - self.climbed > 0.6 * (allowed - self.climbed):
                break
            error, per_step = predict(settings, near.steps)
            if math.isfinite(error):
                self._plan(settings, near.steps, error, per_step)

    def _by_quarter(self, level: float, near: TrialRun) -> Callable[[VBD, int], tuple[float, float]]:
        """The error of settings, and the time of a step, by the quarter of the duration in which steps matter most."""
        p, last, before = self.trials, self.levels[-1], self.levels[-2]
        apart = (before.x - last.x).square().sum(-1).flatten(1).mean(1).sqrt()
        quarter = int(apart.diff().argmax())

        def measured(settings: VBD, steps: int) -> tuple[float, float]:
            run = p.run(settings, steps, quarter, last)
            off = math.inf if run.failure else float((run.x[-1] - last.x[quarter + 1]).square().mean().sqrt())
            return off, run.seconds / steps

        scale, _ = measured(near.settings, near.steps)

        def predict(settings: VBD, steps: int) -> tuple[float, float]:
            off, per_step = measured(settings, steps)
            return level * off / max(scale, 1e-300), per_step

        return predict

    def _by_whole(self, settings: VBD, steps: int) -> tuple[float, float]:
        """The same by the whole duration: after an impact that no step resolves a quarter says nothing of the rest."""
        run = self.trials.run(settings, steps)
        if run.failure:
            return math.inf, 0.0
        error = self._distance(run, self.truth)
        self.proven.append(Candidate(run.settings, error + self.uncertain, run.seconds, True))
        return error, run.seconds / steps

    def _plan(self, settings: VBD, steps: int, error: float, per_step: float) -> None:
        order = self._order_of(settings)
        more = (max(error, 1e-300) / self.aim) ** (1 / order)
        wanted = self._rounded(steps * more)
        if wanted <= MOST_STEPS:
            self.plans.append((wanted * per_step, wanted, settings))
            planned = on(settings, wanted, self.trials.duration)
            self.predicted.append(Candidate(planned, self.aim + self.uncertain, wanted * per_step, False))

    def _order_of(self, settings: VBD) -> float:
        return min(self.order, 1.0) if isinstance(settings.integrator, ImplicitEuler) else self.order

    @staticmethod
    def _rounded(steps: float) -> int:
        return FRAMES * max(1, math.ceil(min(steps, 2.0 * MOST_STEPS) / FRAMES))

    def _least(self) -> float:
        """Time of the fastest proven candidate that stays within the error."""
        return min((c.seconds for c in self.proven if c.error <= self.most), default=math.inf)

    def _allowed(self, seconds: float, more: bool) -> float:
        """Time that all runs may take [s] for a solver that takes ``seconds``."""
        return min(max(COSTS * seconds, FREE, MORE * self.climbed if more else 0.0), self.time_budget)

    def _prove(self) -> None:
        p = self.trials
        for seconds, steps, settings in sorted(self.plans, key=lambda plan: plan[0]):
            for _ in range(3):
                least = self._least()
                allowed = self._allowed(min(least, seconds), more=seconds < MUCH * least)
                if seconds > 0.9 * least or p.spent + seconds > allowed:
                    break
                run = p.run(settings, steps)
                if run.failure:
                    break
                error = self._distance(run, self.truth) + self.uncertain
                self.proven.append(Candidate(run.settings, error, run.seconds, True))
                if error <= self.most and error - self.uncertain >= TOO_FINE * self.error:
                    break
                order = self._order_of(settings)
                more = ((error - self.uncertain) / self.aim) ** (1 / order)
                steps, before = self._rounded(steps * min(max(more, 0.25), 4.0)), steps
                if steps == before:
                    break
                seconds = run.seconds * steps / before


# --- a solver that stays within an error ------------------------------------------------------------------------------


@torch.no_grad()
def advise(
    model: Model,
    x: Tensor,
    v: Tensor,
    *,
    duration: float,
    error: float = ERROR,
    quantity: Quantity | None = None,
    gradient: bool = False,
    device: torch.device | str | None = None,
    time_budget: float = TIME_BUDGET,
    progress: bool = False,
    **inputs: Any,
) -> VBD:
    """The solver that takes the least time with an error of at most ``error``, found by trial runs of the scene itself.

    Time step, integrator, sweeps, relaxation and subspace are chosen. Pass the result on:
    ``dv.rollout(model, x, v, solver, duration=..., ...)``. Print it: it says what it promises, what the runners-up take
    and what the advice has cost: in the benchmark mostly about ten of the rollouts that it advises, and more than a
    hundred where a quick trial run turned out to do.

    The error is one of time: of the motion of this mesh with these energies, contact included, against the limit of
    small steps and many sweeps. That of the mesh is not in it (:func:`diffvbd.error_budget` has it). Chaotic motion,
    as of piles that topple, has no such limit: ``prediction.reached`` is False then and ``prediction.why`` says why;
    the solver is the best that was run.

    Args:
        model, x, v: As in :func:`diffvbd.rollout`.
        duration: Of the motion [s].
        error: Wanted relative error, in (0, 1): of positions, root mean square over vertices and four times, over that
            of the way from the start.
        quantity: A function of the last x and v, [..., V, 3], that returns a scalar, which shall stay within the error.
        gradient: Whether the gradient of ``quantity`` shall stay within it, and its time be counted: with respect to
            each modulus and to a velocity that is added to all vertices. Without a quantity it is the mean squared way.
        device: Where the trials run; None: the Model's.
        time_budget: How long trials may run [s]; the search ends with the one that exceeds it.
        progress: Print each trial run, by the logger "diffvbd".
        inputs: As in rollout, constant or a function of the time [s]: loads at the middle of each step, all else at its
            end, and what is marked by :func:`diffvbd.step_average` over all of it. What swings within steps has these
            made shorter; a single push that is shorter than they are may go unseen unless it is averaged.

    Returns:
        A solver with a ``prediction`` (:class:`diffvbd.results.Prediction`).

    Raises:
        ValueError, TypeError: As rollout; an error outside (0, 1), per_step values, a quantity that is no finite scalar
            or, beside ``gradient``, has no derivative.
    """
    check_state(model, x, v)
    error = check_positive("error", error)
    if error >= 1:
        fail("error", "a share of the motion in (0, 1)", repr(error))
    time_budget = check_positive("time_budget", time_budget, "s")
    if device is not None:
        model = model.to(device)
        x, v, inputs = (converted(value, device=model.device) for value in (x, v, inputs))
    return _Search(trials_of(model, x, v, duration, quantity, gradient, inputs, progress), error, time_budget).run()


# --- where the error of a rollout comes from --------------------------------------------------------------------------

FINER = 4  # times the steps of the finest run
ENOUGH = 0.1  # of what more sweeps have changed so far: below it they have converged
DETECTIONS = 8  # in each step of the run that is truncated least


@dataclass(frozen=True)
class Share:
    """Contribution of one cause to an error.

    Attributes:
        cause: "sweeps", "time step", "precision", "contact", "mesh" or "all but mesh".
        motion: Root mean square distance of positions, over vertices and four times, over the way from the start [-].
        quantity: Relative difference of the quantity [-]; None without one.
        gradient: That of its gradient [-]; None where none was asked for.
        seconds: What the trial runs took that tell it [s].
        note: With what was compared.
    """

    cause: str
    motion: float
    quantity: float | None
    gradient: float | None
    seconds: float
    note: str


@dataclass(frozen=True)
class ErrorBudget:
    """The error of a rollout by cause, see :func:`diffvbd.error_budget`. As text: a table.

    Attributes:
        solver: Whose error it is.
        shares: One for each cause, the largest first, then "all but mesh" together, which need not be their sum.
        duration: Of the motion that was looked at [s].
        truncated: The largest fraction of vertices that pairs truncated in a step [-]; None without pairs.
        friction: The share of the friction that the last step left unbalanced [-]; None without friction.
        reached: Whether all runs that others are compared with have steps that balance their forces, to 1 %. Where one
            has not, its note says so, and what is compared with it says little.
    """

    solver: VBD
    shares: tuple[Share, ...]
    duration: float
    truncated: float | None
    friction: float | None
    reached: bool = True

    @property
    def largest(self) -> Share:
        return self.shares[0]

    @property
    def total(self) -> float:
        """Of the motion, all causes but the mesh together [-]."""
        return next(s.motion for s in self.shares if s.cause == "all but mesh")

    def __str__(self) -> str:
        def shown(value: float | None) -> str:
            return "-" if value is None else f"{value:.1e}"

        header = ("cause", "motion", "quantity", "gradient", "s", "compared with")
        rows = [(s.cause, shown(s.motion), shown(s.quantity), shown(s.gradient), f"{s.seconds:.2g}", s.note)
                for s in self.shares]  # fmt: skip
        lines = [f"{self.solver}, {self.duration:.3g} s of motion", *aligned([header, *rows])]
        if self.truncated is not None:
            lines.append(f"pairs truncated at most {percent(self.truncated)} of the vertices in a step")
        if self.friction is not None:
            lines.append(f"{percent(self.friction)} of the friction is not balanced in the last step")
        return "\n".join(lines)


@torch.no_grad()
def error_budget(
    model: Model,
    x: Tensor,
    v: Tensor,
    solver: VBD,
    *,
    duration: float,
    fraction: float = 1.0,
    quantity: Quantity | None = None,
    gradient: bool = False,
    mesh: bool = False,
    progress: bool = False,
    **inputs: Any,
) -> ErrorBudget:
    """The error of a rollout by cause, from trial runs that have less of one error at a time.

    sweeps: the same steps with sweeps until more change nothing and their forces balance. time step: those against
    SDIRK2 with four times the steps. precision: the same run in double precision. contact: the converged steps with
    more detections in each, where pairs have truncated motion.
    mesh: the converged run on a mesh of eight tets for each. Look at the largest: nothing else is worth improving.

    Args:
        model, x, v, solver, duration: Of the rollout that is judged; trial runs take a multiple of four steps.
        fraction: Of the duration, from its start, that trials run, in (0, 1]. Errors mostly grow with time: a part says
            which is largest sooner than how large it will be.
        quantity, gradient: As in :func:`diffvbd.advise`.
        mesh: Whether to compare with a subdivided mesh, which takes some eight to sixteen times a run.
        progress, inputs: As in :func:`diffvbd.advise`.

    Raises:
        ValueError, TypeError: As rollout; a fraction outside (0, 1]; ``mesh`` with what belongs to single vertices.
        RuntimeError: The rollout itself does not run to its end.
    """
    check_state(model, x, v)
    check_kind("solver", solver, VBD)
    h, duration = check_time_step(solver.time_step, model.dtype), check_positive("duration", duration, "s")
    if not h <= (1 + SAME_TIME_STEP) * duration:
        fail("solver", f"a time step of at most the duration, {duration:g} s", f"{h:g} s")
    check_bool("mesh", mesh)
    fraction = check_number("fraction", fraction)
    if not 0 < fraction <= 1:
        fail("fraction", "a number in (0, 1]", repr(fraction))
    steps = FRAMES * max(1, round(fraction * duration / (h * FRAMES)))
    trials = trials_of(model, x, v, steps * h, quantity, gradient, inputs, progress)
    return _Budget(trials, replace(solver, prediction=None), steps).run(mesh)


class _Budget:
    def __init__(self, trials: TrialRuns, own: VBD, steps: int) -> None:
        self.trials, self.own, self.steps = trials, own, steps
        self.shares: list[Share] = []
        self.failed: dict[str, str] = {}  # by cause: why its reference is none

    def run(self, mesh: bool) -> ErrorBudget:
        p = self.trials
        run = self._run(p, self.own, self.steps)
        truncated, friction = self._contact_of()
        self._precision(run)
        converged = self._sweeps(run)
        self._contact(converged, truncated)
        best = self._time(run, converged)
        if mesh:
            self._mesh(converged)
        shares = sorted(self.shares, key=lambda s: -s.motion)
        whole = self._share("all but mesh", run, best, 0.0, f"{best.settings}")
        return ErrorBudget(self.own, (*shares, whole), p.duration, truncated, friction, not self.failed)

    @staticmethod
    def _run(trials: TrialRuns, settings: VBD, steps: int) -> TrialRun:
        done = trials.run(settings, steps)
        if done.failure:
            raise RuntimeError(f"error_budget: expected a rollout that runs to its end; {done.failure}")
        return done

    def _settled(self, trials: TrialRuns, settings: VBD, steps: int, cause: str) -> tuple[TrialRun, str]:
        """A run with sweeps until its steps balance their forces, and a note: its settings, or why that failed."""
        left, before = math.inf, math.inf
        while True:
            done = self._run(trials, settings, steps)
            left, before = trials.left(), left
            if is_balanced(left):
                self.failed.pop(cause, None)
                return done, f"{done.settings}"
            if settings.sweeps > MOST_SWEEPS:
                self.failed[cause] = unreached(done.settings, left)
                return done, self.failed[cause]
            settings = with_more_sweeps(settings, left, before)

    def _share(self, cause: str, a: TrialRun, b: TrialRun, seconds: float, note: str) -> Share:
        quantity = None if a.quantity is None or b.quantity is None else relative(a.quantity, b.quantity)
        gradients = self.trials.gradients_apart(a, b)
        motion = self.trials.apart(a.x, b.x)
        return Share(cause, motion, quantity, max(gradients) if gradients else None, seconds, note)

    def _counted(self, others: TrialRuns) -> float:
        """Adds what other trial runs, which began as copies of these, have taken, and returns it [s]."""
        seconds = others.spent - self.trials.spent
        self.trials.spent, self.trials.runs = others.spent, others.runs
        return seconds

    def _precision(self, run: TrialRun) -> None:
        p = self.trials
        if p.model.dtype == torch.float64:
            return
        given = converted(p.given, dtype=torch.float64)
        own = p.quantity
        quantity = None if own is None else lambda x, v: own(x.to(p.model.dtype), v.to(p.model.dtype))
        double = replace(p, model=p.model.to(dtype=torch.float64), x=p.x.double(), v=p.v.double(), given=given,
                         quantity=quantity)  # fmt: skip
        done = self._run(double, self.own, self.steps)
        seconds = self._counted(double)
        single = replace(run, x=run.x.double(), gradient=tuple(g.double() for g in run.gradient),
                         quantity=None if run.quantity is None else run.quantity.double())  # fmt: skip
        self.shares.append(self._share("precision", single, done, seconds, "the same in float64"))

    def _contact(self, converged: TrialRun, truncated: float | None) -> None:
        """Detections share the sweeps of a step: only where each has enough do they tell what pairs have truncated."""
        model, seconds, done, note = self.trials.model, 0.0, converged, "pairs truncated nothing"
        if truncated is None:
            return
        if truncated > 0:
            energies = [replace(e, detections=DETECTIONS) if isinstance(e, PairBarrier) else e for e in model.energies]
            others = replace(self.trials, model=model.replace(energies=energies))
            done, note = self._settled(others, converged.settings, self.steps, "contact")
            seconds = self._counted(others)
            note += f", detections={DETECTIONS}"
        self.shares.append(self._share("contact", converged, done, seconds, note))

    def _contact_of(self) -> tuple[float | None, float | None]:
        """The largest share of vertices that pairs truncated in a step, and of friction left unbalanced by the last
        one; None where there are no pairs, no friction, or it cannot be told."""
        p, model = self.trials, self.trials.model
        if not model.touches:
            return None, None
        settings, cuts, before = self.own, list[Tensor](), [(p.x, p.v)]
        system = system_of(model, settings)

        def look(step: int, x: Tensor, v: Tensor) -> None:
            cuts.append(truncated_fraction(system))
            if step == self.steps - 1:
                before[0] = (x, v)

        given = p.at_steps(dict(p.given), settings.time_step, self.steps, 0.0)
        end = p.execute(model, p.x, p.v, settings, steps=self.steps, save="last", observe=look, checks=NONE, **given)
        truncated = None if model.contact is None else float(torch.stack(cuts).max())
        if model.friction is None or changes(p.given) or not isinstance(settings.integrator, ImplicitEuler):
            return truncated, None
        inputs = given_of(system, p.given)
        prepared = prepare(system, tuple(p.x.shape[:-2]), inputs, time_step=settings.time_step, sweeps=settings.sweeps)
        return truncated, unbalanced_friction(system, Solve(*before[0], prepared, inputs.loads), end.x[-1])

    def _sweeps(self, run: TrialRun) -> TrialRun:
        """The same steps with sweeps enough that more change little."""
        began = self.trials.spent
        settings = replace(start_of(self.trials), integrator=self.own.integrator)
        now, note = self._settled(self.trials, replace(settings, sweeps=max(17, 2 * self.own.sweeps)), self.steps,
                                  "sweeps")  # fmt: skip
        while True:
            settings = replace(now.settings, sweeps=2 * now.settings.sweeps + 1)
            before, (now, note) = now, self._settled(self.trials, settings, self.steps, "sweeps")
            left = self.trials.apart(before.x, now.x)
            moves = left > max(ENOUGH * self.trials.apart(run.x, now.x), 1e-9)
            if not moves or now.settings.sweeps > MOST_SWEEPS:
                break
        note += f", which still move it by {left:.1e}" if moves else ""
        self.shares.append(self._share("sweeps", run, now, self.trials.spent - began, note))
        return now

    def _time(self, run: TrialRun, converged: TrialRun) -> TrialRun:
        """SDIRK2 with more steps; their sweeps are as many as converge here."""
        began = self.trials.spent
        settings = replace(converged.settings, integrator=SDIRK2())
        fine, note = self._settled(self.trials, settings, FINER * self.steps, "time step")
        share = self._share("time step", converged, fine, 0.0, "")
        half = self._run(self.trials, fine.settings, FINER // 2 * self.steps)
        left = self.trials.apart(half.x, fine.x)
        note += f", itself off by some {left:.0e}" if left > 0.3 * share.motion else ""
        if unseen := self.trials.swinging(FINER * self.steps):
            note += f", whose steps do not see how {unseen} swings"
        self.shares.append(replace(share, seconds=self.trials.spent - began, note=note))
        return fine

    def _mesh(self, converged: TrialRun) -> None:
        p, vertices = self.trials, self.trials.model.num_vertices
        finer = finer_mesh(p)
        fine, note = self._settled(finer, converged.settings, self.steps, "mesh")
        truncated = replace(fine, x=fine.x[..., :vertices, :], gradient=(), quantity=None)
        note = f"{finer.model.num_tets} tets, {note}"
        self.shares.append(self._share("mesh", replace(converged, gradient=()), truncated, self._counted(finer), note))


def finer_mesh(p: TrialRuns) -> TrialRuns:
    """TrialRun runs on the subdivided mesh, whose first vertices are those of the mesh."""
    given = dict(p.given)
    for name in given:
        if given[name] is not None and name not in (*OF_TETS, "gravity", "colliders", "colliders_before"):
            fail(name, "None with mesh=True, which has other vertices", type(given[name]).__name__)
    fine = halved(p.model)
    for name in OF_TETS:
        given[name] = mapped(given.get(name), lambda value: of_parts(value, p.model.num_tets))
    return replace(p, model=fine.model, x=fine.between(p.x), v=fine.between(p.v), given=given, quantity=None, wrt=None)
