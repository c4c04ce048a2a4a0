"""The rigid corrections of a substep (docs/method.md, section 18): one before its sweeps, one after them, and more of
blocked bodies after the last sweeps."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd import Function

from .. import ops
from .._common.context import is_captured, replaced
from .._contact.start import SubstepStart
from ..adjoint.contact import Pairs, at_corners, of_scene, pair_lag, some_of, sum_at_corners, sum_of_scenes
from ..adjoint.potential import IncreaseInputs, IncrementalPotential, increase_of_bodies, of_vertices
from ..model.system import System
from ..ops import broadcast
from ..ops import contact as ops_rigid
from ..ops import contact as ops_start
from ..ops.contact import Moved, left_alone
from ..ops.fields import DECREASE, FRACTIONS, RESTING_MOTION, ROUNDINGS, most_grouped
from ..ops.sums import Order, of_segments, one_thread, sum_by, sum_segments

# --- the potentials of pairs and of friction on a floor, each term of its own, without derivati -----------------------


def barrier_values(s: Scenes, x: Tensor) -> Tensor:
    """Barrier of each listed pair at x [B, V, 3], times h^2, [pairs] [kg m^2]."""
    f, listed = s.fields, s.listed
    state = pair_lag(x, f.collider, f.kappa, f.origin, listed)
    near = state[:, 1] > 0
    if not x.is_cuda:  # few of them push
        rows = near.nonzero()[:, 0]
        listed = replaced(listed, pairs=listed.pairs[rows], constants=listed.constants[rows])
        values = _barrier_values(s, x, listed, state[rows], near[rows])
        return values.new_zeros(len(near)).index_copy_(0, rows, values)
    return _barrier_values(s, x, listed, state, near)


def _barrier_values(s: Scenes, x: Tensor, listed: Pairs, state: Tensor, near: Tensor) -> Tensor:
    force, _, n, w = state.split((1, 1, 3, 4), -1)
    scene, corners = corners_of(listed)
    f = s.fields
    at = torch.cat([x, f.collider], 1)[scene, corners]
    if f.origin.numel():
        at = at + torch.cat([f.origin, torch.zeros_like(f.collider)], 1)[scene, corners]
    gap = (w * ((at - at[:, :1]) * n[:, None]).sum(-1)).sum(-1) - listed.constants[:, 1]
    b, slope, _ = log_barrier(torch.where(near, gap, 0.5), torch.where(near, listed.constants[:, 0], 1.0))
    # the force carries stiffness and mollifier
    return torch.where(near, s.time_step**2 * force[:, 0] * (b / -slope), 0.0)


def lagged_values(s: Scenes, x: Tensor) -> Tensor:
    """Friction and damping of each lagged pair, likewise."""
    f, h = s.fields, s.time_step
    load, rate, n, w = f.lag.split((1, 1, 3, 4), -1)
    scene, corners = corners_of(s.lagged)
    moved = torch.cat([x - f.x_prev, f.collider - f.collider_prev], 1)[scene, corners]
    m = (w[..., None] * moved).sum(1)
    along = (n * m).sum(-1, keepdim=True)
    slip = _slip_value(m - along * n, s.friction_eps)
    return h * h * load[:, 0] * slip + 0.5 * h * (rate * along.clamp(max=0) ** 2)[:, 0]


def floor_friction_values(s: Scenes, x: Tensor) -> Tensor:
    """Friction of each vertex on a floor, likewise [B, V]."""
    load, n = s.fields.floor_lag[..., 0], s.fields.floor_lag[..., 1:]
    travel = (x - s.fields.x_prev)[:, :, None]
    u = travel - n * (n * travel).sum(-1, keepdim=True)
    return s.time_step**2 * (load * _slip_value(u, s.friction_eps)).sum(-1)


def _slip_value(u: Tensor, eps: float) -> Tensor:
    """Friction potential f0 of tangential motions u [..., 3]; twin of slip_value in csrc/subspace/contact_rigid.h."""
    length = u.square().sum(-1).sqrt()
    return torch.where(length < eps, length**2 * (1 / eps - length / (3 * eps**2)) + eps / 3, length)


# --- whether bodies may move together ---------------------------------------------------------------------------------

EDGES = 1  # the kind of a pair of two edges


class Sets(NamedTuple):
    """Sets of bodies of all scenes, as the bodies of one large scene [1, B V, 3]; fields as of MovingBodies."""

    order: Tensor  # int32, rows of vertices that move, by set
    ptr: Tensor  # int32 [sets + 1]; on CUDA many sets are empty
    of: Tensor  # int64 [B V], the set of each row; `number` where it does not move
    of_body: Tensor  # int64 [B, bodies + 1], set of each body that moves, then that of the rest

    @property
    def number(self) -> int:
        return self.ptr.shape[0] - 1


class Trials:
    """Common data of all trials in one substep.

    Args:
        scenes: Scenes of the substep, with the pairs that sweeps can reach and their trust regions.
        inputs: Common data of the bodies' potentials.
    """

    def __init__(self, scenes: Scenes, inputs: IncreaseInputs) -> None:
        self.scenes, self.inputs = scenes, inputs
        moving = inputs.model._moving
        self.count = moving.number + 1  # what does not move counts as a body
        self.each = torch.arange(scenes.fields.x_prev.shape[1], dtype=torch.int32, device=moving.of.device)
        self.of = moving.of
        self.of_corner = torch.cat([self.of, self.of.new_full((scenes.fields.collider.shape[1],), moving.number)])
        self.bodies = self._sets()
        # the set of each pair, and the potentials of all of a kind
        self._of_pairs = [(self._set_of_pairs(listed), values) for listed, values in
                          ((scenes.listed, barrier_values), (scenes.lagged, lagged_values)) if listed.pairs.shape[0]
                          ]  # fmt: skip

    @torch.no_grad()
    def _sets(self) -> Sets:
        s, scenes, moves = self.scenes, self.scenes.fields.x_prev.shape[0], self.count - 1
        near = self._sides(s.listed, s.fields.constants[:, -1] < torch.inf)
        acts = (s.fields.lag[:, :2] != 0).any(-1) if s.fields.lag.numel() else s.lagged.pairs[:, 0] < 0
        one, two = torch.cat([near, self._sides(s.lagged, acts)]).unbind(1)
        least = connected_rows(one, two, scenes * self.count)
        # without convergence, all bodies of a scene are one set
        apart = (
            sum_by((least[one] != least[two]).to(s.fields.trust_radius.dtype)[:, None], one // self.count, scenes) > 0
        )
        first = self.count * torch.arange(scenes, device=least.device)[:, None]
        least = torch.where(apart, first, least.reshape(scenes, self.count)[:, :moves])
        number, of_body = scenes * self.count, least
        if not least.is_cuda:
            used, of_body = torch.unique(least, return_inverse=True)
            number = len(used)
        of_body = torch.cat([of_body, of_body.new_full((scenes, 1), number)], 1)
        of = of_body[:, self.of].reshape(-1)
        ordered, order = torch.sort(of, stable=True)
        active = scenes * len(self.inputs.model._moving.order)
        ptr = torch.searchsorted(ordered, torch.arange(number + 1, device=of.device))
        return Sets(order[:active].int(), ptr.int(), of, of_body)

    def _sides(self, listed: Pairs, counts: Tensor) -> Tensor:
        """Rows of the bodies of both sides of pairs [n, 2]; one row twice where one side moves or the pair does not
        count."""
        scene, corners = corners_of(listed)
        body, kind = self.of_corner[corners], listed.pairs[:, 4]
        first = torch.where(kind == EDGES, body[:, :2].amin(1), body[:, 0])
        second = torch.where(kind == EDGES, body[:, 2:].amin(1), body[:, 1:].amin(1))
        least, largest = torch.minimum(first, second), torch.maximum(first, second)
        joins = counts & (largest < self.count - 1) & (kind >= 0)
        return self.count * scene + torch.stack([least, torch.where(joins, largest, least)], 1)

    def _set_of_pairs(self, listed: Pairs) -> Tensor:
        scene, corners = corners_of(listed)
        return self.bodies.of_body[scene[:, 0], self.of_corner[corners].amin(1)]

    @torch.no_grad()
    def admits(self, x: Tensor, to: Tensor) -> Tensor:
        """Whether each set may move from x to ``to`` [1, B V, 3], bool [1, sets]; what does not move is at x in
        both."""
        x, to = (t.reshape(self.scenes.fields.x_prev.shape) for t in (x, to))
        return self._admits(x, to, 0.0)[None, :-1]

    @torch.no_grad()
    def lengths(self, x: Tensor, displacement: Tensor, slope: Tensor) -> Tensor:
        """Step fraction of each set along a displacement [B, V, 3]: the first of 1, 1/2, ..., 1/128 with a sufficient
        decrease of its potential, by the slope [sets]; else 0; [1, sets]."""
        found = torch.zeros_like(slope, dtype=x.dtype)
        for trial in range(FRACTIONS):
            fraction = 0.5**trial
            enough = torch.cat([DECREASE * fraction * slope, slope.new_zeros(1)])
            good = self._admits(x, x + fraction * displacement, enough)[:-1] & (slope <= 0)
            found = torch.where((found == 0) & good, fraction, found)
            if not x.is_cuda and bool((found > 0).all()):
                break
        return found[None]

    def _admits(self, x: Tensor, to: Tensor, most: Tensor | float) -> Tensor:
        """Whether the potential of each set increases at most by ``most``, without crossings, bool [sets + 1]."""
        increase, size = self.increase(x, to).unbind(-1)
        fits = torch.ones_like(increase, dtype=x.dtype)
        fits = fits.scatter_reduce(0, self.bodies.of, self._fits(x, to).reshape(-1), "amin")
        # False for NaN
        return (increase <= most + ROUNDINGS * torch.finfo(x.dtype).eps * size) & (fits >= 1)

    def of_bodies(self, values: Tensor) -> Tensor:
        """Values of sets [1, sets] of each body that moves [B, bodies]."""
        return values[0][self.bodies.of_body[:, :-1]]

    def increase(self, x: Tensor, to: Tensor) -> Tensor:
        """Increase of the potential of each set from x to ``to`` [B, V, 3], and the sizes of its terms [sets + 1, 2];
        the last row is of what does not move."""
        rows = self.bodies.number + 1
        own = increase_of_bodies(self.inputs, x, to)
        total = sum_by(own.flatten(0, 1), self.bodies.of_body[:, :-1].reshape(-1), rows)
        if self.scenes.fields.floor_lag.numel():
            total = total + _summed(floor_friction_values, self.scenes, x, to, self.bodies.of, rows)
        for of_pair, values in self._of_pairs:
            total = total + _summed(values, self.scenes, x, to, of_pair, rows)
        return total

    def _fits(self, x: Tensor, to: Tensor) -> Tensor:
        """Step fraction of each vertex when all move [B, V]: 1 where it fits; floors count in the potential."""
        f, surface = self.scenes.fields, self.scenes.model.surface_of_contact
        if surface is None:
            return torch.ones_like(x[..., 0])
        none, collider = x.new_zeros((x.shape[0], surface.bodies, 3)), f.collider.detach()
        displacement = torch.nan_to_num(to - x, 0.0, 0.0, 0.0)  # the potential finds NaN
        fraction, _ = ops_start.advance(x.contiguous(), displacement, none, f.center, f.origin, collider, collider,
                                        f.pinned, f.body, self.each, self.scenes.listed, careful=False)  # fmt: skip
        within = (to - f.center).square().sum(-1) <= f.trust_radius**2
        return torch.where(within | f.pinned[: x.shape[1]], fraction, 0.0)


def _summed(
    values: Callable[[Scenes, Tensor], Tensor], scenes: Scenes, x: Tensor, to: Tensor, index: Tensor, rows: int
) -> Tensor:
    """Differences of values between two states, and their sizes, summed by an index, float64 [rows, 2]."""
    before, after = (values(scenes, at).reshape(-1).double() for at in (x, to))
    return sum_by(torch.stack([after - before, before.abs() + after.abs()], 1), index, rows)


def connected_rows(one: Tensor, two: Tensor, count: int) -> Tensor:
    """Smallest row connected with each of ``count`` rows by pairs (one, two) [n]; on CUDA after a fixed number of
    rounds, enough for all but unusual graphs."""
    least = torch.arange(count, device=one.device)
    for _ in range(2 * count.bit_length()):
        low = torch.minimum(least[one], least[two])
        after = least
        for row in (one, two, least[one], least[two]):  # ends of pairs, and their smallest rows so far
            after = after.scatter_reduce(0, row, low, "amin")
        after = after[after]
        if not one.is_cuda and torch.equal(after, least):
            break
        least = after
    return least


# --- parts of coarse corrections of bodies that touch, differentiable -------------------------------------------------


class Scenes(NamedTuple):
    """Fields of the correction."""

    model: Any
    fields: ops.TouchingFields
    time_step: float
    friction_eps: float  # [m]

    @property
    def listed(self) -> Pairs:
        f = self.fields
        return Pairs(f.pairs, f.constants, f.pair_ptr, f.pair_entry)

    @property
    def lagged(self) -> Pairs:
        f = self.fields
        return Pairs(f.lag_pairs, f.constants, f.lag_ptr, f.lag_entry)


class PairTerms(NamedTuple):
    """Contribution of pairs: gradient [n, 3] by the motion of their weighted corners, its derivative [n, 3, 3] and
    weights [n, 4]."""

    listed: Pairs
    force: Tensor
    stiffness: Tensor
    weights: Tensor
    at_corners: Tensor | None = None  # what is added to the gradient at each corner [n, 4, 3]


def outer(n: Tensor) -> Tensor:
    return n[..., None] * n[..., None, :]


def _slip(u: Tensor, eps: float) -> tuple[Tensor, Tensor]:
    """f1(|u|) / |u| of friction and the derivative of this quotient over |u|, of tangential motions u [..., 3]."""
    square = (u * u).sum(-1)
    moves = square > (RESTING_MOTION * eps) ** 2
    length = torch.where(moves, torch.where(moves, square, torch.ones_like(square)).sqrt(), square.detach().sqrt())
    sticks = length < eps
    rate = torch.where(sticks, (2 - length / eps) / eps, 1 / torch.where(sticks, torch.ones_like(length), length))
    slope = torch.where(sticks, -1 / eps**2, -rate * rate)
    return rate, torch.where(moves, slope / torch.where(moves, length, torch.ones_like(length)), 0.0)


def _slip_stiffness(rate: Tensor, bend: Tensor, n: Tensor, u: Tensor) -> Tensor:
    """Exact derivative of friction by the tangential motion [..., 3, 3]; rate, bend: results of _slip times the
    load."""
    eye = torch.eye(3, dtype=n.dtype, device=n.device)
    return rate[..., None, None] * (eye - outer(n)) + bend[..., None, None] * outer(u)


def log_barrier(gap: Tensor, dhat: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """b / kappa and its first two derivatives, of gaps in (0, dhat)."""
    past, log = gap - dhat, torch.log(gap / dhat)
    part = past / gap
    return -past * past * log, -past * (2 * log + part), -(2 * log + 4 * part - part * part)


def _vertex_energies(s: Scenes) -> list[tuple[Any, tuple[Tensor, float, Tensor | None]]]:
    """Vertex energies, each with its data, the time step and the origin."""
    f = s.fields
    out, first, origin = [], 0, f.origin if f.origin.numel() else None
    for energy in s.model.vertex_energies:
        size = energy.count() * (s.model.num_vertices if energy.per_vertex else 1)
        own = f.energy_data[:, first : first + size]
        own = broadcast(own, (len(f.x), size)) if energy.per_vertex else of_vertices(own, f.x)
        out.append((energy, (own, s.time_step, origin)))
        first += size
    return out


def _floor_slip(s: Scenes) -> tuple[Tensor, Tensor, Tensor]:
    """Floor friction: tangential motion along each plane, and the results of _slip times the load [N]."""
    load, n = s.fields.floor_lag[..., 0], s.fields.floor_lag[..., 1:]
    travel = (s.fields.x - s.fields.x_prev)[:, :, None]
    u = travel - n * (n * travel).sum(-1, keepdim=True)
    rate, bend = _slip(u, s.friction_eps)
    return u, load * rate, load * bend


def vertex_gradient(s: Scenes) -> Tensor:
    """Gradient of inertia, vertex energies and floor friction [B, V, 3]; without inertia at pinned vertices."""
    f = s.fields
    off = torch.where(s.model._pinned[:, None], torch.zeros_like(f.x), f.x - f.y)
    force = broadcast(f.mass, f.x.shape[:2])[..., None] * off
    for energy, rest in _vertex_energies(s):
        force = force + energy.gradient(f.x, f.x_prev, *rest)
    if f.floor_lag.numel():
        u, rate, _ = _floor_slip(s)
        force = force + s.time_step**2 * (rate[..., None] * u).sum(2)
    return force


def vertex_blocks(s: Scenes) -> Tensor | None:
    """Blocks [B, V, 3, 3] of its derivative without inertia; None: there are none."""
    f = s.fields
    parts = [energy.blocks(f.x, f.x_prev, *rest) for energy, rest in _vertex_energies(s)]
    if f.floor_lag.numel():
        u, rate, bend = _floor_slip(s)
        parts.append(s.time_step**2 * _slip_stiffness(rate, bend, f.floor_lag[..., 1:], u).sum(2))
    out = None
    for part in parts:
        out = part if out is None else out + part
    return None if out is None else broadcast(out, (*f.x.shape, 3))


def corners_of(listed: Pairs) -> tuple[Tensor, Tensor]:
    """Scene [n, 1] and corner points [n, 4] of pairs; empty rows get zeros."""
    rows = listed.pairs.long().clamp(min=0)
    return rows[:, 5:], rows[:, :4]


def _listed(s: Scenes) -> Pairs:
    """Pairs that push, few of the listed ones; all where values must not decide sizes."""
    f, listed = s.fields, s.listed
    if f.x.is_cuda:
        return listed
    with torch.no_grad():
        acts = pair_lag(f.x.detach(), f.collider.detach(), f.kappa.detach(), f.origin, listed)[:, 1] > 0
    return some_of(listed, acts)[0]


def pair_terms(s: Scenes) -> list[PairTerms]:
    """Terms of barriers, and of lagged friction and damping."""
    f, h, h2 = s.fields, s.time_step, s.time_step**2
    points = torch.cat([f.x, f.collider], 1)
    out = []
    if f.pairs.shape[0]:
        listed = _listed(s)
        force, active, n, w = pair_lag(f.x, f.collider, f.kappa, f.origin, listed).split((1, 1, 3, 4), -1)
        at = at_corners(points, listed)
        if f.origin.numel():
            at = at + at_corners(torch.cat([f.origin, torch.zeros_like(f.collider)], 1), listed)
        dhat, offset = listed.constants[:, 0], listed.constants[:, 1]
        near = active[:, 0] > 0
        height = ((at - at[:, :1].detach()) * n[:, None]).sum(-1)
        gap = torch.where(near, (w * height).sum(-1) - offset, 0.5)
        b, _, curvature = log_barrier(gap, torch.where(near, dhat, 1.0))
        kappa = broadcast(f.kappa, near.shape) if f.kappa.shape[0] == 1 else of_scene(f.kappa, listed)
        e, by_corners = _mollifier(at, listed)
        turned = torch.where(near, h2 * kappa * b, 0.0)[:, None, None] * by_corners
        stiffness = torch.where(near, h2 * kappa * e * curvature, 0.0)[:, None, None] * outer(n)
        out.append(PairTerms(listed, torch.where(near[:, None], -h2 * force * n, 0.0), stiffness, w, turned))
    if f.lag.numel():
        load, rate, n, w = f.lag.split((1, 1, 3, 4), -1)
        moved = at_corners(points - torch.cat([f.x_prev, f.collider_prev], 1), s.lagged)
        m = (w[..., None] * moved).sum(1)
        along = (n * m).sum(-1, keepdim=True)
        approach, u = along.clamp(max=0), m - along * n
        slip, bend = (h2 * load[:, 0] * part for part in _slip(u, s.friction_eps))
        stiffness = _slip_stiffness(slip, bend, n, u) + (h * rate)[..., None] * outer(n)
        out.append(PairTerms(s.lagged, slip[:, None] * u + h * rate * approach * n, stiffness, w))
    return out


def _mollifier(at: Tensor, listed: Pairs) -> tuple[Tensor, Tensor]:
    """e = s (2 - s) of pairs [n] with corners [n, 4, 3], and its gradient by these; 1 and zero where nothing is
    mollified. Twin of csrc/contact/geometry.h."""
    threshold = listed.constants[:, 2]
    u, v = at[:, 1] - at[:, 0], at[:, 3] - at[:, 2]
    c = torch.linalg.cross(u, v)
    square = (c * c).sum(-1)
    close = (listed.pairs[:, 4] == 1) & (square < threshold)
    safe = torch.where(close, threshold, 1.0)
    part = square / safe
    slope = torch.where(close, 4 * (1 - part) / safe, 0.0)[:, None]
    by_u, by_v = slope * torch.linalg.cross(v, c), slope * torch.linalg.cross(c, u)
    return torch.where(close, part * (2 - part), 1.0), torch.stack([-by_u, by_u, -by_v, by_v], 1)


# --- the rigid correction of bodies that touch ------------------------------------------------------------------------

_FIELDS = len(ops.TouchingFields._fields)


class Corrected(NamedTuple):
    """State after corrections; all but x is index data."""

    x: Tensor  # [B, V, 3]
    fractions: list[Tensor]  # step fractions of each correction [B, bodies]
    back: Tensor  # translation that each did not take of its last motion [B, bodies] [m]


class Which(NamedTuple):
    """Bodies that a correction moves; see ops.contact.rigid_system."""

    moving: Tensor | None = None  # bool [B, bodies]; None: all
    alone: bool = False


# more(count, moved, groups): bodies of the next correction, after `count` of them, from the results of the last one;
# None ends them.
More = Callable[[int, ops_rigid.Moved, Tensor], Which | None]


def once(*_: Any) -> None:
    """Ends the corrections after the first."""


def correct(model: System, fields: ops.TouchingFields, time_step: float, friction_eps: float,
            more: More = once) -> Corrected:  # fmt: skip
    """State after the rigid correction of every free body, by an admissible step fraction, and after those that
    ``more`` adds. friction_eps: [m], 0 without friction. Differentiable in ops.TOUCHING_ADJOINTS."""
    fields = ops.TouchingFields(*[t.contiguous() for t in fields])
    kept = torch.is_grad_enabled() and any([t.requires_grad for t in fields])
    x, back, *rest = _correct(*fields, model, time_step, friction_eps, more, kept)
    fractions = _made(fields.x, rest).fraction if kept else rest
    return Corrected(x, [fraction.to(x.dtype) for fraction in fractions], back)


def _made(x: Tensor, flat: Sequence[Tensor]) -> ops_rigid.Made:
    """Corrections from the saved list: motion, fraction, factor and groups of each, and between two of them the state
    before the second. x: State before the first."""
    return ops_rigid.Made([x, *flat[4::5]], *(flat[k::5] for k in range(4)))


def bodies_of(model: System) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """order, ptr, free, pinned and body of ops.TouchingFields."""
    return model.derived("touching_bodies", lambda: _bodies_of(model))


def _bodies_of(model: System) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    surface, count = model.surface_of_contact, model.mesh.num_bodies
    pins = torch.zeros((count,), dtype=torch.int64, device=model.device).index_add(0, model.body, model._pinned.long())
    free = pins == 0
    if surface is not None:
        return surface.body_order, surface.body_ptr, free, surface.pinned, surface.body
    body, order = torch.sort(model.body, stable=True)
    ptr = torch.searchsorted(body, torch.arange(count + 1, device=body.device))
    return order.to(torch.int32), ptr.to(torch.int32), free, model._pinned, model.body.to(torch.int32)


def _run(*args: Any) -> tuple[Tensor, ...]:
    fields, (model, time_step, friction_eps, more, kept) = ops.TouchingFields(*args[:_FIELDS]), args[_FIELDS:]
    options, made, count, back = (model._data_count, time_step, friction_eps), [], 0, fields.x
    which: Which | None = Which()
    while which is not None:
        if count and kept:
            made.append(fields.x)
        centers, motion, factor, groups = ops_rigid.rigid_system(fields, *options, which.moving, which.alone)
        end = ops_rigid.rigid_move(fields, centers, motion, *options, which.moving)
        made.extend([motion, end.fraction, factor, groups] if kept else [end.fraction])
        back = end.remaining if which.moving is None else torch.where(end.moved, end.remaining, back)
        count, fields = count + 1, replaced(fields, x=end.x)
        which = more(count, end, groups)
    return fields.x, back, *made


def _reverse(bars: Sequence[Any], saved: Sequence[Any], rest: tuple, needs: Sequence[bool]) -> list[Any]:
    model, time_step, friction_eps = rest
    s = Scenes(model, ops.TouchingFields(*saved[:_FIELDS]), time_step,
               friction_eps or 1.0)  # which loads that are zero do not read  # fmt: skip
    return _adjoints(s, bars[0], _made(saved[0], saved[_FIELDS:]), needs)


# Fields; model, time_step, friction_eps, more, kept.
_correct = ops.Differentiable(
    _run, _reverse, arguments=_FIELDS + 5, inputs=_FIELDS, saved=lambda inputs, made: (*inputs[:_FIELDS], *made[2:]),
    rest=lambda inputs: inputs[_FIELDS:-2],
)  # fmt: skip


def _adjoints(s: Scenes, x_bar: Tensor, made: ops_rigid.Made, needs: Sequence[bool]) -> list[Tensor | None]:
    """Adjoints of the fields. With H d = -g, the adjoint of d is that of -l . (g + H d), where H l is the adjoint of d:
    a sum over vertices and pairs."""
    f = s.fields
    wants = dict(zip(ops.TouchingFields._fields, needs, strict=True))
    own = ops_rigid.rigid_reverse(f, made, x_bar, s.model._data_count, s.time_step, s.friction_eps,
                                  wants["energy_data"])._asdict()  # fmt: skip
    by_kappa = own.pop("by_kappa")
    if wants["kappa"]:
        own["kappa"] = -sum_of_scenes(by_kappa, s.listed, f.x.shape[0])
    return [own.get(name) for name in f._fields]


# --- the coarse correction of bodies that touch -----------------------------------------------------------------------


class Space(NamedTuple):
    """Functions W [V, F] of a Model by row, and their bodies; constants."""

    vertex: Tensor  # int64 [entries]
    function: Tensor  # int64 [entries]
    by_vertex: Order  # of the entries
    by_function: Order
    weight: Tensor  # [entries]
    body: Tensor  # int64 [F], of those that move; their number where a function only fills up
    of_coarse: Tensor  # int64 [coarse bodies], the moving body of each
    dense: Tensor  # int64 [9 cells], where the packed matrices of all bodies stand in one [3F, 3F]
    functions: int

    def restricted(self, g: Tensor) -> Tensor:
        """P' g: [B, V, 3] -> [B, F, 3]."""
        return sum_segments(self.weight[:, None] * of_segments(g, *self.by_vertex), *self.by_function)

    def prolonged(self, a: Tensor) -> Tensor:
        """P a: [B, F, 3] -> [B, V, 3]."""
        return sum_segments(self.weight[:, None] * of_segments(a, *self.by_function), *self.by_vertex)


def space_of(model: System) -> Space:
    return model.derived("contact_space", lambda: _space(model))


def _space(model: System) -> Space:
    g, moving = model.coarse_geometry, model._moving
    vertex, function = (torch.from_numpy(a).to(model.device, torch.int64) for a in (g.vertex, g.function))
    weight = torch.from_numpy(g.weight).to(model.device, model.dtype)
    body = torch.full((g.functions,), moving.number, device=model.device)
    body[function] = moving.of[vertex]
    ptr = torch.from_numpy(g.function_ptr).to(model.device, torch.int64)
    dense = []
    for first, last in zip(g.function_ptr[:-1].tolist(), g.function_ptr[1:].tolist(), strict=True):
        rows = torch.arange(3 * first, 3 * last)
        dense.append((3 * g.functions * rows[:, None] + rows).reshape(-1))
    orders = (_order(vertex, model.num_vertices), _order(function, g.functions))
    return Space(
        vertex, function, *orders, weight, body, body[ptr[:-1]], torch.cat(dense).to(model.device), g.functions
    )


def _order(index: Tensor, count: int) -> Order:
    ordered, order = torch.sort(index, stable=True)
    ptr = torch.searchsorted(ordered, torch.arange(count + 1, device=index.device))
    return order.to(torch.int32), ptr.to(torch.int32), index


class Corrections:
    """Coarse corrections of a substep. packed: Matrices of all bodies, differentiable."""

    def __init__(self, trials: Trials, fields: ops.SweepFields, packed: Tensor, scenes: Scenes) -> None:
        self.trials, self.fields, self.packed, self.scenes = trials, fields, packed, scenes
        self.constants = replaced(fields, **{k: None if t is None else t.detach() for k, t in fields._asdict().items()})
        if fields.rest is None:  # made on first use, which must not be in a backward that is being compiled
            self.constants = replaced(self.constants, rest=scenes.model.rest_scalars)
        self.space = space_of(scenes.model)
        self.matrix = _dense(packed.detach(), self.space)
        self.sets = trials.bodies.number
        self.set_of = trials.bodies.of_body[:, self.space.body]  # of each function [B, F]

    def correct(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """x [B, V, 3] after a correction, and its length for each body of the coarse space [B, bodies]."""
        r, presses = self._gradient(x)
        with torch.no_grad():
            a = self._solved(presses, r)
            displacement = -self.space.prolonged(a)
            slope = sum_by(-(r * a).sum(-1).reshape(-1, 1).double(), self.set_of.reshape(-1), self.sets + 1)[:-1, 0]
            length = torch.where(self._lost(), 0.0, self.trials.lengths(x, displacement, slope))
        if torch.is_grad_enabled():
            displacement = -self.space.prolonged(self._differentiable(a, r, presses))
        of_vertex = torch.cat([length, length.new_zeros((1, 1))], 1)[0][self.trials.bodies.of].reshape(*x.shape[:2], 1)
        return torch.where(of_vertex > 0, x + of_vertex * displacement, x), self._of_bodies(length)

    def _of_bodies(self, length: Tensor) -> Tensor:
        return length[0][self.trials.bodies.of_body[:, self.space.of_coarse]]

    def _gradient(self, x: Tensor) -> tuple[Tensor, list[_Press]]:
        """P' dG [B, F, 3], and stiffnesses."""
        s, f = replaced(self.scenes, fields=replaced(self.scenes.fields, x=x)), self.fields
        force = _Elastic.apply(x, f.mu, f.lam, f.rest, self.constants, s.model, s.time_step) + vertex_gradient(s)
        scenes, vertices = x.shape[:2]
        presses = []
        blocks = vertex_blocks(s)
        if blocks is not None:
            presses.append(_at_vertices(blocks))
        for terms in pair_terms(s):
            scene, corners = corners_of(terms.listed)
            moves = corners < vertices
            rows = vertices * scene + torch.where(moves, corners, 0)  # a corner that does not move keeps its scene
            weights = torch.where(moves, terms.weights, 0.0)
            pulled = terms.weights[..., None] * terms.force[:, None]
            if terms.at_corners is not None:
                pulled = pulled + terms.at_corners
            force = force + sum_at_corners(pulled, terms.listed, scenes, s.fields.body.shape[0])[:, :vertices]
            presses.append(_Press(rows, weights, terms.stiffness))
        return self.space.restricted(force), presses

    def _solved(self, presses: list[_Press], r: Tensor) -> Tensor:
        """a [B, F, 3]; keeps the factor, in double precision for the range of stiffnesses."""
        scenes, unknowns = r.shape[0], 3 * self.space.functions
        matrix = self.matrix.expand(scenes, unknowns, unknowns).double()
        for press in presses:
            matrix = matrix + press.assembled(self.space, scenes, self.scenes.fields.x_prev.shape[1])
        with one_thread(matrix):
            factor = torch.linalg.cholesky_ex(matrix)[0]
        # a matrix that is not positive definite gives no correction and no gradient
        self.solved = torch.isfinite(factor).flatten(1).all(1)[:, None, None]
        self.cholesky = torch.where(self.solved, factor, torch.eye(unknowns, dtype=factor.dtype, device=r.device))
        return self._back(r)

    def _lost(self) -> Tensor:
        """The sets of scenes without a correction, bool [sets]."""
        lost = (~self.solved[:, :, 0]).expand(self.set_of.shape).double()
        return sum_by(lost.reshape(-1, 1), self.set_of.reshape(-1), self.sets + 1)[:-1, 0] > 0

    def _back(self, r: Tensor) -> Tensor:
        right = torch.where(self.solved, r, 0.0).double().reshape(r.shape[0], -1, 1)
        return _Back.apply(self.cholesky, right).reshape(r.shape).to(r.dtype)

    def _differentiable(self, a: Tensor, r: Tensor, presses: list[_Press]) -> Tensor:
        """a with its derivatives: one more step with the same matrix. Its value, r - A a, is dropped, even where the
        matrix is nearly singular: the correction that was tried is the one that is made."""
        pushed = _Product.apply(self.packed, a, self.space)
        displacement = self.space.prolonged(a)
        for press in presses:
            pushed = pushed + self.space.restricted(press.product(displacement))
        step = self._back(r - pushed)
        return a + (step - step.detach())


class _Press(NamedTuple):
    """Stiffness against motions sum_k w_k x_k of some vertices."""

    rows: Tensor  # int64 [n, k], among the vertices of all scenes
    weights: Tensor  # [n, k]
    stiffness: Tensor  # [n, 3, 3], times h^2

    def product(self, displacement: Tensor) -> Tensor:
        """[B, V, 3] -> [B, V, 3]"""
        flat = displacement.flatten(0, 1)
        moved = (self.weights[..., None] * flat[self.rows]).sum(1)
        force = (self.stiffness * moved[:, None]).sum(-1)
        pulled = self.weights[..., None] * force[:, None]
        return sum_by(pulled.reshape(-1, 3), self.rows.reshape(-1), len(flat)).reshape(displacement.shape)

    def assembled(self, space: Space, scenes: int, vertices: int) -> Tensor:
        """P' H P [B, 3F, 3F]."""
        dense = torch.zeros((vertices, space.functions), dtype=space.weight.dtype, device=space.weight.device)
        dense[space.vertex, space.function] = space.weight
        moved = (self.weights[..., None] * dense[self.rows % vertices]).sum(1)  # [n, F]
        scene, out = self.rows[:, 0] // vertices, []
        for n in range(scenes):
            own = torch.where((scene == n)[:, None], moved, 0.0) if scenes > 1 else moved
            with one_thread(own):
                upper = {(i, j): own.mT @ (self.stiffness[:, i, j, None] * own) for i in range(3) for j in range(i, 3)}
            blocks = [torch.stack([upper[min(i, j), max(i, j)] for j in range(3)], -1) for i in range(3)]
            out.append(torch.stack(blocks, 1).reshape(3 * space.functions, -1))
        return torch.stack(out)


def _at_vertices(blocks: Tensor) -> _Press:
    """Stiffness of blocks [B, V, 3, 3]; only of nonzero ones where values may decide sizes."""
    flat = blocks.flatten(0, 1)
    rows = torch.arange(len(flat), device=flat.device)
    if not flat.is_cuda:
        rows = (flat != 0).flatten(1).any(1).nonzero()[:, 0]
        flat = flat[rows]
    return _Press(rows[:, None], torch.ones_like(flat[:, :1, 0]), flat)


def _dense(packed: Tensor, space: Space) -> Tensor:
    """The matrices of all bodies as one [B, 3F, 3F]."""
    unknowns = 3 * space.functions
    out = packed.new_zeros((len(packed), unknowns * unknowns))
    out[:, space.dense] = packed
    return out.reshape(-1, unknowns, unknowns)


class _Back(Function):
    """(L L')^-1 b of a factor that is a constant."""

    @staticmethod
    def forward(factor: Tensor, right: Tensor) -> Tensor:
        with one_thread(factor):
            half = torch.linalg.solve_triangular(factor, right, upper=False)
            return torch.linalg.solve_triangular(factor.mT, half, upper=True)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: Tensor) -> None:
        ctx.save_for_backward(inputs[0])

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple:
        return None, _Back.apply(*ctx.saved_tensors, grads[0])


class _Product(Function):
    """A a [B, F, 3] of the matrices without presses."""

    @staticmethod
    def forward(packed: Tensor, a: Tensor, space: Space) -> Tensor:
        matrix = _dense(packed, space)
        with one_thread(matrix):
            return (matrix @ a.reshape(len(a), -1, 1)).reshape(a.shape)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: Tensor) -> None:
        packed, a, ctx.space = inputs
        ctx.shape = packed.shape
        ctx.save_for_backward(a)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple:
        (a,) = ctx.saved_tensors
        unknowns = 3 * ctx.space.functions
        row, column = ctx.space.dense // unknowns, ctx.space.dense % unknowns
        bar = grads[0].reshape(len(a), -1)[:, row] * a.reshape(len(a), -1)[:, column]
        return ops.sum_to(bar, ctx.shape), None, None


class _Elastic(Function):
    """The gradient of the tets' energy times h^2 [B, V, 3]."""

    @staticmethod
    def forward(
        x: Tensor, mu: Tensor, lam: Tensor, rest: Tensor | None, fields: Any, model: System, h: float
    ) -> Tensor:
        return IncrementalPotential(model, x, fields, h).elastic()

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: Tensor) -> None:
        x, mu, lam, rest, ctx.fields, ctx.model, ctx.h = inputs
        ctx.shapes = [None if t is None else t.shape for t in (mu, lam, rest)]
        ctx.save_for_backward(x)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple:
        (x,) = ctx.saved_tensors
        w, needs = grads[0].contiguous(), ctx.needs_input_grad
        potential = IncrementalPotential(ctx.model, x, ctx.fields, ctx.h)
        bars = potential.dependence(w, (False, False, False, needs[1], needs[2], False, needs[3], False))
        bars = [None if bar is None else ops.sum_to(-bar, shape)
                for bar, shape in zip((bars[3], bars[4], bars[6]), ctx.shapes, strict=True)]  # fmt: skip
        return potential.elastic_product(w) if needs[0] else None, *bars, None, None, None


# --- rigid corrections of a substep -----------------------------------------------------------------------------------

# Rigid corrections after the last sweeps while bodies are blocked: they first approach the blocking bodies, then push
# them. A row of four cubes that meet at 3 m/s lost 14 % of its momentum with one correction and none with three; at
# 10 m/s that takes five.
BLOCKED_CORRECTIONS = 5
# The same where touching bodies are too many to be corrected together. In stacks of two with friction the upper body
# creeps at 3.4 mm/s with 3, 2.0 with 4 and 1.1 with 6; stacks of four fell with 6.
LEFT_CORRECTIONS = 8
BLOCKED = 0.01  # of its displacement in the step plus dhat: a body that misses more is blocked


def corrected(of: Any, x: Tensor, collider: Tensor, start: SubstepStart, listed: Pairs, more: More = once) -> Corrected:
    """State after the rigid correction of all free bodies, and after those that ``more`` adds."""
    numbers = of.prepared.settings.numbers
    eps = 0.0 if of.model.friction is None else numbers.friction_eps
    return correct(of.model, touching(of, x, collider, start, listed), numbers.time_step, eps, more)


def touching(of: Any, x: Tensor, collider: Tensor, start: SubstepStart, listed: Pairs) -> ops.TouchingFields:
    """Fields of the rigid correction, at x [B, V, 3]."""
    lagged = of.lagged
    return ops.TouchingFields(
        x, of.x_prev, of.begun.y, of.fields.mass, of.begun.data, of.origin, *bodies_of(of.model), collider, of.before,
        of.kappa, *listed, of.lag, lagged.pairs, lagged.ptr, lagged.entry, of.floor_lag, start.center,
        start.trust_radius,
    )  # fmt: skip


def corrected_after(of: Any, x: Tensor, collider: Tensor, start: SubstepStart, listed: Pairs, last: bool) -> Corrected:
    """State after the corrections that follow the sweeps of a substep. last: Whether these are the last sweeps."""
    # coarse sweeps leave a stiff body rotated; after one Newton step a free body still gained spin
    least = 1 if of.prepared.coarse is None else 2
    bodies = of.model.mesh.num_bodies
    grouped, captured = bodies <= most_grouped(bodies), is_captured(x)

    def more(count: int, end: Moved, groups: Tensor) -> Which | None:
        if count < least:
            return Which()
        if not last or of.barrier is None or count >= (BLOCKED_CORRECTIONS if grouped else LEFT_CORRECTIONS):
            return None
        alone = count >= BLOCKED_CORRECTIONS
        left = None if grouped else left_alone(groups)
        if not captured:
            some_blocked = not alone and bool(end.blocked.any())
            if not some_blocked and (left is None or not bool(left.any())):
                return None
            alone = not some_blocked
        return Which(end.blocked if left is None else left if alone else end.blocked | left, alone)

    return corrected(of, x, collider, start, listed, more)


def is_blocked(of: Any, x: Tensor, back: Tensor) -> Tensor:
    """Vertices [B, V] of bodies blocked at the end, at x [B, V, 3]; back: Of Corrected."""
    assert of.barrier is not None
    displacement = (x.detach() - of.x_prev.detach()).norm(dim=-1)
    body = of.model.derived("labels", lambda: of.model.body)
    return back[:, body] > BLOCKED * (displacement + of.barrier.dhat)
