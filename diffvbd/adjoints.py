"""Adjoint routes: small objects given to the one step function."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from . import ops
from .checks import fail

FULL_TAPE_LIMIT = 256 * 2**20  # bytes of full tape per step up to which "auto" keeps it


@dataclass(frozen=True)
class ReverseSweep:
    """The executed sweeps backwards: exact for every number of sweeps, without a global system. Recommended.

    Args:
        tape: What a step keeps for its backward, per active vertex and sweep (float64):
            ``"full"`` 72 bytes, raw update and factored block (96 with a floor, whose gaps must come back to the bit);
            ``"compact"`` 24 bytes, raw update, or with a floor the old position; blocks are assembled again;
            ``"recompute"`` nothing; the backward runs the step again;
            ``"auto"`` full while a step's full tape fits 256 MiB, compact beyond; a rollout that keeps all its tapes
            decides by their sum against 2 GiB.

    Source: paper, section 3; docs/method.md, sections 3 and 7.
    """

    tape: Literal["auto", "full", "compact", "recompute"] = "auto"

    def __post_init__(self) -> None:
        if self.tape not in ("auto", "full", "compact", "recompute"):
            fail("tape", '"auto", "full", "compact" or "recompute"', repr(self.tape))

    def policy(self, scalars_per_row: int, itemsize: int, energies: int) -> int:
        """The tape policy of ops.py for a step of scalars_per_row = scenes x sweeps x active vertices."""
        if self.tape == "auto":
            full = scalars_per_row * itemsize * ops.tape_rows(ops.FULL_TAPE, energies)
            return ops.FULL_TAPE if full <= FULL_TAPE_LIMIT else ops.COMPACT_TAPE
        return {"full": ops.FULL_TAPE, "compact": ops.COMPACT_TAPE, "recompute": ops.NO_TAPE}[self.tape]
