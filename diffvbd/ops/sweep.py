"""The compiled operators of sweeps, of whole steps on CUDA and of a mesh's plan: shapes without execution."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from .fields import LANES, REST_SCALARS, tape_shape
from .functions import raw_backward
from .load import raw


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


for _name in ("sweep", "sweep_backward", "fused_step", "fused_step_backward", "pack_rest"):
    torch.library.register_autograd(f"diffvbd::{_name}", raw_backward)


def build_plan(
    points: Tensor, tets: Tensor, active: Tensor, lanes: int
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Plan, color_ptr, color_vertices, star_ptr and star of a mesh, see csrc/cpu/plan.h; lanes: of :data:`LANES`."""
    return raw.build_plan(points, tets, active, lanes)


def pack_rest(rest: Tensor, plan: Tensor, sizes: tuple[int, ...]) -> Tensor:
    """Rest scalars of the tets [B, T, 7] -> as their vertices see them [B, slots, 4, lanes]. Not differentiable."""
    return raw.pack_rest(rest.contiguous(), plan, sizes)
