"""What every rollout says of its end: numbers that are not finite, vertices that have gone too far, steps that were not
solved; and what is at fault: the force, the time step or the sweeps."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..mask import ELASTIC
from ..model.integrators import Integrator
from ..model.system import System
from ..model.warnings import warn_of_bending
from ..ops import SweepSettings
from ..said import is_silent, page, percent, warn
from ..scopes import looks_at, may_copy
from ..step.arguments import Prepared
from ..step.integrators import Solve
from ..step.lost import FAR, fault_of, reach_of, size_of
from ..step.unsolved import Unsolved, unsolved
from ..tuples import replaced

WRONG = 0.02  # of the motion: an estimate above it is warned of; impacts were off by two to five times as much
MADE_GOOD = 2.5  # with coarse corrections the next steps make good most of an error: it was 1 / 2.4 to 1 / 40 as large
UNSEEN = 1e-6  # of the Model's size: by less nothing is wrong
LEAST_STEPS = 10  # of a rollout whose sweeps are looked at unasked: a look costs as much as some steps
EVERY, MOST = 75, 4  # steps between two looks, and looks at most, beside that at the hardest step
ENDED = "ended"  # of a Model's _derived, on CUDA: how its latest rollouts ended, on the way to the host


@dataclass
class EndLook:
    """Looks at some steps of a rollout, the last among them, and the one in which forces did most.

    A share e of what forces do in a step is left out by its sweeps, or comes on top of it. Over a time T it moves the
    end by e a T^2 / 2, where a is the acceleration, and a vibration of frequency w out of its phase by e w T / 2; with
    w^2 = a over the way the two are the same estimate, of the motion's relative error.
    """

    model: System
    integrator: Integrator
    start: tuple[Tensor, ...]  # positions and velocities
    steps: int
    time_step: float
    asked: bool  # whether to look at more than whether the end is lost
    at: frozenset[int]  # steps whose sweeps are looked at
    kept: dict[int, tuple[Solve, Tensor]] = field(default_factory=dict)
    hardest: tuple[int, float] = (0, 0.0)  # a step, and by how much its velocities changed, root sum of squares
    forced: float = 0.0  # sum of the squares of that
    seen: int = 0
    last: tuple[Prepared, Tensor, Any] | None = None  # of the latest step: arguments, velocities before it, force

    def see(self, step: int, prepared: Prepared, force: Any, solve: Solve, before: Tensor, x: Tensor, v: Tensor
            ) -> None:  # fmt: skip
        """After a step from velocities ``before``; one that runs again is not seen twice."""
        if step <= self.seen:
            return
        self.seen, self.last = step, (prepared, before, force)
        if not self.at:
            return
        change = float(torch.dist(v.detach(), before.detach()))
        self.forced += change * change
        harder = change > self.hardest[1]
        if not harder and step not in self.at:
            return
        given = {k: t.detach() if isinstance(t, Tensor) else t for k, t in solve.given.items()}
        if harder and self.hardest[0] not in self.at:
            self.kept.pop(self.hardest[0], None)
        if harder:
            self.hardest = (step, change)
        self.kept[step] = (replaced(solve, x=solve.x.detach(), v=solve.v.detach(), given=given), x.detach())

    def warn(self, x: Tensor, v: Tensor, gravity: Any) -> None:
        """Warns (UserWarning) of the end of a rollout."""
        model, duration = self.model, self.steps * self.time_step
        with torch.no_grad():
            reach = reach_of(model, self.start, x, gravity, duration)
            good = torch.stack([torch.isfinite(x).all() & torch.isfinite(v).all(), reach <= FAR])
        if not looks_at(x) and not self.asked:
            _say_later(model, good)
            return
        finite, near = good.tolist()
        if not (finite and near):
            _warn_of_loss("the rollout", finite, self.fault())
            return
        if self.at:
            self._warn_of_sweeps(duration)
        if self.asked:
            warn_of_bending(model, x)

    def forget(self) -> None:
        """Lets go of tensors, which a segment that runs again in a backward would keep."""
        self.kept, self.last, self.start = {}, None, ()

    def fault(self) -> str:
        """What is at fault where the state that the latest step has left is lost."""
        if self.last is None or not looks_at(self.last[1]):
            return "take a smaller time_step, more sweeps, or float64"
        return fault_of(self.model, self.last[0], self.integrator, *self.last[1:])

    def explain(self, error: Exception, x: Tensor, v: Tensor) -> str:
        """The end of a message of a step that refuses the state that earlier ones have left."""
        if self.last is None or not str(error).startswith(("x:", "v:", "x, v:")) or not looks_at(x):
            return ""
        largest = float(torch.stack([(x - self.start[0]).abs().amax(), v.abs().amax()]).amax())
        if largest <= FAR * size_of(self.model):
            return ""
        return f", which the steps before made; {self.fault()}"

    def _warn_of_sweeps(self, duration: float) -> None:
        known: dict[tuple[int, int], np.ndarray] = {}
        found: list[Unsolved] = []
        way = 0.0
        for solve, x in self.kept.values():
            if (one := unsolved(self.model, solve, x, known)) is not None:
                found.append(one)
            way = max(way, float(torch.dist(x, self.start[0].detach())))
        forced = math.fsum(u.forced**2 for u in found)
        left = math.fsum(u.error**2 for u in found)
        if not left > 0:
            return
        share = math.sqrt(left / forced) if forced > 0 else math.inf
        acceleration = math.sqrt(self.forced / self.steps) / self.time_step
        error = share * max(1.0, 0.5 * duration * math.sqrt(acceleration / way) if way > 0 else 1.0)
        error /= 1.0 if self.model.coarse is None else MADE_GOOD
        distance = max(
            self.steps * math.sqrt(left / len(found)), error * way / math.sqrt(self.start[0][..., 0].numel())
        )
        if not (error > WRONG and distance > UNSEEN * size_of(self.model)):
            return
        worst = max(found, key=lambda u: u.error)
        of = f", worst in body {worst.body}" if int(self.model.body.max()) else ""
        of += f" of scene {worst.scene}" if worst.scene else ""
        faster = "" if self.model.coarse is not None else ', subspace="coarse"'
        warn(
            f"sweeps: they leave steps unsolved{of}, and the motion may be off by some {percent(min(error, 1.0))}; "
            f"take more sweeps{faster} or a smaller time_step, and compare; " + page("numerics.md")
        )


def look_at_end(asked: bool | None, model: System, integrator: Integrator, x: Tensor, v: Tensor, steps: int,
                settings: SweepSettings) -> EndLook | None:  # fmt: skip
    """A look at a rollout; None where nothing may be looked at."""
    if steps == 0 or x.numel() == 0 or is_silent() or not (looks_at(x) or may_copy(x)):
        return None
    looked = asked is not False and (asked or (not x.is_cuda and steps >= LEAST_STEPS))
    looked = bool(looked and settings.sweeps and model.num_active and model.energy_mask & ELASTIC)
    count = 0 if not looked or model.contact is not None else max(1, min(MOST, steps // EVERY))
    at = frozenset(round(steps * k / count) for k in range(1, count + 1))
    return EndLook(model, integrator, (x, v), steps, settings.numbers.time_step, looked, at)


# --- on CUDA, where looking waits for the device ----------------------------------------------------------------------


def _say_later(model: System, good: Tensor) -> None:
    """Copies an answer to the host meanwhile; the Model's next rollout that finds it there says what it was."""
    said = torch.empty(2, dtype=torch.bool, pin_memory=True)
    said.copy_(good, non_blocking=True)
    done = torch.cuda.Event()
    done.record(torch.cuda.current_stream(good.device))
    model._derived.setdefault(ENDED, []).append((said, done))


def warn_of_last_end(model: System, x: Tensor) -> None:
    """Warns of the Model's rollouts before this one, on CUDA, as far as they are done."""
    if not model._derived.get(ENDED) or not may_copy(x):
        return
    ends = [(said, done.query()) for said, done in model._derived[ENDED]]
    model._derived[ENDED] = [end for end, (_, there) in zip(model._derived[ENDED], ends, strict=True) if not there]
    for said, there in ends:
        if there and not bool(said.all()):
            _warn_of_loss(
                "a rollout of this Model before this one",
                bool(said[0]),
                "take a smaller time_step, more sweeps, or float64",
            )
            return


def _warn_of_loss(which: str, finite: bool, fault: str) -> None:
    how = f"vertices more than {FAR:g} body sizes from where motion and gravity would have taken them"
    if not finite:
        how = "positions or velocities that are not finite"
    warn(f"x: {which} ended with {how}: {fault}; dv.debug_checks() says in which step what is not finite began; "
         + page("numerics.md"))  # fmt: skip
