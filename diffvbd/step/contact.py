"""The executed step with contact: R times detection, start, correction, sweeps and correction (docs/method.md, sections
12 and 18)."""

from __future__ import annotations

import functools
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from ..adjoint.contact_lag import Pairs, no_pairs, rubbing, some_of
from ..adjoint.potential import of_vertices
from ..adjoint.rise import RiseParts, rise_parts
from ..adjoint.sweep import no_transforms, sweep
from ..contact import detection as search
from ..contact.start import PartStart, start_between_planes
from ..contact.surface import LEAST_CAPACITY
from ..mask import CONTACT
from ..model.inputs import parameter_of
from ..model.system import System
from ..model.warnings import inside_out
from ..ops import SweepSettings, broadcast
from ..ops import contact as ops_start
from ..ops.contact import RoomsOfBodies
from ..scopes import checking, is_captured, not_compiled, recorders
from ..tuples import replaced
from .coarse import matrix_of
from .contact_cycles import CUT, MOST_DETECTIONS, of_going, parts_of, record_parts, sweeps_of_part, swept_part
from .corrections import corrected, corrected_after, is_cut
from .floor_start import start_on_floor
from .intersections import advice_to_part, refuse_intersections
from .met import Detection, Met, TooManyPairs, outcomes
from .motion import Motion, coasting, motion_of
from .rooms import ROOM, rooms, rooms_of_sweeps
from .unsupported import rests, unsupported

if TYPE_CHECKING:
    from .arguments import Prepared
    from .predict import Begun

FREE = 1e15  # [m] room that nothing fills
CLOSE = 1e-3  # of dhat: pairs whose gap is so much wider do not push, however it is rounded
MOST_CAPACITY = 2**26
LOST = ("x: positions became non-finite {}: check that v, forces and materials are in SI units, use a smaller "
        "time_step or softer materials, or look with diffvbd.debug_checks()")  # fmt: skip


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
                f"capacity: {needed} pairs in part {r} of the step do not fit {self.capacity} "
                f"({-(-self.capacity // scenes)} per scene): "
                f"use diffvbd.contact.reserve(model, {2 * -(-needed // scenes)})",
            )
        if touching:
            self._refuse_what_is_not_finite()
            if pair < 0:
                raise RuntimeError(LOST.format(f"before part {r} of the step"))
            scene, corners = surface.corners_of(pair)
            vertices = self.x_prev.shape[1]
            named = "x or colliders" if any(corner >= vertices for corner in corners) else "x"
            owners = surface.owners_of(corners[0], corners[3])
            raise ValueError(
                f"{named}: expected surfaces that do not touch, got {touching} pairs without a gap "
                + (f"in part {r} of the step" if r else "at the start of the step")
                + f", one of the corner points {corners} of {owners} in scene {scene}: "
                + advice_to_part(self.x_prev, self.origin, self.barrier.dhat)
            )
        if hindered:
            raise ValueError(
                f"prescribed or colliders: expected motion that leaves bodies a way, got {hindered} pairs in part {r} "
                f"of {self.parts} that it would bring too close: spread a long way over more steps (per_step), give "
                "PairBarrier a larger number of detections, or use a smaller time_step"
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
