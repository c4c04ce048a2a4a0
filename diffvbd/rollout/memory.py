"""Predicted bytes of steps and rollouts, from the same constants that the kernels use."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from .. import ops
from ..adjoint.routes import TapedSweep
from ..checks import check_bool, check_count, is_word
from ..mask import KEEPS_POSITIONS
from ..model.integrators import BDF2
from ..model.model import Model
from ..model.solver import VBD
from ..model.system import System, system_of
from ..step.contact_cycles import sweeps_of_parts
from ..step.integrators import solves_of
from ..step.memory import cuda_scratch
from .checkpoints import BinomialCheckpoints, _left, choose_schedule


def memory(
    model: Model,
    solver: VBD,
    *,
    steps: int = 1,
    scenes: int = 1,
    checkpoint_every: Any = "auto",
    save: Any = "last",
    material: bool = True,
    rest: bool = False,
) -> dict[str, int]:
    """Bytes that a differentiated rollout keeps and works with (default arguments otherwise, no force). The lists of
    contact are not counted: about 0.2 KB for each pair, step and detection, and 1 KB in the backward of one step. Nor
    are the sweeps that a step takes beyond its K where pairs hold bodies up (docs/contact.md).

    Args:
        model, solver: As in rollout.
        steps, scenes: Number of steps, product of x's leading dimensions.
        checkpoint_every, save: As in rollout.
        material, rest: Whether material and rest-shape gradients are wanted (they take scratch in the backward).

    Returns:
        A dict of bytes:
            model: index data and rest scalars of the Model;
            tape: of one step, scenes x sweeps x active vertices x 72 (full), 24 (compact) or 0 bytes in float64
                (104 and 32 with a floor);
            step: what one step keeps for its backward beside the state it starts from, tape included;
            kept: the largest amount kept at once: all steps without checkpoints; states plus the steps of one segment
                with checkpoints every n; states plus one step with BinomialCheckpoints. The state of the random number
                generator, 5 kB, is kept with every checkpoint (with BinomialCheckpoints: with every step). ``rest``
                adds the graph of the rest metric, once (297 B per tet), for rest_points that the scenes share.
                BinomialCheckpoints with frames saved: an upper estimate;
            scratch: of one backward step, in scenes that run side by side on as many threads;
            total: kept + scratch.

    Raises:
        ValueError, TypeError: For what rollout would refuse; it names the argument.
    """
    model, sweeps, scheme = system_of(model, solver), solver.sweeps, solver.integrator
    item = model._mass.element_size()
    steps, scenes = check_count("steps", steps), check_count("scenes", scenes)
    for name, asked in (("material", material), ("rest", rest)):
        check_bool(name, asked)
    solves = solves_of(scheme)
    schedule, adjoint = choose_schedule(
        checkpoint_every, TapedSweep(solver.tape), model, scenes, steps, solves * sweeps
    )
    assert isinstance(adjoint, TapedSweep)
    scalars = scenes * sweeps * model.num_active
    policy = adjoint.policy(scalars, item, model.energy_mask, model.device)
    tape_bytes = scalars * ops.tape_rows(policy, model.energy_mask) * item
    state = scenes * model.num_vertices * 3 * item
    local = model.dtype == torch.float32  # positions about an origin, which the result does not share
    # where the sweeps start, the predictor and where the sweeps end; about an origin that, and where the step started
    per_step = (5 if local else 3) * state + tape_bytes
    per_step += scenes * sum(model._data_count) * item if local else 0
    per_step += scenes * coarse_scalars(model, sweeps) * item
    per_step = solves * per_step + (2 * state if isinstance(scheme, BDF2) else 0)
    # of the state before a step, which a step alone is given: v, and x where the sweeps before did not end at it
    between = state * (2 if model.corrects and not local else 1)
    if is_word(save, "all", "last"):
        frames = steps + 1 if save == "all" else 1
    else:
        frames = steps // check_count("save", save, 1) + 2
    generator = torch.get_rng_state().numel()
    if schedule is None:
        kept = steps * per_step + max(0, steps - 1) * between
    elif isinstance(schedule, BinomialCheckpoints):
        kept = 2 * state * min(schedule.snapshots + 1, steps) + per_step + max(0, steps - 1) * generator
        # A part that runs again saves its frames again, inside parts that have done so.
        part = steps if frames > 1 else 1
        while part > 1:
            part = _left(part, schedule.snapshots)
            kept += 2 * state * (part * frames // (steps + 1))
    else:
        segments = math.ceil(steps / schedule)
        kept = segments * (2 * state + generator)
        kept += min(schedule, steps) * per_step + max(0, min(schedule, steps) - 1) * between
    kept += 2 * state * frames
    if rest:
        kept += (37 * model.num_tets + model.num_vertices) * item

    # what the transposed sweeps return, and what the correction before them has
    outputs = (19 if model.corrects else 12) * model.num_vertices + model.num_tets * (
        (2 if material else 0) + (7 if rest else 0)
    )
    if model.device.type == "cuda":
        scratch = cuda_scratch(model, scenes, reverse=True, material=material, rest=rest) + outputs * scenes * item
    else:
        scratch = _cpu_scratch(model, scenes, material, rest) + outputs * scenes * item
    if model.coarse is not None:
        plan = model._coarse_plan
        stiffness = plan.sizes.groups * (3 * plan.sizes.width) ** 2
        # once for all steps: what the matrices are made of, and, where a material meets it, the rest shape
        kept += (stiffness + (13 * model.num_tets if material else 0)) * item
        scratch += scenes * (10 * plan.mass.numel() + stiffness) * item
    if policy == ops.NO_TAPE:
        scratch += scalars * ops.tape_rows(ops.FULL_TAPE, model.energy_mask) * item
    parts = (vars(model).values(), model._topology, model._bodies, model._other_bodies)
    parts += () if model.coarse is None else (model._coarse_plan,)
    tensors = [t for part in parts for t in part if isinstance(t, Tensor)]
    return {
        "model": sum(t.numel() * t.element_size() for t in tensors),
        "tape": tape_bytes,
        "step": per_step,
        "kept": kept,
        "scratch": scratch,
        "total": kept + scratch,
    }


def coarse_scalars(model: System, sweeps: int) -> int:
    """Scalars that the coarse corrections of a step keep for its backward, for each scene: the matrices or
    their factors, and what each correction has done; with a floor also where it began."""
    if model.coarse is None or not model.coarse_geometry.bodies:
        return 0
    geometry, plan = model.coarse_geometry, model._coarse_plan
    if model.touches:  # all bodies together: the factor of each correction, its forces and ways
        count = sum(-(-max(0, n - 1) // model.coarse.every) for n in _parts(model, sweeps))
        return 9 * plan.mass.numel() + count * (9 * geometry.functions**2 + 12 * model.num_vertices)
    positions = 3 * plan.sizes.positions if model.energy_mask & KEEPS_POSITIONS else 0
    of_one = 3 * geometry.functions + geometry.bodies + positions
    return 9 * plan.mass.numel() + model.coarse.corrections(sweeps) * of_one


def _parts(model: System, sweeps: int) -> list[int]:
    """Sweeps of each part of a step: one for each detection of pairs. More parts have fewer cycles, and need less."""
    return sweeps_of_parts(sweeps, 1 if model.contact is None else model.contact.detections or 1)


def _cpu_scratch(model: System, scenes: int, material: bool, rest: bool) -> int:
    blocks, slots, edge_slots = (ops.LANES["cpu"] * n for n in model._plan[4:7].tolist())
    # packed state and its adjoints, rows along edges, one row per (vertex, tet) pair of what is differentiated
    work = blocks * (22 if model.floor else 16) + 4 * edge_slots
    work += slots * ((2 if material or rest else 0) + (4 if rest else 0))
    threads = torch.get_num_threads()
    return work * (threads if scenes >= threads else 1) * model._mass.element_size()
