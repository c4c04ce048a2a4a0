"""Lagged contact: forces, normals and weights of pairs at the start of a step, differentiable."""

from __future__ import annotations

import math
from functools import cached_property
from typing import Any, NamedTuple

import torch
from torch import Tensor

from .. import ops
from .._contact.pair_forces import (
    NearPairs,
    barrier_forces,
    barrier_stiffness,
    corner_points,
    lag_of,
    lagged_forces,
    lagged_stiffness,
    near_pairs,
    pair_energy,
)
from ..energies import damped_fraction, log_barrier
from ..model.inputs import parameter_of
from ..model.patches import Averaged
from ..model.system import System
from ..ops.fields import CONSTANTS
from ..ops.sums import segment_sum, sum_by
from ..reference.energies import smoothed
from .potential import IncrementalPotential


class Pairs(NamedTuple):
    """Index data of a detection: which pairs there are; not differentiable. Shapes: detection.detect."""

    pairs: Tensor
    constants: Tensor
    ptr: Tensor
    entry: Tensor


def no_pairs(like: Tensor, corners: int) -> Pairs:
    """An empty list for so many corner points of all scenes."""
    none = torch.zeros((corners + 1,), dtype=torch.int32, device=like.device)
    return Pairs(none[:0].reshape(0, 6), like.new_zeros((0, CONSTANTS)), none, none[:0])


_of_scene = ops.Linear(lambda value, listed: value[listed.pairs[:, 5].clamp(min=0).to(torch.int64)],
                       lambda bar, shape, listed: sum_of_scenes(bar, listed, shape[0]), 2)  # fmt: skip


def sum_of_scenes(values: Tensor, listed: Pairs, scenes: int) -> Tensor:
    """Sums of values of pairs [pairs] over those of each scene [B], in a fixed order; values are zero in rows that no
    pair fills."""
    if scenes <= 1:
        return ops.sum_to(values, (1,))[:scenes]
    ptr = listed.ptr  # pairs are sorted by scene, with four entries each
    first = (ptr[:: (ptr.shape[0] - 1) // scenes] // 4).contiguous()
    order = torch.arange(values.shape[0], dtype=torch.int32, device=ptr.device)
    return segment_sum(values[None, :, None].contiguous(), order, first)[0, :, 0]


def of_scene(value: Tensor, listed: Pairs) -> Tensor:
    """value [B], one for each scene, for each pair [pairs]; its gradient is summed in a fixed order."""
    return _of_scene(value, listed)


def friction_lag(x: Tensor, collider: Tensor, kappa: Tensor, friction: Tensor | None, damping: Tensor | None,
                 origin: Tensor, body: Tensor, listed: Pairs) -> Tensor:  # fmt: skip
    """[pairs, 9]: friction coefficient times normal force [N], damping [N s/m] (energies.damped_fraction), normal (3),
    weights (4). Differentiable in the first five. Of the faces of another body near a point, the one that presses it
    most has the normal force of all, and the others have none.

    Args:
        x: [B, V, 3] [m].  collider: [B, Vc, 3] [m].  kappa, damping: [1 | B].  origin: [B, V, 3] or empty.
        friction: [1 | B], or [1 | B, n, n] of each two bodies and colliders.  body: [N], of the corner points.
    """
    inputs = (x.contiguous(), collider.contiguous(), kappa.contiguous(), friction, damping)
    return _friction_lag(*inputs, origin, body, *listed)[0]


def _run_lag(x: Tensor, collider: Tensor, kappa: Tensor, friction: Tensor | None, damping: Tensor | None,
             origin: Tensor, body: Tensor, *listed: Tensor) -> tuple[Tensor, ...]:  # fmt: skip
    state, force, bearer = ops.direct.contact_lag(x, origin, collider, kappa, *listed, body)
    none, pairs, active = torch.zeros_like(force), Pairs(*listed), state[:, 1] > 0
    coefficient = none if friction is None else coefficients(friction, pairs, body, len(x))
    rate = none if damping is None else _damping(force, kappa, damping, active, len(x), pairs)
    lag = torch.cat([torch.stack([force * coefficient, rate], 1), state[:, 2:]], 1)
    return lag, force, bearer, active, coefficient


def _damping(force: Tensor, kappa: Tensor, damping: Tensor, active: Tensor, scenes: int, listed: Pairs) -> Tensor:
    """Damping of pairs [pairs] by their normal force."""
    stiffness, own = (of_scene(ops.broadcast(t, (scenes,)), listed) for t in (kappa, damping))
    dhat = torch.where(active, listed.constants[:, 0], 1.0)  # rows that no pair fills hold anything
    return own * damped_fraction(force, stiffness, dhat)


def _reverse_lag(bars: Any, saved: Any, rest: tuple, needs: Any) -> list[Tensor | None]:
    x, collider, kappa, friction, damping, force, bearer, active, coefficient = saved
    bar, (origin, body, *listed), scenes = bars[0], rest, len(x)
    pairs, of_kappa, of_friction, of_damping = Pairs(*listed), 0.0, None, None
    by_force = coefficient * bar[:, 0]
    with torch.enable_grad():
        if needs[3]:
            given = friction.detach().requires_grad_()
            found = coefficients(given, pairs, body, scenes)
            (of_friction,) = torch.autograd.grad(found, given, force * bar[:, 0])
        if damping is not None:
            load, k, c = leaves = [t.detach().requires_grad_() for t in (force, kappa, damping)]
            rate = _damping(load, k, c, active, scenes, pairs)
            own, of_kappa, of_damping = torch.autograd.grad(rate, leaves, bar[:, 1])
            by_force = by_force + own
    # faces whose forces sum to less than nothing bear nothing
    own = torch.where(force > 0, by_force, 0.0)[bearer][:, None]
    points, kappa_bar = ops.direct.contact_lag_backward(
        torch.cat([own, torch.zeros_like(own), bar[:, 2:]], 1), x, origin, collider, kappa, *listed
    )
    of_kappa = ops.sum_to(kappa_bar, kappa.shape) + of_kappa
    return [points[:, : x.shape[1]], points[:, x.shape[1] :], of_kappa, of_friction, of_damping]


# Of the arguments of friction_lag(), the list's last.
_friction_lag = ops.Differentiable(
    _run_lag, _reverse_lag, arguments=11, inputs=5, saved=lambda inputs, made: (*inputs[:5], *made[1:]),
    rest=lambda inputs: inputs[5:],
)  # fmt: skip


def coefficients(friction: Tensor, listed: Pairs, body: Tensor, scenes: int) -> Tensor:
    """Friction coefficient of each pair [pairs]; arguments as of friction_lag()."""
    if friction.dim() == 1:
        return of_scene(ops.broadcast(friction, (scenes,)), listed)
    table = ops.broadcast(of_two(friction), (scenes, *friction.shape[1:]))
    rows = listed.pairs.clamp(min=0).long()
    first, second = (body.long()[rows[:, k]] for k in (0, 3))  # the last corner is of the second side
    return _entries(table, (rows[:, 5] * table.shape[1] + first) * table.shape[1] + second)


def of_two(friction: Tensor) -> Tensor:
    """Coefficients of two bodies [..., n, n], in either order."""
    return (friction + friction.mT) / 2


_entries = ops.Linear(lambda table, index: table.flatten()[index],
                      lambda bar, shape, index: sum_by(bar, index, math.prod(shape)).reshape(shape), 2)  # fmt: skip


# --- contact of a step at one state -----------------------------------------------------------------------------------


class ContactState(NamedTuple):
    """Forces at one state [N]; those of pairs on their corners [Q, 4, 3], those of planes on vertices [B, V, P, 3]."""

    points: Tensor  # [B, N, 3] corner points
    pairs: NearPairs
    barrier: Tensor
    lagged: NearPairs | None  # pairs of the start; None where there are none, or no start is known
    damping: Tensor
    friction: Tensor
    floor: Tensor  # barrier and damping of planes; on vertices that are not pinned
    floor_friction: Tensor

    def of_pairs(self) -> tuple[Tensor, Tensor]:
        """Normal and friction forces of pairs on corner points, both [B, N, 3]."""
        normal = self.pairs.summed(self.barrier, self.points)
        if self.lagged is None:
            return normal, torch.zeros_like(normal)
        return normal + self.lagged.summed(self.damping, self.points), self.lagged.summed(self.friction, self.points)

    def on_vertices(self) -> tuple[Tensor, Tensor]:
        """Normal and friction forces of everything on the vertices, both [B, V, 3]."""
        count = self.floor.shape[1]
        normal, friction = self.of_pairs()
        return normal[:, :count] + self.floor.sum(-2), friction[:, :count] + self.floor_friction.sum(-2)


class StepContact:
    """Contact of a step of a Model before anything moves.

    Args:
        data: The energies' data [1 | B, n].  parameters: Those of the energies, [1 | B, ...].
        colliders, before: Collider points at the end and at the start [B, Vc, 3].
        x_prev: Start of the step [B, V, 3], relative to ``origin`` where there is one; None: at rest in any state, so
            that there is neither damping nor friction.
        friction_eps: Motion from there below which friction is smoothed [m], as of the solve: where that is part of a
            step, this need not be its time step times the velocity of the friction.
    """

    def __init__(self, model: System, data: Tensor, parameters: dict[str, Tensor], colliders: Tensor, before: Tensor,
                 x_prev: Tensor | None, origin: Tensor | None, time_step: float, friction_eps: float
                 ) -> None:  # fmt: skip
        self.model, self.parameters, self.origin, self.h = model, parameters, origin, time_step
        self.colliders, self.x_prev = colliders, x_prev
        floor = model.floor
        self.planes = None if floor is None else data[:, : floor.count()].double()
        self.start = None if x_prev is None else corner_points(x_prev, origin, before)
        self.reach = friction_eps
        self.lag = None
        surface, barrier = model.surface_of_contact, model.contact
        if x_prev is not None and self.start is not None and surface is not None and barrier is not None:
            first = before + (colliders - before) / (barrier.detections or 1)
            near = near_pairs(x_prev, origin, before, first, surface, barrier)
            self.lag = lag_of(near, self.start, self._number("pair_kappa"), surface.body.long())

    def _number(self, name: str) -> Tensor:
        """A parameter [1 | B]; zero where its energy is absent."""
        value = parameter_of(self.model, self.parameters, name)
        return self.colliders.new_zeros((1,), dtype=torch.float64) if value is None else value.double()

    @cached_property
    def coefficients(self) -> Tensor:
        """Friction coefficient of each lagged pair [Q]."""
        surface, friction = self.model.surface_of_contact, self._number("friction")
        assert self.lag is not None and surface is not None
        pairs = self.lag.pairs
        if friction.dim() == 1:
            return pairs.of_scene(friction)
        a, b = (side.long() for side in pairs.sides(surface.body))
        return of_two(friction).expand(len(self.colliders), *friction.shape[1:])[pairs.scene, a, b]

    def at(self, x: Tensor) -> ContactState:
        """Forces at x [B, V, 3].

        Raises:
            ValueError: Where surfaces touch there, or positions are not finite.
        """
        points = corner_points(x, self.origin, self.colliders)
        pairs = self._near(x, points)
        pushes = barrier_forces(pairs, points, self._number("pair_kappa"))
        damping = friction = points.new_zeros((0, 4, 3))
        if self.lag is not None:
            damping, friction = lagged_forces(self.lag, points, self._number("pair_damping"),
                                              self.coefficients, self.h, self.reach)  # fmt: skip
        lagged = None if self.lag is None else self.lag.pairs
        return ContactState(points, pairs, pushes, lagged, damping, friction, *self._floor(points[:, : x.shape[1]]))

    def energy(self, x: Tensor) -> Tensor:
        """Energy of the barriers of each scene at x [B, V, 3] [J], [B]; raises as at()."""
        points = corner_points(x, self.origin, self.colliders)
        pairs = self._near(x, points)
        own = pair_energy(pairs, pairs.positions(points), self._number("pair_kappa"))
        total = points.new_zeros((len(x),)).index_add(0, pairs.scene, own)
        if self.model.floor is None or self.planes is None:
            return total
        gap, _, kappa, dhat = self.model.floor.gaps(points[:, : x.shape[1]], self.planes, None)
        return total + torch.where(self.model._pinned[:, None], 0.0, log_barrier(gap, kappa, dhat)[0]).sum((1, 2))

    def _near(self, x: Tensor, points: Tensor) -> NearPairs:
        surface, barrier = self.model.surface_of_contact, self.model.contact
        if surface is None or barrier is None:
            return _no_pairs(points)
        return near_pairs(x, self.origin, self.colliders, self.colliders, surface, barrier)

    def _floor(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Normal and friction forces of each plane on each vertex, both [B, V, P, 3]."""
        floor = self.model.floor
        if floor is None or self.planes is None:
            none = x.new_zeros((*x.shape[:2], 0, 3))
            return none, none
        start = x if self.start is None else self.start[:, : x.shape[1]]
        free = ~self.model._pinned[:, None, None]
        slope, normal = floor.slopes(x, start, self.planes, self.h, None)
        push = torch.where(free, -(slope / self.h**2)[..., None] * normal, 0.0)
        if self.start is None or self.model.friction is None:
            return push, torch.zeros_like(push)
        lagged, slip, factor = self._floor_slip(x)
        return push, torch.where(free, -(lagged * factor)[..., None] * slip, 0.0)

    def _floor_slip(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Largest friction of each plane on each vertex [B, V, P], slip [B, V, P, 3], and what their product takes."""
        floor, start = self.model.floor, self.start
        assert floor is not None and start is not None and self.planes is not None
        start = start[:, : x.shape[1]]
        force, normal = floor.normal_force(start, self.planes, None)
        lagged = floor_coefficients(self._number("friction"), self.model.body) * force
        travel = (x - start)[:, :, None]
        slip = travel - (travel * normal).sum(-1, keepdim=True) * normal
        return lagged, slip, smoothed(slip.movedim(-1, -2), self.reach)[1]

    def stiffness(self, forces: ContactState) -> Tensor:
        """Trace of the contact's part of each vertex's block [N/m], [B, V]; of planes their friction alone."""
        points, count = forces.points, forces.floor.shape[1]
        total = barrier_stiffness(forces.pairs, points, self._number("pair_kappa"))
        if self.lag is not None:
            total = total + lagged_stiffness(self.lag, points, self._number("pair_damping"),
                                             self.coefficients, self.h, self.reach)  # fmt: skip
        total = total[:, :count]
        if self.model.friction is not None and self.start is not None and self.planes is not None:
            lagged, _, factor = self._floor_slip(points[:, :count])
            total = total + 2 * (lagged * factor).sum(-1)
        return total


def floor_coefficients(friction: Tensor, body: Tensor) -> Tensor:
    """Friction coefficient of each vertex on a floor [1 | B, 1 | V, 1]; friction as of friction_lag(), body: [V]."""
    return friction[:, None, None] if friction.dim() == 1 else of_two(friction)[:, body, -1, None]


def _no_pairs(points: Tensor) -> NearPairs:
    whole, real = (points.new_zeros((0,), dtype=d) for d in (torch.int64, torch.float64))
    return NearPairs(whole.reshape(0, 4), whole, whole, real, real, real)


class ContactPotential(IncrementalPotential):
    """The incremental potential at x with pairs and friction. Its Hessian is that without them."""

    def __init__(self, model: System, x: Tensor, fields: ops.SweepFields, contact: StepContact,
                 averaged: Averaged | None = None) -> None:  # fmt: skip
        super().__init__(model, x, fields, contact.h, averaged)
        self.step_contact = contact

    @cached_property
    def contact(self) -> ContactState:
        return self.step_contact.at(self.x)

    def forces(self) -> Tensor:
        """h^2 dE/dx [kg m], [B, V, 3], pairs and friction included."""
        count = self.x.shape[1]
        normal, friction = self.contact.of_pairs()
        total = (normal + friction)[:, :count] + self.contact.floor_friction.sum(-2)
        return super().forces() - (self.h**2 * total).to(self.x.dtype)

    def stiffness(self) -> Tensor:
        return super().stiffness() + (self.h**2 * self.step_contact.stiffness(self.contact))[..., None].to(self.x.dtype)
