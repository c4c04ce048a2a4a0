"""Vertices of bodies of given sizes, in any order, of which some are held: what operators on bodies read."""

import numpy as np
import torch
from torch import Tensor


def grouped(sizes: list[int], rng: np.random.Generator, held: float, device: str) -> tuple[Tensor, ...]:
    """held bool [n], held_bodies bool [bodies], order and ptr int32, each vertex held with a chance of ``held``."""
    n = sum(sizes)
    order, ptr = rng.permutation(n).astype(np.int32), np.cumsum([0, *sizes]).astype(np.int32)
    holds = rng.random(n) < held
    pinned_bodies = np.array([holds[order[a:b]].any() for a, b in zip(ptr[:-1], ptr[1:], strict=True)], dtype=bool)
    return tuple(torch.as_tensor(a, device=device) for a in (holds, pinned_bodies, order, ptr))
