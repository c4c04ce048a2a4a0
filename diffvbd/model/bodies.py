"""The bodies of a mesh as the operators at the beginning and the end of a step take them."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ..mesh import arrays
from ..ops.fields import CORRECTED

# vertices of a body that a thread (where there are many), a part of a warp and a block of a CUDA device work on
LARGEST = (12, 64, 2048)
Groups = tuple[int, int, int, int]  # how many bodies are tiny, small, medium and large, by LARGEST


class Bodies(NamedTuple):
    """The bodies that are corrected: connected, with no pinned vertex. Smallest first."""

    order: Tensor  # int32 [listed], their vertices
    ptr: Tensor  # int32 [bodies + 1]
    spread: Tensor  # float64 [bodies], squared radius of gyration at rest [m^2]
    tets: Tensor  # as of OtherBodies; none without a floor, on which alone a start asks for them
    tet_ptr: Tensor
    groups: Groups

    @property
    def number(self) -> int:
        return self.ptr.shape[0] - 1

    def to(self, device: torch.device) -> Bodies:
        order, ptr, spread, tets, tet_ptr = (t.to(device) for t in self[:5])
        return Bodies(order, ptr, spread, tets, tet_ptr, self.groups)


class OtherBodies(NamedTuple):
    """The bodies that are not. Smallest first."""

    of: Tensor  # int32 [V], which of them a vertex is in; -1: none; CORRECTED: one of Bodies
    order: Tensor  # int32 [listed], their vertices
    ptr: Tensor  # int32 [bodies + 1]
    tets: Tensor  # int32 [tets of these bodies, 5]: the number of a tet and its corners
    tet_ptr: Tensor  # int32 [bodies + 1]
    groups: Groups

    @property
    def number(self) -> int:
        return self.ptr.shape[0] - 1

    def to(self, device: torch.device) -> OtherBodies:
        of, order, ptr, tets, tet_ptr = (t.to(device) for t in self[:5])
        return OtherBodies(of, order, ptr, tets, tet_ptr, self.groups)


class _Grouped(NamedTuple):
    of: Tensor  # int64 [V], -1 for a vertex that is not listed
    order: Tensor
    ptr: Tensor
    groups: Groups


def connected(sets: Tensor, count: int) -> Tensor:
    """Lowest item of the connected sets that each of ``count`` items is in, int64 [count]; sets: int64 [N, n], CPU."""
    return torch.from_numpy(arrays.connected(sets.numpy(), count))


def find_bodies(points: Tensor, tets: Tensor, pinned: Tensor, correct: bool, floor: bool) -> tuple[Bodies, OtherBodies]:
    """Connected sets of tets: those without a pinned vertex, if they are to be corrected, and the others.

    points [V, 3], tets int64 [T, 4], pinned bool [V]; all on the CPU. floor: whether there are planes.
    """
    label = connected(tets, points.shape[0])
    count = len(label)
    loose = torch.ones(count, dtype=torch.bool)
    loose[tets.reshape(-1)] = False
    held = torch.full((count,), not correct).index_fill_(0, label[pinned], True)[label]
    free, other = _grouped(label, ~held & ~loose), _grouped(label, held & ~loose)

    size = (free.ptr[1:] - free.ptr[:-1])[:, None]
    of_row = free.of[free.order]
    center = points.new_zeros((len(size), 3)).index_add_(0, of_row, points[free.order]) / size
    square = (points[free.order] - center[of_row]).square().sum(-1)
    spread = points.new_zeros(len(size)).index_add_(0, of_row, square) / size[:, 0]

    return (
        Bodies(
            free.order.int(),
            free.ptr.int(),
            spread.double(),
            *_tets_of(free, tets if floor else tets[:0]),
            free.groups,
        ),
        OtherBodies(
            torch.where(free.of >= 0, CORRECTED, other.of).int(),
            other.order.int(),
            other.ptr.int(),
            *_tets_of(other, tets),
            other.groups,
        ),
    )


def first_of_body(body: Tensor) -> Tensor:
    """For each vertex the first vertex of its body [V]: the origin that float32 computes about."""
    labels, inverse = torch.unique(body, return_inverse=True)
    order = torch.arange(body.shape[0])
    first = torch.full((labels.shape[0],), body.shape[0]).scatter_reduce(0, inverse, order, "amin")
    return first[inverse]


def _tets_of(bodies: _Grouped, tets: Tensor) -> tuple[Tensor, Tensor]:
    """The tets of bodies [listed, 5] as OtherBodies has them, and where those of each begin."""
    of_tet = bodies.of[tets[:, 0]] if len(tets) else bodies.of[:0]
    listed = (of_tet >= 0).nonzero().reshape(-1)
    listed = listed[torch.argsort(of_tet[listed], stable=True)]
    tet_ptr = _starts(torch.bincount(of_tet[listed], minlength=len(bodies.ptr) - 1))
    return torch.cat([listed[:, None], tets[listed]], 1).int(), tet_ptr.int()


def _starts(sizes: Tensor) -> Tensor:
    return torch.cat([sizes.new_zeros(1), sizes.cumsum(0)])


def _grouped(label: Tensor, which: Tensor) -> _Grouped:
    """The vertices of a mask by label, those of the smallest body first."""
    listed = which.nonzero().reshape(-1)
    roots, of_body, size = torch.unique(label[listed], return_inverse=True, return_counts=True)
    rank = torch.argsort(size, stable=True)
    of_body = torch.empty_like(rank).index_copy_(0, rank, torch.arange(len(roots)))[of_body]
    size = size[rank]
    tiny, small, medium = (int((size <= largest).sum()) for largest in LARGEST)
    of = torch.full((len(label),), -1).index_copy_(0, listed, of_body)
    order = listed[torch.argsort(of_body, stable=True)]
    return _Grouped(of, order, _starts(size), (tiny, small - tiny, medium - small, len(size) - medium))
