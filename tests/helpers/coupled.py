"""Scenes with springs, tendons and pressure: a box with a cavity, pinned or free, and a cube beside it."""

from typing import Any

import numpy as np
import torch
from torch import Tensor

import diffvbd as dv
from diffvbd.testing import generator


def hollow_box(cells: tuple[int, int, int] = (3, 3, 3), size: Any = 0.3, low: int = 1) -> dv.TetMesh:
    """A box without its inner cells; ``low``: cells of the lower wall."""
    box = dv.mesh.box([n + 1 for n in cells], size, split="kuhn")
    at = box.points[box.tets].mean(1) / (np.asarray(size) / np.asarray(cells))
    hole = ((at > (1, low, 1)) & (at < np.asarray(cells) - 1)).all(1)
    used, tets = np.unique(box.tets[~hole], return_inverse=True)
    return dv.TetMesh(box.points[used], tets.reshape(-1, 4))


def coupled(*extra: Any, pinned: bool = True, gas: bool = False, places: bool = False, tension_only: bool = False,
            law: Any = None, device: Any = "cpu") -> dv.Model:  # fmt: skip
    """All three couplings at once, and other energies; law: the elastic one, default: stable Neo-Hookean."""
    mesh = dv.mesh.join([hollow_box(), dv.mesh.cube(2, 0.1).translate((0.5, 0.1, 0.1))])
    first = dv.Embedding.of_points(mesh, [[0.3, 0.15, 0.15], [0.28, 0.03, 0.1]])
    second = dv.Embedding.of_points(mesh, [[0.5, 0.14, 0.15], [0.52, 0.13, 0.12]])
    route = dv.Embedding.of_points(mesh, [[0.05, 0.3, 0.1], [0.15, 0.3, 0.12], [0.29, 0.28, 0.1], [0.55, 0.15, 0.15]])
    frame = torch.tensor([[0.52, 0.1, 0.1], [0.4, 0.2, 0.1]])
    energies = (
        dv.StableNeoHookean() if law is None else law,
        dv.Springs(first, frame if places else second, 100.0, tension_only=tension_only),
        dv.Tendons(route, [[0, 1, 2], [3, 2]], 80.0, 0.2),
        dv.Pressure(pressure=900.0, gas=gas),
    )
    pins = mesh.points[:, 0] < 1e-9 if pinned else None
    return dv.Model(mesh, pinned=pins, energies=(*energies, *extra), device=device)


def inputs_of(model: dv.Model, batch: tuple[int, ...] = ()) -> dict[str, Tensor]:
    """Every differentiable input of a step, x and v among them, a little off the rest shape."""
    rng = generator("coupled", batch)

    def noise(*shape: int) -> Tensor:
        return torch.from_numpy(rng.standard_normal(shape))

    rest, state, tets = model.rest_points.cpu(), (*batch, model.num_vertices, 3), (*batch, model.num_tets)
    values = {
        "x": rest + 2e-3 * noise(*state),
        "v": 0.2 * noise(*state),
        "mu": 2e4 * torch.exp(0.2 * noise(*tets)),
        "lam": 4e4 * torch.exp(0.2 * noise(*tets)),
        "force": 0.3 * noise(*state),
        "rest_points": rest + 1e-3 * noise(model.num_vertices, 3),
        "density": model.density.cpu(),
        "spring_stiffness": torch.tensor([400.0, 30.0]),
        "spring_rest_length": torch.tensor([0.1, 0.02]),
        "tendon_stiffness": torch.tensor([80.0, 50.0]),
        "tendon_rest_length": torch.tensor([0.2, 0.21]),
        "pressure": torch.full((*batch, 1), 900.0),
    }
    if "spring_points" in model.inputs:
        values["spring_points"] = torch.tensor([[0.52, 0.1, 0.1], [0.4, 0.2, 0.1]])
    if "anchor_stiffness" in model.inputs:
        values["anchor_stiffness"] = torch.from_numpy(rng.uniform(10, 30, model.num_vertices))
    return {name: value.double().to(model.device) for name, value in values.items()}
