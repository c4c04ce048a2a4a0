"""Young's modulus along a beam, from a picture of how it hangs at rest."""

import torch

import diffvbd as dv

mesh = dv.mesh.beam(13, 2, 2, size=(0.6, 0.08, 0.08))  # [m]
model = dv.Model(mesh, density=1000.0, pinned=mesh.points[:, 0] == 0.0)
solver = dv.VBD(time_step=1.0, sweeps=0, subspace="coarse")  # of which equilibrium takes the subspace alone
markers = torch.as_tensor(mesh.points[:, 2] == 0.0)  # on the side that the camera sees
sections = torch.as_tensor(mesh.points[mesh.tets].mean(1)[:, 0] / 0.6 * 4).long()  # of each tet, 0 to 3


def hangs(log_young, x=model.rest_points):
    return dv.equilibrium(model, x, solver, young=log_young.exp()[sections], poisson=0.3)


truth = torch.tensor([4e5, 1e5, 2e5, 1e5], dtype=torch.float64)  # [Pa]
with torch.no_grad():
    observed = hangs(truth.log()).x[markers]

log_young = torch.full((4,), 2e5, dtype=torch.float64).log().requires_grad_()
optimizer = torch.optim.LBFGS([log_young], max_iter=50, tolerance_change=1e-14, line_search_fn="strong_wolfe")


def loss():
    optimizer.zero_grad()
    error = (hangs(log_young).x[markers] - observed).square().sum()
    error.backward()
    return error


sag = (model.rest_points - hangs(log_young.detach()).x)[:, 1].max().item()
optimizer.step(loss)
print(f"the beam would sag by {sag:.3f} m; it sags by {(model.rest_points[markers] - observed)[:, 1].max():.3f} m")
print("Young's modulus [kPa]:", ", ".join(f"{young / 1000:.1f}" for young in log_young.exp().tolist()))
assert ((log_young.detach().exp() / truth - 1).abs() < 0.01).all()
