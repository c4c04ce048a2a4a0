"""A cushion below y = 0, written as an energy in PyTorch: its stiffness from how deep a cube sinks in."""

import torch

import diffvbd as dv

mesh = dv.mesh.cube(3, size=0.1).translate((0.0, 0.02, 0.0))  # [m]
model = dv.Model(mesh, density=500.0)
solver = dv.VBD(time_step=0.005, sweeps=20)
x, v = model.rest_points, torch.zeros_like(model.rest_points)


def cushion(x, stiffness):
    """Energy [J] of positions x [V, 3]: k/2 d^2 at depth d, for each vertex."""
    return 0.5 * stiffness * (-x[..., 1]).clamp(min=0).square().sum()


gradient = torch.func.grad(cushion)  # with respect to x; differentiable again


def simulate(stiffness):
    def force(step, x, v):
        return -gradient(x, stiffness)

    return dv.rollout(model, x, v, solver, steps=60, young=2e4, poisson=0.3, force=force).x


with torch.no_grad():
    observed = simulate(torch.tensor(20.0, dtype=x.dtype))
log_k = torch.tensor(10.0, dtype=x.dtype).log().requires_grad_()
optimizer = torch.optim.LBFGS([log_k], max_iter=15, tolerance_grad=0.0, line_search_fn="strong_wolfe")


def loss():
    optimizer.zero_grad()
    error = (simulate(log_k.exp()) - observed).square().sum() / (observed - x).square().sum()
    error.backward()
    return error


optimizer.step(loss)
print(f"stiffness {log_k.exp().item():.4f} N/m, true 20 N/m")
