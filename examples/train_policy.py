"""A network that drives a cart so that the soft column on it reaches a target."""

import torch

import diffvbd as dv

torch.manual_seed(0)
mesh = dv.mesh.box((2, 7, 2), (0.08, 0.4, 0.08))  # [m]
model = dv.Model(mesh, pinned=mesh.points[:, 1] == 0.0)
solver = dv.VBD(time_step=1 / 60, sweeps=8, subspace="coarse", relaxation=1.5)
rest, foot = model.rest_points, model.pinned
tip = rest[:, 1] == 0.4
scenes = 8
targets = rest[tip].mean(0)[[0, 2]] + 0.4 * torch.rand(scenes, 2, dtype=rest.dtype) - 0.2  # x and z [m]
network = torch.nn.Sequential(torch.nn.Linear(6, 16), torch.nn.Tanh(), torch.nn.Linear(16, 2)).to(rest.dtype)


def ground(values, part):
    """Mean of some vertices along x and z, shape [..., 2]."""
    return values[..., part, :].mean(-2)[..., [0, 2]]


def drive(step, x, v):
    """Positions of the foot after a step; the network chooses the acceleration, at most 6 m/s^2."""
    cart = ground(v, foot)
    seen = torch.cat([targets - ground(x, tip), ground(v, tip), cart], -1)
    speed = cart + solver.time_step * 6.0 * network(5 * seen).tanh()
    moved = torch.zeros_like(x)
    moved[..., [0, 2]] = solver.time_step * speed[:, None]
    return torch.where(foot[:, None], x + moved, rest)


def loss():
    x = rest.expand(scenes, -1, -1)
    motion = dv.rollout(model, x, torch.zeros_like(x), solver, steps=40, mu=4e4, lam=4e4, prescribed=drive)
    return (ground(motion.x[-10:], tip) - targets).square().sum(-1).mean()


optimizer = torch.optim.Adam(network.parameters(), lr=0.02)
distances = []
for _ in range(25):
    optimizer.zero_grad()
    value = loss()
    value.backward()
    optimizer.step()
    distances.append(value.item() ** 0.5)
print(f"distance of the tips from their targets: {distances[0]:.3f} m before, {distances[-1]:.3f} m after training")
