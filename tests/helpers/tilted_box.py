"""A box that falls on a floor edge first, whose converged steps corrections have missed."""

from typing import Any

import torch
from torch import Tensor

import diffvbd as dv

SOFT: dict[str, Any] = {"young": 1e5, "poisson": 0.3, "gravity": (0.0, 0.0, 0.0)}


def tilted_box() -> tuple[dv.Model, Tensor, Tensor]:
    box = dv.mesh.box(3, 0.1)
    points = torch.tensor(box.points) - 0.05
    c, s = torch.tensor(0.3).double().cos(), torch.tensor(0.3).double().sin()
    about_z = torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]], dtype=torch.float64)
    about_x = torch.tensor([[1, 0, 0], [0, c, -s], [0, s, c]], dtype=torch.float64)
    points = points @ (about_z @ about_x).T
    points[:, 1] += 0.006 - points[:, 1].min()
    energies = (dv.StableNeoHookean(), dv.FloorBarrier(kappa=2e5, dhat=5e-3))
    model = dv.Model(dv.TetMesh(points.numpy(), box.tets), energies=energies)
    v = torch.zeros_like(model.rest_points)
    v[:, 1] = -2.0
    return model, model.rest_points, v
