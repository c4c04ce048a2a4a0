"""What the operators take besides tensors: sizes, settings and policies, with their twins in C++."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from torch import Tensor

from ..mask import KEEPS_POSITIONS

NO_TAPE, COMPACT_TAPE, FULL_TAPE = 0, 1, 2
REST_SCALARS = 7  # k01 k02 k03 k12 k13 k23 c6 of a tet
LANES = {"cpu": 8, "cuda": 32}  # vertices of a block of the plan; twins of kLanes and kSlice in csrc/core/views.h
THREAD = 1  # the regime whose tape has scenes last; twin of kThread in csrc/cuda/step.h
PLAN_HEADER = 11  # twin of kPlanHeader in csrc/core/plan_views.h


class SweepSettings(NamedTuple):
    """What a sweep executes besides its tensors, in the order of csrc/bind/schema.cpp."""

    sizes: tuple[int, ...]  # active vertices, tets, slots of the plan; more on CUDA, see plan_sizes
    energies: int  # mask
    data_count: tuple[int, ...]  # scalars per scene, or per vertex, of each energy of one vertex
    # time_step, regularization, relaxation, saturation, saturation_eps, filter_eta, relaxation of the last sweep
    numbers: tuple[float, ...]
    sweeps: int
    launch: tuple[int, ...] = ()  # on CUDA: regime and threads per vertex of sweeps and reverse, see regimes.py


def plan_sizes(plan: Tensor, device: str) -> tuple[int, ...]:
    """What the host must know of a plan that is still on the CPU; the order is that of csrc/bind/cuda/sweep.cpp."""
    header = plan[:PLAN_HEADER].tolist()
    vertices, tets, active, colors, blocks, slots, *rest = header
    if device == "cpu":
        return active, tets, slots
    return (
        active,
        tets,
        slots,
        vertices,
        colors,
        blocks,
        *rest,
        *plan[PLAN_HEADER : PLAN_HEADER + colors + 1].tolist(),
    )


def tape_rows(policy: int, energies: int) -> int:
    """Scalars of tape per active vertex and sweep; twin of tape_rows in csrc/core/views.h."""
    return {NO_TAPE: 0, COMPACT_TAPE: 3, FULL_TAPE: 12 if energies & KEEPS_POSITIONS else 9}[policy]


def tape_shape(x: Tensor, sizes: Sequence[int], energies: int, sweeps: int, launch: Sequence[int], policy: int) -> list:
    """Scenes first, but last where each thread has a scene: who mixes up the two is told so by the shape."""
    shape = [sweeps, tape_rows(policy, energies), sizes[0]]
    return [*shape, x.shape[0]] if tuple(launch[:1]) == (THREAD,) else [x.shape[0], *shape]
