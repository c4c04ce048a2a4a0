"""The arrays of a plan of a coarse space; and coarse_stiffness and coarse_mass on CUDA, by products of torch.

Some groups or bodies at a time, so that what is worked with stays below about LIMIT scalars. No two numbers go to one
place: the same bits every time.

What depends on the plan alone is made at the first call for a plan, which waits for the device; no later call does, so
that a CUDA graph captures them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.utils.weak import WeakTensorKeyDictionary

from .fields import LANES, ROW, CoarseSizes

PACK = LANES["cpu"]  # tets of a block, on every device

LIMIT = 2**25
_pieces: Any = WeakTensorKeyDictionary()  # of each plan, by what else they depend on


def lengths(s: CoarseSizes) -> dict[str, int]:
    """Of the arrays in their order; twin of view_plan() in csrc/coarse/views.h."""
    return {
        "function_ptr": s.bodies + 1, "mass_ptr": s.bodies + 1, "function_body": s.functions,
        "position_body": s.positions, "position_ptr": s.positions + 1, "function": s.entries,
        "row_ptr": s.functions + 1, "row": s.entries, "block_ptr": s.bodies + 1, "part_ptr": s.bodies + 1,
        "part_body": s.parts, "part_begin": s.parts + 1, "corner": 4 * s.tet_blocks * PACK,
        "tet": s.tet_blocks * PACK, "group_ptr": s.bodies + 1, "group_body": s.groups,
        "group_function": s.groups * s.width, "place_ptr": s.groups, "place": s.places, "tet_ptr": s.groups + 1,
        "moment_ptr": s.groups + 1, "moment_vertex": s.moments, "moment_group": s.moments,
        "vertex_ptr": s.vertices + 1, "vertex_moment": s.moments, "list_ptr": s.bodies + 1, "list": s.listed,
        "list_position": s.listed,
    }  # fmt: skip


def views(sizes: CoarseSizes, plan: Tensor) -> dict[str, Tensor]:
    """The arrays of a plan by their names, int64 and flat."""
    own = lengths(sizes)
    return dict(zip(own, plan.long().split(list(own.values())), strict=True))


class _Tets(NamedTuple):
    """Some tets of some groups [n, t]; padding repeats a group's first."""

    groups: slice
    position: Tensor  # [n, t, 4] of their corners
    base: Tensor  # [n, 1, 1, 1], see _dense()
    tet: Tensor  # their numbers
    inside: Tensor  # 0 at padding, else 1
    chosen: Tensor  # where that is 1, among all
    numbers: Tensor  # of these tets


class _Vertices(NamedTuple):
    """Some vertices of some bodies [n, v]."""

    cells: Tensor  # [n, most, most] of the bodies' matrices, 0 at padding
    known: Tensor  # 0 there, else 1
    chosen_cells: Tensor
    cell_numbers: Tensor
    position: Tensor
    base: Tensor
    vertex: Tensor
    inside: Tensor
    chosen: Tensor
    numbers: Tensor


def stiffness(mu: Tensor, lam: Tensor, gradients: Tensor, volume: Tensor, plan: Tensor, weights: Tensor, sizes: Any
              ) -> Tensor:  # fmt: skip
    sizes, given = CoarseSizes(*sizes), (mu, lam, gradients, volume)
    scenes, width = max(len(t) for t in given), sizes.width
    out = mu.new_zeros((scenes, sizes.groups, 3, 3, width, width))
    part = views(sizes, plan)
    for piece in _tets(plan, sizes, scenes):
        w = _dense(part, weights, piece.position, piece.base, part["place"], width, plan, sizes)
        slopes, shear, bulk, _ = _slopes(piece, w, *given)

        def product(scale: Tensor, slopes: Tensor = slopes) -> Tensor:
            both = (slopes * scale[..., None]).transpose(-1, -2) @ slopes
            return both.reshape(*both.shape[:2], 3, width, 3, width).transpose(3, 4)

        of_mu = product(shear)
        trace = of_mu.diagonal(dim1=2, dim2=3).sum(-1)[:, :, None, None]
        one = torch.eye(3, dtype=mu.dtype, device=mu.device)[:, :, None, None]
        out[:, piece.groups] += of_mu.transpose(2, 3) + one * trace + product(bulk)
    return out


def stiffness_backward(mu: Tensor, lam: Tensor, gradients: Tensor, volume: Tensor, plan: Tensor, weights: Tensor,
                       bar: Tensor, sizes: Any, wants_rest: bool) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
    sizes, given = CoarseSizes(*sizes), (mu, lam, gradients, volume)
    scenes, count, width = max(len(t) for t in given), gradients.shape[1], sizes.width
    rest = count if wants_rest else 0
    bars = tuple(mu.new_zeros((scenes, *own)) for own in ((count,), (count,), (rest, 4, 3), (rest,)))
    part = views(sizes, plan)
    for piece in _tets(plan, sizes, scenes):
        w = _dense(part, weights, piece.position, piece.base, part["place"], width, plan, sizes)
        slopes, shear, bulk, (of_mu, of_lam, size) = _slopes(piece, w, *given)
        own = bar[:, piece.groups]
        trace = own.diagonal(dim1=2, dim2=3).sum(-1)[:, :, None, None]
        one = torch.eye(3, dtype=mu.dtype, device=mu.device)[:, :, None, None]
        # of sum over r, c, i, j of bar: slopes in the columns (c, i) and (r, j), or (r, i) and (c, j)
        asked = (own.transpose(2, 3) + one * trace, own)
        asked = [t.transpose(3, 4).reshape(*t.shape[:2], 3 * width, 3 * width) for t in asked]
        turned = [slopes @ (t + t.transpose(-1, -2)) for t in asked]
        sums = [(slopes * t).sum(-1) / 2 for t in turned]
        _put(bars[0], piece.chosen, piece.numbers, size * sums[0])
        _put(bars[1], piece.chosen, piece.numbers, size * sums[1])
        if not wants_rest:
            continue
        slopes_bar = shear[..., None] * turned[0] + bulk[..., None] * turned[1]
        _put(bars[2], piece.chosen, piece.numbers, w @ slopes_bar.unflatten(-1, (3, width)).transpose(-1, -2))
        _put(bars[3], piece.chosen, piece.numbers, of_mu * sums[0] + of_lam * sums[1])
    return bars  # pyright: ignore[reportReturnType]


def mass(of_vertices: Tensor, plan: Tensor, weights: Tensor, sizes: Any) -> Tensor:
    sizes = CoarseSizes(*sizes)
    out = of_vertices.new_zeros((len(of_vertices), sizes.cells))
    part = views(sizes, plan)
    for piece in _vertices(plan, sizes, len(of_vertices)):
        w = _dense(part, weights, piece.position, piece.base, None, sizes.most, plan, sizes) * piece.inside[..., None]
        cells = (w * of_vertices[:, piece.vertex][..., None]).transpose(-1, -2) @ w
        out[:, piece.cell_numbers] += cells.flatten(1)[:, piece.chosen_cells]
    filled = _once(plan, "filled", lambda: _filled(part))
    return out.index_fill_(1, filled, 1)  # assignment would copy a number from the host


def mass_backward(bar: Tensor, plan: Tensor, weights: Tensor, sizes: Any) -> Tensor:
    sizes = CoarseSizes(*sizes)
    out = bar.new_zeros((len(bar), sizes.vertices))
    part = views(sizes, plan)
    for piece in _vertices(plan, sizes, len(bar)):
        w = _dense(part, weights, piece.position, piece.base, None, sizes.most, plan, sizes)
        both = (w @ (bar[:, piece.cells] * piece.known)) * w
        _put(out, piece.chosen, piece.numbers, both.sum(-1))
    return out


def _slopes(piece: _Tets, weights: Tensor, mu: Tensor, lam: Tensor, gradients: Tensor, volume: Tensor) -> tuple:
    """Gradients of the functions [B, n, t, 3 width], mu V and lam V, 0 at padding; and mu, lam, V."""
    mu, lam, gradients, volume = (
        t[:, piece.tet] if t.shape[1] > 1 else t[:, 0][:, None, None] for t in (mu, lam, gradients, volume)
    )
    slopes = (gradients.transpose(-1, -2) @ weights).flatten(-2)
    size = volume * piece.inside
    return slopes, mu * size, lam * size, (mu, lam, volume)


def _put(out: Tensor, chosen: Tensor, numbers: Tensor, values: Tensor) -> None:
    """Values [B, n, t, ...] to where they belong, without those of padding."""
    out[:, numbers] = values.expand(len(out), *values.shape[1:]).flatten(1, 2)[:, chosen]


def _once(plan: Tensor, key: Any, make: Callable[[], Any]) -> Any:
    known = _pieces.setdefault(plan, {})
    if key not in known:
        known[key] = make()
    return known[key]


def _filled(part: dict[str, Tensor]) -> Tensor:
    """Cells on the diagonal of functions that act on no vertex."""
    functions = (part["row_ptr"].diff() == 0).nonzero()[:, 0]
    body = part["function_body"][functions]
    first, size = part["function_ptr"][body], part["function_ptr"].diff()[body]
    return part["mass_ptr"][body] + (functions - first) * (size + 1)


def _most(plan: Tensor, sizes: CoarseSizes) -> int:
    """Functions of a position at most."""
    return _once(plan, "most", lambda: int(views(sizes, plan)["position_ptr"].diff().max()))


def _tets(plan: Tensor, sizes: CoarseSizes, scenes: int) -> list[_Tets]:
    return _once(plan, ("tets", scenes, LIMIT), lambda: list(_make_tets(plan, sizes, scenes)))


def _make_tets(plan: Tensor, sizes: CoarseSizes, scenes: int) -> Iterator[_Tets]:
    part, width = views(sizes, plan), sizes.width
    count, body = part["tet_ptr"].diff(), part["group_body"]
    start = part["block_ptr"][body] * PACK + part["tet_ptr"][:-1] - part["tet_ptr"][part["group_ptr"][body]]
    corner = part["corner"].reshape(-1, 4, PACK).transpose(1, 2).reshape(-1, 4) // ROW
    base = part["place_ptr"] - part["function_ptr"][body]
    of_tet = 4 * (3 * _most(plan, sizes) + width) + 24 * scenes * width
    for groups, first, last in _cut(count, of_tet, 90 * scenes * width**2):
        slot = start[groups, None] + torch.arange(first, last, device=count.device)
        inside = slot < (start + count)[groups, None]
        slot = torch.where(inside, slot, start[groups, None])
        tet = part["tet"][slot]
        yield _Tets(groups, corner[slot], base[groups, None, None, None], tet, inside.long(),
                    inside.reshape(-1).nonzero()[:, 0], tet[inside])  # fmt: skip


def _vertices(plan: Tensor, sizes: CoarseSizes, scenes: int) -> list[_Vertices]:
    return _once(plan, ("vertices", scenes, LIMIT), lambda: list(_make_vertices(plan, sizes, scenes)))


def _make_vertices(plan: Tensor, sizes: CoarseSizes, scenes: int) -> Iterator[_Vertices]:
    part, most = views(sizes, plan), sizes.most
    start, count, size = part["list_ptr"][:-1], part["list_ptr"].diff(), part["function_ptr"].diff()
    own = torch.arange(most, device=count.device)
    for bodies, first, last in _cut(count, 3 * _most(plan, sizes) + 3 * scenes * most, 4 * scenes * most**2):
        known = own < size[bodies, None]
        cells = part["mass_ptr"][:-1][bodies, None, None] + own[:, None] * size[bodies, None, None] + own
        known = known[:, :, None] & known[:, None]
        listed = start[bodies, None] + torch.arange(first, last, device=count.device)
        inside = listed < (start + count)[bodies, None]
        listed = torch.where(inside, listed, start[bodies, None])
        vertex = part["list"][listed]
        yield _Vertices(torch.where(known, cells, 0), known.long(), known.reshape(-1).nonzero()[:, 0], cells[known],
                        part["list_position"][listed], -part["function_ptr"][:-1][bodies, None, None], vertex,
                        inside.long(), inside.reshape(-1).nonzero()[:, 0], vertex[inside])  # fmt: skip


def _dense(part: dict[str, Tensor], weights: Tensor, position: Tensor, base: Tensor, place: Tensor | None, width: int,
           plan: Tensor, sizes: CoarseSizes) -> Tensor:  # fmt: skip
    """Weights of the functions at positions [..., width]; where a function stands: place[base + function], or that."""
    begin, end = part["position_ptr"][position], part["position_ptr"][position + 1]
    entry = begin[..., None] + torch.arange(_most(plan, sizes), device=position.device)
    inside = entry < end[..., None]
    entry = torch.where(inside, entry, 0)
    at = base + part["function"][entry]
    at = torch.where(inside, at if place is None else place[torch.where(inside, at, 0)], width)
    out = weights.new_zeros((*position.shape, width + 1))
    return out.scatter_(-1, at, torch.where(inside, weights[entry], 0))[..., :width]


def _cut(count: Tensor, of_entry: int, of_list: int) -> Iterator[tuple[slice, int, int]]:
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


OPERATORS = {
    "coarse_stiffness": stiffness,
    "coarse_stiffness_backward": stiffness_backward,
    "coarse_mass": mass,
    "coarse_mass_backward": mass_backward,
}
for _name, _function in OPERATORS.items():
    torch.library.impl(f"diffvbd::{_name}", "cuda", func=_function)
