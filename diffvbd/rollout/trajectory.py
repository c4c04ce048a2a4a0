"""Values that change from step to step, and the Trajectory of a rollout."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from .._common.checks import check_count, fail
from .._common.context import is_captured
from ..step.integrators import History
from ..step.residual import ErrorEstimate


@dataclass(frozen=True)
class PerStep:
    """A value that changes from step to step, see :func:`per_step`."""

    values: Tensor


def per_step(values: Tensor) -> PerStep:
    """A tensor of values for each step of a rollout, shape [steps, ...].

    Raises:
        TypeError: What is no tensor, or has no dimension. Another number of steps than that of the rollout raises
            ValueError there.
    """
    if not isinstance(values, Tensor) or values.dim() == 0:
        got = "shape []" if isinstance(values, Tensor) else type(values).__name__
        raise TypeError(f"values: expected a tensor of shape [steps, ...], got {got}")
    return PerStep(values)


@dataclass(frozen=True)
class StepAverage:
    """A function of the time [s] whose mean over each step is taken, see :func:`step_average`."""

    function: Callable[[float], Any]
    samples: int

    def __call__(self, time: float) -> Any:
        return self.function(time)

    def over(self, time_step: float, began: float = 0.0) -> Callable[[int, Tensor, Tensor], Any]:
        """The mean as a function of the step, as rollouts take one. began: the time at step 0 [s]."""

        def mean(step: int, x: Tensor, v: Tensor) -> Tensor:
            total: Any = 0.0
            for sample in range(self.samples):
                value = self.function(began + (step + (sample + 0.5) / self.samples) * time_step)
                total = total + (value if isinstance(value, Tensor) else torch.as_tensor(value, dtype=x.dtype).to(x))
            return total / self.samples

        return mean


def step_average(function: Callable[[float], Any], samples: int = 32) -> StepAverage:
    """A function of the time [s] since the start of the rollout, whose mean over each step is the value of that step:
    for loads that begin, end or swing within a step. No impulse is lost, and times in the function, such as that
    of a release, keep their gradient, which values at the middle of each step lose.

    An edge should last some h / ``samples``. For sharper ones divide the differences of the integral by h, and pass
    them on in :func:`per_step`.

    Args:
        function: Returns what rollout takes for the argument: a tensor, a number or a sequence. It may close over
            tensors that require grad.
        samples: How many times of a step it is asked at, in the middles of equal parts.

    Raises:
        ValueError, TypeError: What is no function; samples < 1. In a rollout, beside ``prescribed`` and ``colliders``,
            which are positions at the end of a step.
    """
    if not callable(function) or isinstance(function, Tensor):
        raise TypeError(f"function: expected a function of the time [s], got {type(function).__name__}")
    return StepAverage(function, check_count("samples", samples, minimum=1))


def mapped(value: Any, change: Callable[[Any], Any]) -> Any:
    """An input of a rollout after ``change``, also where it is given per step or by a function."""
    if isinstance(value, PerStep):
        return PerStep(change(value.values))
    if isinstance(value, StepAverage):
        return StepAverage(mapped(value.function, change), value.samples)
    if isinstance(value, Tensor) or not callable(value):
        return change(value)

    @functools.wraps(value)  # with its arguments, by which policies are told from functions of time
    def changed(*at: Any) -> Any:
        return change(value(*at))

    return changed


def refuse_average(name: str, value: Any) -> None:
    if isinstance(value, StepAverage):
        raise TypeError(f"{name}: expected positions at the end of each step, got step_average")


@dataclass(frozen=True)
class Trajectory:
    """Saved states of a rollout.

    Attributes:
        x, v: Positions [m] and velocities [m/s] of the saved frames, shape [frames, ..., V, 3].
        steps: Step number of each frame (0: the initial state); the last frame is the final state.
        observations: What ``observe`` returned, stacked over steps (a tensor, or a tuple or dict of them), or None.
        errors: With ``Checks(errors=True)`` those of each step, its tensors of shape [steps, ..., bodies]; else None.
        history: With BDF2() that of the last frame, for a rollout that continues; else None.
    """

    x: Tensor
    v: Tensor
    steps: list[int]
    observations: Any = None
    errors: ErrorEstimate | None = None
    history: History | None = None

    def __repr__(self) -> str:
        frames, span = len(self.steps), f"{self.steps[0]} to {self.steps[-1]}" if self.steps else "none"
        return f"Trajectory({frames} frames of steps {span}, x and v of shape {list(self.x.shape)})"


def stacked(observed: list[Any]) -> Any:
    """The results of ``observe`` over steps."""
    if not observed:
        return None
    first = observed[0]
    for step, value in enumerate(observed, start=1):
        if not _alike(first, value):
            fail("observe", f"{_described(first)} after each step, as after the first",
                 f"{_described(value)} after step {step}")  # fmt: skip
    if first is None:
        return None
    if isinstance(first, dict):
        return {k: stacked([o[k] for o in observed]) for k in first}
    if isinstance(first, (tuple, list)):
        return tuple(stacked([o[i] for o in observed]) for i in range(len(first)))
    if not isinstance(first, Tensor):
        raise TypeError(f"observe: expected tensors, or tuples or dicts of them, got {type(first).__name__}")
    return torch.stack(observed)


def _alike(first: Any, value: Any) -> bool:
    if isinstance(first, dict):
        return isinstance(value, dict) and value.keys() == first.keys()
    if isinstance(first, (tuple, list)):
        return isinstance(value, (tuple, list)) and len(value) == len(first)
    if isinstance(first, Tensor):
        return isinstance(value, Tensor) and value.shape == first.shape
    return type(value) is type(first)


def _described(value: Any) -> str:
    if isinstance(value, dict):
        return f"a dict with the keys {list(value)}"
    if isinstance(value, (tuple, list)):
        return f"a tuple of {len(value)}"
    if isinstance(value, Tensor):
        return f"a tensor of shape {list(value.shape)}"
    return "None" if value is None else type(value).__name__


# --- functions of a rollout that a checkpointed segment calls again ---------------------------------------------------

CHANGED = (
    "{}: expected the same value for step {} in the backward as in the rollout, got another one: a function must not "
    "keep state from call to call (an integral, a filter, a hidden state, a random generator of its own), and what it "
    "closes over must not change in place before the backward; checkpoint_every=None calls it once"
)
STRIDE = (5**0.5 - 1) / 2  # of weights in [0, 1) that differ from place to place


def repeated(name: str, value: Any) -> Any:
    """``value``; a function of (step, x, v) is wrapped to raise RuntimeError where it returns another value than it did
    for that step. Tensors on CUDA, where a look would wait for the device, become NaN in place of that."""
    if isinstance(value, Tensor) or not callable(value):
        return value
    seen: dict[int, Any] = {}  # by step

    def called(step: int, x: Tensor, v: Tensor) -> Any:
        found = value(step, x, v)
        if isinstance(found, Tensor) and is_captured(found):
            return found
        now = _mark_of(found)
        return _matched(found, seen.setdefault(step, now), now, CHANGED.format(name, step))

    return called


def _mark_of(value: Any) -> Any:
    """A small key of a value: of a tensor two sums. NaN is that of rows of ``prescribed`` that are not
    pinned."""
    if isinstance(value, (tuple, list)):
        return [_mark_of(part) for part in value]
    if isinstance(value, np.ndarray):
        return [value.shape, value.tobytes()]
    if not isinstance(value, Tensor):
        return value if isinstance(value, (int, float, np.number)) else type(value)
    flat = value.detach().double().nan_to_num().flatten()
    weights = torch.arange(len(flat), dtype=flat.dtype, device=flat.device).mul_(STRIDE).frac_()
    return torch.stack([flat @ weights, flat @ flat])


def _matched(found: Any, before: Any, now: Any, changed: str) -> Any:
    """The value if its mark is that of before."""
    if isinstance(now, Tensor) and isinstance(before, Tensor):
        close = _are_close(before, now, found)
        if found.is_cuda:  # the same operations in each run
            return found * torch.where(close, 1.0, torch.nan).to(found.dtype)
        same = bool(close)
    elif isinstance(found, (tuple, list)) and isinstance(before, list) and len(before) == len(found):
        parts = [_matched(*part, changed) for part in zip(found, before, now, strict=True)]
        return tuple(parts) if isinstance(found, tuple) else parts
    else:
        same = type(before) is type(now) and (before == now or (before != before and now != now))  # NaN is itself
    if not same:
        raise RuntimeError(changed)
    return found


def _are_close(before: Tensor, now: Tensor, value: Tensor) -> Tensor:
    """Whether sums differ by no more than what rounding of the values makes of them."""
    if before is now:
        return now.new_ones((), dtype=torch.bool)
    share = torch.finfo(value.dtype if value.is_floating_point() else torch.float64).eps ** 0.5
    scale = torch.stack([(value.numel() * now[1]).sqrt(), now[1]])
    return ((now - before).abs() <= share * scale).all()
