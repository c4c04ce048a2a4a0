"""The executed step with contact: R times detection, start, correction, sweeps and correction (docs/method.md, sections
12 and 18)."""

from __future__ import annotations

import functools
import math
import weakref
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from .. import ops
from .._common.constants import CONTACT
from .._common.context import MorePairs, checking, in_segment, is_captured, not_compiled, recorders, replaced
from .._contact import detection as search
from .._contact.barrier import PairBarrier
from .._contact.detection import intersections
from .._contact.start import PartStart, above_floor, start_between_planes
from .._contact.surface import LEAST_CAPACITY, ContactSurface
from ..adjoint.contact import Pairs, no_pairs, rubbing, some_of
from ..adjoint.potential import RiseParts, of_vertices, rise_parts
from ..model.inputs import parameter_of
from ..model.material import inside_out
from ..model.model import Model
from ..model.system import System
from ..ops import SweepSettings, broadcast
from ..ops import contact as ops_contact
from ..ops import contact as ops_start
from ..ops.autograd import no_transforms
from ..ops.contact import RoomsOfBodies, contact_rooms, lift_left, sweep_rooms
from ..ops.fields import WAYS
from ..ops.sweep import sweep
from .arguments import Prepared, collider_state
from .coarse import matrix_of
from .contact_corrections import Corrections, Scenes, Trials, bodies_of, corrected, corrected_after, is_cut, touching
from .predict import Begun

FREE = 1e15  # [m] room that nothing fills
CLOSE = 1e-3  # of dhat: pairs whose gap is so much wider do not push, however it is rounded
MOST_CAPACITY = 2**26
LOST = ("x: positions became non-finite {}: check that v, forces and materials are in SI units, use a smaller "
        "time_step or softer materials, or look with diffvbd.testing.debug_checks()")  # fmt: skip


class ContactStep:
    """Data that the substeps of one step share."""

    def __init__(self, model: System, begun: Begun, prepared: Prepared, before: Tensor, colliders: Tensor) -> None:
        begun = replaced(begun, x_prev=begun.x_prev.contiguous(), y=begun.y.contiguous())
        self.model, self.begun, self.prepared = model, begun, prepared
        self.x_prev = begun.x_prev
        # [B, Vc, 3] at the end and at the start of the step: one tensor if they rest
        self.before = before.contiguous()
        self.colliders = self.before if colliders is before else colliders.contiguous()
        self.fields = begun.fields(model, prepared)
        self.origin = begun.x_prev.new_empty((0,)) if begun.origin is None else begun.origin
        self.surface, self.barrier = model.surface_of_contact, model.contact
        self.floor_data = None if model.floor is None else begun.data[:, : model.floor.count()].contiguous()
        if prepared.settings.sweeps == 0 and self._reads(self.x_prev):  # for what sweeps raise
            plain = replaced(prepared.settings, energies=prepared.settings.energies & ~CONTACT, coarse=())
            with torch.no_grad():
                sweep(self.fields, model._packed_rest, model._plan, plain, tape_policy=0)
        floor = model.floor
        oblique = floor is not None and bool((np.count_nonzero(floor.normal, axis=-1) > 1).any())
        self.any_direction = oblique or "floor_normal" in prepared.parameters
        self.parts: int | None = None if self.barrier is None else self.barrier.detections  # None: not decided yet
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
        size = broadcast(self._parameter("friction")[:, None, None], force.shape) * force
        normal = broadcast(normal, (*size.shape, 3))
        return torch.cat([size[..., None], normal], -1)

    def _rub(self, listed: Pairs, collider: Tensor) -> Tensor:
        """Notes friction and damping of the pairs at the start of the step, where there are any; returns the forces of
        pairs on corner points [B, N, 3] [N]."""
        none = self.kappa.new_empty
        friction = self._parameter("friction") if self.model.friction is not None else none((0,))
        damping = self._parameter("pair_damping") if self._damps else none((0,))
        lag, push = rubbing(self.begun.x_prev, collider, self.kappa, friction, damping, self.origin, listed)
        if self._rubs:
            self.lagged, self.lag = listed, lag
        return push

    @property
    def _damps(self) -> bool:
        """Whether pairs damp motion."""
        barrier = self.barrier
        return barrier is not None and (barrier.damping > 0 or "pair_damping" in self.prepared.parameters)

    @property
    def _rubs(self) -> bool:
        """Whether sweeps need what pairs were at the start of the step."""
        return self.model.friction is not None or self._damps

    @staticmethod
    def _reads(x: Tensor) -> bool:
        """Whether values may decide sizes: on CUDA that would wait."""
        return not x.is_cuda

    def gaps_before(self, listed: Pairs) -> Tensor:
        """Gaps of pairs at the start of the step [n] [m]."""
        if self.colliders is self.before:
            return listed.constants[:, -1]
        return ops_start.gaps(self.x_prev, self.origin, self.before, *listed[:3])

    def _pushing(self, listed: Pairs) -> Pairs:
        """The pairs that may push at the start: the same of a scene in any batch. On CUDA they are found if sweeps go
        through them, too."""
        if not (self._rubs or self._reads(self.x_prev)):
            return listed
        gap = self.gaps_before(listed)
        return some_of(listed, (gap < (1 + CLOSE) * listed.constants[:, 0]).contiguous())[0]

    def _narrowed(self, listed: Pairs, x: Tensor, collider: Tensor, room: Tensor) -> tuple[Pairs, Tensor | None]:
        """The pairs that can matter as long as no vertex goes farther than its room [B, V] from x, with their gaps
        there; and which of the listed these are, where that may be read."""
        with torch.no_grad():
            constants = ops_start.narrow(x.detach().contiguous(), self.origin, collider.detach().contiguous(), room,
                                         listed.pairs, listed.constants, listed.ptr)  # fmt: skip
        near, rows = some_of(replaced(listed, constants=constants), (constants[:, -1] < torch.inf).contiguous())
        return near, rows if self._reads(x) else None

    def run(self, policy: int, debug_step: int) -> Tensor:
        """Positions after all parts [B, V, 3]; raises where detection did not hold."""
        settings = self.prepared.settings
        barrier, surface = self.barrier, self.surface
        if barrier is None or surface is None:
            return self._run_on_floor(policy, debug_step)
        if checking():
            self._refuse_what_is_not_finite()
            refuse_intersections(self.model, self.x_prev, self.origin, self.before)
        pinned, pins = self.model._pinned[:, None], self.model.num_active < self.model.num_vertices
        lift = broadcast(self.begun.lift, self.begun.y.shape)
        lift = torch.where(pinned, 0.0, lift) if pins else lift
        x = self.x_prev
        bodies = surface.held, surface.held_bodies, surface.body_order, surface.body_ptr
        way = self.prepared.ways(functools.partial(coasting, x, self.fields.mass, self.begun.y - x - lift, *bodies))
        left, met = way, Met()
        stages, r = self.parts or 1, 0  # of what is prescribed
        planned, going = self.parts, None
        while r < (self.parts or 1):
            was, now = (self._colliders_at(min(1.0, n / stages)) for n in (r, r + 1))
            # all of the way in the first part; what is prescribed, and what pairs have held up, goes on in the others
            move = torch.where(pinned, way / stages, left) if pins and stages > 1 else left
            fall = lift if r == 0 else torch.zeros_like(lift)
            motion = motion_of(surface, x, self.origin, self.fields.mass, move, fall)
            within = self._rooms(x, was, now, motion)
            if planned is None:
                self.parts = planned = 1 if is_captured(x) else parts_of(within.over)
            assert self.parts is not None
            detection = self._detect(x, was, now, within)
            sweeps = sweeps_of_part(settings.sweeps, planned, r)
            met.found.append(detection)
            met.counts.append(detection.counts)
            if self._reads(x):  # before any work
                self._check(r, met.counts[r].tolist(), met)
            if r == 0:
                pushing = self._pushing(detection.listed)
                push = self._rub(pushing, was)
                fall = lift = unsupported(self.model, x, self.origin, push, self.fields.mass, lift, self.floor_data,
                                          settings.numbers.time_step)  # fmt: skip
            falls, resting = r == 0 and self.model.starts_from == "predictor", None
            if falls and pins and self.model.start == "auto":
                resting = rests(self.model, (self.x_prev + way).detach(), lift.detach(), self._raises)
            if resting is not None:
                fall = lift = torch.where(resting[..., None], 0.0, lift)
            fall = fall if falls else torch.zeros_like(fall)  # corrections do it
            start = start_between_planes(x, move, fall, self.fields.mass, was, now, self.floor_data, self.origin,
                                         detection, surface, motion.rigid, ROOM * motion.stretched, self._raises,
                                         barrier.self_contact, falls)  # fmt: skip
            met.counts[r] = torch.cat([detection.counts[:3], start.stuck])
            if self._reads(x):
                self._check(r, met.counts[r].tolist(), met)
            begin = x
            x, taken, _ = corrected(self, start.x, now, start, detection.listed)
            if start.own:
                start = replaced(start, own=(start.own[0] + (x - start.x).detach(), start.own[1]))
            room = rooms_of_sweeps(motion, surface, barrier, start, x, begin)
            near, kept = self._narrowed(detection.listed, x, now, room)
            swept_from = replaced(start, center=x.detach(), room=room)
            limits, lengths, held, cut = None, None, start.short, start.short
            if sweeps:
                part = replaced(settings, sweeps=sweeps)
                swept = swept_part(self, x, swept_from, now, near, part, policy, debug_step)
                met.swept.append(swept)
                x, limits, lengths = swept
                x, shares, back = corrected_after(self, x, now, start, detection.listed, r + 1 == self.parts)
                taken.extend(shares)
                # what the start has held up, sweeps may have made good, and corrections, what these have
                held = is_cut(self, x, back)
                cut = (limits[:, -1] > 0) | held
            if going is not None:  # what it does not help stays as it is; others, too: the same bits in any batch
                going = going & ~self._inverted(x)[:, None, None]
                met.swept[-1] = of_going(met.swept[-1], going)
                assert met.cut is not None
                x, cut = torch.where(going, x, begin), torch.where(going[..., 0], cut, met.cut)
                held = held & going[..., 0]
            met.cut = cut
            met.found[r] = replaced(detection, shares=start.shares, corrections=tuple(taken), limits=limits,
                                    kept=kept, frames=start.frames, lengths=lengths, sweeps=sweeps, going=going,
                                    resting=resting)  # fmt: skip
            r += 1
            may_go_on = barrier.detections is None and settings.sweeps > 0 and not is_captured(x)
            if may_go_on and r == self.parts < MOST_DETECTIONS:
                asked = held.any(-1) | (cut.sum(-1) > CUT * self.model.num_active)  # pairs still hold up some
                asked = asked & ~self._inverted(x)  # through what is inside out another body might pass
                going = asked[:, None, None] if going is None else going & asked[:, None, None]
                self.parts += int(going.any())
            if r < self.parts:
                left = torch.where(start.short[..., None], self.x_prev + way + lift - x, 0.0)
        x = self._judged(x, met)
        for found in recorders():  # a step that is done again, with room for more pairs, counts once
            found.extend(met.found)
        return x

    @functools.cached_property
    def potential_parts(self) -> RiseParts:
        """Common data of the step's comparisons of potentials."""
        return rise_parts(self.model, self.fields, self.prepared.settings.numbers.time_step)

    def _inverted(self, x: Tensor) -> Tensor:
        """Scenes with an inverted tet, bool [B]."""
        return inside_out(self.model.tets, x if self.begun.origin is None else x.detach() + self.origin).any(-1)

    def _raises(self, x: Tensor, to: Tensor) -> Tensor:
        """Vertices of bodies whose own potential is higher at ``to`` than at x [B, V], bool."""
        return self.potential_parts.raises(x.detach().contiguous(), to.detach())

    def _run_on_floor(self, policy: int, debug_step: int) -> Tensor:
        """Friction on a floor alone: no pairs, and nothing but the floor limits motion."""
        x = start_on_floor(self.model, self.begun, self.floor_data, self.fields.mass, self.prepared)
        room, none = torch.full_like(x[..., 0], FREE), no_pairs(x, x.shape[0] * x.shape[1])
        whole = torch.ones_like(room)
        start = PartStart(x, x.detach(), room, (), None, room > 0, none.ptr[:1].long(), (whole, whole))
        x = corrected(self, x, self.colliders, start, none).x
        if self.prepared.settings.sweeps:
            settings = self.prepared.settings
            swept = swept_part(self, x, start, self.colliders, none, settings, policy, debug_step)
            x = corrected_after(self, swept.x, self.colliders, start, none, True).x
            record_parts(self.model, x, [swept])
        return self._finite(x)

    def _colliders_at(self, share: float) -> Tensor:
        if self.colliders is self.before:
            return self.before
        return self.before + share * (self.colliders - self.before)

    def _sweep(self, x: Tensor, center: Tensor, room: Tensor, collider: Tensor, listed: Pairs, settings: SweepSettings,
               policy: int, debug_step: int) -> tuple[Tensor, Tensor]:  # fmt: skip
        lagged, model = self.lagged, self.model
        fields = replaced(self.fields,
            x_start=x, center=center, room=room, collider=collider, collider_prev=self.before, kappa=self.kappa,
            **listed._asdict(), lag=self.lag, lag_pairs=lagged.pairs, lag_ptr=lagged.ptr, lag_entry=lagged.entry,
            floor_lag=self.floor_lag,
        )  # fmt: skip
        return sweep(fields, model._packed_rest, model._plan, settings, tape_policy=policy, debug_step=debug_step)[:2]

    def detect(self, x: Tensor, was: Tensor, now: Tensor, motion: Motion) -> Detection:
        """The pairs that can matter on the ways from x."""
        return self._detect(x, was, now, self._rooms(x, was, now, motion))

    def _rooms(self, x: Tensor, was: Tensor, now: Tensor, motion: Motion) -> RoomsOfBodies:
        assert self.surface is not None and self.barrier is not None
        return rooms(motion, self.surface, self.barrier, x, self.origin, self.fields.mass, was, now, self.floor_data,
                     self.any_direction)  # fmt: skip

    @torch.no_grad()
    def _detect(self, x: Tensor, was: Tensor, now: Tensor, within: RoomsOfBodies) -> Detection:
        surface, barrier, island = self.surface, self.barrier, within.island
        assert surface is not None and barrier is not None
        x, room, own_room = x.detach(), within.room, within.own_room
        *index, corners, values, counts, smallest = search.detect(
            x, self.origin, was.detach(), now.detach(), surface, barrier, self.capacity, room, own_room
        )
        lowest = island.new_empty((0,))
        if self.floor_data is not None:
            lowest = search.lowest(x, self.origin, self.floor_data.detach(), island, surface)
        return Detection(Pairs(*index), corners, values, counts, smallest, island, lowest, room, own_room)

    def _record(self, met: Met) -> Tensor:
        """Notes what became of the step; its counts [parts, 4]."""
        outcomes[self.model.model] = outcome = met.outcome(self.capacity, self.x_prev)
        return outcome.counts

    def _judged(self, x: Tensor, met: Met) -> Tensor:
        """x, or NaN where a captured step, which cannot raise, must not be trusted."""
        table = self._record(met)
        record_parts(self.model, x, met.swept)
        if is_captured(x):
            needed, touching, _, hindered = table.unbind(1)
            good = ((needed <= self.capacity) & (touching + hindered == 0)).all()
            return torch.where(good, x, torch.nan)
        if x.is_cuda:
            for r, row in enumerate(table.tolist()):
                self._check(r, row, met)
        return self._finite(x)

    def _finite(self, x: Tensor) -> Tensor:
        """x; raises where it holds what is not finite, if that may be read."""
        if self._reads(x) and not bool(torch.isfinite(x).all()):
            self._refuse_what_is_not_finite()
            raise RuntimeError(LOST.format("in the step"))
        return x

    @property
    def capacity(self) -> int:
        """Pairs of all scenes that fit."""
        surface, barrier, scenes = self.surface, self.barrier, self.x_prev.shape[0]
        assert surface is not None and barrier is not None
        if barrier.capacity is None and not self.x_prev.is_cuda:
            return MOST_CAPACITY  # the list is as long as it must be
        return max(surface.capacity * scenes, LEAST_CAPACITY if scenes and barrier.capacity is None else 0)

    def _check(self, r: int, counts: list[int], met: Met) -> None:
        """Raises where a detection found more than fits, surfaces that touch, or a way that pairs close to what is
        prescribed."""
        surface = self.surface
        assert surface is not None and self.barrier is not None
        needed, touching, pair, hindered = counts
        if needed > self.capacity or touching or hindered:
            self._record(met)  # the status of a step that raises says why
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
        if hindered:
            raise ValueError(
                f"prescribed or colliders: expected motion that leaves bodies a way, got {hindered} pairs in substep "
                f"{r} of {self.parts} that it would bring too close: spread a long way over more steps (per_step), "
                "give PairBarrier a larger number of detections, or use a smaller time_step"
            )

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
            # nobody has said how many there may be: again, with room for them
            model.model.surface_of_contact = replace(surface, capacity=2 * error.needed)
            if in_segment():  # which begins again
                raise MorePairs from None


# --- the sweeps of a part of a step with pairs or friction, in cycles, with the coarse correcti -----------------------

# Of a step that nobody has given a number: by how far bodies want to go, and with more of them while pairs hold some up
MOST_PLANNED, MOST_DETECTIONS = 4, 8
CUT = 0.01  # share of the vertices that pairs may hold up, beside whole bodies, before it goes on, and a rollout warns


class SweptPart(NamedTuple):
    """Result of the sweeps of a substep."""

    x: Tensor  # [B, V, 3]
    limits: Tensor  # uint8 [B, K, V]
    lengths: Tensor | None = None  # of coarse corrections [corrections, B, bodies of the coarse space]


def sweeps_of_parts(sweeps: int, parts: int) -> list[int]:
    """Numbers of sweeps of R substeps: K spread evenly, the first ones taking the remainder."""
    return [sweeps // parts + (1 if r < sweeps % parts else 0) for r in range(parts)]


def sweeps_of_part(sweeps: int, planned: int, part: int) -> int:
    """And how many a part has; one beyond those that were planned, as many as the last of these, or one."""
    shared = sweeps_of_parts(sweeps, planned)
    return shared[part] if part < planned else max(shared[-1], min(sweeps, 1))


def parts_of(over: Tensor) -> int:
    """Number of substeps of a step without a given number: one, and one more each time that bodies want to go
    twice as far as the most room that they get. over: of RoomsOfBodies."""
    most = float(over.max()) if over.numel() else 0.0
    return min(MOST_PLANNED, 1 + math.ceil(math.log2(most))) if 1 < most < math.inf else 1


def swept_part(of: ContactStep, x: Tensor, start: PartStart, collider: Tensor, listed: Pairs, settings: SweepSettings,
               policy: int, debug_step: int) -> SweptPart:  # fmt: skip
    """Positions [B, V, 3] after the sweeps of a part that begin at x, in the rooms of its start."""

    def sweep(x: Tensor, settings: SweepSettings) -> tuple[Tensor, Tensor]:
        return of._sweep(x, start.center, start.room, collider, listed, settings, policy, debug_step)

    settings = replaced(settings, coarse=())  # which the operator would make, without pairs
    cycles = _cycles(of.model, settings.sweeps)
    if len(cycles) <= 1:
        return SweptPart(*sweep(x, settings))
    corrections = None
    if of.coarse_matrix is not None:
        judge = _trials(of, start, collider, listed)
        corrections = Corrections(judge, of.fields, of.coarse_matrix, _scenes(of, start, collider, listed))
    numbers = settings.numbers
    within = replaced(settings, numbers=replaced(numbers, last_relaxation=numbers.relaxation))
    limits, lengths = [], []
    for n, count in enumerate(cycles):
        ends = n + 1 == len(cycles)
        if corrections is not None and n:
            x, length = corrections.correct(x)
            lengths.append(length)
        x, limit = sweep(x, replaced(settings if ends else within, sweeps=count))
        limits.append(limit)
    return SweptPart(x, torch.cat(limits, 1), torch.stack(lengths) if lengths else None)


def _cycles(model: System, sweeps: int) -> list[int]:
    """Sweeps of each cycle of a part, with corrections the first sweep alone; [sweeps] where nothing is done between
    them."""
    if model.coarse is None or not model.coarse_geometry.bodies:
        return [sweeps]
    every, after = model.coarse.every, sweeps - 1
    return [1, *(min(every, after - begun) for begun in range(0, after, every))]


def _scenes(of: ContactStep, start: PartStart, collider: Tensor, listed: Pairs) -> Scenes:
    numbers = of.prepared.settings.numbers
    fields = touching(of, of.x_prev, collider, start, listed)
    return Scenes(of.model, fields, numbers.time_step, numbers.friction_eps)


def _trials(of: ContactStep, start: PartStart, collider: Tensor, listed: Pairs) -> Trials:
    s = _scenes(of, start, collider, listed)
    s = replaced(s, fields=ops.TouchingFields(*(t.detach() for t in s.fields)))
    return Trials(s, of.potential_parts)


def of_going(part: SweptPart, going: Tensor) -> SweptPart:
    """Result of a substep in the scenes that go on, bool [B, 1, 1]; in others it is discarded."""
    return part if part.lengths is None else replaced(part, lengths=torch.where(going[:, 0], part.lengths, 0.0))


def record_parts(model: System, x: Tensor, parts: Sequence[SweptPart]) -> None:
    """For record("subspace"): what the parts of a step that ends at x have done."""
    if model.coarse is not None:
        for found in recorders("subspace"):
            lengths = [part.lengths for part in parts if part.lengths is not None]
            empty = x.new_empty((0, len(x), model.coarse_geometry.bodies))
            found.append(torch.cat([empty, *lengths]).movedim(0, 1))


# --- records of a step with contact -----------------------------------------------------------------------------------


class Detection(NamedTuple):
    """One search for pairs, and what its part of the step has decided. Index data; the step differentiates the values
    anew. N corner points: vertices, then those of colliders.

    Attributes:
        listed: The pairs that may matter: ``pairs`` [capacity, 6], four corner points, kind (0 point and triangle, 1
            two edges, 2 point and plane) and scene, or -1; ``constants`` [capacity, 8]; those of each corner point by
            ``ptr`` [B N + 1] and ``entry`` [4 capacity].
        near_corners: Corner points and kind of the nearest pair of each corner point, int [B, N, 5]; -1: none.
        near_values: Its weights, normal and gap [m], [B, N, 8].
        counts: int64 [4]: pairs that the list needs, pairs that touch, key of one of those or -1, 0.
        smallest: Smallest gap of each scene, or how far was looked [m], [B].
        island: Smallest body of those that each body moves with, int [B, bodies]; -1: it stays, being held or near a
            collider.
        lowest: Lowest vertex of each body's island above each plane of the floor, int [B, bodies, planes]; else empty.
        room: How far the vertices of each body may go beside its island, and the largest [m], [B, bodies + 1].
        own_room: The same beside the rigid motion of the body [m].
        shares: How much of its two ways each vertex begins the part with, [B, V] each.
        corrections: Shares of the rigid corrections before and after the sweeps, [B, bodies] each.
        limits: By how often each update was halved, uint8 [B, K, V]; 8: it was not made.
        frames: Share of the rigid motion that each body begins the part with, [B, bodies].
        lengths: Of the coarse corrections, [corrections, B, bodies of the coarse space]; None: there are none.
        kept: Rows of the listed pairs that sweeps can reach; None where that would have to be read, as on CUDA.
        sweeps: How many sweeps the part has.
        going: Scenes that go on in a part beyond those that were planned, bool [B, 1, 1]; None: all, as planned.
        resting: Vertices of held bodies that begin without gravity's fall, bool [B, V]; None: none.
    """

    listed: Pairs
    near_corners: Tensor
    near_values: Tensor
    counts: Tensor
    smallest: Tensor
    island: Tensor
    lowest: Tensor
    room: Tensor
    own_room: Tensor
    # what the part has decided
    shares: tuple[Tensor, ...] | None = None
    corrections: tuple[Tensor, ...] | None = None
    limits: Tensor | None = None
    frames: Tensor | None = None
    lengths: Tensor | None = None
    kept: Tensor | None = None
    sweeps: int = 0
    going: Tensor | None = None
    resting: Tensor | None = None


class Outcome(NamedTuple):
    """Record of the latest step of a Model, on its device; read by diffvbd.contact.status."""

    counts: Tensor  # [R, 4] int64: pairs needed, touching pairs, key of one or -1, pairs that hinder what is prescribed
    capacity: int  # pairs of all scenes
    cut: Tensor  # [B, V] bool: limited in the last sweep; without any, held up at the start
    smallest: Tensor  # [R, B] [m]


class TooManyPairs(RuntimeError):
    """More pairs than fit; ``needed`` per scene."""

    def __init__(self, needed: int, message: str) -> None:
        super().__init__(message)
        self.needed = needed


class Met:
    """Records of the substeps, one after another."""

    def __init__(self) -> None:
        self.found: list[Detection] = []
        self.counts: list[Tensor] = []
        self.swept: list[SweptPart] = []
        self.cut: Tensor | None = None  # before the first part is over

    def outcome(self, capacity: int, x: Tensor) -> Outcome:
        """capacity: Pairs of all scenes that fit.  x: [B, V, 3] at the start of the step."""
        smallest, counts = _stack([d.smallest for d in self.found]), _stack(self.counts)
        cut = torch.zeros_like(x[..., 0], dtype=torch.bool) if self.cut is None else self.cut
        return Outcome(counts, capacity, cut, smallest)


def _stack(parts: list[Tensor]) -> Tensor:
    return parts[0][None] if len(parts) == 1 else torch.stack(parts)  # one is not copied: on CUDA that is a launch


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

ROOM = 1.5  # how far a vertex may go, over how far the farthest of its body wants to
LEAST_ROOM = 1.0  # of dhat, beside that: as far as a barrier that starts compressed may push


@torch.no_grad()
def rooms(motion: Motion, surface: ContactSurface, barrier: PairBarrier, x: Tensor, origin: Tensor, mass: Tensor,
          was: Tensor, now: Tensor, floor: Tensor | None, any_direction: bool) -> RoomsOfBodies:  # fmt: skip
    """Trust-region radii of bodies until pairs are found again. Index data.

    Args:
        motion: Where each vertex wants to go.  x, origin: As the sweeps take them.  mass: [1 | B, V] [kg].
        was, now: Collider points [B, Vc, 3] [m].  floor: Data of the FloorBarrier, or None.
        any_direction: Whether the floor has planes across the axes, along which a translation may be turned.
    """
    s, dhat = surface, barrier.dhat
    floor = x.new_empty((0,)) if floor is None else floor.detach().contiguous()
    return contact_rooms(
        x.detach(), origin, mass.detach().contiguous(), motion.move.detach().contiguous(), s.held, s.body_order,
        s.body_ptr, motion.ways, floor, was.detach(), now.detach(), s.planes, s.body, s.radius, s.most_room,
        s.most_room_alone, s.most_own_room, s.least_own_room, dhat, ROOM, LEAST_ROOM * dhat, any_direction,
        barrier.self_contact,
    )  # fmt: skip


@torch.no_grad()
def rooms_of_sweeps(motion: Motion, surface: ContactSurface, barrier: PairBarrier, start: PartStart, x: Tensor,
                    begin: Tensor) -> Tensor:  # fmt: skip
    """Largest displacement of a vertex by the sweeps [B, V] [m]: as far as a barrier pushes, weight
    pulls, elasticity takes back what bodies deform by on the way and, of what pairs have held up, all; the most of a
    scene, since bodies push one another. Index data.

    Args:
        motion: What the part wanted.  start: Its start, whose rooms bound the whole way.
        x, begin: Where the sweeps begin, and where the part began, [B, V, 3] [m].
    """
    s, none = surface, x.new_empty((0,))
    own_center, own_room = start.own or (none, none)
    x, led, begin, move, fall = (t.detach().contiguous() for t in (x, start.x, begin, motion.move, motion.fall))
    return sweep_rooms(
        x, led, begin, move, fall, motion.apart, motion.stretched, start.center, start.room, own_center, own_room,
        s.held, s.body_order, s.body_ptr, ROOM, LEAST_ROOM * barrier.dhat,
    )  # fmt: skip


# --- intended motion of bodies ----------------------------------------------------------------------------------------


def coasting(x: Tensor, mass: Tensor, move: Tensor, held: Tensor, held_bodies: Tensor, order: Tensor, ptr: Tensor,
             chord: float) -> Tensor:  # fmt: skip
    """The ways ``move`` [B, V, 3] without what stretches free bodies that turn; differentiable in x, mass and move.
    Arguments as for :func:`diffvbd.ops.contact.contact_coast`."""
    given = (t.contiguous() for t in (x, mass, move))
    return ops_contact.coasting(*given, held, held_bodies, order, ptr, chord)


class Motion(NamedTuple):
    """The ways that vertices want to go in a part of a step."""

    move: Tensor  # [B, V, 3] [m]
    fall: Tensor  # [B, V, 3] [m]: what contact may bear of it comes after ``move``
    rigid: Tensor  # [B, V, 3] [m]: of ``move`` a shift and a turn of each body, which brings no two points of it closer
    ways: ops_contact.Ways  # index data

    @property
    def apart(self) -> Tensor:
        """The longest way of a free vertex of each body beside its rigid motion [B, bodies] [m]."""
        return self.ways.longest[WAYS.index("apart")]

    @property
    def stretched(self) -> Tensor:
        """Distance by which the straight paths of a rotation, or of a fraction of it, take a vertex of each body from
        the rotated body [B, bodies] [m]."""
        return self.ways.longest[WAYS.index("stretched")]


def motion_of(surface: ContactSurface, x: Tensor, origin: Tensor, mass: Tensor, move: Tensor, fall: Tensor) -> Motion:
    """Differentiable in what x, mass and move do to ``rigid``.

    Args:
        x, origin: As the sweeps take them.  mass: [1 | B, V] [kg].  move, fall: [B, V, 3] [m].
    """
    x, mass, move = x.contiguous(), mass.contiguous(), move.contiguous()
    index = (surface.held, surface.held_bodies, surface.body_order, surface.body_ptr)
    rigid, longest, sums = ops_contact.rigid_motion(x, mass, move, origin, *index, fall.detach().contiguous())
    return Motion(move, fall, rigid, ops_contact.Ways(rigid.detach(), longest, sums))


# --- residual acceleration of each body -------------------------------------------------------------------------------


def unsupported(model: System, x: Tensor, origin: Tensor, push: Tensor, mass: Tensor, lift: Tensor,
                floor_data: Tensor | None, time_step: float) -> Tensor:  # fmt: skip
    """Residual of ``lift`` = h^2 a [1 | B, V, 3] once the contact forces at the start of the step have borne their
    part of each body's acceleration: for a body at rest nothing, in flight all of it. Differentiable.

    Without it every step would push a supported body into its support, and the sweeps would have to take it back.

    Args:
        x, origin: As the sweeps take them.  push: Forces of pairs on corner points at x [B, N, 3] [N].
        mass: [1 | B, V] [kg].  floor_data: Of the FloorBarrier [1 | B, 7 planes], or None.  time_step: [s].
    """
    surface = model.surface_of_contact
    assert surface is not None
    planes = x.new_empty((0,)) if floor_data is None else floor_data
    constants = (surface.held_bodies, surface.body_order, surface.body_ptr, time_step)
    at = x.detach() if floor_data is None else x  # without a floor only forces know where vertices are
    given = (t.contiguous() for t in (at, lift, push, mass, planes))
    return lift_left(*given, origin, *constants)


def rests(model: System, x: Tensor, lift: Tensor, raises: Callable[[Tensor, Tensor], Tensor]) -> Tensor | None:
    """Vertices of partly pinned bodies whose potential ``lift`` would increase, bool [B, V]; None
    without such bodies. Elasticity bears the weight of a body at rest, and its potential is convex about there: it
    rises by any fall. Few sweeps do not take the fall back, and what stands on such a body would follow it.

    Args:
        x: Where vertices are without the fall, [B, V, 3] [m].  lift: As :func:`unsupported` returns it.
        raises: As for :func:`diffvbd._contact.start.start_between_planes`.
    """
    assert model.surface_of_contact is not None
    held = model.surface_of_contact.partly_held
    return None if held is None else raises(x, x + lift) & held


# --- start of the sweeps of a step with friction on a floor and no pairs ----------------------------------------------

PLANE, DHAT = 7, 5  # numbers of a plane of a FloorBarrier, and which of them is dhat


def start_on_floor(model: System, begun: Begun, floor: Tensor | None, mass: Tensor, prepared: Prepared
                   ) -> Tensor:  # fmt: skip
    """Positions [B, V, 3] [m]: free bodies go as wholes, above the floor. If each vertex went as far as the floor lets
    it by itself, the start would press a body that hits the floor. Differentiable.

    floor: Data of the FloorBarrier [1 | B, 7 planes], or None.  mass: [1 | B, V] [kg].
    """
    x, start = begun.x_prev, begun.x_start
    if floor is None:
        return start
    order, ptr, free, held, body = bodies_of(model)
    body, lift = body[: x.shape[1]].long(), broadcast(begun.lift, x.shape)
    way = prepared.ways(partial(coasting, x, mass, begun.y - x - lift, held, ~free, order, ptr))
    if model.starts_from != "inertia":
        way = way + _borne(floor, x if begun.origin is None else x + begun.origin, lift, body, len(free))
    none = x.new_empty((0,))
    origin = none if begun.origin is None else begun.origin
    left, _ = above_floor(x, none, way, floor, origin, held, order, ptr)
    return torch.where(free[body, None], x + left, start)


def _borne(floor: Tensor, x: Tensor, lift: Tensor, body: Tensor, bodies: int) -> Tensor:
    """``lift`` = h^2 a [B, V, 3] without what pushes a body into a plane within dhat, which bears it. Of a body at rest
    nothing is left, on a slope what draws it down the slope."""
    planes = floor.reshape(floor.shape[0], 1, -1, PLANE)
    normal = planes[:, 0, :, :3]
    with torch.no_grad():
        close = (x @ normal.mT - planes[..., 3] < planes[..., DHAT]).to(x.dtype)
        near = close.new_zeros((len(x), bodies, close.shape[-1]))
        near = near.scatter_reduce(1, body[:, None].expand(close.shape), close, "amax")[:, body]
    return lift - (near * (lift @ normal.mT).clamp(max=0)) @ normal
