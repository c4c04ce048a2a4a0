"""The coarse space of a Model: fixed functions on each body's rest shape, and groups of tets that turn together.

    A = P' M P + h^2 sum over groups of R_g (P' K_g P) R_g',        P = W x I3,

where W has a row for each vertex and a column for each function, K_g is the stiffness of the tets of group g at rest
and R_g the mean rotation of that group (docs/method.md, section 15). Everything here depends on the rest shape alone.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor

from .. import ops
from .._common.checks import check_count, fail, init_names_checked, is_word
from .._common.context import replaced
from ..ops.coarse import PACK as LANES
from ..ops.coarse import ROW, lengths
from ..ops.fields import TILE
from .bodies import connected

FEWEST, MOST = 32, 128  # functions of a body under "auto"
MOST_COUPLED = 512  # of bodies that couplings or contact couple: one dense system of three times as many unknowns
MOST_FUNCTIONS, MOST_OF_ANY = 3840, 2**20  # that a CoarseSpace may ask for
PER_FUNCTION = 25  # vertices of a large body for each function
PER_FUNCTION_SMALL = 6  # and of a small one
PER_FUNCTION_SHEET = 18
PER_GROUP = 4
SHEET = 0.125  # a body is a sheet if its thickness is below this share of its second extent
GRID = 8  # functions from which on they are splines; fewer are affine
ZERO = 1e-12  # a function that is no more than this at a vertex is 0 there but for rounding
EQUAL = 1e-9  # share by which lengths and distances differ from rounding alone
DEPENDENT = 1e-6  # squared distance of a normalised function from the span of others, below which it is left out
_AT_ONCE = 2**24  # scalars of a batch of bodies
PACK = ops.LANES["cpu"]  # a body's matrix has 1, 2, 4 or a multiple of as many functions


@init_names_checked
@dataclass(frozen=True)
class CoarseSpace:
    """Coarse correction between sweeps: what few sweeps do badly, the motion of large parts, done by one small system.

    Args:
        functions: Of each body, at most; up to 3840, one dense system. ``"auto"``: a 25th of its vertices, 32 to
            128; small bodies fewer, down to affine functions and constants. Bodies that couplings join have at most 512
            together.
        degree: Of the splines on the body's rest box, 1 to 3. ``"auto"``: 1, in the plane of a sheet 3.
        groups: Sets of neighbouring tets of a body with one rotation each. ``"auto"``: a quarter of its functions.
        every: Sweeps after each correction. A step is: one sweep, then a correction and up to ``every`` sweeps, again
            until ``sweeps`` are done; without sweeps it is one correction, beside pairs and friction none.

    Raises:
        ValueError: Numbers out of range.
        TypeError: What is neither an integer nor, for the first three, ``"auto"``.

    Source: docs/method.md, section 15.
    """

    functions: int | Literal["auto"] = "auto"
    degree: int | Literal["auto"] = "auto"
    groups: int | Literal["auto"] = "auto"
    every: int = 3

    def __post_init__(self) -> None:
        for name, most in (("functions", MOST_FUNCTIONS), ("groups", MOST_OF_ANY)):
            if not is_word(getattr(self, name), "auto"):
                object.__setattr__(self, name, check_count(name, getattr(self, name), 1, maximum=most))
        if not is_word(self.degree, "auto"):
            object.__setattr__(self, "degree", check_count("degree", self.degree, 1, maximum=3))
        object.__setattr__(self, "every", check_count("every", self.every, 1, maximum=MOST_OF_ANY))

    def corrections(self, sweeps: int) -> int:
        """Number of corrections of a step of so many sweeps."""
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


def build_coarse(points: np.ndarray, tets: np.ndarray, pinned: np.ndarray, label: np.ndarray, space: CoarseSpace,
                 joined: np.ndarray | None = None) -> CoarseGeometry:  # fmt: skip
    """points [V, 3], tets [T, 4], pinned bool [V], label [V]: equal in a connected body; joined [V]: in bodies that are
    corrected as one, None: each is by itself.

    Bodies of as many vertices, or tets, go through each step together: a loop over them would take longer than all of
    the rest of a Model.
    """
    roots, one, body = np.unique(label, return_index=True, return_inverse=True)
    of_root = np.unique((label if joined is None else joined)[one], return_inverse=True)[1].reshape(-1)
    of_body = _lists(body.reshape(-1), len(roots))
    of_tet = _lists(body.reshape(-1)[tets[:, 0]], len(roots))
    movable = np.bincount(body.reshape(-1)[~pinned], minlength=len(roots)) > 0

    has_some = movable & (of_tet.number > 0)
    most = np.minimum(MOST, MOST_COUPLED // np.maximum(np.bincount(of_root, has_some), 1).astype(np.int64))[of_root]
    counts = np.zeros(len(roots), dtype=np.int64)
    entries: list[tuple[np.ndarray, ...]] = []
    for which, vertices in _alike(of_body, np.flatnonzero(has_some), _AT_ONCE // MOST, most):
        for part, weights, kept in _functions(points[vertices], ~pinned[vertices], space, int(most[which[0]])):
            counts[which[part]] = kept.sum(1)
            own = np.cumsum(kept, axis=1) - 1
            weights *= kept[:, None]
            at, row, column = np.nonzero(np.abs(weights) > ZERO)
            entries.append((vertices[part[at], row], which[part[at]], own[at, column], weights[at, row, column]))

    # bodies that are joined are one from here on: with a matrix of all their functions
    sort = np.argsort(of_root, kind="stable")
    offset, own_counts = np.zeros(len(roots), dtype=np.int64), counts
    counts = np.bincount(of_root, own_counts).astype(np.int64)
    offset[sort] = np.cumsum(own_counts[sort]) - own_counts[sort]
    offset -= (np.cumsum(counts) - counts)[of_root]
    if (several := counts[of_root] > np.maximum(own_counts, MOST_COUPLED)).any():
        fail("subspace", f"at most {MOST_COUPLED} functions of bodies that springs or tendons join: use a CoarseSpace "
             "with fewer, or None", f"{counts[of_root][several].max()}")  # fmt: skip

    # those of the smallest matrix first
    small = np.array((0, 1, 2, 4, 4))[np.minimum(counts, 4)]
    size = np.where(counts <= 4, small, -(-counts // PACK) * PACK)
    listed = np.argsort(size, kind="stable")
    listed = listed[counts[listed] > 0]
    rank = np.full(len(counts), -1)
    rank[listed] = np.arange(len(listed))
    function_ptr = np.concatenate(([0], np.cumsum(size[listed])))
    filling = np.arange(function_ptr[-1]) - np.repeat(function_ptr[:-1], size[listed])
    filling = filling >= np.repeat(counts[listed], size[listed])
    entries.append((np.zeros(0, dtype=np.int64),) * 3 + (np.zeros(0),))
    vertex, of, own, weight = (np.concatenate(part) for part in zip(*entries, strict=True))
    sort = np.argsort(vertex, kind="stable")
    vertex, weight = vertex[sort], weight[sort]
    function = (own + offset[of] + function_ptr[rank[of_root[of]]])[sort]

    number = -(-own_counts // PER_GROUP) if space.groups == "auto" else np.full(len(roots), space.groups)
    number = np.minimum(number, of_tet.number)
    moving = np.flatnonzero(own_counts)
    moving = moving[np.argsort(rank[of_root[moving]], kind="stable")]
    group_body = np.repeat(rank[of_root[moving]], number[moving])
    first = np.zeros(len(roots), dtype=np.int64)
    first[moving] = np.cumsum(number[moving]) - number[moving]
    tet_group, axes = np.full(len(tets), -1), points.T.copy()
    for which, members in _alike(of_tet, moving, _AT_ONCE // 16, number):
        corners = [axis[tets[members]] for axis in axes]
        centers = np.stack([(c[..., 0] + c[..., 1] + c[..., 2] + c[..., 3]) / 4 for c in corners], 1)
        tet_group[members] = first[which][:, None] + _groups(centers, int(number[which[0]]))
    groups = _functions_of_groups(tets, tet_group, len(group_body), vertex, function, len(points))
    return CoarseGeometry(function_ptr, vertex, function, weight, tet_group, group_body, groups, filling)


class _Lists(NamedTuple):
    order: np.ndarray  # what each body has, one body after the other
    start: np.ndarray
    number: np.ndarray


def _lists(of: np.ndarray, bodies: int) -> _Lists:
    count = np.bincount(of, minlength=bodies)
    return _Lists(np.argsort(of, kind="stable"), np.cumsum(count) - count, count)


def _alike(lists: _Lists, bodies: np.ndarray, limit: int, other: np.ndarray | None = None
           ) -> Iterator[tuple[np.ndarray, np.ndarray]]:  # fmt: skip
    """Those of ``bodies`` that have as many entries (and the same of ``other``), and their entries [n, entries]; one
    body, or several with at most ``limit`` entries."""
    key = np.stack((lists.number, lists.number if other is None else other), 1)[bodies]
    unique, of = np.unique(key, axis=0, return_inverse=True)
    same = _lists(of.reshape(-1), len(unique))
    for k, (entries, _) in enumerate(unique.tolist()):
        which = bodies[same.order[same.start[k] : same.start[k] + same.number[k]]]
        for part in np.array_split(which, -(-len(which) * entries // limit)) if len(which) > 1 else (which,):
            if len(part):
                yield part, lists.order[lists.start[part][:, None] + np.arange(entries)]


def _functions(points: np.ndarray, free: np.ndarray, space: CoarseSpace, most: int
               ) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:  # fmt: skip
    """Of bodies [n, V, 3] those with the same splines: which they are [m], functions at their vertices [m, V, f], zero
    where these are pinned, and which of them are independent [m, f]. most: of them under "auto"."""
    local = _in_its_box(points)
    extent = np.ptp(local, axis=1)
    long = np.argsort(-extent, axis=1)
    ordered = np.take_along_axis(extent, long, 1)
    sheet = ordered[:, 2] < SHEET * ordered[:, 1]
    if space.functions == "auto":
        target = np.maximum(free.sum(1) // np.where(sheet, PER_FUNCTION_SHEET, PER_FUNCTION), FEWEST)
        target = np.minimum(target, max(1, min(most, points.shape[1] // PER_FUNCTION_SMALL)))
    else:
        target = np.full(len(points), space.functions)
    # affine functions, or splines of a degree on so many cells
    degree = np.full((len(points), 3), 1 if space.degree == "auto" else space.degree)
    plane = 3 if space.degree == "auto" else space.degree
    np.put_along_axis(degree, long, np.where(sheet[:, None], (plane, plane, 1), degree), 1)
    splines = target >= GRID
    while (many := splines & (np.prod(degree + 1, axis=1) > target)).any():  # one cell has too many
        degree[many, np.argmax(degree[many], axis=1)] -= 1
    kind = np.zeros((len(points), 7), dtype=np.int64)
    kind[:, 0] = np.where(splines, 0, np.where(target >= 4, 4, 1))
    kind[splines, 1:4] = degree[splines]
    if splines.any():
        kind[splines, 4:] = _cells(extent[splines], degree[splines], target[splines])
    kinds, of = np.unique(kind, axis=0, return_inverse=True)
    for k, (affine, *rest) in enumerate(kinds.tolist()):
        part = np.flatnonzero(of.reshape(-1) == k)
        at = local[part]
        if affine:
            span = extent[part][:, None]
            scaled = (at - at.mean(1, keepdims=True)) / np.where(span > 0, span, 1.0)
            out = np.concatenate((np.ones((*at.shape[:2], 1)), scaled), 2)[..., :affine]
        else:
            one, two, three = (_splines(at[..., a], rest[3 + a], rest[a]) for a in range(3))
            out = one[..., :, None, None] * two[..., None, :, None] * three[..., None, None, :]
            out = out.reshape(*at.shape[:2], -1)
        out *= free[part][..., None]
        yield part, out, _independent(out)


def _in_its_box(points: np.ndarray) -> np.ndarray:
    """Positions from the lowest corner of each body's box, along the axes, or along its own where that is far
    thinner."""
    own = points - points.mean(1, keepdims=True)
    own = own @ np.linalg.svd(own, full_matrices=False)[2].swapaxes(1, 2)
    thinner = np.ptp(own, axis=1).min(1) < 0.5 * np.ptp(points, axis=1).min(1)
    local = np.where(thinner[:, None, None], own, points)
    return local - local.min(1, keepdims=True)


def _cells(extent: np.ndarray, degree: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Cells of grids of at most ``target`` splines [n, 3]: the longest edge of a cell is as short as it can be, then
    the others are."""
    most = [int((target // np.prod(np.delete(degree, a, 1) + 1, axis=1) - degree[:, a]).max()) for a in range(2)]
    first, second = (a.reshape(-1) for a in np.mgrid[1 : max(1, most[0]) + 1, 1 : max(1, most[1]) + 1])
    third = target[:, None] // ((first + degree[:, :1]) * (second + degree[:, 1:2])) - degree[:, 2:]
    # no shorter across than the longest edge asks for
    longest = np.maximum(extent[:, :1] / first, extent[:, 1:2] / second)
    cells = np.minimum(third, np.maximum(1, np.ceil(extent[:, 2:] / longest))).astype(np.int64)
    edges = np.stack((extent[:, :1] / first, extent[:, 1:2] / second, extent[:, 2:] / np.maximum(cells, 1)), 2)
    edges = -np.sort(-edges, axis=2)
    allowed = cells >= 1
    for k in range(3):
        edge = np.where(allowed, edges[..., k], np.inf)
        allowed &= edge <= (1 + EQUAL) * edge.min(1, keepdims=True)
    best = np.argmax(allowed, axis=1)
    return np.stack((first[best], second[best], cells[np.arange(len(best)), best]), 1)


def _splines(at: np.ndarray, cells: int, degree: int) -> np.ndarray:
    """Values of the cells + degree uniform B-splines of an interval that each row of ``at`` spans, [n, V, cells +
    degree]."""
    top = at.max(1, keepdims=True)
    unit = np.where(top > 0, at / np.where(top > 0, top, 1.0) * cells, at)[..., None]
    knots = np.arange(-degree, cells + degree + 1)
    inside = np.clip(np.floor(unit), 0, cells - 1)
    out = (knots[:-1] == inside).astype(np.float64)
    for d in range(1, degree + 1):
        out = (unit - knots[: -d - 1]) / d * out[..., :-1] + (knots[d + 1 :] - unit) / d * out[..., 1:]
    return out


def _independent(functions: np.ndarray) -> np.ndarray:
    """Columns of [n, V, f] that are no combination of others, by Cholesky's method with pivots: bool [n, f]."""
    stack = torch.from_numpy(functions)
    gram = (stack.mT @ stack).numpy()  # numpy takes ten times as long
    norm = np.sqrt(np.einsum("nii->ni", gram))
    some = norm > 1e-9 * np.maximum(norm.max(1, keepdims=True, initial=0.0), 1e-300)
    norm = np.where(some, norm, 1.0)
    gram /= norm[:, :, None] * norm[:, None]
    kept, body = np.zeros(some.shape, dtype=bool), np.arange(len(gram))
    left, rows = np.where(some, 1.0, -1.0), np.zeros_like(gram)
    for k in range(gram.shape[1]):
        most = left.max(1, keepdims=True)
        # the first of those that rounding alone tells apart: copies of a body have the same functions
        pivot = np.argmax(left >= (1 - EQUAL) * most, axis=1)
        found = most[:, 0] > DEPENDENT
        if not found.any():
            break
        row = gram[body, pivot] - (rows[body, :k, pivot][:, None] @ rows[:, :k])[:, 0]
        row /= np.sqrt(np.where(found, left[body, pivot], 1.0))[:, None]
        rows[:, k] = np.where(found[:, None], row, 0.0)
        kept[body[found], pivot[found]] = True
        left = np.where(kept, -1.0, left - rows[:, k] ** 2)
    return kept


def _groups(centers: np.ndarray, count: int) -> np.ndarray:
    """Cuts clouds [n, 3, T] into ``count`` parts of nearly equal size, each time across their longest side: [n, T]."""
    n, _, tets = centers.shape
    out, body = np.zeros((n, tets), dtype=np.int64), np.arange(n)
    parts = [(np.broadcast_to(np.arange(tets), (n, tets)), count, 0)]
    while parts:
        members, number, first = parts.pop()
        if number == 1:
            out[body[:, None], members] = first
            continue
        cloud = np.take_along_axis(centers, members[:, None], 2)
        along = cloud[body, np.argmax(np.ptp(cloud, axis=2), axis=1)]
        sort = np.take_along_axis(members, np.argsort(along, axis=1, kind="stable"), 1)
        half = number // 2
        cut = sort.shape[1] * half // number
        parts += [(sort[:, :cut], half, first), (sort[:, cut:], number - half, first + half)]
    return out


def _functions_of_groups(tets: np.ndarray, tet_group: np.ndarray, groups: int, vertex: np.ndarray,
                         function: np.ndarray, vertices: int) -> np.ndarray:  # fmt: skip
    listed = tet_group >= 0
    group, at = _pairs(np.repeat(tet_group[listed], 4), tets[listed].reshape(-1), vertices)
    ptr = np.searchsorted(vertex, np.arange(vertices + 1))
    count = ptr[at + 1] - ptr[at]
    entry = np.repeat(ptr[at] - np.cumsum(count) + count, count) + np.arange(count.sum())
    group, known = _pairs(np.repeat(group, count), function[entry], int(function.max(initial=0)) + 1)
    number = np.bincount(group, minlength=groups)
    out = np.full((groups, int(number.max(initial=0))), -1)
    out[group, np.arange(len(known)) - np.repeat(np.cumsum(number) - number, number)] = known
    return out


def _pairs(one: np.ndarray, two: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """The distinct pairs, sorted; the second of a pair is below ``count``."""
    key = np.sort(one * count + two)  # np.unique takes ten times as long
    key = key[np.diff(key, prepend=-1) > 0]
    return key // count, key % count


# --- the coarse space of a model as tensors ---------------------------------------------------------------------------

PART = 32  # most blocks of a part of a body


class CoarsePlan(NamedTuple):
    """All tensors are constants of the Model; floating ones have its dtype, but for ``volume`` (float64)."""

    sizes: ops.CoarseSizes
    plan: Tensor  # int32, see csrc/coarse/views.h
    weights: Tensor  # [2 entries], of W by position and by function
    rest: Tensor  # [1, blocks, 7, lanes], rest scalars of the tets of each body
    tet: Tensor  # int64 [blocks, lanes], their numbers, group by group; any at padding
    moments: Tensor  # [n, 3], what the mean deformations of the groups are made of
    volume: Tensor  # float64 [groups]
    mass: Tensor  # [1, cells], W' M W of each body with the Model's own masses; 1 for functions that fill up

    def to(self, device: torch.device, dtype: torch.dtype) -> CoarsePlan:
        def placed(t: Tensor) -> Tensor:
            return t.to(device, dtype) if t.is_floating_point() else t.to(device)

        sizes, *tensors = self
        return replaced(CoarsePlan(sizes, *map(placed, tensors)), volume=self.volume.to(device))


def plan_of(space: CoarseSpace, points: Tensor, tets: Tensor, pinned: Tensor, mass: Tensor, rest: Tensor, plan: Tensor,
            device: str, joined: Tensor | None) -> tuple[CoarseGeometry, CoarsePlan]:  # fmt: skip
    """The space on a mesh in float64, on the CPU; rest [1, T, 7]; plan: of the sweeps on a device, itself on the
    CPU; joined [V]: as of build_coarse()."""
    arrays, label = (points.numpy(), tets.numpy()), connected(tets, len(points)).numpy()
    geometry = build_coarse(*arrays, pinned.numpy(), label, space, None if joined is None else joined.numpy())
    order = ops.plan_order(plan, ops.LANES[device]).numpy()
    return geometry, arrange_coarse(geometry, space.every, *arrays, mass.numpy(), rest[0].numpy(), order)


def check_coupled(geometry: CoarseGeometry, touches: bool) -> None:
    """Beside contact, raises where the bodies of a scene have more functions than can be solved for together."""
    if touches and geometry.functions > MOST_COUPLED:
        fail("subspace", f"at most {MOST_COUPLED} functions of all bodies with a PairBarrier or Friction, which couple "
             "them: use a CoarseSpace with fewer, or None", f"{geometry.functions} of {geometry.bodies}")  # fmt: skip


def arrange_coarse(geometry: CoarseGeometry, every: int, points: np.ndarray, tets: np.ndarray, mass: np.ndarray,
                   rest: np.ndarray, order: np.ndarray) -> CoarsePlan:  # fmt: skip
    """points [V, 3], tets [T, 4], mass [V], rest [T, 7], all float64; order: the vertex at each position, -1: none."""
    g, vertices = geometry, len(points)
    position = np.full(vertices, -1)
    real = np.flatnonzero(order >= 0)
    position[order[real]] = real
    counts = np.diff(g.function_ptr)
    mass_ptr = np.concatenate(([0], np.cumsum(counts**2)))

    at = position[g.vertex]
    of_vertex = _starts(g.vertex, vertices)
    some = order[np.sort(position[of_vertex[1:] > of_vertex[:-1]])]  # vertices with functions, in sweep order
    number = of_vertex[some + 1] - of_vertex[some]
    sort = np.repeat(of_vertex[some] - np.cumsum(number) + number, number) + np.arange(len(at))
    by_position = (at[sort], g.function[sort], g.weight[sort])
    rows = np.argsort(g.function * len(order) + at)  # no two are equal
    function_body = np.repeat(np.arange(g.bodies), counts)
    position_body = np.full(len(order), -1)
    position_body[at] = function_body[g.function]

    vertex_body = np.full(vertices, -1)
    vertex_body[g.vertex] = function_body[g.function]
    listed = np.flatnonzero(vertex_body >= 0)
    listed = listed[np.argsort(vertex_body[listed], kind="stable")]
    tet, block_ptr, tet_ptr = _blocks(g)
    # padding has one corner of its block four times
    corner = position[np.where(tet[..., None] >= 0, tets[np.maximum(tet, 0)], tets[tet[:, :1], :1])].swapaxes(1, 2)

    volume = 1 / (6 * rest[:, 6])
    moment = _moments(g, points, tets)
    moment_group = np.repeat(np.arange(len(g.group_body)), np.diff(moment[0]))
    part_ptr, part_body, part_begin = _parts(block_ptr)
    place_ptr, place = _places(g, counts)
    sizes = ops.CoarseSizes(
        g.bodies, g.functions, len(g.group_body), g.group_functions.shape[1], len(g.vertex), len(tet), len(moment[1]),
        len(order), len(listed), int(mass_ptr[-1]), int(counts.max(initial=0)), len(part_body), len(place), vertices,
        int((3 * counts > TILE).sum()), every)  # fmt: skip
    arrays = {
        "function_ptr": g.function_ptr, "mass_ptr": mass_ptr, "function_body": function_body,
        "position_body": position_body, "position_ptr": _starts(by_position[0], len(order)),
        "function": by_position[1], "row_ptr": _starts(g.function[rows], g.functions), "row": at[rows],
        "block_ptr": block_ptr, "part_ptr": part_ptr, "part_body": part_body, "part_begin": part_begin,
        "corner": ROW * corner, "tet": np.maximum(tet, 0), "group_ptr": _starts(g.group_body, g.bodies),
        "group_body": g.group_body, "group_function": g.group_functions, "place_ptr": place_ptr, "place": place,
        "tet_ptr": tet_ptr, "moment_ptr": moment[0], "moment_vertex": moment[1], "moment_group": moment_group,
        "vertex_ptr": _starts(np.sort(moment[1]), vertices), "vertex_moment": np.argsort(moment[1], kind="stable"),
        "list_ptr": _starts(vertex_body[listed], g.bodies), "list": listed, "list_position": position[listed],
    }  # fmt: skip
    assert {name: a.size for name, a in arrays.items()} == lengths(sizes)
    index = torch.from_numpy(np.concatenate([a.reshape(-1) for a in arrays.values()]).astype(np.int32))
    weights = torch.from_numpy(np.concatenate((by_position[2], g.weight[rows])))
    lanes = rest[np.maximum(tet, 0)].swapaxes(1, 2)  # of any tet at padding, whose corners do not move apart
    listed_tets = g.tet_group >= 0
    of_group = np.bincount(g.tet_group[listed_tets], volume[listed_tets], len(g.group_body))
    rest_of, tet_of, moments, of_group = map(
        torch.from_numpy, (lanes[None].copy(), np.maximum(tet, 0), moment[2], of_group)
    )
    coarse_mass = ops.raw.coarse_mass(torch.from_numpy(mass)[None], index, weights, sizes)
    return CoarsePlan(sizes, index, weights, rest_of, tet_of, moments, of_group, coarse_mass)


def _starts(sorted_values: np.ndarray, count: int) -> np.ndarray:
    return np.searchsorted(sorted_values, np.arange(count + 1))


def _blocks(g: CoarseGeometry) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Tets of each body, group by group, in blocks [blocks, LANES], -1 at the end of the last one; where each body's
    blocks begin; and where each group's tets do, without padding."""
    order = np.argsort(g.tet_group, kind="stable")
    order = order[g.tet_group[order] >= 0]
    tet_ptr = _starts(g.tet_group[order], len(g.group_body))
    return *in_blocks(order, np.diff(tet_ptr[_starts(g.group_body, g.bodies)])), tet_ptr


def in_blocks(tets: np.ndarray, count: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Tets, so many of each body in turn, in blocks [blocks, LANES], -1 at the end of a body's last one; and where each
    body's blocks begin."""
    ptr = np.concatenate(([0], np.cumsum(-(-count // LANES)))).astype(np.int64)
    out = np.full(ptr[-1] * LANES, -1)
    out[np.arange(len(tets)) + np.repeat(ptr[:-1] * LANES - np.cumsum(count) + count, count)] = tets
    return out.reshape(-1, LANES), ptr


def _parts(block_ptr: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Parts of at most PART blocks of one body: where each body's begin, the body of each, its first block and the
    last one's end."""
    count = -(-np.diff(block_ptr) // PART)
    ptr = np.concatenate(([0], np.cumsum(count)))
    body = np.repeat(np.arange(len(count)), count)
    begin = block_ptr[body] + PART * (np.arange(len(body)) - ptr[body])
    return ptr, body, np.append(begin, block_ptr[-1])


def _places(g: CoarseGeometry, counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """For each group where its row begins, which has for each function of its body the place among those of the group,
    -1: it is none of them."""
    ptr = np.concatenate(([0], np.cumsum(counts[g.group_body]))).astype(np.int64)
    out = np.full(ptr[-1], -1)
    group, place = np.nonzero(g.group_functions >= 0)
    out[ptr[group] + g.group_functions[group, place] - g.function_ptr[g.group_body[group]]] = place
    return ptr[:-1], out


def _moments(g: CoarseGeometry, points: np.ndarray, tets: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """For each group its vertices and the vectors D with sum over them of x D' = sum of V F over the group's tets."""
    listed, vertices = np.flatnonzero(g.tet_group >= 0), max(len(points), 1)
    corners = tets[listed].T.copy()
    key = (g.tet_group[listed] * vertices + corners).reshape(-1)
    sort = np.argsort(key, kind="stable")
    new = np.diff(key[sort], prepend=-1) > 0
    row = np.empty(len(key), dtype=np.int64)
    row[sort] = np.cumsum(new) - 1
    key = key[sort[new]]
    # V times the gradients of the shape functions: normals of the opposite faces, which sum to 0
    x = points.T.copy()[:, corners]  # [3, 4, tets]
    e = x[:, 1:] - x[:, :1]
    normals = [np.cross(e[:, (k + 1) % 3], e[:, (k + 2) % 3], axis=0) for k in range(3)]
    normals = np.stack([-(normals[0] + normals[1] + normals[2]), *normals], 1)
    out = np.stack([np.bincount(row, along.reshape(-1), len(key)) for along in normals], 1) / 6
    return _starts(key // vertices, len(g.group_body)), key % vertices, out
