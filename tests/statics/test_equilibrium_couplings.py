"""Claim: dv.equilibrium takes springs, tendons and pressure: rest states, their gradients, and closed forms."""

import math
from typing import Any

import numpy as np
import pytest
import torch
from helpers.coupled import coupled, inputs_of
from helpers.dense_statics import newton, potential, residual, weight
from torch import Tensor

import diffvbd as dv
from diffvbd.testing import tolerance

SOLVER = dv.VBD(1.0, 0, subspace="coarse")
STILL = (0.0, 0.0, 0.0)


def points_of(embedding: dv.Embedding, x: Tensor) -> Tensor:
    return (embedding.weights[..., None] * x[embedding.vertices]).sum(1)


def energy_of(model: dv.Model, x: Tensor, values: dict[str, Any]) -> Tensor:
    """Energy [J] of all couplings of a Model, from the definitions."""
    total = x.new_zeros(())
    for energy in model.couplings:
        if isinstance(energy, dv.Springs):
            places = not isinstance(energy.second, dv.Embedding)
            second = values["spring_points"] if places else points_of(energy.second, x)
            longer = (points_of(energy.first, x) - second).norm(dim=-1) - values["spring_rest_length"]
            longer = longer.clamp(min=0) if energy.tension_only else longer
            total = total + (values["spring_stiffness"] / 2 * longer**2).sum()
        elif isinstance(energy, dv.Tendons):
            points = points_of(energy.points, x)
            lengths = [(points[r[1:]] - points[r[:-1]]).norm(dim=-1).sum() for r in map(list, energy.routes)]
            longer = (torch.stack(lengths) - values["tendon_rest_length"]).clamp(min=0)
            total = total + (values["tendon_stiffness"] / 2 * longer**2).sum()
        elif isinstance(energy, dv.Pressure):
            for triangles in energy.surfaces:
                now, rest = (torch.linalg.det(p[torch.as_tensor(triangles.copy())]).sum().abs() / 6
                             for p in (x, model.rest_points))  # fmt: skip
                p = values["pressure"].sum()
                total = total - p * now
                if energy.gas:
                    total = total + p * now + 101_325.0 * now - (p + 101_325.0) * rest * torch.log(now / rest)
    return total


SCENES: dict[str, tuple[dict[str, Any], dict[str, float]]] = {
    "all three": ({}, {}),
    "gas, places": ({"gas": True, "places": True}, {}),
    "cables": ({"tension_only": True}, {"spring_rest_length": 0.9}),  # some of which are slack
    "soft": ({}, {"mu": 0.2, "lam": 0.2}),
}


@pytest.mark.parametrize("name", SCENES)
def test_rest_states(name: str) -> None:
    options, factors = SCENES[name]
    model = coupled(**options)
    inputs = inputs_of(model)
    for key in ("x", "v", "rest_points", "density"):
        del inputs[key]
    for key, factor in factors.items():
        inputs[key] = factor * inputs[key]
    x = model.rest_points
    done = dv.equilibrium(model, x, SOLVER, tolerance=1e-11, **inputs)
    moved = float((done.x - x).abs().max())
    load = weight(model) + inputs["force"]
    energy = potential(model, load, inputs["mu"], inputs["lam"], lambda at: energy_of(model, at, inputs))
    assert done.converged and moved > 5e-3
    assert residual(model, energy, load, done.x) < 1e-8
    assert float((done.x - newton(model, energy, x)).abs().max()) < 1e-6 * moved
