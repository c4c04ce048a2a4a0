"""The compiled operators: the only room that names torch.ops.

Raw operators are private and functional: `raw.NAME`, with shapes for torch.compile beside each. Those that are
differentiable are autograd.Functions in the form that also serves torch.func and torch.compile, in the rooms that use
them; the fixed-order sums, which everybody uses, are here.
"""

from .fields import (
    COMPACT_TAPE,
    FULL_TAPE,
    LANES,
    NO_TAPE,
    PLAN_HEADER,
    REST_SCALARS,
    STEP_ADJOINTS,
    SWEEP_ADJOINTS,
    TET_READS_X_PREV,
    THREAD,
    BeginFields,
    CoarseFields,
    RigidFields,
    StepFields,
    StepNumbers,
    SweepFields,
    SweepSettings,
    as_list,
    plan_sizes,
    tape_rows,
    tape_shape,
)
from .functions import (
    distinct,
    fold_scenes,
    no_second_derivative,
    no_transforms,
    not_batched,
    of_inputs,
    one_by_one,
    raw_backward,
    ready_signature,
)
from .load import has_cuda, raw, require_cuda
from .mesh import PAIR_REST, build_plan, pack_rest, plan_order
from .sums import broadcast, star_sum, sum_to, tet_gather
from .sweep import fused_step, fused_step_backward, sweep, sweep_backward

__all__ = [
    "COMPACT_TAPE",
    "FULL_TAPE",
    "LANES",
    "NO_TAPE",
    "PAIR_REST",
    "PLAN_HEADER",
    "REST_SCALARS",
    "TET_READS_X_PREV",
    "STEP_ADJOINTS",
    "SWEEP_ADJOINTS",
    "THREAD",
    "BeginFields",
    "CoarseFields",
    "RigidFields",
    "StepFields",
    "StepNumbers",
    "SweepFields",
    "SweepSettings",
    "as_list",
    "broadcast",
    "build_plan",
    "distinct",
    "fold_scenes",
    "fused_step",
    "fused_step_backward",
    "has_cuda",
    "no_second_derivative",
    "no_transforms",
    "not_batched",
    "of_inputs",
    "one_by_one",
    "pack_rest",
    "plan_order",
    "plan_sizes",
    "raw",
    "raw_backward",
    "ready_signature",
    "require_cuda",
    "star_sum",
    "sum_to",
    "sweep",
    "sweep_backward",
    "tape_rows",
    "tape_shape",
    "tet_gather",
]
