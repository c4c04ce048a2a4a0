"""A soft cube that lands on a floor and slides: its way, with the gradient, beside Coulomb's law for a rigid block."""

import torch

import diffvbd as dv

mesh = dv.mesh.cube(3, size=0.1).translate((0.0, 0.012, 0.0))  # [m]
energies = (
    dv.StableNeoHookean(),
    dv.FloorBarrier(height=0.0, kappa=2000.0, dhat=0.01),
    dv.Friction(0.3, velocity=0.01),
)
model = dv.Model(mesh, density=1000.0, energies=energies)
solver = dv.VBD(time_step=0.002, sweeps=10)
x = model.rest_points


def distance(speed, friction):
    """Mean displacement along x [m] after 0.4 s."""
    v = speed * torch.tensor([1.0, 0.0, 0.0], dtype=x.dtype).expand_as(x)
    end = dv.rollout(model, x, v, solver, steps=200, save="last", young=1e5, poisson=0.3, friction=friction)
    return (end.x[-1] - x)[:, 0].mean()


speed = torch.tensor(0.8, dtype=torch.float64, requires_grad=True)  # [m/s]
friction = torch.tensor(0.3, dtype=torch.float64, requires_grad=True)
slide = distance(speed, friction)
slide.backward()

rigid = 0.8**2 / (2 * 0.3 * 9.81)
print(f"slides {slide.item():.4f} m; a rigid block {rigid:.4f} m")
print(f"gradient {speed.grad.item():.3f} m per m/s; a rigid block {2 * rigid / 0.8:.3f}")
print(f"gradient {friction.grad.item():.3f} m per unit of friction; a rigid block {-rigid / 0.3:.3f}")
