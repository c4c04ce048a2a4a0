"""Couplings in a step: their bound about a state as data of the sweeps (couplings.py); and sweeps that renew bounds,
those of patches, too (model/patches.py)."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from .. import ops
from .._common.checks import input_name
from .._common.context import replaced
from ..couplings import load_of
from ..model.system import System
from ..ops.sweep import sweep
from .coarse import in_lanes

COARSE_FIELDS = ("coarse_factor", "coarse_mass", "coarse_plan", "coarse_weights", "coarse_rest")
Record = Callable[[Tensor], Tensor]  # of a state [B, V, 3]: data of the energies [B, n]
Law = Callable[[Tensor], tuple[Tensor, Tensor, Tensor]]  # of a state: mu, lam [B, T], rest scalars [B, T, 7]


def parameters_at(model: System, given: dict[str, Tensor], scenes: int) -> list[dict[str, Tensor]]:
    """The parameters of each coupling by key, [B, ...]; given: as in Prepared."""
    return [
        {key: ops.broadcast(given.get(input_name(energy, key), own[None]), (scenes, *own.shape))
         for key, own in model.constants(energy).items()} for energy in model.couplings
    ]  # fmt: skip


def row_of(model: System, given: dict[str, Tensor], scenes: int) -> Tensor:
    """The parameters of all couplings in one row [B, n]; arguments as of parameters_at()."""
    values = parameters_at(model, given, scenes)
    flat = [value.flatten(1) for own in values for value in own.values()]
    return torch.cat(flat, 1) if flat else model._mass.new_zeros((1, 0))


def record_of(model: System, given: dict[str, Tensor], data: Tensor, origin: Tensor | None, scenes: int) -> Record:
    """The record of a Model's couplings for a step.

    Args:
        given: Parameters of energies, as in Prepared.  data: Of the other energies [1 | B, n], the anchors last.
    """
    data = ops.broadcast(data, (scenes, data.shape[1]))
    return partial(_refreshed, model, parameters_at(model, given, scenes), data, origin)


def _refreshed(model: System, values: list[dict[str, Tensor]], data: Tensor, origin: Tensor | None, x: Tensor
               ) -> Tensor:  # fmt: skip
    load = load_of(model.couplings, values, x if origin is None else x + origin)
    others = data.shape[1] - 4 * model.num_vertices
    stiffness, point = data[:, others:].unflatten(1, (-1, 4)).split((1, 3), -1)
    # two springs of a vertex are one, but for a constant
    total = stiffness + load[..., 3:]
    step = (stiffness * (point - x) - load[..., :3]) / torch.where(total > 0, total, 1.0)
    anchors = torch.cat([total, x + torch.where(total > 0, step, 0.0)], -1)
    return torch.cat([data[:, :others], anchors.flatten(1)], 1)


def sweep_renewed(model: System, renewed: Callable[[Tensor], dict[str, Tensor]], fields: ops.SweepFields,
                  settings: ops.SweepSettings, policy: int, debug_step: int, corrected: Callable[[Tensor], Tensor]
                  ) -> tuple[Tensor, list[Tensor]]:  # fmt: skip
    """Positions after the sweeps and their corrections, each with the fields that are ``renewed`` at the state that it
    begins at; and what the coarse ones did. Free bodies that couplings may pull together are ``corrected`` before each
    sweep but the first."""
    numbers, coarse = settings.numbers, () if fields.coarse_plan is None else settings.coarse
    last = replaced(settings, coarse=(), sweeps=1)
    within = replaced(last, numbers=replaced(numbers, last_relaxation=numbers.relaxation))
    plain = replaced(fields, **dict.fromkeys(COARSE_FIELDS))
    x, corrections = fields.x_start, []

    def run(x: Tensor, fields: ops.SweepFields, settings: ops.SweepSettings) -> Tensor:
        first = x is fields.x_start  # looks at the values that all others have, too
        changes = renewed(x)
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
        corrections.extend([done] if done.numel() else [])
        return end

    def coarsely(x: Tensor) -> Tensor:
        return run(x, fields, replaced(within, sweeps=0, coarse=replaced(coarse, begun=1)))

    for n in range(settings.sweeps):
        if coarse and n and (n - 1) % coarse.every == 0:
            x = coarsely(x)
        x = corrected(x) if n and model.couplings else x
        x = run(x, plain, last if n + 1 == settings.sweeps else within)
    if coarse and settings.sweeps <= 1:
        x = coarsely(x)
    return x, corrections
