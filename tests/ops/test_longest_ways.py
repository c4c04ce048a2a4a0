"""Longest ways of bodies and the largest angles of their turns, against plain torch."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
import torch
from torch import Tensor

from diffvbd.ops import detect as ops_contact
from diffvbd.testing import generator, tolerance

NAN, INF = float("nan"), float("inf")
SIZES = [[0, 3, 0, 1], [1] * 40, [300, 20, 0], [8] * 7, [40_000, 5], [6000], [0], []]


class Case(NamedTuple):
    way: Tensor
    beside: Tensor
    arm: Tensor
    counts: Tensor
    order: Tensor
    ptr: Tensor

    def changed(self, **values: Tensor) -> Case:
        return Case(**(self._asdict() | values))

    def ways(self, beside: bool) -> Tensor:
        given = (self.way, self.counts, self.order, self.ptr)
        return ops_contact.longest_ways(*given, self.beside) if beside else ops_contact.longest_ways(*given)

    def turns(self) -> tuple[Tensor, Tensor]:
        return ops_contact.longest_turns(self.way, self.arm, self.counts, self.order, self.ptr, self.beside)


def case(sizes: list[int], device: str, dtype: torch.dtype = torch.float64, scenes: int = 2) -> Case:
    """Bodies of these sizes whose vertices have any numbers; a third of them does not count."""
    rng, n = generator("longest", *sizes), sum(sizes)
    real = [rng.standard_normal((scenes, k, 3)) for k in (n, len(sizes), n)]
    way, beside, arm = (torch.as_tensor(a, dtype=dtype, device=device) for a in real)
    index = [rng.permutation(n).astype(np.int32), np.cumsum([0, *sizes]).astype(np.int32)]
    return Case(way, beside, arm, torch.as_tensor(rng.random(n) < 2 / 3, device=device),
                *(torch.as_tensor(a, device=device) for a in index))  # fmt: skip


def by_torch(c: Case, beside: bool) -> tuple[Tensor, Tensor]:
    """As written down, [B, bodies] both."""
    scenes, bodies = c.way.shape[0], len(c.ptr) - 1
    body = torch.empty_like(c.order, dtype=torch.int64)
    body[c.order.long()] = torch.repeat_interleave(torch.arange(bodies, device=c.ptr.device), c.ptr.diff())
    way = c.way - c.beside[:, body] if beside else c.way
    length, arm = (a.square().sum(-1).sqrt() for a in (way, c.arm))
    angle = length / arm.clamp(min=torch.finfo(arm.dtype).tiny)
    longest, largest = (
        a.new_zeros((scenes, bodies)).scatter_reduce(1, body.expand(a.shape), torch.where(c.counts, a, 0.0), "amax")
        for a in (length, angle)
    )
    return longest, largest


def assert_same(got: Tensor, expected: Tensor) -> None:
    """But for roundings: square roots of MKL and sums of squares on CUDA have their own."""
    rtol = tolerance("ulps") * torch.finfo(got.dtype).eps / torch.finfo(torch.float64).eps
    torch.testing.assert_close(got, expected, rtol=rtol, atol=0.0, equal_nan=True)


def check(c: Case) -> None:
    for beside in (False, True):
        assert_same(c.ways(beside), by_torch(c, beside)[0])
    got = c.turns()
    for one, expected, again in zip(got, by_torch(c, True), c.turns(), strict=True):
        assert_same(one, expected)
        assert one.is_contiguous() and torch.equal(one.isnan(), again.isnan())
        assert torch.equal(one.nan_to_num(), again.nan_to_num())


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("sizes", SIZES, ids=lambda sizes: f"{len(sizes)}-{sum(sizes)}")
def test_as_plain_torch_says(device: str, sizes: list[int], dtype: torch.dtype) -> None:
    for scenes in (0, 1, 3):
        c = case(sizes, device, dtype, scenes)
        for counts in (c.counts, torch.ones_like(c.counts), torch.zeros_like(c.counts)):
            check(c.changed(counts=counts))


def test_bodies_without_vertices_that_count_go_nowhere(device: str) -> None:
    c = case([0, 3, 50, 0], device)
    counts = torch.ones_like(c.counts)
    counts[c.order[:3].long()] = False  # of the second body
    c = c.changed(counts=counts)
    for found in (c.ways(False), c.ways(True), *c.turns()):
        assert (found[:, [0, 1, 3]] == 0).all() and (found[:, 2] > 0).all()


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("field", ["way", "beside", "arm"])
@pytest.mark.parametrize("value", [NAN, INF, -INF])
def test_what_is_not_finite_shows(device: str, field: str, value: float, dtype: torch.dtype) -> None:
    """Of its body alone, wherever in it, and not where it does not count."""
    for sizes in ([4, 300, 3], [4, 5000, 3]):
        c = case(sizes, device, dtype)
        rows = c.order.long()[[4, 4 + sizes[1] // 2, 3 + sizes[1]]].tolist() if field != "beside" else [1]
        for row in rows:
            values = getattr(c, field).clone()
            values[0, row, 2] = value
            for counts in (torch.ones_like(c.counts), torch.arange(len(c.counts), device=device) != row):
                changed = c.changed(**{field: values}, counts=counts)
                check(changed)
                if value != value and counts.all():
                    found = torch.stack(changed.turns()).isnan().any(0)
                    assert found[0].tolist() == [False, True, False] and not found[1].any()


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_sizes_that_squares_do_not_hold(device: str, dtype: torch.dtype) -> None:
    """And arms without a length."""
    c, tiny = case([4, 300], device, dtype), torch.finfo(dtype).tiny
    for factor in (0.0, tiny, 1 / tiny):
        check(c.changed(way=factor * c.way, beside=factor * c.beside))
        check(c.changed(arm=factor * c.arm))


def test_threads_that_share_bodies_change_nothing() -> None:
    c, threads = case([20] * 600, "cpu", scenes=4), torch.get_num_threads()
    results = []
    try:
        for n in (1, 2, 4):
            torch.set_num_threads(n)
            results.append(torch.stack([c.ways(False), *c.turns()]))
    finally:
        torch.set_num_threads(threads)
    assert c.way.shape[0] * c.way.shape[1] > 4 * 4096  # more than one thread is given
    assert all(torch.equal(found, results[0]) for found in results)


def test_opcheck_and_bad_input(device: str) -> None:
    c = case([3, 0, 5], device)
    good = (c.way, c.beside, c.arm, c.counts, c.order, c.ptr)
    none = c.way.new_empty((0,))
    operator = torch.ops.diffvbd.longest_ways.default
    for beside in (c.beside, none):
        for arm in (c.arm, none.clone()):
            torch.library.opcheck(operator, (c.way, beside, arm, *good[3:]))
    for place, value in enumerate(good):
        other = value.float() if value.is_floating_point() else value.long()
        for bad in (value[None], value[..., :-1], value.mT if value.ndim > 1 else value[:, None], other):
            with pytest.raises(ValueError, match="expected"):
                operator(*good[:place], bad, *good[place + 1 :])
    with pytest.raises(NotImplementedError, match="not differentiable"):
        c.changed(way=c.way.clone().requires_grad_()).ways(False).sum().backward()
