"""How a rollout is executed: time step, integrator and sweeps, and what a Model does between the sweeps."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import torch

from ..adjoint.routes import ReverseSweep
from ..checks import check_count, check_kind, check_positive, fail, is_word
from ..energies import StableNeoHookean
from ..model.arguments import checked_coarse, checked_relaxation
from ..model.coarse import CoarseSpace
from ..model.model import Model
from ..step.integrators import ImplicitEuler, Integrator, check_integrator
from .checkpoints import BinomialCheckpoints, checked_schedule


@dataclass(frozen=True)
class Candidate:
    """Settings that :func:`diffvbd.advise` has considered.

    Attributes:
        settings: They.
        error: Of the motion, or the largest of motion, quantity and gradient [-], as for the advised ones.
        seconds: Of one rollout over the duration [s], with its backward if gradients were asked for.
        proven: Whether they were run over the whole duration; otherwise error and seconds are predicted from a part.
    """

    settings: Settings
    error: float
    seconds: float
    proven: bool


@dataclass(frozen=True)
class Prediction:
    """What :func:`diffvbd.advise` says of the settings it returns. As text: a table with the runners-up.

    Attributes:
        asked: The error that was asked for [-].
        error: The predicted one [-]: root mean square over vertices and over four times of the distance to the exact
            motion of the mesh, over that of the motion itself; with a quantity or gradients the largest of theirs.
        seconds: Time of one rollout over ``duration`` [s], with its backward if gradients were asked for.
        duration: [s], of motion.
        reached: Whether ``error`` is known to be at most ``asked``.
        why: One line: why these, or why the error cannot be had.
        others: The runners-up, fastest first; if the error cannot be had, the other runs with an estimate.
        spent: What all pilot runs took [s].
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
        """Time of the pilot runs over that of one advised rollout."""
        return self.spent / self.seconds if self.seconds > 0 else math.inf


@dataclass(frozen=True)
class Settings:
    """What a rollout runs with, in place of what the Model and the call say: ``dv.rollout(..., settings=s)``.

    Args:
        time_step: h [s], at most; a rollout over ``duration`` takes steps of equal length.
        sweeps: K, of each solve.
        integrator: As in :func:`diffvbd.step`.
        relaxation, coarse: As in :class:`diffvbd.Model`.
        block: Of StableNeoHookean: ``"exact"`` or ``"paper"``; None: the Model's.
        dtype: The Model's has to be this one; None: any.
        tape: Of :class:`diffvbd.ReverseSweep`.
        checkpoint_every: As in :func:`diffvbd.rollout`.
        predicted: Of settings that :func:`diffvbd.advise` returns; else None.

    Raises:
        ValueError, TypeError: For what the step, the Model or the rollout would refuse; it names the argument. Also
            from ``applied`` for what is no Model, or one of another dtype, and from ``steps`` for a duration <= 0.
    """

    time_step: float
    sweeps: int
    integrator: Integrator = ImplicitEuler()
    relaxation: float = 1.0
    coarse: CoarseSpace | Literal["auto"] | None = None
    block: Literal["exact", "paper"] | None = None
    dtype: torch.dtype | None = None
    tape: Literal["auto", "full", "compact", "recompute"] = "auto"
    checkpoint_every: int | BinomialCheckpoints | Literal["auto"] | None = "auto"
    predicted: Prediction | None = field(default=None, compare=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "time_step", check_positive("time_step", self.time_step, "s"))
        object.__setattr__(self, "sweeps", check_count("sweeps", self.sweeps))
        object.__setattr__(self, "integrator", check_integrator(self.integrator))
        object.__setattr__(self, "relaxation", checked_relaxation(self.relaxation))
        checked_coarse(self.coarse, (StableNeoHookean(),), None)  # this and what follows raises
        ReverseSweep(self.tape)
        checked_schedule(self.checkpoint_every)
        if self.block is not None and not is_word(self.block, "exact", "paper"):
            fail("block", '"exact", "paper" or None', repr(self.block))
        if not isinstance(self.dtype, torch.dtype | None) or self.dtype not in (None, torch.float64, torch.float32):
            fail("dtype", "torch.float64, torch.float32 or None", repr(self.dtype))
        if not isinstance(self.predicted, Prediction | None):
            raise TypeError(f"predicted: expected a diffvbd.Prediction or None, got {type(self.predicted).__name__}")

    def steps(self, duration: float) -> int:
        """How many steps a rollout over so long [s] takes; what exceeds a whole number by rounding is none."""
        return max(1, math.ceil(check_positive("duration", duration, "s") / self.time_step - 1e-6))

    def applied(self, model: Model) -> Model:
        """The Model that runs: ``model`` with relaxation, coarse and block of these settings. It is
        made once for each Model and kept with it."""
        check_kind("model", model, Model)
        if self.dtype is not None and self.dtype != model.dtype:
            fail("settings", f"those of a Model of {model.dtype}", f"of {self.dtype}: take model.to(dtype=...)")
        changes: dict[str, Any] = {
            "relaxation": self.relaxation,
            "coarse": CoarseSpace() if self.coarse == "auto" else self.coarse,
        }
        if self.block is not None:
            energies = [StableNeoHookean(self.block) if isinstance(e, StableNeoHookean) else e for e in model.energies]
            changes["energies"] = tuple(energies)
        same = {name: getattr(model, name) == value for name, value in changes.items() if name != "energies"}
        own = next((e.block for e in model.energies if isinstance(e, StableNeoHookean)), None)
        if all(same.values()) and self.block in (None, own):
            return model
        key = f"settings {self.relaxation} {changes['coarse']} {self.block}"
        return model.derived(key, lambda: _replaced(model, changes))

    def on(self, steps: int, duration: float) -> Settings:
        """The same with ``steps`` steps over ``duration`` [s], without a prediction."""
        steps, duration = check_count("steps", steps, minimum=1), check_positive("duration", duration, "s")
        return replace(self, time_step=duration / steps, predicted=None)

    def __str__(self) -> str:
        parts = [f"h = {self.time_step:.3g} s", type(self.integrator).__name__, f"K = {self.sweeps}"]
        parts += [f"relaxation {self.relaxation:g}"] if self.relaxation != 1 else []
        parts += ["coarse"] if self.coarse is not None else []
        line = ", ".join(parts)
        return line if self.predicted is None else f"{line}\n{_told(line, self.predicted)}"


def _replaced(model: Model, changes: dict[str, Any]) -> Model:
    """``model`` with other arguments and the room for pairs that it has by now."""
    out, own = model.replace(**changes), model.surface_of_contact
    if own is not None and out.surface_of_contact is not None:
        out.surface_of_contact = replace(out.surface_of_contact, capacity=own.capacity)
    return out


def aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """The lines of a table whose columns are as wide as their widest cell."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join(map(str.ljust, row, widths)).rstrip() for row in rows]


def _status(candidate: Candidate, told: Prediction) -> str:
    if not candidate.proven:
        return "predicted"
    misses = told.reached and candidate.seconds < told.seconds
    return "measured, misses the error" if misses else "measured"


def _told(line: str, told: Prediction) -> str:
    """The lines below the settings: what they promise, why, and the runners-up."""
    verdict = f"error {told.error:.2g} {told.of}"
    if not told.reached:
        verdict += ", not confirmed" if told.error <= told.asked else f": {told.asked:g} cannot be had"
    rows = [(line, f"{told.error:.1e}", f"{told.seconds / told.duration:.3g}", "measured")]
    rows += [(str(c.settings), f"{c.error:.1e}", f"{c.seconds / told.duration:.3g}", _status(c, told))
             for c in told.others]  # fmt: skip
    header = ("settings", "error", "s per s of motion", "")
    cost = f"{told.runs} pilot runs took {told.spent:.2g} s, {told.cost:.1f} rollouts of these settings"
    first = f"{verdict}, {told.seconds_per_second:.3g} s per second of motion"
    lines = [first, told.why, cost, "", *aligned([header, *rows])]
    if told.reached and any(not c.proven and c.seconds < told.seconds for c in told.others):
        lines.append("What is predicted has not been run to the end, and may miss the error.")
    return "\n".join(lines)
