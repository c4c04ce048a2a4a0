"""Predicted bytes of steps and rollouts, from the same constants that the kernels use."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint, set_checkpoint_early_stop

from .. import ops
from .._common.checks import check_bool, check_count, check_save, fail, names_checked
from .._common.constants import KEEPS_POSITIONS
from .._common.context import MorePairs, Scope, in_segment, segment, transformed
from ..adjoint.routes import Adjoint, TapedSweep, Unrolled
from ..model.model import Model
from ..model.solver import BDF2, VBD
from ..model.system import System, system_of
from ..step.advance import cuda_scratch
from ..step.contact import sweeps_of_substeps
from ..step.integrators import solves_of


@names_checked("dv.memory")
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
    are the sweeps that a step takes beyond its K where pairs truncate motions (docs/contact.md).

    Args:
        model, solver: As in rollout.
        steps, scenes: Number of steps, product of x's leading dimensions.
        checkpoint_every, save: As in rollout.
        material, rest: Whether material and rest-shape gradients are wanted (they take scratch in the backward).

    Returns:
        A dict of bytes. ``"model"``: index data and rest scalars of the Model. ``"tape"``: of one step, scenes x sweeps
        x active vertices x 72 (full), 24 (compact) or 0 bytes in float64 (104 and 32 with a floor). ``"step"``: what
        one step keeps for its backward with the state it starts from, tape included. ``"kept"``: the largest amount
        kept at once: all steps without checkpoints; states plus the steps of one segment with checkpoints every n;
        states plus one step with BinomialCheckpoints, there an upper estimate if frames are saved. It counts the state
        of the random number generator (5 kB) with every checkpoint. ``rest`` adds the graph of the rest metric, once
        (297 B per tet), for rest_points that the scenes share. ``"scratch"``: of one backward step, in scenes that run
        side by side on as many threads. ``"total"``: kept + scratch.

    Raises:
        ValueError, TypeError: For what rollout would refuse; it names the argument.
    """
    model, sweeps, scheme = system_of(model, solver), solver.sweeps, solver.integrator
    item = model._mass.element_size()
    steps, scenes = check_count("steps", steps), check_count("scenes", scenes)
    for name, asked in (("material", material), ("rest", rest)):
        check_bool(name, asked)
    solves = solves_of(scheme)
    schedule, adjoint = choose_schedule(checkpoint_every, TapedSweep(solver.tape), model, scenes, steps,
                                        solves * sweeps)  # fmt: skip
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
    if model.couplings:  # each sweep has its own start and record, and free bodies may have a correction of their own
        per_step += scenes * sweeps * (23 if model.corrects_each_sweep else 12) * model.num_vertices * item
    per_step += scenes * corrections_between(model, sweeps) * item
    if model.patches is not None:  # each sweep has its own start and law
        per_step += scenes * sweeps * (9 * model.num_tets + 3 * model.num_vertices) * item
    per_step = solves * per_step + (2 * state if isinstance(scheme, BDF2) else 0)
    # of the state before a step, which a step alone is given: v, and x where the sweeps before did not end at it
    between = state * (2 if model.corrects and not local else 1)
    save = check_save(save)
    frames = {"all": steps + 1, "last": 1}[save] if isinstance(save, str) else steps // save + 2
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
    outputs = (19 if model.corrects else 12) * model.num_vertices + (2 * material + 7 * rest) * model.num_tets
    scratch = outputs * scenes * item
    if model.device.type == "cuda":
        scratch += cuda_scratch(model, scenes, reverse=True, material=material, rest=rest)
    else:
        scratch += _cpu_scratch(model, scenes, material, rest)
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
    parts += () if model.patches is None else ((model.patches.label,), *model.patches[1:])
    tensors = [t for part in parts for t in part if isinstance(t, Tensor)]
    return {"model": sum(t.numel() * t.element_size() for t in tensors), "tape": tape_bytes, "step": per_step,
            "kept": kept, "scratch": scratch, "total": kept + scratch}  # fmt: skip


def coarse_scalars(model: System, sweeps: int) -> int:
    """Scalars that the coarse corrections of a step keep for its backward, for each scene: the matrices or
    their factors, and what each correction has done; with a floor also where it began."""
    if model.coarse is None or not model.coarse_geometry.bodies:
        return 0
    geometry, plan = model.coarse_geometry, model._coarse_plan
    if model.touches:  # all bodies together: the factor of each correction, its forces and ways
        # one part for each detection of pairs: more parts have fewer cycles, and need less
        parts = sweeps_of_substeps(sweeps, 1 if model.contact is None else model.contact.detections or 1)
        count = sum(-(-max(0, n - 1) // model.coarse.every) for n in parts)
        return 9 * plan.mass.numel() + count * (9 * geometry.functions**2 + 12 * model.num_vertices)
    positions = 3 * plan.sizes.positions if model.energy_mask & KEEPS_POSITIONS else 0
    of_one = 3 * geometry.functions + geometry.bodies + positions
    if model.couplings:  # matrices of their own, and what those are made of
        vectors = sum(energy.differences()[0][..., 0].size for energy in model.couplings)
        of_one += 18 * plan.mass.numel() + 15 * vectors * plan.sizes.most
    return 9 * plan.mass.numel() + model.coarse.corrections(sweeps) * of_one


def _cpu_scratch(model: System, scenes: int, material: bool, rest: bool) -> int:
    blocks, slots, edge_slots = (ops.LANES["cpu"] * n for n in model._plan[4:7].tolist())
    # packed state and its adjoints, rows along edges, one row per (vertex, tet) pair of what is differentiated
    work = blocks * (22 if model.floor else 16) + 4 * edge_slots
    work += slots * ((2 if material or rest else 0) + (4 if rest else 0))
    threads = torch.get_num_threads()
    return work * (threads if scenes >= threads else 1) * model._mass.element_size()


# --- checkpoint schedules of a rollout --------------------------------------------------------------------------------

MAX_REPEATS = 64  # of a step under BinomialCheckpoints: each is a nested checkpoint, and a run of the step
TAPE_BUDGET = 2 * 2**30  # bytes of tape that "auto" lets a rollout keep
UNROLLED_SCALARS = 540  # that autograd keeps per active vertex and sweep; measured on a structured beam (bench/cpu.py)


@dataclass(frozen=True)
class BinomialCheckpoints:
    """Binomial (treeverse) checkpointing: at most ``snapshots`` states and the tape of one step are kept.

    ``steps`` steps cost at most t extra forward runs of a step, t the least number with C(snapshots + t, t) >= steps.

    Args:
        snapshots: How many states, at least 1.

    Raises:
        ValueError: snapshots < 1; in the rollout, so few that t would be more than 64.
        TypeError: What is no integer.

    Source: Griewank and Walther (2000), Algorithm 799.
    """

    snapshots: int

    def __post_init__(self) -> None:
        check_count("snapshots", self.snapshots, 1)


# x, v, and what an integrator knows of the step before. A checkpoint takes the tensors one by one: of those that lie in
# other arguments autograd would keep copies alive.
State = tuple[Tensor, ...]


class Segment(NamedTuple):
    """The state after some steps, the frames (step, x, v) saved on the way, and what was observed."""

    end: State
    frames: list[tuple[int, Tensor, Tensor]]
    observed: list[Any]


Run = Callable[..., Segment]  # of the first step, the one after the last, and a State's tensors


def choose_schedule(checkpoint_every: int | BinomialCheckpoints | Literal["auto"] | None, adjoint: Adjoint,
                    model: System, scenes: int, steps: int, sweeps: int
                    ) -> tuple[int | BinomialCheckpoints | None, Adjoint]:  # fmt: skip
    """Resolves ``"auto"`` for schedule and tape from the bytes they would keep."""
    if isinstance(checkpoint_every, str) and checkpoint_every != "auto":
        fail(
            "checkpoint_every", '"auto", None, an integer > 0 or BinomialCheckpoints(snapshots)', repr(checkpoint_every)
        )
    if not (checkpoint_every is None or isinstance(checkpoint_every, (str, BinomialCheckpoints))):
        checkpoint_every = check_count("checkpoint_every", checkpoint_every, 1)
    inside = transformed()  # torch's checkpoints cannot hold tensors of a transform
    if inside and torch.is_grad_enabled() and checkpoint_every not in (None, "auto"):
        raise NotImplementedError(f'checkpoint_every: expected None or "auto", which both keep all tapes inside '
                                  f"torch.func transforms, got {checkpoint_every}")  # fmt: skip
    if isinstance(checkpoint_every, BinomialCheckpoints):
        snapshots = checkpoint_every.snapshots
        while _repeats(steps, snapshots) > MAX_REPEATS:
            snapshots += 1
        if snapshots > checkpoint_every.snapshots:
            wanted = f"BinomialCheckpoints of at least {snapshots} snapshots for {steps} steps"
            fail("checkpoint_every", wanted, checkpoint_every)
    if checkpoint_every != "auto":
        return checkpoint_every, adjoint
    row = scenes * check_count("sweeps", sweeps) * model.num_active * model._mass.element_size()
    own = 0  # bytes of a step besides its tape
    if model.rigid_bodies is not None:
        own = scenes * (9 * model.num_vertices + corrections_between(model, sweeps)) * model._mass.element_size()
    if not isinstance(adjoint, TapedSweep):  # a step of GlobalAdjoint keeps a few states and no tape
        kept = UNROLLED_SCALARS * row if isinstance(adjoint, Unrolled) else 0
        return None if inside or steps * kept <= TAPE_BUDGET else max(1, math.isqrt(steps)), adjoint
    candidates = ("full", "compact") if adjoint.tape == "auto" else (adjoint.tape,)
    for tape in candidates:
        policy = TapedSweep(tape).policy(0, 0, 0, model.device)
        if steps * (row * ops.tape_rows(policy, model.energy_mask) + own) <= TAPE_BUDGET:
            return None, TapedSweep(tape)
    if inside:
        return None, TapedSweep(candidates[-1])
    return max(1, math.isqrt(steps)), adjoint


def corrections_between(model: System, sweeps: int) -> int:
    """Scalars of a scene that a step keeps of the rigid corrections between its sweeps: the states about each."""
    return 6 * model.num_vertices * max(0, sweeps - 1) if model.rigid_bodies is not None and model.touches else 0


def run_segments(run: Run, steps: int, state: State, every: int | BinomialCheckpoints | None) -> Segment:
    """Runs all steps under a schedule."""
    if isinstance(every, BinomialCheckpoints):
        return _binomial(run, 0, steps, every.snapshots, *state)
    if every is None:
        return run(0, steps, *state)
    frames, observed = [], []
    for first in range(0, steps, every):
        part = _again(run, first, min(first + every, steps), *state)
        state = part.end
        frames += part.frames
        observed += part.observed
    return Segment(state, frames, observed)


def _again(run: Callable[..., Segment], *args: Any) -> Segment:
    # The non-reentrant form: gradients reach what a callable closes over, and checkpoints nest.
    if torch.compiler.is_compiling():
        return checkpoint(run, *args, use_reentrant=False, preserve_rng_state=True)  # type: ignore[return-value]
    # A graph's capture admits no look at the state of the random number generator; what is replayed draws none.
    capturing = torch.cuda.is_available() and torch.cuda.is_current_stream_capturing()
    scope, outermost = Scope(), not in_segment()

    def resumed(*args: Any) -> Segment:
        with scope.resumed():
            return run(*args)

    # A run that stops once the last tensor is saved does not reach the end of its last step, which records it.
    with set_checkpoint_early_stop(not scope.recorders), segment():
        while True:
            try:
                return checkpoint(resumed, *args, use_reentrant=False, preserve_rng_state=not capturing)  # type: ignore[return-value]
            except MorePairs:
                if not outermost:
                    raise


def _binomial(run: Run, first: int, end: int, snapshots: int, *state: Tensor) -> Segment:
    length = end - first
    if length <= 1:
        return run(first, end, *state)
    middle = first + _left(length, snapshots)
    left = _again(_binomial, run, first, middle, snapshots, *state)
    right = _binomial(run, middle, end, max(snapshots - 1, 0), *left.end)
    return Segment(right.end, left.frames + right.frames, left.observed + right.observed)


def _left(length: int, snapshots: int) -> int:
    """Steps before the first snapshot, so that both parts repeat their steps as rarely as can be."""
    if snapshots == 0:
        return length - 1
    repeats = _repeats(length, snapshots)
    most = math.comb(snapshots + repeats - 1, repeats - 1)
    return max(1, min(most, length - 1))


def _repeats(length: int, snapshots: int) -> int:
    """Most repetitions of a step."""
    repeats = 1
    while math.comb(snapshots + repeats, repeats) < length:
        repeats += 1
    return repeats
