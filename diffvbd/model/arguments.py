"""What a Model is given, checked and in the form that it keeps."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from .. import ops
from ..checks import check_readable, fail, refuse_gradient, to_float
from ..contact.barrier import Friction, PairBarrier
from ..energies import VERTEX_ENERGIES, StableNeoHookean, VertexEnergy

Energy = StableNeoHookean | VertexEnergy | PairBarrier | Friction


def checked_device(device: torch.device | str) -> torch.device:
    """A device that there is an object for; "cuda" is the current one."""
    try:
        device = torch.device(device)
    except (RuntimeError, TypeError, ValueError):
        fail("device", '"cpu" or "cuda"', repr(device))
    if device.type not in ops.LANES:
        fail("device", '"cpu" or "cuda"', repr(str(device)))
    if device.type == "cuda":
        ops.require_cuda()
        if device.index is None:
            device = torch.device("cuda", torch.cuda.current_device())
    return device


def checked_energies(energies: Any, num_vertices: int) -> tuple[Energy, ...]:
    """At most one energy of each kind, with detached tensors that fit the mesh."""
    kinds = (StableNeoHookean, *VERTEX_ENERGIES, PairBarrier, Friction)
    if isinstance(energies, kinds):
        energies = (energies,)
    out: list[Energy] = []
    if not isinstance(energies, (tuple, list)):
        raise TypeError(f"energies: expected a sequence of energies, got {type(energies).__name__}")
    for energy in energies:
        if not isinstance(energy, kinds):
            names = ", ".join(k.__name__ for k in kinds)
            raise TypeError(f"energies: expected instances of {names}, got {type(energy).__name__}")
        if any(type(energy) is type(other) for other in out):
            fail("energies", f"one {type(energy).__name__} (several planes are one FloorBarrier)", "two")
        if isinstance(energy, VertexEnergy):
            energy.check(num_vertices)
            energy = energy.detached()
        out.append(energy)
    return tuple(out)


def check_isolated(tets: Tensor, pinned: Tensor) -> None:
    """Raises where a vertex that moves is in no tet; tets [T, 4], pinned bool [V]."""
    touched = torch.zeros_like(pinned)
    touched[tets.reshape(-1)] = True
    loose = (~touched & ~pinned).nonzero().reshape(-1)
    if loose.numel():
        shown = ", ".join(map(str, loose[:5].tolist())) + (", ..." if loose.numel() > 5 else "")
        fail("mesh", "every vertex in a tet, or pinned", f"{loose.numel()} isolated vertices: {shown}")


def per_tet_density(density: Any, num_tets: int) -> Tensor:
    """The density of each tet [kg/m^3], float64 [T]."""
    if isinstance(density, bool) or not (isinstance(density, (int, float)) or hasattr(density, "__array__")):
        raise TypeError(f"density: expected a number or shape [{num_tets}], got {type(density).__name__}")
    if isinstance(density, Tensor):
        refuse_gradient("density", density, "pass density= to a step or a rollout")
        check_readable("density", density)
    elif isinstance(density, int):
        density = to_float("density", density)
    try:
        density = torch.as_tensor(density).detach().cpu()
    except TypeError:  # of numpy's objects and strings
        raise TypeError(f"density: expected real numbers, got {type(density).__name__}") from None
    if density.is_complex():
        raise TypeError(f"density: expected real numbers, got dtype {density.dtype}")
    density = density.to(torch.float64)
    if density.shape not in ((), (1,), (num_tets,)):
        fail("density", f"a number or shape [{num_tets}]", f"shape {list(density.shape)}")
    if not bool((torch.isfinite(density) & (density > 0)).all()):
        wrong = density.reshape(-1)[~(torch.isfinite(density) & (density > 0)).reshape(-1)]
        fail("density", "finite numbers > 0 kg/m^3", float(wrong[0]))
    return density.expand(num_tets).clone()
