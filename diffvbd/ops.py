"""The compiled operators, and the autograd functions of gathers and sums: the only file that names torch.ops.diffvbd.

Raw operators are private and functional. Each differentiable one is an autograd.Function in the form that also serves
torch.func and torch.compile; the sweep's stand in sweeps.py.
"""

# pyright: reportIncompatibleMethodOverride=false
from __future__ import annotations

import inspect
import math
from collections.abc import Sequence
from typing import Any, NamedTuple, NoReturn

import torch
from torch import Tensor
from torch.autograd import Function

from . import native
from .mask import KEEPS_POSITIONS

NO_TAPE, COMPACT_TAPE, FULL_TAPE = 0, 1, 2
REST_SCALARS = 7  # k01 k02 k03 k12 k13 k23 c6 of a tet


native.load()
raw = torch.ops.diffvbd


class SweepSettings(NamedTuple):
    """What a sweep executes besides its tensors, in the order of csrc/ops.cpp."""

    sizes: tuple[int, ...]  # active vertices, tets, slots of the plan; more on CUDA, see plan_sizes
    energies: int  # mask
    data_count: tuple[int, ...]  # scalars per scene, or per vertex, of each energy of one vertex
    # time_step, regularization, relaxation, saturation, saturation_eps, filter_eta, relaxation of the last sweep
    numbers: tuple[float, ...]
    sweeps: int
    launch: tuple[int, ...] = ()  # on CUDA: regime and threads per vertex of sweeps and reverse, see regimes.py


LANES = {"cpu": 8, "cuda": 32}  # vertices of a block of the plan; twins of kLanes and kSlice in csrc/core/views.h


THREAD = 1  # the regime whose tape has scenes last; twin of kThread in csrc/cuda/step.h
PLAN_HEADER = 11  # twin of kPlanHeader in csrc/core/plan_views.h


def plan_sizes(plan: Tensor, device: str) -> tuple[int, ...]:
    """What the host must know of a plan that is still on the CPU; the order is that of csrc/ops_cuda.cpp."""
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


# --- raw operators: shapes without execution, no autograd -------------------------------------------------------------


@torch.library.register_fake("diffvbd::sweep")
def _(x_start, x_prev, y, mu, lam, mass, rest, energy_data, origin, plan, sizes, energies, data_count, numbers, sweeps,
      launch, tape_policy, debug_step, checked):  # fmt: skip
    return torch.empty_like(x_start), x_start.new_empty(
        tape_shape(x_start, sizes, energies, sweeps, launch, tape_policy)
    )


def _materials(mu: Tensor, lam: Tensor, num_tets: int) -> int:
    """Length of the adjoints of mu and lam: CUDA sums what a scene shares."""
    return 1 if mu.is_cuda and mu.shape[-1] == 1 and lam.shape[-1] == 1 else num_tets


@torch.library.register_fake("diffvbd::sweep_backward")
def _(x_bar, x, x_prev, y, mu, lam, mass, rest, energy_data, origin, tape, plan, sizes, energies, data_count, numbers,
      sweeps, launch, tape_policy, wants):  # fmt: skip
    return sweep_adjoints(x, mu, lam, energy_data, sizes, wants)


def sweep_adjoints(x: Tensor, mu: Tensor, lam: Tensor, energy_data: Tensor, sizes: Sequence[int], wants: Sequence[bool]
                   ) -> tuple[Tensor, ...]:  # fmt: skip
    """Empty tensors in the shapes of a sweep's adjoints."""
    (b, v), materials = x.shape[:2], _materials(mu, lam, sizes[1])

    def wanted(flag: bool, *shape: int) -> Tensor:
        return x.new_empty((b, *shape) if flag else (0,))

    return (*(torch.empty_like(x) for _ in range(3)), wanted(wants[0], materials), wanted(wants[0], materials),
            wanted(wants[1], v), wanted(wants[2], sizes[1], REST_SCALARS),
            wanted(wants[3], energy_data.shape[-1]))  # fmt: skip


@torch.library.register_fake("diffvbd::fused_step")
def _(x, v, acceleration, held, mu, lam, mass, rest, plan, sizes, energies, data_count, numbers, sweeps, launch,
      tape_policy):  # fmt: skip
    shape = tape_shape(x, sizes, energies, sweeps, launch, tape_policy)
    return torch.empty_like(x), torch.empty_like(x), x.new_empty(shape)


@torch.library.register_fake("diffvbd::fused_step_backward")
def _(x_bar, v_bar, x_end, x, v, acceleration, held, mu, lam, mass, rest, tape, plan, sizes, energies, data_count,
      numbers, sweeps, launch, tape_policy, wants):  # fmt: skip
    b, materials = x.shape[0], _materials(mu, lam, sizes[1])
    shapes = [x.shape] * 4 + [(b, materials)] * 2 + [(b, x.shape[1]), (b, sizes[1], REST_SCALARS)]
    flags = [*wants[:5], wants[4], *wants[5:]]
    return tuple(x.new_empty(shape if flag else (0,)) for flag, shape in zip(flags, shapes, strict=True))


@torch.library.register_fake("diffvbd::pack_rest")
def _(rest, plan, sizes):
    return rest.new_empty((rest.shape[0], sizes[2], 4, LANES[rest.device.type]))


@torch.library.register_fake("diffvbd::tet_gather")
def _(values, tets):
    return values.new_empty((values.shape[0], tets.shape[0], 4, values.shape[2]))


@torch.library.register_fake("diffvbd::star_sum")
def _(values, star_ptr, star, positive):
    return values.new_empty((values.shape[0], star_ptr.shape[0] - 1, values.shape[3]))


@torch.library.register_fake("diffvbd::row_sum")
def _(values):
    return values.new_empty((values.shape[0],))


def raw_backward(ctx: Any, *grads: Tensor) -> NoReturn:
    raise NotImplementedError("diffvbd: the raw operators are not differentiable; call diffvbd.step")


for _name in (
    "sweep",
    "sweep_backward",
    "fused_step",
    "fused_step_backward",
    "pack_rest",
    "tet_gather",
    "star_sum",
    "row_sum",
):
    torch.library.register_autograd(f"diffvbd::{_name}", raw_backward)


# --- fixed-order reductions -------------------------------------------------------------------------------------------


def fold_scenes(tensor: Tensor, dim: int | None, size: int, scenes: int) -> Tensor:
    """[1 | B, ...] with a vmapped dimension of ``size`` -> [1 | size B, ...], for functions with a scene dimension."""
    if dim is None:
        if tensor.shape[0] == 1:
            return tensor
        return tensor.expand(size, *tensor.shape).reshape(size * tensor.shape[0], *tensor.shape[1:])
    tensor = tensor.movedim(dim, 0)
    return tensor.expand(size, scenes, *tensor.shape[2:]).reshape(size * scenes, *tensor.shape[2:])


class _RowSum(Function):
    """[rows, columns] -> [rows], summed in an order that depends on nothing but the shape."""

    @staticmethod
    def forward(values: Tensor) -> Tensor:
        return raw.row_sum(values.contiguous())

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: Tensor) -> None:
        ctx.columns = inputs[0].shape[1]

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Tensor:
        return grads[0][:, None].expand(-1, ctx.columns)

    @staticmethod
    def vmap(info: Any, in_dims: tuple, values: Tensor) -> tuple[Tensor, int]:
        values = values.movedim(in_dims[0], 0)
        return _RowSum.apply(values.flatten(0, 1)).unflatten(0, values.shape[:2]), 0


def sum_to(tensor: Tensor, shape: Sequence[int]) -> Tensor:
    """Sums the dimensions in which ``shape`` has 1 (same number of dimensions), in a fixed order."""
    reduced = [d for d, n in enumerate(shape) if n == 1 and tensor.shape[d] != 1]
    if not reduced:
        return tensor
    kept = [d for d in range(tensor.dim()) if d not in reduced]
    rows, columns = (math.prod([tensor.shape[d] for d in dims]) for dims in (kept, reduced))
    return _RowSum.apply(tensor.permute(*kept, *reduced).reshape(rows, columns)).reshape(shape)


class _Broadcast(Function):
    """expand() to a shape of as many dimensions, with a fixed-order sum in the backward."""

    @staticmethod
    def forward(tensor: Tensor, shape: tuple[int, ...]) -> Tensor:
        return tensor.expand(shape).contiguous()

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: Tensor) -> None:
        ctx.shape = tuple(inputs[0].shape)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple:
        return sum_to(grads[0], ctx.shape), None

    @staticmethod
    def vmap(info: Any, in_dims: tuple, tensor: Tensor, shape: tuple[int, ...]) -> tuple[Tensor, int]:
        return _Broadcast.apply(tensor.movedim(in_dims[0], 0), (info.batch_size, *shape)), 0


def broadcast(tensor: Tensor, shape: Sequence[int]) -> Tensor:
    """Broadcasts like torch.expand; the gradient of the expanded dimensions is summed in a fixed order."""
    shape = tuple(shape)
    if tuple(tensor.shape) == shape:
        return tensor
    if not tensor.requires_grad:
        return tensor.expand(shape)
    return _Broadcast.apply(tensor.reshape((1,) * (len(shape) - tensor.dim()) + tuple(tensor.shape)), shape)


class _TetGather(Function):
    @staticmethod
    def forward(values: Tensor, tets: Tensor, star_ptr: Tensor, star: Tensor) -> Tensor:
        return raw.tet_gather(values.contiguous(), tets)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: Tensor) -> None:
        ctx.mesh = inputs[1:]

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple:
        return _StarSum.apply(grads[0], *ctx.mesh, False), None, None, None

    @staticmethod
    def vmap(info: Any, in_dims: tuple, values: Tensor, *mesh: Tensor) -> tuple[Tensor, int]:
        values = values.movedim(in_dims[0], 0)
        return _TetGather.apply(values.flatten(0, 1), *mesh).unflatten(0, values.shape[:2]), 0


class _StarSum(Function):
    @staticmethod
    def forward(values: Tensor, tets: Tensor, star_ptr: Tensor, star: Tensor, positive: bool) -> Tensor:
        return raw.star_sum(values.contiguous(), star_ptr, star, positive)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: Tensor) -> None:
        ctx.mesh = inputs[1:4]

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple:
        return _TetGather.apply(grads[0], *ctx.mesh), None, None, None, None

    @staticmethod
    def vmap(info: Any, in_dims: tuple, values: Tensor, *mesh: Any) -> tuple[Tensor, int]:
        values = values.movedim(in_dims[0], 0)
        return _StarSum.apply(values.flatten(0, 1), *mesh).unflatten(0, values.shape[:2]), 0


def tet_gather(values: Tensor, tets: Tensor, star_ptr: Tensor, star: Tensor) -> Tensor:
    """Vertex values [B, V, C] -> values of the tets' corners [B, T, 4, C]; its adjoint is star_sum."""
    return _TetGather.apply(values, tets, star_ptr, star)


def star_sum(values: Tensor, tets: Tensor, star_ptr: Tensor, star: Tensor, *, positive: bool = False) -> Tensor:
    """Corner values [B, T, 4, C] -> sums over the tets of each vertex [B, V, C], in the order of the tets.

    With ``positive`` the values are masses: one that is not finite and > 0 raises ValueError.
    """
    return _StarSum.apply(values, tets, star_ptr, star, positive)


def build_plan(
    points: Tensor, tets: Tensor, active: Tensor, lanes: int
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Plan, color_ptr, color_vertices, star_ptr and star of a mesh, see csrc/cpu/plan.h; lanes: of :data:`LANES`."""
    return raw.build_plan(points, tets, active, lanes)


def pack_rest(rest: Tensor, plan: Tensor, sizes: tuple[int, ...]) -> Tensor:
    """Rest scalars of the tets [B, T, 7] -> as their vertices see them [B, slots, 4, lanes]. Not differentiable."""
    return raw.pack_rest(rest.contiguous(), plan, sizes)


def ready_signature(*functions: type[Function]) -> None:
    """apply() asks for the signature of forward at every call: ready-made, it costs less."""
    for function in functions:
        function.forward.__signature__ = inspect.signature(function.forward)  # type: ignore[attr-defined]


ready_signature(_RowSum, _Broadcast, _TetGather, _StarSum)
