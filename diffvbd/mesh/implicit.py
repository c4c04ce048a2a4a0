"""Bodies given by an implicit function, filled with well shaped tets: isosurface stuffing.

Source: Labelle and Shewchuk, "Isosurface stuffing: fast tetrahedral meshes with good dihedral angles", ACM TOG 26(3),
2007. A body-centred cubic lattice is cut by the surface; lattice vertices that a cut comes close to are moved onto it,
and each lattice tet is replaced by the pieces inside. Works on all tets at once.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from diffvbd.mesh.arrays import FloatArray, IntArray, connected, float_array, positive
from diffvbd.mesh.tet_mesh import EDGES, TetMesh, inner_faces, oriented

ImplicitFunction = Callable[[FloatArray], FloatArray]

# A vertex moves onto a cut that is closer than this fraction of a long or short lattice edge (the paper's "safe" pair).
_SNAP_LONG, _SNAP_SHORT = 0.24999, 0.41189

# In a lattice tet the edges 0-1 and 2-3 are long, the other four short.
_LONG_PARTNER = np.array([1, 0, 3, 2])
_BISECTIONS = 48
_MOST_CELLS = 1e9  # of the lattice, whose points and tets take some hundred bytes for each


def fill(function: ImplicitFunction, low: Any, high: Any, spacing: float) -> TetMesh:
    """Tets that fill the body `function(p) < 0`, with boundary vertices on its surface.

    The lattice is centred on the box from `low` to `high`. Inner tets are all alike; next to the surface the mean
    ratio (`TetMesh.quality`) stays above 0.3 where the surface is smooth on the scale of `spacing`. Of several
    pieces the one with most tets is kept.

    Args:
        function: Points [m], shape [N, 3], to values, shape [N]: negative inside, positive outside, continuous.
        low, high: A box around the body [m], shape [3] each.
        spacing: Long edge of the lattice [m]; the short ones are 0.87 times that. Thinner parts get lost.

    Raises:
        TypeError, ValueError: bad arguments; the body is empty, reaches out of the box, or is so thin against
            `spacing` that nothing of it is left or the surface would touch itself.
    """
    if not callable(function):
        raise TypeError(f"function: expected a function of points [N, 3], got {type(function).__name__}")
    bottom, top, step = float_array("low", low, (3,)), float_array("high", high, (3,)), positive("spacing", spacing)
    if (top <= bottom).any():
        raise ValueError(f"high: expected more than low = {bottom.tolist()}, got {top.tolist()}")
    with np.errstate(over="ignore"):
        size = np.ceil((top - bottom) / step) + 2
    if size.prod() > _MOST_CELLS:
        wanted = f"one with at most {_MOST_CELLS:g} cells in the box"
        raise ValueError(f"spacing: expected {wanted}, got {step:.6g}: try a larger one")
    cells = size.astype(int)
    points, lattice, outermost = _lattice((bottom + top) / 2 - step * cells / 2, cells, step)
    inside = -_evaluate(function, points)
    if (inside[outermost] > 0).any():
        raise ValueError("low, high: expected a box around the body, but the function is negative outside of it")
    lattice = lattice[(inside[lattice] > 0).any(axis=1)]
    if len(lattice) == 0:
        raise ValueError(f"function: expected a body inside the box, found no point of it at spacing {step:.6g}")

    edges = np.unique(np.sort(lattice[:, EDGES].reshape(-1, 2), axis=1) @ [len(points), 1])
    ends = np.stack(np.divmod(edges, len(points)), axis=1)
    crossed = np.sign(inside[ends]).prod(axis=1) < 0
    edges, ends = edges[crossed], ends[crossed]
    ends_inside_first = np.where(inside[ends[:, :1]] > 0, ends, ends[:, ::-1])
    fraction, cuts = _cut(function, points[ends_inside_first[:, 0]], points[ends_inside_first[:, 1]])
    moved, on_surface = _snap(points, ends_inside_first, fraction, cuts, step)
    inside[on_surface] = 0

    tets = _stencils(lattice, inside, edges, len(points))
    if len(tets) == 0:
        raise ValueError(f"spacing: the body is thinner than the lattice at spacing {step:.6g}; try a smaller one")
    # Orientation is read off the undeformed lattice, so that a tet inverted by the moves cannot pass unseen.
    undeformed = np.concatenate([points, points[ends].mean(axis=1)])
    tets = _largest_piece(oriented(undeformed, tets))
    used, compact = np.unique(tets, return_inverse=True)
    mesh = TetMesh(np.concatenate([moved, cuts])[used], compact.reshape(-1, 4))
    ends = np.sort(mesh.surface[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    if (np.unique(ends, axis=0, return_counts=True)[1] != 2).any():
        raise ValueError(f"spacing: the surface touches itself at spacing {step:.6g}; try a smaller one")
    return mesh


def _evaluate(function: ImplicitFunction, points: FloatArray) -> FloatArray:
    return float_array("function", function(points), (len(points),))


def _lattice(origin: FloatArray, cells: IntArray, step: float) -> tuple[FloatArray, IntArray, IntArray]:
    """Points of a body-centred cubic lattice, its tets (two cell centres, two corners), its outermost points."""
    corner = np.arange(np.prod(cells + 1)).reshape(cells + 1)
    centre = corner.size + np.arange(np.prod(cells)).reshape(cells)
    grids = [np.stack(np.meshgrid(*map(np.arange, n), indexing="ij"), -1).reshape(-1, 3) for n in (cells + 1, cells)]
    points = origin + step * np.concatenate([grids[0], grids[1] + 0.5])
    tets = []
    for axis in range(3):
        # Two neighbouring centres and an edge of the square between them make one tet.
        ids = np.moveaxis(corner, axis, 0)[1:-1]
        square = [ids[:, :-1, :-1], ids[:, 1:, :-1], ids[:, 1:, 1:], ids[:, :-1, 1:]]
        pair = np.moveaxis(centre, axis, 0)
        tets += [np.stack([pair[:-1], pair[1:], square[k], square[(k + 1) % 4]], -1).reshape(-1, 4) for k in range(4)]
    border = np.ones_like(corner, dtype=bool)
    border[1:-1, 1:-1, 1:-1] = False
    return points, np.concatenate(tets), corner[border]


def _cut(function: ImplicitFunction, inner: FloatArray, outer: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Points at which the surface crosses the segments from inner to outer points, and their fractions of a segment."""
    low, high = np.zeros(len(inner)), np.ones(len(inner))
    for _ in range(_BISECTIONS if len(inner) else 0):
        middle = (low + high) / 2
        is_inside = _evaluate(function, inner + middle[:, None] * (outer - inner)) < 0
        low, high = np.where(is_inside, middle, low), np.where(is_inside, high, middle)
    fraction = (low + high) / 2
    return fraction, inner + fraction[:, None] * (outer - inner)


def _snap(points: FloatArray, ends: IntArray, fraction: FloatArray, cuts: FloatArray, step: float
          ) -> tuple[FloatArray, IntArray]:  # fmt: skip
    """Lattice points moved onto the nearest cut that comes too close, and the ids of those that moved."""
    edge_length = np.linalg.norm(points[ends[:, 1]] - points[ends[:, 0]], axis=1)
    limit = np.where(edge_length > 0.93 * step, _SNAP_LONG, _SNAP_SHORT)
    vertex, cut = np.concatenate([ends[:, 0], ends[:, 1]]), np.tile(np.arange(len(cuts)), 2)
    share = np.concatenate([fraction, 1 - fraction])
    close = share < np.tile(limit, 2)
    vertex, cut, distance = vertex[close], cut[close], (share * np.tile(edge_length, 2))[close]
    order = np.lexsort((distance, vertex))
    ids, first = np.unique(vertex[order], return_index=True)
    moved = points.copy()
    moved[ids] = cuts[cut[order][first]]
    return moved, ids


def _stencils(lattice: IntArray, inside: FloatArray, edges: IntArray, num_points: int) -> IntArray:
    """The part of each lattice tet inside the surface as tets over lattice points and cuts (numbered after them).

    A point on the surface counts as inside, with cuts that coincide with it; pieces that collapse are dropped.
    """
    lattice = lattice[(inside[lattice] > 0).any(axis=1)]
    outside = inside[lattice] < 0
    number = outside.sum(axis=1)

    def cut(a: IntArray, b: IntArray) -> IntArray:
        key = np.minimum(a, b) * num_points + np.maximum(a, b)
        found = num_points + np.searchsorted(edges, key)
        return np.where(inside[a] == 0, a, np.where(inside[b] == 0, b, found))

    pieces = [lattice[number == 0]]

    # Faces of neighbours must agree on the diagonal of a cut quad. It starts at the cut of a long edge, if one
    # of the two cut edges is long, else at the vertex of lower index: both follow from the face alone.
    tet, out = lattice[number == 1], outside[number == 1].argmax(axis=1)
    partner = _LONG_PARTNER[out]
    d, long = _pick(tet, out), _pick(tet, partner)
    # The other long edge: 2-3 if d is 0 or 1, else 0-1.
    one, two = _pick(tet, (out + 2) % 4), _pick(tet, _LONG_PARTNER[(out + 2) % 4])
    low, high = np.minimum(one, two), np.maximum(one, two)
    pieces.append(_prism(low, high, long, cut(low, d), cut(high, d), cut(long, d)))

    tet, is_out = lattice[number == 2], outside[number == 2]
    order = np.argsort(is_out, axis=1, kind="stable")
    along = _LONG_PARTNER[order[:, 0]] == order[:, 1]
    a, b, c, d = np.take_along_axis(tet[along], order[along], axis=1).T
    a, b = np.minimum(a, b), np.maximum(a, b)
    pieces.append(_prism(a, cut(a, c), cut(a, d), b, cut(b, c), cut(b, d)))
    first, second = order[~along, 0], order[~along, 1]
    a, b, c, d = (_pick(tet[~along], k) for k in (first, second, _LONG_PARTNER[first], _LONG_PARTNER[second]))
    pieces.append(_prism(cut(a, c), a, cut(a, d), cut(b, c), b, cut(b, d)))

    tet, within = lattice[number == 3], (~outside[number == 3]).argmax(axis=1)
    a = _pick(tet, within)
    others = [_pick(tet, (within + k) % 4) for k in (1, 2, 3)]
    pieces.append(np.stack([a, *(cut(a, b) for b in others)], axis=1))

    tets = np.concatenate(pieces)
    ranked = np.sort(tets, axis=1)
    return tets[(ranked[:, 1:] != ranked[:, :-1]).all(axis=1)]


def _pick(tets: IntArray, column: IntArray) -> IntArray:
    return tets[np.arange(len(tets)), column]


def _prism(a: IntArray, b: IntArray, c: IntArray, a2: IntArray, b2: IntArray, c2: IntArray) -> IntArray:
    """Three tets of a prism with the diagonals a-b2, a-c2, b-c2."""
    return np.concatenate([np.stack(t, axis=1) for t in ((a, b, c, c2), (a, b, b2, c2), (a, a2, b2, c2))])


def _largest_piece(tets: IntArray) -> IntArray:
    """Of the tets connected through faces, the largest set."""
    label = connected(np.stack(inner_faces(tets), axis=1) // 4, len(tets))
    return tets[label == np.bincount(label).argmax()]
