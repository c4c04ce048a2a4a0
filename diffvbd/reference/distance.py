"""Distance of pairs of primitives, the weight of their barrier and the log barrier, by textbook formulas.

A pair has four corners [Q, 4, 3]: a point and a triangle, two edges, or a point and three points that span a plane.
Its closest features are chosen without gradient; the distance is then that features' own formula, so that every
derivative, of normals and of closest points too, comes from autograd. Source: Li et al. 2020, Ericson 2005.
"""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import torch
from torch import Tensor

POINT_TRIANGLE, EDGE_EDGE, POINT_PLANE = range(3)  # kinds of a pair
TO_POINT, TO_EDGE, TO_FACE, BETWEEN_EDGES, TO_PLANE = range(5)  # its closest features
PARALLEL = 1e-16  # squared sine below which two directions span no plane

# A point and the ends of an edge, as local corners: what is left when the closest points are not inside both features.
_BORDERS = {POINT_TRIANGLE: ((0, 1, 2), (0, 2, 3), (0, 3, 1)), EDGE_EDGE: ((0, 2, 3), (1, 2, 3), (2, 0, 1), (3, 0, 1))}


_CROSSED = torch.tensor([[-1.0, 0, 0], [1, 0, 0], [0, -1, 1], [0, 1, 1]])  # two edges without a singular derivative


def _cross(a: Tensor, b: Tensor) -> Tensor:
    return torch.linalg.cross(a, b, dim=-1)


def _dot(a: Tensor, b: Tensor) -> Tensor:
    return (a * b).sum(-1)


def _length(a: Tensor) -> Tensor:
    return torch.linalg.vector_norm(a, dim=-1)


@torch.no_grad()
def closest_features(kind: Tensor, corners: Tensor) -> tuple[Tensor, Tensor]:
    """The closest features [Q] of pairs, and the local corners [Q, 4] in the order that the feature's formula takes."""
    feature = torch.full_like(kind, TO_PLANE)
    index = torch.arange(4, device=kind.device).expand(len(kind), 4).clone()
    for this, inside_of, inner in ((POINT_TRIANGLE, _inside_face, TO_FACE), (EDGE_EDGE, _inside_edges, BETWEEN_EDGES)):
        rows = (kind == this).nonzero()[:, 0]
        inside = inside_of(*corners[rows].unbind(1))
        border, order = _closest_border(corners[rows], torch.tensor(_BORDERS[this], device=kind.device))
        feature[rows] = torch.where(inside, inner, border)
        index[rows] = torch.where(inside[:, None], index[rows], order)
    return feature, index


def _inside_face(p: Tensor, a: Tensor, b: Tensor, c: Tensor) -> Tensor:
    """True if p projects into the interior of a triangle: positive areas against each of its edges."""
    ab, ac = b - a, c - a
    normal = _cross(ab, ac)
    areas = [_dot(_cross(s - p, t - p), normal) > 0 for s, t in ((a, b), (b, c), (c, a))]
    return areas[0] & areas[1] & areas[2] & (_dot(normal, normal) > PARALLEL * _dot(ab, ab) * _dot(ac, ac))


def _inside_edges(a: Tensor, b: Tensor, c: Tensor, d: Tensor) -> Tensor:
    """True if the lines through two edges are closest inside both."""
    u, v, r = b - a, d - c, c - a
    normal = _cross(u, v)
    size = _dot(normal, normal)
    s, t = _dot(_cross(r, v), normal), _dot(_cross(r, u), normal)
    return (s > 0) & (s < size) & (t > 0) & (t < size) & (size > PARALLEL * _dot(u, u) * _dot(v, v))


def _closest_border(corners: Tensor, borders: Tensor) -> tuple[Tensor, Tensor]:
    """The closest of several (point, edge): its feature [Q] and the local corners [Q, 4], the last one unused."""
    p, a, b = (corners[:, column] for column in borders.T)
    edge = b - a
    size = _dot(edge, edge)
    t = torch.where(size > 0, _dot(p - a, edge) / torch.where(size > 0, size, 1.0), 0.0).clamp(0, 1)
    best = _length(p - a - t[..., None] * edge).argmin(1)
    t = t.gather(1, best[:, None])
    near = torch.where(t < 1, borders[best], borders[best][:, [0, 2, 1]])  # the end that is closest comes first
    feature = torch.where((t > 0) & (t < 1), TO_EDGE, TO_POINT)[:, 0]
    return feature, torch.cat((near, near[:, :1]), 1)


def _to_plane(p: Tensor, a: Tensor, b: Tensor, c: Tensor) -> Tensor:
    normal = _cross(b - a, c - a)
    return _dot(normal, p - a) / _length(normal)


def _between_lines(a: Tensor, b: Tensor, c: Tensor, d: Tensor) -> Tensor:
    normal = _cross(b - a, d - c)
    return _dot(normal, a - c).abs() / _length(normal)


_FORMULAS: dict[int, Callable[[Tensor, Tensor, Tensor, Tensor], Tensor]] = {
    TO_POINT: lambda p, a, b, c: _length(p - a),
    TO_EDGE: lambda p, a, b, c: _length(_cross(p - a, b - a)) / _length(b - a),
    TO_FACE: lambda p, a, b, c: _to_plane(p, a, b, c).abs(),
    BETWEEN_EDGES: _between_lines,
    TO_PLANE: _to_plane,
}


def distance(kind: Tensor, corners: Tensor) -> Tensor:
    """Distance [m] of pairs [Q] from kinds [Q] and corners [Q, 4, 3]; signed for a plane, whose points run
    counterclockwise as seen from the free side. Derivatives do not exist at distance 0."""
    feature, index = closest_features(kind, corners)
    ordered = corners.gather(1, index[..., None].expand(-1, -1, 3))
    out = corners.new_zeros(len(kind))
    for this, formula in _FORMULAS.items():
        rows = (feature == this).nonzero()[:, 0]
        out = out.index_put((rows,), formula(*ordered[rows].unbind(1)))
    return out


def weight(kind: Tensor, corners: Tensor, dhat: Tensor, measure: Tensor) -> Tensor:
    """What the barrier of pairs [Q] is multiplied by.

    Of a point and a face or plane ``measure``, how often it counts. Of two edges u, v that are closest inside both,
    s (2 - s) of s = |u x v|^2 / measure < 1, else 1, times a smooth step, over half of dhat, of the distance from there
    to each of the four ends. Of other edges 0."""
    edges = kind == EDGE_EDGE
    safe = torch.where(edges[:, None, None], corners, _CROSSED.to(corners))
    a, b, c, d = safe.unbind(1)
    inside = edges & _inside_edges(a.detach(), b.detach(), c.detach(), d.detach())
    a, b, c, d = torch.where(inside[:, None, None], safe, _CROSSED.to(corners)).unbind(1)
    u, v, r = b - a, d - c, c - a
    normal = _cross(u, v)
    square = _dot(normal, normal)
    threshold, reach = torch.where(edges, measure, 1.0), dhat / 2
    part = square / threshold
    out = torch.where(part < 1, part * (2 - part), 1.0)
    for place, edge in ((_dot(_cross(r, v), normal) / square, u), (_dot(_cross(r, u), normal) / square, v)):
        for along in (place, 1 - place):
            q = (along * _length(edge) / reach).clamp(0, 1)
            out = out * q**3 * (10 - q * (15 - 6 * q))
    return torch.where(kind == EDGE_EDGE, torch.where(inside, out, 0.0), measure)


def log_barrier(gap: Tensor, kappa: Tensor, dhat: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """b = -kappa (gap - dhat)^2 log(gap / dhat) for 0 < gap < dhat, else 0, with its first two derivatives."""
    active = (gap > 0) & (gap < dhat)
    d = torch.where(active, gap, dhat)  # the unused branch must stay finite for autograd
    log, past = torch.log(d / dhat), d - dhat
    value = -kappa * past**2 * log
    first = -kappa * (2 * past * log + past**2 / d)
    second = -kappa * (2 * log + 4 * past / d - (past / d) ** 2)
    return value, torch.where(active, first, 0.0), torch.where(active, second, 0.0)


def with_gradient(function: Callable[[Tensor], Tensor], corners: Tensor) -> tuple[Tensor, Tensor]:
    """function(corners) [Q], each from its own corners [Q, 4, 3] alone, and its gradient [Q, 4, 3], which is itself
    differentiable where corners are tracked."""
    tracked = corners.requires_grad and torch.is_grad_enabled()
    with torch.enable_grad():
        corners = corners if tracked else corners.detach().requires_grad_()
        value = function(corners)
        (gradient,) = torch.autograd.grad(value.sum(), corners, create_graph=tracked, materialize_grads=True)
    return (value if tracked else value.detach()), gradient


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
        """Mask of edges [n, 2] that cross triangles [n, 3], as `intersections` defines it."""
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
