"""Points that move with a mesh: each one is a weighted sum of vertices."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ._common.checks import check_bool, fail, kind_of
from ._common.messages import warn
from .mesh import TetMesh
from .mesh.arrays import FloatArray, IntArray, check_mesh, float_array, int_array
from .mesh.tet_mesh import boundary_faces
from .ops.sums import Rows

CHUNK = 500_000  # distances that are held at once
INSIDE = -1e-9  # least weight of a point that counts as inside a tet
FAR = 1.5  # of the height of a tet, from which extrapolated points are warned of


class Embedding:
    """Points as weighted sums of vertices: markers, skins, sensors, and the ends of springs and tendons.

    Args:
        vertices: Vertices of each point, shape [P, n], integers.
        weights: Their weights [-], shape [P, n]. Points that move with the body have weights of sum 1.

    Attributes:
        vertices, weights: These, int64 and float64 tensors on the CPU.

    Raises:
        TypeError, ValueError: Naming the argument: no integers or numbers, shapes that differ, no points, a negative
            index, NaN, a tensor that requires grad.
    """

    def __init__(self, vertices: Any, weights: Any) -> None:
        index = int_array("vertices", vertices, (None, None))
        if not index.size:
            fail("vertices", "at least one vertex of at least one point", f"shape {list(index.shape)}")
        if index.min() < 0:
            fail("vertices", "indices >= 0", int(index.min()))
        values = float_array("weights", weights, (None, None))
        if values.shape != index.shape:
            fail("weights", f"shape {list(index.shape)}, that of vertices", f"shape {list(values.shape)}")
        self.vertices, self.weights = torch.from_numpy(index), torch.from_numpy(values)
        self._placed: dict[Any, tuple[Rows, Tensor]] = {}

    @classmethod
    def of_vertices(cls, indices: Any) -> Embedding:
        """Vertices themselves as points; ``indices`` [P], integers."""
        index = int_array("indices", indices, (None,))
        return cls(index[:, None], np.ones((len(index), 1)))

    @classmethod
    def of_points(cls, mesh: TetMesh, points: Any, surface: bool = False) -> Embedding:
        """Points of space that move with the rest shape of a mesh.

        Args:
            mesh: Its tets take the points along.
            points: [m], shape [P, 3]. A point inside a tet has its barycentric weights. One outside is extrapolated
                from the closest tet, so that ``at`` the rest points it is where it was given.
            surface: Take the closest point on the surface instead, with the weights of its triangle.

        Raises:
            TypeError, ValueError: No TetMesh, one without tets, points of another shape, NaN. Points that lie farther
                outside than a tet is high are warned of.
        """
        check_mesh(mesh)
        check_bool("surface", surface)
        given = float_array("points", points, (None, 3))
        if not mesh.num_tets:
            fail("mesh", "at least one tet", "none")
        if surface:
            faces = mesh.surface
            face, weights = _closest(given, mesh.points[faces])
            return cls(faces[face], weights)
        tet, weights, inside = _containing(given, mesh.points[mesh.tets])
        if not inside.all():
            faces, owner = boundary_faces(mesh.tets, mesh.num_vertices)
            out = np.flatnonzero(~inside)
            tet[out] = owner[_closest(given[out], mesh.points[faces])[0]]
            weights[out] = _barycentric(given[out], mesh.points[mesh.tets[tet[out]]])
            _warn_of_far(out, given, weights)
        return cls(mesh.tets[tet], weights)

    def check(self, name: str, num_vertices: int) -> None:
        """Raises ValueError unless all vertices are those of a mesh."""
        most = int(self.vertices.max())
        if most >= num_vertices:
            fail(name, f"vertices in [0, {num_vertices})", most)

    def at(self, x: Tensor) -> Tensor:
        """The points at positions of the vertices, differentiable in x; the same bits from run to run.

        Args:
            x: Positions [m] or other vectors of vertices, shape [..., V, 3], float64 or float32.

        Returns:
            Shape [..., P, 3].
        """
        if not isinstance(x, Tensor):
            raise TypeError(f"x: expected a tensor of shape [..., V, 3], got {kind_of(x)}")
        if x.dim() < 2 or x.shape[-1] != 3:
            fail("x", "shape [..., V, 3]", f"shape {list(x.shape)}")
        if x.dtype not in (torch.float32, torch.float64):
            raise TypeError(f"x: expected float64 or float32, got {x.dtype}")
        lead, count, key = x.shape[:-2], x.shape[-2], (x.shape[-2], x.dtype, x.device)
        if key not in self._placed:
            self.check("x: this Embedding", count)
            with torch.inference_mode(False), torch.no_grad():
                rows = Rows.of(self.vertices.reshape(-1), count).to(x.device)
                self._placed[key] = rows, self.weights.to(x.device, x.dtype)
        rows, weights = self._placed[key]
        corners = rows.gather(x.reshape(math.prod(lead), count, 3)).unflatten(1, tuple(weights.shape))
        return (corners * weights[..., None]).sum(2).reshape(*lead, len(weights), 3)

    def __len__(self) -> int:
        return len(self.vertices)

    def __repr__(self) -> str:
        return f"Embedding({len(self)} points of {self.vertices.shape[1]} vertices each)"

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_placed": {}}


def _warn_of_far(out: IntArray, points: FloatArray, weights: FloatArray) -> None:
    """Warns of points outside by more than a tet is high: a small strain of that tet moves them by far."""
    far = out[-weights[out].min(1) > FAR]
    if len(far):
        worst = far[weights[far].min(1).argmin()]
        warn(f"points: {len(far)} of {len(points)} lie farther outside the mesh than its tets are high, the farthest "
             f"is point {worst} at {points[worst].tolist()}; their motion is extrapolated, surface=True takes the "
             "closest points of the surface")  # fmt: skip


def _pairs(points: FloatArray, corners: FloatArray, nearest: bool) -> Iterator[tuple[IntArray, IntArray]]:
    """Points and cells [C, n, 3] that can meet: those within a cell's radius of its center, or with ``nearest`` those
    that can be the closest, chunk by chunk."""
    center: FloatArray = corners.mean(1)
    radius = np.linalg.norm(corners - center[:, None], axis=-1).max(1) * (1 + 1e-9)
    step = max(1, CHUNK // len(corners))
    for first in range(0, len(points), step):
        distance = np.linalg.norm(points[first : first + step, None] - center, axis=-1)
        bound = distance.min(1, keepdims=True) if nearest else 0.0  # a center is a point of its cell
        point, cell = np.nonzero(distance - radius <= bound)
        yield point + first, cell


def _best(point: IntArray, value: FloatArray) -> tuple[IntArray, IntArray]:
    """Points that occur, and the place of the least value of each, the first of equal ones."""
    order = np.lexsort((value, point))
    first = np.concatenate([[True], point[order][1:] != point[order][:-1]]) if len(point) else order.astype(bool)
    return point[order[first]], order[first]


def _barycentric(points: FloatArray, tets: FloatArray) -> FloatArray:
    """Weights [n, 4] of points [n, 3] in tets [n, 4, 3]."""
    edges = np.swapaxes(tets[:, 1:] - tets[:, :1], 1, 2)
    others = np.asarray(np.linalg.solve(edges, (points - tets[:, 0])[..., None])[..., 0], dtype=np.float64)
    return np.concatenate([1 - others.sum(1, keepdims=True), others], 1)


def _containing(points: FloatArray, tets: FloatArray) -> tuple[IntArray, FloatArray, NDArray[np.bool_]]:
    """A tet that contains each point, the weights there, and whether there is one."""
    tet = np.zeros(len(points), dtype=np.int64)
    weights, inside = np.zeros((len(points), 4)), np.zeros(len(points), dtype=bool)
    for point, cell in _pairs(points, tets, nearest=False):
        own = _barycentric(points[point], tets[cell])
        found, place = _best(point, -own.min(1))
        tet[found], weights[found], inside[found] = cell[place], own[place], own[place].min(1) >= INSIDE
    return tet, weights, inside


def _closest(points: FloatArray, triangles: FloatArray) -> tuple[IntArray, FloatArray]:
    """The closest of triangles [F, 3, 3] to each point, and the weights [P, 3] of the closest point on it."""
    face, weights = np.zeros(len(points), dtype=np.int64), np.zeros((len(points), 3))
    for point, cell in _pairs(points, triangles, nearest=True):
        own, square = _on_triangle(points[point], triangles[cell])
        found, place = _best(point, square)
        face[found], weights[found] = cell[place], own[place]
    return face, weights


def _on_triangle(points: FloatArray, triangles: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Weights [n, 3] of the closest point of each triangle [n, 3, 3] to its point, and its squared distance."""
    a, b, c = (triangles[:, k] for k in range(3))
    normal = np.cross(b - a, c - a)
    size = np.einsum("ni,ni->n", normal, normal)[:, None]
    # the foot on the plane, where it is inside, and the closest point of each edge
    areas = [np.cross(q - p, points - p) for p, q in ((b, c), (c, a), (a, b))]
    foot = np.stack([np.einsum("ni,ni->n", area, normal) for area in areas], 1) / size
    candidates = [np.where((foot >= 0).all(1, keepdims=True), foot, np.eye(3)[0])]
    for i, j in ((0, 1), (1, 2), (2, 0)):
        edge = triangles[:, j] - triangles[:, i]
        along = np.einsum("ni,ni->n", points - triangles[:, i], edge) / np.einsum("ni,ni->n", edge, edge)
        weights, along = np.zeros((len(points), 3)), np.clip(along, 0, 1)
        weights[:, i], weights[:, j] = 1 - along, along
        candidates.append(weights)
    options = np.stack(candidates, 1)  # [n, 4, 3]
    square = np.square(options @ triangles - points[:, None]).sum(-1)
    best = square.argmin(1)
    rows = np.arange(len(points))
    return options[rows, best], square[rows, best]
