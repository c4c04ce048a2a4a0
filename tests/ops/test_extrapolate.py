"""Claim: where bodies coast to is what the formula says, with the adjoint of it; a turn leaves the shape of a body."""

from __future__ import annotations

from typing import NamedTuple

import pytest
import torch
from helpers.grouped import grouped
from torch import Tensor

from diffvbd.ops import contact as ops_motion
from diffvbd.testing import generator, tolerance

SIZES = [[4, 300, 20], [8] * 7, [6000, 5], []]
LOOKBACKS = (1.0, 0.17, 0.01, -1 / 9)


class Case(NamedTuple):
    x: Tensor
    mass: Tensor
    move: Tensor
    pinned: Tensor
    pinned_bodies: Tensor
    order: Tensor
    ptr: Tensor

    def rows(self) -> list[Tensor]:
        ptr = self.ptr.tolist()
        return [self.order.long()[a:b] for a, b in zip(ptr[:-1], ptr[1:], strict=True)]


def case(sizes: list[int], device: str, dtype: torch.dtype = torch.float64, scenes: int = 2, displacement: float = 0.05,
         pinned: float = 0.0) -> Case:  # fmt: skip
    rng, n = generator("coast", *sizes), sum(sizes)

    def reals(*shape: int) -> Tensor:
        return torch.as_tensor(rng.standard_normal(shape), dtype=dtype, device=device)

    index = grouped(sizes, rng, pinned, device)
    return Case(reals(scenes, n, 3), 0.5 + reals(1, n).abs(), displacement * reals(scenes, n, 3), *index)


def rotation(to: Tensor, of: Tensor, mass: Tensor) -> Tensor:
    """The rotation that takes ``of`` closest to ``to`` [B, n, 3], by the singular values."""
    u, _, v = torch.linalg.svd((mass[..., None] * to[..., :, None] * of[..., None, :]).sum(-3))
    return u @ v


def by_formula(c: Case, lookback: float) -> Tensor:
    out = c.move.clone()
    for rows, is_pinned in zip(c.rows(), c.pinned_bodies.tolist(), strict=True):
        if is_pinned:
            continue
        m = c.mass.expand(c.x.shape[:2])[:, rows, None]
        center, mean = ((m * a[:, rows]).sum(1, keepdim=True) / m.sum(1, keepdim=True) for a in (c.x, c.move))
        r, d = c.x[:, rows] - center, c.move[:, rows] - mean
        before = r - lookback * d
        shape = r + (r - before @ rotation(r, before, m).mT) / lookback
        out = out.index_copy(1, rows, mean + shape @ rotation(r + d, shape, m).mT - r)
    return out


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("sizes", SIZES, ids=lambda sizes: f"{len(sizes)}-{sum(sizes)}")
def test_as_the_formula_says(device: str, sizes: list[int], dtype: torch.dtype) -> None:
    scale = torch.finfo(dtype).eps / torch.finfo(torch.float64).eps
    for scenes, pinned in ((0, 0.0), (1, 0.05), (3, 0.0)):
        c = case(sizes, device, dtype, scenes, pinned=pinned)
        for lookback in LOOKBACKS:
            got, again = (ops_motion.contact_extrapolate(*c, lookback) for _ in range(2))
            assert torch.equal(got, again)
            wide = Case(*(t.double() if t.is_floating_point() else t for t in c))
            bar = scale * tolerance("sums_of_bodies")
            torch.testing.assert_close(got.double(), by_formula(wide, lookback), rtol=bar, atol=bar)


@pytest.mark.parametrize("lookback", LOOKBACKS)
def test_adjoint_is_that_of_autograd(device: str, lookback: float) -> None:
    c = case([5, 40, 12], device, scenes=3, pinned=0.02)
    bar = torch.randn(c.x.shape, dtype=c.x.dtype, generator=torch.Generator().manual_seed(0)).to(device)
    x, mass, move = (t.clone().requires_grad_() for t in (c.x, c.mass.expand(3, -1).contiguous(), c.move))
    out = by_formula(Case(x, mass, move, *c[3:]), lookback)
    expected = torch.autograd.grad((out * bar).sum(), (x, mass, move))
    got, again = (ops_motion.contact_extrapolate_backward(bar, *c, lookback) for _ in range(2))
    for one, want, same in zip(got, expected, again, strict=True):
        torch.testing.assert_close(one, want, rtol=tolerance("sums_of_bodies"), atol=tolerance("sums_of_bodies"))
        assert torch.equal(one, same) and float(want.abs().max()) > 0


def test_without_a_turn_ways_stay_to_the_bit(device: str) -> None:
    """Of bodies that are shifted, of those that are held, and of points and lines, which have no turn."""
    c = case([20, 1, 6], device, pinned=0.0)
    shifted = torch.full_like(c.move, 0.3)
    assert torch.equal(ops_motion.contact_extrapolate(*c._replace(move=shifted), 1.0), shifted)
    pinned = c.pinned.clone()
    pinned[c.order[-1].long()] = True
    line = c.x * torch.tensor([1.0, 0.0, 0.0], dtype=c.x.dtype, device=device)
    bent = c._replace(x=line, move=c.move * torch.tensor([1.0, 0.0, 0.0], dtype=c.x.dtype, device=device))
    assert torch.equal(ops_motion.contact_extrapolate(*bent, 1.0), bent.move)
    some = c._replace(pinned=pinned, pinned_bodies=torch.tensor([False, False, True], device=device))
    out, rows = ops_motion.contact_extrapolate(*some, 1.0), some.rows()
    assert torch.equal(out[:, rows[2]], c.move[:, rows[2]]) and torch.equal(out[:, rows[1]], c.move[:, rows[1]])
    assert not torch.equal(out[:, rows[0]], c.move[:, rows[0]])
    bars = ops_motion.contact_extrapolate_backward(torch.ones_like(c.x), *some, 1.0)
    assert not bars[0][:, rows[2]].any() and torch.equal(bars[2][:, rows[2]], torch.ones_like(c.x)[:, rows[2]])
