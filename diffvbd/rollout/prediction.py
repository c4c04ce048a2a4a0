"""Predictions: what dv.advise promises of a solver."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from ..checks import check_count, check_positive
from ..model.solver import VBD


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
    """What :func:`diffvbd.advise` says of the solver it returns; ``print(solver)`` shows a table with the runners-up.

    Attributes:
        asked: The error that was asked for [-].
        error: The predicted one [-]: root mean square over vertices and over four times of the distance to the exact
            motion of the mesh, over that of the motion itself; with a quantity or gradients the largest of theirs.
        seconds: Time of one rollout over ``duration`` [s], with its backward if gradients were asked for.
        duration: [s], of motion.
        reached: Whether ``error`` is known to be at most ``asked``.
        why: One line: why these, or why the error cannot be reached.
        others: The runners-up, fastest first; if the error cannot be reached, the other runs with an estimate.
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
            verdict += ", not confirmed" if self.error <= self.asked else f": {self.asked:g} cannot be reached"
        rows = [(line, f"{self.error:.1e}", f"{self.seconds / self.duration:.3g}", "measured")]
        rows += [(str(c.solver), f"{c.error:.1e}", f"{c.seconds / self.duration:.3g}", self._status(c))
                 for c in self.others]  # fmt: skip
        header = ("solver", "error", "s per s of motion", "")
        cost = f"{self.runs} trial runs took {self.spent:.2g} s, {self.cost:.1f} rollouts of this solver"
        first = f"{verdict}, {self.seconds_per_second:.3g} s per second of motion"
        lines = [first, self.why, cost, "", *aligned([header, *rows])]
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
