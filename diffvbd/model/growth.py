"""How many sweeps keep the vibrations of stiff bodies from growing, from one step to the next.

A vibration far shorter than a step should be gone after it. K sweeps leave a share of it, an eigenvalue of the matrix
of these sweeps, of either sign or complex; the next step extrapolates from that, and its scheme lets it grow where the
share lies outside a region of the complex plane. The eigenvalues depend on the relaxation and on lam over mu.
"""

from __future__ import annotations

import contextlib
import math
from bisect import bisect_left
from collections.abc import Iterator
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from ..energies import StableNeoHookean
from ..said import page, warn
from .tet_shapes import looked_at, shapes_of_tets

if TYPE_CHECKING:
    from .model import Model

LONG_STEP = 3.0  # elements that a pressure wave crosses in a step: beyond, some vibrations are far shorter than it
TINY, ROUNDING = 1e-300, 1e-6  # a ratio that was computed, as of Poisson's ratio 0.45, is still that of the table
GROWS, STEPS_SEEN = "grows", "steps seen"  # of a Model's _derived: integrators and sweeps that were told; steps

RELAXATIONS = (1.0, 1.3, 1.5, 1.7)
RATIOS = (1.0, 2.0, 4.0, 9.0, 20.0, 60.0)  # lam / mu, Poisson's ratio 0.25, 0.33, 0.4, 0.45, 0.476, 0.492
MANY = 41  # more than 40

# Sweeps from which on none grows, for each relaxation and ratio [`stability.json`, python -m bench stability].
# ALL: of bodies that are held somewhere, all sweeps over-relaxed; BUT_LAST: the same but the last; FREE: of free
# bodies; COARSE: with coarse corrections.
Table = tuple[tuple[int, ...], ...]
ALL: dict[str, Table] = {
    "ImplicitEuler": ((1, 1, 1, 1, 2, 6), (2, 2, 2, 3, 5, 14), (3, 3, 3, 5, 9, 25), (4, 4, 6, 9, 41, 41)),
    "BDF2": ((1, 1, 1, 3, 6, 19), (3, 3, 4, 5, 10, 30), (4, 4, 6, 8, 15, 41), (7, 9, 13, 36, 41, 41)),
    "SDIRK2": ((5, 2, 4, 7, 16, 41), (10, 11, 13, 16, 25, 41), (11, 12, 15, 21, 41, 41), (13, 17, 24, 41, 41, 41)),
}
BUT_LAST: dict[str, Table] = {
    "ImplicitEuler": ((1, 1, 1, 1, 2, 6), (1, 1, 1, 1, 4, 14), (1, 1, 1, 4, 8, 24), (1, 1, 3, 7, 37, 41)),
    "BDF2": ((1, 1, 1, 3, 6, 19), (1, 1, 1, 4, 9, 30), (3, 4, 5, 7, 14, 41), (5, 6, 10, 29, 41, 41)),
    "SDIRK2": ((5, 2, 4, 7, 16, 41), (10, 11, 13, 15, 24, 41), (11, 12, 15, 21, 41, 41), (13, 16, 23, 41, 41, 41)),
}
FREE: dict[str, Table] = {
    "ImplicitEuler": ((1, 1, 1, 1, 2, 6), (1, 1, 1, 1, 4, 14), (1, 1, 1, 4, 8, 27), (1, 1, 3, 7, 19, 41)),
    "BDF2": ((1, 1, 2, 4, 9, 24), (1, 1, 2, 5, 12, 37), (1, 1, 4, 7, 18, 41), (6, 6, 8, 15, 31, 41)),
    "SDIRK2": ((2, 3, 5, 12, 27, 41), (3, 3, 6, 14, 28, 41), (5, 6, 8, 16, 33, 41), (9, 10, 13, 22, 41, 41)),
}
COARSE: dict[str, Table] = {
    "ImplicitEuler": ((1, 1, 1, 1, 1, 1), (1, 1, 1, 1, 3, 12), (1, 1, 1, 1, 8, 24), (1, 1, 1, 6, 12, 41)),
    "BDF2": ((1, 1, 1, 3, 6, 24), (1, 1, 1, 5, 12, 41), (3, 3, 4, 8, 16, 41), (5, 5, 6, 12, 24, 41)),
    "SDIRK2": ((2, 2, 3, 5, 12, 41), (3, 3, 4, 8, 16, 41), (4, 4, 5, 12, 24, 41), (5, 5, 8, 12, 24, 41)),
}


def least_sweeps(tables: tuple[dict[str, Table], ...], scheme: str, relaxation: float, ratio: float) -> int:
    """The most that one of the tables asks for; MANY: more than they know."""
    row = min(bisect_left(RELAXATIONS, relaxation), len(RELAXATIONS) - 1)
    column = min(bisect_left(RATIOS, ratio * (1 - ROUNDING)), len(RATIOS) - 1)
    return max(table[scheme][row][column] for table in tables)


@contextlib.contextmanager
def proven(model: Model, scheme: str, sweeps: int) -> Iterator[None]:
    """Inside, it is not doubted that vibrations stay small: a pilot run with these settings has ended well."""
    before = model._derived.get(GROWS, frozenset())
    model._derived[GROWS] = before | {(scheme, sweeps)}
    try:
        yield
    finally:
        model._derived[GROWS] = before


def warn_of_growth(model: Model, mu: Tensor, lam: Tensor, time_step: float, sweeps: int, scheme: str) -> None:
    """Too few sweeps for an integrator, a relaxation and a material (docs/numerics.md, "Relaxation"). Moduli may change
    from step to step: those of the 1st, 2nd, 4th, 8th, ... are looked at."""
    tables, relaxation = _tables_of(model), model.relaxation
    if sweeps == 1 and tables != (ALL,):
        relaxation = min(relaxation, 1.0)  # the last sweep is not over-relaxed
    if sweeps >= least_sweeps(tables, scheme, relaxation, RATIOS[-1]):
        return
    said: frozenset[tuple[str, int]] = model._derived.get(GROWS, frozenset())
    model._derived[STEPS_SEEN] = seen = model._derived.get(STEPS_SEEN, 0) + 1
    if seen & (seen - 1) or (scheme, sweeps) in said:
        return
    if not any(isinstance(e, StableNeoHookean) for e in model.energies):
        return
    crossed, ratio = _stiffest(model, mu, lam, time_step)
    if not (math.isfinite(crossed) and math.isfinite(ratio)):  # which the step will refuse
        return
    needed = _needed(tables, scheme, relaxation, ratio, crossed)
    if sweeps >= needed:
        return
    model._derived[GROWS] = said | {(scheme, sweeps)}
    take = [f"{needed} sweeps" if needed < MANY else f"more than {MANY - 1} sweeps"]
    calmer = [r for r in RELAXATIONS if r < model.relaxation and _needed(tables, scheme, r, ratio, crossed) <= sweeps]
    take += [f"relaxation={calmer[-1]:g}"] if calmer else []
    if model.coarse is None and _needed((COARSE,), scheme, model.relaxation, ratio, crossed) <= sweeps:
        take.append('coarse="auto"')
    warn(
        f"sweeps: {sweeps} with {scheme}(), relaxation={model.relaxation:g} and lam of {ratio:.3g} mu may let "
        "vibrations of stiff bodies grow without bound, where steps are much longer than these, as here; take "
        f"{', '.join(take)} or a shorter time step; " + page("numerics.md"),
    )


def _tables_of(model: Model) -> tuple[dict[str, Table], ...]:
    if model.coarse is not None:
        return (COARSE,)
    if not model.corrects:
        return (ALL,)
    return (FREE, BUT_LAST) if model.num_active < model.num_vertices else (FREE,)


def _needed(tables: tuple[dict[str, Table], ...], scheme: str, relaxation: float, ratio: float, crossed: float) -> int:
    """Sweeps of a step in which a pressure wave crosses so many elements: of few, inertia takes a share of the work."""
    least = least_sweeps(tables, scheme, relaxation, ratio)
    return math.ceil(1 + (least - 1) * min(1.0, crossed / LONG_STEP))


def _stiffest(model: Model, mu: Tensor, lam: Tensor, time_step: float) -> tuple[float, float]:
    """How many elements a pressure wave crosses in a step, where most, and lam / mu there."""
    height, rows = torch.as_tensor(shapes_of_tets(model)[1], dtype=torch.float64, device=mu.device), looked_at(model)
    shear, first = (m.detach().double() if m.shape[-1] == 1 else m.detach()[..., rows].double() for m in (mu, lam))
    density = model._density[rows].to(height).clamp(min=TINY)
    crossed = time_step * ((first + 2 * shear).clamp(min=0) / density).sqrt() / height
    ratio = (first / shear.clamp(min=TINY)).expand_as(crossed)
    if crossed.numel() == 0:
        return 0.0, 0.0
    most = float(crossed.max())
    if math.isnan(most):
        return math.nan, math.nan
    return most, float(ratio[crossed >= min(LONG_STEP, most)].max())
