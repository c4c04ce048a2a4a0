"""Which edges cross which triangles: the check of a state that knows nothing of distances, bounds or detection.

The signs of the determinants are exact: those that rounding could change are evaluated again in integers.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from torch import Tensor

CHUNK = 1 << 21  # boxes compared at a time
# Shewchuk (1997): a 3x3 determinant of differences is off by less than this times the sum of its terms' sizes.
ERROR_BOUND = (7 + 28 * np.finfo(np.float64).eps) * np.finfo(np.float64).eps / 2


def intersections(x: Any, triangles: Any, edges: Any, body: Any = None) -> Tensor:
    """Pairs [n, 2] int64 of (edge, triangle) that cross, in lexicographic order.

    An edge crosses a triangle, with which it shares no vertex, when its ends lie strictly on both sides of the plane
    and it meets the closed triangle, border included: passing through the seam of two triangles counts, and so does an
    edge that touches another one's side exactly; an end on the triangle, or an edge in its plane, does not.

    Args:
        x: Positions, [N, 3], a tensor or an array.
        triangles, edges: Vertices, [F, 3] and [E, 2].
        body: Labels [N]: edges are tested against triangles of other bodies alone. None: against all.

    Raises:
        ValueError: a shape is wrong, or a position is not finite.
    """
    x, triangles, edges = (_array(value) for value in (x, triangles, edges))
    for name, value, width in (("x", x, 3), ("triangles", triangles, 3), ("edges", edges, 2)):
        if value.ndim != 2 or value.shape[1] != width:
            raise ValueError(f"{name}: expected shape [n, {width}], got {list(value.shape)}")
    x, label = x.astype(np.float64), None if body is None else _array(body)
    if not np.isfinite(x).all():
        raise ValueError(f"x: expected finite positions, got {int((~np.isfinite(x)).any(1).sum())} that are not")
    predicates = _Predicates(x)
    found = [np.empty((0, 2), np.int64)]
    for edge, triangle in _overlapping_boxes(x[edges], x[triangles]):
        ends, corners = edges[edge], triangles[triangle]
        apart = (ends[:, :, None] != corners[:, None, :]).all((1, 2))
        if label is not None:
            apart &= label[ends[:, 0]] != label[corners[:, 0]]
        edge, triangle, ends, corners = edge[apart], triangle[apart], ends[apart], corners[apart]
        crossing = predicates.cross(ends, corners)
        found.append(np.stack((edge[crossing], triangle[crossing]), 1))
    pairs = np.concatenate(found)
    return torch.from_numpy(pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))])


def _array(value: Any) -> np.ndarray:
    return value.detach().cpu().numpy() if isinstance(value, Tensor) else np.asarray(value)


def _overlapping_boxes(edges: np.ndarray, triangles: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Indices of edges [E, 2, 3] and triangles [F, 3, 3] whose boxes overlap, a chunk at a time: triangles are sorted
    by their lower end along one axis, where each edge then meets one interval of them."""
    if not len(edges) or not len(triangles):
        return
    (low_e, high_e), (low_t, high_t) = ((s.min(1), s.max(1)) for s in (edges, triangles))
    best: tuple = ()
    for axis in range(3):
        order = np.argsort(low_t[:, axis], kind="stable")
        reached = np.maximum.accumulate(high_t[order, axis])  # of this triangle and all before it
        first = np.searchsorted(reached, low_e[:, axis], "left")
        last = np.searchsorted(low_t[order, axis], high_e[:, axis], "right")
        size = np.maximum(last - first, 0)
        if not best or size.sum() < best[0]:
            best = (size.sum(), order, first, size)
    _, order, first, size = best
    total = np.concatenate(([0], np.cumsum(size)))
    start = 0
    while start < len(edges):
        stop = max(start + 1, int(np.searchsorted(total, total[start] + CHUNK, "right")) - 1)
        edge = np.repeat(np.arange(start, stop), size[start:stop])
        place = np.arange(total[start], total[stop]) - total[edge] + first[edge]
        triangle = order[place]
        for axis in range(3):
            keep = (low_e[edge, axis] <= high_t[triangle, axis]) & (low_t[triangle, axis] <= high_e[edge, axis])
            edge, triangle = edge[keep], triangle[keep]
        yield edge, triangle
        start = stop


class _Predicates:
    """Exact signs of volumes of tetrahedra among points [N, 3]."""

    def __init__(self, x: np.ndarray) -> None:
        self.x = x
        self.integers: np.ndarray | None = None

    def cross(self, ends: np.ndarray, corners: np.ndarray) -> np.ndarray:
        """Whether edges [n, 2] cross triangles [n, 3], as `intersections` defines it."""
        p, q = ends.T
        sides = [self.side(np.column_stack((corners, end))) for end in (p, q)]
        crossing = sides[0] * sides[1] < 0
        p, q, corners = p[crossing], q[crossing], corners[crossing]
        turns = [self.side(np.column_stack((p, q, corners[:, k], corners[:, k - 2]))) for k in range(3)]
        crossing[crossing] = np.abs(np.sign(turns).sum(0)) == np.abs(np.sign(turns)).sum(0)
        return crossing

    def side(self, tets: np.ndarray) -> np.ndarray:
        """Sign of the volume of tetrahedra [n, 4]."""
        volume, size = _determinant(*(self.x[tets[:, k]] for k in range(4)))
        sign = np.sign(volume).astype(np.int64)
        unsure = np.abs(volume) <= ERROR_BOUND * size
        if unsure.any():
            self.integers = _scaled_integers(self.x) if self.integers is None else self.integers
            exact, _ = _determinant(*(self.integers[tets[unsure, k]] for k in range(4)))
            sign[unsure] = (exact > 0).astype(np.int64) - (exact < 0).astype(np.int64)
        return sign


def _determinant(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """det [a - d, b - d, c - d] of points [n, 3], and the sum of the sizes of its terms."""
    (ax, ay, az), (bx, by, bz), (cx, cy, cz) = ((s - d).T for s in (a, b, c))
    positive = (ax * by, bx * cy, cx * ay)
    negative = (bx * ay, cx * by, ax * cy)
    factors = (cz, az, bz)
    volume = sum(f * (s - t) for f, s, t in zip(factors, positive, negative, strict=True))
    size = sum(abs(f) * (abs(s) + abs(t)) for f, s, t in zip(factors, positive, negative, strict=True))
    return np.asarray(volume), np.asarray(size)


def _scaled_integers(x: np.ndarray) -> np.ndarray:
    """The same numbers times one power of 2, as Python integers."""
    mantissa, exponent = np.frexp(x)
    whole = (mantissa * 2.0**53).astype(np.int64).astype(object)
    return whole << (exponent - exponent.min()).astype(object)
