"""The compiled operators and their autograd functions: the only file that names torch.ops.diffvbd.

Raw operators are private and functional. Each differentiable one is an autograd.Function in the form that also serves
torch.func and torch.compile; the backward is a second Function, whose own backward raises.
"""

# pyright: reportIncompatibleMethodOverride=false
from __future__ import annotations

import inspect
import math
import sysconfig
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import torch
from torch import Tensor
from torch.autograd import Function

NO_TAPE, COMPACT_TAPE, FULL_TAPE = 0, 1, 2
REST_SCALARS = 7  # k01 k02 k03 k12 k13 k23 c6 of a tet
_FILTERING = 4  # mask of the energies with a step filter (FloorBarrier)


def _load() -> None:
    folder = Path(__file__).parent
    for suffix in (".abi3.so", sysconfig.get_config_var("EXT_SUFFIX") or ".so"):
        path = folder / f"_C{suffix}"
        if path.exists():
            torch.ops.load_library(str(path))
            return
    raise ImportError(
        "diffvbd is not built here: run `pip install --no-build-isolation -e .` in this folder, or, if it is installed "
        "elsewhere, leave this folder, whose sources hide the installed package"
    )


_load()
_ops = torch.ops.diffvbd


class SweepSettings(NamedTuple):
    """What a sweep executes besides its tensors, in the order of csrc/ops.cpp."""

    sizes: tuple[int, int, int]  # active vertices, tets, slots of the plan
    energies: int  # mask
    data_count: tuple[int, ...]  # scalars per scene, or per vertex, of each energy of one vertex
    numbers: tuple[float, ...]  # time_step, regularization, relaxation, saturation, saturation_eps, filter_eta
    sweeps: int


def tape_rows(policy: int, energies: int) -> int:
    """Scalars of tape per active vertex and sweep; twin of tape_rows in csrc/cpu/scene.h."""
    return {NO_TAPE: 0, COMPACT_TAPE: 3, FULL_TAPE: 12 if energies & _FILTERING else 9}[policy]


# --- raw operators: shapes without execution, no autograd -------------------------------------------------------------


@torch.library.register_fake("diffvbd::sweep")
def _(x_start, x_prev, y, mu, lam, mass, rest, energy_data, origin, plan, sizes, energies, data_count, numbers, sweeps,
      tape_policy, debug_step, checked):  # fmt: skip
    rows = tape_rows(tape_policy, energies)
    return torch.empty_like(x_start), x_start.new_empty((x_start.shape[0], sweeps, rows, sizes[0]))


@torch.library.register_fake("diffvbd::sweep_backward")
def _(x_bar, x, x_prev, y, mu, lam, mass, rest, energy_data, origin, tape, plan, sizes, energies, data_count, numbers,
      sweeps, tape_policy, wants):  # fmt: skip
    b, v = x.shape[:2]

    def wanted(flag: bool, *shape: int) -> Tensor:
        return x.new_empty((b, *shape) if flag else (0,))

    return (*(torch.empty_like(x) for _ in range(3)), wanted(wants[0], sizes[1]), wanted(wants[0], sizes[1]),
            wanted(wants[1], v), wanted(wants[2], sizes[1], REST_SCALARS),
            wanted(wants[3], energy_data.shape[-1]))  # fmt: skip


@torch.library.register_fake("diffvbd::pack_rest")
def _(rest, plan, sizes):
    return rest.new_empty((rest.shape[0], sizes[2], 4, 8))


@torch.library.register_fake("diffvbd::tet_gather")
def _(values, tets):
    return values.new_empty((values.shape[0], tets.shape[0], 4, values.shape[2]))


@torch.library.register_fake("diffvbd::star_sum")
def _(values, star_ptr, star, positive):
    return values.new_empty((values.shape[0], star_ptr.shape[0] - 1, values.shape[3]))


@torch.library.register_fake("diffvbd::row_sum")
def _(values):
    return values.new_empty((values.shape[0],))


def _raw_backward(ctx: Any, *grads: Tensor) -> NoReturn:
    raise NotImplementedError("diffvbd: the raw operators are not differentiable; call diffvbd.step")


for _name in ("sweep", "sweep_backward", "pack_rest", "tet_gather", "star_sum", "row_sum"):
    torch.library.register_autograd(f"diffvbd::{_name}", _raw_backward)


# --- fixed-order reductions -------------------------------------------------------------------------------------------


def _fold(tensor: Tensor, dim: int | None, size: int, scenes: int) -> Tensor:
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
        return _ops.row_sum(values.contiguous())

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


def _sum_to(tensor: Tensor, shape: Sequence[int]) -> Tensor:
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
        return _sum_to(grads[0], ctx.shape), None

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
        return _ops.tet_gather(values.contiguous(), tets)

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
        return _ops.star_sum(values.contiguous(), star_ptr, star, positive)

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


def build_plan(points: Tensor, tets: Tensor, active: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Plan, color_ptr, color_vertices, star_ptr and star of a mesh, see csrc/cpu/plan.h."""
    return _ops.build_plan(points, tets, active)


def pack_rest(rest: Tensor, plan: Tensor, sizes: tuple[int, int, int]) -> Tensor:
    """Rest scalars of the tets [B, T, 7] -> as their vertices see them [B, slots, 4, 8]. Not differentiable."""
    return _ops.pack_rest(rest.contiguous(), plan, sizes)


# --- the sweep --------------------------------------------------------------------------------------------------------

_TENSORS = 8  # x_start, x_prev, y, mu, lam, mass, rest, energy_data: the differentiable inputs, all [1 | B, ...]


class _Sweep(Function):
    """K sweeps of block updates and, as its backward, the same sweeps transposed in reverse order."""

    @staticmethod
    def forward(x_start, x_prev, y, mu, lam, mass, rest, energy_data, origin, packed_rest, plan, settings, tape_policy,
                debug_step, checked):  # fmt: skip
        if rest is not None:
            packed_rest = pack_rest(rest, plan, settings.sizes)
        return _ops.sweep(x_start, x_prev, y, mu, lam, mass, packed_rest, energy_data, origin, plan, *settings,
                          tape_policy, debug_step, checked)  # fmt: skip

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: tuple[Tensor, Tensor]) -> None:
        *tensors, origin, packed_rest, plan, settings, tape_policy, _, _ = inputs
        ctx.save_for_backward(*tensors, origin, packed_rest, plan, *output)
        ctx.settings, ctx.tape_policy = settings, tape_policy
        ctx.mark_non_differentiable(output[1])
        ctx.set_materialize_grads(False)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple:
        if grads[0] is None:
            return (None,) * (_TENSORS + 7)
        needs = ctx.needs_input_grad[:_TENSORS]
        out = _SweepBackward.apply(grads[0], *ctx.saved_tensors, ctx.settings, ctx.tape_policy, needs)
        out = iter(out if isinstance(out, tuple) else (out,))
        return tuple(next(out) if need else None for need in needs) + (None,) * 7

    @staticmethod
    def vmap(info: Any, in_dims: tuple, *args: Any) -> tuple[tuple[Tensor, Tensor], tuple[int, int]]:
        tensors: tuple[Any, ...] = args[: _TENSORS + 1]
        scenes = _scenes(tensors, in_dims)
        folded: list[Any] = [
            t if t is None or t.numel() == 0 else _fold(t, d, info.batch_size, scenes)
            for t, d in zip(tensors, in_dims, strict=False)
        ]
        full = (info.batch_size * scenes, *folded[0].shape[1:])
        folded[:3] = [t.expand(full).contiguous() for t in folded[:3]]
        x, tape = _Sweep.apply(*folded, *args[_TENSORS + 1 :])
        return (x.unflatten(0, (-1, scenes)), tape.unflatten(0, (-1, scenes))), (0, 0)


class _SweepBackward(Function):
    @staticmethod
    def forward(x_bar, x_start, x_prev, y, mu, lam, mass, rest, energy_data, origin, packed_rest, plan, x, tape,
                settings, tape_policy, needs):  # fmt: skip
        if rest is not None:
            packed_rest = pack_rest(rest, plan, settings.sizes)
        inputs = (x_prev, y, mu, lam, mass, packed_rest, energy_data, origin)
        if tape_policy == NO_TAPE:
            tape_policy = FULL_TAPE
            x, tape = _ops.sweep(x_start, *inputs, plan, *settings, tape_policy, -1, False)
        wants = (needs[3] or needs[4], needs[5], needs[6], needs[7])
        bars = _ops.sweep_backward(x_bar.contiguous(), x, *inputs, tape, plan, *settings, tape_policy, wants)
        given: tuple[Any, ...] = (x_start, x_prev, y, mu, lam, mass, rest, energy_data)
        return tuple(_sum_to(bar, t.shape) for bar, t, need in zip(bars, given, needs, strict=True) if need)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: tuple[Tensor, ...]) -> None:
        ctx.count = len(inputs)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> NoReturn:
        raise NotImplementedError("diffvbd: second derivatives of a step are not supported (create_graph, hessian)")

    @staticmethod
    def vmap(info: Any, in_dims: tuple, *args: Any) -> tuple[tuple[Tensor, ...], tuple[int, ...]]:
        x_bar, *saved, settings, tape_policy, needs = args
        tensors: tuple[Any, ...] = (x_bar, *saved[: _TENSORS + 1])
        scenes = _scenes(tensors, in_dims)
        size = info.batch_size

        def fold(t: Tensor | None, d: int | None) -> Any:
            return t if t is None or t.numel() == 0 else _fold(t, d, size, scenes)

        folded: list[Any] = [fold(t, d) for t, d in zip(tensors, in_dims, strict=False)]
        packed_rest, plan, x, tape = saved[_TENSORS + 1 :]
        x, tape = (
            t if t.numel() == 0 else t.expand(size * scenes, *t.shape[1:]).contiguous()
            for t in (fold(t, d) for t, d in zip((x, tape), in_dims[_TENSORS + 4 :], strict=False))
        )
        full = (size * scenes, *x_bar.shape[-2:])
        # shared inputs get a gradient for each member of the batch: give every differentiated one its own scenes
        spread: list[Any] = [t.expand(size * scenes, *t.shape[1:]).contiguous() if t is not None and need else t
                  for t, need in zip(folded[1 : _TENSORS + 1], needs, strict=True)]  # fmt: skip
        spread[:3] = [t.expand(full).contiguous() for t in spread[:3]]
        out = _SweepBackward.apply(folded[0].expand(full), *spread, folded[-1], packed_rest, plan, x, tape, settings,
                                   tape_policy, needs)  # fmt: skip
        out = out if isinstance(out, tuple) else (out,)
        shapes = [t.shape[0] if d is None else t.movedim(d, 0).shape[1]
                  for t, d, need in zip(saved[:_TENSORS], in_dims[1:], needs, strict=False) if need]  # fmt: skip
        result = tuple(
            o.unflatten(0, (size, scenes)) if n == scenes else _member_sum(o.unflatten(0, (size, scenes)))
            for o, n in zip(out, shapes, strict=True)
        )
        return result, (0,) * len(result)


# apply() asks for the signature of forward at every call: ready-made, it costs less.
for _function in (_RowSum, _Broadcast, _TetGather, _StarSum, _Sweep, _SweepBackward):
    _function.forward.__signature__ = inspect.signature(_function.forward)  # type: ignore[attr-defined]


def _member_sum(values: Tensor) -> Tensor:
    """[N, B, ...] -> [N, 1, ...]: what the scenes of each member add to an input that they share."""
    return _sum_to(values, (values.shape[0], 1, *values.shape[2:]))


def _scenes(tensors: Sequence[Tensor | None], in_dims: tuple) -> int:
    sizes = [1]
    for t, d in zip(tensors, in_dims, strict=False):
        if t is not None and t.numel() > 0:
            sizes.append((t if d is None else t.movedim(d, 0)[0]).shape[0])
    return max(sizes)


def sweep(x_start, x_prev, y, mu, lam, mass, rest, energy_data, origin, packed_rest, plan, settings: SweepSettings, *,
          tape_policy: int, debug_step: int = -1, checked: bool = True) -> Tensor:  # fmt: skip
    """Positions after the sweeps, [B, V, 3], differentiable in the first eight tensors.

    Args:
        x_start, x_prev, y: Start of the sweep, start of the step, predictor [m], [B, V, 3].
        mu, lam: [1 | B, 1 | T] [Pa]; mass: [1 | B, V] [kg].
        rest: [1 | B, T, 7], or None for the Model's own ``packed_rest`` [1, slots, 4, 8].
        energy_data: [1 | B, n], see VertexEnergy.pack; origin: [B, V, 3] or empty.
        tape_policy: What is kept for the backward; NO_TAPE runs the step again there.
    """
    tensors = (x_start, x_prev, y, mu, lam, mass, rest, energy_data, origin)
    distinct: list[Tensor | None] = []
    for t in tensors:
        t = t if t is None else t.contiguous()
        # torch.compile refuses one tensor in two places
        distinct.append(t.view_as(t) if t is not None and any(t is other for other in distinct) else t)
    x, _ = _Sweep.apply(*distinct, packed_rest, plan, settings, tape_policy, debug_step, checked)
    return x
