"""A soft finger that two tendons bend: how far to shorten them so that its tip comes to rest at a target."""

import numpy as np
import torch

import diffvbd as dv

length, width = 0.1, 0.02  # [m]
mesh = dv.mesh.beam(13, 3, 3, size=(length, width, width))
along = np.linspace(0, length, 5)
routes = [[[x, 0.9 * width, z] for x in along] for z in (0.3 * width, 0.7 * width)]  # above the middle, side by side
points = dv.Embedding.of_points(mesh, np.concatenate(routes))
tendons = dv.Tendons(points, [range(5), range(5, 10)], stiffness=50.0, rest_length=length)
model = dv.Model(mesh, pinned=mesh.points[:, 0] < 1e-9, energies=(dv.StableNeoHookean(), tendons))
tip = dv.Embedding.of_points(mesh, [[length, width / 2, width / 2]])
solver = dv.VBD(time_step=0.05, sweeps=30, relaxation=1.5, subspace="coarse")
x = model.rest_points
target = torch.tensor([0.094, 0.027, 0.012], dtype=x.dtype)  # of the tip [m]: up, and a little to the side


def reach(shortening):
    """Where the tip is after 0.6 s in which the tendons are shortened [m] for half of the time."""
    ramp = (torch.arange(1, 13, dtype=x.dtype) / 6).clamp(max=1)[:, None]
    motion = dv.rollout(model, x, torch.zeros_like(x), solver, steps=12, young=3e5, poisson=0.3,
                        tendon_rest_length=dv.per_step(length - ramp * shortening))  # fmt: skip
    return tip.at(motion.x[-1])[0], motion.x[-1]


centimetres = torch.full((2,), 3.0, dtype=x.dtype, requires_grad=True)  # of order one, as optimisers want it
optimizer = torch.optim.LBFGS([centimetres], max_iter=5, line_search_fn="strong_wolfe")


def loss():
    optimizer.zero_grad()
    value = 1e4 * (reach(centimetres / 100)[0] - target)[1:].square().sum()
    value.backward()
    return value


optimizer.step(loss)
shortening = centimetres.detach() / 100
end, state = reach(shortening)
miss = (end - target)[1:].norm().item()
tension = dv.coupling_forces(model, state, tendon_rest_length=length - shortening).tendons
assert miss < 1e-4
print(f"tendons shortened by {' and '.join(f'{1000 * s:.2f}' for s in shortening.tolist())} mm, "
      f"at {' and '.join(f'{t:.2f}' for t in tension.tolist())} N")  # fmt: skip
print(f"the tip misses its target by {1000 * miss:.4f} mm")
