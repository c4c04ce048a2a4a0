"""Energies that couple vertices which need not share a tet: springs, tendons and enclosed pressure.

Before each sweep an energy E(x) is replaced by a quadratic bound that is separable over the vertices,

    E(x) <= E(x0) + sum_i g_i . (x_i - x0_i) + s_i / 2 |x_i - x0_i|^2,        g = dE/dx at x0,

which is the record of an Anchor with stiffness s_i at x0_i - g_i / s_i. What lowers the bound lowers E.

Source: Hunter and Lange (2004), "A tutorial on MM algorithms"; docs/method.md, section 21.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from ._common.checks import (
    check_bool,
    check_kind,
    check_number,
    fail,
    init_names_checked,
    name_value,
    refuse_gradient,
    refuse_gradients,
)
from ._common.context import looks_at
from .embedding import Embedding
from .energies import numbers_of
from .mesh import TetMesh, cavities
from .mesh.arrays import IntArray, int_array
from .ops.sums import Rows

ATMOSPHERE = 101_325.0  # [Pa]
STRAIGHT = 1e-3  # derivative of a tendon's length by a vertex, below which the bound's size is smooth


class Curvature(NamedTuple):
    """Of N terms of an energy by the M vectors that each depends on: sum of rate (slope . dd)^2, over all M together,
    and of dd . across dd."""

    rate: Tensor  # [B, N]
    slope: Tensor  # [B, N, M, 3]
    across: Tensor | None  # [B, N, M, 3, 3]; None: there is no such part


class Coupling:
    """An energy of several vertices. Subclasses are dataclasses, whose fields are constants."""

    name: ClassVar[str]
    bit: ClassVar[int] = 0  # of a scene's mask: it reaches the kernels as the record of an Anchor
    strength: ClassVar[str] = "stiffness"  # the parameter in which the energy is linear, gas but for ambient
    parameters: ClassVar[dict[str, int]]  # as of VertexEnergy
    units: ClassVar[dict[str, str]]

    def of_mesh(self, mesh: TetMesh, pinned: Tensor) -> Coupling:
        """A copy with the index data of a mesh; raises ValueError where it does not fit. pinned: bool [V]."""
        raise NotImplementedError

    def placed(self, num_vertices: int, device: torch.device) -> Coupling:
        """A copy whose index data lie on a device."""
        return self._with(**{k: _moved(v, device) for k, v in vars(self).items() if k.startswith("_")})

    def _with(self, **values: Any) -> Any:
        out = copy.copy(self)
        for name, value in values.items():
            object.__setattr__(out, name, value)
        return out

    def _count(self) -> int:
        """Number of springs, tendons or cavities."""
        raise NotImplementedError

    def constants(self, rest_points: Tensor) -> dict[str, Tensor]:
        """The parameters as tensors of rest_points' dtype and device."""
        own = {key: getattr(self, key).to(rest_points) for key in self.parameters}
        return {key: value if value.dim() == 2 else value.expand(self._count()) for key, value in own.items()}

    def least(self, key: str) -> float:
        """The least value of a parameter."""
        return 0.0

    def load(self, x: Tensor, values: dict[str, Tensor]) -> Tensor:
        """Gradient [N] and bound s [N/m] of each vertex, [B, V, 4]; differentiable.

        x: [B, V, 3] [m].  values: parameters by key, [B, ...].
        """
        raise NotImplementedError

    def terms(self, x: Tensor, values: dict[str, Tensor]) -> Tensor:
        """Terms [J] whose sum is the energy of a scene, but for a constant, [B, N]; arguments as of load()."""
        raise NotImplementedError

    def joins(self) -> tuple[Tensor, Tensor]:
        """Pairs of vertices [n, 2] whose bodies it joins, and vertices [m] that it ties to places; on the CPU."""
        none = torch.zeros((0, 2), dtype=torch.int64, device="cpu")
        return none, none[:, 0]

    def differences(self) -> tuple[IntArray, np.ndarray]:
        """Vertices and weights [N, M, n] of the M vectors that each of N terms of the energy depends on."""
        raise NotImplementedError

    def curvature(self, x: Tensor, values: dict[str, Tensor]) -> Curvature | None:
        """Second derivative by these vectors, without what of it may be negative; differentiable. None: nothing is
        left."""
        raise NotImplementedError

    def _take_numbers(self) -> None:
        """The parameters as float64 tensors, checked."""
        refuse_gradients(self)
        for key in self.parameters:
            value = numbers_of(key, getattr(self, key))
            if bool((value < self.least(key)).any()):
                fail(key, f"numbers >= {self.least(key):g} {self.units[key]}", getattr(self, key))
            object.__setattr__(self, key, value)

    def _check_counts(self, noun: str) -> None:
        for key, own in self.parameters.items():
            shape, count = list(getattr(self, key).shape), self._count()
            if own == 1 and shape not in ([], [1], [count]):
                fail(key, f"a number or shape [{count}], one for each {noun}", f"shape {shape}")


def _moved(value: Any, device: torch.device) -> Any:
    return value.to(device) if hasattr(value, "to") else type(value)(*(part.to(device) for part in value))


def _pairs(rows: Tensor) -> Tensor:
    """The first of each row [N, n] with the others, [N (n - 1), 2]."""
    return torch.stack([rows[:, :1].expand(-1, rows.shape[1] - 1), rows[:, 1:]], -1).reshape(-1, 2)


def _length(d: Tensor) -> tuple[Tensor, Tensor]:
    """|d| and 1 / |d| of d [..., 3]; both 0, with derivatives of 0, where d is 0."""
    square = (d * d).sum(-1)
    some = square > 0
    length = torch.where(some, square, 1.0).sqrt()
    return torch.where(some, length, 0.0), torch.where(some, 1 / length, 0.0)


class _Differences(NamedTuple):
    """Vectors d = sum_j w_j x_j of M segments of each of N routes; a route of fewer is filled up with zeros."""

    rows: Rows
    weights: Tensor  # [N, M, n], those of a vertex added up at one place
    bounds: Tensor  # [N, M, n] |w_i| sum_j |w_j|, over the vertices that are not pinned

    @classmethod
    def of(cls, index: IntArray, weights: np.ndarray, pinned: Tensor) -> _Differences:
        """index, weights: [N, M, n]."""
        order = index.argsort(-1, kind="stable")
        index, weights = np.take_along_axis(index, order, -1), np.take_along_axis(weights, order, -1)
        for j in range(1, index.shape[-1]):  # a vertex that both ends have is bounded by its own weight
            again = index[..., j] == index[..., j - 1]
            weights[..., j] += np.where(again, weights[..., j - 1], 0.0)
            weights[..., j - 1] = np.where(again, 0.0, weights[..., j - 1])
        vertices, w = torch.from_numpy(index), torch.from_numpy(weights)
        moving = (w.abs() * ~pinned[vertices]).sum(-1, keepdim=True)
        return cls(Rows.of(vertices.reshape(-1), len(pinned)), w, w.abs() * moving)

    @property
    def vertices(self) -> IntArray:
        """[N, M, n]"""
        return self.rows.group.reshape(-1)[: self.rows.rows].reshape(self.weights.shape).cpu().numpy()

    def take(self, x: Tensor) -> Tensor:
        """d of x [B, V, 3], [B, N, M, 3]."""
        corners = self.rows.gather(x).unflatten(1, tuple(self.weights.shape))
        return (corners * self.weights.to(x.dtype)[..., None]).sum(-2)

    def spread(self, pull: Tensor, stiffness: Tensor) -> Tensor:
        """Gradients with respect to d [B, N, M, 3] and bounds of the stiffness of d [B, N, M, 1] as those of each
        weight, [B, N M n, 4]; their sums by vertex are a load()."""
        weights, bounds = (t.to(pull.dtype)[..., None] for t in (self.weights, self.bounds))
        return torch.cat([weights * pull[..., None, :], bounds * stiffness[..., None]], -1).flatten(1, 3)


def _across(force: Tensor, normal: Tensor) -> Tensor:
    """force (1 - n n^T), [...], [..., 3] -> [..., 3, 3]."""
    eye = torch.eye(3, dtype=normal.dtype, device=normal.device)
    return force[..., None, None] * (eye - normal[..., :, None] * normal[..., None, :])


@init_names_checked
@dataclass(frozen=True, eq=False, repr=False)
class Springs(Coupling):
    """Springs k / 2 (|p - q| - L)^2 between points p and q; with L = 0 an attachment, k / 2 |p - q|^2.

    Args:
        first: The points p, S of them.
        second: The points q of other vertices, or places [m], shape [S, 3], a tensor: a frame, fixed or moved by the
            input ``spring_points``.
        stiffness: k [N/m], a number or one for each spring, shape [S].
        rest_length: L [m], the same.
        tension_only: Springs that are shorter than L do not push: cables.

    Inputs: ``spring_stiffness`` and ``spring_rest_length`` [S]; with places ``spring_points`` [S, 3].

    Raises:
        TypeError, ValueError: Naming the argument, as Anchor; in the Model, vertices that its mesh does not have.

    Source: docs/method.md, section 21; docs/attachments.md.
    """

    name: ClassVar[str] = "spring"
    parameters: ClassVar[dict[str, int]] = {"stiffness": 1, "rest_length": 1, "points": 2}
    units: ClassVar[dict[str, str]] = {"stiffness": "N/m", "rest_length": "m", "points": "m"}

    points: ClassVar[Tensor]  # places that second has
    _ends: ClassVar[_Differences]

    first: Embedding
    second: Embedding | Tensor
    stiffness: float | Tensor
    rest_length: float | Tensor = 0.0
    tension_only: bool = False

    def __post_init__(self) -> None:
        check_kind("first", self.first, Embedding)
        check_bool("tension_only", self.tension_only)
        count = self._count()
        if isinstance(self.second, Embedding):
            object.__setattr__(self, "parameters", {"stiffness": 1, "rest_length": 1})
            fits, got = len(self.second) == count, f"{len(self.second)} points"
        else:
            refuse_gradient("second", self.second, "pass spring_points= to a step or a rollout")
            places = numbers_of("second", self.second)
            object.__setattr__(self, "second", places)
            object.__setattr__(self, "points", places)
            fits, got = places.shape == (count, 3), f"shape {list(places.shape)}"
        if not fits:
            fail("second", f"{count} points, as many as first has, or shape [{count}, 3]", got)
        self._take_numbers()
        self._check_counts("spring")

    def __repr__(self) -> str:
        return f"Springs({self._count()})"

    def _count(self) -> int:
        return len(self.first)

    def least(self, key: str) -> float:
        return -math.inf if key == "points" else 0.0

    def of_mesh(self, mesh: TetMesh, pinned: Tensor) -> Springs:
        ends = [(self.first, 1.0), (self.second, -1.0)] if isinstance(self.second, Embedding) else [(self.first, 1.0)]
        for name, (end, _) in zip(("first", "second"), ends, strict=False):
            end.check(name, mesh.num_vertices)
        index = np.concatenate([end.vertices.numpy() for end, _ in ends], -1)
        weights = np.concatenate([sign * end.weights.numpy() for end, sign in ends], -1)
        return self._with(_ends=_Differences.of(index[:, None], weights[:, None], pinned))

    def joins(self) -> tuple[Tensor, Tensor]:
        one = self.first.vertices
        if not isinstance(self.second, Embedding):
            return _pairs(one), one.reshape(-1)
        return _pairs(torch.cat([one, self.second.vertices], 1)), one.new_zeros((0,))

    def _vectors(self, x: Tensor, values: dict[str, Tensor]) -> Tensor:
        d = self._ends.take(x)[:, :, 0]
        return d - values["points"] if "points" in values else d

    def terms(self, x: Tensor, values: dict[str, Tensor]) -> Tensor:
        longer = _length(self._vectors(x, values))[0] - values["rest_length"]
        return values["stiffness"] / 2 * (longer.clamp(min=0) if self.tension_only else longer).square()

    def pull(self, x: Tensor, values: dict[str, Tensor]) -> Tensor:
        """Gradient of each spring with respect to p - q, [B, S, 3]: the force on q, and against that on p."""
        d, rest = self._vectors(x, values), values["rest_length"]
        length, inverse = _length(d)
        # at d = 0 the derivative is that of an attachment, of a slack cable 0
        rate = values["stiffness"] * (1 - rest * inverse)
        return (torch.where(length < rest, 0.0, rate) if self.tension_only else rate)[..., None] * d

    def load(self, x: Tensor, values: dict[str, Tensor]) -> Tensor:
        # k / 2 |d|^2 - k L |d|, of which the second part is concave: k bounds all of it
        spread = self._ends.spread(self.pull(x, values)[:, :, None], values["stiffness"][..., None, None])
        return self._ends.rows.sum(spread)

    def differences(self) -> tuple[IntArray, np.ndarray]:
        return self._ends.vertices, self._ends.weights.cpu().numpy()

    def curvature(self, x: Tensor, values: dict[str, Tensor]) -> Curvature:
        d, rest = self._vectors(x, values), values["rest_length"]
        length, inverse = _length(d)
        rate = values["stiffness"].expand_as(length)
        rate = torch.where(length < rest, 0.0, rate) if self.tension_only else rate
        normal = inverse[..., None] * d
        return Curvature(
            rate, normal[:, :, None], _across(rate * (1 - rest * inverse).clamp(min=0), normal)[:, :, None]
        )


class _Own(NamedTuple):
    """The vertices of each tendon, U of all of them."""

    of_entries: Rows  # entries of segments, by such a vertex
    of_tendons: Rows  # U, by tendon
    of_vertices: Rows  # U, by vertex of the mesh
    acts: Tensor  # [U] 1 where it has weight
    moving: Tensor  # [U] 1 where it is not pinned


@init_names_checked
@dataclass(frozen=True, eq=False, repr=False)
class Tendons(Coupling):
    """Tendons k / 2 max(0, l - L)^2, l the length of a route through points along which the tendon slides freely.

    Its tension k (l - L) is the same everywhere. Shortening L is the actuation.

    Args:
        points: The points of all routes.
        routes: For each tendon the points that it runs through, in order: indices into ``points``, at least two.
        stiffness: k [N/m], a number or one for each of the R tendons, shape [R].
        rest_length: L [m], the same.

    Inputs: ``tendon_stiffness`` and ``tendon_rest_length`` [R].

    Raises:
        TypeError, ValueError: Naming the argument, as Springs; a route of fewer than two points, an index out of range.

    Source: docs/method.md, section 21; docs/attachments.md.
    """

    name: ClassVar[str] = "tendon"
    parameters: ClassVar[dict[str, int]] = {"stiffness": 1, "rest_length": 1}
    units: ClassVar[dict[str, str]] = {"stiffness": "N/m", "rest_length": "m"}

    _segments: ClassVar[_Differences]
    _own: ClassVar[_Own]

    points: Embedding
    routes: Sequence[Sequence[int]]
    stiffness: float | Tensor
    rest_length: float | Tensor

    def __post_init__(self) -> None:
        check_kind("points", self.points, Embedding)
        if not isinstance(self.routes, (list, tuple)) or not self.routes:
            fail("routes", "a list of lists of points, one for each tendon", repr(self.routes))
        routes = []
        for k, route in enumerate(self.routes):
            own = int_array(f"routes[{k}]", route, (None,))
            if len(own) < 2:
                fail(f"routes[{k}]", "at least two points", len(own))
            if own.min() < 0 or own.max() >= len(self.points):
                fail(f"routes[{k}]", f"indices in [0, {len(self.points)})", f"{own.min()}..{own.max()}")
            routes.append(tuple(own.tolist()))
        object.__setattr__(self, "routes", tuple(routes))
        self._take_numbers()
        self._check_counts("tendon")

    def __repr__(self) -> str:
        return f"Tendons({self._count()})"

    def _count(self) -> int:
        return len(self.routes)

    def of_mesh(self, mesh: TetMesh, pinned: Tensor) -> Tendons:
        self.points.check("points", mesh.num_vertices)
        vertices, weights = self.points.vertices.numpy(), self.points.weights.numpy()
        shape = (len(self.routes), max(map(len, self.routes)) - 1, 2 * vertices.shape[1])
        index, w = np.zeros(shape, dtype=np.int64), np.zeros(shape)
        for k, route in enumerate(self.routes):
            a, b = list(route[:-1]), list(route[1:])
            index[k, : len(a)] = np.concatenate([vertices[b], vertices[a]], -1)
            w[k, : len(a)] = np.concatenate([weights[b], -weights[a]], -1)
        segments = _Differences.of(index, w, pinned)
        entry = segments.rows.group.reshape(-1)[: segments.rows.rows].reshape(shape[0], -1)
        own, of = torch.unique(entry + torch.arange(shape[0])[:, None] * mesh.num_vertices, return_inverse=True)
        tendon, vertex = own // mesh.num_vertices, own % mesh.num_vertices
        acts = torch.zeros_like(own, dtype=torch.float64).index_fill(0, of[segments.weights.flatten(1) != 0], 1.0)
        own = _Own(Rows.of(of.reshape(-1), len(own)), Rows.of(tendon, shape[0]), Rows.of(vertex, mesh.num_vertices),
                   acts, (~pinned[vertex]).double())  # fmt: skip
        return self._with(_segments=segments, _own=own)

    def joins(self) -> tuple[Tensor, Tensor]:
        vertices = self.points.vertices
        return torch.cat([_pairs(vertices[list(route)].reshape(1, -1)) for route in self.routes]), vertices.new_zeros(0)

    def tension(self, x: Tensor, values: dict[str, Tensor]) -> Tensor:
        """Tension of each tendon [N], [B, R]."""
        return self._tension(_length(self._segments.take(x))[0], values)

    def _tension(self, length: Tensor, values: dict[str, Tensor]) -> Tensor:
        return values["stiffness"] * (length.sum(-1) - values["rest_length"]).clamp(min=0)

    def terms(self, x: Tensor, values: dict[str, Tensor]) -> Tensor:
        longer = _length(self._segments.take(x))[0].sum(-1) - values["rest_length"]
        return values["stiffness"] / 2 * longer.clamp(min=0).square()

    def load(self, x: Tensor, values: dict[str, Tensor]) -> Tensor:
        d, own = self._segments.take(x), self._own
        length, inverse = _length(d)
        tension = self._tension(length, values)
        # k n n' with n_i = dl / dx_i, whose rows are bounded by lengths, and what turns the segments, T / |d| at most
        turns = (tension[..., None] * inverse)[..., None]
        parts = own.of_entries.sum(self._segments.spread(inverse[..., None] * d, turns))
        slope, turning = parts.split((3, 1), -1)
        # smooth where a route is straight, and no less
        acts, moving = (t.to(x.dtype)[:, None] for t in (own.acts, own.moving))
        size = acts * (slope.square().sum(-1, keepdim=True) + STRAIGHT**2).sqrt()
        sums = own.of_tendons.sum(size * moving) * values["stiffness"][..., None]
        pull = own.of_tendons.gather(tension[..., None]) * slope
        return own.of_vertices.sum(torch.cat([pull, size * own.of_tendons.gather(sums) + turning], -1))

    def differences(self) -> tuple[IntArray, np.ndarray]:
        return self._segments.vertices, self._segments.weights.cpu().numpy()

    def curvature(self, x: Tensor, values: dict[str, Tensor]) -> Curvature:
        d = self._segments.take(x)
        length, inverse = _length(d)
        tension, normal = self._tension(length, values), inverse[..., None] * d
        rate = torch.where(tension > 0, values["stiffness"], 0.0)
        return Curvature(rate, normal, _across(tension[..., None] * inverse, normal))


class _Surfaces(NamedTuple):
    """Closed surfaces: C cavities, F triangles, E edges."""

    corners: Rows  # 3 F + 2 E: first, second and third corners, then the two ends of each edge
    opposite: Rows  # 2 E: the third corners of the two triangles of each edge
    of_faces: Rows  # F, by cavity
    of_edges: Rows  # E, by cavity
    origin: Tensor  # [F] a vertex of each triangle's cavity
    moving: Tensor  # [2, E] 1 where the other end of an edge is not pinned


def _edges_of(triangles: IntArray, name: str) -> IntArray:
    """Ends and opposite corners [E, 4] of the edges of a closed surface; raises where it is open or not a surface."""
    a, b, c = triangles.T
    directed = np.concatenate([np.stack(t, 1) for t in ((a, b, c), (b, c, a), (c, a, b))])
    count = int(triangles.max()) + 1
    key, back = directed[:, 0] * count + directed[:, 1], directed[:, 1] * count + directed[:, 0]
    ranked = np.sort(key)
    if (repeats := ranked[1:][ranked[1:] == ranked[:-1]]).size:
        edge = divmod(int(repeats[0]), count)
        fail(name, "a closed surface with all triangles wound alike", f"the edge {edge} twice in one direction")
    place = np.searchsorted(ranked, back).clip(max=len(key) - 1)
    lone = ranked[place] != back
    if lone.any():
        edge = tuple(directed[lone][0, :2].tolist())
        fail(name, "a closed surface", f"an open edge {edge}, which is in one triangle only")
    other = directed[np.argsort(key)[place], 2]
    once = directed[:, 0] < directed[:, 1]
    return np.concatenate([directed, other[:, None]], 1)[once]


@init_names_checked
@dataclass(frozen=True, eq=False, repr=False)
class Pressure(Coupling):
    """Gas in closed cavities, that pushes their walls outwards: E = -p V, V the enclosed volume.

    With ``gas`` the amount of gas is given, not its pressure: p is the pressure above ambient at the cavity's volume V0
    in the Model's rest shape, and (p + ambient) V0 = (p' + ambient) V at another one (isothermal).

    Args:
        triangles: A closed surface [F, 3], or a list of one for each of the C cavities, wound either way; None: all
            cavities of the mesh (:func:`diffvbd.mesh.cavities`).
        pressure: p above ambient [Pa], a number or one for each cavity, shape [C]; at least -ambient with ``gas``.
        gas: Whether the amount of gas is constant.
        ambient: Absolute pressure outside [Pa], which only ``gas`` reads; 0 in a vacuum.

    Inputs: ``pressure`` [C].

    Raises:
        TypeError, ValueError: Naming the argument; in the Model, a surface that is not closed (it names an open edge),
            one without volume, a mesh without cavities.

    Source: docs/method.md, section 21; docs/attachments.md.
    """

    name: ClassVar[str] = "pressure"
    parameters: ClassVar[dict[str, int]] = {"pressure": 1}
    units: ClassVar[dict[str, str]] = {"pressure": "Pa"}
    strength: ClassVar[str] = "pressure"

    surfaces: ClassVar[tuple[IntArray, ...]]  # in a Model: the triangles of each cavity, normals into the walls
    _surfaces: ClassVar[_Surfaces]
    _rest_volume: ClassVar[Tensor]

    triangles: Any = None
    pressure: float | Tensor = 0.0
    gas: bool = False
    ambient: float = ATMOSPHERE

    def __post_init__(self) -> None:
        check_bool("gas", self.gas)
        object.__setattr__(self, "ambient", check_number("ambient", self.ambient, "a finite number >= 0 Pa"))
        if self.triangles is not None:
            first = next(iter(self.triangles), ()) if isinstance(self.triangles, (list, tuple)) else ()
            several = np.ndim(first) == 2
            given = self.triangles if several else [self.triangles]
            names = [f"triangles[{k}]" if several else "triangles" for k in range(len(given))]
            found = [int_array(name, part, (None, 3)) for name, part in zip(names, given, strict=True)]
            object.__setattr__(self, "triangles", tuple(found))
        self._take_numbers()

    def __repr__(self) -> str:
        return f"Pressure({'' if self.triangles is None else len(self.triangles)}{', gas' * self.gas})"

    def _count(self) -> int:
        return len(self._rest_volume)

    def least(self, key: str) -> float:
        return -self.ambient if self.gas else -math.inf

    def of_mesh(self, mesh: TetMesh, pinned: Tensor) -> Pressure:
        given = cavities(mesh) if self.triangles is None else self.triangles
        if not given:
            fail("triangles", "closed surfaces, or a mesh with cavities", "a mesh without")
        volumes, faces, edges = [], [], []
        for k, part in enumerate(given):
            name = f"triangles[{k}]" if len(given) > 1 else "triangles"
            if not len(part) or part.min() < 0 or part.max() >= mesh.num_vertices:
                got = f"{part.min()}..{part.max()}" if len(part) else "no triangles"
                fail(name, f"vertices in [0, {mesh.num_vertices})", got)
            a, b, c = (mesh.points[part[:, i]] - mesh.points[part[0, 0]] for i in range(3))
            volume = float(np.einsum("ni,ni->", a, np.cross(b, c)) / 6)
            if abs(volume) <= 1e-12 * np.abs(a).max() ** 3:
                fail(name, "a surface that encloses a volume at rest", f"{volume:.3g} m^3")
            part = part if volume > 0 else part[:, ::-1]
            volumes.append(abs(volume))
            faces.append(part)
            edges.append(_edges_of(part, name))
        of_faces, of_edges = (np.repeat(np.arange(len(p)), list(map(len, p))) for p in (faces, edges))
        origin = np.array([part[0, 0] for part in faces])[of_faces]
        face, edge = np.concatenate(faces), np.concatenate(edges)

        def rows(groups: IntArray, count: int) -> Rows:
            return Rows.of(torch.from_numpy(np.ascontiguousarray(groups)), count)

        ends = edge[:, [0, 1]].T
        corners = rows(np.concatenate([*face.T, *ends]), mesh.num_vertices)
        opposite = rows(edge[:, [2, 3]].T.reshape(-1), mesh.num_vertices)
        moving = (~pinned[torch.from_numpy(ends[::-1].copy())]).double()
        surfaces = _Surfaces(corners, opposite, rows(of_faces, len(faces)), rows(of_edges, len(faces)),
                             torch.from_numpy(origin), moving)  # fmt: skip
        rest = torch.tensor(volumes, dtype=torch.float64)
        out = self._with(surfaces=tuple(faces), _surfaces=surfaces, _rest_volume=rest)
        out._check_counts("cavity")
        return out

    def _faces(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Volumes [B, C], and twice the area vectors of the triangles [B, F, 3]."""
        s = self._surfaces
        a, b, c = s.corners.gather(x)[:, : 3 * s.of_faces.rows].unflatten(1, (3, -1)).unbind(1)
        normal = torch.linalg.cross(b - a, c - a)
        # about a vertex of the cavity: small numbers. A closed surface has the same volume about any point
        volume = (normal * (a - x.detach()[:, s.origin])).sum(-1, keepdim=True) / 6
        return s.of_faces.sum(volume)[..., 0], normal

    def state(self, x: Tensor, values: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
        """Pressure above ambient [Pa] and volume [m^3] of each cavity, [B, C]."""
        volume = self._faces(x)[0]
        return self._gauge(volume, values), volume

    def _gauge(self, volume: Tensor, values: dict[str, Tensor]) -> Tensor:
        if not self.gas:
            return values["pressure"]
        return (values["pressure"] + self.ambient) * self._rest_volume.to(volume.dtype) / volume - self.ambient

    def terms(self, x: Tensor, values: dict[str, Tensor]) -> Tensor:
        volume = self._faces(x)[0]
        if not self.gas:
            return -values["pressure"] * volume
        rest = self._rest_volume.to(x.dtype)
        work = (values["pressure"] + self.ambient) * rest * (volume / rest).log()  # NaN where inside out
        return self.ambient * volume - work

    def load(self, x: Tensor, values: dict[str, Tensor]) -> Tensor:
        s = self._surfaces
        volume, normal = self._faces(x)
        if self.gas and looks_at(volume):
            what = "cavities of positive volume [m^3], for their gas; a smaller time_step keeps them so"
            name_value("x", what, volume.detach(), volume.detach() > 0, ("scene", "cavity"))
        gauge = self._gauge(volume, values)
        of_face, of_edge = s.of_faces.gather(gauge[..., None]), s.of_edges.gather(gauge.abs()[..., None])
        one, two = s.opposite.gather(x).unflatten(1, (2, -1)).unbind(1)
        # V is linear in each vertex. Its second derivative by both ends of an edge has the norm |c1 - c2| / 6, of
        # either sign, c1 and c2 the opposite corners; |p| times a row of these bounds -p V about x.
        bent = of_edge * _length(one - two)[0][..., None] / 6
        bent = (s.moving.to(x.dtype)[None, ..., None] * bent[:, None]).flatten(1, 2)
        slope = -of_face * normal / 6
        bound = torch.zeros_like(slope[..., :1])
        if self.gas:  # and (p + ambient) / V dV/dx_i dV/dx_j, whose rows are bounded by areas
            size = _length(normal)[0][..., None] / 6
            stiff = ((gauge + self.ambient) / volume).clamp(min=0) * 3 * s.of_faces.sum(size)[..., 0]
            bound = size * s.of_faces.gather(stiff[..., None])
        faces = torch.cat([slope, bound], -1).repeat(1, 3, 1)
        edges = torch.cat([torch.zeros_like(bent).expand(-1, -1, 3), bent], -1)
        return s.corners.sum(torch.cat([faces, edges], 1))

    def differences(self) -> tuple[IntArray, np.ndarray]:
        # the corners of all triangles: a vertex may be on two cavities
        most = max(map(len, self.surfaces))
        index, weights = (
            np.zeros((len(self.surfaces), 3 * most, 1), dtype=np.int64),
            np.zeros((len(self.surfaces), most)),
        )
        for k, own in enumerate(self.surfaces):
            index[k, : own.size, 0] = own.reshape(-1)
            weights[k, : len(own)] = 1.0
        return index, weights.repeat(3, 1)[..., None]

    def curvature(self, x: Tensor, values: dict[str, Tensor]) -> Curvature | None:
        if not self.gas:
            return None
        volume, normal = self._faces(x)
        rate = ((self._gauge(volume, values) + self.ambient) / volume).clamp(min=0)
        parts, most = normal.split(list(map(len, self.surfaces)), 1), max(map(len, self.surfaces))
        padded = torch.stack([pad(part, (0, 0, 0, most - part.shape[1])) for part in parts], 1)
        return Curvature(rate, padded.repeat_interleave(3, 2) / 6, None)

    def joins(self) -> tuple[Tensor, Tensor]:
        corners = [torch.from_numpy(own.reshape(-1, 1).copy()) for own in self.surfaces]
        pairs = torch.cat([torch.cat([own, own[:1].expand_as(own)], 1) for own in corners])
        return pairs, pairs.new_zeros(0)


COUPLINGS: tuple[type[Coupling], ...] = (Springs, Tendons, Pressure)


def load_of(couplings: Sequence[Coupling], values: Sequence[dict[str, Tensor]], x: Tensor) -> Tensor:
    """The sum of their loads at x [B, V, 3], [B, V, 4]; values: of each one."""
    parts = [energy.load(x, own) for energy, own in zip(couplings, values, strict=True)]
    return torch.stack(parts).sum(0) if len(parts) > 1 else parts[0]
