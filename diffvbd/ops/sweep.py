"""The compiled operators of sweeps, and of whole steps on CUDA: calls, and shapes without execution."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from ..mask import CONTACT
from ..tuples import replaced
from .fields import (
    FULL_TAPE,
    NO_TAPE,
    REST_SCALARS,
    STEP_ADJOINTS,
    SWEEP_ADJOINTS,
    TET_READS_X_PREV,
    StepFields,
    SweepFields,
    SweepSettings,
    as_list,
    corrections_shape,
    tape_shape,
)
from .functions import raw_backward, shapes_of
from .load import raw
from .mesh import pack_rest

LAG_SCALARS = 9  # twin of kLagScalars in csrc/contact/pairs.h


def listed(fields: SweepFields | StepFields, packed_rest: Tensor, plan: Tensor, settings: SweepSettings
           ) -> list[Tensor]:  # fmt: skip
    """Fields as the operators take them, with the rest shape packed."""
    rest = packed_rest if fields.rest is None else pack_rest(fields.rest, plan, settings.sizes)
    return as_list(replaced(fields, rest=rest), fields.mass)


def sweep(fields: SweepFields, packed_rest: Tensor, plan: Tensor, settings: SweepSettings, tape_policy: int,
          debug_step: int = -1, checked: bool = False) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
    """x [B, V, 3], tape, with contact the exponents of limits, uint8 [B, K, V], and what coarse corrections did."""
    given = listed(fields, packed_rest, plan, settings)
    return raw.sweep(*given, plan, *settings, tape_policy, debug_step, checked)


def sweep_backward(x_bar: Tensor, x: Tensor, tape: Tensor, corrections: Tensor, cut: Tensor, fields: SweepFields,
                   packed_rest: Tensor, plan: Tensor, settings: SweepSettings, tape_policy: int,
                   wants: dict[str, bool]) -> dict[str, Tensor]:  # fmt: skip
    """Adjoints of the fields by name; an empty tape: the sweeps run again. ``wants``: of SWEEP_ADJOINTS."""
    given = listed(fields, packed_rest, plan, settings)
    if tape_policy == NO_TAPE:
        tape_policy = FULL_TAPE
        x, tape, cut, corrections = raw.sweep(*given, plan, *settings, tape_policy, -1, False)
    material = wants["mu"] or wants["lam"] or wants["corners_prev"]
    flags = [material, wants["mass"], wants["rest"], wants["energy_data"], wants["coarse_factor"]]
    bars = raw.sweep_backward(
        *given, x_bar.contiguous(), x, tape, corrections, cut, plan, *settings, tape_policy, flags
    )
    return dict(zip(SWEEP_ADJOINTS, bars, strict=True))


def fused_step(fields: StepFields, packed_rest: Tensor, plan: Tensor, settings: SweepSettings, tape_policy: int
               ) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """x, v [B, V, 3] and tape of a step on CUDA whose only energy is that of the tets."""
    return raw.fused_step(*listed(fields, packed_rest, plan, settings), plan, *settings, tape_policy)


def fused_step_backward(x_bar: Tensor | None, v_bar: Tensor | None, x: Tensor, tape: Tensor, fields: StepFields,
                        packed_rest: Tensor, plan: Tensor, settings: SweepSettings, tape_policy: int,
                        wants: dict[str, bool]) -> dict[str, Tensor]:  # fmt: skip
    """As sweep_backward, of STEP_ADJOINTS."""
    given = listed(fields, packed_rest, plan, settings)
    if tape_policy == NO_TAPE:
        tape_policy = FULL_TAPE
        x, _, tape = raw.fused_step(*given, plan, *settings, tape_policy)
    out = [fields.x.new_empty((0,)) if bar is None else bar.contiguous() for bar in (x_bar, v_bar)]
    flags = [wants[name] for name in ("x", "v", "acceleration", "prescribed")]
    flags += [wants["mu"] or wants["lam"], wants["mass"], wants["rest"]]
    bars = raw.fused_step_backward(*given, *out, x, tape, plan, *settings, tape_policy, flags)
    return dict(zip(STEP_ADJOINTS, bars, strict=True))


_FIELDS, _STEP_FIELDS = len(SweepFields._fields), len(StepFields._fields)


@shapes_of("sweep")
def _(*arguments):
    f: Any = SweepFields(*arguments[:_FIELDS])
    _, sizes, energies, _, _, sweeps, launch, coarse, tape_policy, *_ = arguments[_FIELDS:]
    x, scenes = f.x_start, f.x_start.shape[0] if energies & CONTACT else 0
    tape = x.new_empty(tape_shape(x, sizes, energies, sweeps, launch, tape_policy))
    done = corrections_shape(x, coarse, sweeps, energies) if f.coarse_plan.numel() else (0,)
    cut = (scenes, sweeps, x.shape[1])
    return torch.empty_like(x), tape, x.new_empty(cut, dtype=torch.uint8), x.new_empty(done)


def _body_adjoints(x: Tensor, f: Any, num_tets: int, wants: Sequence[bool]) -> list[Tensor]:
    """Empty adjoints of mu, lam, mass, rest. CUDA sums the material that a scene shares."""
    shares = f.mu.is_cuda and f.mu.shape[-1] == 1 and f.lam.shape[-1] == 1 and not TET_READS_X_PREV
    b, v = x.shape[:2]
    materials = (b, 1 if shares else num_tets)
    shapes = (materials, materials, (b, v), (b, num_tets, REST_SCALARS))
    return [x.new_empty(shape if flag else (0,)) for shape, flag in zip(shapes, (wants[0], *wants), strict=True)]


@shapes_of("sweep_backward")
def _(*arguments):
    f: Any = SweepFields(*arguments[:_FIELDS])
    _, x, _, _, _, _, sizes, energies, *_, wants = arguments[_FIELDS:]
    b, v = x.shape[:2]
    own = [*(torch.empty_like(x) for _ in range(3)), *_body_adjoints(x, f, sizes[1], wants[:3])]
    own.append(x.new_empty((b, f.energy_data.shape[-1]) if wants[3] else (0,)))
    last = (x.new_empty(f.corners_prev.shape if wants[0] else (0,)),
            x.new_empty(f.coarse_factor.shape if wants[4] else (0,)))  # fmt: skip
    if not energies & CONTACT:
        return (*own, *(x.new_empty((0,)) for _ in range(len(SWEEP_ADJOINTS) - len(own) - len(last))), *last)
    colliders = f.collider.shape[1] if f.collider.dim() == 3 else 0
    planes = f.floor_lag.numel() // max(1, f.floor_lag.shape[0] * 4 * v)
    shapes = [(b, colliders, 3), (b, colliders, 3), (b,), (f.lag_pairs.shape[0], LAG_SCALARS),
              (b, v, planes, 4)]  # fmt: skip
    return (*own, *(x.new_empty(shape) for shape in shapes), *last)


@shapes_of("fused_step")
def _(*arguments):
    x, (_, sizes, energies, _, _, sweeps, launch, _, tape_policy) = arguments[0], arguments[_STEP_FIELDS:]
    tape = x.new_empty(tape_shape(x, sizes, energies, sweeps, launch, tape_policy))
    return torch.empty_like(x), torch.empty_like(x), tape


@shapes_of("fused_step_backward")
def _(*arguments):
    f = StepFields(*arguments[:_STEP_FIELDS])
    _, _, _, _, _, sizes, *_, wants = arguments[_STEP_FIELDS:]
    state = [f.x.new_empty(f.x.shape if flag else (0,)) for flag in wants[:4]]
    return (*state, *_body_adjoints(f.x, f, sizes[1], wants[4:]))


for _name in ("sweep", "sweep_backward", "fused_step", "fused_step_backward"):
    torch.library.register_autograd(f"diffvbd::{_name}", raw_backward)
