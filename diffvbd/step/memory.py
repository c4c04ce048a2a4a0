"""What a step needs of memory on CUDA, and what it says where that is not there."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import torch
from torch import Tensor

from .. import ops
from ..adjoint.sweep import is_out_of_memory
from ..mask import VERTEX_ENERGIES
from ..model.coarse_plan import TILE
from ..model.system import System
from ..ops import regimes


@contextlib.contextmanager
def out_of_memory_named(model: System, x: Tensor, settings: ops.SweepSettings, policy: int) -> Iterator[None]:
    """Says of a step that does not fit the memory how much it wanted, and which tape would fit a CUDA device."""
    try:
        yield
    except (RuntimeError, MemoryError) as error:
        if not is_out_of_memory(error) or isinstance(error, torch.OutOfMemoryError) and not x.is_cuda:
            raise
        scalars = x.shape[0] * settings.sweeps * model.num_active * x.element_size()
        base = 2 * x.numel() * x.element_size()
        base += cuda_scratch(model, x.shape[0], reverse=False) if x.is_cuda else 0
        wanted = {name: base + scalars * ops.tape_rows(code, model.energy_mask) for name, code in _POLICIES.items()}
        chosen = next(name for name, code in _POLICIES.items() if code == policy)
        if not x.is_cuda:
            smaller = [f'"{name}" {size} bytes' for name, size in wanted.items() if size < wanted[chosen]]
            advice = f", or a smaller VBD(tape=...): {', '.join(smaller)}" if smaller else ""
            raise torch.OutOfMemoryError(
                f'CPU out of memory: a step of {settings.sweeps} sweeps with tape="{chosen}" wanted {wanted[chosen]} '
                f"bytes; use fewer sweeps or scenes{advice}"
            ) from error
        free, _ = torch.cuda.mem_get_info(x.device)
        free += torch.cuda.memory_reserved(x.device) - torch.cuda.memory_allocated(x.device)
        fits = [f'"{name}" ({bytes_wanted} bytes)' for name, bytes_wanted in wanted.items() if bytes_wanted <= free]
        advice = f"VBD(tape=...) that fits: {', '.join(fits)}" if fits else "no tape policy fits: fewer scenes"
        raise torch.OutOfMemoryError(
            f'CUDA out of memory: a step with tape="{chosen}" wanted {wanted[chosen]} bytes, {free} are free; {advice}'
        ) from error


_POLICIES = {"full": ops.FULL_TAPE, "compact": ops.COMPACT_TAPE, "recompute": ops.NO_TAPE}
WORKSPACE_BUDGET = 2 << 30  # bytes; twin of kWorkspaceBudget in csrc/bind/cuda/sweep.h


def cuda_scratch(model: System, scenes: int, *, reverse: bool, material: bool = True, rest: bool = False) -> int:
    """Bytes of workspace of one step on CUDA, as carved in csrc/cuda/run.cuh (a material per tet)."""
    corrects = model.coarse is not None
    launch = regimes.choose(model.num_vertices, model.num_colors, scenes, model.touches, corrects)
    if launch[0] == regimes.THREAD:
        return 0
    _, _, slots, _, _, blocks, edge_slots, *_ = model._sizes
    lanes = ops.LANES["cuda"]
    positions, pairs = blocks * lanes, slots * lanes
    one = 8 * positions + (6 * positions if model.floor else 0) + 2 * pairs
    one += 3 * positions if model.dtype == torch.float32 else 0  # local origins
    if reverse:
        one += 4 * (edge_slots * lanes + 1) + 8 * positions
        one += (2 * pairs if material or rest else 0) + (4 * pairs if rest else 0)
    if model.touches:
        one += ((6 if reverse else 4) + (0 if launch[2] == regimes.MANY_LANES else 9)) * positions
    if corrects:
        sizes = model._coarse_plan.sizes
        one += 8 * positions + 3 * sizes.functions + (0 if reverse else 6 * sizes.parts)
        if model.energy_mask & VERTEX_ENERGIES and not model.touches:  # in float64: blocks, matrices, their inversion
            double, tile = 8 // model._mass.element_size(), sizes.functions * 6 + TILE * sizes.bodies
            one += double * (6 * positions + 9 * sizes.cells + TILE * tile)
            one += 9 * sizes.cells + (4 * positions if reverse else 0)
    one *= model._mass.element_size()
    return one * min(scenes, max(1, WORKSPACE_BUDGET // max(1, one)))
