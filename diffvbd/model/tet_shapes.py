"""How thin the tets of a mesh are, and which tets of a state are inside out."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

if TYPE_CHECKING:
    from .model import Model


def height_of_tets(model: Model) -> np.ndarray:
    """The shortest of each tet's four heights [m], [T]."""
    return model.derived("shapes of tets", lambda: _shapes_of_tets(model))[0]


def thinness(model: Model) -> tuple[float, float]:
    """Longest edge over shortest height [-], and that height [m], of the median tet."""
    return model.derived("shapes of tets", lambda: _shapes_of_tets(model))[1:]


def _shapes_of_tets(model: Model) -> tuple[np.ndarray, float, float]:
    corners = model.mesh.points[model.mesh.tets]
    edges = corners[:, 1:] - corners[:, :1]
    normals = np.stack([np.cross(edges[:, i], edges[:, j]) for i, j in ((1, 2), (2, 0), (0, 1))], 1)
    volume = np.abs((edges[:, 0] * normals[:, 0]).sum(-1))
    normals = np.concatenate([normals, -normals.sum(1, keepdims=True)], 1)
    height = volume / np.linalg.norm(normals, axis=-1).max(1)
    sides = np.linalg.norm(corners[:, [0, 0, 0, 1, 1, 2]] - corners[:, [1, 2, 3, 2, 3, 3]], axis=-1)
    return height, float(np.median(sides.max(1) / height)), float(np.median(height))


def inside_out(tets: Tensor, x: Tensor) -> Tensor:
    """Which tets [T, 4] of states [..., V, 3] have a volume of 0 or less, bool [..., T]."""
    corners = x.detach()[..., tets, :]
    a, b, c = (corners[..., 1:, :] - corners[..., :1, :]).unbind(-2)
    return (torch.linalg.cross(a, b) * c).sum(-1) <= 0
