"""The search for neighboring points: its compiled operator, and the errors that only its result shows."""

from __future__ import annotations

from typing import Any, NoReturn

import torch
from torch import Tensor

from ..scopes import is_captured
from .functions import shapes_of
from .load import raw


@shapes_of("neighbor_pairs")
def _(points, radius, max_pairs):
    return points.new_empty((max_pairs, 3), dtype=torch.int32), points.new_empty((1,), dtype=torch.int64)


def _raw_backward(ctx: Any, *grads: Tensor) -> NoReturn:
    raise NotImplementedError(
        "diffvbd: pairs have no gradient; call diffvbd.contact.center_of_mass_penalty for a force that has"
    )


torch.library.register_autograd("diffvbd::neighbor_pairs", _raw_backward)


def neighbor_pairs(points: Tensor, radius: float, max_pairs: int, *, name: str = "points") -> tuple[Tensor, Tensor]:
    """Pairs of points of one scene that are closer than a radius.

    The squared distance is compared as it rounds, (dx^2 + dy^2) + dz^2 < radius^2 in the dtype of the points, alike on
    every device. There is no gradient through indices.

    Args:
        points: Positions [m], shape [B, N, 3], float64 or float32, B scenes.
        radius: Distance below which two points are neighbors [m].
        max_pairs: The most pairs of all scenes together that there is room for.
        name: What an error calls the points.

    Returns:
        pairs: (scene, i, j) with i < j, int32, in lexicographic order. All rows are found pairs, but where the host may
            not wait for the device (capture of a CUDA graph, torch.compile): there the shape is [max_pairs, 3], and
            unused rows are -1.
        count: The number of pairs, int64, shape [1]. Where it was not read, the caller must: above ``max_pairs``, or
            -1 for points that are not finite, ``pairs`` is empty of pairs.

    Raises:
        ValueError: More pairs than ``max_pairs`` (the message says how many), points that are not finite, or a radius
            whose square is no normal number of the dtype.

    Source: uniform grid with cells as wide as the radius, as in the paper's appendix on implementation.
    """
    points = points.detach().contiguous()
    pairs, count = raw.neighbor_pairs(points, radius, max_pairs)
    if unread(points):
        return pairs, count
    found = int(count)
    if found < 0:
        where = (~torch.isfinite(points)).nonzero()[0].tolist()
        raise ValueError(f"{name}: expected finite values, got {float(points[tuple(where)]):g} at {where}")
    if found > max_pairs:
        raise ValueError(f"max_pairs: expected room for {found} pairs within {radius:g} m, got {max_pairs}")
    return pairs[:found], count


def unread(points: Tensor) -> bool:
    """Whether results on the points' device must not be looked at now."""
    return torch.compiler.is_compiling() or is_captured(points)
