"""Time integrators: how implicit solves make up a step (docs/method.md, section 19).

Every solve is that of implicit Euler, over a time and from a state of its own: S(h; x, v) minimises
1/2 |x' - y|^2_M + h^2 E(x') with y = x + h v + h^2 a, and v' = (x' - x) / h. An integrator asks for a solve about a
reference (r, w), which is extrapolated and may lie inside something. The solve starts at a state x that is feasible,
with the velocity w + (r - x) / h: its y is that of the reference.

Forces of contact may change within a step, and a scheme that extrapolates them gains energy at an impact. So a body
that may touch something takes implicit Euler for a step that does not resolve it (approach.py): in a solve over c h
instead of h this is the same problem with c^2 times the mass, gravity over c^2 and velocity over c.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from .._common.checks import check_tensor, fail, input_name
from .._common.context import looks_at, recorders, refuse_transforms, replaced
from ..energies import log_barrier
from ..model.solver import BDF2, SDIRK2, ImplicitEuler, Integrator
from ..model.system import System
from ..reference.distance import EDGE_EDGE, POINT_PLANE
from .arguments import STAGED, Prepared, acceleration_of, broadcastable, collider_state, refuse_non_finite
from .coarse import coarse_mass
from .contact import ContactStep
from .damping import Reference, damped
from .predict import Begun, begin

GAMMA = 1 - 1 / math.sqrt(2)
# With these a turn leaves the shape of a body to third order in its angle. The first solve of SDIRK2() goes along
# tangents, of lookback 0, by which no turn could be measured.
LOOKBACK_OF_BDF2, LOOKBACKS_OF_SDIRK2 = -1 / 9, (0.01, 3 - 2 * math.sqrt(2))
SAME_TIME_STEP = 1e-9  # relative: two durations divided into steps give the same h but for rounding


class History(NamedTuple):
    """The step before a state, for :class:`diffvbd.BDF2`: by how much it moved every vertex [m], the velocity before it
    [m/s], both [..., V, 3], whether it is smooth, bool [..., V]: False where contact made a body take implicit
    Euler; and its time step [s].
    """

    moved: Tensor
    v: Tensor
    smooth: Tensor
    time_step: float


class Solve(NamedTuple):
    """One implicit Euler solve that was executed, with its arguments as advance() takes them."""

    x: Tensor
    v: Tensor
    prepared: Prepared
    given: dict[str, Any]


class Taken(NamedTuple):
    """A step: the state after it, what the next one needs of it, and the solve that it ended with."""

    x: Tensor
    v: Tensor
    history: History | None  # of BDF2
    last: Solve


def check_history(integrator: Integrator, history: Any, x: Tensor, time_step: Any) -> None:
    if history is None:
        return
    if not isinstance(integrator, BDF2):
        fail("history", f"None with {type(integrator).__name__}(), which has none", type(history).__name__)
    if not isinstance(history, History):
        raise TypeError(f"history: expected what a step with BDF2() returns, got {type(history).__name__}")
    flags = torch.empty(x.shape[:-1], dtype=torch.bool, device=x.device)
    for name, value, like, owner in (("moved", history.moved, x, "that of x"), ("v", history.v, x, "that of x"),
                                     ("smooth", history.smooth, flags, "a history's")):  # fmt: skip
        shape = like.shape
        if not isinstance(value, Tensor) or value.shape != shape:
            got = f"shape {list(value.shape)}" if isinstance(value, Tensor) else type(value).__name__
            fail(f"history.{name}", f"shape {list(shape)}, that of x", got)
        check_tensor(f"history.{name}", value, like, owner=owner)
    if not is_step_of(history, time_step):
        fail("history", f"one of a step of time_step {time_step} s (None begins anew)", f"{history.time_step} s")


def is_step_of(history: History, time_step: Any) -> bool:
    """Whether a history is that of a time step, but for the rounding with which a duration was divided."""
    try:
        return math.isclose(history.time_step, time_step, rel_tol=SAME_TIME_STEP)
    except (TypeError, ValueError):  # what is no number, prepare() says
        return False


def solves_of(integrator: Integrator) -> int:
    """Solves of a step, each of all its sweeps."""
    return 2 if isinstance(integrator, SDIRK2) else 1


def take(integrator: Integrator, model: System, x: Tensor, v: Tensor, history: History | None, whole: Prepared,
         given: dict[str, Any], run: Callable[..., tuple[Tensor, Tensor]]) -> Taken:  # fmt: skip
    """One step.

    Args:
        whole: The arguments of a solve over all of it.
        given: force, gravity, prescribed, colliders, colliders_before, as of step().
        run: A solve: advance(), or one that sweeps until it has converged.
    """
    if given["colliders"] is None and given["colliders_before"] is not None and len(model.collider_points):
        given = {**given, "colliders": model.collider_points}
    end = _at_end(given)

    outer = {"x": x, "v": v, **_named(history, given)}

    def solve(x: Tensor, v: Tensor, prepared: Prepared, given: dict[str, Any], reference: Reference | None = None,
              begun: Tensor | None = None) -> tuple[Tensor, Tensor, Solve]:  # fmt: skip
        """``reference``: as of damped(); ``begun``: where a solve before this one has ended."""
        try:
            prepared = damped(model, prepared, x, reference)
            return *run(model, x, v, prepared, **given), Solve(x, v, prepared, given)
        except ValueError:  # perhaps of what was made of several arguments for this solve
            if isinstance(integrator, ImplicitEuler):
                raise
            # what is wrong with x or v themselves has been said with vertex and scene
            others = {name: t for name, t in outer.items() if isinstance(t, Tensor) and t is not x and t is not v}
            refuse_non_finite(model, {name: t for name, t in others.items() if not t.is_meta})
            if begun is not None and not bool(torch.isfinite(begun).all()):
                fail("x, v", f"a state from which the first solve of a step of {integrator} ends finite (a smaller "
                     "time_step, more sweeps or float64 may help)", "positions that are not")  # fmt: skip
            raise

    if isinstance(integrator, ImplicitEuler):
        x_end, v_end, last = solve(x, v, whole, end)
        return Taken(x_end, v_end, None, last)
    time_step = whole.settings.numbers.time_step
    if model.touches:
        refuse_transforms("a step with contact")
    touching = _touching(model, x, v, whole, end)
    if touching is not None:
        if whole.unrolled is not None:
            raise NotImplementedError(f"adjoint: expected ReverseSweep or GlobalAdjoint with {integrator} and a "
                                      "FloorBarrier, got Unrolled")  # fmt: skip
        for found in recorders("integrator"):
            found.append(touching)
    euler = touching
    if history is not None and touching is not None:
        euler = touching | ~history.smooth

    def remembered(x_end: Tensor) -> History | None:
        if not isinstance(integrator, BDF2):
            return None
        smooth = torch.ones_like(x[..., 0], dtype=torch.bool) if touching is None else ~touching
        return History(x_end - x, v, smooth, time_step)

    # not with a regularization, which a solve over a share of the step takes for a larger part of the mass
    if euler is not None and looks_at(euler) and not model.regularization and bool(euler.all()):
        x_end, v_end, last = solve(x, v, whole, end)
        return Taken(x_end, v_end, remembered(x_end), last)

    def last_solve(feasible: Tensor, reference: Tensor, carried: Tensor, fraction: float, lookback: float,
                   states: tuple[Tensor, float], end: dict[str, Any] = end, begun: Tensor | None = None
                   ) -> Taken:  # fmt: skip
        """From a feasible state, about a velocity w and a position that is h_solve times ``carried`` away from it: that
        of x + weight (other - x), of the ``states`` other and weight."""
        start, weights = reference + carried, _over(whole, fraction, lookback)
        if euler is not None:
            one = euler[..., None]
            feasible, start = torch.where(one, x, feasible), torch.where(one, v / fraction, start)
            weights, loads = _of_euler(model, weights, end, x, euler, fraction)
        else:
            loads = end
        began = None
        if weights.damping is not None:
            position, two = feasible + weights.settings.numbers.time_step * carried, states[0]
            if euler is not None:
                position, two = (torch.where(euler[..., None], x, t) for t in (position, two))
            began = Reference(position, x, two, states[1])
        x_end, v_end, last = solve(feasible, start, weights, loads, began, begun)
        v_end = v_end - carried if euler is None else torch.where(euler[..., None], fraction * v_end, v_end - carried)
        return Taken(x_end, v_end, remembered(x_end), last)

    if isinstance(integrator, BDF2) and history is not None:
        carried = history.moved / (2 * time_step)
        before = x - history.moved, -1 / 3
        return last_solve(x, v + (v - history.v) / 3, carried, 2 / 3, LOOKBACK_OF_BDF2, before)
    first, second = LOOKBACKS_OF_SDIRK2
    midway = _at_fraction(given, x, GAMMA)
    x1, v1, _ = solve(x, v, _over(whole, GAMMA, first), midway)
    feasible, carried, before = x1, math.sqrt(2) * v1, midway["colliders"]
    if euler is not None and (model.contact is not None or model.friction is not None):
        # Bodies stay apart at x1 only if all begin there: where one takes implicit Euler, all begin at x. With friction
        # they do, too, because it is measured from x.
        mixed = euler.any(-1)[..., None, None] | (model.friction is not None)
        feasible = torch.where(mixed, x, x1)
        carried = torch.where(mixed, carried + (x1 - x) / (GAMMA * time_step), carried)
        if isinstance(given["colliders_before"], Tensor):
            before = torch.where(mixed, given["colliders_before"], before)
    if given["colliders_before"] is not None:
        end = {**end, "colliders_before": before}
    half = x1, 1 + math.sqrt(2)
    return last_solve(feasible, v + (1 + math.sqrt(2)) * (v1 - v), carried, GAMMA, second, half, end, x1)


def _named(history: History | None, given: dict[str, Any]) -> dict[str, Any]:
    """The tensors of a step by the names that errors give them."""
    out: dict[str, Any] = {} if history is None else {"history.moved": history.moved, "history.v": history.v}
    for name, value in given.items():
        several = isinstance(value, tuple) and name in STAGED
        out |= {f"{name}[{i}]": part for i, part in enumerate(value)} if several else {name: value}
    return out


def _over(whole: Prepared, fraction: float, lookback: float) -> Prepared:
    """The arguments of a solve over a fraction of the step, with a lookback ratio."""
    numbers = whole.settings.numbers
    numbers = replaced(numbers, time_step=fraction * numbers.time_step, friction_eps=fraction * numbers.friction_eps)
    return replaced(whole, settings=replaced(whole.settings, numbers=numbers), lookback=lookback)


def _touching(model: System, x: Tensor, v: Tensor, prepared: Prepared, given: dict[str, Any]) -> Tensor | None:
    """Whether the body of each vertex may touch something that the step does not resolve, bool [..., V]; None: there is
    nothing to touch."""
    if model.floor is None and model.contact is None:
        return None
    with torch.no_grad():
        x, v = x.detach(), v.detach()
        prepared = damped(model, prepared, x)
        begun = begin(model, x, v, prepared, given["force"], acceleration_of(given["gravity"], x), given["prescribed"])
        where = collider_state(model, x, given["colliders"], given["colliders_before"])
        return may_touch(model, begun, prepared, where).reshape(x.shape[:-1])


def _of_euler(model: System, prepared: Prepared, given: dict[str, Any], x: Tensor, euler: Tensor, fraction: float
              ) -> tuple[Prepared, dict[str, Any]]:  # fmt: skip
    """Arguments of a solve over a fraction of the step in which some bodies take all of it. ``euler``: bool [...,
    V]."""
    factor = torch.ones_like(x[..., 0]).masked_fill(euler, fraction * fraction)
    mass = prepared.mass * factor.reshape(-1, factor.shape[-1])
    numbers = prepared.settings.numbers
    settings = replaced(prepared.settings, numbers=replaced(numbers, friction_eps=numbers.friction_eps / fraction))
    coarse = prepared.coarse
    if coarse is not None:
        coarse = replaced(coarse, mass=coarse_mass(model._coarse_plan, mass))
    parameters = dict(prepared.parameters)
    for energy in (model.floor, model.contact):  # who damps touches something
        if energy is not None:
            name = input_name(energy, "damping")
            value = parameters[name] if name in parameters else model.constants(energy)["damping"][None]
            if name in parameters or energy.damping > 0:
                parameters[name] = fraction * value
    gravity = acceleration_of(given["gravity"], x) / factor[..., None]
    damping = prepared.damping
    if damping is not None:  # rates of the whole step
        of_vertices = torch.where(euler, fraction, 1.0).to(x.dtype).reshape(-1, euler.shape[-1])
        of_tets = of_vertices[:, model._topology[0][:, 0]]
        changed = {"viscosity": of_tets, "volume_viscosity": of_tets, "drag": 1 / of_vertices}
        old = damping._asdict()
        damping = replaced(damping, **{k: old[k] * by for k, by in changed.items() if old[k] is not None})
    own = replaced(prepared, mass=mass, settings=settings, coarse=coarse, parameters=parameters, damping=damping,
                   euler=euler.reshape(-1, euler.shape[-1]))  # fmt: skip
    return own, {**given, "gravity": gravity}


def _at_end(given: dict[str, Any]) -> dict[str, Any]:
    """The arguments of a solve up to the end of the step, of arguments that may be given for each solve."""
    return {k: v[-1] if k in STAGED and isinstance(v, tuple) else v for k, v in given.items()}


def _at_fraction(given: dict[str, Any], x: Tensor, fraction: float) -> dict[str, Any]:
    """Of a solve up to a fraction of the step, to which what is prescribed moves evenly unless that is given."""
    out = {k: v[0] if k in STAGED and isinstance(v, tuple) else v for k, v in given.items()}
    prescribed, colliders, before = (given[k] for k in ("prescribed", "colliders", "colliders_before"))
    if isinstance(prescribed, Tensor):
        out["prescribed"] = x + fraction * (broadcastable("prescribed", prescribed, x) - x)
    if isinstance(colliders, Tensor) and before is not None:
        out["colliders"] = before + fraction * (colliders - before)
    return out


# --- bodies that may touch something in a step, which a scheme must not extrapolate -----------------------------------

MARGIN = 2.0  # of the ways that vertices want to go, which forces within bodies change
LEAST = 0.25  # of dhat
# What a step resolves: bounds within which no impact of bench/integrators.py gains energy (docs/method.md, 19).
SLOW = 1.0  # of a gap: ways of its sides
SOFT = 10.0  # of the mass: h^2 times a barrier's curvature


@torch.no_grad()
def may_touch(model: System, begun: Begun, prepared: Prepared, where: tuple[Tensor, Tensor] | None) -> Tensor:
    """Whether the body of each vertex may touch something on its way from begun.x_prev to begun.y, bool [B, V]: where a
    gap is below dhat, or its sides may go that close, unless the step resolves the barrier.

    Args:
        where: Colliders at the start and at the end of the step [B, Vc, 3] [m], of a Model with contact.
    """
    begun = begun.detached()
    displacement = begun.y - begun.x_prev
    near = torch.zeros_like(displacement[..., 0], dtype=torch.bool)
    if model.floor is not None:
        near = _near_floor(model, begun, prepared, displacement)
    if model.contact is not None and where is not None:
        near = near | _near_pairs(model, begun, prepared, displacement, *where)
    first = model._first_of_body.expand(near.shape)
    of_body = torch.zeros_like(displacement[..., 0]).scatter_reduce(1, first, near.to(displacement.dtype), "amax")
    return of_body.gather(1, first) > 0


def _extrapolates(model: System, prepared: Prepared) -> bool:
    """Whether no contact is damped: damping reads the start and the time step of a solve."""
    damped = (
        input_name(e, "damping") in prepared.parameters or e.damping > 0 for e in (model.floor, model.contact) if e
    )
    return not any(damped)


def _resolved(gap: Tensor, kappa: Tensor, dhat: Tensor, displacement: Tensor, mass: Tensor, h: float) -> Tensor:
    """Whether a step of h resolves a barrier, so that its force may be extrapolated: its sides move by less than the
    gap [m], and its curvature where they may end, over masses [kg], vibrates slowly."""
    slow = displacement < SLOW * torch.minimum(gap, dhat)
    return slow & (h * h * log_barrier(gap - displacement, kappa, dhat)[2] < SOFT * mass)


def _near_floor(model: System, begun: Begun, prepared: Prepared, displacement: Tensor) -> Tensor:
    assert model.floor is not None
    data = begun.data[:, : model.floor.count()]
    gap, normal, kappa, dhat = model.floor.gaps(begun.x_prev, data, begun.origin)
    along = (normal * displacement[:, :, None]).sum(-1)
    near = gap - MARGIN * (-along).clamp(min=0) < (1 + LEAST) * dhat
    if _extrapolates(model, prepared):
        h = prepared.settings.numbers.time_step
        near = near & ~_resolved(gap, kappa, dhat, along.abs(), prepared.mass[..., None], h)
    return near.any(-1) & ~model._pinned


def _near_pairs(model: System, begun: Begun, prepared: Prepared, displacement: Tensor, before: Tensor, after: Tensor
                ) -> Tensor:  # fmt: skip
    step = ContactStep(model, begun, prepared, before, after)
    assert step.surface is not None
    found = step.detect(step.x_prev, step.before, step.colliders, displacement, torch.zeros_like(displacement))
    displacements = torch.cat([displacement, after - before], 1)
    *corner, kind, scene = found.listed.pairs.long().unbind(-1)
    rows = torch.arange(len(kind), device=displacement.device)
    at = torch.cat([step.x_prev if begun.origin is None else step.x_prev + step.origin, before], 1)
    most = _displacement_between(kind, [displacements[scene, c] for c in corner], [at[scene, c] for c in corner])
    gap, dhat = step.gaps_before(found.listed), found.listed.constants[:, 0]
    near = gap - MARGIN * most < (1 + LEAST) * dhat
    near = near & (rows < found.listed.ptr[-1] // 4)  # that pairs fill
    if _extrapolates(model, prepared):
        # colliders do not give way: their masses count as infinite
        mass = torch.cat([prepared.mass.expand(displacement.shape[:2]), torch.full_like(after[..., 0], torch.inf)], 1)
        lightest = torch.stack([mass[scene, c] for c in corner]).amin(0)
        kappa, h = step.kappa.expand(displacement.shape[0])[scene], prepared.settings.numbers.time_step
        near = near & ~_resolved(gap, kappa, dhat, most, lightest, h)
    total = displacements.shape[0] * displacements.shape[1]
    out = near.new_zeros(total + len(kind))
    for c in corner:  # a row that is not near has a place of its own
        out[torch.where(near, scene * displacements.shape[1] + c, total + rows)] = True
    too_many = found.counts[0] > step.capacity  # of which some are not listed
    return out[:total].reshape(displacements.shape[:2])[:, : displacement.shape[1]] | too_many


def _displacement_between(kind: Tensor, displacement: list[Tensor], at: list[Tensor]) -> Tensor:
    """Relative displacement of the sides of pairs [m]: the longest of their corners' across them; for a
    plane, which may turn about points far away, the way of the vertex relative to the plane's point below it."""
    edges = kind == EDGE_EDGE
    square = displacement[0].new_zeros(len(kind))
    for i, j, of in ((0, 1, ~edges), (0, 2, None), (0, 3, None), (1, 2, edges), (1, 3, edges)):
        across = (displacement[i] - displacement[j]).square().sum(-1)
        square = torch.maximum(square, across if of is None else torch.where(of, across, 0))
    p, a, b, c = at
    first, second, own = b - a, c - a, p - a
    products = [(s * t).sum(-1) for s, t in ((first, first), (first, second), (second, second))]
    along = [(s * own).sum(-1) for s in (first, second)]
    inverse = 1 / (products[0] * products[2] - products[1].square())
    fraction = [(products[2] * along[0] - products[1] * along[1]) * inverse,
                (products[0] * along[1] - products[1] * along[0]) * inverse]  # fmt: skip
    below = (
        displacement[1]
        + fraction[0][:, None] * (displacement[2] - displacement[1])
        + fraction[1][:, None] * (displacement[3] - displacement[1])
    )
    return torch.where(kind == POINT_PLANE, (displacement[0] - below).square().sum(-1), square).sqrt()
