"""Two soft fingers lift a soft ball: contact forces, and how they depend on the grip."""

import torch

import diffvbd as dv

ball = dv.mesh.capsule(0.03, 0.0, resolution=3).translate((0, 0.032, 0))  # radius 3 cm [m]
finger = dv.mesh.box((2, 3, 3), (0.02, 0.05, 0.05))
mesh = dv.mesh.join([ball, finger.translate((-0.053, 0.0073, -0.0239)), finger.translate((0.033, 0.0069, -0.0257))])
backs = abs(mesh.points[:, 0]) > 0.0529  # the hand holds the fingers there
energies = (
    dv.StableNeoHookean(),
    dv.FloorBarrier(kappa=200.0, dhat=0.004),
    dv.PairBarrier(kappa=500.0, dhat=0.004, self_contact=False, reach=0.008),
    dv.Friction(0.5, velocity=0.005),
)
model = dv.Model(mesh, pinned=backs, energies=energies)
solver = dv.VBD(time_step=0.01, sweeps=10, subspace="coarse")
x = model.rest_points
hand = torch.as_tensor(backs)
inward = torch.where(hand, -x[:, 0].sign(), 0.0)


def lift(squeeze):
    """The hand closes by `squeeze` [m] on each side in 0.1 s and rises by 1 cm in 0.2 s."""
    time = torch.arange(1, 31, dtype=x.dtype)[:, None]
    close, rise = (time / 10).clamp(max=1), ((time - 10) / 20).clamp(min=0)
    moved = torch.stack([squeeze * close * inward, 0.01 * rise * hand, 0 * rise * hand], -1)
    return dv.rollout(
        model, x, torch.zeros_like(x), solver, steps=30, young=5e4, poisson=0.4, prescribed=dv.per_step(x + moved)
    )


squeeze = torch.tensor(0.005, dtype=torch.float64, requires_grad=True)
motion = lift(squeeze)
forces = dv.contact.forces(model, motion.x[-1], solver, previous=(motion.x[-2], motion.v[-2]))
grip = forces.between.normal[:, 0].abs().mean()
grip.backward()
raised = (motion.x[-1] - x)[model.body == 0, 1].mean()
print(f"ball raised by {1000 * raised.item():.1f} mm, grip {grip.item():.2f} N")
print(f"gradient {squeeze.grad.item() / 1000:.3f} N per mm of squeeze")
