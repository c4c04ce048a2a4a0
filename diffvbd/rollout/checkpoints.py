"""Checkpoint schedules of a rollout: which states are kept, and which steps the backward runs again."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint, set_checkpoint_early_stop

from .. import ops
from ..adjoint.routes import Adjoint, TapedSweep, Unrolled
from ..checks import check_count, fail, is_word
from ..model.system import System
from ..scopes import Scope, transformed

MAX_REPEATS = 64  # of a step under BinomialCheckpoints: each is a nested checkpoint, and a run of the step
TAPE_BUDGET = 2 * 2**30  # bytes of tape that "auto" lets a rollout keep
UNROLLED_SCALARS = 540  # that autograd keeps per active vertex and sweep; measured on a structured beam (bench/cpu.py)


@dataclass(frozen=True)
class BinomialCheckpoints:
    """Binomial (treeverse) checkpointing: at most ``snapshots`` states and the tape of one step are kept.

    ``steps`` steps cost at most t extra forward runs of a step, t the least number with C(snapshots + t, t) >= steps.

    Args:
        snapshots: How many states, at least 1.

    Raises:
        ValueError: snapshots < 1; in the rollout, so few that t would be more than 64.
        TypeError: What is no integer.

    Source: Griewank and Walther (2000), Algorithm 799.
    """

    snapshots: int

    def __post_init__(self) -> None:
        check_count("snapshots", self.snapshots, 1)


# x, v, and what an integrator knows of the step before. A checkpoint takes the tensors one by one: of those that lie in
# other arguments autograd would keep copies alive.
State = tuple[Tensor, ...]


class Segment(NamedTuple):
    """The state after some steps, the frames (step, x, v) saved on the way, and what was observed."""

    end: State
    frames: list[tuple[int, Tensor, Tensor]]
    observed: list[Any]


Run = Callable[..., Segment]  # of the first step, the one after the last, and a State's tensors


def checked_schedule(given: Any) -> Any:
    """A schedule whose kind and numbers are right."""
    if given is None or is_word(given, "auto") or isinstance(given, BinomialCheckpoints):
        return given
    if isinstance(given, str):
        fail("checkpoint_every", '"auto", None, an integer > 0 or BinomialCheckpoints(snapshots)', repr(given))
    return check_count("checkpoint_every", given, 1)


def choose_schedule(
    checkpoint_every: int | BinomialCheckpoints | Literal["auto"] | None,
    adjoint: Adjoint,
    model: System,
    scenes: int,
    steps: int,
    sweeps: int,
) -> tuple[int | BinomialCheckpoints | None, Adjoint]:
    """Resolves ``"auto"`` for schedule and tape from the bytes they would keep."""
    checkpoint_every = checked_schedule(checkpoint_every)
    inside = transformed()  # torch's checkpoints cannot hold tensors of a transform
    if inside and torch.is_grad_enabled() and checkpoint_every not in (None, "auto"):
        raise NotImplementedError(f'checkpoint_every: expected None or "auto", which both keep all tapes inside '
                                  f"torch.func transforms, got {checkpoint_every}")  # fmt: skip
    if isinstance(checkpoint_every, BinomialCheckpoints):
        snapshots = checkpoint_every.snapshots
        while _repeats(steps, snapshots) > MAX_REPEATS:
            snapshots += 1
        if snapshots > checkpoint_every.snapshots:
            fail(
                "checkpoint_every",
                f"BinomialCheckpoints of at least {snapshots} snapshots for {steps} steps",
                checkpoint_every,
            )
    if checkpoint_every != "auto":
        return checkpoint_every, adjoint
    row = scenes * check_count("sweeps", sweeps) * model.num_active * model._mass.element_size()
    if not isinstance(adjoint, TapedSweep):  # a step of GlobalAdjoint keeps a few states and no tape
        kept = UNROLLED_SCALARS * row if isinstance(adjoint, Unrolled) else 0
        return None if inside or steps * kept <= TAPE_BUDGET else max(1, math.isqrt(steps)), adjoint
    candidates = ("full", "compact") if adjoint.tape == "auto" else (adjoint.tape,)
    for tape in candidates:
        policy = TapedSweep(tape).policy(0, 0, 0, model.device)
        if steps * row * ops.tape_rows(policy, model.energy_mask) <= TAPE_BUDGET:
            return None, TapedSweep(tape)
    if inside:
        return None, TapedSweep(candidates[-1])
    return max(1, math.isqrt(steps)), adjoint


def run_segments(run: Run, steps: int, state: State, every: int | BinomialCheckpoints | None) -> Segment:
    """Runs all steps under a schedule."""
    if isinstance(every, BinomialCheckpoints):
        return _binomial(run, 0, steps, every.snapshots, *state)
    if every is None:
        return run(0, steps, *state)
    frames, observed = [], []
    for first in range(0, steps, every):
        part = _again(run, first, min(first + every, steps), *state)
        state = part.end
        frames += part.frames
        observed += part.observed
    return Segment(state, frames, observed)


def _again(run: Callable[..., Segment], *args: Any) -> Segment:
    # The non-reentrant form: gradients reach what a callable closes over, and checkpoints nest.
    # A graph's capture admits no look at the state of the random number generator; what is replayed draws none.
    capturing = (
        not torch.compiler.is_compiling() and torch.cuda.is_available() and torch.cuda.is_current_stream_capturing()
    )
    if torch.compiler.is_compiling():
        return checkpoint(run, *args, use_reentrant=False, preserve_rng_state=not capturing)  # type: ignore[return-value]
    scope = Scope()
    # A run that stops once the last tensor is saved does not reach the end of its last step, which records it.
    with set_checkpoint_early_stop(not scope.recorders):
        return checkpoint(_resuming(run, scope), *args, use_reentrant=False, preserve_rng_state=not capturing)  # type: ignore[return-value]


def _resuming(run: Callable[..., Segment], scope: Scope) -> Callable[..., Segment]:
    def resumed(*args: Any) -> Segment:
        with scope.resumed():
            return run(*args)

    return resumed


def _binomial(run: Run, first: int, end: int, snapshots: int, *state: Tensor) -> Segment:
    length = end - first
    if length <= 1:
        return run(first, end, *state)
    middle = first + _left(length, snapshots)
    left = _again(_binomial, run, first, middle, snapshots, *state)
    right = _binomial(run, middle, end, max(snapshots - 1, 0), *left.end)
    return Segment(right.end, left.frames + right.frames, left.observed + right.observed)


def _left(length: int, snapshots: int) -> int:
    """Steps before the first snapshot, so that both parts repeat their steps as rarely as can be."""
    if snapshots == 0:
        return length - 1
    repeats = _repeats(length, snapshots)
    most = math.comb(snapshots + repeats - 1, repeats - 1)
    return max(1, min(most, length - 1))


def _repeats(length: int, snapshots: int) -> int:
    """How often a step is run again at most."""
    repeats = 1
    while math.comb(snapshots + repeats, repeats) < length:
        repeats += 1
    return repeats
