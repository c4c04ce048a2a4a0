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
from ..contact.start import PartStart, start_between_planes
from ..contact.surface import LEAST_CAPACITY
from ..model.model import Model
from ..ops import SweepSettings, broadcast
from ..reference.intersections import intersections
from ..scopes import checking, recorders
from .rigid_contact import Scene, correct

if TYPE_CHECKING:
    from .arguments import Prepared
    from .predict import Begun

import os

STARTS, ENDS = int(os.environ.get("S", 1)), int(os.environ.get("E", 1))
FREE = 1e15  # [m] a room that ends nowhere
ROOM = 1.5  # how far a vertex may go, over how far the farthest of its body wants to go


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

    def trimmed(self) -> Detection:
        """Without the rows that no pair fills; reads the count."""
        n, (pairs, constants, ptr, entry) = int(self.counts[0]), self.listed
        listed = Pairs(pairs[:n].clone(), constants[:n].clone(), ptr, entry[: 4 * n].clone())
        return self._replace(listed=listed)


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
            none, free = no_pairs(x, x.shape[0] * x.shape[1]), torch.full_like(x[..., 0], FREE)
            return self._sweep(x, x.detach().contiguous(), free, self.colliders, none, settings, policy, debug_step)[0]
        if checking():
            self._look_for_intersections()
        lift = torch.where(self.model._pinned[:, None], torch.zeros_like(begun.lift), begun.lift)
        lift = broadcast(lift, begun.y.shape)
        x, way = self.x_prev, begun.y - self.x_prev - lift
        left, pinned = torch.zeros_like(way), self.model._pinned[:, None]
        cut: list[Tensor] = []
        found: list[Detection] = []
        counts: list[Tensor] = []
        for r, sweeps in enumerate(sweeps_of_parts(settings.sweeps, self.parts)):
            was, now = (self._colliders_at(n / self.parts) for n in (r, r + 1))
            move, fall = (way, lift) if r == 0 else (left, torch.zeros_like(lift))
            if self.parts > 1:
                move = torch.where(pinned, way / self.parts, move)
            island, room = self._rooms(x, was, now, move, fall)
            detection = self._detect(x, was, now, island, room)
            found.append(detection)
            if not x.is_cuda and not torch.compiler.is_compiling():  # reading is free: before any work
                counts.append(torch.cat([detection.counts[:3], detection.counts[3:]]))
                self._record(found, counts, cut)
                self._check(r, counts[-1].tolist())
                counts.pop()
                detection = found[-1] = detection.trimmed()
            if r == 0:
                self._set_lag(detection.listed, was)
                lift = self._supported(lift, x, was, detection.listed)
                fall = lift
            start = self._start(x, move, fall, was, now, detection, room)
            counts.append(torch.cat([detection.counts[:3], start.stuck]))
            x = start.x
            cut.append(start.cut)
            for _ in range(STARTS):
                x = self._correct(x, was, now, start, detection)
            if sweeps:
                part = settings._replace(sweeps=sweeps)
                x, held_back = self._sweep(x, start.center, start.room, now, detection.listed, part, policy, debug_step)
                cut.append(held_back)
            for _ in range(ENDS):
                x = self._correct(x, was, now, start, detection)
            if r + 1 < self.parts:  # what has not come through tries again
                goal = self.x_prev + way + lift
                left = torch.where(start.cut[:, 0, :, None] > 0, goal - x, torch.zeros_like(x))
        return self._judged(x, found, counts, cut)

    def _correct(self, x: Tensor, was: Tensor, now: Tensor, start: PartStart, detection: Detection) -> Tensor:
        numbers, surface = self.prepared.settings.numbers, self.surface
        assert surface is not None
        scene = Scene(
            self.x_prev,
            self.begun.y,
            self.fields.mass,
            self.origin,
            self.before,
            was,
            now,
            self.kappa,
            detection.listed,
            self.lagged,
            self.lag,
            self.floor_lag,
            start.center,
            start.room,
            surface,
            self.model,
            self.begun.data,
            numbers.time_step,
            numbers.friction_eps,
        )
        return correct(scene, x)

    def _rooms(self, x: Tensor, was: Tensor, now: Tensor, move: Tensor, fall: Tensor) -> tuple[Tensor, Tensor]:
        """Islands [B, bodies], and how far the vertices of each body may go beside them, and the largest,
        [B, bodies + 1] [m]. What is within that of each other is looked for."""
        surface, barrier = self.surface, self.barrier
        assert surface is not None and barrier is not None
        with torch.no_grad():
            x, was, now, move = x.detach(), was.detach(), now.detach(), move.detach()
            body = surface.body[: x.shape[1]].long()
            mass = self.fields.mass.detach()
            free = ~surface.held[: x.shape[1]]
            weight = broadcast(torch.where(free, mass, torch.zeros_like(mass)), x.shape[:2])[..., None]

            falls = fall.detach().square().sum(-1).sqrt()
            falls = falls.new_zeros((x.shape[0], surface.bodies)).index_reduce_(1, body, falls, "amax")

            def largest(beside: Tensor) -> Tensor:
                length = torch.where(free, beside.square().sum(-1).sqrt(), beside.new_zeros(()))
                out = length.new_zeros((x.shape[0], surface.bodies)).index_reduce_(1, body, length, "amax")
                return ROOM * out + falls + barrier.dhat / 4

            sums = x.new_zeros((x.shape[0], surface.bodies, 4))
            sums.index_add_(1, body, torch.cat([weight * move, weight], -1))
            own = sums[..., :3] / sums[..., 3:].clamp(min=torch.finfo(x.dtype).tiny)
            room = largest(move - own[:, body]).clamp(max=surface.most_room)

            def islands(room: Tensor) -> Tensor:
                room = (
                    torch.cat([room, room.amax(1, keepdim=True)], 1)
                    if surface.bodies
                    else room.new_zeros((x.shape[0], 1))
                )
                return search.islands(
                    x, self.origin, move, mass, was, now, surface, barrier.dhat, room, self.any_direction
                ), room

            island, _ = islands(room)
            label = island.clamp(min=0).long()
            joined = torch.zeros_like(sums).scatter_add_(1, label[..., None].expand_as(sums), sums)
            u = (joined[..., :3] / joined[..., 3:].clamp(min=torch.finfo(x.dtype).tiny)).gather(
                1, label[..., None].expand(-1, -1, 3)
            )
            u = torch.where((island >= 0)[..., None], u, u.new_zeros(()))
            room = torch.maximum(room, largest(move - u[:, body]).clamp(max=surface.most_room))
            return islands(room)

    def _supported(self, lift: Tensor, x: Tensor, was: Tensor, listed: Pairs) -> Tensor:
        """The part of h^2 a that a body is free to go: what the forces of contact at the start of the step bear of
        its acceleration is taken away."""
        model, surface = self.model, self.surface
        assert surface is not None
        h2 = self.prepared.settings.numbers.time_step**2
        state = pair_lag(x, was, self.kappa, self.origin, listed)
        force, _, n, w = state.split((1, 1, 3, 4), -1)
        rows = (force * w)[..., None] * n[:, None]  # [pairs, 4, 3]
        points = x.shape[1] + was.shape[1]
        used = (listed.pairs[:, :1] >= 0).to(x.dtype)[..., None]
        index = (listed.pairs[:, 5:6].long() * points + listed.pairs[:, :4].long()).clamp(min=0)
        total = x.new_zeros((x.shape[0] * points, 3)).index_add(0, index.reshape(-1), (used * rows).reshape(-1, 3))
        total = total.reshape(x.shape[0], points, 3)[:, : x.shape[1]]
        if self.floor_data is not None and model.floor is not None:
            size, normal = model.floor.normal_force(x, self.floor_data, self.begun.origin)
            total = total + (size[..., None] * broadcast(normal[:, None], (*size.shape, 3))).sum(2)
        free = ~model._pinned
        body = surface.body[: x.shape[1]].long()
        mass = broadcast(self.fields.mass, x.shape[:2])
        columns = torch.cat([mass[..., None] * lift, h2 * total, mass[..., None]], -1)
        columns = torch.where(free[:, None], columns, torch.zeros_like(columns))
        sums = x.new_zeros((x.shape[0], surface.bodies, 7)).index_add(1, body, columns)
        whole = sums[..., 6:].clamp(min=torch.finfo(x.dtype).tiny)
        mean, borne = sums[..., :3] / whole, sums[..., 3:6] / whole
        square = (borne * borne).sum(-1, keepdim=True)
        share = (-(mean * borne).sum(-1, keepdim=True) / square.clamp(min=torch.finfo(x.dtype).tiny)).clamp(0, 1)
        pinned = x.new_zeros(surface.bodies).index_add(0, body, model._pinned.to(x.dtype)) > 0
        taken = torch.where(pinned[:, None], torch.zeros_like(borne), share * borne)
        return torch.where(free[:, None], lift + taken[:, body], lift)

    def _start(self, x: Tensor, move: Tensor, fall: Tensor, was: Tensor, now: Tensor, detection: Detection, room: Tensor
               ) -> PartStart:  # fmt: skip
        surface = self.surface
        assert surface is not None
        return start_between_planes(x, move, fall, self.fields.mass, was, now, self.floor_data, self.origin, detection,
                                    surface, room)  # fmt: skip

    def _look_for_intersections(self) -> None:
        """Distances do not show that surfaces pass through each other: debug_checks() compares edges with triangles."""
        surface = self.surface
        assert surface is not None
        absolute = self.x_prev if self.origin.numel() == 0 else self.x_prev + self.origin
        points = torch.cat([absolute, self.before], 1).detach().double().cpu()
        triangles, edges = surface.triangles.cpu(), surface.edges.cpu()
        for scene, at in enumerate(points):
            if not bool(torch.isfinite(at).all()):
                continue  # named elsewhere
            found = intersections(at, triangles, edges)
            if len(found):
                edge, triangle = found[0].tolist()
                raise ValueError(
                    f"x: expected surfaces that do not intersect, got {len(found)} edges through triangles, one of the "
                    f"corner points {surface.edges[edge].tolist()} and {surface.triangles[triangle].tolist()} in scene "
                    f"{scene}"
                )

    def _colliders_at(self, share: float) -> Tensor:
        if self.colliders is self.before:
            return self.before
        return self.before + share * (self.colliders - self.before)

    def _sweep(self, x: Tensor, center: Tensor, room: Tensor, collider: Tensor, listed: Pairs, settings: SweepSettings,
               policy: int, debug_step: int) -> tuple[Tensor, Tensor]:  # fmt: skip
        lagged, model = self.lagged, self.model
        fields = self.fields._replace(
            x_start=x, collider=collider, collider_prev=self.before, kappa=self.kappa,
            **listed._asdict(), lag=self.lag, lag_pairs=lagged.pairs, lag_ptr=lagged.ptr, lag_entry=lagged.entry,
            floor_lag=self.floor_lag, center=center, room=room,
        )  # fmt: skip
        return sweep(fields, model._packed_rest, model._plan, settings, tape_policy=policy, debug_step=debug_step)[:2]

    def _detect(self, x: Tensor, was: Tensor, now: Tensor, island: Tensor, room: Tensor) -> Detection:
        surface, barrier = self.surface, self.barrier
        assert surface is not None and barrier is not None
        with torch.no_grad():
            x, was, now = x.detach(), was.detach(), now.detach()
            *index, corners, values, counts, smallest = search.detect(
                x, self.origin, was, now, surface, barrier, self.capacity, room
            )
            lowest = island.new_empty((0,))
            if self.floor_data is not None:
                lowest = search.lowest(x, self.origin, self.floor_data.detach(), island, surface)
        detection = Detection(Pairs(*index), corners, values, counts, smallest, island, lowest)
        for found in recorders():
            found.append(detection)
        return detection

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
    return Pairs(none[:0].reshape(0, 6), like.new_zeros((0, 8)), none, none[:0])


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
