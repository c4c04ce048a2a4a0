"""The coarse space of a Model as tensors: what the corrections read, and what their matrices are made of."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from .. import ops
from .bodies import connected
from .coarse import CoarseGeometry, CoarseSpace, build_coarse
from .rest import rest_metric, shape_gradients

LANES = ops.LANES["cpu"]  # tets of a block, on every device; twin of kLanes
TILE = 32  # unknowns of a body beyond which it counts as large; twin of kTile in csrc/coarse/views.h
PART = 32  # most blocks of a part of a body
ROW = 4  # scalars of a row of positions; twin of kRow in csrc/core/views.h


class CoarsePlan(NamedTuple):
    """All tensors are constants of the Model; floating ones have its dtype, but for ``volume`` (float64)."""

    sizes: ops.CoarseSizes
    plan: Tensor  # int32, see csrc/coarse/views.h
    weights: Tensor  # [2 entries], of W by position and by function
    rest: Tensor  # [1, blocks, 7, lanes], rest scalars of the tets of each body
    tet: Tensor  # int64 [blocks, lanes], their numbers; any at padding
    moments: Tensor  # [n, 3], what the mean deformations of the groups are made of
    volume: Tensor  # float64 [groups]
    mass: Tensor  # [1, cells], W' M W of each body with the Model's own masses; 1 for functions that fill up
    group_tets: Tensor  # int64 [groups, n], any at padding
    group_weights: Tensor  # [groups, n, 4, width], functions of a group at the corners of its tets; 0 at padding

    def to(self, device: torch.device, dtype: torch.dtype) -> CoarsePlan:
        def placed(t: Tensor) -> Tensor:
            return t.to(device, dtype) if t.is_floating_point() else t.to(device)

        sizes, *tensors = self
        return CoarsePlan(sizes, *map(placed, tensors))._replace(volume=self.volume.to(device))

    @property
    def width(self) -> int:
        """Most functions of a group."""
        return self.group_weights.shape[-1]


def plan_of(space: CoarseSpace, points: Tensor, tets: Tensor, pinned: Tensor, mass: Tensor, plan: Tensor,
            device: str) -> tuple[CoarseGeometry, CoarsePlan]:  # fmt: skip
    """The space on a mesh in float64, on the CPU; plan: of the sweeps on a device, itself on the CPU."""
    arrays = points.numpy(), tets.numpy()
    geometry = build_coarse(*arrays, pinned.numpy(), connected(tets, len(points)).numpy(), space)
    order = ops.plan_order(plan, ops.LANES[device]).numpy()
    rest, _ = rest_metric(points[tets][None])
    return geometry, arrange_coarse(geometry, space.every, *arrays, mass.numpy(), rest[0].numpy(), order)


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
    sort = np.lexsort((g.function, at))
    by_position = (at[sort], g.function[sort], g.weight[sort])
    rows = np.lexsort((at, g.function))
    function_body = np.repeat(np.arange(g.bodies), counts)
    position_body = np.full(len(order), -1)
    position_body[at] = function_body[g.function]

    listed, vertex_body = np.unique(g.vertex), np.full(vertices, -1)
    vertex_body[g.vertex] = function_body[g.function]
    listed = listed[np.argsort(vertex_body[listed], kind="stable")]
    tet_body = np.where(g.tet_group >= 0, g.group_body[g.tet_group], -1) if len(g.group_body) else g.tet_group
    tet, block_ptr = _blocks(tet_body, g.bodies)
    # padding has one corner of its block four times
    corner = position[np.where(tet[..., None] >= 0, tets[np.maximum(tet, 0)], tets[tet[:, :1], :1])].swapaxes(1, 2)

    group_tets, inside = _padded(g.tet_group, len(g.group_body))
    gradients, volume = (a.numpy() for a in shape_gradients(torch.from_numpy(points[tets])))
    moment = _moments(g, tets, gradients, volume, group_tets, inside, vertices)
    moment_group = np.repeat(np.arange(len(g.group_body)), np.diff(moment[0]))
    part_ptr, part_body, part_begin = _parts(block_ptr)
    place_ptr, place = _places(g, counts)
    sizes = ops.CoarseSizes(
        g.bodies, g.functions, len(g.group_body), g.group_functions.shape[1], len(g.vertex), len(tet), len(moment[1]),
        len(order), len(listed), int(mass_ptr[-1]), int(counts.max(initial=0)), len(part_body), len(place), vertices,
        int((3 * counts > TILE).sum()), every)  # fmt: skip
    arrays = [
        g.function_ptr, mass_ptr, function_body, position_body, _starts(by_position[0], len(order)), by_position[1],
        _starts(g.function[rows], g.functions), at[rows], block_ptr, part_ptr, part_body, part_begin, ROW * corner,
        np.maximum(tet, 0), _starts(g.group_body, g.bodies), g.group_body, g.group_functions, place_ptr, place,
        *moment[:2], moment_group, _starts(np.sort(moment[1]), vertices), np.argsort(moment[1], kind="stable"),
        _starts(vertex_body[listed], g.bodies), listed, position[listed],
    ]  # fmt: skip
    lanes = rest[np.maximum(tet, 0)].swapaxes(1, 2)  # of any tet at padding, whose corners do not move apart
    as_tensor = torch.from_numpy
    return CoarsePlan(
        sizes=sizes,
        plan=torch.from_numpy(np.concatenate([np.asarray(a).reshape(-1) for a in arrays]).astype(np.int32)),
        weights=as_tensor(np.concatenate((by_position[2], g.weight[rows]))),
        rest=as_tensor(lanes[None].copy()),
        tet=as_tensor(np.maximum(tet, 0)),
        moments=as_tensor(moment[2]),
        volume=as_tensor(np.bincount(g.tet_group[g.tet_group >= 0], volume[g.tet_group >= 0], len(g.group_body))),
        mass=as_tensor(_mass_cells(g, mass)[None]),
        group_tets=as_tensor(group_tets),
        group_weights=as_tensor(_group_weights(g, tets, group_tets, inside, vertices)),
    )


def _starts(sorted_values: np.ndarray, count: int) -> np.ndarray:
    return np.searchsorted(sorted_values, np.arange(count + 1))


def _blocks(of: np.ndarray, bodies: int) -> tuple[np.ndarray, np.ndarray]:
    """Tets of each body in blocks [blocks, LANES], -1 at the end of the last one, and where each body's begin."""
    order = np.argsort(of, kind="stable")
    order = order[of[order] >= 0]
    count = np.bincount(of[order], minlength=bodies)
    ptr = np.concatenate(([0], np.cumsum(-(-count // LANES))))
    out = np.full(ptr[-1] * LANES, -1)
    first = np.concatenate(([0], np.cumsum(count)[:-1])) if bodies else count
    out[np.arange(len(order)) + np.repeat(ptr[:-1] * LANES - first, count)] = order
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


def _padded(of: np.ndarray, groups: int) -> tuple[np.ndarray, np.ndarray]:
    order = np.argsort(of, kind="stable")
    order = order[of[order] >= 0]
    count = np.bincount(of[order], minlength=groups)
    out = np.full((groups, int(count.max(initial=0))), -1)
    out[of[order], np.arange(len(order)) - np.repeat(np.cumsum(count) - count, count)] = order
    return np.maximum(out, 0), out >= 0


def _moments(g: CoarseGeometry, tets: np.ndarray, gradients: np.ndarray, volume: np.ndarray, group_tets: np.ndarray,
             inside: np.ndarray, vertices: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """For each group its vertices and the vectors D with sum over them of x D' = sum of V F over the group's tets."""
    listed = np.flatnonzero(g.tet_group >= 0)
    key = np.repeat(g.tet_group[listed], 4) * vertices + tets[listed].reshape(-1)
    unique, inverse = np.unique(key, return_inverse=True)
    out = np.zeros((len(unique), 3))
    np.add.at(out, inverse.reshape(-1), (volume[listed, None, None] * gradients[listed]).reshape(-1, 3))
    return _starts(unique // max(vertices, 1), len(g.group_body)), unique % max(vertices, 1), out


def _group_weights(g: CoarseGeometry, tets: np.ndarray, group_tets: np.ndarray, inside: np.ndarray, vertices: int
                   ) -> np.ndarray:  # fmt: skip
    groups, most = group_tets.shape
    width = g.group_functions.shape[1]
    out = np.zeros((groups, most, 4, width))
    local = np.full(g.functions + 1, -1)
    ptr = _starts(g.vertex, vertices)
    for group in range(groups):
        functions = g.group_functions[group]
        local[:] = -1
        local[functions[functions >= 0]] = np.flatnonzero(functions >= 0)
        corners = tets[group_tets[group][inside[group]]].reshape(-1)
        count = ptr[corners + 1] - ptr[corners]
        entry = np.repeat(ptr[corners] - np.cumsum(count) + count, count) + np.arange(count.sum())
        flat = out[group].reshape(-1, width)
        flat[np.repeat(np.arange(len(corners)), count), local[g.function[entry]]] = g.weight[entry]
    return out


def _mass_cells(g: CoarseGeometry, mass: np.ndarray) -> np.ndarray:
    cell, vertex, weight, out = mass_parts(g)
    np.add.at(out, cell, weight * mass[vertex])
    return out


def mass_parts(g: CoarseGeometry) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """What W' M W of all bodies is a sum of: cell, vertex and weight of each product; and the cells that this is added
    to: 1 on the diagonal of functions that fill up a matrix, else 0."""
    size = np.diff(g.function_ptr)
    mass_ptr = np.concatenate(([0], np.cumsum(size**2)))
    body = np.repeat(np.arange(g.bodies), size)
    own = np.arange(g.functions) - g.function_ptr[body]
    filled = np.zeros(int(mass_ptr[-1]))
    filled[(mass_ptr[body] + own * (size[body] + 1))[g.filling]] = 1.0

    first = np.searchsorted(g.vertex, np.unique(g.vertex))
    count = np.diff(np.append(first, len(g.vertex)))
    of = np.repeat(count, count)  # of each entry of W: how many its vertex has
    one = np.repeat(np.arange(len(g.vertex)), of)
    two = np.repeat(np.repeat(first, count), of) + np.arange(len(one)) - np.repeat(np.cumsum(of) - of, of)
    body = body[g.function[one]]
    cell = mass_ptr[body] + own[g.function[one]] * size[body] + own[g.function[two]]
    return cell, g.vertex[one], g.weight[one] * g.weight[two], filled
