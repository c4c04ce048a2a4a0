"""Two boxes in contact, a sphere, and a step of them."""

from typing import Any

import diffvbd as dv
from diffvbd import colliders
from diffvbd.mesh import box, join

STEP: dict[str, Any] = {"mu": 2e4, "lam": 4e4, "solver": dv.VBD(0.01, 3)}


def two_boxes(device: str = "cpu", *, things: Any = (), **options: Any) -> dv.Model:
    """Boxes 8 mm apart, closer than dhat."""
    energies = (dv.StableNeoHookean(), dv.PairBarrier(**({"dhat": 0.02} | options)), dv.Friction(0.4, 0.05))
    return dv.Model(join([box(2, 0.2), box(2, 0.2).translate((0.02, 0.208, 0.03))]), energies=energies,
                    colliders=things, device=device)  # fmt: skip


def ball() -> colliders.Sphere:
    return colliders.Sphere((0.1, -0.115, 0.1), 0.1)
