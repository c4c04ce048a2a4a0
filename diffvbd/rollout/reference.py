"""When a run may be called a reference: once its steps leave no force over that is worth speaking of."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import torch

from ..mask import ELASTIC
from ..model.model import Model
from ..model.solver import VBD
from ..said import percent
from ..step.balance import UNBALANCED, left_of_solve, share

MOST_SWEEPS = 1300
LOOKS = 64  # at steps of a run, evenly spread
STALLED = 0.5  # of what was left over: more than this part of it after twice the sweeps


def unbalanced(seen: list[Any]) -> float:
    """The force that solves left over, all together, over all of their forces [-]: of the worst scene, with contact of
    the worst body. Steps with large forces, such as those of an impact, weigh more than those in flight.

    seen: of solves that a rollout recorded (kind "solve"), each (Model, Solve, positions after it).
    """
    if not seen:
        return 0.0
    found = [left_of_solve(model, (s.x, s.v), end, s.prepared, s.given) for model, s, end in seen]
    left, whole = (torch.stack(parts).sum(0) for parts in zip(*found, strict=True))
    return float(torch.nan_to_num(share(left, whole), nan=math.inf).max()) if left.numel() else 0.0


def is_balanced(left: float) -> bool:
    """Whether the steps of a run leave so little over that others may be held against it."""
    return left <= UNBALANCED


def takes_corrections(model: Model, solver: VBD) -> bool:
    """Whether coarse corrections are defined."""
    return bool(model.energy_mask & ELASTIC) and solver.block == "exact" and solver.saturation is None


def with_other_sweeps(model: Model, solver: VBD) -> VBD:
    """Plain sweeps in place of coarse corrections, or corrections, where they are cheap, in place of plain ones."""
    if solver.coarse is None and (model.touches or not takes_corrections(model, solver)):
        return solver
    return replace(solver, subspace="coarse" if solver.coarse is None else "rigid")


def with_more_sweeps(settings: VBD, left: float, before: float) -> VBD:
    """Those of the next attempt: twice the sweeps, or plain ones where more with corrections have not helped.

    left, before: unbalanced() of the last two runs.
    """
    if settings.coarse is not None and not is_balanced(left) and left > STALLED * before:
        return replace(settings, subspace="rigid", relaxation=1.0)
    return replace(settings, sweeps=2 * settings.sweeps + 1)


def unreached(settings: VBD, left: float) -> str:
    return f"no reference could be reached: {settings} leaves {percent(left)} of its forces unbalanced"
