# ruff: noqa: F401
"""The compiled operators: the only package that names torch.ops.

Raw operators are private and functional: `raw.NAME`, with shapes for torch.compile in shapes.py. Those that are
differentiable are rows of autograd.Differentiable or autograd.Linear.
"""

from . import coarse as _coarse  # registers what CUDA runs
from . import shapes as _shapes  # registers what torch.compile asks
from .autograd import (
    Differentiable,
    Linear,
    direct,
    distinct,
    fold_scenes,
    folded,
    is_batched,
    no_second_derivative,
    no_transforms,
    not_batched,
    of_inputs,
    one_by_one,
    sum_to,
)
from .fields import (
    COMPACT_TAPE,
    FULL_TAPE,
    LANES,
    NO_TAPE,
    PLAN_HEADER,
    REST_SCALARS,
    STARTS,
    STEP_ADJOINTS,
    SWEEP_ADJOINTS,
    THREAD,
    TOUCHING_ADJOINTS,
    BeginFields,
    CoarseFields,
    CoarseSizes,
    RigidFields,
    StepFields,
    StepNumbers,
    SweepFields,
    SweepSettings,
    TouchingFields,
    as_list,
    corrections_of,
    plan_sizes,
    tape_rows,
    tape_shape,
)
from .laws import bits_of_law, library_of, own_bits
from .load import has_cuda, raw, require_cuda
from .sums import broadcast, star_sum, tet_gather
from .sweep import fused_step, pack_rest, plan_order, run_sweep, sweep, sweep_backward
