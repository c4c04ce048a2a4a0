"""The search for settings that keep an error: a ladder of time steps, then cheaper candidates that are run to be sure.

1. Ladder: settings that converge well run with ever more steps, twice as many each time, until two runs and the order
   that three show (Richardson) say that half of the wanted error is reached. Its last two runs give the reference.
2. Ranking: candidates run the quarter of the duration in which the ladder's runs part most, from the reference's own
   state there; with contact all of it. Error and time of each, and the order, predict with how many steps it meets the
   wanted error.
3. Proof: the one that should take the least time runs the whole duration and is compared with the reference; with more
   steps if it misses the error, with fewer if it is far below, or the next one. The ladder's last run always meets it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from ..model.integrators import BDF2, SDIRK2, ImplicitEuler, Integrator
from ..model.solver import VBD
from ..model.warnings import is_nearly_incompressible
from .pilots import FRAMES, Pilot, Pilots, changes, relative
from .prediction import Candidate, Prediction, on
from .reference import MOST_SWEEPS, is_balanced, takes_corrections, unreached, with_more_sweeps

LONGEST = 0.1  # [s] of the first time step of the ladder
MOST_STEPS = 2**17
FEWEST_THAT_RUN = 256  # steps: fewer than these may fail
ORDERS = (0.5, 2.0)  # that are believed
CLEAN = 0.6  # least order of two levels in a row from which contact counts as resolved
AIM = 0.6  # of the wanted error that a candidate is given
COSTS = 8.0  # times the advised rollout that all runs may take,
FREE = 1.0  # [s] or so long,
MORE = 2.0  # or so many times what the ladder has taken: where that is long, much faster settings are worth a look
LIKELY = 4  # of the candidates, at which that much is spent
MUCH = 0.5  # of the time of the fastest proven, that what is run to the end beyond the usual may take
NEAR = 10.0  # times the wanted error: runs of the ladder that are shown
ROUNDING = 1e-3  # of the wanted error: runs of the ladder below that, as of a free fall, compare with nothing
SAFE = 0.8  # of the wanted error that a run with impacts may show: the runs it is held against show less than there is
TOO_FINE = 0.1  # of the wanted error: candidates below it try fewer steps
WHOLE = 0.95  # of what the longest steps lose at an impact: runs that lose as much do not resolve it
ERROR, TIME_BUDGET = 0.01, 120.0  # what is asked for where nothing else is [-], [s]
PLAIN = VBD(1.0, 1)
STUCK = 6  # levels of the ladder that do not come closer: there is no limit to find


def found(pilots: Pilots, error: float, time_budget: float) -> VBD:
    """The settings that take the least time and keep the error, with their Prediction."""
    return _Search(pilots, error, time_budget).run()


def start_of(pilots: Pilots) -> VBD:
    """What the ladder runs with: well converged and never far from the fastest."""
    model = pilots.model
    if not takes_corrections(model, PLAIN):
        return VBD(1.0, 40, integrator=SDIRK2())
    if model.touches:
        return VBD(1.0, 20, integrator=SDIRK2())
    relaxation = 1.5 if _may_over_relax(pilots) else 1.0
    return VBD(1.0, 8, integrator=SDIRK2(), relaxation=relaxation, subspace="coarse")


def candidates_of(pilots: Pilots) -> list[VBD]:
    """What might be faster than the ladder's settings, the likeliest first."""
    model, sdirk, bdf, euler = pilots.model, SDIRK2(), BDF2(), ImplicitEuler()
    touches, corrects = model.touches, takes_corrections(model, PLAIN)
    free = not touches and corrects and _may_over_relax(pilots)
    over, over_coarse = (1.6, 1.5) if free else (1.0, 1.0)

    def plain(scheme: Integrator, *sweeps: int) -> list[VBD]:
        return [VBD(1.0, k, integrator=scheme, relaxation=over) for k in sweeps]

    def coarse(scheme: Integrator, *sweeps: int) -> list[VBD]:
        return [VBD(1.0, k, integrator=scheme, relaxation=over_coarse, subspace="coarse") for k in sweeps]

    out = []
    if corrects and not touches:
        out += [*coarse(sdirk, 2), *coarse(euler, 2), *coarse(bdf, 2), *coarse(sdirk, 5)]
    out += [*plain(sdirk, 10), *plain(euler, 5), *plain(bdf, 5), *plain(sdirk, 5, 20), *plain(bdf, 10, 20),
            *plain(euler, 10, 20)]  # fmt: skip
    return out


def _may_over_relax(pilots: Pilots) -> bool:
    """Whether no tet comes near incompressible, at any of some times where moduli change."""
    if pilots.model.mesh.num_tets == 0:
        return True
    times = [pilots.duration * k / FRAMES for k in range(FRAMES + 1)] if pilots.material_changes else [0.0]
    return not any(is_nearly_incompressible(p.mu, p.lam) for p in map(pilots.prepared_at, times))


class _Search:
    def __init__(self, pilots: Pilots, error: float, time_budget: float) -> None:
        self.pilots, self.error, self.time_budget = pilots, error, time_budget
        self.order = 1.0
        # impacts come early or late by up to a step: nothing can be extrapolated until steps resolve them
        self.smooth = not (pilots.model.touches or pilots.model.floor is not None)
        self.most = error if self.smooth else SAFE * error  # that a run may show
        self.clean = self.smooth  # whether the last two runs can be extrapolated
        self.ladder: list[Pilot] = []
        self.estimates: list[tuple[float, Pilot]] = []  # of levels from the third on: what is asked for, and the run
        self.proven: list[Candidate] = []
        self.predicted: list[Candidate] = []
        others = ", quantity and gradient" if pilots.wrt is not None else " and quantity" if pilots.quantity else ""
        self.of = f"(the largest of motion{others})" if others else "of the motion"

    def run(self) -> VBD:
        reached, why = self._climb()
        if reached:
            self._rank()
            self._prove()
            self.proven.sort(key=lambda c: c.seconds)
            best = next(c for c in self.proven if c.error <= self.most)
            why = self._reason()
        else:
            least = (math.inf, self.ladder[-1] if self.ladder else None)
            error, now = min(self.estimates, key=lambda e: e[0], default=least)
            settings = on(start_of(self.pilots), FRAMES, self.pilots.duration) if now is None else now.settings
            best = Candidate(settings, error, math.inf if now is None else now.seconds, now is not None)
            self.proven = [Candidate(r.settings, e, r.seconds, True) for e, r in self.estimates if r is not now]
        once = {str(c.solver): c for c in sorted(self.proven, key=lambda c: -c.seconds)}  # of two runs the faster
        once.pop(str(best.solver), None)
        tried = {str(best.solver), *once}
        rest = [*once.values(), *(c for c in self.predicted if str(c.solver) not in tried)]
        others = tuple(sorted(rest, key=lambda c: c.seconds))
        p = self.pilots
        told = Prediction(
            self.error, best.error, best.seconds, p.duration, reached, why, others, p.spent, p.runs, self.of
        )
        return replace(best.solver, prediction=told)

    def _reason(self) -> str:
        last, before = (run.settings for run in self.ladder[:-3:-1])
        limit = f"the limit of {before} and {last}" if self.clean else f"{last}"
        why = (
            f"the fastest of the runs below that keep the error; their errors are distances to {limit}, "
            f"and {self.uncertain:.1g} by which that may be off"
        )
        if self.pilots.spent > 0.9 * self.time_budget:
            why += f"; {self.time_budget:g} s of pilot runs (time_budget) ended the search for faster ones"
        return why

    # --- the ladder ---------------------------------------------------------------------------------------------------

    def _climb(self) -> tuple[bool, str]:
        """Runs with more steps each time until the last one has half of the wanted error, or why that cannot be had."""
        p, settings = self.pilots, start_of(self.pilots)
        steps = FRAMES * max(1, math.ceil(p.duration / (FRAMES * LONGEST)))
        apart: list[float] = []
        left = math.inf  # of forces, by the run that was last taken for the reference
        unseen = "what changes in time" if changes(p.given) else ""
        while True:
            if steps > MOST_STEPS and unseen and self.ladder:
                return False, f"{unseen} swings within each of {MOST_STEPS} steps, which do not see it"
            if steps > MOST_STEPS:
                return False, f"{MOST_STEPS} steps are not enough"
            if p.spent > self.time_budget:
                return False, f"{self.time_budget:g} s of pilot runs were not enough (time_budget)"
            now = p.run(settings, steps)
            if now.x is None and not self.ladder and steps < FEWEST_THAT_RUN:  # long steps may fail where short do not
                steps *= 2
                continue
            if now.x is None:
                return False, f"a run failed: {now.failure}"
            if unseen:
                unseen, apart = p.swinging(steps), []
                self.ladder = [now] if unseen else []  # runs that do not see it tell nothing of others
                if unseen:
                    steps *= 2
                    continue
            self.ladder.append(now)
            if len(self.ladder) > 1:
                apart.append(self._distance(self.ladder[-2], now))
            if len(apart) > 1:
                self._see_order(apart)
                error = max(self._remaining(apart), self._unresolved())
                self.estimates.append((error, now))
                if error <= 0.5 * self.error:
                    left, before = p.left(), left
                    if settings.sweeps > MOST_SWEEPS and not is_balanced(left):
                        return False, unreached(now.settings, left)
                    more = self._with_more_sweeps(settings, left, before)
                    if more is None:
                        return True, ""
                    if more.x is None:
                        return False, f"a run failed: {more.failure}"
                    settings = more.settings
                    self.estimates.pop()  # more sweeps moved it: it was none
                    self.ladder[-2:] = [more]
                    apart[-2:] = [self._distance(self.ladder[-2], more)]
                    continue
                if self._is_rounding():
                    return False, (f"shorter steps than those of {min(self.estimates, key=lambda e: e[0])[1].settings} "
                                   f"make it worse, as rounding does in {p.model.dtype}")  # fmt: skip
                if self._is_stuck(apart):
                    return False, self._why(apart[-1])
            steps *= 2

    def _remaining(self, apart: list[float]) -> float:
        """The error of the last run."""
        if self.clean:
            return apart[-1] / (2**self.order - 1)
        return max(apart[-2:]) / (2 ** min(self.order, 1.0) - 1)  # one pair of runs may agree by luck

    def _see_order(self, apart: list[float]) -> None:
        """The order that the last runs show; with contact it is believed where two levels in a row agree on one."""
        low, high = ORDERS
        last = [max(a, 1e-300) for a in apart[-3:]]
        shown = [math.log2(a / b) for a, b in zip(last, last[1:], strict=False)]
        self.order = min(max(shown[-1] if self.smooth else min(shown), low), high)
        self.clean = self.smooth or (len(shown) > 1 and min(shown) >= CLEAN)

    def _unresolved(self) -> float:
        """Motion that is lost with energy, and that runs which agree may therefore both lack. Vibrations swing within a
        step: they are resolved once halving it halves the energy lost. A rebound lasts: none is resolved while as much
        is lost as in the longest steps."""
        p, last = self.pilots, self.ladder[-1]
        if self.smooth:
            # the root of the energy times the step: sqrt(2) x 2 where the energy halves
            now, before = (p.lost(run, p.duration / run.steps) for run in (last, self.ladder[-2]))
            return 0.0 if now < before / (2 * math.sqrt(2)) else now
        now, first = (p.lost(run, 0.5 * p.duration) for run in (last, self.ladder[0]))
        return 0.0 if now < WHOLE * first else now

    def _with_more_sweeps(self, settings: VBD, left: float, before: float) -> Pilot | None:
        """The run before the last once more with twice the sweeps, if those move it by more than a quarter of the
        error: with the sweeps of the ladder it might come close to a limit of its own. Or if the last run left forces
        over; then with plain sweeps where more of them with corrections have left as much."""
        last = self.ladder[-2]
        more = self.pilots.run(with_more_sweeps(settings, left, before), last.steps)
        if is_balanced(left) and (more.x is None or self._distance(last, more) <= 0.25 * self.error):
            return None
        return more

    def _is_rounding(self) -> bool:
        """Whether the last runs are further from one another than longer steps were."""
        errors = [error for error, _ in self.estimates]
        single = self.pilots.model.dtype == torch.float32
        return single and self.smooth and len(errors) > 2 and min(errors[-2:]) > 2 * min(errors[:-2])

    @staticmethod
    def _is_stuck(apart: list[float]) -> bool:
        """Whether runs have come no closer to one another over several levels."""
        return len(apart) > STUCK and min(apart[-2:]) > 0.7 * max(apart[-STUCK:])

    def _why(self, apart: float) -> str:
        cause = "it holds vibrations down to the shortest that the mesh can carry"
        if not self.smooth:
            cause = "what touches when, and what sticks, depends on ever smaller differences"
        return f"runs of h and h/2 stay {apart:.2g} {self.of} apart however small h is: {cause}"

    def _distance(self, a: Pilot, b: Pilot) -> float:
        """Of motion, quantity and gradient, the largest."""
        assert a.x is not None and b.x is not None
        out = [self.pilots.apart(a.x, b.x)]
        out += self.pilots.gradients_apart(a, b)
        if a.quantity is not None and b.quantity is not None:
            out.append(relative(a.quantity, b.quantity))
        return max(out)

    @property
    def reference(self) -> Pilot:
        """The last run of the ladder; where the motion is smooth or resolved, extrapolated from the last two."""
        a, b = self.ladder[-2], self.ladder[-1]
        assert a.x is not None and b.x is not None
        share = 1 / (2**self.order - 1) if self.clean else 0.0

        def beyond(u: Any, w: Any) -> Any:
            return None if u is None else w + share * (w - u)

        gradient = tuple(beyond(u, w) for u, w in zip(a.gradient, b.gradient, strict=True))
        return replace(b, x=beyond(a.x, b.x), quantity=beyond(a.quantity, b.quantity), gradient=gradient)

    # --- candidates ---------------------------------------------------------------------------------------------------

    def _rank(self) -> None:
        p, last = self.pilots, self.ladder[-1]
        reference = self.reference
        uncertain = (0.5 if self.clean else 1.0) * self.estimates[-1][0]
        self.aim = AIM * (self.error - uncertain)
        for run in self.ladder:
            error = self._distance(run, reference) + uncertain
            if error <= NEAR * self.error or run is last:
                self.proven.append(Candidate(run.settings, error, run.seconds, True))
        self.uncertain, self.truth = uncertain, reference
        self.climbed = p.spent
        # with as many steps as the ladder takes for an error as wanted
        level, near = self._level_near(reference)
        # a quarter says what a candidate's error is over that of the ladder, which must be an error then, no rounding
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

    def _by_quarter(self, level: float, near: Pilot) -> Callable[[VBD, int], tuple[float, float]]:
        """The error of settings, and the time of a step, by the quarter of the duration in which steps matter most."""
        p, last, before = self.pilots, self.ladder[-1], self.ladder[-2]
        assert last.x is not None and before.x is not None
        quarter = p.hardest(before.x, last.x)
        target = last.x[quarter + 1]
        scale = self._of_quarter(p.run(near.settings, near.steps, quarter, last), target)

        def predict(settings: VBD, steps: int) -> tuple[float, float]:
            run = p.run(settings, steps, quarter, last)
            return level * self._of_quarter(run, target) / max(scale, 1e-300), run.seconds / steps

        return predict

    def _by_whole(self, settings: VBD, steps: int) -> tuple[float, float]:
        """The same by the whole duration: after an impact that no step resolves a quarter says nothing of the rest."""
        run = self.pilots.run(settings, steps)
        if run.x is None:
            return math.inf, 0.0
        error = self._distance(run, self.truth)
        self.proven.append(Candidate(run.settings, error + self.uncertain, run.seconds, True))
        return error, run.seconds / steps

    def _level_near(self, reference: Pilot) -> tuple[float, Pilot]:
        """The error nearest to the wanted one of a run of the ladder before its last, and that run."""
        levels = [(max(self._distance(run, reference), 1e-300), run) for run in self.ladder[:-1]]
        return min(levels, key=lambda level: abs(math.log(level[0] / self.error)))

    def _of_quarter(self, run: Pilot, target: Tensor) -> float:
        return math.inf if run.x is None else float((run.x[-1] - target).square().mean().sqrt())

    def _plan(self, settings: VBD, steps: int, error: float, per_step: float) -> None:
        order = self._order_of(settings)
        more = (max(error, 1e-300) / self.aim) ** (1 / order)
        wanted = self._rounded(steps * more)
        if wanted <= MOST_STEPS:
            self.plans.append((wanted * per_step, wanted, settings))
            planned = on(settings, wanted, self.pilots.duration)
            self.predicted.append(Candidate(planned, self.aim + self.uncertain, wanted * per_step, False))

    def _order_of(self, settings: VBD) -> float:
        return min(self.order, 1.0) if isinstance(settings.integrator, ImplicitEuler) else self.order

    @staticmethod
    def _rounded(steps: float) -> int:
        return FRAMES * max(1, math.ceil(min(steps, 2.0 * MOST_STEPS) / FRAMES))

    def _least(self) -> float:
        """Time of the fastest proven candidate that keeps the error."""
        return min((c.seconds for c in self.proven if c.error <= self.most), default=math.inf)

    def _allowed(self, seconds: float, more: bool) -> float:
        """How long all runs may take [s] for settings that take ``seconds``."""
        return min(max(COSTS * seconds, FREE, MORE * self.climbed if more else 0.0), self.time_budget)

    def _prove(self) -> None:
        p = self.pilots
        for seconds, steps, settings in sorted(self.plans, key=lambda plan: plan[0]):
            for _ in range(3):
                least = self._least()
                allowed = self._allowed(min(least, seconds), more=seconds < MUCH * least)
                if seconds > 0.9 * least or p.spent + seconds > allowed:
                    break
                run = p.run(settings, steps)
                if run.x is None:
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
