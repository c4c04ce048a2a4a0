"""Values that differ from entry to entry, the same in every run, and the length of a step."""

import math

import torch
from torch import Tensor

import diffvbd as dv

STEP = {"solver": dv.VBD(1 / 60, 3)}


def uniform(*shape: int, low: float = 0.5, high: float = 1.5) -> Tensor:
    generator = torch.Generator().manual_seed(math.prod(shape) + 10 * len(shape))
    return low + (high - low) * torch.rand(shape, dtype=torch.float64, generator=generator)
