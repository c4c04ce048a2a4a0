"""Newton's method for states of rest.

Each iteration solves for a direction by truncated conjugate gradients, the more exactly the smaller the residual is. It
goes the largest of the fractions 1, 1/2, ... of it on which the potential decreases and no gap closes. Where curvature
is negative, or no fraction decreases the potential, the diagonal of the Hessian is raised for the next iterations.

Source: Nocedal and Wright, Numerical Optimization, sections 3.4 and 7.1; docs/method.md.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from .._common.constants import ELASTIC
from .._common.messages import log_progress
from ..adjoint.implicit import descent_direction
from ..adjoint.potential import IncreaseInputs, increase_inputs
from ..adjoint.statics import StaticPotential, Statics, newton_operators
from ..model.system import System
from ..step.residual import of_scenes, rounding, share

DECREASE = 1e-4  # of what the slope promises (Armijo)
ROUNDINGS = 4.0  # of the terms of the potential, by which it may seem to increase
HALVINGS = 12
INEXACT = 0.1  # largest residual of a linear solve; smaller as the forces balance
CG_ITERATIONS = 2000
FIRST_SHIFT, LAST_SHIFT, RAISED = 1e-6, 1e3, 10.0  # of the diagonal
PATIENCE = 150  # iterations of one increment of the load
MOST_PARTS = 64
INCREMENT = 1e-3  # residual at which the next increment follows
WHOLE = 1 - 1e-9  # a fraction of 1, but for rounding
FAR = 1e4  # extents of the scene


class Rest(NamedTuple):
    """Where the iterations ended, scene by scene."""

    x: Tensor  # [B, V, 3] [m]
    residual: Tensor  # [B]
    iterations: int  # of all increments
    converged: Tensor  # bool [B]
    unbounded: Tensor  # bool [B]: it went far away
    turned: Tensor  # bool [B]: tets are inside out that were not at the start


class Limits(NamedTuple):
    """Where iterations end, and whether each is logged."""

    tolerance: float
    iterations: int
    progress: bool


def find_rest(model: System, x: Tensor, held: Tensor, given: Statics, limits: Limits) -> Rest:
    """The rest state from x [B, V, 3], with pinned vertices at ``held`` [B, V, 3].

    Loads and pinned positions go there at once, or in 2, 4, ... increments where that does not converge or turns tets
    inside out that were not before.
    """
    turned, move = _inside_out(model, x, given), torch.where(model._pinned[:, None], held - x, 0)
    count, parts = 0, 1
    while True:
        rest = Rest(x, x.new_full((len(x),), torch.inf), 0, *x.new_zeros((3, len(x)), dtype=torch.bool))
        for n in range(1, parts + 1):
            part = given._replace(load=n / parts * given.load)
            start = _follow(model, rest.x, torch.where(model._pinned[:, None], x + n / parts * move - rest.x, 0), part)
            if start is None:
                rest = rest._replace(converged=torch.zeros_like(rest.converged))
                break
            most = limits.iterations - count
            goal = limits.tolerance if n == parts else max(limits.tolerance, INCREMENT)
            rest = _minimize(model, start, part, Limits(goal, min(most, PATIENCE) if parts < MOST_PARTS else most,
                                                        limits.progress))  # fmt: skip
            count += rest.iterations
            if not bool(rest.converged.all()):
                break
        rest = rest._replace(iterations=count, turned=_inside_out(model, rest.x, given) & ~turned)
        good = bool((rest.converged & ~rest.turned).all())
        if good or bool(rest.unbounded.any()) or count >= limits.iterations or parts >= MOST_PARTS:
            return rest
        parts *= 2


def _inside_out(model: System, x: Tensor, given: Statics) -> Tensor:
    """Whether a tet that resists it is inside out, bool [B]."""
    return (StaticPotential(model, x, given).ratio <= 0).any(-1) & bool(model.energy_mask & ELASTIC)


def _follow(model: System, x: Tensor, step: Tensor, given: Statics) -> Tensor | None:
    """x after a step [B, V, 3] of the pinned vertices, which the others follow by linear elasticity; None where a gap
    would close."""
    if not bool(step.any()):
        return x
    at = StaticPotential(model, x, given)
    product, precondition = newton_operators(at)
    inexact = x.new_full((len(x), 1, 1), INEXACT)
    rest, curved = descent_direction(product, -at.free * at.product(step), precondition, inexact, CG_ITERATIONS)
    step = step + torch.where(curved[:, None, None], 0, rest)
    return x + step if bool((at.admissible(step) >= WHOLE).all()) else None


def _minimize(model: System, x: Tensor, given: Statics, limits: Limits) -> Rest:
    """From x, whose pinned vertices stay."""
    inputs, at = increase_inputs(model, given.fields(x), 1.0), StaticPotential(model, x, given)
    scale, extent = at.stiffness(), (x.amax(1) - x.amin(1)).amax(-1)
    shift, count = x.new_zeros(len(x), 1, 1), 0
    while True:
        left, residual, done = residual_of(at, limits.tolerance)
        unbounded = ~((at.x - x).abs().amax((1, 2)) <= FAR * extent)
        if limits.progress:
            log_progress("equilibrium: residual %.3g after %d iterations", float(residual.max()), count)
        stuck = shift[:, 0, 0] > LAST_SHIFT
        if bool((done | unbounded | stuck).all()) or count >= limits.iterations:
            return Rest(at.x, residual, count, done, unbounded, torch.zeros_like(done))
        count += 1
        rests = done | unbounded | stuck
        operators = newton_operators(at, shift * scale)
        inexact = residual.clamp(max=INEXACT)[:, None, None]
        step, curved = descent_direction(operators[0], torch.where(rests[:, None, None], 0, -left), operators[1],
                                         inexact, CG_ITERATIONS)  # fmt: skip
        at, moved = _search(at, step, (left * step).sum((1, 2)), inputs, rests)
        raised = (RAISED * shift).clamp(min=FIRST_SHIFT)
        shift = torch.where((curved | ~moved)[:, None, None], raised, shift / RAISED)
        shift = torch.where(shift < FIRST_SHIFT, 0, shift)


def residual_of(at: StaticPotential, tolerance: float) -> tuple[Tensor, Tensor, Tensor]:
    """Force left over at free vertices [N], [B, V, 3]; its size over those of internal forces and loads [-], [B];
    whether that meets the tolerance, or is no more than rounding leaves, bool [B]."""
    internal = at.internal()  # where pinned, too: without loads the reactions are what balances
    left = at.free * (internal - at.given.load)
    size = of_scenes(left)
    ratio = share(size, of_scenes(internal) + of_scenes(at.given.load))
    return left, ratio[:, 0], ((ratio <= tolerance) | (size <= rounding(at, of_scenes)))[:, 0]


def _search(at: StaticPotential, step: Tensor, slope: Tensor, inputs: IncreaseInputs, rests: Tensor
            ) -> tuple[StaticPotential, Tensor]:  # fmt: skip
    """The state after the step [B, V, 3], or after a fraction of it, and whether each scene has moved, bool [B].

    slope: Of the potential along the step [J], [B].  rests: Scenes that shall stay, bool [B].
    """
    fraction, moved, x, trial = at.admissible(step), rests, at.x, at
    eps = torch.finfo(x.dtype).eps
    for _ in range(HALVINGS):
        trial = StaticPotential(at.model, torch.where(moved[:, None, None], x, at.x + fraction[:, None, None] * step),
                                at.given)  # fmt: skip
        more, size = at.increase(inputs, trial)
        x = torch.where((more <= DECREASE * fraction * slope + ROUNDINGS * eps * size)[:, None, None], trial.x, x)
        moved = (x != at.x).any(-1).any(-1) | rests
        if bool(moved.all()):
            break
        fraction = fraction / 2
    return trial if torch.equal(trial.x, x) else StaticPotential(at.model, x, at.given), moved
