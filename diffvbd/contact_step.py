"""The executed step with contact: R times detection, bounds, start and sweeps (docs/method.md, section 12)."""

from __future__ import annotations

import weakref
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from . import detection as search
from .contact_sweeps import ContactTensors, Pairs, contact_sweep, pair_lag
from .model import Model
from .ops import SweepSettings, broadcast

if TYPE_CHECKING:
    from .arguments import Prepared
    from .step import Begun

GUARD_ULPS = 32  # of a position: gaps are not trusted to less
FREE = 1e15  # [m] radius of a bound that binds nothing


class Detection(NamedTuple):
    """One search: index data, and values that the step differentiates anew. Shapes: detection.detect."""

    listed: Pairs
    near_corners: Tensor
    near_values: Tensor
    counts: Tensor
    smallest: Tensor
    island: Tensor
    lowest: Tensor  # of a Model with a floor, else empty


class Outcome(NamedTuple):
    """What the latest step of a Model has met, on its device; read by diffvbd.contact.status."""

    counts: Tensor  # [R, 4] int64: pairs needed, touching pairs, 0, corner points moved above their bound
    capacity: int  # pairs of all scenes
    cut: Tensor  # [B, V] bool
    smallest: Tensor  # [R, B] [m]


outcomes: weakref.WeakKeyDictionary[Model, Outcome] = weakref.WeakKeyDictionary()
recorders: list[list[Detection]] = []  # of diffvbd.contact.record


def sweeps_of_parts(sweeps: int, parts: int) -> list[int]:
    """How K sweeps are spread over R parts: evenly, the first ones taking what is left."""
    return [sweeps // parts + (1 if r < sweeps % parts else 0) for r in range(parts)]


def project(x: Tensor, step: Tensor, center: Tensor, radius: Tensor) -> tuple[Tensor, Tensor]:
    """x + step, moved to the closest point of a ball where it leaves it, and where it did; twin of core/bounds.h.

    Args:
        x, step, center: [B, V, 3] [m].  radius: [B, V] [m].
    """
    m = x + step - center
    square = (m * m).sum(-1)
    outside = square.detach().sqrt() > radius.detach()
    length = torch.where(outside, square, torch.ones_like(square)).sqrt()
    return torch.where(outside[..., None], center + (radius / length)[..., None] * m, x + step), outside


class ContactStep:
    """What the parts of one step share."""

    def __init__(self, model: Model, begun: Begun, prepared: Prepared, before: Tensor, colliders: Tensor) -> None:
        self.model, self.begun, self.prepared = model, begun, prepared
        self.colliders, self.before = colliders, before  # [B, Vc, 3] at the end and at the start of the step
        self.tensors = begun.tensors(prepared)
        self.origin = self.tensors.origin
        self.surface, self.barrier = model.surface_of_contact, model.contact
        self.floor_data = None if model.floor is None else begun.data[:, : model.floor.count()]
        self.parts = 1 if self.barrier is None else self.barrier.detections
        like = begun.x_prev
        self.kappa = self._parameter("pair_barrier.kappa", like.new_zeros((1,)))
        self.lagged, self.lag = no_pairs(like, 0), like.new_zeros((0, 9))
        self.floor_lag = self._floor_lag()
        friction = model.friction
        self.friction_eps = prepared.settings.numbers[0] * friction.velocity if friction is not None else 1.0

    def _parameter(self, name: str, default: Tensor) -> Tensor:
        """A parameter [1 | B]."""
        if name in self.prepared.parameters:
            return self.prepared.parameters[name]
        energy, key = name.split(".")
        known = self.model._constants.get(energy)
        return default if known is None else known[key][None]

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
        scene = listed.pairs[:, 5].clamp(min=0).to(torch.int64)

        def of_pair(value: Tensor) -> Tensor:
            return broadcast(value[:, None], force.shape) if value.shape[0] == 1 else value[scene][:, None]

        zero = force.new_zeros((1,))
        coefficient = self._parameter("friction.coefficient", zero)
        damping = self._parameter("pair_barrier.damping", zero)
        self.lagged = listed
        self.lag = torch.cat([of_pair(coefficient) * force, of_pair(damping) * active, rest], -1)

    def run(self, policy: int, debug_step: int) -> Tensor:
        """Positions after all parts [B, V, 3]; raises where detection did not hold."""
        begun, settings, model = self.begun, self.prepared.settings, self.model
        x, held = begun.x_prev, begun.y - begun.x_prev
        remaining = held
        pinned = model.pinned[:, None]
        cut = torch.zeros(x.shape[:2], dtype=torch.bool, device=x.device)
        found: list[Detection] = []
        counts: list[Tensor] = []
        for r, sweeps in enumerate(sweeps_of_parts(settings.sweeps, self.parts)):
            done, then = r / self.parts, (r + 1) / self.parts
            moving = self.colliders is not self.before
            was = self.before + done * (self.colliders - self.before) if moving else self.before
            now = self.before + then * (self.colliders - self.before) if moving else self.before
            bounds, listed = self._free(x), no_pairs(x, x.shape[0] * x.shape[1])
            if self.barrier is not None:
                detection = self._detect(x, was, now, remaining)
                found.append(detection)
                listed = detection.listed
                if r == 0:
                    self._set_lag(listed, was)
                bounds, above = self._bounds(x, was, now, remaining, detection, held / self.parts)
                counts.append(torch.cat([detection.counts[:3], above]))
            center, radius = bounds[..., :3], bounds[..., 3]
            target, outside = project(x, remaining, center, radius)
            if model.floor is not None and self.floor_data is not None:
                # from the center: with it and the target, all between them lies inside the bound
                target = model.floor.filter(center, target - center, self.floor_data, begun.origin)
            target = torch.where(pinned, begun.x_prev + then * held, target)
            cut |= outside & ~model.pinned
            remaining = remaining - (target - x)
            x = target
            if sweeps:
                part = settings._replace(sweeps=sweeps)
                x, held_back = self._sweep(x, bounds, now, listed, part, policy, debug_step)
                cut |= held_back.bool()
        if self.barrier is not None:
            x = self._judged(x, found, torch.stack(counts), cut)
        return x

    def _free(self, x: Tensor) -> Tensor:
        return torch.cat([x, torch.full_like(x[..., :1], FREE)], -1)

    def _sweep(self, x: Tensor, bounds: Tensor, collider: Tensor, listed: Pairs, settings: SweepSettings, policy: int,
               debug_step: int) -> tuple[Tensor, Tensor]:  # fmt: skip
        tensors = self.tensors._replace(x_start=x)
        contact = ContactTensors(bounds, collider, self.before, self.kappa, self.lag, self.floor_lag)
        return contact_sweep(tensors, contact, listed, self.lagged, self.friction_eps, self.model._packed_rest,
                             self.model._plan, settings, tape_policy=policy, debug_step=debug_step)  # fmt: skip

    def _detect(self, x: Tensor, was: Tensor, now: Tensor, remaining: Tensor) -> Detection:
        surface, barrier = self.surface, self.barrier
        assert surface is not None and barrier is not None
        with torch.no_grad():
            x, was, now = x.detach(), was.detach(), now.detach()
            capacity = surface.capacity * x.shape[0]
            *index, corners, values, counts, smallest = search.detect(
                x, self.origin, was, now, surface, barrier, capacity
            )
            island = search.islands(
                x, self.origin, remaining.detach(), self.tensors.mass.detach(), was, now, surface, barrier.dhat
            )
            lowest = island.new_empty((0,))
            if self.floor_data is not None:
                lowest = search.lowest(x, self.origin, self.floor_data.detach(), island, surface)
        detection = Detection(Pairs(*index), corners, values, counts, smallest, island, lowest)
        for record in recorders:
            record.append(detection)
        return detection

    def _bounds(self, x: Tensor, was: Tensor, now: Tensor, remaining: Tensor, detection: Detection, held: Tensor
                ) -> tuple[Tensor, Tensor]:  # fmt: skip
        """Center and radius of every vertex's bound [B, V, 4]; how many corner points were moved above theirs, [1]."""
        surface, barrier = self.surface, self.barrier
        assert surface is not None and barrier is not None
        gap = self._near_gap(x, was, now, detection)
        with torch.no_grad():
            absolute = x if self.origin.numel() == 0 else x + self.origin
            absolute = torch.cat([absolute, was], 1).abs().sum(-1)
            guard = GUARD_ULPS * torch.finfo(x.dtype).eps * absolute
        radius = (barrier.gamma * (gap - guard).clamp(min=0)).clamp(max=surface.cap)
        floor = None
        if self.floor_data is not None:
            floor = search.Floor(self.floor_data, detection.lowest.to(torch.int64))
        center = x + search.island_translation(remaining, self.tensors.mass, detection.island, surface, x, self.origin,
                                               floor)  # fmt: skip
        with torch.no_grad():
            moves = torch.cat([held, now - was], 1).square().sum(-1).sqrt()
            above = (moves > radius) & surface.held & ~surface.plane_points
        return torch.cat([center, radius[:, : x.shape[1], None]], -1), above.sum().reshape(1)

    def _near_gap(self, x: Tensor, was: Tensor, now: Tensor, detection: Detection) -> Tensor:
        """Smallest gap of each corner point [B, N]. By the envelope theorem its derivative is that of the distance with
        weights and normal held, so that the value can stay the one detection found."""
        values = detection.near_values
        gap = values[..., 7]
        if not (torch.is_grad_enabled() and any(t.requires_grad for t in (x, was, now))):
            return gap
        surface = self.surface
        assert surface is not None
        where = torch.where(surface.plane_points[x.shape[1] :, None], now, was)
        points = torch.cat([x, where], 1)
        scene = torch.arange(x.shape[0], device=x.device)[:, None, None]
        corners = points[scene, detection.near_corners[..., :4].to(torch.int64)]
        along = (values[..., :4, None] * values[..., None, 4:7] * corners).sum((-2, -1))
        return gap + (along - along.detach())

    def _judged(self, x: Tensor, found: list[Detection], counts: Tensor, cut: Tensor) -> Tensor:
        surface = self.surface
        assert surface is not None
        capacity = surface.capacity * x.shape[0]
        smallest = torch.stack([d.smallest for d in found])
        outcomes[self.model] = Outcome(counts, capacity, cut, smallest)
        if torch.compiler.is_compiling() or (x.is_cuda and torch.cuda.is_current_stream_capturing()):
            good = (counts[:, 0] <= capacity).all() & (counts[:, 1] == 0).all() & (counts[:, 3] == 0).all()
            return torch.where(good, x, torch.full_like(x, torch.nan))
        for r, (needed, touching, pair, above) in enumerate(counts.tolist()):
            if needed > capacity:
                each = -(-needed // x.shape[0])
                raise RuntimeError(
                    f"pair_barrier.capacity: {needed} pairs in part {r} of the step do not fit {capacity} "
                    f"({surface.capacity} per scene): use diffvbd.contact.reserve(model, {2 * each})"
                )
            if touching:
                raise ValueError(
                    f"x: expected surfaces that do not touch, got {touching} pairs without a gap in part {r} of the "
                    f"step, {self._described(found[r], pair)}"
                )
            if above:
                raise ValueError(
                    f"prescribed or colliders: expected motion below the bounds of contact, got {above} points moved "
                    f"farther in part {r} of {self.parts}: use a smaller time_step or more detections"
                )
        return x

    def _described(self, detection: Detection, _: int) -> str:
        """The corner points of a pair without a gap, for an error."""
        bad = ~(detection.near_values[..., 7] > 0)
        where = bad.nonzero()
        if where.numel() == 0:
            return "too many to name"
        scene, point = where[0].tolist()
        return f"one at corners {detection.near_corners[scene, point, :4].tolist()} of scene {scene}"


def no_pairs(like: Tensor, corners: int) -> Pairs:
    """An empty list for so many corner points of all scenes."""
    none = torch.zeros((corners + 1,), dtype=torch.int32, device=like.device)
    return Pairs(none[:0].reshape(0, 6), like.new_zeros((0, 3)), none, none[:0])


def run_contact(model: Model, begun: Begun, prepared: Prepared, before: Tensor, colliders: Tensor, policy: int,
                debug_step: int) -> Tensor:  # fmt: skip
    """Positions after the sweeps of a step with contact; colliders [B, Vc, 3] at its start and at its end [m]."""
    return ContactStep(model, begun, prepared, before, colliders).run(policy, debug_step)
