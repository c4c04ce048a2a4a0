"""Which sweep color moves a point."""

from __future__ import annotations

import itertools

import torch
from torch import Tensor

import diffvbd as dv


def colors(model: dv.Model, points: int) -> Tensor:
    """Color of each of the points [points], vertices first; -1 where no sweep moves it."""
    out = torch.full((points,), -1)
    for color, (first, end) in enumerate(itertools.pairwise(model.color_ptr.tolist())):
        out[model.color_vertices[first:end].cpu()] = color
    return out
