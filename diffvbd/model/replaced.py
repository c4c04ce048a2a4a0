"""The arguments that a Model was made with, some of them replaced."""

from __future__ import annotations

from typing import Any

import torch

from ..energies import VertexEnergy


def replaced_arguments(model: Any, changes: dict[str, Any]) -> dict[str, Any]:
    """Those of the constructor but mesh, on the CPU; raises TypeError for a change that is none of them."""
    cpu = torch.device("cpu")
    energies = [e.placed(model.num_vertices, cpu) if isinstance(e, VertexEnergy) else e for e in model.energies]
    same = ("saturation", "regularization", "relaxation", "start", "colliders", "coarse", "dtype", "device")
    own = {name: getattr(model, name) for name in same}
    pinned = model._pinned.cpu() if model._pinned.any() else None
    own |= {"density": model._density.cpu(), "pinned": pinned, "energies": energies, "rigid": model._asked_rigid}
    if unknown := sorted(set(changes) - set(own)):
        raise TypeError(f"replace: expected arguments of Model ({', '.join(sorted(own))}), got {', '.join(unknown)}")
    return own | changes
