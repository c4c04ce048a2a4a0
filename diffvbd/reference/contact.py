"""One step with contact between bodies, in plain torch: barrier, damping and friction of pairs, starts, limits, rigid
corrections.

Pairs, islands and decisions of a step are data (`Substep`). The rest is computed here from positions and differentiated
by autograd.
Source: Li et al. 2020 (barrier, mollifier, friction), 2023 (counts of faces).
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from .coarse import Coarse
from .couplings import Bounds, energies_of_sweeps
from .distance import EDGE_EDGE, POINT_TRIANGLE, distance, log_barrier, weight, with_gradient
from .energies import FADE, floor_friction, smoothed, tangential6
from .rigid_contact import Correction
from .scene import Scene, build_layout, build_scene, outer6
from .sweep import check_start, color_masses, executed, predictor, run_sweeps


class Substep(NamedTuple):
    """One detection and the decisions of its substep: data without gradient, of B scenes with N corner points, mesh
    vertices before colliders."""

    pairs: Tensor  # [Q, 6] int64: four corners, kind, scene
    constants: Tensor  # [Q, 3 or more]: dhat of the pair [m], sum of radii [m], measure (distance.weight)
    u: Tensor  # [B, bodies, 3]: translation of each body's island
    fractions: Tensor  # [B, V]: step fraction of each vertex at the start
    truncated: Tensor  # bool [B, V]: vertices whose displacement goes on in the next substep
    # [corrections, B, bodies, 2]: of the rigid ones, step fraction, and the island whose common shift is taken or -1
    corrections: Tensor
    limits: Tensor | None = None  # [K, B, V]: step fraction of each update
    lengths: Tensor | None = None  # [corrections, B, bodies of the coarse space]: of coarse corrections
    sweeps: int | None = None  # None: an even part of those of the step
    going: Tensor | None = None  # bool [B, 1, 1]: scenes that it is for; None: all
    resting: Tensor | None = None  # bool [B, V]: vertices that begin without their gravity move; None: none


class Pairs:
    """The listed pairs of a substep, and for each color the (pair, local corner) of its vertices, sorted by pair.

    order: permutation [Q] of the pairs, which changes only the order of summation.
    """

    def __init__(self, scene: Scene, substep: Substep, order: Tensor | None) -> None:
        order = torch.arange(len(substep.pairs), device=substep.pairs.device) if order is None else order
        rows, constants = substep.pairs[order], scene.tensor(substep.constants)[order]
        self.corners, self.kind, self.batch = rows[:, :4], rows[:, 4], rows[:, 5]
        self.dhat, self.offset, self.measure = constants[:, :3].unbind(1)
        self.lead = scene.like.shape[:-2]
        self.points = scene.rest_points.shape[-1] + scene.model.collider_points.shape[-2]
        self.sizes = [len(color.vertices) for color in scene.layout.colors]
        self.entries = [self._entries(color.vertices) for color in scene.layout.colors]

    def _entries(self, vertices: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Of each entry of a color: pair, local corner, the column of its vertex among those of all scenes, and how
        many corners of the pair are of the color."""
        position = vertices.new_full((self.points,), -1)
        position[vertices] = torch.arange(len(vertices), device=vertices.device)
        owner = position[self.corners]
        repeated = self.corners == self.corners.roll(1, 1)  # of faces that are edges or vertices
        pair, local = (owner >= 0).nonzero(as_tuple=True)
        together = ((owner >= 0) & ~repeated).sum(1)[pair]
        return pair, local, self.batch[pair] * len(vertices) + owner[pair, local], together

    def per_pair(self, value: Tensor) -> Tensor:
        """A parameter, one number or one for each scene, as one for each pair."""
        return value.expand(self.lead).reshape(-1)[self.batch]

    def of_two(self, value: Tensor, model: Any) -> Tensor:
        """Friction of each two bodies [..., n, n], or as of per_pair(), for each pair."""
        if not isinstance(model.friction.coefficient, Tensor):
            return self.per_pair(value)
        a, b = (model.surface_of_contact.body.long()[self.corners[:, k]] for k in (0, 3))
        table = value.expand(*self.lead, *value.shape[-2:]).reshape(-1, *value.shape[-2:])
        return (table[self.batch, a, b] + table[self.batch, b, a]) / 2

    def positions(self, points: Tensor, pairs: Tensor) -> Tensor:
        """Corners [n, 4, 3] of some pairs in corner points [B, N, 3]."""
        return points[self.batch[pairs, None], self.corners[pairs]]

    def measures(self, points: Tensor, pairs: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Gap [n] and weight [n] of some pairs, each followed by its gradient [n, 4, 3] toward the corners."""
        corners, kind = self.positions(points, pairs), self.kind[pairs]
        d, slope = with_gradient(partial(distance, kind), corners)
        e, turn = with_gradient(partial(weight, kind, dhat=self.dhat[pairs], measure=self.measure[pairs]), corners)
        return d - self.offset[pairs], slope, e, turn

    def assemble(self, k: int, columns: Tensor) -> Tensor:
        """Sums columns [9, entries] of color k over the entries of each vertex: [..., 9, n]."""
        (_, _, owner, _), scenes, n = self.entries[k], self.lead.numel(), self.sizes[k]
        total = columns.new_zeros(9, scenes * n).index_add(1, owner, columns)
        return total.reshape(9, scenes, n).movedim(0, 1).reshape(*self.lead, 9, n)

    def total(self, values: Tensor) -> Tensor:
        """Sums of values [Q] over the pairs of each scene, [...]."""
        return values.new_zeros(self.lead.numel()).index_add(0, self.batch, values).reshape(self.lead)


class PairBarrier:
    """e b(d - offset) over the pairs of a substep.

    With E = e b and its gradient F, the block is e b'' n n' of a point and a face, and where e < 0 a bound of
    e b' Hess d; of two edges F F' / E + e (b'' - 2/3 b'^2 / b) n n'. It takes the stiffness of a pair once for each of
    its corners of the color: they move at once.
    """

    def __init__(self, scene: Scene, pairs: Pairs, colliders: Tensor) -> None:
        self.weight, self.pairs, self.colliders = scene.time_step**2, pairs, colliders
        self.kappa = pairs.per_pair(scene.parameter(scene.model.contact, "kappa"))

    def block(self, k: int, x: Tensor, x_prev: Tensor) -> Tensor:
        pair, local, _, together = self.pairs.entries[k]
        gap, slope, e, turn = self.pairs.measures(corner_points(x, self.colliders), pair)
        slope, turn = (g[torch.arange(len(pair), device=pair.device), local].T for g in (slope, turn))
        b, first, second = log_barrier(gap, self.kappa[pair], self.pairs.dhat[pair])
        force, unit = e * first * slope + b * turn, outer6(slope)
        edges = (self.pairs.kind[pair] == EDGE_EDGE) & (self.weight * e * b > torch.finfo(torch.float32).tiny)
        value, height = torch.where(edges, e * b, 1.0), torch.where(edges, b, 1.0)
        stiffness = e * (second - torch.where(edges, 2 / 3 * first**2 / height, 0.0)) * unit
        stiffness = stiffness + torch.where(edges, outer6(force) / value, 0.0)
        across = torch.where(e < 0, e * first / (gap + self.pairs.offset[pair]), 0.0)
        size = slope.square().sum(0)
        whole = outer6(torch.eye(3).to(slope)).sum(-1, True)
        stiffness = stiffness + across * (size * whole - unit)
        columns = torch.cat((force, together * stiffness))
        return self.pairs.assemble(k, self.weight * columns)

    counts_negative = True  # where faces are edges: blocks may be indefinite
    turns_its_body = False  # by pairs of one body; friction acts along a gap, at an arm of it, and does

    def on_corners(self, x: Tensor, majorizes: bool = False) -> tuple[Tensor, Tensor]:
        """Of the rigid correction: forces on the corners [Q, 4, 3] and what their updates add [Q, 4, 4, 3, 3]."""
        p = self.pairs
        gap, slope, e, turn = p.measures(corner_points(x, self.colliders), torch.arange(len(p.kind), device=x.device))
        b, first, second = log_barrier(gap, self.kappa, p.dhat)
        b = self.weight * b
        across = slope[:, :, None, :, None] * slope[:, None, :, None, :]
        first, second = self.weight * e * first, self.weight * e * second
        force = first[:, None, None] * slope + b[:, None, None] * turn
        return force, second[:, None, None, None, None] * across

    def energy(self, x: Tensor, x_prev: Tensor) -> Tensor:
        p = self.pairs
        corners = p.positions(corner_points(x, self.colliders), torch.arange(len(p.kind), device=x.device))
        gap = distance(p.kind, corners) - p.offset
        b, _, _ = log_barrier(gap, self.kappa, p.dhat)
        return self.weight * p.total(torch.where(gap > 0, weight(p.kind, corners, p.dhat, p.measure) * b, torch.inf))


def loads(force: Tensor, corners: Tensor, kind: Tensor, scene: Tensor, body: Tensor) -> Tensor:
    """Normal force that friction and damping of each pair have [Q] [N]: of the faces of another body near a point the
    one that presses it most has the forces of all of them, and the others none. Other pairs have their own.

    Args:
        force, kind, scene: [Q] of each pair.  corners: [Q, 4] corner points.  body: [N] of the corner points.
    """
    point, face, rows = corners[:, 0], body[corners[:, 1]], torch.arange(len(force), device=force.device)
    alone = (kind != POINT_TRIANGLE) | (body[point] == face)
    key = torch.stack([scene, point, face, torch.where(alone, rows, -1)], 1)
    groups, group = torch.unique(key, dim=0, return_inverse=True)
    total, size = force.new_zeros(len(groups)).index_add(0, group, force), force.detach()
    most = torch.full_like(total, -torch.inf).detach().scatter_reduce(0, group, size, "amax")
    bearers = torch.where(size == most[group], rows, len(rows))
    bearer = rows.new_full((len(groups),), len(rows)).scatter_reduce(0, group, bearers, "amin")
    return torch.where(bearer[group] == rows, total[group].clamp(min=0), 0.0)


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
        kappa = pairs.per_pair(scene.parameter(model.contact, "kappa"))
        _, first, _ = log_barrier(gap, kappa, pairs.dhat)
        force = loads(-e * first, pairs.corners, pairs.kind, pairs.batch, model.surface_of_contact.body.long())
        whole = force + FADE * kappa * pairs.dhat
        fraction = torch.where(whole > 0, force / torch.where(whole > 0, whole, 1.0), 0.0)
        self.damping = fraction * pairs.per_pair(scene.parameter(model.contact, "damping"))
        friction = getattr(model, "friction", None)
        self.largest, self.reach = None, 0.0  # mu_f lambda [N], and the slip [m] from which friction is that large
        if friction is not None:
            self.largest = pairs.of_two(scene.parameter(friction, "coefficient"), model) * force
            self.reach = scene.time_step * friction.velocity

    def _travel(self, x: Tensor, pair: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Approach n.m [n], which is damped (else 0), tangential motion u [3, n] and weights [n, 4] of some pairs."""
        slope, normal = self.slope[pair], self.normal[pair]
        weights = (slope * normal[:, None]).sum(-1)
        moved = self.pairs.positions(corner_points(x, self.colliders) - self.start, pair)
        m = (weights[..., None] * moved).sum(1)
        along = (normal * m).sum(-1)
        return along.clamp(max=0.0), (m - along[:, None] * normal).T, weights

    def block(self, k: int, x: Tensor, x_prev: Tensor) -> Tensor:
        pair, local, _, together = self.pairs.entries[k]
        entry = torch.arange(len(pair), device=pair.device)
        along, slip, weights = self._travel(x, pair)
        own = self.slope[pair, local].T
        rate = self.h * self.damping[pair]
        columns = torch.cat((rate * along * own, together * rate * outer6(own)))
        if self.largest is not None:
            weight = weights[entry, local]
            size = self.h**2 * self.largest[pair] * smoothed(slip, self.reach)[1]
            friction = torch.cat((slip, weight * tangential6(self.normal[pair].T)))
            columns = columns + size * weight * friction
        return self.pairs.assemble(k, columns)

    turns_its_body = True

    def on_corners(self, x: Tensor, majorizes: bool = False) -> tuple[Tensor, Tensor]:
        """As those of the barrier, of friction exactly or, where it majorizes, with the stiffness of a block."""
        along, slip, weights = self._travel(x, torch.arange(len(self.normal), device=x.device))
        rate, n = self.h * self.damping, self.normal
        force, outer = (rate * along)[:, None] * n, n[:, :, None] * n[:, None]
        stiffness = rate[:, None, None] * outer
        if self.largest is not None:
            load, u = self.h**2 * self.largest, slip.T
            _, first, bend = smoothed(slip, self.reach)
            force = force + (load * first)[:, None] * u
            stiffness = stiffness + (load * first)[:, None, None] * (torch.eye(3).to(x) - outer)
            if not majorizes:
                stiffness = stiffness + (load * bend)[:, None, None] * u[:, :, None] * u[:, None]
        both = weights[:, :, None, None, None] * weights[:, None, :, None, None]
        return weights[..., None] * force[:, None], both * stiffness[:, None, None]

    def energy(self, x: Tensor, x_prev: Tensor) -> Tensor:
        along, slip, _ = self._travel(x, torch.arange(len(self.normal), device=x.device))
        total = self.h * self.damping / 2 * along**2
        if self.largest is not None:
            total = total + self.h**2 * self.largest * smoothed(slip, self.reach)[0]
        return self.pairs.total(total)


def contact_step(
    model: Any,
    x: Tensor,
    v: Tensor,
    solver: Any,
    *,
    mu: Any = None,
    lam: Any = None,
    substeps: Sequence[Substep],
    force: Tensor | None = None,
    gravity: Any = (0.0, -9.81, 0.0),
    prescribed: Tensor | None = None,
    rest_points: Tensor | None = None,
    density: Any = None,
    colliders: Tensor | None = None,
    colliders_before: Tensor | None = None,
    order: Sequence[Tensor] | None = None,
    tet_order: Tensor | None = None,
    **parameters: Any,
) -> tuple[Tensor, Tensor]:
    """One time step of a model with `model.contact`; every tensor argument is differentiable by autograd.

    Arguments of `step`, and: substeps, one for each detection, scenes counted in
    row-major order of x's leading dimensions; colliders and colliders_before: positions [..., Vc, 3] [m] of collider
    points at the end and at the start of the step, by default `model.collider_points` and `colliders`; order: one
    permutation of the pairs for each substep, tet_order one of the tets: they change only the order of summation.
    parameters may hold "pair_kappa" [N/m], "pair_damping" [N s/m] and "friction". Raises ValueError when an unpinned
    vertex starts below a floor plane, or when substeps or order have another length. Returns (x', v')."""
    model, time_step, sweeps = executed(model, solver), solver.time_step, solver.sweeps
    count = model.contact.detections or len(substeps)
    prescribed_substeps = model.contact.detections or 1
    for name, value in (("substeps", substeps), ("order", order)):
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
    energies, bound = energies_of_sweeps(scene, elsewhere=("pair", "friction"))
    renew = bound.renew if bound is not None else lambda state: None
    energies += floor_friction(scene, energies)
    masses = color_masses(scene)
    end = _collider_rows(scene, model.collider_points if colliders is None else colliders)
    begin = end if colliders_before is None else _collider_rows(scene, colliders_before)
    rigid = () if model.rigid_bodies is None else model.rigid_bodies.numbers
    listed = [Pairs(scene, substep, None if order is None else order[r]) for r, substep in enumerate(substeps)]

    def rows(values: Tensor) -> Tensor:
        """[B, V, c] -> [..., c, V]"""
        return values.to(x).transpose(-1, -2).reshape(*x.shape[:-2], values.shape[-1], x.shape[-2])

    y = predictor(scene, x, v, force, gravity, prescribed).transpose(-1, -2)
    x_prev, pinned = x.transpose(-1, -2), model.pinned
    check_start(energies, x_prev)
    start = corner_points(x_prev, begin)
    inertial = torch.where(pinned, y, x_prev + time_step * v.transpose(-1, -2))
    displacement, h2a, state = inertial - x_prev, y - inertial, x_prev
    if substeps and substeps[0].resting is not None:
        resting = substeps[0].resting.reshape(*x.shape[:-2], 1, -1)
        displacement = displacement + torch.where(resting, 0.0, h2a)
    remaining = displacement
    for r, substep in enumerate(substeps):
        now = begin + min(1.0, (r + 1) / prescribed_substeps) * (end - begin)
        move = remaining if prescribed_substeps == 1 else torch.where(pinned, displacement / prescribed_substeps,
                                                                      remaining)  # fmt: skip
        for body in rigid:
            own, m = model.body == body, scene.mass[..., None, model.body == body]
            mean = (m * move[..., own]).sum(-1, keepdim=True) / m.sum(-1, keepdim=True)
            move = torch.where(own, mean, move)
        u, fraction = rows(substep.u[:, model.body]), rows(substep.fractions[..., None])
        begun, at = state, torch.where(pinned, state + move, state + u + fraction * (move - u))
        forces: list[Any] = [PairBarrier(scene, listed[r], now), LaggedPairForces(scene, listed[0], start, now)]
        correct = Correction(scene, energies, forces, y, x_prev)
        renew(at)
        state = correct(at, substep.corrections[0])
        number = sweeps // count + (1 if r < sweeps % count else 0) if substep.sweeps is None else substep.sweeps
        if number:
            swept = partial(run_sweeps, scene, [*energies, *forces], masses, y)
            between = list(substep.corrections[1:number]) if rigid else []  # two sweeps
            state = in_cycles(scene, energies, forces, swept, state, y, x_prev, number, substep, bound,
                              partial(_between, renew, correct, between))  # fmt: skip
            renew(state)
            state = correct(state, substep.corrections[-1])
        if substep.going is not None:
            state = torch.where(substep.going.reshape(*x.shape[:-2], 1, 1), state, begun)
        remaining = torch.where(rows(substep.truncated[..., None]) > 0, y - state, 0.0)
    x_new = state.transpose(-1, -2).contiguous()
    return x_new, (x_new - x) / time_step


def _between(renew: Callable[[Tensor], None], correct: Correction, fractions: Sequence[Tensor], state: Tensor, done: int
             ) -> Tensor:  # fmt: skip
    """The state after the rigid correction that follows so many sweeps, where there is one."""
    if not fractions:
        return state
    renew(state)
    return correct(state, fractions[done - 1], majorizes=True)


def _collider_rows(scene: Scene, points: Any) -> Tensor:
    """Collider points of every scene, [B, Vc, 3]."""
    points, lead = scene.tensor(points), scene.like.shape[:-2]
    return points.expand(*lead, *points.shape[-2:]).reshape(lead.numel(), *points.shape[-2:])


def corner_points(x: Tensor, colliders: Tensor) -> Tensor:
    """Positions [B, N, 3] of all corner points from a state [..., 3, V] and colliders [B, Vc, 3]."""
    return torch.cat((x.transpose(-1, -2).reshape(len(colliders), -1, 3), colliders), 1)


def in_cycles(
    scene: Scene,
    energies: list[Any],
    forces: list[Any],
    swept: Callable[..., Tensor],
    state: Tensor,
    y: Tensor,
    x_prev: Tensor,
    number: int,
    substep: Any,
    bound: Bounds | None = None,
    between: Callable[[Tensor, int], Tensor] = lambda state, done: state,
) -> Tensor:
    """The state [..., 3, V] after so many sweeps.

    swept(state, x_prev, sweeps, limits, relaxation): the state after some of them. forces: terms of pairs, each with
    its `on_corners`. substep: decisions.
    """
    lead, model = state.shape[:-2], scene.model
    limits = None if substep.limits is None else substep.limits.reshape(number, *lead, 1, -1).to(state)
    last = None if getattr(model, "coarse", None) is None else min(model.relaxation, 1.0)
    corrections = None if substep.lengths is None else Corrections(scene, energies, forces, y, x_prev)
    every = 1 if corrections is None else model.coarse.every
    lengths: Any = substep.lengths
    done, corrected = 0, 0
    while done < number:
        if done:
            state = between(state, done)
        if bound is not None:
            bound.renew(state)
        if corrections is not None and done:
            state = corrections(state, lengths[corrected].reshape(*lead, -1))
            corrected += 1
        alone = corrections is not None and done == 0  # a sweep before the first correction
        count = 1 if alone else min(every, number - done)
        for k in range(count):
            state = between(state, done) if k else state
            own = None if limits is None else limits[done : done + 1]
            done += 1
            if bound is not None:
                bound.renew(state)
            state = swept(state, x_prev, 1, own, last if done == number else None)
    return state


class Corrections:
    """Coarse corrections of all bodies of a scene together, with the stiffness of pairs, friction and vertex
    energies."""

    def __init__(self, scene: Scene, energies: list[Any], forces: list[Any], y: Tensor, x_prev: Tensor) -> None:
        self.coarse = Coarse(scene, energies, forces)
        self.forces, self.y, self.x_prev = forces, y, x_prev
        self.matrix = self.coarse.begin(x_prev)

    def __call__(self, state: Tensor, lengths: Tensor) -> Tensor:
        matrix = self.matrix + self._pressed(state)
        return self.coarse.correct(state, self.y, self.x_prev, matrix, lengths.to(state))[0]

    def _pressed(self, state: Tensor) -> Tensor:
        """Stiffness of pairs against the functions [..., 3F, 3F]."""
        weight = self.coarse.weight
        out = weight.new_zeros((state.shape[:-2].numel(), weight.shape[1], 3, weight.shape[1], 3))
        for force in self.forces:
            pairs, (_, stiffness) = force.pairs, force.on_corners(state)
            mesh = pairs.corners < len(weight)
            moved = torch.where(mesh[..., None], weight[torch.where(mesh, pairs.corners, 0)], 0.0)
            for n in range(len(out)):
                own = pairs.batch == n
                block = torch.einsum("qaf,qabij,qbg->figj", moved[own], stiffness[own], moved[own])
                out = out.index_add(0, torch.tensor([n]), block[None])
        return out.flatten(-4, -3).flatten(-2, -1).reshape(*state.shape[:-2], *self.matrix.shape[-2:])
