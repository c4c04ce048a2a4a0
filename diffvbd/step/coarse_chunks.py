"""The sums of coarse_sums.py by products of torch, for devices without compiled loops: some groups or bodies at a time,
so that what is worked with stays below about LIMIT scalars. No two numbers go to one place: the same bits every time.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from ..model.coarse_plan import LANES, ROW, CoarsePlan, views

LIMIT = 2**25


def stiffness(plan: CoarsePlan, mu: Tensor, lam: Tensor, gradients: Tensor, volume: Tensor) -> Tensor:
    """See coarse_stiffness()."""
    given = (mu, lam, gradients, volume)
    scenes, width = max(len(t) for t in given), plan.sizes.width
    out = mu.new_zeros((scenes, plan.sizes.groups, 3, 3, width, width))
    for groups, tets, weights, inside in _tets(plan, scenes):
        out[:, groups] += _stiffness_of(weights, inside, *(_at(t, tets) for t in given))
    return out


def stiffness_backward(plan: CoarsePlan, mu: Tensor, lam: Tensor, gradients: Tensor, volume: Tensor, bar: Tensor
                       ) -> tuple[Tensor, ...]:  # fmt: skip
    """Adjoints of mu, lam, gradients and volume, for each scene and tet."""
    given = (mu, lam, gradients, volume)
    scenes, count = max(len(t) for t in given), gradients.shape[1]
    bars = tuple(t.new_zeros((scenes, count, *t.shape[2:])) for t in given)
    for groups, tets, weights, inside in _tets(plan, scenes):
        with torch.enable_grad():
            parts = [_at(t, tets).expand(scenes, *tets.shape, *t.shape[2:]).detach().requires_grad_() for t in given]
            value = _stiffness_of(weights, inside, *parts)
        for whole, part in zip(bars, torch.autograd.grad(value, parts, bar[:, groups]), strict=True):
            whole[:, tets[inside]] = part[:, inside]
    return bars


def mass(plan: CoarsePlan, mass: Tensor) -> Tensor:
    """See coarse_mass()."""
    out = mass.new_zeros((len(mass), plan.sizes.cells))
    for cells, known, vertices, weights in _vertices(plan, len(mass)):
        out[:, cells[known]] += _mass_of(weights, mass[:, vertices])[:, known]
    part = views(plan.sizes, plan.plan)
    filling = (part["row_ptr"].diff() == 0).nonzero()[:, 0]
    body = part["function_body"][filling]
    first, size = part["function_ptr"][body], part["function_ptr"].diff()[body]
    out[:, part["mass_ptr"][body] + (filling - first) * (size + 1)] = 1
    return out


def mass_backward(plan: CoarsePlan, bar: Tensor) -> Tensor:
    """Adjoint of the masses of vertices [B, V]."""
    out = bar.new_zeros((len(bar), plan.sizes.vertices))
    for cells, known, vertices, weights in _vertices(plan, len(bar)):
        both = (weights @ torch.where(known, bar[:, cells], 0)) * weights  # in a row of 0 at padding
        inside = weights.any(-1)
        out[:, vertices[inside]] = both.sum(-1)[:, inside]
    return out


def _stiffness_of(weights: Tensor, inside: Tensor, mu: Tensor, lam: Tensor, gradients: Tensor, volume: Tensor
                  ) -> Tensor:  # fmt: skip
    """Of n groups with t tets each, from [n, t, 4, width] and [1 | B, n, t, ...]."""
    slopes = (gradients.transpose(-1, -2) @ weights).flatten(-2)
    n, width = len(weights), weights.shape[-1]

    def weighted(modulus: Tensor) -> Tensor:
        out = (slopes * (modulus * volume * inside)[..., None]).transpose(-1, -2) @ slopes
        return out.reshape(-1, n, 3, width, 3, width).transpose(3, 4)

    shear = weighted(mu)
    trace = shear.diagonal(dim1=2, dim2=3).sum(-1)[:, :, None, None]
    one = torch.eye(3, dtype=shear.dtype, device=shear.device)[:, :, None, None]
    return shear.transpose(2, 3) + one * trace + weighted(lam)


def _mass_of(weights: Tensor, mass: Tensor) -> Tensor:
    return (weights * mass[..., None]).transpose(-1, -2) @ weights


def _at(values: Tensor, tets: Tensor) -> Tensor:
    return values[:, tets] if values.shape[1] > 1 else values[:, 0][:, None, None]


def _tets(plan: CoarsePlan, scenes: int) -> Iterator[tuple[slice, Tensor, Tensor, Tensor]]:
    """Groups, and of some of their tets: numbers, weights at the corners, and whether they are no padding."""
    part, width = views(plan.sizes, plan.plan), plan.sizes.width
    count, body = part["tet_ptr"].diff(), part["group_body"]
    start = part["block_ptr"][body] * LANES + part["tet_ptr"][:-1] - part["tet_ptr"][part["group_ptr"][body]]
    corner = part["corner"].reshape(-1, 4, LANES).transpose(1, 2).reshape(-1, 4) // ROW
    base = part["place_ptr"] - part["function_ptr"][body]
    of_tet = 4 * (3 * plan.most_of_position + width) + 24 * scenes * width
    for groups, first, last in _pieces(count, of_tet, 90 * scenes * width**2):
        slot = start[groups, None] + torch.arange(first, last, device=count.device)
        inside = slot < (start + count)[groups, None]
        slot = torch.where(inside, slot, start[groups, None])
        weights = _dense(plan, part, corner[slot], base[groups, None, None, None], part["place"], width)
        yield groups, part["tet"][slot], weights, inside


def _vertices(plan: CoarsePlan, scenes: int) -> Iterator[tuple[Tensor, Tensor, Tensor, Tensor]]:
    """Of some bodies the cells of their matrices and which of these are no padding; and of some of their vertices:
    numbers, and weights, 0 at padding."""
    part, most = views(plan.sizes, plan.plan), plan.sizes.most
    start, count, size = part["list_ptr"][:-1], part["list_ptr"].diff(), part["function_ptr"].diff()
    own = torch.arange(most, device=count.device)
    for bodies, first, last in _pieces(count, 3 * plan.most_of_position + 3 * scenes * most, 4 * scenes * most**2):
        known = own < size[bodies, None]
        cells = part["mass_ptr"][:-1][bodies, None, None] + own[:, None] * size[bodies, None, None] + own
        known = known[:, :, None] & known[:, None]
        listed = start[bodies, None] + torch.arange(first, last, device=count.device)
        inside = listed < (start + count)[bodies, None]
        listed = torch.where(inside, listed, start[bodies, None])
        base = -part["function_ptr"][:-1][bodies, None, None]
        weights = _dense(plan, part, part["list_position"][listed], base, None, most)
        yield torch.where(known, cells, 0), known, part["list"][listed], weights * inside[..., None]


def _dense(plan: CoarsePlan, part: dict[str, Tensor], position: Tensor, base: Tensor, place: Tensor | None, width: int
           ) -> Tensor:  # fmt: skip
    """Weights of the functions at positions [..., width]; where a function stands: place[base + function], or that."""
    begin, end = part["position_ptr"][position], part["position_ptr"][position + 1]
    entry = begin[..., None] + torch.arange(plan.most_of_position, device=position.device)
    inside = entry < end[..., None]
    entry = torch.where(inside, entry, 0)
    at = base + part["function"][entry]
    at = torch.where(inside, at if place is None else place[torch.where(inside, at, 0)], width)
    out = plan.weights.new_zeros((*position.shape, width + 1))
    return out.scatter_(-1, at, torch.where(inside, plan.weights[entry], 0))[..., :width]


def _pieces(count: Tensor, of_entry: int, of_list: int) -> Iterator[tuple[slice, int, int]]:
    """Lists of so many entries a few at a time, and which entries of each; so many scalars go with an entry and with a
    list."""
    counts, first = count.tolist(), 0
    while first < len(counts):
        last, most = first + 1, counts[first]
        while last < len(counts):
            wider = max(most, counts[last])
            if (last + 1 - first) * (wider * of_entry + of_list) > LIMIT:
                break
            last, most = last + 1, wider
        step = max(1, LIMIT // ((last - first) * of_entry))
        for begin in range(0, most, step):
            yield slice(first, last), begin, min(begin + step, most)
        first = last
