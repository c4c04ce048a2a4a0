"""Sweeps that begin with bounds about their own start: of couplings (couplings.py) and patches (model/patches.py)."""

from __future__ import annotations

import torch
from torch import Tensor

from .. import ops
from .._common.context import replaced
from ..adjoint.potential import increase_inputs
from ..model.system import System
from ..ops.sweep import sweep
from .arguments import Prepared
from .coarse import COARSE_FIELDS, in_lanes
from .coupled_coarse import corrected as corrected_coarsely
from .predict import Begun


def sweep_renewed(model: System, begun: Begun, prepared: Prepared, fields: ops.SweepFields, policy: int,
                  debug_step: int) -> tuple[Tensor, list[Tensor]]:  # fmt: skip
    """Positions after the sweeps and their corrections, each with fields that are renewed at the state that it begins
    at; and what the coarse ones did. Free bodies that couplings may pull together, and that no coarse correction moves,
    are corrected before each sweep but the first."""
    settings = prepared.settings
    numbers, coarse = settings.numbers, () if fields.coarse_plan is None else settings.coarse
    last = replaced(settings, coarse=(), sweeps=1)
    within = replaced(last, numbers=replaced(numbers, last_relaxation=numbers.relaxation))
    plain = replaced(fields, **dict.fromkeys(COARSE_FIELDS))
    x, corrections = begun.x_start, []
    inputs = None
    if coarse and begun.coupled is not None:
        others = replaced(begun.fields(model, prepared), energy_data=begun.coupled.data)
        inputs = increase_inputs(model, others, numbers.time_step, prepared.averaged, settings.energies)

    def run(x: Tensor, fields: ops.SweepFields, settings: ops.SweepSettings, changes: dict[str, Tensor]
            ) -> tuple[Tensor, Tensor]:  # fmt: skip
        first = x is begun.x_start  # looks at the values that all others have, too
        if fields.coarse_rest is not None and "rest" in changes:
            changes["coarse_rest"] = in_lanes(model, changes["rest"])
        now = replaced(fields, x_start=x, **changes)
        if first and "mu" in changes and not x.is_cuda:  # of a bound moduli may be negative, the given ones may not
            data = changes.get("energy_data", fields.energy_data)
            with torch.no_grad():
                sweep(replaced(plain, x_start=x, energy_data=data), model._packed_rest, model._plan,
                      replaced(last, sweeps=0), tape_policy=ops.NO_TAPE, debug_step=debug_step)  # fmt: skip
            first = False
        end, _, done = sweep(now, model._packed_rest, model._plan, settings, tape_policy=policy, debug_step=debug_step,
                             checked=first)  # fmt: skip
        return end, done

    def coarsely(x: Tensor) -> Tensor:
        now = replaced(within, sweeps=0, coarse=replaced(coarse, begun=1))
        if begun.coupled is None or inputs is None:
            x, done = run(x, fields, now, begun.renewed(x))
        else:
            law = begun.renewed_law(x)
            x, done = corrected_coarsely(model, begun.coupled, inputs, fields, x, lambda x, f: run(x, f, now, law))
        corrections.extend([done] if done.numel() else [])
        return x

    for n in range(settings.sweeps):
        if coarse and n and (n - 1) % coarse.every == 0:
            x = coarsely(x)
        x = begun.corrected(x, model, prepared) if n and model.corrects_each_sweep else x
        x, _ = run(x, plain, last if n + 1 == settings.sweeps else within, begun.renewed(x))
    if coarse and settings.sweeps <= 1:
        x = coarsely(x)
    return x, corrections
