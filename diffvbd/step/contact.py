"""The executed step with contact: R times detection, bounds, start and sweeps (docs/method.md, section 12)."""

from __future__ import annotations

import weakref
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..adjoint.contact_lag import Pairs, of_scene, pair_lag
from ..adjoint.sweep import no_transforms, sweep
from ..contact import detection as search
from ..contact.start import start_part
from ..contact.surface import LEAST_CAPACITY
from ..model.model import Model
from ..ops import SweepSettings, broadcast
from ..scopes import checking, recorders
from .intersections import refuse_intersections

if TYPE_CHECKING:
    from .arguments import Prepared
    from .predict import Begun

FREE = 1e15  # [m] radius of a bound that binds nothing


class Detection(NamedTuple):
    """One search: which pairs are listed (``listed.pairs`` [capacity, 6]: four corner points, kind, scene), the nearest
    pair of each corner point (``near_corners`` [B, N, 5], ``near_values`` [B, N, 8]: weights, normal, gap [m]), which
    bodies move together (``island`` [B, bodies]). Index data; the step differentiates the values anew."""

    listed: Pairs
    near_corners: Tensor
    near_values: Tensor
    counts: Tensor
    smallest: Tensor
    island: Tensor
    lowest: Tensor  # of a Model with a floor, else empty


class Outcome(NamedTuple):
    """What the latest step of a Model has met, on its device; read by diffvbd.contact.status."""

    counts: (
        Tensor  # [R, 4] int64: pairs needed, touching pairs, key of one or -1, corner points moved above their bound
    )
    capacity: int  # pairs of all scenes
    cut: list[Tensor]  # [B, V] uint8, of each start and of each part's sweeps
    smallest: Tensor  # [R, B] [m]


outcomes: weakref.WeakKeyDictionary[Model, Outcome] = weakref.WeakKeyDictionary()


def sweeps_of_parts(sweeps: int, parts: int) -> list[int]:
    """How K sweeps are spread over R parts: evenly, the first ones taking what is left."""
    return [sweeps // parts + (1 if r < sweeps % parts else 0) for r in range(parts)]


class ContactStep:
    """What the parts of one step share."""

    def __init__(self, model: Model, begun: Begun, prepared: Prepared, before: Tensor, colliders: Tensor,
                 prescribed: bool) -> None:  # fmt: skip
        begun = begun._replace(x_prev=begun.x_prev.contiguous(), y=begun.y.contiguous())
        self.model, self.begun, self.prepared, self.prescribed = model, begun, prepared, prescribed
        self.x_prev = begun.x_prev
        # [B, Vc, 3] at the end and at the start of the step: one tensor if they rest
        self.before = before.contiguous()
        self.colliders = self.before if colliders is before else colliders.contiguous()
        self.fields = begun.fields(model, prepared)
        self.origin = begun.x_prev.new_empty((0,)) if begun.origin is None else begun.origin
        self.surface, self.barrier = model.surface_of_contact, model.contact
        self.floor_data = None if model.floor is None else begun.data[:, : model.floor.count()].contiguous()
        floor = model.floor
        oblique = floor is not None and bool((np.count_nonzero(floor.normal, axis=-1) > 1).any())
        self.any_direction = oblique or "floor_barrier.normal" in prepared.parameters
        self.parts = 1 if self.barrier is None else self.barrier.detections
        like = begun.x_prev
        self.kappa = self._parameter("pair_barrier.kappa", like.new_zeros((1,)))
        self.lagged, self.lag = no_pairs(like, 0), like.new_zeros((0, 9))
        self.floor_lag = self._floor_lag()

    def _parameter(self, name: str, default: Tensor) -> Tensor:
        """A parameter [1 | B]."""
        if name in self.prepared.parameters:
            return self.prepared.parameters[name]
        owner, key = name.split(".")
        energy = next((e for e in self.model.parametric_energies if e.name == owner), None)
        return default if energy is None else self.model.constants(energy)[key][None]

    def _floor_lag(self) -> Tensor:
        """Friction coefficient times normal force of the floor's planes, and their normals, at the start."""
        floor, x = self.model.floor, self.begun.x_prev
        if floor is None or self.floor_data is None or self.model.friction is None:
            return x.new_zeros((0,))
        force, normal = floor.normal_force(x, self.floor_data, self.begun.origin)
        size = self._parameter("friction.coefficient", x)[:, None, None] * force
        normal = broadcast(normal[:, None], (*size.shape, 3))
        return torch.cat([size[..., None], normal], -1)

    def _set_lag(self, listed: Pairs, collider: Tensor) -> None:
        """Friction and damping of the pairs at the start of the step."""
        barrier, friction = self.barrier, self.model.friction
        damped = "pair_barrier.damping" in self.prepared.parameters or (barrier is not None and barrier.damping > 0)
        if barrier is None or not (damped or friction is not None):
            return
        state = pair_lag(self.begun.x_prev, collider, self.kappa, self.origin, listed)
        force, active, rest = state.split((1, 1, 7), -1)

        def of_pair(value: Tensor) -> Tensor:
            return broadcast(value[:, None], force.shape) if value.shape[0] == 1 else of_scene(value, listed)[:, None]

        zero = force.new_zeros((1,))
        coefficient = self._parameter("friction.coefficient", zero)
        damping = self._parameter("pair_barrier.damping", zero)
        self.lagged = listed
        self.lag = torch.cat([of_pair(coefficient) * force, of_pair(damping) * active, rest], -1)

    def run(self, policy: int, debug_step: int) -> Tensor:
        """Positions after all parts [B, V, 3]; raises where detection did not hold."""
        begun, settings = self.begun, self.prepared.settings
        barrier, surface = self.barrier, self.surface
        if barrier is None or surface is None:  # friction on a floor alone
            x = begun.x_start
            bounds = torch.cat([x, torch.full_like(x[..., :1], FREE)], -1)
            none = no_pairs(x, x.shape[0] * x.shape[1])
            return self._sweep(x, bounds, self.colliders, none, settings, policy, debug_step)[0]
        if checking():
            refuse_intersections(self.model, self.x_prev, self.origin, self.before)
        x, way = self.x_prev, begun.y - self.x_prev
        move = way
        cut: list[Tensor] = []
        found: list[Detection] = []
        counts: list[Tensor] = []
        for r, sweeps in enumerate(sweeps_of_parts(settings.sweeps, self.parts)):
            was, now = (self._colliders_at(n / self.parts) for n in (r, r + 1))
            goal = begun.y if r + 1 == self.parts else self.x_prev + ((r + 1) / self.parts) * way
            detection = self._detect(x, was, now, move)
            found.append(detection)
            counts.append(torch.cat([detection.counts[:3], self._above(way, was, now, detection)]))
            if not x.is_cuda and not torch.compiler.is_compiling():  # reading is free: before any work
                self._record(found, counts, cut)
                self._check(r, counts[-1].tolist())
            if r == 0:
                self._set_lag(detection.listed, was)
            start = start_part(x, move, goal, self.fields.mass, was, now, self.floor_data, self.origin, detection,
                               surface, barrier.gamma)  # fmt: skip
            x, move = start.x, start.move
            cut.append(start.outside)
            if sweeps:
                part = settings._replace(sweeps=sweeps)
                x, held_back = self._sweep(x, start.bounds, now, detection.listed, part, policy, debug_step)
                cut.append(held_back)
        return self._judged(x, found, counts, cut)

    def _colliders_at(self, share: float) -> Tensor:
        if self.colliders is self.before:
            return self.before
        return self.before + share * (self.colliders - self.before)

    def _sweep(self, x: Tensor, bounds: Tensor, collider: Tensor, listed: Pairs, settings: SweepSettings, policy: int,
               debug_step: int) -> tuple[Tensor, Tensor]:  # fmt: skip
        lagged, model = self.lagged, self.model
        fields = self.fields._replace(
            x_start=x, bounds=bounds, collider=collider, collider_prev=self.before, kappa=self.kappa,
            **listed._asdict(), lag=self.lag, lag_pairs=lagged.pairs, lag_ptr=lagged.ptr, lag_entry=lagged.entry,
            floor_lag=self.floor_lag,
        )  # fmt: skip
        return sweep(fields, model._packed_rest, model._plan, settings, tape_policy=policy, debug_step=debug_step)[:2]

    def _detect(self, x: Tensor, was: Tensor, now: Tensor, remaining: Tensor) -> Detection:
        surface, barrier = self.surface, self.barrier
        assert surface is not None and barrier is not None
        with torch.no_grad():
            x, was, now = x.detach(), was.detach(), now.detach()
            *index, corners, values, counts, smallest = search.detect(
                x, self.origin, was, now, surface, barrier, self.capacity
            )
            island = search.islands(
                x,
                self.origin,
                remaining.detach(),
                self.fields.mass.detach(),
                was,
                now,
                surface,
                barrier.dhat,
                self.any_direction,
            )
            lowest = island.new_empty((0,))
            if self.floor_data is not None:
                lowest = search.lowest(x, self.origin, self.floor_data.detach(), island, surface)
        detection = Detection(Pairs(*index), corners, values, counts, smallest, island, lowest)
        for found in recorders():
            found.append(detection)
        return detection

    def _above(self, way: Tensor, was: Tensor, now: Tensor, detection: Detection) -> Tensor:
        """How many pinned vertices and collider points this part moves above their bound, int64 [1]."""
        surface, barrier = self.surface, self.barrier
        assert surface is not None and barrier is not None
        if not self.prescribed and was is now:
            return detection.counts[3:]  # a zero: nothing that is held moves
        with torch.no_grad():
            radius = (barrier.gamma * detection.near_values[..., 7]).clamp(0, surface.cap)
            moves = torch.cat([way / self.parts, now - was], 1).square().sum(-1).sqrt()
            above = (moves > radius) & surface.held & ~surface.plane_points
            return above.sum().reshape(1)

    def _record(self, found: list[Detection], counts: list[Tensor], cut: list[Tensor]) -> None:
        smallest = torch.stack([d.smallest for d in found])
        outcomes[self.model] = Outcome(torch.stack(counts), self.capacity, cut, smallest)

    def _judged(self, x: Tensor, found: list[Detection], counts: list[Tensor], cut: list[Tensor]) -> Tensor:
        """x, or NaN where a captured or compiled step, which cannot raise, must not be trusted."""
        self._record(found, counts, cut)
        outcome = outcomes[self.model]
        table, capacity = outcome.counts, outcome.capacity
        if torch.compiler.is_compiling() or (x.is_cuda and torch.cuda.is_current_stream_capturing()):
            good = (table[:, :2] <= torch.stack([table.new_full((), capacity), table.new_zeros(())])).all()
            good = good & (table[:, 3] == 0).all()
            return torch.where(good, x, torch.nan)
        if x.is_cuda:
            for r, row in enumerate(table.tolist()):
                self._check(r, row)
        return x

    @property
    def capacity(self) -> int:
        """Pairs of all scenes that fit."""
        surface, barrier, scenes = self.surface, self.barrier, self.x_prev.shape[0]
        assert surface is not None and barrier is not None
        return max(surface.capacity * scenes, 0 if barrier.capacity is not None else LEAST_CAPACITY)

    def _check(self, r: int, counts: list[int]) -> None:
        """Raises where a detection found more than fits, surfaces that touch, or motion above a bound."""
        surface = self.surface
        assert surface is not None
        needed, touching, pair, above = counts
        scenes = self.x_prev.shape[0]
        if needed > self.capacity:
            raise RuntimeError(
                f"pair_barrier.capacity: {needed} pairs in part {r} of the step do not fit {self.capacity} "
                f"({-(-self.capacity // scenes)} per scene): "
                f"use diffvbd.contact.reserve(model, {2 * -(-needed // scenes)})"
            )
        if touching:
            finite = all(
                bool(torch.isfinite(t).all()) for t in (self.x_prev, self.begun.y, self.colliders, self.before)
            )
            if not finite:  # which argument, finds arguments.name_argument
                raise ValueError("start (x, v, force, gravity, prescribed, colliders): expected finite values")
            if pair < 0:
                raise RuntimeError(
                    f"x: positions became non-finite before part {r} of the step: look with diffvbd.debug_checks(), "
                    "use a smaller time_step or softer materials"
                )
            scene, corners = surface.corners_of(pair)
            vertices = self.x_prev.shape[1]
            named = "x or colliders" if any(corner >= vertices for corner in corners) else "x"
            raise ValueError(
                f"{named}: expected surfaces that do not touch, got {touching} pairs without a gap in part {r} of the "
                f"step, one of the corner points {corners} in scene {scene}"
            )
        if above:
            raise ValueError(
                f"prescribed or colliders: expected motion below the bounds of contact, got {above} points moved "
                f"farther in part {r} of {self.parts}: use a larger reach (now {surface.reach:g} m, which allows "
                f"{surface.cap:g} m a part), more detections or a smaller time_step"
            )


def no_pairs(like: Tensor, corners: int) -> Pairs:
    """An empty list for so many corner points of all scenes."""
    none = torch.zeros((corners + 1,), dtype=torch.int32, device=like.device)
    return Pairs(none[:0].reshape(0, 6), like.new_zeros((0, 3)), none, none[:0])


def run_contact(model: Model, begun: Begun, prepared: Prepared, before: Tensor, colliders: Tensor, prescribed: bool,
                policy: int, debug_step: int) -> Tensor:  # fmt: skip
    """Positions after the sweeps of a step with contact.

    Args:
        before, colliders: Where the colliders are at its start and at its end, [B, Vc, 3] [m]; one tensor if they rest.
        prescribed: Whether pinned vertices are moved.
    """
    if torch._C._functorch.peek_interpreter_stack() is not None:  # pyright: ignore[reportAttributeAccessIssue]
        no_transforms()
    return ContactStep(model, begun, prepared, before, colliders, prescribed).run(policy, debug_step)
