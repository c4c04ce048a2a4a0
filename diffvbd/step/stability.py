"""Whether steps let vibrations of a body grow, from one step to the next, measured on the Model's own mesh at rest.

A vibration far shorter than a step should be gone after it. K sweeps leave a share of it, of either sign, and the next
step extrapolates from that: with too few sweeps, of slivers above all, it grows. So the step itself is asked: noise
that is far too small to bend anything goes through some steps about the rest shape, without loads. Steps that are
solved never add to its energy, kinetic and elastic, and what steps amplify soon is all that is left of it.
"""

from __future__ import annotations

import math
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from .._common.constants import EXACT_BLOCK
from .._common.context import replaced, silence
from .._common.messages import page
from ..adjoint.potential import IncrementalPotential
from ..energies import StableNeoHookean
from ..mesh import TetMesh
from ..model.material import height_of_tets
from ..model.model import Model
from ..model.solver import Integrator
from ..model.system import System, system_of
from .advance import advance
from .arguments import acceleration_of, material_of, prepare
from .integrators import take
from .predict import begin

GROWS = 1.02  # times in a step: a hundred steps make seven of it
BURN, STEPS = 8, 24  # steps in which what is damped goes; all steps
MORE = 16  # what seems to grow is looked at for so many more
NOISE = 1e-6  # displacements over the size of the body
GONE = 1e-24  # of the energy: nothing is left that could grow
MOST_TETS = 4000  # of a larger mesh the part about its stiffest tet is measured: what grows is rough, and local
MOST_SWEEPS = 100  # of more it is not doubted
SOFT = 0.2  # elements that a pressure wave crosses in a step, below which inertia does the work
CALMER = (1.7, 1.5, 1.3, 1.0)  # relaxations that are tried for a message


class _Part(NamedTuple):
    """System that is measured in place of a Model's own, elastic and on the CPU in float64, and which tets it has."""

    model: System
    tets: np.ndarray | None  # rows of the Model's; None: all


def measured(model: System, mu: Tensor, lam: Tensor, h: float, sweeps: int, integrator: Integrator) -> str:
    """Message about steps that amplify vibrations, or "".  mu, lam: [1 | B, 1 | T], float64 on the CPU."""
    if not bool((mu > 0).all() and (mu + lam > 0).all() and torch.isfinite(mu + lam).all()):  # perhaps refused later
        return ""
    crossed = _crossed(model, mu, lam, h)
    if not float(crossed.max()) > SOFT:
        return ""
    # of many scenes those with the stiffest and the least compressible tet
    scenes = sorted({int((lam + 2 * mu).amax(-1).argmax()), int((lam / mu).amax(-1).argmax())})
    mu, lam = (m if len(m) == 1 else m[scenes] for m in (mu, lam))
    part = _part_of(model, crossed)
    mu, lam = (m if part.tets is None or m.shape[-1] == 1 else m[:, part.tets] for m in (mu, lam))
    measure = partial(growth, mu=mu, lam=lam, time_step=h, integrator=integrator)
    found = measure(part.model, sweeps=sweeps)
    if not found > GROWS:
        return ""
    take_these = []
    needed = sweeps
    while needed < MOST_SWEEPS:
        needed = min(MOST_SWEEPS, math.ceil(1.25 * needed))
        if measure(part.model, sweeps=needed) <= 1:
            take_these.append(f"{needed} sweeps")
            break
    calmer = (r for r in CALMER if r < model.relaxation)
    take_these += [f"relaxation={r:g}" for r in calmer if measure(part.model, sweeps=sweeps, relaxation=r) <= 1][:1]
    corrects = model.coarse is None and model.saturation is None and model.energy_mask & EXACT_BLOCK
    if corrects and measure(part.model.with_solver(subspace="coarse"), sweeps=sweeps) <= 1:
        take_these.append('subspace="coarse"')
    advice = f"{', '.join(take_these)} or a shorter time step" if take_these else "a shorter time step"
    return (
        f"sweeps: {sweeps} with {type(integrator).__name__}(), relaxation={model.relaxation:g} and time_step = {h:.3g} "
        f"s let vibrations of this mesh grow {found:.2f} times in every step; take {advice}; " + page("numerics.md")
    )


def _crossed(model: System, mu: Tensor, lam: Tensor, h: float) -> Tensor:
    """Number of each tet that a pressure wave crosses in a step, the largest over scenes [T]."""
    speed = ((lam + 2 * mu).amax(0) / model._density.double().cpu()).clamp(min=0).sqrt()
    heights = model.derived("heights of tets", lambda: height_of_tets(model))
    return h * speed / torch.from_numpy(heights)


def _part_of(model: System, crossed: Tensor) -> _Part:
    plain = model.dtype == torch.float64 and model.device.type == "cpu" and len(model.energies) == 1
    if model.num_tets <= MOST_TETS:
        if plain:
            return _Part(model, None)
        return _Part(model.derived("elastic", lambda: _elastic(model, model.mesh, model._unswept.cpu(), None)), None)
    worst = int(crossed.argmax())

    def build() -> _Part:
        points, tets = model.mesh.points, model.mesh.tets
        away = np.square(points[tets].mean(1) - points[tets[worst]].mean(0)).sum(-1)
        rows = np.sort(np.argpartition(away, MOST_TETS)[:MOST_TETS])
        used, corners = np.unique(tets[rows], return_inverse=True)
        outside = np.ones(len(tets), dtype=bool)
        outside[rows] = False
        pinned = model._unswept.cpu().numpy().copy()
        pinned[tets[outside]] = True
        mesh = TetMesh(points[used], corners.reshape(-1, 4))
        return _Part(_elastic(model, mesh, torch.from_numpy(pinned[used]), rows), rows)

    return model.derived(f"elastic about {worst}", build)


def _elastic(model: System, mesh: TetMesh, pinned: Tensor, rows: np.ndarray | None) -> System:
    density = model._density.cpu()
    with silence():  # nobody has made this one
        own = Model(mesh, density if rows is None else density[rows], pinned, (StableNeoHookean(),))
    return system_of(own, model.solver)


def growth(model: System, *, mu: Tensor, lam: Tensor, time_step: float, sweeps: int, integrator: Integrator,
           relaxation: float | None = None) -> float:  # fmt: skip
    """Factor by which noise about the rest shape has grown in a step, after some steps [-], the worst of scenes; 0:
    nothing is left of it.

    model: Elastic, in float64 on the CPU.  mu, lam: [1 | B, 1 | T].
    """
    lead = (max(len(mu), len(lam)),)
    prepared = prepare(model, lead, material_of(mu=mu, lam=lam), time_step=time_step, sweeps=sweeps)
    if relaxation is not None:
        numbers = prepared.settings.numbers
        numbers = replaced(numbers, relaxation=relaxation, last_relaxation=min(numbers.last_relaxation, relaxation))
        prepared = replaced(prepared, settings=replaced(prepared.settings, numbers=numbers))
    rest = model._rest_points.expand(*lead, -1, -1)
    free = (~model._pinned)[:, None].double()
    nothing: dict[str, Any] = {"force": None, "prescribed": None, "colliders": None, "colliders_before": None,
                               "gravity": acceleration_of((0.0, 0.0, 0.0), rest)}  # fmt: skip
    begun = begin(model, rest, torch.zeros_like(rest), prepared, None, nothing["gravity"], None)
    at_rest = IncrementalPotential(model, rest, begun.fields(model, prepared), time_step)
    mass = free * model._mass[:, None]

    def energy(d: Tensor, v: Tensor) -> Tensor:
        """Times 2 h^2 [kg m^2]."""
        return (free * d * at_rest.elastic_product(free * d) + mass * (time_step * v).square()).sum((-2, -1))

    generator = torch.Generator("cpu").manual_seed(0)
    noise = torch.randn(rest.shape[1:], generator=generator, dtype=torch.float64, device="cpu")
    size = float((rest[0].amax(0) - rest[0].amin(0)).norm())
    x, v, history = rest + NOISE * size * free * noise, torch.zeros_like(rest), None
    total, logs = torch.zeros(lead, dtype=torch.float64, device="cpu"), [energy(x - rest, v).log()]
    run = advance
    last = STEPS
    while len(logs) <= last:
        x, v, history, _ = take(integrator, model, x, v, history, prepared, nothing, run)
        now = energy(x - rest, v)
        if not bool(torch.isfinite(now).all()):
            return math.inf
        logs.append(total + now.clamp(min=math.ulp(0.0)).log())
        if float((logs[-1] - logs[0]).max()) < math.log(GONE):
            return 0.0
        moved = ((x - rest).square() + (time_step * v).square()).sum((-2, -1)).mean().sqrt()
        scale = NOISE * size * math.sqrt(rest[0].numel()) / moved.clamp(min=math.ulp(0.0))
        total = total - 2 * scale.log()
        x, v = rest + scale * (x - rest), scale * v
        if history is not None:
            history = replaced(history, moved=scale * history.moved, v=scale * history.v)
        if len(logs) == STEPS + 1 and _factor(logs, BURN, STEPS) > GROWS:
            last = STEPS + MORE
    return _factor(logs, last - (STEPS - BURN), last)


def _factor(logs: list[Tensor], first: int, last: int) -> float:
    return math.exp(min(500.0, float((logs[last] - logs[first]).max()) / (2 * (last - first))))
