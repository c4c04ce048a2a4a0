"""Adjoint routes: small objects given to the one step function. docs/adjoints.md says when to use which."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import torch

from .. import ops
from .._common.checks import check_bool, check_count, check_positive, fail, init_names_checked, is_word

# Up to which bytes of a step's full tape "auto" keeps it: these, or on CUDA this share of the device's memory if that
# is more.
FULL_TAPE_LIMIT, FULL_TAPE_SHARE = 256 * 2**20, 1 / 256


def full_tape_limit(device: torch.device) -> int:
    """Bytes of a step's full tape up to which ``tape="auto"`` keeps it."""
    if device.type != "cuda":
        return FULL_TAPE_LIMIT
    return max(FULL_TAPE_LIMIT, int(FULL_TAPE_SHARE * torch.cuda.get_device_properties(device).total_memory))


@init_names_checked
@dataclass(frozen=True)
class ReverseSweep:
    """The executed sweeps backwards: exact for every number of sweeps, without a global system. Recommended.

    What a step keeps for it is said by ``VBD(tape=)``.

    Source: paper, section 3; docs/method.md, sections 3 and 7.
    """


@dataclass(frozen=True)
class TapedSweep(ReverseSweep):
    """ReverseSweep with the tape of a solver: see :class:`diffvbd.VBD`."""

    tape: str = "auto"

    def policy(self, scalars_per_row: int, itemsize: int, energies: int, device: torch.device) -> int:
        """The tape policy of ops.fields for a step of scalars_per_row = scenes x sweeps x active vertices."""
        if self.tape == "auto":
            full = scalars_per_row * itemsize * ops.tape_rows(ops.FULL_TAPE, energies)
            return ops.FULL_TAPE if full <= full_tape_limit(device) else ops.COMPACT_TAPE
        return {"full": ops.FULL_TAPE, "compact": ops.COMPACT_TAPE, "recompute": ops.NO_TAPE}[self.tape]


@init_names_checked
@dataclass(frozen=True)
class Unrolled:
    """The executed colored sweep in plain torch (``diffvbd.reference``), differentiated by torch.autograd.

    Exact for every number of sweeps, as ReverseSweep is, at a hundred times its time and tens of times its memory: for
    checking a gradient, or for a formula that is not compiled yet. Not recommended otherwise. The forward is plain
    torch too: it agrees with the compiled one to rounding, not to the bit.
    """


@dataclass(frozen=True)
class LinearSolve:
    """Outcome of the linear solves of one step's backward, which GlobalAdjoint hands to its ``report``.

    Attributes:
        iterations: Of conjugate gradients, the most over all scenes.
        residual: |b - A w| / |b|, computed anew at the end, the largest over all scenes.
        converged: Whether every scene met the tolerance.
    """

    iterations: int
    residual: float
    converged: bool


@init_names_checked
@dataclass(frozen=True)
class GlobalAdjoint:
    """The adjoint of the equation, not of the solver: one linear system per step with the Hessian of the incremental
    potential at the executed end state, solved by preconditioned conjugate gradients (3x3 blocks of vertices).

    Right where the sweeps have converged, as after :func:`diffvbd.solve`; before, wrong in size and even in sign. Keeps
    no tape: memory does not grow with the sweeps. Not recommended for steps of few sweeps. Springs, tendons, pressure
    and patches enter with their energies, not with the bounds that sweeps see. Its backward waits for the device, so
    that it cannot be captured in a CUDA graph, and is not available to ``torch.func``.

    Args:
        assembled: Store the Hessian as a sparse matrix of 3V x 3V; else multiply with it matrix-free, tet by tet.
        tolerance: Relative residual |b - A w| / |b| at which a scene's solve ends, in (0, 1); None: 1e-10 in float64,
            1e-5 in float32. An ill-conditioned system may not get there: then the solve fails.
        max_iterations: Of conjugate gradients; None: ten times the unknowns of a scene, at most 10,000.
        on_failure: ``"raise"`` a RuntimeError, or ``"warn"`` and go on, where a solve does not meet the tolerance.
        report: Called with a :class:`diffvbd.results.LinearSolve` after each step's backward, e.g. ``solves.append``.

    Raises:
        RuntimeError: In the backward, for a solve that fails, for adjoints that are not finite, and while a CUDA graph
            is captured.
        NotImplementedError: With contact or rigid bodies; inside ``torch.func`` transforms; in the backward, for second
            derivatives and for batched gradients (``is_grads_batched``).

    Source: paper, eq. 5 (right) and section 6.3; docs/adjoints.md.
    """

    assembled: bool = True
    tolerance: float | None = None
    max_iterations: int | None = None
    on_failure: Literal["raise", "warn"] = "raise"
    report: Callable[[LinearSolve], object] | None = None

    def __post_init__(self) -> None:
        check_bool("assembled", self.assembled)
        if self.tolerance is not None and check_positive("tolerance", self.tolerance) >= 1:
            fail("tolerance", "a number in (0, 1)", self.tolerance)
        if self.max_iterations is not None:
            check_count("max_iterations", self.max_iterations, 1)
        if not is_word(self.on_failure, "raise", "warn"):
            fail("on_failure", '"raise" or "warn"', repr(self.on_failure))
        if self.report is not None and not callable(self.report):
            raise TypeError(f"report: expected a function of a LinearSolve, got {type(self.report).__name__}")


Adjoint = ReverseSweep | Unrolled | GlobalAdjoint


def check_adjoint(adjoint: Adjoint | None, tape: str = "auto") -> Adjoint:
    """The route to take, with the tape of the solver; None is the default one."""
    if isinstance(adjoint, TapedSweep):
        return adjoint
    if adjoint is None or isinstance(adjoint, ReverseSweep):
        return TapedSweep(tape)
    if not isinstance(adjoint, (Unrolled, GlobalAdjoint)):
        kinds = "diffvbd.ReverseSweep, Unrolled or GlobalAdjoint"
        got = f"the class {adjoint.__name__}" if isinstance(adjoint, type) else type(adjoint).__name__
        raise TypeError(f"adjoint: expected a {kinds}, got {got}")
    return adjoint
