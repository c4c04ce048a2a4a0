"""What a Model is given, checked and in the form that it keeps."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from .. import ops
from ..checks import check_positive, check_readable, fail, is_word, refuse_gradient, to_float
from ..contact.barrier import Friction, PairBarrier
from ..energies import VERTEX_ENERGIES, StableNeoHookean, VertexEnergy
from .coarse import CoarseSpace

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


def checked_steps(
    relaxation: Any, rigid: Any, start: Any, coarse: Any, energies: tuple[Energy, ...], saturation: float | None,
) -> tuple[float, bool, str, CoarseSpace | None]:  # fmt: skip
    """What steps do besides plain sweeps: the relaxation, whether free bodies are corrected, where the sweeps of the
    others start, and the coarse space."""
    rigid, start = checked_correction(rigid, start, energies)
    coarse = checked_coarse(coarse, energies, saturation)
    return checked_relaxation(relaxation), rigid, start, coarse


def checked_relaxation(relaxation: Any) -> float:
    number = check_positive("relaxation", relaxation)
    if number >= 2:
        fail("relaxation", "a number in (0, 2): from 2 on the updates raise the potential", relaxation)
    return number


def checked_correction(rigid: Any, start: Any, energies: tuple[Energy, ...]) -> tuple[bool, str]:
    """Whether free bodies are corrected, and where the sweeps of the others start."""
    touches = any(isinstance(e, (PairBarrier, Friction)) for e in energies)
    if not is_word(start, "auto", "predictor", "inertia"):
        fail("start", '"auto", "predictor" or "inertia"', repr(start))
    if start == "inertia" and any(isinstance(e, PairBarrier) for e in energies):
        fail("start", '"auto" or "predictor" beside a PairBarrier, whose steps go to y in parts', '"inertia"')
    if rigid is None:  # tets without stiffness are no body
        return not touches and any(isinstance(e, StableNeoHookean) for e in energies), start
    if not isinstance(rigid, bool):
        raise TypeError(f"rigid: expected True, False or None, got {type(rigid).__name__}")
    if rigid and touches:
        fail("rigid", "False beside a PairBarrier or Friction, which the correction does not see", "True")
    return rigid, start


def checked_coarse(coarse: Any, energies: tuple[Energy, ...], saturation: float | None) -> CoarseSpace | None:
    """The coarse space, where it is one that the other arguments allow."""
    if coarse is None:
        return None
    if is_word(coarse, "auto"):
        coarse = CoarseSpace()
    if not isinstance(coarse, CoarseSpace):
        raise TypeError(f'coarse: expected a diffvbd.CoarseSpace, "auto" or None, got {coarse!r}')
    elastic = next((e for e in energies if isinstance(e, StableNeoHookean)), None)
    if elastic is None or elastic.block != "exact":
        fail("coarse", "None without StableNeoHookean and its exact block", repr(coarse))
    if ops.TET_READS_X_PREV:
        fail("coarse", "None with a law of tets that reads where a step began", repr(coarse))
    if saturation is not None:
        fail("coarse", "None with saturation, which a correction would go around", repr(coarse))
    return coarse
