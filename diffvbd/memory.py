"""Predicted bytes of steps and rollouts, from the same constants that the kernels use."""

from __future__ import annotations

import math
from typing import Any

from . import ops
from .adjoints import ReverseSweep
from .checks import check_count
from .model import Model
from .schedule import Binomial, choose_schedule

LANES = 8  # kLanes of csrc/core/views.h


def predict(
    model: Model,
    *,
    sweeps: int,
    steps: int = 1,
    scenes: int = 1,
    tape: str = "auto",
    checkpoint_every: Any = "auto",
    save: Any = "last",
    material: bool = True,
    rest: bool = False,
) -> dict[str, int]:
    """Bytes that a differentiated rollout keeps and works with (default arguments otherwise, no force).

    Args:
        sweeps, steps, scenes: K, number of steps, product of x's leading dimensions.
        tape, checkpoint_every, save: As in ReverseSweep and rollout.
        material, rest: Whether material and rest-shape gradients are wanted (they take scratch in the backward).

    Returns:
        A dict of bytes:
            model: index data and rest scalars of the Model;
            tape: of one step, scenes x sweeps x active vertices x 72 (full), 24 (compact) or 0 bytes in float64;
            step: what one step keeps for its backward, tape included;
            kept: the largest amount kept at once: all steps without checkpoints; states plus the steps of one segment
                with checkpoints every n; states plus one step with Binomial;
            scratch: of one backward step;
            total: kept + scratch.
    """
    item = model.mass.element_size()
    steps, scenes = check_count("steps", steps), check_count("scenes", scenes)
    schedule, adjoint = choose_schedule(checkpoint_every, ReverseSweep(tape), model, scenes, steps, sweeps)  # type: ignore[arg-type]
    scalars = scenes * sweeps * model.num_active
    policy = adjoint.policy(scalars, item, model.energy_mask)
    tape_bytes = scalars * ops.tape_rows(policy, model.energy_mask) * item
    state = scenes * model.num_vertices * 3 * item
    # y and x of each step; a floor adds the filtered start, the wanted step and the filter's own intermediates
    per_step = 2 * state + tape_bytes
    if model.floor is not None:
        per_step += 2 * state + scenes * model.num_vertices * model.floor.planes * (4 * item + 2)
    if schedule is None:
        kept = steps * per_step
    elif isinstance(schedule, Binomial):
        kept = 2 * state * min(schedule.snapshots + 1, steps) + per_step
    else:
        kept = 2 * state * math.ceil(steps / schedule) + min(schedule, steps) * per_step
    frames = {"last": 1, "all": steps + 1}.get(save) or steps // save + 2
    kept += 2 * state * frames

    slots = model._sizes[2] * LANES
    columns = 4 + (2 if material or rest else 0) + (4 if rest else 0)
    scratch = scenes * (slots * columns + model.num_vertices * 20) * item
    if policy == ops.NO_TAPE:
        scratch += scalars * ops.tape_rows(ops.FULL_TAPE, model.energy_mask) * item
    tensors = [t for t in vars(model).values() if hasattr(t, "element_size")] + list(model._topology)
    return {
        "model": sum(t.numel() * t.element_size() for t in tensors),
        "tape": tape_bytes,
        "step": per_step,
        "kept": kept,
        "scratch": scratch,
        "total": kept + scratch,
    }
