"""Bodies that touch, stiffer than sweeps can do."""

from typing import Any

import torch

import diffvbd as dv
from diffvbd.testing.contact_scenes import boxes

TIME_STEP = 1 / 60  # [s]


def pressed() -> tuple[dv.Model, dict[str, Any]]:
    """A stiff beam, held at one end, that its load presses on a plane stiffer than itself."""
    mesh = dv.mesh.box((9, 3, 5), (1.0, 0.15, 0.4))
    barrier = dv.PairBarrier(kappa=2e6, dhat=0.01, self_contact=False)
    model = dv.Model(mesh, pinned=mesh.points[:, 0] < 1e-9, energies=(dv.StableNeoHookean(), barrier),
                     colliders=(dv.colliders.Plane((0, -0.009, 0), (0, 1, 0)),))  # fmt: skip
    force = torch.zeros(model.num_vertices, 3, dtype=torch.float64)
    force[torch.from_numpy(mesh.points[:, 1] > 0.14), 1] = -200.0
    return model, {"mu": 1e6, "lam": 2e6, "force": force}


def stack() -> tuple[dv.Model, dict[str, Any]]:
    """Three boxes on a floor, one on the other."""
    tets = boxes((0, 0, 0), (0.01, 0.2035, 0), (0, 0.407, 0.013))
    energies = (dv.StableNeoHookean(), dv.FloorBarrier(height=-0.0035, kappa=1e5, dhat=0.005),
                dv.PairBarrier(1e5, 0.005), dv.Friction(0.4, 0.05))  # fmt: skip
    return dv.Model(tets, energies=energies), {"mu": 1e6, "lam": 2e6}
