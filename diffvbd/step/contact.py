"""The executed step with contact: R substeps of detection, start, correction, sweeps and correction (docs/method.md,
sections 12 and 18)."""

from __future__ import annotations

import functools
import math
import weakref
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from .._common.constants import CONTACT
from .._common.context import MorePairs, checking, in_segment, is_captured, not_compiled, recorders
from .._contact.barrier import PairBarrier
from .._contact.detection import intersections
from .._contact.pair_forces import NearPairs, corner_points
from .._contact.surface import LEAST_CAPACITY, ContactSurface, units
from ..adjoint.contact import Pairs, floor_coefficients, friction_lag, no_pairs
from ..adjoint.potential import IncreaseInputs, increase_inputs, of_vertices
from ..model.inputs import parameter_of
from ..model.model import Model
from ..model.system import System
from ..ops import SweepSettings, broadcast
from ..ops.autograd import no_transforms
from ..ops.contact import Found, SubstepStart, contact_find, contact_near, start_substep, within
from ..ops.sweep import sweep
from ..reference.distance import distance
from .arguments import Prepared, collider_state
from .coarse import matrix_of
from .contact_coarse import Corrections
from .contact_rigid import bodies_of, corrected, is_blocked, touching
from .predict import Begun

MOST_CAPACITY = 2**26
FAR = 1e15  # [m] trust-region radius without pairs
LOST = ("x: positions became non-finite {}: check that v, forces and materials are in SI units, use a smaller "
        "time_step or softer materials, or look with diffvbd.testing.debug_checks()")  # fmt: skip


def may_read(x: Tensor) -> bool:
    """Whether values may decide sizes; on CUDA the host would wait."""
    return not x.is_cuda


class ContactStep:
    """Data that the substeps of one step share."""

    def __init__(self, model: System, begun: Begun, prepared: Prepared, before: Tensor, colliders: Tensor) -> None:
        begun = begun._replace(x_prev=begun.x_prev.contiguous(), y=begun.y.contiguous())
        self.model, self.begun, self.prepared = model, begun, prepared
        self.x_prev = begun.x_prev
        self.reads = may_read(begun.x_prev)
        # [B, Vc, 3] at the end and at the start of the step: one tensor if they rest
        self.before = before.contiguous()
        self.colliders = self.before if colliders is before else colliders.contiguous()
        self.fields = begun.fields(model, prepared)
        self.origin = begun.x_prev.new_empty((0,)) if begun.origin is None else begun.origin
        self.surface, self.barrier, self.bodies = model.surface_of_contact, model.contact, bodies_of(model)
        self.floor_data = None if model.floor is None else begun.data[:, : model.floor.count()].contiguous()
        self.none = begun.x_prev.new_empty((0,))
        self.planes = self.none if self.floor_data is None else self.floor_data.detach()
        self.capacity = self._capacity()
        unchecked = prepared.settings.sweeps == 0 or begun.law is not None
        if unchecked and self.reads:  # for what sweeps raise
            plain = prepared.settings._replace(energies=prepared.settings.energies & ~CONTACT, coarse=(), sweeps=0)
            with torch.no_grad():
                sweep(self.fields, model._packed_rest, model._plan, plain, tape_policy=0)
        self.substeps = (None if self.barrier is None else self.barrier.detections) or 1
        like = begun.x_prev
        self.kappa = like.new_zeros((1,)) if self.barrier is None else self._parameter("pair_kappa")
        self.lagged, self.lag = no_pairs(like, 0), like.new_zeros((0, 9))
        self.floor_lag = self._floor_lag()
        self.coarse_matrix = None
        if prepared.coarse is not None:
            h = prepared.settings.numbers.time_step
            self.coarse_matrix = matrix_of(model, prepared.coarse, self.x_prev, h, factored=False)

    def _parameter(self, name: str) -> Tensor:
        """A parameter of an energy that the Model has [1 | B]."""
        value = parameter_of(self.model, self.prepared.parameters, name)
        assert value is not None
        return value

    def _floor_lag(self) -> Tensor:
        """Friction coefficient times normal force of the floor's planes, and their normals, at the start."""
        floor, x = self.model.floor, self.begun.x_prev
        if floor is None or self.floor_data is None or self.model.friction is None:
            return x.new_zeros((0,))
        force, normal = floor.normal_force(x, of_vertices(self.floor_data, x), self.begun.origin)
        size = broadcast(floor_coefficients(self._parameter("friction"), self.model.body), force.shape) * force
        normal = broadcast(normal, (*size.shape, 3))
        return torch.cat([size[..., None], normal], -1)

    def _lag_friction(self, listed: Pairs) -> None:
        """Lags friction and damping of the pairs that push at the start of the step, where sweeps read them."""
        if self.model.friction is None and not self._damps:
            return
        assert self.surface is not None
        near = within(0.0, self.x_prev, self.origin, self.before, self.surface.pinned, listed)
        self.lagged = Pairs(*near[2:])
        friction = None if self.model.friction is None else self._parameter("friction")
        damping = self._parameter("pair_damping") if self._damps else None
        self.lag = friction_lag(self.begun.x_prev, self.before, self.kappa, friction, damping, self.origin,
                                self.surface.body, self.lagged)  # fmt: skip

    @property
    def _damps(self) -> bool:
        """Whether pairs damp motion."""
        barrier = self.barrier
        return barrier is not None and (barrier.damping > 0 or "pair_damping" in self.prepared.parameters)

    def gaps_before(self, listed: Pairs) -> Tensor:
        """Gaps of pairs at the start of the step [n] [m]. Those of planes in a detection are of its end."""
        if self.colliders is self.before:
            return listed.constants[:, -1]
        assert self.surface is not None
        near = within(torch.inf, self.x_prev, self.origin, self.before, self.surface.pinned, listed)
        gaps = near.constants.new_full((len(listed.pairs) + 1,), torch.inf)
        gaps[near.rows] = near.constants[:, -1]  # a row of -1 is the last
        return gaps[:-1]

    def run(self, policy: int, debug_step: int) -> Tensor:
        """Positions after all substeps [B, V, 3]; raises where a detection is not valid."""
        settings = self.prepared.settings
        barrier, surface = self.barrier, self.surface
        if barrier is None or surface is None:
            return self._run_on_floor(policy, debug_step)
        if checking():
            self._refuse_what_is_not_finite()
            refuse_intersections(self.model, self.x_prev, self.origin, self.before)
        pinned, pins = self.model._pinned[:, None], self.model.num_active < self.model.num_vertices
        x, y = self.x_prev, self.begun.y
        h2a = broadcast(self.begun.h2a, y.shape)
        h2a = torch.where(pinned, 0.0, h2a) if pins else h2a
        displacement, resting = self._wanted(h2a)
        remaining, records = displacement, Records()
        planned, r = self.substeps, 0
        going = None
        while r < self.substeps:
            was, now = self._colliders_at(r / planned), self._colliders_at((r + 1) / planned)
            # the whole displacement in the first substep; prescribed motion and truncated displacements go on later
            move = remaining
            if pins and planned > 1:
                move = torch.where(pinned, displacement / planned, remaining)
            detection = self.detect(x, was, now, move, h2a)
            sweeps = sweeps_of_substep(settings.sweeps, planned, r)
            records.found.append(detection)
            counts = detection.counts.tolist() if self.reads else []
            if self.reads:  # before any work
                self._check(r, counts, 0, records)
            if r == 0:
                self._lag_friction(detection.listed)
            start = start_substep(x, self._as_wholes(move), detection.u, detection.rigid, detection.trust_radius,
                                  detection.deformation_radius, self.planes, self.origin, was.detach(), now.detach(),
                                  surface.pinned, surface.body, surface.unit, detection.listed)  # fmt: skip
            records.infeasible.append(start.infeasible)
            if self.reads:
                self._check(r, counts, int(start.infeasible.sum()), records)
            begin = x
            x, first, _ = corrected(self, start.x, now, start, detection.listed)
            taken = [first]
            at, own_center = x.detach(), start.own_center
            if barrier.self_contact:
                own_center = own_center + (at - start.x.detach())
            left, kept, *near = contact_near(at, self.origin, now.detach(), start.center, own_center,
                                             start.trust_radius, start.own_radius, surface.pinned,
                                             detection.listed)  # fmt: skip
            swept_from = start._replace(center=at, trust_radius=left)
            limits, lengths, blocked, truncated = None, None, start.truncated, start.truncated
            if sweeps:
                own = settings._replace(sweeps=sweeps)
                swept = swept_substep(self, x, swept_from, now, Pairs(*near), own, policy, debug_step)
                records.swept.append(swept)
                x, limits, lengths, between = swept
                taken.extend(between)
                x, last, back = corrected(self, x, now, start, detection.listed)
                taken.append(last)
                # sweeps may have recovered what the start truncated, and corrections what sweeps did
                blocked = is_blocked(self, x, back)
                truncated = (limits[:, -1] > 0) | blocked
            if going is not None:  # other scenes stay as they are: the same bits in any batch
                records.swept[-1] = of_going(records.swept[-1], going)
                assert records.truncated is not None
                x, truncated = torch.where(going, x, begin), torch.where(going[..., 0], truncated, records.truncated)
                blocked = blocked & going[..., 0]
            records.truncated = truncated
            records.found[r] = detection._replace(fractions=start.fractions, truncated=start.truncated,
                                                  corrections=tuple(taken), limits=limits,
                                                  kept=kept if self.reads else None, lengths=lengths, sweeps=sweeps,
                                                  going=going, resting=resting)  # fmt: skip
            r += 1
            may_go_on = barrier.detections is None and settings.sweeps > 0 and not is_captured(x)
            if may_go_on and r == self.substeps < MOST_DETECTIONS:
                asked = blocked.any(-1) | (truncated.sum(-1) > TRUNCATED * self.model.num_moving)  # still truncated
                going = asked[:, None, None] if going is None else going & asked[:, None, None]
                self.substeps += int(going.any())
            if r < self.substeps:
                remaining = torch.where(start.truncated[..., None], y - x, 0.0)
        x = self._judged(x, records)
        for found in recorders():  # a step that runs again, with a larger capacity, counts once
            found.extend(records.found)
        return x

    @functools.cached_property
    def increase_inputs(self) -> IncreaseInputs:
        """Common data of the step's comparisons of potentials."""
        settings = self.prepared.settings
        return increase_inputs(self.model, self.fields, settings.numbers.time_step, self.prepared.averaged,
                               settings.energies)  # fmt: skip

    def _wanted(self, h2a: Tensor) -> tuple[Tensor, Tensor | None]:
        """Displacement that each vertex starts with, ``h v`` [B, V, 3] [m], and the vertices of partly pinned bodies
        that go without gravity's, bool [B, V]. The correction of a free body adds ``h2a`` = h^2 a. A partly pinned body
        adds it here unless its own potential would increase: elasticity bears a body at rest."""
        surface, displacement = self.surface, self.begun.y - self.x_prev - h2a
        if surface is None or surface.partly_pinned is None or self.model.starts_from != "predictor":
            return displacement, None
        resting = ~surface.partly_pinned.expand(displacement.shape[:2])
        if self.model.start == "auto":
            with torch.no_grad():
                at = (self.x_prev + displacement).contiguous()
                resting = resting | self.increase_inputs.increases_potential(at, at + h2a)
        return displacement + torch.where(resting[..., None], 0.0, h2a), resting

    def _as_wholes(self, move: Tensor) -> Tensor:
        """Displacements [B, V, 3] with which a substep starts: a rigid body shifts, and its correction turns it."""
        rigid = self.model.rigid_bodies
        return move if rigid is None else rigid.translation(self.fields.mass, move)

    def _run_on_floor(self, policy: int, debug_step: int) -> Tensor:
        """The step with friction on a floor and without pairs: only the floor limits motion."""
        x, none = self.x_prev, no_pairs(self.x_prev, math.prod(self.x_prev.shape[:2]))
        free, pinned, labels = self.bodies[2:]
        body = labels[: x.shape[1]].long()
        scenes, bodies = len(x), len(free)
        far, nowhere = x.new_full((scenes, bodies + 1), FAR), x.new_zeros((scenes, bodies, 3))
        move = self._as_wholes(self.begun.y - x - broadcast(self.begun.h2a, x.shape))
        start = start_substep(x, move, nowhere, self.none, far,
                              far, self.planes, self.origin, self.before, self.colliders, pinned, labels,
                              units(body, ~free), none)  # fmt: skip
        x = torch.where(free[body, None], start.x, self.begun.x_start)
        x = corrected(self, x, self.colliders, start, none).x
        if self.prepared.settings.sweeps:
            settings = self.prepared.settings
            swept = swept_substep(self, x, start, self.colliders, none, settings, policy, debug_step)
            x = corrected(self, swept.x, self.colliders, start, none).x
            record_substeps(self.model, x, [swept])
        return self._finite(x)

    def _colliders_at(self, fraction: float) -> Tensor:
        if self.colliders is self.before:
            return self.before
        return self.before + min(1.0, fraction) * (self.colliders - self.before)

    def _sweep(self, x: Tensor, center: Tensor, trust_radius: Tensor, collider: Tensor, listed: Pairs,
               settings: SweepSettings, policy: int, debug_step: int) -> tuple[Tensor, Tensor]:  # fmt: skip
        lagged, model = self.lagged, self.model
        if self.begun.renews and settings.sweeps > 1:  # each with the bounds about its own start
            numbers, limits = settings.numbers, []
            within = settings._replace(numbers=numbers._replace(last_relaxation=numbers.relaxation))
            for n in range(settings.sweeps):
                one = (settings if n + 1 == settings.sweeps else within)._replace(sweeps=1)
                x, limit = self._sweep(x, center, trust_radius, collider, listed, one, policy, debug_step)
                limits.append(limit)
            return x, torch.cat(limits, 1)
        fields = self.fields._replace(**{"energy_data": self.begun.data, **self.begun.renewed(x)}, x_start=x,
                          center=center, trust_radius=trust_radius, collider=collider, collider_prev=self.before,
                          kappa=self.kappa, **listed._asdict(), lag=self.lag, lag_pairs=lagged.pairs,
                          lag_ptr=lagged.ptr, lag_entry=lagged.entry, floor_lag=self.floor_lag)  # fmt: skip
        return sweep(fields, model._packed_rest, model._plan, settings, tape_policy=policy, debug_step=debug_step,
                     checked=self.begun.law is None)[:2]  # fmt: skip

    def detect(self, x: Tensor, was: Tensor, now: Tensor, move: Tensor, gravity_move: Tensor) -> Detection:
        """Pairs that can matter for displacements from x [B, V, 3] [m]."""
        surface, barrier = self.surface, self.barrier
        assert surface is not None and barrier is not None
        found = find(surface, barrier, x, self.origin, self.fields.mass, move, gravity_move, was, now, self.planes,
                     self.capacity)  # fmt: skip
        rigid = found.rigid if barrier.self_contact else self.none
        return Detection(Pairs(*found[:4]), *found[4:8], rigid, found.u, found.trust_radius, found.deformation_radius)

    def _record(self, records: Records) -> Outcome:
        """Records the outcome of the step."""
        outcomes[self.model.model] = outcome = records.outcome(self.capacity, self.x_prev)
        return outcome

    def _judged(self, x: Tensor, records: Records) -> Tensor:
        """x; NaN in the scenes in which a captured step, which cannot raise, is not valid."""
        outcome = self._record(records)
        record_substeps(self.model, x, records.swept)
        if is_captured(x):
            fits = outcome.counts[:, 0] <= self.capacity  # a list that is not complete lacks pairs of any scene
            good = fits[:, None] & (outcome.smallest > 0) & (outcome.infeasible == 0)
            return torch.where(good.all(0)[:, None, None], x, torch.nan)
        if x.is_cuda:
            infeasible = outcome.infeasible.sum(1, keepdim=True)
            for r, (*row, count) in enumerate(torch.cat([outcome.counts, infeasible], 1).tolist()):
                self._check(r, row, count, records)
        return self._finite(x)

    def _finite(self, x: Tensor) -> Tensor:
        """x; raises where it is not finite, if it may be read."""
        if self.reads and not bool(torch.isfinite(x).all()):
            self._refuse_what_is_not_finite()
            raise RuntimeError(LOST.format("in the step"))
        return x

    def _capacity(self) -> int:
        """Pairs of all scenes that fit in a list."""
        surface, barrier, scenes = self.surface, self.barrier, self.x_prev.shape[0]
        if surface is None or barrier is None:
            return 0
        if barrier.capacity is None and self.reads:
            return MOST_CAPACITY  # the list is as long as it must be
        return max(surface.capacity * scenes, LEAST_CAPACITY if scenes and barrier.capacity is None else 0)

    def _check(self, r: int, counts: list[int], infeasible: int, records: Records) -> None:
        """Raises where a detection found more pairs than fit, surfaces that touch, or infeasible prescribed motion."""
        surface = self.surface
        assert surface is not None and self.barrier is not None
        needed, touching, pair = counts
        if needed > self.capacity or touching or infeasible:
            self._record(records)  # the status of a step that raises says why
        scenes = self.x_prev.shape[0]
        if needed > self.capacity:
            raise TooManyPairs(
                -(-needed // scenes),
                f"capacity: {needed} pairs in substep {r} of the step do not fit {self.capacity} "
                f"({-(-self.capacity // scenes)} per scene): "
                f"use diffvbd.contact.reserve(model, {2 * -(-needed // scenes)})",
            )
        if touching:
            self._refuse_what_is_not_finite()
            if pair < 0:
                raise RuntimeError(LOST.format(f"before substep {r} of the step"))
            scene, corners = surface.corners_of(pair)
            vertices = self.x_prev.shape[1]
            named = "x or colliders" if any(corner >= vertices for corner in corners) else "x"
            owners = surface.owners_of(corners[0], corners[3])
            raise ValueError(
                f"{named}: expected surfaces that do not touch, got {touching} pairs without a gap "
                + (f"in substep {r} of the step" if r else "at the start of the step")
                + f", one of the corner points {corners} of {owners} in scene {scene}: "
                + advice_to_part(self.x_prev, self.origin, self.barrier.dhat)
            )
        if infeasible:
            listed = records.found[r].listed
            raise ValueError(
                f"prescribed or colliders: expected feasible motion, got {infeasible} pairs in substep "
                f"{r} of {self.substeps} that it would bring too close, {self._most_closed(listed, needed)}: move it "
                f"by less than dhat, {self.barrier.dhat:.3g} m, in a step where it meets what is free to move: take a "
                "smaller time_step, or spread the motion over more steps (per_step)"
            )

    def _most_closed(self, listed: Pairs, count: int) -> str:
        """For a message: the pair that what is prescribed would close most, and how far that goes in the step."""
        surface, pinned = self.surface, self.model._pinned[:, None]
        assert surface is not None
        with torch.no_grad():
            origin = self.origin if self.origin.numel() else None
            start = corner_points(self.x_prev, origin, self.before)
            end = corner_points(torch.where(pinned, self.begun.y, self.x_prev), origin, self.colliders)
            near = NearPairs.of(listed.pairs[:count], listed.constants[:count])
            k = int((distance(near.kind, near.positions(end)) - near.offset).argmin())
            way = (end - start).norm(dim=-1)[near.scene[k], near.corners[k]].max()
            owners = surface.owners_of(*near.corners[k, [0, 3]].tolist())
            return f"first {owners} in scene {int(near.scene[k])}, by a motion of {float(way):.3g} m"

    def _refuse_what_is_not_finite(self) -> None:
        """Refusal of values that are not finite; arguments.named finds the argument."""
        given = (self.x_prev, self.begun.y, self.colliders, self.before)
        if not all(bool(torch.isfinite(t).all()) for t in given):
            raise ValueError("start (x, v, force, gravity, prescribed, colliders): expected finite values")


@not_compiled  # sizes, checks and lists depend on values, and torch 2.11 compiled wrong gradients
def run_contact(model: System, begun: Begun, prepared: Prepared, before: Tensor, colliders: Tensor, policy: int,
                debug_step: int) -> Tensor:  # fmt: skip
    """Positions after the sweeps of a step with contact.

    Args:
        before, colliders: Where the colliders are at its start and at its end, [B, Vc, 3] [m]; one tensor if they rest.
    """
    if torch._C._functorch.peek_interpreter_stack() is not None:  # pyright: ignore[reportAttributeAccessIssue]
        no_transforms()
    while True:
        try:
            return ContactStep(model, begun, prepared, before, colliders).run(policy, debug_step)
        except TooManyPairs as error:
            barrier, surface = model.contact, model.surface_of_contact
            if barrier is None or surface is None or barrier.capacity is not None or 2 * error.needed > MOST_CAPACITY:
                raise
            # without a given capacity: again, with a larger one
            model.model.surface_of_contact = replace(surface, capacity=2 * error.needed)
            if in_segment():  # which begins again
                raise MorePairs from None


# --- the sweeps of a part of a step with pairs or friction, in cycles, with the coarse correcti -----------------------

MOST_DETECTIONS = 8  # of a step without a given number: one, and more while pairs truncate motion
TRUNCATED = 0.01  # fraction of vertices, besides blocked bodies, above which a step goes on and a rollout warns


class SweptSubstep(NamedTuple):
    """Result of the sweeps of a substep."""

    x: Tensor  # [B, V, 3]
    limits: Tensor  # uint8 [B, K, V]
    lengths: Tensor | None = None  # of coarse corrections [corrections, B, bodies of the coarse space]
    taken: Sequence[Tensor] = ()  # by the rigid corrections between sweeps, [B, bodies, 2] each


def sweeps_of_substeps(sweeps: int, substeps: int) -> list[int]:
    """Numbers of sweeps of R substeps: K spread evenly, the first ones taking the remainder."""
    return [sweeps // substeps + (1 if r < sweeps % substeps else 0) for r in range(substeps)]


def sweeps_of_substep(sweeps: int, planned: int, substep: int) -> int:
    """Number of sweeps of one substep. One beyond the planned ones has as many as the last of these, at least one."""
    shared = sweeps_of_substeps(sweeps, planned)
    return shared[substep] if substep < planned else max(shared[-1], min(sweeps, 1))


def swept_substep(of: ContactStep, x: Tensor, start: SubstepStart, collider: Tensor, listed: Pairs,
                  settings: SweepSettings, policy: int, debug_step: int) -> SweptSubstep:  # fmt: skip
    """Result of the sweeps of a substep from x, in the trust regions of its start."""

    def sweep(x: Tensor, settings: SweepSettings) -> tuple[Tensor, Tensor]:
        return of._sweep(x, start.center, start.trust_radius, collider, listed, settings, policy, debug_step)

    settings = settings._replace(coarse=())  # the operator would correct without pairs
    cycles = _cycles(of.model, settings.sweeps)
    if len(cycles) <= 1:
        return SweptSubstep(*sweep(x, settings))
    corrections, matrix = None, of.coarse_matrix
    numbers = settings.numbers
    within = settings._replace(numbers=numbers._replace(last_relaxation=numbers.relaxation))
    limits, lengths, taken = [], [], []
    for n, (corrects, count) in enumerate(cycles):
        ends = n + 1 == len(cycles)
        if of.model.rigid_bodies is not None and n:
            # Where friction reverses, its exact derivative makes a motion too long, and most of it is refused.
            x, own, _ = corrected(of, x, collider, start, listed, majorizes=True)
            taken.append(own)
        if matrix is not None and corrects:
            if corrections is None or of.begun.renews:
                fields = touching(of, x, collider, start, listed)
                own = of.fields if of.begun.law is None else of.fields._replace(**of.begun.renewed(x))
                corrections = Corrections(of.model, own, fields, matrix, settings)
            x, length = corrections.correct(x)
            lengths.append(length)
        x, limit = sweep(x, (settings if ends else within)._replace(sweeps=count))
        limits.append(limit)
    return SweptSubstep(x, torch.cat(limits, 1), torch.stack(lengths) if lengths else None, taken)


def _cycles(model: System, sweeps: int) -> list[tuple[bool, int]]:
    """The cycles of a substep: whether a coarse correction begins it, and how many sweeps follow. With rigid bodies,
    which are corrected between any two sweeps, each has one."""
    counts = [sweeps]
    if model.coarse is not None and model.coarse_geometry.bodies:  # the first sweep stands alone
        every, after = model.coarse.every, sweeps - 1
        counts = [1, *(min(every, after - begun) for begun in range(0, after, every))]
    cycles = [(n > 0, count) for n, count in enumerate(counts)]
    if model.rigid_bodies is None:
        return cycles
    return [(begins and k == 0, 1) for begins, count in cycles for k in range(count)]


def of_going(substep: SweptSubstep, going: Tensor) -> SweptSubstep:
    """Result of a substep in the scenes that go on, bool [B, 1, 1]; in others it is discarded."""
    lengths = substep.lengths
    return substep if lengths is None else substep._replace(lengths=torch.where(going[:, 0], lengths, 0.0))


def record_substeps(model: System, x: Tensor, substeps: Sequence[SweptSubstep]) -> None:
    """For record("subspace"): lengths of the coarse corrections of a step that ends at x."""
    if model.coarse is not None:
        for found in recorders("subspace"):
            lengths = [substep.lengths for substep in substeps if substep.lengths is not None]
            empty = x.new_empty((0, len(x), model.coarse_geometry.bodies))
            found.append(torch.cat([empty, *lengths]).movedim(0, 1))


# --- records of a step with contact -----------------------------------------------------------------------------------


class Detection(NamedTuple):
    """One detection, and the decisions of its substep. Index data; the step computes differentiable values again. N
    corner points: vertices, then those of colliders.

    Attributes:
        listed: Pairs that may matter: ``pairs`` [capacity, 6], four corner points, kind (0 point and triangle, 1 two
            edges, 2 point and plane) and scene, or -1; ``constants`` [capacity, 8]; pairs by corner point in ``ptr``
            [B N + 1] and ``entry`` [4 capacity].
        near_corners: Corner points and kind of the nearest pair of each corner point, int [B, N, 5]; -1: none.
        near_values: Its weights, normal and gap [m], [B, N, 8].
        counts: int64 [3]: pairs that the list needs, pairs that touch, key of one of those or -1.
        smallest: Smallest gap of each scene, at most 0 where pairs touch, or the search distance [m], [B].
        rigid: Rigid motion of each body, a displacement [B, V, 3] [m]; empty where bodies have no pairs of their own.
        u: Translation of each body's island, rounded to a grid [B, bodies, 3] [m].
        trust_radius: Trust-region radius of each body relative to its island, and the largest [m], [B, bodies + 1].
        deformation_radius: The same relative to the body's rigid motion [m].
        fractions: Step fraction of each vertex at the start [B, V].
        truncated: Vertices that pairs or radii have truncated at the start, bool [B, V].
        corrections: Of the rigid corrections before, between and after the sweeps, [B, bodies, 2] each: step fraction,
            and a number of the island whose common shift it took whole, or -1.
        limits: Number of halvings of each update, uint8 [B, K, V]; 8: it was not made.
        lengths: Of the coarse corrections, [corrections, B, bodies of the coarse space]; None: there are none.
        kept: Rows of the listed pairs that sweeps can reach; None where the host must not read them, as on CUDA.
        sweeps: Number of sweeps of the substep.
        going: Scenes that go on in a further substep, bool [B, 1, 1]; None: all.
        resting: Vertices of partly pinned bodies that begin without their gravity move, bool [B, V]; None: none.
    """

    listed: Pairs
    near_corners: Tensor
    near_values: Tensor
    counts: Tensor
    smallest: Tensor
    rigid: Tensor
    u: Tensor
    trust_radius: Tensor
    deformation_radius: Tensor
    # decisions of the substep
    fractions: Tensor | None = None
    truncated: Tensor | None = None
    corrections: tuple[Tensor, ...] | None = None
    limits: Tensor | None = None
    lengths: Tensor | None = None
    kept: Tensor | None = None
    sweeps: int = 0
    going: Tensor | None = None
    resting: Tensor | None = None


class Outcome(NamedTuple):
    """Record of the latest step of a Model, on its device; read by diffvbd.contact.status."""

    counts: Tensor  # [R, 3] int64: pairs needed, touching pairs, key of one or -1
    infeasible: Tensor  # [R, B] int64: pairs that hinder what is prescribed; a step that has raised may lack rows
    capacity: int  # pairs of all scenes
    truncated: Tensor  # [B, V] bool: limited in the last sweep or, without sweeps, at the start
    smallest: Tensor  # [R, B] [m]


class TooManyPairs(RuntimeError):
    """More pairs than fit; ``needed`` per scene."""

    def __init__(self, needed: int, message: str) -> None:
        super().__init__(message)
        self.needed = needed


class Records:
    """Records of the substeps, one after another."""

    def __init__(self) -> None:
        self.found: list[Detection] = []
        self.infeasible: list[Tensor] = []
        self.swept: list[SweptSubstep] = []
        self.truncated: Tensor | None = None  # until the first substep ends

    def outcome(self, capacity: int, x: Tensor) -> Outcome:
        """capacity: Pairs of all scenes that fit.  x: [B, V, 3] at the start of the step."""
        counts, smallest = _stack([d.counts for d in self.found]), _stack([d.smallest for d in self.found])
        infeasible = _stack(self.infeasible) if self.infeasible else torch.zeros_like(smallest, dtype=torch.int64)
        truncated = torch.zeros_like(x[..., 0], dtype=torch.bool) if self.truncated is None else self.truncated
        return Outcome(counts, infeasible, capacity, truncated, smallest)


def _stack(rows: list[Tensor]) -> Tensor:
    return rows[0][None] if len(rows) == 1 else torch.stack(rows)  # one is not copied: on CUDA that is a launch


outcomes: weakref.WeakKeyDictionary[Model, Outcome] = weakref.WeakKeyDictionary()


# --- a state whose surfaces intersect is an error ---------------------------------------------------------------------


def check_start(model: System, x: Tensor, colliders: Any, colliders_before: Tensor | None, moving: bool) -> None:
    """Raises where the surfaces of a rollout's initial state intersect; waits for the device. Nothing happens without a
    PairBarrier, under torch.compile, and while a CUDA graph is captured.

    Args:
        x: [..., V, 3] [m].  colliders, colliders_before: As given to the rollout.
        moving: Whether ``colliders`` change from step to step, so that the first of them are not the start.
    """
    if model.surface_of_contact is None or x.numel() == 0 or torch.compiler.is_compiling():
        return
    if torch._C._functorch.peek_interpreter_stack() is not None:  # pyright: ignore[reportAttributeAccessIssue]
        return  # the step says that there are no transforms of it
    if is_captured(x):
        return
    where = collider_state(model, x, None if moving else colliders, colliders_before)
    if where is not None:
        refuse_intersections(model, x.reshape(-1, *x.shape[-2:]), x.new_empty((0,)), where[0],
                             "; checks=dv.Checks(start=False) starts all the same")  # fmt: skip


def advice_to_part(x: Tensor, origin: Tensor, dhat: float) -> str:
    """Advice about surfaces that touch. x: [B, V, 3] [m], relative to origin [B, V, 3] or empty."""
    far = max(float(t.abs().max()) for t in (x, origin) if t.numel())
    rounded = far * torch.finfo(x.dtype).eps
    if rounded > dhat / 2:
        return (f"positions of up to {far:.3g} m are rounded by {rounded:.3g} m as {x.dtype}, dhat is {dhat:g} m: "
                "give x in metres, near the origin")  # fmt: skip
    return f"move them apart, best by about dhat, {dhat:g} m"


def refuse_intersections(model: System, x: Tensor, origin: Tensor, colliders: Tensor, otherwise: str = "") -> None:
    """Raises where an edge of the surfaces passes through a triangle, or a point lies behind a plane.

    Args:
        x: [B, V, 3] [m], relative to origin [B, V, 3] or empty.  colliders: [B, Vc, 3] [m].
        otherwise: What else the message advises.

    Raises:
        ValueError: It names the first crossing of the first scene that has one.
    """
    surface, barrier = model.surface_of_contact, model.contact
    assert surface is not None and barrier is not None
    found = intersections(x, origin, colliders, surface, barrier.self_contact, barrier.between_bodies)
    counts = found.counts.tolist()
    for scene, (crossings, behind) in enumerate(counts):
        if crossings == behind == 0:
            continue
        (edge, triangle), (point, plane) = found.first[scene].tolist()
        if crossings:
            ends, corners = surface.edges[edge].tolist(), surface.triangles[triangle].tolist()
            what = f"the edge of corner points {ends} passes through the triangle {corners}"
        else:
            ends, corners = [int(surface.points[point])], surface.planes[plane].tolist()
            what = f"corner point {ends[0]} lies behind the plane {corners}"
        of_bodies = all(corner < model.num_vertices for corner in ends + corners)
        total, below = (sum(row[k] for row in counts) for k in (0, 1))
        got = [f"{total} edges through triangles"] * bool(total) + [f"{below} points behind planes"] * bool(below)
        raise ValueError(
            f"{'x' if of_bodies else 'x or colliders'}: expected surfaces that do not intersect, got "
            f"{' and '.join(got)}: {what} in scene {scene}, of "
            f"{surface.owners_of(ends[0], corners[0])}. Contact keeps apart what is apart and cannot undo this: "
            f"move the bodies apart (diffvbd.contact.intersections lists what crosses){otherwise}"
        )


# --- trust regions ----------------------------------------------------------------------------------------------------

RADIUS_FACTOR = 1.5  # trust-region radius over the longest wanted displacement of the body
LEAST_RADIUS = 1.0  # of dhat, added to it: a compressed barrier may push so far


def find(surface: ContactSurface, barrier: PairBarrier, x: Tensor, origin: Tensor, mass: Tensor, move: Tensor,
         gravity_move: Tensor, was: Tensor, now: Tensor, floor: Tensor, capacity: int) -> Found:  # fmt: skip
    """Pairs that can matter in a substep, and trust-region radii until they are found again. Index data.

    Args:
        x, origin: As the sweeps take them.  mass: [1 | B, V] [kg].
        move, gravity_move: Wanted displacements [B, V, 3] [m], and h^2 a, which corrections and sweeps add.
        was, now: Collider points [B, Vc, 3] [m].  floor: Data of the FloorBarrier, or empty.
        capacity: Pairs of all scenes that fit.
    """
    x, move, gravity_move = x.detach().contiguous(), move.detach().contiguous(), gravity_move.detach().contiguous()
    return contact_find(x, origin, was.detach(), now.detach(), mass.detach().contiguous(), move, gravity_move, floor,
                        surface.searched, surface.of_bodies, barrier.self_contact, barrier.between_bodies, barrier.dhat,
                        RADIUS_FACTOR, LEAST_RADIUS * barrier.dhat, capacity,
                        not torch.compiler.is_compiling())  # fmt: skip
