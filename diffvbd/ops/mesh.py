"""The compiled operators on a mesh: its plan, and rest shapes as the sweeps read them."""

from __future__ import annotations

import torch
from torch import Tensor

from .fields import LANES, PLAN_HEADER
from .functions import raw_backward, shapes_of
from .load import raw

PAIR_REST = 4  # scalars of a rest shape that one vertex sees; twin of TetLayout::pair_rest in csrc/energies/tet.h


def build_plan(
    points: Tensor, tets: Tensor, active: Tensor, lanes: int
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Plan, color_ptr, color_vertices, star_ptr and star of a mesh, see csrc/cpu/plan.h; lanes: of :data:`LANES`."""
    return raw.build_plan(points, tets, active, lanes)


def plan_order(plan: Tensor, lanes: int) -> Tensor:
    """The vertex at each position of the sweep order [blocks lanes], -1: none; see csrc/core/plan_views.h."""
    colors, blocks = plan[3:5].tolist()
    return plan.narrow(0, PLAN_HEADER + colors + 1 + 4 * (blocks + 1), blocks * lanes).cpu()


def pack_rest(rest: Tensor, plan: Tensor, sizes: tuple[int, ...]) -> Tensor:
    """Rest scalars of the tets [B, T, 7] -> as their vertices see them [B, slots, 4, lanes]. Not differentiable."""
    return raw.pack_rest(rest.contiguous(), plan, sizes)


@shapes_of("pack_rest")
def _(rest, plan, sizes):
    row = (
        PAIR_REST if rest.device.type == "cpu" else -(-PAIR_REST // 4) * 4
    )  # whole loads: kRestRow in csrc/cuda/step.h
    return rest.new_empty((rest.shape[0], sizes[2], row, LANES[rest.device.type]))


torch.library.register_autograd("diffvbd::pack_rest", raw_backward)
