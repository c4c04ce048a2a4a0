"""What the operators take: lists of tensors, sizes, settings and policies; and the constants of C++ that Python needs
as well (csrc/bind/constants.cpp)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from torch import Tensor

from .._common.constants import KEEPS_POSITIONS, TAKES_FRACTIONS
from .load import raw

_C: dict[str, Any] = {a.name: a.default_value for a in raw.constants.default._schema.arguments}
LANES = {"cpu": _C["cpu_lanes"], "cuda": _C["cuda_lanes"]}  # vertices of a block of the plan
PLAN_HEADER, ROW, REST_SCALARS = (_C[name] for name in ("plan_header", "row", "rest_scalars"))
REST_ROW = {"cpu": _C["pair_rest"], "cuda": -(-_C["pair_rest"] // 4) * 4}  # of what a vertex sees; whole loads on CUDA
LAG_SCALARS, PLANE_SCALARS = _C["lag_scalars"], _C["plane_scalars"]
PAIR_ROW, CONSTANTS, NEAR_ROW, NEAR_VALUES, COUNTS, CROSSING_ROW = (
    _C[name] for name in ("pair_row", "pair_constants", "near_row", "near_values", "counts", "crossing_row")
)
MOST_COUPLED = _C["most_coupled"]  # bodies of a group that is corrected together
STARTS = {"inertia": _C["start_inertia"], "predictor": _C["start_predictor"], "auto": _C["start_lower"]}
START_LOWER = STARTS["auto"]
CORRECTED, TILE, NO_MOVE, WORKSPACE_BUDGET, ROUNDINGS = (
    _C[name] for name in ("corrected", "tile", "no_move", "workspace_budget", "roundings")
)
# What a reverse differentiates, in the order of what it returns.
SWEEP_ADJOINTS, STEP_ADJOINTS, TOUCHING_ADJOINTS = (
    tuple(_C[name].split()) for name in ("sweep_adjoints", "step_adjoints", "touching_adjoints")
)

NO_TAPE, COMPACT_TAPE, FULL_TAPE = 0, 1, 2
THREAD = 1  # the regime whose tape has scenes last; twin of kThread in csrc/cuda/step.h
# Of vertices of a body; twins of DisplacementKind in csrc/contact/motion.h.
DISPLACEMENTS = ("bends", "driven", "apart", "stretched", "gravity")


class SweepFields(NamedTuple):
    """What the sweeps read, in the order of DIFFVBD_SWEEP_FIELDS in csrc/bind/fields.h; None where a scene lacks it.

    ``rest`` is [1 | B, T, 7] where a step is given one; to the operator it goes packed, as the tets' vertices see it.
    """

    x_start: Tensor  # start of the sweeps [m], [B, V, 3]
    x_prev: Tensor  # start of the step [m], [B, V, 3]
    y: Tensor  # predictor [m], [B, V, 3]
    mu: Tensor  # [1 | B, 1 | T] [Pa]
    lam: Tensor  # [1 | B, 1 | T] [Pa]
    mass: Tensor  # [1 | B, V] [kg]
    rest: Tensor | None
    energy_data: Tensor  # [1 | B, n], see VertexEnergy.pack
    origin: Tensor | None = None  # [B, V, 3], what positions are relative to
    # contact; the shapes of the index data are those of ops.contact
    collider: Tensor | None = None  # during the sweeps [m], [B, Vc, 3]
    collider_prev: Tensor | None = None  # at the start of the step [m], [B, Vc, 3]
    kappa: Tensor | None = None  # [1 | B] [N/m]
    pairs: Tensor | None = None  # that repel
    constants: Tensor | None = None
    ptr: Tensor | None = None
    entry: Tensor | None = None
    lag: Tensor | None = None  # friction and damping of pairs at the start of the step, [pairs, 9]
    lag_pairs: Tensor | None = None
    lag_ptr: Tensor | None = None
    lag_entry: Tensor | None = None
    floor_lag: Tensor | None = None  # [B, V, planes, 4]
    center: Tensor | None = None  # [B, V, 3] from where a vertex may go,
    trust_radius: Tensor | None = None  # [B, V] as far as this [m]
    # coarse corrections; see model.coarse_plan for the constants
    # [B, 9 cells]  Cholesky factors (CUDA: inverses), with vertex energies the matrices; its adjoint is the matrix's
    coarse_factor: Tensor | None = None
    coarse_mass: Tensor | None = None  # [1 | B, cells] [kg]
    coarse_plan: Tensor | None = None
    coarse_weights: Tensor | None = None
    coarse_rest: Tensor | None = None  # [1 | B, blocks, 7, lanes]


class StepFields(NamedTuple):
    """What a whole step in one operator reads (CUDA), in the order of DIFFVBD_STEP_FIELDS; all are differentiable."""

    x: Tensor  # [B, V, 3] [m]
    v: Tensor  # [B, V, 3] [m/s]
    acceleration: Tensor  # [1 | B, 1 | V, 3] [m/s^2]
    prescribed: Tensor | None  # where pinned vertices go [m], [1 | B, V, 3]; None: they stay
    mu: Tensor
    lam: Tensor
    mass: Tensor
    rest: Tensor | None


class RigidFields(NamedTuple):
    """What the rigid correction reads, in the order of DIFFVBD_RIGID_FIELDS; the first five are differentiable."""

    x: Tensor  # as in SweepFields, which ends there
    x_prev: Tensor
    y: Tensor
    mass: Tensor
    energy_data: Tensor
    origin: Tensor | None
    order: Tensor  # of model.bodies.Bodies, as are the next two
    ptr: Tensor
    spread: Tensor
    other: Tensor  # OtherBodies.of


class TouchingFields(NamedTuple):
    """What the rigid correction of bodies that touch reads, in the order of DIFFVBD_TOUCHING_FIELDS; differentiable:
    TOUCHING_ADJOINTS. Empty where a scene lacks something."""

    x: Tensor  # [B, V, 3] [m], as are the next two
    x_prev: Tensor
    y: Tensor
    mass: Tensor  # [1 | B, V] [kg]
    energy_data: Tensor
    origin: Tensor
    order: Tensor  # [V] int32, vertices by body
    ptr: Tensor  # [bodies + 1] int32
    free: Tensor  # [bodies] bool: nothing of it is pinned
    pinned: Tensor  # [N] bool, of all corner points: pinned, or of a collider
    body: Tensor  # [N] int32
    collider: Tensor  # as in SweepFields, as are the rest
    collider_prev: Tensor
    kappa: Tensor
    pairs: Tensor
    constants: Tensor
    pair_ptr: Tensor
    pair_entry: Tensor
    lag: Tensor
    lag_pairs: Tensor
    lag_ptr: Tensor
    lag_entry: Tensor
    floor_lag: Tensor
    center: Tensor
    trust_radius: Tensor


class CoarseFields(NamedTuple):
    """What the matrix of a coarse space reads, in the order of DIFFVBD_COARSE_FIELDS; the first three are
    differentiable."""

    x_prev: Tensor
    stiffness: Tensor  # [1 | B, groups, 3, 3, width, width], at rest [N/m]
    mass: Tensor  # [1 | B, cells] [kg]
    plan: Tensor  # of model.coarse_plan, as are the next two
    moments: Tensor
    volume: Tensor


class BeginFields(NamedTuple):
    """What the beginning of a step reads, in the order of DIFFVBD_BEGIN_FIELDS; the first six are differentiable."""

    x: Tensor
    v: Tensor
    acceleration: Tensor
    prescribed: Tensor | None
    mass: Tensor
    energy_data: Tensor
    origin: Tensor | None
    mu: Tensor
    lam: Tensor
    rest: Tensor | None  # [1 | B, T, 7], None where tets have no energy or nobody asks for it
    pinned: Tensor  # bool [V]
    order: Tensor
    ptr: Tensor
    spread: Tensor
    tets: Tensor  # of model.bodies.Bodies, as is the next one
    tet_ptr: Tensor
    other: Tensor
    other_order: Tensor  # of model.bodies.OtherBodies, as are the next three
    other_ptr: Tensor
    other_tets: Tensor
    other_tet_ptr: Tensor


def as_list(fields: NamedTuple, like: Tensor) -> list[Tensor]:
    """Fields as the operators take them: what a scene lacks is empty."""
    absent = like.new_empty((0,))
    return [absent if t is None else t for t in fields]


class StepNumbers(NamedTuple):
    """Numbers of a sweep: StepParameters of csrc/core/safeguards.h in their order, then that of friction."""

    time_step: float  # [s]
    regularization: float  # [kg]
    relaxation: float
    saturation: float  # [m]; negative: none
    saturation_eps: float
    filter_eta: float
    last_relaxation: float  # of the last sweep of a step
    friction_eps: float  # motion within the step below which friction is smoothed [m]


class CoarseSizes(NamedTuple):
    """Sizes of the plan of a coarse space, in the order of Plan in csrc/coarse/views.h."""

    bodies: int
    functions: int
    groups: int
    width: int
    entries: int
    tet_blocks: int
    moments: int
    positions: int
    listed: int
    cells: int
    most: int
    parts: int
    places: int
    vertices: int
    large: int
    every: int
    begun: int = 0  # 1 where the sweeps to run go on after the first of a step


class SweepSettings(NamedTuple):
    """What a sweep executes besides its tensors, in the order of DIFFVBD_SETTINGS in csrc/bind/sweep.cpp."""

    sizes: tuple[int, ...]  # active vertices, tets, slots of the plan; more on CUDA, see plan_sizes
    energies: int  # mask
    data_count: tuple[int, ...]  # scalars per scene, or per vertex, of each energy of one vertex
    numbers: StepNumbers
    sweeps: int
    launch: tuple[int, ...] = ()  # on CUDA: regimes and threads per vertex, see regimes.py
    coarse: CoarseSizes | tuple[()] = ()  # with coarse corrections


def plan_sizes(plan: Tensor, device: str) -> tuple[int, ...]:
    """What the host must know of a plan that is still on the CPU; its order is that of plan_of() in bind/plan.h."""
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
    kept = 4 if energies & TAKES_FRACTIONS else 3 if energies & KEEPS_POSITIONS else 0
    return {NO_TAPE: 0, COMPACT_TAPE: kept or 3, FULL_TAPE: 9 + kept}[policy]


def corrections_of(sweeps: int, every: int, begun: int = 0) -> int:
    """Coarse corrections among so many sweeps, of which ``begun`` more came before; twin of corrections_of in
    csrc/coarse/views.h."""
    return max(1, -(-(sweeps + begun - 1) // every))


def corrections_shape(x: Tensor, coarse: Sequence[int], sweeps: int, energies: int) -> list[int]:
    """Of what is recorded of coarse corrections; twin of tape_size() there. ``coarse``: as in SweepSettings."""
    sizes = CoarseSizes(*coarse)
    before = 3 * sizes.positions if energies & KEEPS_POSITIONS else 0
    size = 3 * sizes.functions + sizes.bodies + before
    return [x.shape[0], corrections_of(sweeps, sizes.every, sizes.begun), size]


def tape_shape(x: Tensor, sizes: Sequence[int], energies: int, sweeps: int, launch: Sequence[int], policy: int) -> list:
    """Scenes first, but last where each thread has a scene: who mixes up the two is told so by the shape."""
    shape = [sweeps, tape_rows(policy, energies), sizes[0]]
    return [*shape, x.shape[0]] if tuple(launch[:1]) == (THREAD,) else [x.shape[0], *shape]
