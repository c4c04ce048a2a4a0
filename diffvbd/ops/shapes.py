"""Shapes of what each operator returns, from its arguments, for torch.compile; no operator is differentiable itself.

A row gets the arguments by the names that csrc/bind gives them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Any, NoReturn

import torch
from torch import Tensor

from .._common.constants import CONTACT
from ..energies import VERTEX_ENERGIES
from .fields import (
    CONSTANTS,
    COUNTS,
    CROSSING_ROW,
    DISPLACEMENTS,
    LAG_SCALARS,
    LANES,
    NEAR_ROW,
    NEAR_VALUES,
    PAIR_ROW,
    REST_ROW,
    REST_SCALARS,
    START_LOWER,
    SWEEP_ADJOINTS,
    CoarseSizes,
    corrections_shape,
    tape_shape,
)
from .load import raw

Row = Callable[[Any], Any]
INT, LONG, BYTE, DOUBLE = torch.int32, torch.int64, torch.uint8, torch.float64


def new(like: Tensor, *shape: Any, dtype: torch.dtype | None = None) -> Tensor:
    return like.new_empty(shape, dtype=dtype)


def same(t: Tensor, count: int) -> list[Tensor]:
    return [torch.empty_like(t) for _ in range(count)]


def wanted(flag: Any, like: Tensor, *shape: Any) -> Tensor:
    return new(like, *(shape if flag else (0,)))


def scalars_of_data(data_count: Sequence[int]) -> tuple[int, int]:
    """Scalars of energy data that a scene has, and that each vertex has."""
    counts = list(zip(VERTEX_ENERGIES, data_count, strict=True))
    return sum(n for e, n in counts if not e.per_vertex), sum(n for e, n in counts if e.per_vertex)


# --- sweeps and bodies ------------------------------------------------------------------------------------------------


def _sweep(a: Any) -> Any:
    x = a.x_start
    tape = new(x, *tape_shape(x, a.sizes, a.energies, a.sweeps, a.launch, a.tape_policy))
    done = corrections_shape(x, a.coarse, a.sweeps, a.energies) if a.coarse_plan.numel() else (0,)
    limits = (x.shape[0] if a.energies & CONTACT else 0, a.sweeps, x.shape[1])
    return torch.empty_like(x), tape, new(x, *limits, dtype=BYTE), new(x, *done)


def _body_adjoints(x: Tensor, a: Any, wants: Sequence[bool]) -> list[Tensor]:
    """Of mu, lam, mass, rest. CUDA sums the material that a scene shares."""
    shares = a.mu.is_cuda and a.mu.shape[-1] == 1 and a.lam.shape[-1] == 1
    (b, v), tets = x.shape[:2], a.sizes[1]
    material = (b, 1 if shares else tets)
    shapes = (material, material, (b, v), (b, tets, REST_SCALARS))
    return [wanted(flag, x, *shape) for shape, flag in zip(shapes, (wants[0], *wants), strict=True)]


def _sweep_backward(a: Any) -> Any:
    x, wants = a.x, a.wants
    b, v = x.shape[:2]
    own = [*same(x, 3), *_body_adjoints(x, a, wants[:3]), wanted(wants[3], x, b, a.energy_data.shape[-1])]
    last = wanted(wants[4], x, *a.coarse_factor.shape)
    if not a.energies & CONTACT:
        return (*own, *(new(x, 0) for _ in range(len(SWEEP_ADJOINTS) - len(own) - 1)), last)
    colliders = a.collider.shape[1] if a.collider.dim() == 3 else 0
    planes = a.floor_lag.numel() // max(1, a.floor_lag.shape[0] * 4 * v)
    shapes = ((b, colliders, 3), (b, colliders, 3), (b,), (a.lag_pairs.shape[0], LAG_SCALARS), (b, v, planes, 4))
    return (*own, *(new(x, *shape) for shape in shapes), last)


def _fused_step(a: Any) -> Any:
    return *same(a.x, 2), new(a.x, *tape_shape(a.x, a.sizes, a.energies, a.sweeps, a.launch, a.tape_policy))


def _fused_step_backward(a: Any) -> Any:
    states = [wanted(flag, a.x, *a.x.shape) for flag in a.wants[:4]]
    return (*states, *_body_adjoints(a.x, a, a.wants[4:]))


def _rigid_backward(a: Any) -> Any:
    x, (b, v), (shared, own) = a.x, a.x.shape[:2], scalars_of_data(a.data_count)
    x_prev = wanted(a.energy_data.numel() or a.v_bar.numel(), x, *x.shape)
    return (torch.empty_like(x), x_prev, torch.empty_like(x), new(x, b, v),
            new(x, b, a.spread.shape[0] if a.wants_data else 0, shared),
            new(x, b, v if a.wants_data else 0, own))  # fmt: skip


def _begin(a: Any) -> Any:
    def decisions(made: bool, ptr: Tensor) -> Tensor:
        return new(a.x, a.x.shape[0] if made else 0, ptr.shape[0] - 1, dtype=BYTE)

    return *same(a.x, 2), decisions(a.kind == START_LOWER, a.other_ptr), decisions(a.parts, a.ptr)


def _begin_backward(a: Any) -> Any:
    x, (b, v), (shared, own) = a.x, a.x.shape[:2], scalars_of_data(a.data_count)
    bodies, rows = (a.spread.shape[0], v) if a.wants[2] else (0, 0)
    return (*same(x, 2), wanted(a.wants[0], x, *x.shape), wanted(a.wants[1], x, *x.shape), new(x, b, v),
            new(x, b, bodies, shared), new(x, b, rows, own),
            new(x, b, rows if a.filters else 0, a.data_count[0]))  # fmt: skip


# --- coarse spaces ----------------------------------------------------------------------------------------------------


def _scenes(*tensors: Tensor) -> int:
    return max(t.shape[0] for t in tensors)


def _coarse_stiffness(a: Any) -> Any:
    sizes = CoarseSizes(*a.sizes)
    return new(a.mu, _scenes(a.mu, a.lam, a.gradients, a.volume), sizes.groups, 3, 3, sizes.width, sizes.width)


def _coarse_stiffness_backward(a: Any) -> Any:
    scenes, tets = _scenes(a.mu, a.lam, a.gradients, a.volume), a.gradients.shape[1]
    rest = tets if a.wants_rest else 0
    return tuple(new(a.mu, scenes, *own) for own in ((tets,), (tets,), (rest, 4, 3), (rest,)))


# --- contact ----------------------------------------------------------------------------------------------------------


def _points(x: Tensor, collider: Tensor) -> Tensor:
    """One vector for each corner point."""
    return new(x, x.shape[0], x.shape[1] + (collider.shape[1] if collider.dim() == 3 else 0), 3)


def _contact_detect(a: Any) -> Any:
    x, b, n = a.x, a.x.shape[0], a.body.shape[0]
    rows = torch.library.get_ctx().new_dynamic_size() if a.trim and x.device.type == "cpu" else a.capacity
    return (new(x, rows, PAIR_ROW, dtype=INT), new(x, rows, CONSTANTS), new(x, b * n + 1, dtype=INT),
            new(x, 4 * rows, dtype=INT), new(x, b, n, NEAR_ROW, dtype=INT), new(x, b, n, NEAR_VALUES),
            new(x, COUNTS, dtype=LONG), new(x, b))  # fmt: skip


def _contact_find(a: Any) -> Any:
    x, b, n = a.x, a.x.shape[0], a.body_ptr.shape[0] - 1
    return (*_contact_detect(a), torch.empty_like(x), new(x, len(DISPLACEMENTS), b, n), new(x, b, n, 4),
            new(x, b, n, dtype=INT), new(x, b, n, 3), new(x, b, n + 1), new(x, b, n + 1))  # fmt: skip


def _contact_near(a: Any) -> Any:
    count, like = torch.library.get_ctx().new_dynamic_size() if a.exact else a.pairs.shape[0], a.constants
    return (torch.empty_like(a.x[..., 0]), new(like, count, dtype=LONG), new(like, count, a.pairs.shape[1], dtype=INT),
            new(like, count, like.shape[1]), new(like, *a.ptr.shape, dtype=INT),
            new(like, 4 * count, dtype=INT))  # fmt: skip


def _contact_start(a: Any) -> Any:
    scenes, vertices, _ = a.x.shape
    own = scenes if a.rigid.dim() == 3 else 0
    return (torch.empty_like(a.x), torch.empty_like(a.x), new(a.x, own, vertices, 3), new(a.x, scenes, vertices),
            new(a.x, own, vertices), new(a.x, scenes, vertices), new(a.x, scenes, vertices, dtype=torch.bool),
            new(a.x, scenes, dtype=LONG))  # fmt: skip


def _contact_rigid_correct(a: Any) -> Any:
    size = a.x.shape[0], a.free.shape[0]
    return torch.empty_like(a.x), new(a.x, *size, 2, dtype=DOUBLE), new(a.x, *size)


def _pairs(a: Any) -> tuple[int, int]:
    return a.pairs.shape[0], a.lag_pairs.shape[0] if a.lag.numel() else 0


def _contact_rigid_reverse(a: Any) -> Any:
    (listed, lagged), (b, v), (shared, own) = _pairs(a), a.x.shape[:2], scalars_of_data(a.data_count)
    planes = a.floor_lag.numel() // max(1, a.floor_lag.shape[0] * v * 4)
    data = ((b, a.free.shape[0] if a.wants_data else 0, shared), (b, v if a.wants_data else 0, own))
    colliders = (b, a.body.shape[0] - v, 3)
    shapes = ((b, v), *data, (b if planes else 0, v, planes, 4), colliders, colliders, (listed,), (lagged, LAG_SCALARS))
    return *same(a.x, 3), *(new(a.x, *shape) for shape in shapes)


def _contact_coarse_system(a: Any) -> Any:
    b, functions = a.x.shape[0], a.function_ptr.shape[0] - 1
    size = 3 * functions
    return new(a.x, b, functions, 3, dtype=DOUBLE), new(a.x, b, size, size, dtype=DOUBLE)


def _contact_coarse_reverse(a: Any) -> Any:
    b, tets, wants = a.x.shape[0], a.tets.shape[0], a.wants
    a.wants_data = wants[0]
    shapes = ((b, tets if wants[1] else 0, 2), (b, tets if wants[2] else 0, REST_SCALARS),
              (b, a.packed.shape[1] if wants[3] else 0))  # fmt: skip
    return *_contact_rigid_reverse(a), *(new(a.x, *shape) for shape in shapes)


TABLE: dict[str, Row] = {
    "pack_rest": lambda a: new(a.rest, a.rest.shape[0], a.sizes[2], REST_ROW[a.rest.device.type],
                               LANES[a.rest.device.type]),
    "tet_gather": lambda a: new(a.values, a.values.shape[0], a.tets.shape[0], 4, a.values.shape[2]),
    "star_sum": lambda a: new(a.values, a.values.shape[0], a.star_ptr.shape[0] - 1, a.values.shape[3]),
    "row_sum": lambda a: new(a.values, a.values.shape[0]),
    "segment_sum": lambda a: new(a.values, a.values.shape[0], a.ptr.shape[0] - 1, a.values.shape[2]),
    "neighbor_pairs": lambda a: (new(a.points, a.max_pairs, 3, dtype=INT), new(a.points, 1, dtype=LONG)),
    "sweep": _sweep,
    "sweep_backward": _sweep_backward,
    "fused_step": _fused_step,
    "fused_step_backward": _fused_step_backward,
    "rigid": lambda a: tuple(same(a.x, 2)),
    "rigid_backward": _rigid_backward,
    "begin": _begin,
    "begin_backward": _begin_backward,
    "potential_increase": lambda a: new(a.x, a.x.shape[0], a.ptr.shape[0] - 1, 2, dtype=DOUBLE),
    "coarse_matrix": lambda a: new(a.x_prev, a.x_prev.shape[0], 9 * a.mass.shape[-1]),
    "coarse_matrix_backward": lambda a: (torch.empty_like(a.x_prev),
                                         new(a.x_prev, a.x_prev.shape[0], *a.stiffness.shape[1:]),
                                         new(a.x_prev, a.x_prev.shape[0], *a.mass.shape[1:])),
    "coarse_stiffness": _coarse_stiffness,
    "coarse_stiffness_backward": _coarse_stiffness_backward,
    "coarse_mass": lambda a: new(a.mass, a.mass.shape[0], CoarseSizes(*a.sizes).cells),
    "coarse_mass_backward": lambda a: new(a.bar, a.bar.shape[0], CoarseSizes(*a.sizes).vertices),
    "contact_detect": _contact_detect,
    "contact_intersections": lambda a: (new(a.x, a.capacity, CROSSING_ROW, dtype=INT),
                                        new(a.x, a.x.shape[0], 2, dtype=LONG), new(a.x, a.x.shape[0], 2, 2, dtype=INT)),
    "contact_find": _contact_find,
    "contact_start": _contact_start,
    "contact_near": _contact_near,
    "contact_lag": lambda a: (new(a.x, a.pairs.shape[0], LAG_SCALARS), new(a.x, a.pairs.shape[0]),
                              new(a.x, a.pairs.shape[0], dtype=LONG)),
    "contact_lag_backward": lambda a: (_points(a.x, a.collider), new(a.x, a.x.shape[0])),
    "contact_rigid_correct": _contact_rigid_correct,
    "contact_rigid_reverse": _contact_rigid_reverse,
    "contact_coarse_system": _contact_coarse_system,
    "contact_coarse_move": lambda a: (torch.empty_like(a.x), new(a.x, a.x.shape[0], a.free.shape[0], dtype=DOUBLE)),
    "contact_coarse_restrict": lambda a: _contact_coarse_system(a)[0],
    "contact_coarse_reverse": _contact_coarse_reverse,
}  # fmt: skip


def _not_differentiable(ctx: Any, *grads: Tensor) -> NoReturn:
    raise NotImplementedError("diffvbd: the raw operators are not differentiable; call diffvbd.step")


def _register(name: str, row: Row) -> None:
    names = [argument.name for argument in getattr(raw, name).default._schema.arguments]

    def shapes(*arguments: Any) -> Any:
        # torch asks, too, where some are on the meta device, and then what comes back would be as if all were
        given = (t for a in arguments for t in (a if isinstance(a, list) else (a,)))
        devices = {t.device for t in given if isinstance(t, Tensor)}
        if len(devices) > 1:
            found = ", ".join(sorted(str(device) for device in devices))
            raise ValueError(f"diffvbd::{name}: expected tensors on one device, got {found}")
        return row(SimpleNamespace(**dict(zip(names, arguments, strict=True))))

    torch.library.register_fake(f"diffvbd::{name}", shapes)
    torch.library.register_autograd(f"diffvbd::{name}", _not_differentiable)


for _name, _row in TABLE.items():
    _register(_name, _row)
