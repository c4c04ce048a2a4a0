"""The coarse space of a Model as tensors: what the corrections read, and what their matrices are made of."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from .. import ops
from ..checks import fail
from ..ops.coarse_arrays import PACK as LANES
from ..ops.coarse_arrays import ROW, lengths
from ..tuples import replaced
from .bodies import connected
from .coarse import CoarseGeometry, CoarseSpace, build_coarse

TILE = 32  # unknowns of a body beyond which it counts as large; twin of kTile in csrc/coarse/views.h
MOST_COUPLED = 512  # functions of all bodies beside contact: one dense system of three times as many unknowns
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
            device: str) -> tuple[CoarseGeometry, CoarsePlan]:  # fmt: skip
    """The space on a mesh in float64, on the CPU; rest [1, T, 7]; plan: of the sweeps on a device, itself on the
    CPU."""
    arrays = points.numpy(), tets.numpy()
    geometry = build_coarse(*arrays, pinned.numpy(), connected(tets, len(points)).numpy(), space)
    order = ops.plan_order(plan, ops.LANES[device]).numpy()
    return geometry, arrange_coarse(geometry, space.every, *arrays, mass.numpy(), rest[0].numpy(), order)


def check_coupled(geometry: CoarseGeometry, touches: bool) -> None:
    """Beside contact, raises where the bodies of a scene have more functions than can be solved for together."""
    if touches and geometry.functions > MOST_COUPLED:
        fail("coarse", f"at most {MOST_COUPLED} functions of all bodies beside a PairBarrier or Friction, which couple "
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
    as_tensor = torch.from_numpy
    return CoarsePlan(
        sizes=sizes,
        plan=index,
        weights=weights,
        rest=as_tensor(lanes[None].copy()),
        tet=as_tensor(np.maximum(tet, 0)),
        moments=as_tensor(moment[2]),
        volume=as_tensor(np.bincount(g.tet_group[g.tet_group >= 0], volume[g.tet_group >= 0], len(g.group_body))),
        mass=ops.raw.coarse_mass(as_tensor(mass)[None], index, weights, sizes),
    )


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
    x = [axis[corners] for axis in points.T.copy()]
    e = [x[c][1:] - x[c][0] for c in range(3)]
    out = np.empty((len(key), 3))
    for c in range(3):
        a, b = e[(c + 1) % 3], e[(c + 2) % 3]
        normal = np.empty((4, len(listed)))
        for k in range(3):
            i, j = (k + 1) % 3, (k + 2) % 3
            normal[k + 1] = a[i] * b[j] - b[i] * a[j]
        normal[0] = -(normal[1] + normal[2] + normal[3])
        out[:, c] = np.bincount(row, normal.reshape(-1), len(key)) / 6
    return _starts(key // vertices, len(g.group_body)), key % vertices, out
