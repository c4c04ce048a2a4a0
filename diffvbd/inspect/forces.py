"""Forces and stresses at a state: what contact does, what pins bear, what the material bears. Differentiable."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.linalg import cross

from .. import ops
from .._common.checks import check_kind, fail, name_value, real_array
from .._common.context import looks_at, replaced, transformed
from .._common.messages import warn
from .._contact.pair_forces import NearPairs
from ..adjoint.contact import ContactState, StepContact
from ..adjoint.potential import IncrementalPotential
from ..couplings import Pressure, Springs, Tendons, load_of
from ..laws.tets import cauchy
from ..model.arguments import ELASTIC_LAWS
from ..model.material import deformed, shape_gradients
from ..model.model import Model
from ..model.solver import VBD
from ..model.system import System, system_of
from ..step.arguments import (
    COLLIDERS,
    VISCOSITIES,
    Given,
    Prepared,
    acceleration_of,
    broadcastable,
    check_state,
    collider_state,
    given_of,
    material_of,
    prepare,
    refuse_non_finite,
)
from ..step.couplings import parameters_at
from ..step.damping import damped
from ..step.predict import energy_data

# --- contact ----------------------------------------------------------------------------------------------------------


class ForceParts(NamedTuple):
    """Forces [N], shape [..., 3]: ``normal`` by barriers and damping, ``tangential`` by friction. ``torque`` [N m] is
    that of both, about the point given to :func:`forces`."""

    normal: Tensor
    tangential: Tensor
    torque: Tensor

    @property
    def total(self) -> Tensor:
        """Their sum [N]."""
        return self.normal + self.tangential


@dataclass(frozen=True)
class Forces:
    """Forces of contact at a state, see :func:`forces`. Bodies are counted as in ``model.body``; N of them.

    Attributes:
        vertices: On every vertex, [..., V, 3]; those of self-contact, too.
        body_pairs: Bodies a < b that are near each other in some scene, int64 [M, 2].
        between: On body a of each of these by body b, [..., M, 3]. b bears the opposite force; its torque is not
            quite the opposite, because friction acts on it at the other end of the gap.
        colliders: On each body by each collider, [..., N, colliders, 3].
        floors: On each body by each plane of the FloorBarrier, [..., N, planes, 3].
        bodies: On each body by all others, colliders and planes, [..., N, 3].
    """

    vertices: ForceParts
    body_pairs: Tensor
    between: ForceParts
    colliders: ForceParts
    floors: ForceParts
    bodies: ForceParts

    def __str__(self) -> str:
        """A line for each two bodies, each collider and each plane that press; of batches the shapes alone."""
        scenes = self.vertices.normal.shape[:-2]
        if scenes.numel() != 1:
            return f"Forces of contact in scenes {list(scenes)}, {len(self.body_pairs)} pairs of bodies"
        lines = []

        def add(name: str, parts: ForceParts, at: tuple[int, ...]) -> None:
            normal, tangential = (t.detach().reshape(t.shape[len(scenes) :])[at].tolist() for t in parts[:2])
            if any(normal) or any(tangential):
                words = (" ".join(f"{value:.4g}" for value in force) for force in (normal, tangential))
                lines.append(f"{name}: normal ({next(words)}) N, friction ({next(words)}) N")

        for i, (a, b) in enumerate(self.body_pairs.tolist()):
            add(f"on body {a} by body {b}", self.between, (i,))
        for parts, by in ((self.colliders, "collider"), (self.floors, "floor plane")):
            bodies, others = parts.normal.shape[-3:-1]
            for body, other in product(range(bodies), range(others)):
                add(f"on body {body} by {by} {other}", parts, (body, other))
        return "\n".join(lines) or "no forces of contact"


def forces(
    model: Model,
    x: Tensor,
    solver: VBD | None = None,
    *,
    previous: tuple[Tensor, Tensor] | None = None,
    about: Tensor | Sequence[float] = (0.0, 0.0, 0.0),
    **inputs: Any,
) -> Forces:
    """Forces that pairs, colliders and floors exert at x, by vertex, by two bodies, by collider and by plane.

    The barrier's forces are those at x. Damping and friction are those of a step: they follow from its start and from
    its motion, so they need ``previous`` and ``solver``; without these x is at rest and they are zero. Which
    pairs are near has no derivative; all else is differentiable by autograd. Computed in float64.

    Args:
        model: The scene; a FloorBarrier or a PairBarrier exerts the forces.
        x: Positions [m], shape [..., V, 3].
        solver: That of the step, whose time step is read.
        previous: State (x, v) from which one step led to ``x``, of x's shape; v is not read.
        about: Point that torques are about [m], shape [3] or [..., 3]. Each force acts where its corner point is.
        inputs: As in :func:`diffvbd.step`; those of the barriers, friction, colliders and colliders_before are read.

    Returns:
        A :class:`Forces`, of x's dtype.

    Raises:
        ValueError, TypeError: As :func:`diffvbd.step`; also where surfaces touch, for vertices on or below a floor, and
            for ``previous`` without a solver.

    Source: Li et al. (2020); docs/method.md, sections 6 and 12.
    """
    given_inputs = _checked(model, x, solver, previous, inputs)
    start = None if previous is None else previous[0]
    _refuse_non_finite(model, {"x": x, "previous: x": start, **given_inputs.parameters,
                               **{name: given_inputs.loads[name] for name in COLLIDERS}})  # fmt: skip
    given = widen(
        model, x, solver, Given(material_of(mu=0.0, lam=0.0).material, given_inputs.parameters, given_inputs.loads)
    )
    _refuse_below(given, {"x": x, "previous: x": start})
    state = _contact_at(given, x, previous)
    lead, dtype = x.shape[:-2], x.dtype
    point = _points_about(about, x)

    def shaped(normal: Tensor, tangential: Tensor, torque: Tensor) -> ForceParts:
        return ForceParts(*(t.reshape(*lead, *t.shape[1:]).to(dtype) for t in (normal, tangential, torque)))

    surface = given.model.surface_of_contact
    labels = given.model.body
    bodies = int(labels.max()) + 1 if labels.numel() else 0
    arms = state.points[:, : len(labels)] - point[:, None]

    def with_torque(normal: Tensor, tangential: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        arm = arms if normal.dim() == 3 else arms[:, :, None].expand(normal.shape)
        return normal, tangential, cross(arm, normal + tangential)

    floors = [_by_label(part, labels, bodies) for part in with_torque(state.floor, state.floor_friction)]
    sums = _OfBodies(state, bodies, 0 if surface is None else len(surface.rows), surface.body if surface else labels,
                     point)  # fmt: skip
    body_pairs, *between = sums.between()
    return Forces(
        vertices=shaped(*with_torque(*state.on_vertices())),
        body_pairs=body_pairs,
        between=shaped(*between),
        colliders=shaped(*sums.colliders()),
        floors=shaped(*floors),
        bodies=shaped(*(own + floor.sum(2) for own, floor in zip(sums.bodies(), floors, strict=True))),
    )


def _points_about(about: Tensor | Sequence[float], x: Tensor) -> Tensor:
    """The point of each scene [B, 3] in float64."""
    lead = x.shape[:-2]
    shapes = " or ".join(dict.fromkeys(("[3]", f"{[*lead, 3]}")))
    point = real_array("about", about, f"a point of shape {shapes}").to(x.device)
    if (
        point.shape[-1:] != (3,)
        or point.dim() > len(lead) + 1
        or any(n not in (1, m) for n, m in zip(point.shape[-2::-1], lead[::-1], strict=False))
    ):
        fail("about", f"a point of shape {shapes}", f"shape {list(point.shape)}")
    if looks_at(point):
        name_value("about", "finite coordinates", point, torch.isfinite(point))
    return point.expand(*lead, 3).reshape(lead.numel(), 3)


def _checked(model: Model, x: Tensor, solver: VBD | None, previous: Any, inputs: dict[str, Any]) -> Given:
    """Inputs of a step, once the states fit the Model."""
    check_state(model, x, x)
    check_previous(model, previous, x, solver)
    return given_of(model, inputs)


def _refuse_non_finite(model: Model, where: dict[str, Tensor | None]) -> None:
    for value in where.values():
        if isinstance(value, Tensor):
            ops.not_batched(value)
    refuse_non_finite(model, where)


def _refuse_moduli(mu: Tensor, lam: Tensor) -> None:
    if looks_at(mu) and looks_at(lam):
        name_value("mu", "finite values >= 0 Pa", mu, (mu >= 0) & torch.isfinite(mu))
        name_value("lam", "finite values with mu + lam >= 0 Pa", lam, (mu + lam >= 0) & torch.isfinite(lam))


def _refuse_below(given: Wide, where: dict[str, Tensor | None]) -> None:
    """Raises for a vertex on or below a plane of the floor, where its barrier has no force."""
    floor = given.model.floor
    for name, x in where.items():
        if floor is None or x is None:
            continue
        flat = x.detach().double().reshape(x.shape[:-2].numel(), *x.shape[-2:])
        gaps = floor.gaps(flat, given.data()[:, : floor.count()].detach().double(), None)[0]
        below = (~(gaps > 0) & ~given.model._pinned[:, None]).nonzero()
        if len(below):
            scene, vertex, plane = below[0].tolist()
            fail(name, "every unpinned vertex above the floor", f"vertex {vertex} on or below plane {plane} in scene "
                 f"{scene}")  # fmt: skip


def _contact_at(given: Wide, x: Tensor, previous: tuple[Tensor, Tensor] | None) -> ContactState:
    if transformed() and not x.requires_grad:
        raise NotImplementedError("diffvbd: torch.func transforms of forces of contact with x as a constant are not "
                                  "supported: use torch.autograd")  # fmt: skip
    flat = (x.shape[:-2].numel(), *x.shape[-2:])
    start = None if previous is None else previous[0].double().reshape(flat)
    numbers = given.prepared.settings.numbers
    contact = StepContact(given.model, given.data(), given.prepared.parameters, given.colliders, given.before, start,
                          None, numbers.time_step, numbers.friction_eps)  # fmt: skip
    return contact.at(x.double().reshape(flat))


def _by_label(values: Tensor, labels: Tensor, count: int) -> Tensor:
    """[B, V, ...] -> [B, count, ...]"""
    return values.new_zeros(len(values), count, *values.shape[2:]).index_add(1, labels, values)


class _OfBodies:
    """Forces of pairs and their torques, added up by the bodies of their two sides; colliders count on from the
    ``bodies``."""

    def __init__(self, state: ContactState, bodies: int, colliders: int, labels: Tensor, about: Tensor) -> None:
        self.count, self.colliding, self.scenes = bodies, colliders, len(state.points)
        parts: list[tuple[NearPairs, Tensor, int]] = [(state.pairs, state.barrier, 0)]
        if state.lagged is not None:
            parts += [(state.lagged, state.damping, 0), (state.lagged, state.friction, 1)]
        rows = []
        for pairs, on_corners, part in parts:
            torque = cross(pairs.positions(state.points) - about[pairs.scene, None], on_corners)
            both = torch.cat([on_corners, torque], -1)  # [Q, 4, 6]
            first = pairs.of_first(both)
            rows.append((pairs.scene, *(side.long() for side in pairs.sides(labels)), torch.full_like(pairs.kind, part),
                         first, both.sum(1) - first))  # fmt: skip
        self.scene, a, b, self.part, of_a, of_b = (torch.cat(column) for column in zip(*rows, strict=True))
        turned = a > b  # bodies before colliders, and the lower one first
        self.a, self.b = torch.minimum(a, b), torch.maximum(a, b)
        self.of_a, self.of_b = (torch.where(turned[:, None], *both) for both in ((of_b, of_a), (of_a, of_b)))

    def between(self) -> tuple[Tensor, ...]:
        """Body pairs [M, 2], normal and tangential forces and torques on their first bodies [B, M, 3]."""
        own = (self.b < self.count) & (self.a < self.b)
        key = self.a[own] * self.count + self.b[own]
        keys, column = key.unique(return_inverse=True)
        found = torch.stack([keys // max(1, self.count), keys % max(1, self.count)], -1)
        return found, *self._sums(own, self.of_a, column, len(keys))

    def colliders(self) -> tuple[Tensor, ...]:
        """Normal and tangential forces and torques on bodies by colliders [B, bodies, colliders, 3]."""
        own = self.b >= self.count
        column = self.a[own] * self.colliding + self.b[own] - self.count
        shape = (self.scenes, self.count, self.colliding, 3)
        return tuple(t.reshape(shape) for t in self._sums(own, self.of_a, column, self.count * self.colliding))

    def bodies(self) -> tuple[Tensor, ...]:
        """Normal and tangential forces and torques on bodies by others and by colliders [B, bodies, 3]."""
        apart, moves = self.a < self.b, self.b < self.count
        first = self._sums(apart, self.of_a, self.a[apart], self.count)
        second = self._sums(apart & moves, self.of_b, self.b[apart & moves], self.count)
        return tuple(one + two for one, two in zip(first, second, strict=True))

    def _sums(self, own: Tensor, values: Tensor, column: Tensor, columns: int) -> tuple[Tensor, ...]:
        total = values.new_zeros(2 * self.scenes * columns, 6)
        index = (self.part[own] * self.scenes + self.scene[own]) * columns + column
        normal, tangential = total.index_add(0, index, values[own]).reshape(2, self.scenes, columns, 6)
        return normal[..., :3], tangential[..., :3], (normal + tangential)[..., 3:]


# --- pins and material ------------------------------------------------------------------------------------------------


def reactions(
    model: Model, x: Tensor, solver: VBD | None = None, *, previous: tuple[Tensor, Tensor] | None = None, **inputs: Any
) -> Tensor:
    """Forces that hold the pinned vertices where they are: what a support must bear, with the opposite sign.

    The sum of a pinned vertex's reaction, its weight, the external force, elasticity, springs, tendons, pressure and
    contact is its mass times its acceleration, which is zero unless ``previous`` tells another. Differentiable by
    autograd in every tensor; computed in float64.

    Args:
        model, inputs: As in :func:`diffvbd.step`. A force on a pinned vertex goes into its support.
        x: Positions [m], shape [..., V, 3].
        solver, previous: As in :func:`diffvbd.contact.forces`; v is read.

    Returns:
        Reactions [N], x's shape and dtype; zero at vertices that are not pinned.

    Raises:
        ValueError, TypeError: As :func:`diffvbd.step` and :func:`diffvbd.contact.forces`.

    Source: docs/method.md, sections 1, 2 and 12.
    """
    given_inputs = _checked(model, x, solver, previous, inputs)
    loads = given_inputs.loads
    state = {} if previous is None else {"previous: x": previous[0], "previous: v": previous[1]}
    pull, force = acceleration_of(loads["gravity"], x), loads["force"]
    _refuse_non_finite(model, {"x": x, **state, **given_inputs.parameters, "force": force, "gravity": pull,
                               **{name: loads[name] for name in COLLIDERS}})  # fmt: skip
    given = widen(model, x, solver, given_inputs)
    _refuse_moduli(given.prepared.mu, given.prepared.lam)
    _refuse_below(given, {"x": x})
    prepared, h, drag = given.prepared, given.prepared.settings.numbers.time_step, None
    if prepared.damping is not None:
        if previous is None:
            fail("previous", "the state (x, v) before the step with viscosity or drag, which act on motion", "None")
        drag = prepared.damping.drag
        no_drag = replaced(prepared, damping=replaced(prepared.damping, drag=None))
        prepared = damped(given.model, no_drag, previous[0].double())
    flat = (x.shape[:-2].numel(), *x.shape[-2:])

    def full(value: Tensor) -> Tensor:
        return value.expand(x.shape).double().reshape(flat)

    at = full(x)
    fields = ops.SweepFields(at, at, at, prepared.mu, prepared.lam, prepared.mass, prepared.rest, given.data(), None)
    total = IncrementalPotential(given.model, at, fields, h, prepared.averaged).elastic() / h**2
    if given.model.contact is not None:  # planes do not act on pinned vertices
        normal, friction = _contact_at(given, x, previous).on_vertices()
        total = total - normal - friction
    if given.model.couplings:
        total = total + load_of(given.model.couplings, given.parameters(len(at)), at)[..., :3]
    acceleration = -full(pull)
    if previous is not None:
        start, speed = (full(t) for t in previous)
        acceleration = acceleration + ((at - start) / h - speed) / h
        if drag is not None:
            acceleration = acceleration + drag[..., None] * (at - start) / h
    total = total + prepared.mass[..., None] * acceleration
    if force is not None:
        total = total - full(broadcastable("force", force, x))
    return torch.where(given.model._pinned[:, None], total, 0.0).reshape(x.shape).to(x.dtype)


class CouplingForces(NamedTuple):
    """What springs, tendons and gas do at a state; None for what a Model has not.

    Attributes:
        springs: Force of each spring on its first point [N], shape [..., S, 3].
        tendons: Tension of each tendon [N], shape [..., R].
        pressure, volume: Pressure above ambient [Pa] and volume [m^3] of each cavity, shape [..., C].
        vertices: Their force on every vertex [N], shape [..., V, 3].
    """

    springs: Tensor | None
    tendons: Tensor | None
    pressure: Tensor | None
    volume: Tensor | None
    vertices: Tensor

    def __repr__(self) -> str:
        own = (f"{name} of shape {list(t.shape)}" for name, t in self._asdict().items() if t is not None)
        return f"CouplingForces({', '.join(own)})"


def coupling_forces(model: Model, x: Tensor, **inputs: Any) -> CouplingForces:
    """Forces of springs and tendons, and pressure and volume of cavities, at x. Differentiable by autograd in every
    tensor; computed in float64.

    Args:
        model: A scene with Springs, Tendons or Pressure.
        x: Positions [m], shape [..., V, 3].
        inputs: As in :func:`diffvbd.step`; those of springs, tendons and pressure are read.

    Returns:
        A :class:`diffvbd.results.CouplingForces` of x's dtype.

    Raises:
        ValueError, TypeError: As :func:`diffvbd.step`; also for a Model without such an energy.

    Source: docs/method.md, section 21.
    """
    given_inputs = _checked(model, x, None, None, inputs)
    if not model.couplings:
        fail("model", "Springs, Tendons or Pressure among its energies", "none")
    _refuse_non_finite(model, {"x": x, **given_inputs.parameters})
    given = widen(model, x, None, Given(material_of(mu=0.0, lam=0.0).material, given_inputs.parameters, {}))
    at = x.double().reshape(x.shape[:-2].numel(), *x.shape[-2:])
    values = given.parameters(len(at))
    found: dict[str, Tensor] = {"vertices": -load_of(given.model.couplings, values, at)[..., :3]}
    for energy, own in zip(given.model.couplings, values, strict=True):
        if isinstance(energy, Springs):
            found["springs"] = -energy.pull(at, own)
        elif isinstance(energy, Tendons):
            found["tendons"] = energy.tension(at, own)
        elif isinstance(energy, Pressure):
            found["pressure"], found["volume"] = energy.state(at, own)
    shaped = {name: t.reshape(*x.shape[:-2], *t.shape[1:]).to(x.dtype) for name, t in found.items()}
    return CouplingForces(**{**dict.fromkeys(CouplingForces._fields), **shaped})  # pyright: ignore[reportArgumentType]


class Stress(NamedTuple):
    """Stress of each tet [Pa]: ``cauchy`` [..., T, 3, 3], symmetric, tension positive; ``von_mises`` [..., T]."""

    cauchy: Tensor
    von_mises: Tensor


def stress(model: Model, x: Tensor, **inputs: Any) -> Stress:
    """Elastic Cauchy stress of each tet and the von Mises stress that follows from it; without that of viscosity.

        cauchy = P F^T / J = mu F F^T / J + ((mu + lam) (J - 1) - mu) I

    With patches lam times the strain J_P - 1 of the patch stands for lam (J - 1).

    Args:
        model: A scene with StableNeoHookean tets, or a law of your own.
        x: Positions [m], shape [..., V, 3].
        inputs: As in :func:`diffvbd.step`; moduli, rest_points and stress_free are read. A viscosity is warned of.

    Returns:
        A :class:`diffvbd.results.Stress` of x's dtype, differentiable by autograd in every tensor. The
        derivative of a von Mises stress of zero is zero. Where a tet has no volume (J = 0) its stress is not finite.

    Raises:
        ValueError, TypeError: As :func:`diffvbd.step`; also for a Model without StableNeoHookean.

    Source: Smith, de Goes, Kim (2018); docs/method.md, section 2.
    """
    check_state(model, x, x)
    lead = x.shape[:-2]
    if not any(isinstance(energy, ELASTIC_LAWS) for energy in model.energies):
        fail("model", "StableNeoHookean among its energies", "none")
    given_inputs = given_of(model, inputs)
    rest_points, stress_free = (given_inputs.material[name] for name in ("rest_points", "stress_free"))
    for name in VISCOSITIES:
        if given_inputs.material[name] is not None:
            warn(f"{name}: the stress is the elastic one alone; that of viscosity needs a motion and is not in it")
    own = {} if model.law is None else given_inputs.parameters
    given = widen(model, x, None, Given(given_inputs.material, own, {}))
    if model.law is not None:
        assert given.prepared.rest is not None
        scalars = given.prepared.rest.expand(lead.numel(), -1, -1)
        scalars = scalars.reshape(*lead, *scalars.shape[1:])
        return _stress_of(cauchy(model.law.density, x.double()[..., given.model._topology[0], :], scalars), x)
    tets = given.model._topology[0]
    points = given.model._rest_points if rest_points is None else wide(rest_points)
    rest = points.expand(x.shape)[..., tets, :]
    rest = rest if stress_free is None else deformed(rest, wide(stress_free).expand(*rest.shape[:-2], 3, 3))
    gradients, _ = shape_gradients(rest)
    corners = x.double()[..., tets, :]
    edges = corners[..., 1:, :] - corners[..., :1, :]
    f = (edges[..., :, None] * gradients[..., 1:, None, :]).sum(-3)  # F_ij = sum_a e_ai (grad N_a)_j
    det = (f[..., 0, :] * cross(f[..., 1, :], f[..., 2, :])).sum(-1)
    shear, second = (
        t.expand(lead.numel(), t.shape[1]).reshape(*lead, t.shape[1]) for t in (given.prepared.mu, given.prepared.lam)
    )
    _refuse_moduli(shear, second)
    eye = torch.eye(3, dtype=f.dtype, device=f.device)
    left = (f[..., :, None, :] * f[..., None, :, :]).sum(-1)
    pressure = (shear + second) * (det - 1) - shear
    if (patches := given.model.patches) is not None:
        assert given.prepared.averaged is not None
        mean = patches.mean(det.reshape(-1, det.shape[-1]), given.prepared.averaged.c6)
        pressure = pressure + second * (patches.spread(mean).reshape(det.shape) - det)
    return _stress_of((shear / det)[..., None, None] * left + pressure[..., None, None] * eye, x)


def _stress_of(cauchy: Tensor, x: Tensor) -> Stress:
    eye = torch.eye(3, dtype=cauchy.dtype, device=cauchy.device)
    trace = cauchy.diagonal(dim1=-2, dim2=-1).sum(-1)
    square = 1.5 * (cauchy - (trace / 3)[..., None, None] * eye).square().sum((-2, -1))
    unloaded = square == 0  # a root has no derivative at zero
    von_mises = torch.where(unloaded, 0.0, torch.where(unloaded, 1.0, square).sqrt())
    return Stress(cauchy.to(x.dtype), von_mises.to(x.dtype))


# --- a model and arguments of a step in float64, for reading ----------------------------------------------------------


class Wide(NamedTuple):
    """A Model in float64, what does not depend on the state, and collider points at the start and the end of a step
    [B, Vc, 3]."""

    model: System
    prepared: Prepared
    before: Tensor
    colliders: Tensor

    def data(self) -> Tensor:
        """Data of the energies [1 | B, n]."""
        return energy_data(self.model, self.prepared, None)

    def parameters(self, scenes: int) -> list[dict[str, Tensor]]:
        """Parameters of each coupling by key, [B, ...]."""
        return parameters_at(self.model, self.prepared.parameters, scenes)


def widen(model: Model, x: Tensor, solver: VBD | None, given: Given) -> Wide:
    """Inputs checked as those of a step; loads but colliders are not read. Without a solver the time step is 1 s."""
    lead = check_state(model, x, x)
    solver = VBD(1.0, 0) if solver is None else solver
    system, options = system_of(model, solver), {"time_step": solver.time_step, "sweeps": 0}
    prepared = prepare(system, lead, given, **options)
    where = collider_state(system, x, given.loads.get("colliders"), given.loads.get("colliders_before"))
    if where is None:
        none = x.new_zeros((x.shape[:-2].numel(), 0, 3))
        where = none, none
    if model.dtype == torch.float64:
        return Wide(system, prepared, *where)
    double = system.derived("in_float64", lambda: system.to(dtype=torch.float64))
    prepared = prepare(double, lead, Given(*(wide(part) for part in given)), **options)
    return Wide(double, prepared, wide(where[0]), wide(where[1]))


def wide(value: Any) -> Any:
    """Tensors of real numbers in float64, those of a dict, tuple or list, too; anything else as it is."""
    if isinstance(value, Tensor):
        return value.double() if value.is_floating_point() else value
    if isinstance(value, dict):
        return {key: wide(each) for key, each in value.items()}
    return type(value)(wide(each) for each in value) if isinstance(value, (tuple, list)) else value


def check_previous(model: Model, previous: Any, x: Tensor, solver: Any) -> None:
    """Raises where ``previous`` is no state (x, v) with a solver of the step from it."""
    if solver is not None:
        check_kind("solver", solver, VBD)
    if previous is None:
        return
    if not (isinstance(previous, (tuple, list)) and len(previous) == 2):
        shown = f"{len(previous)} values" if isinstance(previous, (tuple, list)) else type(previous).__name__
        raise TypeError(f"previous: expected positions and velocities (x, v), got {shown}")
    try:
        check_state(model, *previous)
    except (ValueError, TypeError) as error:
        raise type(error)(f"previous: {error}") from None
    if solver is None:
        fail("solver", "that of the step where previous is given", None)
    if previous[0].shape != x.shape:
        fail("previous", f"x's shape {list(x.shape)}", f"shape {list(previous[0].shape)}")
