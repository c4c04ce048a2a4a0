"""Constants of the safeguards, and where the sweeps of a step start above a floor.

The constants travel to the compiled kernels as arguments, so each exists once.
"""

from __future__ import annotations

import torch
from torch import Tensor

SATURATION_EPS = 1e-12  # [m], keeps |d| + c + eps away from 0 (paper, appendix on safeguards)
FILTER_ETA = 0.9  # largest fraction of a gap that one move may close (method.md, section 6)
GUARD_ULPS = 8  # a computed gap below this many roundings of its terms has no safe sign
PARALLEL = 1e-6  # squared sine below which a plane counts as parallel to those that bind; twin in floor_start.h


def filter_against_planes(
    x: Tensor, step: Tensor, normal: Tensor, height: Tensor, dhat: Tensor, origin: Tensor | None
) -> Tensor:
    """Returns the position after as much of ``step`` as the start of a step may take toward planes.

    What would approach a plane within its dhat, or close more than FILTER_ETA of the way to there, is taken away along
    the normal. A start does not minimise the barrier: what it closed in every step the sweeps would have to open again.

    Args:
        x: Positions above every plane [m], shape [B, V, 3].
        step: Wanted moves [m], shape [B, V, 3].
        normal: Unit normals, shape [1 | B, P, 3].
        height, dhat: Plane heights and activation distances [m], shape [1 | B, P].
        origin: Body-local origins that x is relative to [m], shape [B, V, 3], or None.

    Returns:
        Positions strictly above every plane, shape [B, V, 3]; piecewise smooth in all arguments.

    Twin of csrc/energies/floor_start.h, which parts of a step with contact start by; docs/method.md, section 6.
    """
    n = normal[:, None]  # [B, 1, P, 3]
    local_height = height[:, None]
    if origin is not None:
        local_height = local_height - (n * origin[:, :, None]).sum(-1)
    gap = (n * x[:, :, None]).sum(-1) - local_height  # [B, V, P]
    room = FILTER_ETA * (gap - dhat[:, None]).clamp(min=0)
    moved = _within(room, n, step)
    with torch.no_grad():  # rounding must not undo it: a gap that cannot be told from zero keeps its vertex where it is
        new_gap = (n * (x + moved)[:, :, None]).sum(-1) - local_height
        world = x if origin is None else x + origin
        guard = (n * world[:, :, None]).abs().sum(-1) + height[:, None].abs()
        safe = (new_gap > GUARD_ULPS * torch.finfo(x.dtype).eps * guard).all(-1, keepdim=True)
    return x + torch.where(safe, moved, torch.zeros_like(moved))


def _within(room: Tensor, n: Tensor, step: Tensor) -> Tensor:
    """The step less what approaches a plane by more than its ``room`` [B, V, P].

    Planes bind one after the other, the one exceeded most first, each along the part of its normal that leaves those
    before it as they are: with one or two planes that is the closest motion there is. Where more of them leave no such
    way, the whole step is shortened.
    """

    def excess_of(move: Tensor) -> Tensor:
        return -(n * move[:, :, None]).sum(-1) - room

    planes = room.shape[-1]
    length = (step.detach() ** 2).sum(-1)
    slack = 8 * torch.finfo(step.dtype).eps * length.sqrt()
    if planes == 1:  # the same in fewer operations
        excess, own = excess_of(step), n[..., 0, :]
        excess = torch.where(excess.detach() > slack[..., None], excess, torch.zeros_like(excess))
        return step + excess / (own * own).sum(-1, keepdim=True) * own
    every, index = n.expand(*room.shape, 3), torch.arange(planes, device=step.device)
    bound = torch.zeros_like(room, dtype=torch.bool)
    stuck = torch.zeros_like(slack, dtype=torch.bool)
    out, taken = step, []
    for _ in range(min(planes, 3)):
        excess = excess_of(out)
        most, worst = excess.detach().masked_fill(bound, -torch.inf).max(-1, keepdim=True)
        w = own = every.gather(-2, worst[..., None].expand(*worst.shape, 3))[..., 0, :]
        for other, square in taken:
            w = w - ((own * other).sum(-1) / square)[..., None] * other
        square = (w * w).sum(-1)
        binds = most[..., 0] > slack
        stuck = stuck | (binds & (square <= PARALLEL))
        binds = binds & (square > PARALLEL)
        square = torch.where(binds, square, torch.ones_like(square))
        w = torch.where(binds[..., None], w, torch.zeros_like(w))
        out = out + (excess.gather(-1, worst)[..., 0] / square)[..., None] * w
        taken.append((w, square))
        bound = bound | ((index == worst) & binds[..., None])
    with torch.no_grad():
        stuck = stuck | (excess_of(out).masked_fill(bound, -torch.inf) > slack[..., None]).any(-1)
        stuck = stuck | ((out * out).sum(-1) > (1 + 1e-6) * length)
    over = excess_of(step) > 0
    towards = torch.where(over, (n * step[:, :, None]).sum(-1), -torch.ones_like(room))
    alpha = torch.where(over, -room / towards, torch.ones_like(room)).min(-1, keepdim=True).values
    return torch.where(stuck[..., None], alpha * step, out)
