"""Distance of pairs of primitives, the mollifier of almost parallel edges and the log barrier, by textbook formulas.

A pair has four corners [Q, 4, 3]: a point and a triangle, two edges, or a point and three points that span a plane.
Its closest features are chosen without gradient; the distance is then that features' own formula, so that every
derivative, of normals and of closest points too, comes from autograd. Source: Li et al. 2020, Ericson 2005.
"""

from collections.abc import Callable

import torch
from torch import Tensor

POINT_TRIANGLE, EDGE_EDGE, POINT_PLANE = range(3)  # kinds of a pair
TO_POINT, TO_EDGE, TO_FACE, BETWEEN_EDGES, TO_PLANE = range(5)  # its closest features
PARALLEL = 1e-16  # squared sine below which two directions span no plane

# A point and the ends of an edge, as local corners: what is left when the closest points are not inside both features.
_BORDERS = {
    POINT_TRIANGLE: ((0, 1, 2), (0, 2, 3), (0, 3, 1)),
    EDGE_EDGE: ((0, 2, 3), (1, 2, 3), (2, 0, 1), (3, 0, 1)),
}


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
    for this, inside_of, inner in (
        (POINT_TRIANGLE, _inside_face, TO_FACE),
        (EDGE_EDGE, _inside_edges, BETWEEN_EDGES),
    ):
        rows = (kind == this).nonzero()[:, 0]
        inside = inside_of(*corners[rows].unbind(1))
        border, order = _closest_border(corners[rows], torch.tensor(_BORDERS[this], device=kind.device))
        feature[rows] = torch.where(inside, inner, border)
        index[rows] = torch.where(inside[:, None], index[rows], order)
    return feature, index


def _inside_face(p: Tensor, a: Tensor, b: Tensor, c: Tensor) -> Tensor:
    """Whether p projects into the interior of a triangle: positive areas against each of its edges."""
    ab, ac = b - a, c - a
    normal = _cross(ab, ac)
    areas = [_dot(_cross(s - p, t - p), normal) > 0 for s, t in ((a, b), (b, c), (c, a))]
    return areas[0] & areas[1] & areas[2] & (_dot(normal, normal) > PARALLEL * _dot(ab, ab) * _dot(ac, ac))


def _inside_edges(a: Tensor, b: Tensor, c: Tensor, d: Tensor) -> Tensor:
    """Whether the lines through two edges are closest inside both."""
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


def mollifier(kind: Tensor, corners: Tensor, threshold: Tensor) -> Tensor:
    """e = s (2 - s) of s = |u x v|^2 / threshold where two edges u, v have s < 1, else 1; threshold 0: never."""
    a, b, c, d = corners.unbind(1)
    normal = _cross(b - a, d - c)
    square = _dot(normal, normal)
    active = (kind == EDGE_EDGE) & (square < threshold)
    s = square / torch.where(active, threshold, 1.0)
    return torch.where(active, s * (2 - s), 1.0)


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
