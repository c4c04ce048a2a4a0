"""Derivative of a beam's height with respect to its shear modulus, checked by differences."""

import torch

import diffvbd as dv

mesh = dv.mesh.beam(6, 3, 3, size=(0.5, 0.2, 0.2))  # vertices along x, y, z; size [m]
model = dv.Model(mesh, density=1000.0, pinned=mesh.points[:, 0] == 0.0)
solver = dv.VBD(time_step=0.01, sweeps=40)
x, v = model.rest_points, torch.zeros_like(model.rest_points)


def height(mu):
    motion = dv.rollout(model, x, v, solver, steps=20, mu=mu, lam=2e5)
    return motion.x[-1, :, 1].mean()


mu = torch.tensor(1e5, dtype=torch.float64, requires_grad=True)  # [Pa]
height(mu).backward()
print(f"height {height(mu).item():.5f} m, gradient {mu.grad.item():.4e} m/Pa")

check = dv.check_gradients(height, {"mu": mu.detach()}, verbose=False)
print("differences agree:", check.ok)
