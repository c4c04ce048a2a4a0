"""The arrays of a plan of a coarse space (model.coarse_plan), which is one tensor to the operators."""

from __future__ import annotations

from torch import Tensor

from .fields import LANES, CoarseSizes

ROW = 4  # scalars of a row of positions; twin of kRow in csrc/core/views.h
PACK = LANES["cpu"]  # tets of a block, on every device; twin of kLanes


def lengths(s: CoarseSizes) -> dict[str, int]:
    """Of the arrays in their order; twin of view_plan() in csrc/coarse/views.h."""
    return {
        "function_ptr": s.bodies + 1, "mass_ptr": s.bodies + 1, "function_body": s.functions,
        "position_body": s.positions, "position_ptr": s.positions + 1, "function": s.entries,
        "row_ptr": s.functions + 1, "row": s.entries, "block_ptr": s.bodies + 1, "part_ptr": s.bodies + 1,
        "part_body": s.parts, "part_begin": s.parts + 1, "corner": 4 * s.tet_blocks * PACK,
        "tet": s.tet_blocks * PACK, "group_ptr": s.bodies + 1, "group_body": s.groups,
        "group_function": s.groups * s.width, "place_ptr": s.groups, "place": s.places, "tet_ptr": s.groups + 1,
        "moment_ptr": s.groups + 1, "moment_vertex": s.moments, "moment_group": s.moments,
        "vertex_ptr": s.vertices + 1, "vertex_moment": s.moments, "list_ptr": s.bodies + 1, "list": s.listed,
        "list_position": s.listed,
    }  # fmt: skip


def views(sizes: CoarseSizes, plan: Tensor) -> dict[str, Tensor]:
    """The arrays of a plan by their names, int64 and flat."""
    own = lengths(sizes)
    return dict(zip(own, plan.long().split(list(own.values())), strict=True))
