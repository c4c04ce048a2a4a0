"""Where the error of a rollout comes from: sweeps, time step, precision, contact, mesh."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from ..checks import check_kind, check_number, check_positive, check_time_step, fail
from ..contact.barrier import PairBarrier
from ..model.inputs import MODULI
from ..model.integrators import SDIRK2, ImplicitEuler
from ..model.model import Model
from ..model.solver import VBD
from ..model.system import system_of
from ..said import percent
from ..step.arguments import check_state, given_of, prepare
from ..step.held_up import cut_share
from ..step.integrators import SAME_TIME_STEP
from .checks import NONE
from .contact_check import unbalanced_friction
from .halved import halved, of_parts
from .pilots import FRAMES, Pilot, Pilots, Quantity, changes, converted, of_time, pilots_of, relative
from .prediction import aligned
from .reference import MOST_SWEEPS, is_balanced, unreached, with_more_sweeps
from .rollout import rollout
from .search import start_of
from .trajectory import StepAverage

FINER = 4  # times the steps of the finest run
ENOUGH = 0.1  # of what more sweeps have changed so far: below it they have converged
DETECTIONS = 8  # in each step of the run that is held up least


@dataclass(frozen=True)
class Share:
    """What one cause contributes to an error.

    Attributes:
        cause: "sweeps", "time step", "precision", "contact", "mesh" or "all but mesh".
        motion: Root mean square distance of positions, over vertices and four times, over the way from the start [-].
        quantity: Relative difference of the quantity [-]; None without one.
        gradient: That of its gradient [-]; None where none was asked for.
        seconds: What the pilot runs took that tell it [s].
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
    """The error of a rollout by cause, see :func:`error_budget`. As text: a table.

    Attributes:
        solver: Whose error it is.
        shares: One for each cause, the largest first, then "all but mesh" together, which need not be their sum.
        duration: Of the motion that was looked at [s].
        cut: The largest share of vertices that pairs held up in a step [-]; None without pairs.
        friction: The share of the friction that the last step left unbalanced [-]; None without friction.
        reached: Whether all runs that others are compared with have steps that balance their forces, to 1 %. Where one
            has not, its note says so, and what is compared with it says little.
    """

    solver: VBD
    shares: tuple[Share, ...]
    duration: float
    cut: float | None
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
        if self.cut is not None:
            lines.append(f"pairs held up at most {percent(self.cut)} of the vertices in a step")
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
    """Splits the error of a rollout by cause, by pilot runs that have less of one error at a time.

    sweeps: the same steps with sweeps until more change nothing and their forces balance. time step: those against
    SDIRK2 with four times the steps. precision: the same run in double precision. contact: the converged steps with
    more detections in each, where pairs have held up motion.
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
    if not isinstance(mesh, bool):
        raise TypeError(f"mesh: expected a bool, got {type(mesh).__name__}")
    fraction = check_number("fraction", fraction)
    if not 0 < fraction <= 1:
        fail("fraction", "a number in (0, 1]", repr(fraction))
    steps = FRAMES * max(1, round(fraction * duration / (h * FRAMES)))
    pilots = pilots_of(rollout, model, x, v, steps * h, quantity, gradient, inputs, progress)
    return _Budget(pilots, replace(solver, prediction=None), steps).run(mesh)


class _Budget:
    def __init__(self, pilots: Pilots, own: VBD, steps: int) -> None:
        self.pilots, self.own, self.steps = pilots, own, steps
        self.shares: list[Share] = []
        self.failed: dict[str, str] = {}  # by cause: why its reference is none

    def run(self, mesh: bool) -> ErrorBudget:
        p = self.pilots
        run = self._run(p, self.own, self.steps)
        cut, friction = self._contact_of()
        self._precision(run)
        converged = self._sweeps(run)
        self._contact(converged, cut)
        best = self._time(run, converged)
        if mesh:
            self._mesh(converged)
        shares = sorted(self.shares, key=lambda s: -s.motion)
        whole = self._share("all but mesh", run, best, 0.0, f"{best.settings}")
        return ErrorBudget(self.own, (*shares, whole), p.duration, cut, friction, not self.failed)

    @staticmethod
    def _run(pilots: Pilots, settings: VBD, steps: int) -> Pilot:
        done = pilots.run(settings, steps)
        if done.x is None:
            raise RuntimeError(f"error_budget: expected a rollout that runs to its end; {done.failure}")
        return done

    def _settled(self, pilots: Pilots, settings: VBD, steps: int, cause: str) -> tuple[Pilot, str]:
        """A run with sweeps until its steps balance their forces, and a note: its settings, or why that failed."""
        left, before = math.inf, math.inf
        while True:
            done = self._run(pilots, settings, steps)
            left, before = pilots.left(), left
            if is_balanced(left):
                self.failed.pop(cause, None)
                return done, f"{done.settings}"
            if settings.sweeps > MOST_SWEEPS:
                self.failed[cause] = unreached(done.settings, left)
                return done, self.failed[cause]
            settings = with_more_sweeps(settings, left, before)

    def _share(self, cause: str, a: Pilot, b: Pilot, seconds: float, note: str) -> Share:
        assert a.x is not None and b.x is not None
        quantity = None if a.quantity is None or b.quantity is None else relative(a.quantity, b.quantity)
        gradients = self.pilots.gradients_apart(a, b)
        motion = self.pilots.apart(a.x, b.x)
        return Share(cause, motion, quantity, max(gradients) if gradients else None, seconds, note)

    def _counted(self, others: Pilots) -> float:
        """Adds what other pilot runs, which began as copies of these, have taken, and returns it [s]."""
        seconds = others.spent - self.pilots.spent
        self.pilots.spent, self.pilots.runs = others.spent, others.runs
        return seconds

    def _precision(self, run: Pilot) -> None:
        p = self.pilots
        if p.model.dtype == torch.float64:
            return
        given = converted(p.given, dtype=torch.float64)
        own = p.quantity
        quantity = None if own is None else lambda x, v: own(x.to(p.model.dtype), v.to(p.model.dtype))
        double = replace(p, model=p.model.to(dtype=torch.float64), x=p.x.double(), v=p.v.double(), given=given,
                         quantity=quantity)  # fmt: skip
        done = self._run(double, self.own, self.steps)
        seconds = self._counted(double)
        assert run.x is not None
        single = replace(run, x=run.x.double(), gradient=tuple(g.double() for g in run.gradient),
                         quantity=None if run.quantity is None else run.quantity.double())  # fmt: skip
        self.shares.append(self._share("precision", single, done, seconds, "the same in float64"))

    def _contact(self, converged: Pilot, cut: float | None) -> None:
        """Detections share the sweeps of a step: only where each has enough do they tell what pairs have held up."""
        model, seconds, done, note = self.pilots.model, 0.0, converged, "pairs held up nothing"
        if cut is None:
            return
        if cut > 0:
            energies = [replace(e, detections=DETECTIONS) if isinstance(e, PairBarrier) else e for e in model.energies]
            others = replace(self.pilots, model=model.replace(energies=energies))
            done, note = self._settled(others, converged.settings, self.steps, "contact")
            seconds = self._counted(others)
            note += f", detections={DETECTIONS}"
        self.shares.append(self._share("contact", converged, done, seconds, note))

    def _contact_of(self) -> tuple[float | None, float | None]:
        """The largest share of vertices that pairs held up in a step, and of friction left unbalanced by the last one;
        None where there are no pairs, no friction, or it cannot be told."""
        p, model = self.pilots, self.pilots.model
        if not model.touches:
            return None, None
        settings, cuts, before = self.own, list[Tensor](), [(p.x, p.v)]
        system = system_of(model, settings)

        def look(step: int, x: Tensor, v: Tensor) -> None:
            cuts.append(cut_share(system))
            if step == self.steps - 1:
                before[0] = (x, v)

        given = p.at_steps(dict(p.given), settings.time_step, self.steps, 0.0)
        end = p.execute(model, p.x, p.v, settings, steps=self.steps, save="last", observe=look, checks=NONE, **given)
        cut = None if model.contact is None else float(torch.stack(cuts).max())
        if model.friction is None or changes(p.given) or not isinstance(settings.integrator, ImplicitEuler):
            return cut, None
        inputs = given_of(system, p.given)
        prepared = prepare(system, tuple(p.x.shape[:-2]), inputs, time_step=settings.time_step, sweeps=settings.sweeps)
        return cut, unbalanced_friction(system, before[0], end.x[-1], prepared, inputs.loads)

    def _sweeps(self, run: Pilot) -> Pilot:
        """The same steps with sweeps enough that more change little."""
        began = self.pilots.spent
        settings = replace(start_of(self.pilots), integrator=self.own.integrator)
        now, note = self._settled(self.pilots, replace(settings, sweeps=max(17, 2 * self.own.sweeps)), self.steps,
                                  "sweeps")  # fmt: skip
        while True:
            settings = replace(now.settings, sweeps=2 * now.settings.sweeps + 1)
            before, (now, note) = now, self._settled(self.pilots, settings, self.steps, "sweeps")
            assert before.x is not None and now.x is not None and run.x is not None
            left = self.pilots.apart(before.x, now.x)
            moves = left > max(ENOUGH * self.pilots.apart(run.x, now.x), 1e-9)
            if not moves or now.settings.sweeps > MOST_SWEEPS:
                break
        note += f", which still move it by {left:.1e}" if moves else ""
        self.shares.append(self._share("sweeps", run, now, self.pilots.spent - began, note))
        return now

    def _time(self, run: Pilot, converged: Pilot) -> Pilot:
        """SDIRK2 with more steps; their sweeps are as many as converge here."""
        began = self.pilots.spent
        settings = replace(converged.settings, integrator=SDIRK2())
        fine, note = self._settled(self.pilots, settings, FINER * self.steps, "time step")
        share = self._share("time step", converged, fine, 0.0, "")
        half = self._run(self.pilots, fine.settings, FINER // 2 * self.steps)
        assert half.x is not None and fine.x is not None
        left = self.pilots.apart(half.x, fine.x)
        note += f", itself off by some {left:.0e}" if left > 0.3 * share.motion else ""
        if unseen := self.pilots.swinging(FINER * self.steps):
            note += f", whose steps do not see how {unseen} swings"
        self.shares.append(replace(share, seconds=self.pilots.spent - began, note=note))
        return fine

    def _mesh(self, converged: Pilot) -> None:
        p, vertices = self.pilots, self.pilots.model.num_vertices
        finer = finer_mesh(p)
        fine, note = self._settled(finer, converged.settings, self.steps, "mesh")
        assert fine.x is not None
        cut = replace(fine, x=fine.x[..., :vertices, :], gradient=(), quantity=None)
        note = f"{finer.model.num_tets} tets, {note}"
        self.shares.append(self._share("mesh", replace(converged, gradient=()), cut, self._counted(finer), note))


def _of_parts(value: Any, tets: int) -> Any:
    """A value of each tet, or a function of time that returns one, for its parts."""
    if isinstance(value, StepAverage):
        return value.then(lambda found: of_parts(found, tets))
    return (lambda t: of_parts(value(t), tets)) if of_time(value) else of_parts(value, tets)


def finer_mesh(p: Pilots) -> Pilots:
    """Pilot runs on the subdivided mesh, whose first vertices are those of the mesh."""
    given = dict(p.given)
    for name in given:
        if given[name] is not None and name not in (*MODULI, "density", "gravity", "colliders", "colliders_before"):
            fail(name, "None beside mesh=True, which has other vertices", type(given[name]).__name__)
    fine = halved(p.model)
    for name in (*MODULI, "density"):
        given[name] = _of_parts(given.get(name), p.model.num_tets)
    return replace(p, model=fine.model, x=fine.between(p.x), v=fine.between(p.v), given=given, quantity=None, wrt=None)
