"""The compiled operators of sweeps, of whole steps on CUDA, of plans, and of the rise of potentials."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from .._common.context import replaced
from .fields import (
    FULL_TAPE,
    NO_TAPE,
    PLAN_HEADER,
    STEP_ADJOINTS,
    SWEEP_ADJOINTS,
    StepFields,
    SweepFields,
    SweepSettings,
    as_list,
)
from .load import direct as raw


def build_plan(
    points: Tensor, tets: Tensor, active: Tensor, lanes: int
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Plan, color_ptr, color_vertices, star_ptr and star of a mesh, see csrc/cpu/plan.h; lanes: of :data:`LANES`."""
    return raw.build_plan(points, tets, active, lanes)


def plan_order(plan: Tensor, lanes: int) -> Tensor:
    """The vertex at each position of the sweep order [blocks lanes], -1: none; see csrc/core/plan_views.h."""
    colors, blocks = plan[3:5].tolist()
    return plan.narrow(0, PLAN_HEADER + colors + 1 + 4 * (blocks + 1), blocks * lanes).cpu()


def pack_rest(rest: Tensor, plan: Tensor, sizes: tuple[int, ...]) -> Tensor:
    """Rest scalars of the tets [B, T, 7] -> as their vertices see them [B, slots, 4, lanes]. Not differentiable."""
    return raw.pack_rest(rest.contiguous(), plan, sizes)


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


def sweep_backward(x_bar: Tensor, x: Tensor, tape: Tensor, corrections: Tensor, limits: Tensor, fields: SweepFields,
                   packed_rest: Tensor, plan: Tensor, settings: SweepSettings, tape_policy: int, wants: dict[str, bool]
                   ) -> dict[str, Tensor]:  # fmt: skip
    """Adjoints of the fields by name; an empty tape: the sweeps run again. ``wants``: of SWEEP_ADJOINTS."""
    given = listed(fields, packed_rest, plan, settings)
    if tape_policy == NO_TAPE:
        tape_policy = FULL_TAPE
        x, tape, limits, corrections = raw.sweep(*given, plan, *settings, tape_policy, -1, False)
    material = wants["mu"] or wants["lam"] or wants["corners_prev"]
    flags = [material, wants["mass"], wants["rest"], wants["energy_data"], wants["coarse_factor"]]
    bars = raw.sweep_backward(
        *given, x_bar.contiguous(), x, tape, corrections, limits, plan, *settings, tape_policy, flags
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


def potential_increase(fields: SweepFields, x: Tensor, to: Tensor, material: Tensor, rest: Tensor,
                       index: Sequence[Tensor], data_count: Sequence[int], time_step: float) -> Tensor:  # fmt: skip
    """By how much the potential of each body rises from x to ``to`` [kg m^2, times h^2], and the sum of the sizes of
    its terms, float64 [B, bodies, 2]; infinite where a vertex would lose more of a gap than a step may.

    Args:
        fields: Of the step; where its sweeps start does not enter.
        x, to: Positions [m], [B, V, 3].
        material, rest: [1 | B, blocks, 2 | 7, 8], of the tets by body.
        index: order, ptr, of the OtherBodies (of no meaning here), corner and block_ptr of MovingBodies, int32.
    """
    absent = x.new_empty((0,))
    origin = absent if fields.origin is None else fields.origin
    return raw.potential_increase(x, to, fields.x_prev, fields.y, fields.mass, fields.energy_data, origin, material,
                                  rest, *index, list(data_count), time_step)  # fmt: skip
