"""One step with contact between bodies, in plain torch: barrier, damping and friction of pairs, bounds on the motion.

Which pairs touch, which pair is nearest to a vertex and which bodies move together are index data that a detection
found (`Part`); everything that follows from them is computed here from positions and differentiated by autograd.
Sources: Li et al. 2020 (barrier, mollifier, friction), Chen et al. 2025 (bounds of offset geometric contact).
"""

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from .distance import EDGE_EDGE, distance, log_barrier, mollifier, with_gradient
from .energies import FloorBarrier, build_energies
from .friction import floor_friction, smoothed, tangential6
from .layout import build_layout, dot, outer6, take
from .scene import Scene, build_scene
from .sweep import check_start, color_masses, predictor, run_sweeps, started

GUARD = 32  # ulps of a vertex's coordinates that are taken off its gap before it becomes a bound


class Part(NamedTuple):
    """One detection: indices without gradient, of B scenes with N corner points, mesh vertices before colliders."""

    pairs: Tensor  # [Q, 6] int64: four corners, kind, scene
    constants: Tensor  # [Q, 3]: dhat of the pair [m], sum of radii [m], threshold of the mollifier [m^4]
    near_corners: Tensor  # [B, N, 5] int64: four corners and kind of the nearest pair of a corner point; -1: none
    island: Tensor  # [B, bodies] int64: label of the island of a body; -1: it is not translated
    lowest: Tensor | None = None  # [B, bodies, planes] int64: lowest vertex of a body's island above each floor plane


class Pairs:
    """The listed pairs of a part, and for each color the (pair, local corner) of its vertices, sorted by pair.

    order: permutation [Q] of the pairs, which changes only the order of summation.
    """

    def __init__(self, scene: Scene, part: Part, order: Tensor | None) -> None:
        order = torch.arange(len(part.pairs), device=part.pairs.device) if order is None else order
        rows, constants = part.pairs[order], scene.tensor(part.constants)[order]
        self.corners, self.kind, self.batch = rows[:, :4], rows[:, 4], rows[:, 5]
        self.dhat, self.offset, self.threshold = constants.unbind(1)
        self.lead = scene.like.shape[:-2]
        self.points = scene.rest_points.shape[-1] + scene.model.collider_points.shape[-2]
        self.sizes = [len(color.vertices) for color in scene.layout.colors]
        self.entries = [self._entries(color.vertices) for color in scene.layout.colors]

    def _entries(self, vertices: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Pair and local corner of each entry of a color, and the column of its vertex among those of all scenes."""
        position = vertices.new_full((self.points,), -1)
        position[vertices] = torch.arange(len(vertices), device=vertices.device)
        owner = position[self.corners]
        pair, local = (owner >= 0).nonzero(as_tuple=True)
        return pair, local, self.batch[pair] * len(vertices) + owner[pair, local]

    def per_pair(self, value: Tensor) -> Tensor:
        """A parameter, one number or one for each scene, as one for each pair."""
        return value.expand(self.lead).reshape(-1)[self.batch]

    def positions(self, points: Tensor, pairs: Tensor) -> Tensor:
        """Corners [n, 4, 3] of some pairs in corner points [B, N, 3]."""
        return points[self.batch[pairs, None], self.corners[pairs]]

    def measures(self, points: Tensor, pairs: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Gap [n] and mollifier [n] of some pairs, each followed by its gradient [n, 4, 3] toward the corners."""
        corners, kind = self.positions(points, pairs), self.kind[pairs]
        d, slope = with_gradient(partial(distance, kind), corners)
        e, turn = with_gradient(partial(mollifier, kind, threshold=self.threshold[pairs]), corners)
        return d - self.offset[pairs], slope, e, turn

    def assemble(self, k: int, columns: Tensor) -> Tensor:
        """Sums columns [9, entries] of color k over the entries of each vertex: [..., 9, n]."""
        (_, _, owner), scenes, n = self.entries[k], self.lead.numel(), self.sizes[k]
        total = columns.new_zeros(9, scenes * n).index_add(1, owner, columns)
        return total.reshape(9, scenes, n).movedim(0, 1).reshape(*self.lead, 9, n)

    def total(self, values: Tensor) -> Tensor:
        """Sums of values [Q] over the pairs of each scene, [...]."""
        return values.new_zeros(self.lead.numel()).index_add(0, self.batch, values).reshape(self.lead)


def corner_points(x: Tensor, colliders: Tensor) -> Tensor:
    """Positions [B, N, 3] of all corner points from a state [..., 3, V] and colliders [B, Vc, 3]."""
    return torch.cat((x.transpose(-1, -2).reshape(len(colliders), -1, 3), colliders), 1)


class PairBarrier:
    """e b(d - offset) over the pairs of a part; the block drops b' Hess d and the curvature of the mollifier e."""

    def __init__(self, scene: Scene, pairs: Pairs, colliders: Tensor) -> None:
        self.weight, self.pairs, self.colliders = scene.time_step**2, pairs, colliders
        self.kappa = pairs.per_pair(scene.parameter("pair_barrier", scene.model.contact, "kappa"))

    def block(self, k: int, x: Tensor, x_prev: Tensor) -> Tensor:
        pair, local, _ = self.pairs.entries[k]
        gap, slope, e, turn = self.pairs.measures(corner_points(x, self.colliders), pair)
        slope, turn = (g[torch.arange(len(pair), device=pair.device), local].T for g in (slope, turn))
        b, first, second = log_barrier(gap, self.kappa[pair], self.pairs.dhat[pair])
        columns = torch.cat((e * first * slope + b * turn, e * second * outer6(slope)))
        return self.pairs.assemble(k, self.weight * columns)

    def energy(self, x: Tensor, x_prev: Tensor) -> Tensor:
        p = self.pairs
        corners = p.positions(corner_points(x, self.colliders), torch.arange(len(p.kind), device=x.device))
        gap = distance(p.kind, corners) - p.offset
        b, _, _ = log_barrier(gap, self.kappa, p.dhat)
        return self.weight * p.total(torch.where(gap > 0, mollifier(p.kind, corners, p.threshold) * b, torch.inf))


class LaggedPairForces:
    """Damping of approach and friction of pairs, with gap, normal, weights and force of the start of the step.

    start: corner points at the start of the step [B, N, 3]; colliders: where they are now [B, Vc, 3].
    """

    def __init__(self, scene: Scene, pairs: Pairs, start: Tensor, colliders: Tensor) -> None:
        model = scene.model
        self.h, self.pairs, self.start, self.colliders = scene.time_step, pairs, start, colliders
        gap, self.slope, e, _ = pairs.measures(start, torch.arange(len(pairs.kind), device=start.device))
        # Weights of the first primitive sum to 1, so the gradients w_k n of its corners sum to the normal.
        both = (pairs.kind == EDGE_EDGE)[:, None]
        self.normal = self.slope[:, 0] + torch.where(both, self.slope[:, 1], 0.0)
        self.near = gap < pairs.dhat
        self.damping = pairs.per_pair(scene.parameter("pair_barrier", model.contact, "damping"))
        kappa = pairs.per_pair(scene.parameter("pair_barrier", model.contact, "kappa"))
        _, first, _ = log_barrier(gap, kappa, pairs.dhat)
        friction = getattr(model, "friction", None)
        self.largest, self.reach = None, 0.0  # mu_f lambda [N], and the slip [m] from which friction is that large
        if friction is not None:
            self.largest = -pairs.per_pair(scene.parameter("friction", friction, "coefficient")) * e * first
            self.reach = scene.time_step * friction.velocity

    def _travel(self, x: Tensor, pair: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Approach n.m [n] where it is damped (else 0), slip u [3, n] and weights [n, 4] of some pairs."""
        slope, normal = self.slope[pair], self.normal[pair]
        weights = (slope * normal[:, None]).sum(-1)
        moved = self.pairs.positions(corner_points(x, self.colliders) - self.start, pair)
        m = (weights[..., None] * moved).sum(1)
        along = (normal * m).sum(-1)
        damped = self.near[pair] & (along < 0)
        return torch.where(damped, along, 0.0), (m - along[:, None] * normal).T, weights

    def block(self, k: int, x: Tensor, x_prev: Tensor) -> Tensor:
        pair, local, _ = self.pairs.entries[k]
        entry = torch.arange(len(pair), device=pair.device)
        along, slip, weights = self._travel(x, pair)
        own = self.slope[pair, local].T
        rate = self.h * self.damping[pair]
        columns = torch.cat((rate * along * own, torch.where(self.near[pair], rate, 0.0) * outer6(own)))
        if self.largest is not None:
            weight = weights[entry, local]
            size = self.h**2 * self.largest[pair] * smoothed(slip, self.reach)[1]
            friction = torch.cat((slip, weight * tangential6(self.normal[pair].T)))
            columns = columns + size * weight * friction
        return self.pairs.assemble(k, columns)

    def energy(self, x: Tensor, x_prev: Tensor) -> Tensor:
        along, slip, _ = self._travel(x, torch.arange(len(self.near), device=x.device))
        total = self.h * self.damping / 2 * along**2
        if self.largest is not None:
            total = total + self.h**2 * self.largest * smoothed(slip, self.reach)[0]
        return self.pairs.total(total)


class Bounds:
    """|x_i - center_i| <= b_i for all vertices from one detection to the next, [..., 3, V] and [..., V].

    x: state at the detection; wanted: where each vertex wants to go from there, both [..., 3, V]; colliders
    [B, Vc, 3] as the detection saw them.
    """

    def __init__(
        self, scene: Scene, part: Part, x: Tensor, wanted: Tensor, colliders: Tensor, floor: FloorBarrier | None = None
    ) -> None:
        points = corner_points(x, colliders)
        x_rows = points[:, : x.shape[-1]]
        bound = self._bound(scene.model, part, points, x_rows)
        self.radius = bound.reshape(x.shape[:-2] + bound.shape[-1:])
        rows = wanted.transpose(-1, -2).reshape(x_rows.shape)
        u = self._translation(scene, part, rows).transpose(-1, -2).reshape(x.shape)
        if floor is not None and part.lowest is not None:
            u = self._above(floor, u, x, part.lowest[:, scene.model.body].reshape(*x.shape[:-2], x.shape[-1], -1))
        self.center = x + u

    @staticmethod
    def _bound(model: Any, part: Part, points: Tensor, x: Tensor) -> Tensor:
        """b [B, V] from the gap of the nearest pair of each vertex."""
        reach, cap, gamma = model.contact_numbers
        near = part.near_corners[:, : x.shape[1]]
        scene, vertex = (near[..., 4] >= 0).nonzero(as_tuple=True)
        corners, kind = near[scene, vertex, :4], near[scene, vertex, 4]
        radius = model.surface_of_contact.radius.to(x)
        second = torch.where(kind == EDGE_EDGE, corners[:, 2], corners[:, 1])  # first corner of the second primitive
        gap = distance(kind, points[scene[:, None], corners]) - (radius[corners[:, 0]] + radius[second])
        gap = points.new_full(x.shape[:2], reach).index_put((scene, vertex), gap)
        guard = GUARD * torch.finfo(x.dtype).eps * x.detach().abs().sum(-1)
        return (gamma * (gap - guard).clamp(min=0)).clamp(max=cap)

    @staticmethod
    def _translation(scene: Scene, part: Part, wanted: Tensor) -> Tensor:
        """u [B, V, 3]: mean of `wanted` [B, V, 3], weighted by mass, over the vertices of a vertex's island."""
        model = scene.model
        label = part.island[:, model.body]
        moves = label >= 0
        label = label.clamp(min=0)
        mass = scene.mass.expand(scene.like.shape[:-1]).reshape(label.shape)
        mass = torch.where(model.pinned, 0.0, mass)
        columns = torch.cat((mass[..., None] * wanted, mass[..., None]), -1)
        index = label[..., None].expand_as(columns)
        sums = columns.new_zeros(len(label), part.island.shape[1], 4).scatter_add(1, index, columns).gather(1, index)
        total = torch.where(moves, sums[..., 3], 1.0)
        return torch.where(moves[..., None], sums[..., :3] / total[..., None], 0.0)

    @staticmethod
    def _above(floor: FloorBarrier, u: Tensor, x: Tensor, lowest: Tensor) -> Tensor:
        """u [..., 3, V], down at most until the lowest vertex [..., V, planes] comes within dhat of a plane."""
        lead, count = x.shape[:-2], x.shape[-1]
        gap = floor.gap(x)  # [..., planes, V]
        room = (gap.gather(-1, lowest.transpose(-1, -2)) - floor.dhat).clamp(min=0)
        normal = floor.normal.expand(*lead, *floor.normal.shape[-3:]).expand(*lead, -1, 3, count)
        slack = 8 * torch.finfo(x.dtype).eps * dot(u, u).detach().sqrt().unsqueeze(-2)
        for plane in range(room.shape[-2]):
            n = normal[..., plane, :, :]
            u = u + (-dot(n, u) - room[..., plane, :]).clamp(min=0).unsqueeze(-2) * n
        down = -dot(normal, u.unsqueeze(-3))
        safe = (down <= room * (1 + 1e-6) + slack).all(-2)
        return torch.where(safe.unsqueeze(-2), u, 0.0)

    def cut(self, x: Tensor, step: Tensor, vertices: Tensor) -> Tensor:
        """The step [..., 3, n] of some vertices from x [..., 3, n], ended at the closest point of the bound's ball."""
        center, radius = take(self.center, vertices), take(self.radius.unsqueeze(-2), vertices).squeeze(-2)
        offset = x + step - center
        square = dot(offset, offset)
        moves = square > 0
        length = torch.where(moves, square, 1.0).sqrt()
        outside = moves & (length > radius)
        return torch.where(outside.unsqueeze(-2), (center - x) + (radius / length).unsqueeze(-2) * offset, step)


def contact_step(
    model: Any,
    x: Tensor,
    v: Tensor,
    *,
    mu: Any,
    lam: Any,
    time_step: float,
    sweeps: int,
    parts: Sequence[Part],
    force: Tensor | None = None,
    gravity: Any = (0.0, -9.81, 0.0),
    prescribed: Tensor | None = None,
    rest_points: Tensor | None = None,
    density: Any = None,
    parameters: dict[str, Any] | None = None,
    colliders: Tensor | None = None,
    colliders_before: Tensor | None = None,
    order: Sequence[Tensor] | None = None,
    tet_order: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """One time step of a model with `model.contact`; every tensor argument is differentiable by autograd.

    Arguments of `step`, and: parts, one for each of the `model.contact.detections` detections, scenes counted in
    row-major order of x's leading dimensions; colliders and colliders_before: positions [..., Vc, 3] [m] of collider
    points at the end and at the start of the step, by default `model.collider_points` and `colliders`; order: one
    permutation of the pairs for each part, tet_order one of the tets: they change only the order of summation.
    parameters may hold "pair_barrier.kappa" [N/m], "pair_barrier.damping" [N s/m] and "friction.coefficient".
    Raises ValueError when an unpinned vertex starts below a floor plane, or when parts or order have another length.
    Returns (x', v').
    """
    count = model.contact.detections
    for name, value in (("parts", parts), ("order", order)):
        if value is not None and len(value) != count:
            raise ValueError(f"{name}: expected one for each of {count} detections, got {len(value)}")
    scene = build_scene(
        model,
        build_layout(model, tet_order),
        x,
        mu=mu,
        lam=lam,
        time_step=time_step,
        rest_points=rest_points,
        density=density,
        parameters=parameters,
    )
    energies = build_energies(scene, elsewhere=("pair_barrier", "friction"))
    energies += floor_friction(scene, energies)
    floor = next((energy for energy in energies if isinstance(energy, FloorBarrier)), None)
    masses = color_masses(scene)
    end = _collider_rows(scene, model.collider_points if colliders is None else colliders)
    begin = end if colliders_before is None else _collider_rows(scene, colliders_before)
    planes = model.plane_points.unsqueeze(-1)
    listed = [Pairs(scene, part, None if order is None else order[r]) for r, part in enumerate(parts)]

    y = predictor(scene, x, v, force, gravity, prescribed).transpose(-1, -2)
    x_prev = x.transpose(-1, -2)
    check_start(energies, x_prev)
    start = corner_points(x_prev, begin)
    every = torch.arange(x.shape[-2], device=x.device)
    state, wanted = x_prev, y - x_prev
    for r, part in enumerate(parts):
        before, now = (begin + (n / count) * (end - begin) for n in (r, r + 1))
        bounds = Bounds(scene, part, state, wanted, torch.where(planes, now, before), floor)
        target = state + bounds.cut(state, wanted, every)
        moved = target
        if floor is not None:  # from the center: all between it and the target lies in the ball
            moved = bounds.center + started(energies, bounds.center, target - bounds.center)
        moved = torch.where(model.pinned, x_prev + ((r + 1) / count) * (y - x_prev), moved)
        wanted = wanted - (moved - state)
        forces = [PairBarrier(scene, listed[r], now), LaggedPairForces(scene, listed[0], start, now)]
        number = sweeps // count + (1 if r < sweeps % count else 0)
        state = run_sweeps(scene, [*energies, *forces], masses, y, moved, x_prev, number, bounds.cut)
    x_new = state.transpose(-1, -2).contiguous()
    return x_new, (x_new - x) / time_step


def _collider_rows(scene: Scene, points: Any) -> Tensor:
    """Collider points of every scene, [B, Vc, 3]."""
    points, lead = scene.tensor(points), scene.like.shape[:-2]
    return points.expand(*lead, *points.shape[-2:]).reshape(lead.numel(), *points.shape[-2:])
