"""Constants of the safeguards, and the step filter that prepares the start of a sweep.

The constants travel to the compiled kernels as arguments, so each exists once.
"""

from __future__ import annotations

import torch
from torch import Tensor

SATURATION_EPS = 1e-12  # [m], keeps |d| + c + eps away from 0 (paper, appendix on safeguards)
FILTER_ETA = 0.9  # largest fraction of a gap that one move may close (method.md, section 6)
GUARD_ULPS = 8  # a computed gap below this many roundings of its terms has no safe sign


def filter_against_planes(x: Tensor, step: Tensor, normal: Tensor, height: Tensor, origin: Tensor | None) -> Tensor:
    """Returns the position after as much of ``step`` as every plane allows.

    Args:
        x: Positions above every plane [m], shape [B, V, 3].
        step: Wanted moves [m], shape [B, V, 3].
        normal: Unit normals, shape [1 | B, P, 3].
        height: Plane heights [m], shape [1 | B, P].
        origin: Body-local origins that x is relative to [m], shape [B, V, 3], or None.

    Returns:
        Positions strictly above every plane, shape [B, V, 3]; piecewise smooth in all arguments.
    """
    n = normal[:, None]  # [B, 1, P, 3]
    local_height = height[:, None]
    if origin is not None:
        local_height = local_height - (n * origin[:, :, None]).sum(-1)
    gap = (n * x[:, :, None]).sum(-1) - local_height  # [B, V, P]
    change = (n * step[:, :, None]).sum(-1)
    closing = change < 0
    fraction = FILTER_ETA * gap / torch.where(closing, -change, torch.ones_like(change))
    fraction = torch.where(closing & (fraction < 1), fraction, torch.ones_like(fraction))
    alpha = fraction.min(dim=-1).values
    with torch.no_grad():
        moved = x + alpha[..., None] * step
        new_gap = (n * moved[:, :, None]).sum(-1) - local_height
        world = x if origin is None else x + origin
        guard = (n * world[:, :, None]).abs().sum(-1) + height[:, None].abs()
        safe = (new_gap > GUARD_ULPS * torch.finfo(x.dtype).eps * guard).all(-1)
    alpha = torch.where(safe, alpha, torch.zeros_like(alpha))
    return x + alpha[..., None] * step
