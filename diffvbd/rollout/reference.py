"""When a run may be called a reference: once its steps leave no force over that is worth speaking of."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import torch

from ..energies import StableNeoHookean
from ..model.model import Model
from ..said import percent
from ..step.balance import UNBALANCED, left_of_solve, share
from .settings import Settings

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


def takes_corrections(model: Model) -> bool:
    """Whether coarse corrections are defined."""
    elastic = next((e for e in model.energies if isinstance(e, StableNeoHookean)), None)
    return elastic is not None and elastic.block == "exact" and model.saturation is None


def with_other_sweeps(model: Model) -> Model:
    """With plain sweeps in place of corrections, or with corrections, where they are cheap, in place of plain ones."""
    if model.coarse is None and (model.touches or not takes_corrections(model)):
        return model
    coarse = "auto" if model.coarse is None else None
    return Settings(1.0, 1, coarse=coarse).applied(model)


def with_more_sweeps(settings: Settings, left: float, before: float) -> Settings:
    """Those of the next attempt: twice the sweeps, or plain ones where more with corrections have not helped.

    left, before: unbalanced() of the last two runs.
    """
    if settings.coarse is not None and not is_balanced(left) and left > STALLED * before:
        return replace(settings, coarse=None, relaxation=1.0)
    return replace(settings, sweeps=2 * settings.sweeps + 1)


def unreached(settings: Settings, left: float) -> str:
    return f"no reference could be reached: {settings} leaves {percent(left)} of its forces unbalanced"
