"""Forces of pairs at one state, in plain torch and differentiable: barrier, damping of approach and friction.

The formulas of docs/method.md, section 12, for reading and for residuals; sweeps have their own. Pairs come from
detection and have no derivative. Everything is computed in float64, whatever the positions are.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from .._common.checks import fail
from .._contact.barrier import PairBarrier
from .._contact.detection import detect
from .._contact.surface import LEAST_CAPACITY, ContactSurface
from ..energies import damped_fraction, log_barrier
from ..reference.contact import loads
from ..reference.distance import EDGE_EDGE, distance, weight, with_gradient
from ..reference.energies import smoothed

ADVANCES = 8  # of continuous detection after the first; fewer are on the safe side


class NearPairs(NamedTuple):
    """Q pairs that are closer than their dhat."""

    corners: Tensor  # [Q, 4] int64, of corner points
    kind: Tensor  # [Q] int64
    scene: Tensor  # [Q] int64
    dhat: Tensor  # [Q] [m]
    offset: Tensor  # [Q] sum of the radii [m]
    measure: Tensor  # [Q] that weighs the pair (reference.distance.weight)

    @classmethod
    def of(cls, pairs: Tensor, constants: Tensor) -> NearPairs:
        """Of the rows of a detection."""
        rows, numbers = pairs.long(), constants.double()
        return cls(rows[:, :4], rows[:, 4], rows[:, 5], *numbers[:, :3].unbind(1))

    def positions(self, points: Tensor) -> Tensor:
        """Corners [Q, 4, 3] in corner points [B, N, 3]."""
        return points[self.scene[:, None], self.corners]

    def measures(self, points: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Gap [Q] and weight [Q], each followed by its gradient [Q, 4, 3] toward the corners."""
        at = self.positions(points)
        d, slope = with_gradient(partial(distance, self.kind), at)
        e, turn = with_gradient(partial(weight, self.kind, dhat=self.dhat, measure=self.measure), at)
        return d - self.offset, slope, e, turn

    def of_scene(self, value: Tensor) -> Tensor:
        """A parameter [1 | B], for each pair [Q]."""
        return value.expand(len(self.scene)) if value.shape[0] == 1 else value[self.scene]

    def summed(self, on_corners: Tensor, points: Tensor) -> Tensor:
        """Values of corners [Q, 4, n], added up over corner points, [B, N, n]; points: [B, N, 3]."""
        (scenes, count), size = points.shape[:2], on_corners.shape[-1]
        rows = (self.scene[:, None] * count + self.corners).reshape(-1)
        flat = on_corners.new_zeros(scenes * count, size).index_add(0, rows, on_corners.reshape(-1, size))
        return flat.reshape(scenes, count, size)

    def of_first(self, on_corners: Tensor) -> Tensor:
        """Force on the first of the two sides of each pair [Q, 3]; the second takes its opposite."""
        both = (self.kind == EDGE_EDGE)[:, None]
        return on_corners[:, 0] + torch.where(both, on_corners[:, 1], 0.0)

    def sides(self, body: Tensor) -> tuple[Tensor, Tensor]:
        """Body of the first and of the second side [Q]; ``body`` [N] of the corner points."""
        second = torch.where(self.kind == EDGE_EDGE, self.corners[:, 2], self.corners[:, 1])
        return body[self.corners[:, 0]], body[second]


def corner_points(x: Tensor, origin: Tensor | None, colliders: Tensor) -> Tensor:
    """Positions of all corner points [B, N, 3] in float64: of the mesh, then of the colliders."""
    x = x.double() if origin is None else x.double() + origin.double()
    return torch.cat([x, colliders.double()], 1)


def near_pairs(
    x: Tensor, origin: Tensor | None, was: Tensor, now: Tensor, surface: ContactSurface, barrier: PairBarrier,
    radius: Tensor | None = None,
) -> NearPairs:  # fmt: skip
    """Pairs closer than their dhat at x; arguments as of :func:`detection.detect`, ``origin`` or None.

    radius: How far the vertices of each body go, and the most of all [B, bodies + 1] [m]; pairs that may come closer
    than dhat on the way are listed, too.

    Raises:
        ValueError: Where surfaces touch, or positions are not finite.
    """
    with torch.no_grad():
        x, was, now = (t.detach().contiguous() for t in (x, was, now))
        shift = x.new_empty((0,)) if origin is None else origin.detach().contiguous()
        reach = x.new_zeros((x.shape[0], surface.bodies + 1)) if radius is None else radius
        capacity = max(surface.capacity * x.shape[0], LEAST_CAPACITY)
        while True:
            pairs, constants, *_, counts, _ = detect(x, shift, was, now, surface, barrier, capacity, reach, reach)
            needed, touching, key = counts.tolist()
            if needed <= capacity:
                break
            capacity = needed
        if touching:
            _raise_touching(surface, touching, key)
        listed = NearPairs.of(pairs[:needed], constants[:needed])
        if radius is not None:
            return listed
        gap = distance(listed.kind, listed.positions(corner_points(x, origin, was))) - listed.offset
        near = gap < listed.dhat
        return NearPairs(*(t[near] for t in listed))


def _raise_touching(surface: ContactSurface, touching: int, key: int) -> None:
    if key < 0:
        fail("x", "finite positions of surfaces", "some that are not")
    scene, corners = surface.corners_of(key)
    fail("x", "surfaces that do not touch", f"{touching} pairs without a gap, one of the corner points {corners} of "
         f"{surface.owners_of(corners[0], corners[3])} in scene {scene}")  # fmt: skip


def pair_energy(pairs: NearPairs, corners: Tensor, kappa: Tensor) -> Tensor:
    """Energy of the barrier of each pair [J], [Q]; corners: [Q, 4, 3].  kappa: [1 | B] [N/m]."""
    gap = distance(pairs.kind, corners) - pairs.offset
    return (
        weight(pairs.kind, corners, pairs.dhat, pairs.measure) * log_barrier(gap, pairs.of_scene(kappa), pairs.dhat)[0]
    )


def safe_fraction(pairs: NearPairs, points: Tensor, move: Tensor, closed: float) -> Tensor:
    """Largest fraction, at most 1, of a motion of corner points [B, N, 3] on which each pair closes at most a part
    ``closed`` of its gap, of each scene [B]. No corner may go farther than the pairs were listed for.

    The gap of a pair shrinks no faster than its two sides approach: additive continuous collision detection.

    Source: Li et al. (2021), Codimensional incremental potential contact, section 4.
    """
    at, u = pairs.positions(points), pairs.positions(move)
    u = u - u.mean(1, keepdim=True)  # what all corners share changes no gap
    size, both = u.norm(dim=-1), pairs.kind == EDGE_EDGE
    first = torch.where(both, torch.maximum(size[:, 0], size[:, 1]), size[:, 0])
    second = torch.where(both, torch.maximum(size[:, 2], size[:, 3]), size[:, 1:].amax(1))
    gap, speed = distance(pairs.kind, at) - pairs.offset, first + second
    some = speed > closed * gap  # the others may go all the way
    kind, scene, at, u, gap, speed = (a[some] for a in (pairs.kind, pairs.scene, at, u, gap, speed))
    fraction = closed * gap / speed
    for _ in range(ADVANCES):
        left = distance(kind, at + fraction[:, None, None] * u) - pairs.offset[some] - (1 - closed) * gap
        fraction = (fraction + left / speed).clamp(max=1)
    return points.new_ones(len(points)).scatter_reduce(0, scene, fraction, "amin")


def barrier_forces(pairs: NearPairs, points: Tensor, kappa: Tensor) -> Tensor:
    """Force of the barrier on each corner of each pair [N], [Q, 4, 3].

    Args:
        points: Corner points [B, N, 3].  kappa: [1 | B] [N/m].
    """
    gap, slope, e, turn = pairs.measures(points)
    value, first, _ = log_barrier(gap, pairs.of_scene(kappa), pairs.dhat)
    return -(e * first)[:, None, None] * slope - value[:, None, None] * turn


def barrier_stiffness(pairs: NearPairs, points: Tensor, kappa: Tensor) -> Tensor:
    """Trace of e b'' grad_gap grad_gap^T of each corner point [N/m], [B, N], the scale of its stiffness; arguments as
    of barrier_forces."""
    gap, slope, e, _ = pairs.measures(points)
    _, _, second = log_barrier(gap, pairs.of_scene(kappa), pairs.dhat)
    return pairs.summed((e * second)[:, None, None] * slope.square(), points).sum(-1)  # of 3x3 blocks


class Lag(NamedTuple):
    """Lagged values that damping and friction of a step take from its start, for Q pairs that were near there."""

    pairs: NearPairs
    start: Tensor  # corner points at the start [B, N, 3]
    size: Tensor  # [Q] normal force there [N]
    normal: Tensor  # [Q, 3]
    fraction: Tensor  # [Q] of its damping
    weights: Tensor  # [Q, 4]
    slope: Tensor  # [Q, 4, 3] weights times normal


def lag_of(pairs: NearPairs, start: Tensor, kappa: Tensor, body: Tensor) -> Lag:
    """pairs: near at the start, where corner points are ``start`` [B, N, 3]; kappa: [1 | B] [N/m]; body: [N]."""
    gap, slope, e, _ = pairs.measures(start)
    _, first, _ = log_barrier(gap, pairs.of_scene(kappa), pairs.dhat)
    normal = pairs.of_first(slope)  # weights of the first side sum to 1
    weights = (slope * normal[:, None]).sum(-1)
    size = loads(-e * first, pairs.corners, pairs.kind, pairs.scene, body)
    return Lag(pairs, start, size, normal, damped_fraction(size, pairs.of_scene(kappa), pairs.dhat), weights, slope)


def lagged_forces(
    lag: Lag, points: Tensor, damping: Tensor, coefficient: Tensor, time_step: float, reach: float
) -> tuple[Tensor, Tensor]:
    """Damping of approach and friction on each corner of the lagged pairs [N], both [Q, 4, 3].

    Args:
        points: Corner points at the state [B, N, 3].  damping: [1 | B] [N s/m].  coefficient: [Q], of friction.
        reach: Slip in a step from which friction is full [m].
    """
    along, slip, size = _slips(lag, points, coefficient, reach)
    damped = -(lag.pairs.of_scene(damping) * lag.fraction / time_step) * along.clamp(max=0)
    return damped[:, None, None] * lag.slope, -(size[:, None] * slip)[:, None] * lag.weights[..., None]


def _slips(lag: Lag, points: Tensor, coefficient: Tensor, reach: float) -> tuple[Tensor, Tensor, Tensor]:
    """Motion since the start along the normal [Q] and across it [Q, 3], and friction over the latter [N/m], [Q]."""
    moved = (lag.weights[..., None] * lag.pairs.positions(points - lag.start)).sum(1)
    along = (lag.normal * moved).sum(-1)
    slip = moved - along[:, None] * lag.normal
    return along, slip, coefficient * lag.size * smoothed(slip.T, reach)[1]


def lagged_stiffness(
    lag: Lag, points: Tensor, damping: Tensor, coefficient: Tensor, time_step: float, reach: float
) -> Tensor:
    """Trace of the same two terms' part of each corner point's block [N/m], [B, N]; arguments as of lagged_forces."""
    pairs = lag.pairs
    *_, size = _slips(lag, points, coefficient, reach)
    each = pairs.of_scene(damping) * lag.fraction / time_step + 2 * size
    return pairs.summed((each[:, None] * lag.weights.square())[..., None], points)[..., 0]
