"""Newton's method for states of rest.

Each iteration solves for a direction by truncated conjugate gradients, the more exactly the smaller the residual is. It
goes the largest of the fractions 1, 1/2, ... of it on which the potential decreases and no gap closes. Where curvature
is negative, or no fraction decreases the potential, the diagonal of the Hessian is raised for the next iterations.

Stiff parts that turn climb out of their narrow valley with every straight step, and would go with tiny ones. So a few
whole steps may climb, if the potential is lower after them; else the scene goes back, and downhill from then on.

Source: Nocedal and Wright, Numerical Optimization, sections 3.4, 7.1 and 15.6 (the watchdog); docs/method.md.
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
WATCH = 4  # iterations that may climb before they have to end below where they began
INEXACT = 0.1  # largest residual of a linear solve; smaller as the forces balance
CG_ITERATIONS = 2000
FIRST_SHIFT, LAST_SHIFT, RAISED = 1e-6, 1e3, 10.0  # of the diagonal
PATIENCE = 100  # iterations of one increment of the load
MOST_PARTS = 64
INCREMENT = 1e-3  # residual at which the next increment follows
STAGES = (20.0, 100.0, 500.0, 2500.0)  # lam over mu, of bodies with patches that are less compressible in the end
TRIAL = 12  # iterations before stages
LEAST_SHEAR = 1e-300  # [Pa] of a quotient
SMALL_STRAIN = 1e-5  # whose forces stand for those of a state without any, far below the strains of a scene
WHOLE = 1 - 1e-9  # a fraction of 1, but for rounding
FAR = 1e4  # extents of the scene


class Rest(NamedTuple):
    """Where the iterations ended, scene by scene."""

    x: Tensor  # [B, V, 3] [m]
    residual: Tensor  # [B]
    converged: Tensor  # bool [B]
    unbounded: Tensor  # bool [B]: it went far away
    turned: Tensor  # bool [B]: tets are inside out that were not at the start
    iterations: int  # of all increments


class Limits(NamedTuple):
    """Where iterations end, and whether each is logged."""

    tolerance: float
    iterations: int
    progress: bool
    before: int = 0  # iterations before these


def find_rest(model: System, x: Tensor, held: Tensor, given: Statics, limits: Limits, parts: int = 1) -> Rest:
    """The rest state from x [B, V, 3], with pinned vertices at ``held`` [B, V, 3].

    Loads and pinned positions go there in so many parts, and in twice as many in scenes where that does not converge or
    turns tets inside out that were not before.
    """
    staged = parts == 1 and model.patches is not None and model.num_tets > 0
    rest = (_in_stages if staged else _in_increments)(model, x, held, given, limits, parts)
    rest = rest._replace(turned=_inside_out(model, rest.x, given) & ~_inside_out(model, x, given))
    bad = (~rest.converged | rest.turned) & ~rest.unbounded
    limits = limits._replace(iterations=limits.iterations - rest.iterations, before=limits.before + rest.iterations)
    if parts >= MOST_PARTS or limits.iterations <= 0 or not bool(bad.any()):
        return rest
    return _with(rest, bad, find_rest(model, x[bad], held[bad], _of(given, bad), limits, 2 * parts))


def _of(given: Statics, scenes: Tensor) -> Statics:
    """Of some scenes, bool [B]."""
    return Statics(*(t if len(t) == 1 else t[scenes] for t in given))


def _with(rest: Rest, scenes: Tensor, again: Rest) -> Rest:
    """The rest states with those of some scenes exchanged, bool [B]; all iterations count."""
    tensors = (old.index_put((scenes,), new) for old, new in zip(rest[:-1], again[:-1], strict=True))
    return Rest._make([*tensors, rest.iterations + again.iterations])


def _in_stages(model: System, x: Tensor, held: Tensor, given: Statics, limits: Limits, parts: int) -> Rest:
    """Of a Model with patches. Where the first iterations do not do, by way of less lam: volumes that are kept only
    nearly let shapes change in few iterations, and shapes hardly change as lam rises. With lam at once each iteration
    may only go as far as a straight step keeps volumes."""
    most = (given.lam / given.mu.clamp(min=LEAST_SHEAR)).amax()
    stages = [stage for stage in STAGES if bool(most > 2 * stage)]
    first = limits._replace(iterations=min(TRIAL, limits.iterations)) if stages else limits
    tried = _in_increments(model, x, held, given, first, parts)
    bad, count = ~tried.converged & ~tried.unbounded, 0
    if not stages or not bool(bad.any()) or tried.iterations >= limits.iterations:
        return tried
    at, held, given, goal = x[bad], held[bad], _of(given, bad), max(limits.tolerance, INCREMENT)
    limits = limits._replace(iterations=limits.iterations - tried.iterations, before=limits.before + tried.iterations)
    for stage in stages:  # one bound for all tets, so that lam stays alike within a patch
        soft = given._replace(lam=torch.minimum(given.lam, stage * given.mu.amax(-1, keepdim=True)))
        left = limits._replace(iterations=max(limits.iterations - count, 1), before=limits.before + count)
        rest = _in_increments(model, at, held, soft, left._replace(tolerance=goal), parts)
        at, count = torch.where(rest.converged[:, None, None], rest.x, at), count + rest.iterations
    left = limits._replace(iterations=max(limits.iterations - count, 1), before=limits.before + count)
    rest = _in_increments(model, at, held, given, left, parts)
    return _with(tried, bad, rest._replace(iterations=count + rest.iterations))


def _in_increments(model: System, x: Tensor, held: Tensor, given: Statics, limits: Limits, parts: int) -> Rest:
    move = torch.where(model._pinned[:, None], held - x, 0)
    good, count = x.new_ones(len(x), dtype=torch.bool), 0
    lost = ~good
    rest = Rest(x, x.new_full((len(x),), torch.inf), good, lost, lost, 0)
    for n in range(1, parts + 1):
        part = _part(model, given, n / parts)
        step = torch.where(model._pinned[:, None], x + n / parts * move - rest.x, 0)
        start, follows = _follow(model, rest.x, step, part)
        goal = limits.tolerance if n == parts else max(limits.tolerance, INCREMENT)
        most = limits.iterations - count
        most = min(most, PATIENCE) if parts < MOST_PARTS else most
        rest = _minimize(model, start, part, Limits(goal, most, limits.progress, limits.before + count))
        good, lost, count = good & follows & rest.converged, lost | rest.unbounded, count + rest.iterations
        rest = rest._replace(residual=torch.where(follows, rest.residual, torch.inf), converged=good, unbounded=lost)
        if not bool(good.any()):
            break
    return rest._replace(iterations=count)


def _part(model: System, given: Statics, fraction: float) -> Statics:
    """The given loads, and the couplings with such a fraction of their strength."""
    strong = [torch.full_like(own, key == energy.strength, dtype=torch.bool).flatten()
              for energy in model.couplings for key, own in model.constants(energy).items()]  # fmt: skip
    couplings = given.couplings
    if strong and fraction < 1:
        couplings = torch.where(torch.cat(strong), fraction * couplings, couplings)
    return given._replace(load=fraction * given.load, couplings=couplings)


def _inside_out(model: System, x: Tensor, given: Statics) -> Tensor:
    """Whether a tet that resists it is inside out, bool [B]."""
    return (StaticPotential(model, x, given).ratio <= 0).any(-1) & bool(model.energy_mask & ELASTIC)


def _follow(model: System, x: Tensor, step: Tensor, given: Statics) -> tuple[Tensor, Tensor]:
    """x after a step [B, V, 3] of the pinned vertices, which the others follow by linear elasticity, and whether a
    scene follows, bool [B]: it stays where a gap would close."""
    if not bool(step.any()):
        return x, x.new_ones(len(x), dtype=torch.bool)
    at = StaticPotential(model, x, given)
    product, precondition = newton_operators(at)
    inexact = x.new_full((len(x), 1, 1), INEXACT)
    rest, curved = descent_direction(product, -at.free * at.product(step), precondition, inexact, CG_ITERATIONS)
    step = step + torch.where(curved[:, None, None], 0, rest)
    follows = at.admissible(step) >= WHOLE
    return torch.where(follows[:, None, None], x + step, x), follows


def _minimize(model: System, x: Tensor, given: Statics, limits: Limits) -> Rest:
    """From x, whose pinned vertices stay."""
    inputs, at = increase_inputs(model, given.fields(x), 1.0), StaticPotential(model, x, given)
    scale, extent = at.stiffness(), (x.amax(1) - x.amin(1)).amax(-1)
    shift, count = x.new_zeros(len(x), 1, 1), 0
    # scenes that may climb, from where, with which slope there, and for how many iterations they have
    climbs, best, best_slope, since = x.new_ones(len(x), dtype=torch.bool), at, x.new_zeros(len(x)), x.new_zeros(len(x))
    while True:
        below = _decreases(best, at, best_slope, inputs)[0]
        left, residual, done = residual_of(at, limits.tolerance)
        far = ~((at.x - x).abs().amax((1, 2)) <= FAR * extent)
        back = climbs & ~below & (done | far | (since >= WATCH))
        if bool(back.any()):
            climbs, at = climbs & ~back, _state(at, torch.where(back[:, None, None], best.x, at.x))
            left, residual, done = residual_of(at, limits.tolerance)
        unbounded = far & ~back
        if limits.progress:
            log_progress("equilibrium: residual %.3g after %d iterations", float(residual.max()), limits.before + count)
        rests = done | unbounded | (shift[:, 0, 0] > LAST_SHIFT)
        if bool(rests.all()) or count >= limits.iterations:
            return Rest(at.x, residual, done, unbounded, torch.zeros_like(done), count)
        count += 1
        operators = newton_operators(at, shift * scale)
        inexact = residual.clamp(max=INEXACT)[:, None, None]
        step, curved = descent_direction(operators[0], torch.where(rests[:, None, None], 0, -left), operators[1],
                                         inexact, CG_ITERATIONS)  # fmt: skip
        slope = (left * step).sum((1, 2))
        best = _state(best, torch.where(below[:, None, None], at.x, best.x))
        best_slope, since = torch.where(below, slope, best_slope), torch.where(below, 1, since + 1)
        since = torch.where(curved, WATCH, since)
        at, moved = _search(at, step, slope, inputs, rests, climbs & ~curved)
        raised = (RAISED * shift).clamp(min=FIRST_SHIFT)
        shift = torch.where((curved | ~moved)[:, None, None], raised, shift / RAISED)
        shift = torch.where(shift < FIRST_SHIFT, 0, shift)


def _decreases(at: StaticPotential, to: StaticPotential, promised: Tensor, inputs: IncreaseInputs
               ) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Whether U decreases by enough of what its slope has promised [J], but for rounding; and whether ``to`` is
    admitted at all; bool [B]."""
    more, size = at.increase(inputs, to)
    eps = torch.finfo(more.dtype).eps
    # a difference: where both are infinite it is no number
    return more - ROUNDINGS * eps * size <= DECREASE * promised, torch.isfinite(more)


def _state(at: StaticPotential, x: Tensor) -> StaticPotential:
    """The potential at x, which may be where it is."""
    return at if torch.equal(at.x, x) else StaticPotential(at.model, x, at.given)


def residual_of(at: StaticPotential, tolerance: float) -> tuple[Tensor, Tensor, Tensor]:
    """Force left over at free vertices [N], [B, V, 3]; its size over those of internal forces, loads and SMALL_STRAIN
    [-], [B]; whether that meets the tolerance, or is no more than rounding leaves, bool [B]."""
    internal = at.internal()  # where pinned, too: without loads the reactions are what balances
    coupled = torch.zeros_like(internal) if at.coupled is None else at.coupled.gradient
    left = at.free * (internal - at.given.load)
    size = of_scenes(left)
    # a state without stress and loads has no forces to compare with: those of a small strain stand for them
    extent = (at.x.amax(1) - at.x.amin(1)).amax(-1, keepdim=True) if at.x.numel() else size
    least = SMALL_STRAIN * extent / max(at.x.shape[1], 1) * of_scenes(at.free * at.stiffness())
    ratio = share(size, of_scenes(internal - coupled) + of_scenes(coupled) + of_scenes(at.given.load) + least)
    return left, ratio[:, 0], ((ratio <= tolerance) | (size <= rounding(at, of_scenes)))[:, 0]


def _search(at: StaticPotential, step: Tensor, slope: Tensor, inputs: IncreaseInputs, rests: Tensor, climbs: Tensor
            ) -> tuple[StaticPotential, Tensor]:  # fmt: skip
    """The state after the step [B, V, 3], or after a fraction of it, and whether each scene has moved, bool [B].

    slope: Of the potential along the step [J], [B].  rests, climbs: Scenes that shall stay, that may climb, bool [B].
    """
    fraction, moved, x, trial = at.admissible(step), rests, at.x, at
    for _ in range(HALVINGS):
        trial = StaticPotential(at.model, torch.where(moved[:, None, None], x, at.x + fraction[:, None, None] * step),
                                at.given)  # fmt: skip
        decreases, admitted = _decreases(at, trial, fraction * slope, inputs)
        x = torch.where((decreases | (climbs & admitted))[:, None, None], trial.x, x)
        moved = (x != at.x).any(-1).any(-1) | rests
        if bool(moved.all()):
            break
        fraction = fraction / 2
    return _state(trial, x), moved
