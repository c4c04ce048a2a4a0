"""Arguments of a Model, checked and in the form that it keeps."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from .. import ops
from .._common.checks import check_readable, fail, refuse_gradient, to_float
from .._common.messages import warn
from .._contact.barrier import Friction, PairBarrier
from ..couplings import COUPLINGS, Coupling
from ..energies import VERTEX_ENERGIES, StableNeoHookean, VertexEnergy
from ..laws import Law
from ..mesh import TetMesh

LARGE_BODY, SMALL_BODY = 100.0, 1e-4  # [m]; beyond, a file in other units is likelier than such a body
ELASTIC_LAWS = (StableNeoHookean, Law)
Energy = StableNeoHookean | Law | VertexEnergy | Coupling | PairBarrier | Friction


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
    kinds = (*ELASTIC_LAWS, *VERTEX_ENERGIES, *COUPLINGS, PairBarrier, Friction)
    if isinstance(energies, kinds):
        energies = (energies,)
    out: list[Energy] = []
    if not isinstance(energies, (tuple, list)):
        raise TypeError(f"energies: expected a sequence of energies, got {_kind_of(energies)}")
    for energy in energies:
        if not isinstance(energy, kinds):
            names = ", ".join(k.__name__ for k in kinds)
            raise TypeError(f"energies: expected instances of {names}, got {_kind_of(energy)}")
        if any(type(energy) is type(other) for other in out):
            fail("energies", f"one {type(energy).__name__} (several planes are one FloorBarrier)", "two")
        if isinstance(energy, VertexEnergy):
            energy.check(num_vertices)
            energy = energy.detached()
        out.append(energy)
    if any(isinstance(e, Law) for e in out):
        for energy in out:
            if isinstance(energy, StableNeoHookean):
                fail("energies", "no StableNeoHookean with a law of your own", type(energy).__name__)
    return tuple(out)


def _kind_of(energy: Any) -> str:
    return f"the class {energy.__name__}" if isinstance(energy, type) else type(energy).__name__


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


def warn_of(mesh: TetMesh, given: Any, pinned: Tensor, unswept: Tensor, energies: tuple[Energy, ...]) -> None:
    """Warns (UserWarning) of what is legal and seldom meant. ``given``: pinned as it was given; ``unswept``: vertices
    that no sweep moves."""
    if size := _size_message(mesh):
        warn(size)
    if given is not None and mesh.num_vertices and not bool(pinned.any()):
        warn(f"pinned: none of {mesh.num_vertices} vertices is pinned, so all are free, as with pinned=None")
    if mesh.num_vertices and bool(pinned.all()):
        warn(f"pinned: all {mesh.num_vertices} vertices are pinned, so nothing moves but what prescribed moves")
    if not any(isinstance(e, ELASTIC_LAWS) for e in energies) and mesh.num_tets and not bool(unswept.all()):
        warn("energies: no StableNeoHookean among them, so the tets have mass but no stiffness")


def _size_message(mesh: TetMesh) -> str:
    size = _largest_body(mesh)
    if size > LARGE_BODY:
        return (
            f"mesh: a body is {size:.4g} m long; points are in metres: one in mm needs "
            "mesh.transform(1e-3 * numpy.eye(3)), or --scale 0.001 on the command line"
        )
    if 0 < size < SMALL_BODY:
        return f"mesh: the largest body is {size:.2g} m long; points are in metres: are they in other units?"
    return ""


def _largest_body(mesh: TetMesh) -> float:
    """Longest side of the bounding box of a body [m]."""
    if not mesh.num_tets:
        return 0.0
    total = float(np.ptp(mesh.points, axis=0).max())
    if total < SMALL_BODY:
        return total
    # a tet is never longer than its body, and most bodies are neither large nor small: no need to know them exactly
    if total <= LARGE_BODY and float(np.ptp(mesh.points[mesh.tets[:100]], axis=1).max()) >= SMALL_BODY:
        return total
    order = np.argsort(mesh.body, kind="stable")
    first = np.unique(mesh.body[order], return_index=True)[1]
    points = mesh.points[order]
    high, low = np.maximum.reduceat(points, first), np.minimum.reduceat(points, first)
    return float((high - low).max())
