"""Young's modulus and Poisson's ratio of a soft body from the motion of its markers."""

import math

import torch

import diffvbd as dv

mesh = dv.mesh.beam(9, 3, 3, size=(0.4, 0.1, 0.1))  # [m]
model = dv.Model(mesh, density=1000.0, pinned=mesh.points[:, 0] == 0.0)
solver = dv.VBD(time_step=0.005, sweeps=8, subspace="coarse", relaxation=1.5)
x, v = model.rest_points, torch.zeros_like(model.rest_points)
v[:, 2] = 4.0 * x[:, 0]  # a sideways swing [m/s]
v[model.pinned] = 0.0
markers = torch.arange(5, mesh.num_vertices, 7)


def material(raw):
    """Any two real numbers give E > 0 and 0 < nu < 0.5."""
    return {"young": raw[0].exp(), "poisson": 0.5 * raw[1].sigmoid()}


def simulate(raw):
    return dv.rollout(model, x, v, solver, steps=40, **material(raw)).x[1:, markers]


truth = torch.tensor([math.log(8e4), math.log(0.4 / 0.1)], dtype=torch.float64)  # 80 kPa, 0.4
with torch.no_grad():
    observed = simulate(truth)

raw = torch.tensor([math.log(2e4), 0.0], dtype=torch.float64, requires_grad=True)  # 20 kPa, 0.25
optimizer = torch.optim.LBFGS([raw], max_iter=40, tolerance_grad=0.0, line_search_fn="strong_wolfe")


def loss():
    optimizer.zero_grad()
    error = (simulate(raw) - observed).square().sum() / (observed - x[markers]).square().sum()
    error.backward()
    return error


optimizer.step(loss)
found = {name: value.item() for name, value in material(raw).items()}
print(f"Young's modulus {found['young']:.0f} Pa, Poisson's ratio {found['poisson']:.4f}; true 80000 Pa, 0.4")
