"""The coarse space of a Model: fixed functions on each body's rest shape, and groups of tets that turn together.

    A = P' M P + h^2 sum over groups of R_g (P' K_g P) R_g',        P = W x I3,

where W has a row for each vertex and a column for each function, K_g is the stiffness of the tets of group g at rest
and R_g the mean rotation of that group (docs/method.md, section 15). Everything here depends on the rest shape alone.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from .. import ops
from ..checks import check_count

FEWEST, MOST = 32, 128  # functions of a body under "auto"
PER_FUNCTION = 25  # vertices of a large body for each function
PER_FUNCTION_SMALL = 6  # and of a small one
PER_FUNCTION_SHEET = 18
PER_GROUP = 4
SHEET = 0.125  # a body is a sheet if its thickness is below this share of its second extent
GRID = 8  # functions from which on they are splines; fewer are affine
DEPENDENT = 1e-6  # squared distance of a normalised function from the span of others, below which it is left out
PACK = ops.LANES["cpu"]  # a body's matrix has 1, 2, 4 or a multiple of as many functions


@dataclass(frozen=True)
class CoarseSpace:
    """Coarse correction between sweeps: what few sweeps do badly, the motion of large parts, done by one small system.

    Args:
        functions: Of each body, at most. ``"auto"``: a 25th of its vertices, 32 to 128; small bodies fewer, down to
            affine functions and constants.
        degree: Of the splines on the body's rest box, 1 to 3. ``"auto"``: 1, in the plane of a sheet 3.
        groups: Sets of neighbouring tets of a body with one rotation each. ``"auto"``: a quarter of its functions.
        every: Sweeps after each correction. A step is: one sweep, then a correction and up to ``every`` sweeps, again
            until ``sweeps`` are done; without sweeps it is one correction.

    Source: docs/method.md, section 15.
    """

    functions: int | Literal["auto"] = "auto"
    degree: int | Literal["auto"] = "auto"
    groups: int | Literal["auto"] = "auto"
    every: int = 3

    def __post_init__(self) -> None:
        for name in ("functions", "groups"):
            if getattr(self, name) != "auto":
                check_count(name, getattr(self, name), 1)
        if self.degree != "auto":
            check_count("degree", self.degree, 1, maximum=3)
        check_count("every", self.every, 1)

    def corrections(self, sweeps: int) -> int:
        """How many corrections a step of so many sweeps has."""
        return ops.corrections_of(sweeps, self.every)


class CoarseGeometry(NamedTuple):
    """Functions and groups of all bodies that have a vertex to move, those of the smallest matrix first."""

    function_ptr: np.ndarray  # int [bodies + 1]; functions that only fill up a matrix come last in each body
    vertex: np.ndarray  # int [entries], of W, sorted
    function: np.ndarray  # int [entries]
    weight: np.ndarray  # float64 [entries]
    tet_group: np.ndarray  # int [T], -1: a tet without a vertex to move
    group_body: np.ndarray  # int [G]
    group_functions: np.ndarray  # int [G, n], functions that act on a tet of the group; -1 beyond the last
    filling: np.ndarray  # bool [F], functions that act on no vertex

    @property
    def bodies(self) -> int:
        return len(self.function_ptr) - 1

    @property
    def functions(self) -> int:
        return int(self.function_ptr[-1])


def build_coarse(points: np.ndarray, tets: np.ndarray, pinned: np.ndarray, label: np.ndarray, space: CoarseSpace
                 ) -> CoarseGeometry:  # fmt: skip
    """points [V, 3], tets [T, 4], pinned bool [V], label [V]: equal in a connected body."""
    order = np.argsort(label, kind="stable")
    starts = np.flatnonzero(np.diff(label[order], prepend=-1))
    tet_order = np.argsort(label[tets[:, 0]], kind="stable") if len(tets) else np.zeros(0, dtype=np.int64)
    tet_label = label[tets[tet_order, 0]] if len(tets) else tet_order
    found = []
    for vertices in np.split(order, starts[1:]):
        own = slice(*np.searchsorted(tet_label, [label[vertices[0]], label[vertices[0]] + 1]))
        free = ~pinned[vertices]
        if own.start == own.stop or not free.any():
            continue
        weights = _functions(points[vertices], free, space)
        count = weights.shape[1]
        if not count:
            continue
        groups = -(-count // PER_GROUP) if space.groups == "auto" else space.groups
        members = tet_order[own]
        group = _groups(points[tets[members]].mean(1), min(groups, len(members)))
        found.append((_size(count), count, vertices, weights, members, group))
    found.sort(key=lambda body: body[0])

    function_ptr = np.concatenate(([0], np.cumsum([body[0] for body in found]))).astype(np.int64)
    tet_group, group_body = np.full(len(tets), -1), []
    filling = np.ones(int(function_ptr[-1]), dtype=bool)
    entries: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    for body, (_, count, vertices, weights, members, group) in enumerate(found):
        row, column = np.nonzero(weights)
        entries.append((vertices[row], column + function_ptr[body], weights[row, column]))
        filling[function_ptr[body] : function_ptr[body] + count] = False
        tet_group[members] = group + len(group_body)
        group_body += [body] * (int(group.max()) + 1)
    vertex, function, weight = (
        (np.concatenate(part) if part else np.zeros(0))
        for part in (zip(*entries, strict=True) if entries else ([],) * 3)
    )
    vertex, function = vertex.astype(np.int64), function.astype(np.int64)
    sort = np.lexsort((function, vertex))
    vertex, function, weight = vertex[sort], function[sort], weight[sort]
    groups = _functions_of_groups(tets, tet_group, len(group_body), vertex, function, len(points))
    return CoarseGeometry(function_ptr, vertex, function, weight, tet_group, np.array(group_body, dtype=np.int64),
                          groups, filling)  # fmt: skip


def _size(count: int) -> int:
    return next((size for size in (1, 2, 4) if size >= count), -(-count // PACK) * PACK)


def _functions(points: np.ndarray, free: np.ndarray, space: CoarseSpace) -> np.ndarray:
    """Independent functions at the vertices of a body [V, n], zero where they are pinned."""
    local = _in_its_box(points)
    extent = np.ptp(local, axis=0)
    long = np.argsort(-extent)
    sheet = extent[long[2]] < SHEET * extent[long[1]]
    target = space.functions
    if target == "auto":
        target = max(int(free.sum()) // (PER_FUNCTION_SHEET if sheet else PER_FUNCTION), FEWEST)
        target = min(target, MOST, max(1, len(points) // PER_FUNCTION_SMALL))
    if target < GRID:
        scaled = (local - local.mean(0)) / np.where(extent > 0, extent, 1.0)
        out = np.concatenate((np.ones((len(points), 1)), scaled), 1)[:, : 4 if target >= 4 else 1]
    else:
        degree = np.full(3, 1 if space.degree == "auto" else space.degree)
        if sheet:
            plane = 3 if space.degree == "auto" else space.degree
            degree[long] = (plane, plane, 1)
        while np.prod(degree + 1) > target:  # one cell has too many
            degree[np.argmax(degree)] -= 1
        cells = _cells(extent, degree, target)
        axes = [_splines(local[:, a], cells[a], degree[a]) for a in range(3)]
        out = np.einsum("va,vb,vc->vabc", *axes).reshape(len(points), -1)
    out = out * free[:, None]
    return out[:, _independent(out)]


def _in_its_box(points: np.ndarray) -> np.ndarray:
    """Positions from the lowest corner of a body's box, along the axes, or along its own where that is far thinner."""
    own = (points - points.mean(0)) @ np.linalg.svd(points - points.mean(0), full_matrices=False)[2].T
    local = own if np.ptp(own, axis=0).min() < 0.5 * np.ptp(points, axis=0).min() else points
    return local - local.min(0)


def _cells(extent: np.ndarray, degree: np.ndarray, target: int) -> np.ndarray:
    """Cells of a grid of at most ``target`` splines: the longest edge of a cell is as short as it can be, then the
    others are."""
    most = [max(1, target // int(np.prod(np.delete(degree, a) + 1)) - int(degree[a])) for a in range(3)]
    best, found = np.ones(3, dtype=np.int64), (np.inf,)
    for first in range(1, most[0] + 1):
        for second in range(1, most[1] + 1):
            third = target // int((first + degree[0]) * (second + degree[1])) - int(degree[2])
            if third < 1:
                break
            # no shorter across than the longest edge asks for
            longest = max(extent[0] / first, extent[1] / second)
            third = min(third, max(1, math.ceil(extent[2] / longest)))
            edges = sorted((extent[0] / first, extent[1] / second, extent[2] / third), reverse=True)
            if tuple(edges) < found:
                best, found = np.array((first, second, third)), tuple(edges)
    return best


def _splines(at: np.ndarray, cells: int, degree: int) -> np.ndarray:
    """Values of the cells + degree uniform B-splines of an interval that ``at`` spans, [n, cells + degree]."""
    unit = at / at.max() * cells if at.max() > 0 else at
    knots = np.arange(-degree, cells + degree + 1)
    inside = np.clip(np.floor(unit), 0, cells - 1)[:, None]
    out = (knots[:-1] == inside).astype(np.float64)
    for d in range(1, degree + 1):
        left = (unit[:, None] - knots[: -d - 1]) / d * out[:, :-1]
        right = (knots[d + 1 :] - unit[:, None]) / d * out[:, 1:]
        out = left + right
    return out


def _independent(functions: np.ndarray) -> np.ndarray:
    """Columns that are no combination of others, by Cholesky's method with pivots, in ascending order."""
    norm = np.sqrt((functions**2).sum(0))
    unit = functions[:, norm > 1e-9 * max(norm.max(initial=0.0), 1e-300)]
    index = np.flatnonzero(norm > 1e-9 * max(norm.max(initial=0.0), 1e-300))
    unit = unit / norm[index]
    gram = unit.T @ unit
    left, rows, kept = np.diag(gram).copy(), np.zeros((0, len(index))), []
    for _ in range(len(index)):
        pivot = int(np.argmax(left))
        if left[pivot] <= DEPENDENT:
            break
        row = (gram[pivot] - rows[:, pivot] @ rows) / np.sqrt(left[pivot])
        rows, kept = np.concatenate((rows, row[None])), [*kept, pivot]
        left = left - row**2
        left[kept] = -1.0
    return np.sort(index[kept])


def _groups(centers: np.ndarray, count: int) -> np.ndarray:
    """Cuts a cloud into ``count`` parts of nearly equal size, each time across its longest side."""
    out = np.zeros(len(centers), dtype=np.int64)
    parts = [(np.arange(len(centers)), count, 0)]
    while parts:
        members, number, first = parts.pop()
        if number == 1:
            out[members] = first
            continue
        axis = int(np.argmax(np.ptp(centers[members], axis=0)))
        sort = members[np.argsort(centers[members, axis], kind="stable")]
        half = number // 2
        cut = len(sort) * half // number
        parts += [(sort[:cut], half, first), (sort[cut:], number - half, first + half)]
    return out


def _functions_of_groups(tets: np.ndarray, tet_group: np.ndarray, groups: int, vertex: np.ndarray,
                         function: np.ndarray, vertices: int) -> np.ndarray:  # fmt: skip
    listed = tet_group >= 0
    pairs = np.unique(np.stack((np.repeat(tet_group[listed], 4), tets[listed].reshape(-1)), 1), axis=0)
    ptr = np.searchsorted(vertex, np.arange(vertices + 1))
    count = ptr[pairs[:, 1] + 1] - ptr[pairs[:, 1]]
    at = np.repeat(ptr[pairs[:, 1]] - np.concatenate(([0], np.cumsum(count)[:-1])), count) + np.arange(count.sum())
    known = np.unique(np.stack((np.repeat(pairs[:, 0], count), function[at]), 1), axis=0)
    number = np.bincount(known[:, 0], minlength=groups)
    out = np.full((groups, int(number.max(initial=0))), -1)
    out[known[:, 0], np.arange(len(known)) - np.repeat(np.cumsum(number) - number, number)] = known[:, 1]
    return out
