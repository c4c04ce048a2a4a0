"""A converged step: sweeps until the residual meets a tolerance, for which GlobalAdjoint is the right derivative."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor

from .._common.checks import check_bool, check_count, check_positive, fail, is_word
from .._common.context import refuse_refinement, refuse_transforms, replaced
from .._common.messages import log_progress, warn
from ..adjoint.routes import Adjoint, GlobalAdjoint, check_adjoint
from ..model.model import Model
from ..model.solver import BDF2, VBD
from ..model.system import System
from ..ops import SweepSettings
from ..step.advance import advance, of_equation, swept
from ..step.arguments import (
    Prepared,
    acceleration_of,
    check_prescribed,
    check_staged,
    check_state,
    collider_state,
    given_of,
    prepare,
    refuse_non_finite,
)
from ..step.contact import outcomes
from ..step.integrators import take
from ..step.predict import Begun, begin
from ..step.residual import contact_of_step, left_over, of_bodies, of_scenes, potential_of_step, rounding, share
from ..step.warnings import system_for


@dataclass(frozen=True)
class Solution:
    """Result of :func:`diffvbd.solve`.

    Attributes:
        x, v: Positions [m] and velocities [m/s] after the step, shape [..., V, 3].
        sweeps: Executed sweeps, of all solves of the step.
        residual: Left-over force over the forces of the step [-], the largest over scenes, with contact over bodies,
            and over the solves of the step.
        converged: Whether in every scene that meets the tolerance, or is no more than rounding leaves.
    """

    x: Tensor
    v: Tensor
    sweeps: int
    residual: float
    converged: bool

    def __repr__(self) -> str:
        return (f"Solution(x and v of shape {list(self.x.shape)}, sweeps={self.sweeps}, residual={self.residual:.3g}, "
                f"converged={self.converged})")  # fmt: skip


def solve(
    model: Model,
    x: Tensor,
    v: Tensor,
    solver: VBD,
    *,
    tolerance: float = 1e-8,
    max_sweeps: int = 10_000,
    check_every: int = 10,
    on_failure: Literal["raise", "warn"] = "raise",
    adjoint: Adjoint | None = None,
    progress: bool = False,
    **inputs: Any,
) -> Solution:
    """One implicit step, swept until it has converged in every scene.

    The residual is |M (x - y) + h^2 dE/dx| over |M (x - y)| + |h^2 dE/dx|, 2-norms over the vertices that are not
    pinned: the part of the step's forces that is not balanced. A scene where no more is left than rounding leaves
    (in float32, or far from the origin, that can be much) counts as converged.

    With a PairBarrier or Friction the residual has the forces of pairs, damping and friction, and every body has to
    meet the tolerance. Such a step is taken anew with more and more sweeps, because its parts do not go on from where
    others ended. Where pairs hold it up no number of sweeps converges.

    Args:
        model, x, v, solver, inputs: As in :func:`diffvbd.step`; the number of sweeps of the solver is not used. Each
            solve of a step of SDIRK2 is swept until it has converged.
        tolerance: Residual in (0, 1) at which the sweeps end. A gradient of GlobalAdjoint is off by about that, times
            the conditioning of the step.
        max_sweeps: Number of sweeps after which to give up.
        check_every: Sweeps before the first look at the residual, which costs some tens of sweeps of a small mesh and
            on CUDA waits for the device; later looks are further apart, at most a quarter of the sweeps so far.
        on_failure: ``"raise"`` a RuntimeError, or ``"warn"`` and go on, where max_sweeps do not meet the tolerance.
        adjoint: None: GlobalAdjoint(), which sees a converged state and no sweeps. ReverseSweep() or Unrolled() run
            the same sweeps again and differentiate them. With contact ReverseSweep(), and no other; with rigid bodies
            not GlobalAdjoint(), and ReverseSweep() by default.
        progress: Print each look at the residual, by the logger "diffvbd".

    Returns:
        A :class:`diffvbd.results.Solution`.

    Raises:
        ValueError, TypeError: As :func:`diffvbd.step`.
        RuntimeError: Where the sweeps do not converge.
        NotImplementedError: For another adjoint than ReverseSweep with contact or friction; for GlobalAdjoint with
            rigid bodies.

    Source: paper, eq. 1; docs/adjoints.md.
    """
    refuse_refinement("dv.solve")
    refuse_transforms("dv.solve, which looks at values (dv.step has them)")
    lead, system, scheme = check_state(model, x, v), system_for(model, solver), solver.integrator
    if isinstance(scheme, BDF2):
        fail("solver", "ImplicitEuler() or SDIRK2() in a step: BDF2() needs the step before", "BDF2()")
    if adjoint is None and not (model.touches or model.rigid_bodies):
        adjoint = GlobalAdjoint()
    adjoint = check_adjoint(adjoint, solver.tape)
    if check_positive("tolerance", tolerance) >= 1:
        fail("tolerance", "a number in (0, 1)", tolerance)
    max_sweeps, check_every = check_count("max_sweeps", max_sweeps), check_count("check_every", check_every, 1)
    if not is_word(on_failure, "raise", "warn"):
        fail("on_failure", '"raise" or "warn"', repr(on_failure))
    check_bool("progress", progress)
    given = given_of(system, inputs)
    prepared = prepare(system, lead, given, time_step=solver.time_step, sweeps=0, adjoint=adjoint)
    prescribed = given.loads["prescribed"]
    for value in prescribed if isinstance(prescribed, tuple) else (prescribed,):
        check_prescribed(system, value, x)
    check_staged(scheme, given.loads)
    run = _Converging(adjoint, tolerance, max_sweeps, check_every, on_failure, progress)
    taken = take(scheme, system, x, v, None, prepared, given.loads, run)
    return Solution(taken.x, taken.v, run.count, run.residual, run.converged)


class _Converging:
    """Solves that are swept until they have converged.

    Attributes:
        count, residual, converged: As in :class:`diffvbd.results.Solution`, of all solves so far.
    """

    def __init__(self, adjoint: Adjoint, tolerance: float, max_sweeps: int, check_every: int, on_failure: str,
                 progress: bool) -> None:  # fmt: skip
        self.adjoint, self.tolerance, self.on_failure = adjoint, tolerance, on_failure
        self.most, self.progress = (max_sweeps, check_every), progress
        self.count, self.residual, self.converged = 0, 0.0, True

    def __call__(self, model: System, x: Tensor, v: Tensor, prepared: Prepared, **loads: Any) -> tuple[Tensor, Tensor]:
        loads["gravity"] = acceleration_of(loads["gravity"], x)
        where = collider_state(model, x, loads["colliders"], loads["colliders_before"])
        begun = begin(model, x, v, prepared, loads["force"], loads["gravity"], loads["prescribed"])
        with torch.no_grad(), torch.autocast(x.device.type, enabled=False):
            swept_only = replaced(prepared, unrolled=None)
            done = _Sweeping(model, begun.detached(), swept_only, {"x": x, "v": v, **loads}, where, self.tolerance,
                             self.progress)  # fmt: skip
            done.run(*self.most)
            if not math.isfinite(done.residual):
                refuse_non_finite(model, {"x": x, "v": v, **loads, "mu": prepared.mu, "lam": prepared.lam})
        _judge(done, self.tolerance, self.on_failure)
        if isinstance(self.adjoint, GlobalAdjoint):
            end = of_equation(model, begun, prepared, self.adjoint, lambda: done.end.clone())
            x_end, v_end = begun.finish(end, model, prepared, corrects=False)
        else:
            again = replaced(prepared, settings=replaced(prepared.settings, sweeps=done.count))
            x_end, v_end = advance(model, x, v, again, adjoint=self.adjoint, **loads)
            if model.coarse is not None:  # the parts above had corrections of their own
                with torch.no_grad(), torch.autocast(x.device.type, enabled=False):
                    end = x_end.detach().reshape(begun.y.shape)
                    done.look_at(end if begun.origin is None else end - begun.origin)
                _judge(done, self.tolerance, self.on_failure)
        self.count += done.count
        self.residual = max(self.residual, done.residual)
        self.converged = self.converged and done.converged
        return x_end.reshape(x.shape), v_end.reshape(x.shape)


def _judge(done: _Sweeping, tolerance: float, on_failure: str) -> None:
    if done.converged:
        return
    text = (
        f"solve: expected a residual of at most {tolerance:g}, got {done.residual:.3g} after {done.count} sweeps; "
        f"take more (max_sweeps), a smaller time step, or {done.remedy}"
    )
    if on_failure == "raise":
        raise RuntimeError(text)
    warn(text, RuntimeWarning)


class _Sweeping:
    """A step that is swept part by part, without gradients, and how far from converged its end is.

    Attributes:
        end: Where the step ends after the sweeps so far, shape [B, V, 3].
        count: Sweeps so far.
        residual, converged: As in :class:`diffvbd.results.Solution`.
    """

    def __init__(self, model: System, begun: Begun, prepared: Prepared, given: dict[str, Any],
                 where: tuple[Tensor, Tensor] | None, tolerance: float, progress: bool) -> None:  # fmt: skip
        """where: collider points at the start and at the end of the step, None without contact."""
        self.model, self.begun, self.prepared, self.given = model, begun, prepared, given
        self.where = None if where is None else (where[0].detach(), where[1].detach())
        self.tolerance, self.norm = tolerance, of_scenes if where is None else of_bodies(model)
        self.contact = contact_of_step(model, begun, prepared, self.where)
        # The end of a step is its last sweep, which may be relaxed less, and its correction: what was swept before them
        # is what further sweeps go on from.
        self.before, self.count, self.progress = begun.x_start, 0, progress
        numbers = prepared.settings.numbers
        self.over = replaced(prepared.settings, numbers=replaced(numbers, last_relaxation=numbers.relaxation))
        self.rounding: Tensor | None = None
        self.residual, self.converged = math.inf, False
        if where is None:
            self._end_at(self.before)

    @property
    def remedy(self) -> str:
        """Advice where the sweeps do not converge."""
        if self.where is None and self.model.coarse is not None:
            return 'plain sweeps (subspace="rigid"), in case the corrections stall'
        if self.where is None:
            return "with the exact block a relaxation between 1.5 and 1.7"
        outcome = outcomes.get(self.model.model)
        if outcome is not None and bool(outcome.truncated.any()):
            return "more detections or a larger reach of the PairBarrier, whose pairs have held this step up"
        unused = 'subspace="coarse" or ' if self.model.coarse is None else ""
        return unused + "a larger Friction(velocity=)"

    def run(self, max_sweeps: int, check_every: int) -> None:
        """Sweeps until the step has converged, or is lost, or max_sweeps are done."""
        while self.where is not None:  # from the beginning, with half as many sweeps more each time
            self.count = min(self.count + max(check_every, self.count // 2), max_sweeps)
            self._end_at(self._swept(replaced(self.prepared.settings, sweeps=self.count)))
            if self.converged or self.count >= max_sweeps or not math.isfinite(self.residual):
                return
        while not self.converged and self.count < max_sweeps and math.isfinite(self.residual):
            # a look costs many sweeps: at first after check_every, later after a quarter of what there were
            some = min(max(check_every, self.count // 4), max_sweeps - self.count)
            # one of `count` is the last sweep, which each part makes anew
            self.before = self._swept(replaced(self.over, sweeps=some - (self.count == 0)))
            self.count += some
            self._end_at(self._swept(replaced(self.prepared.settings, sweeps=1)))

    def _swept(self, settings: SweepSettings) -> Tensor:
        part = replaced(self.prepared, settings=settings)
        return swept(self.model, replaced(self.begun, x_start=self.before), part, self.given, colliders=self.where)

    def _end_at(self, x: Tensor) -> None:
        """Corrects what the last sweep left, and looks at it."""
        self.look_at(self.begun.corrected(x, self.model, self.prepared))

    def look_at(self, end: Tensor) -> None:
        """Takes a state [B, V, 3] for the end of the step."""
        self.end = end
        if not end.numel():
            self.residual, self.converged = 0.0, True
            return
        at = potential_of_step(self.model, end, self.begun, self.prepared, self.contact)
        if self.rounding is None or self.contact is not None:  # barriers become stiffer as gaps close
            self.rounding = rounding(at, self.norm)
        left, whole = left_over(at, self.norm)
        ratio = share(left, whole)
        done = (ratio <= self.tolerance) | ((left <= self.rounding) & torch.isfinite(self.rounding))
        # what rounding leaves is converged, and no residual to speak of where a body is only a part of the scene
        shown = ratio if self.contact is None else torch.where(done & (ratio > self.tolerance), 0, ratio)
        self.residual, self.converged = float(torch.nan_to_num(shown, nan=torch.inf).max()), bool(done.all())
        if self.progress:
            log_progress("solve: residual %.3g after %d sweeps", self.residual, self.count)
