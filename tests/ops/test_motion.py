"""How bodies want to move: the rigid motion with their momentum, its derivative and the longest ways, against plain
torch."""

from __future__ import annotations

from typing import Any, NamedTuple

import pytest
import torch
from helpers.grouped import grouped
from torch import Tensor

from diffvbd.ops import contact as ops_motion
from diffvbd.ops.contact import WAYS, Ways
from diffvbd.testing import generator, tolerance

NAN, INF = float("nan"), float("inf")
SIZES = [[0, 3, 0, 1], [1] * 40, [300, 20, 0], [8] * 7, [6000, 5], [0], []]


class Case(NamedTuple):
    x: Tensor
    origin: Tensor
    mass: Tensor
    move: Tensor
    fall: Tensor
    held: Tensor
    held_bodies: Tensor
    order: Tensor
    ptr: Tensor

    def changed(self, **values: Tensor) -> Case:
        return Case(**(self._asdict() | values))

    def found(self) -> Ways:
        return ops_motion.contact_motion(*self)

    def body(self) -> Tensor:
        body = torch.empty_like(self.order, dtype=torch.int64)
        of = torch.repeat_interleave(torch.arange(len(self.ptr) - 1, device=self.ptr.device), self.ptr.diff())
        body[self.order.long()] = of
        return body

    def backward(self, bar: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Of x, mass and move."""
        given = (self.x, self.origin, self.mass, self.move, self.held, self.held_bodies, self.order, self.ptr)
        x, move, mass = ops_motion.contact_motion_backward(bar, *given)
        return x, mass, move


def case(sizes: list[int], device: str, dtype: torch.dtype = torch.float64, scenes: int = 2, held: float = 0.0,
         origin: bool = True) -> Case:  # fmt: skip
    """Bodies of these sizes whose vertices have any numbers, and a share of which is held."""
    rng, n = generator("motion", *sizes), sum(sizes)

    def reals(*shape: int) -> Tensor:
        return torch.as_tensor(rng.standard_normal(shape), dtype=dtype, device=device)

    index = grouped(sizes, rng, held, device)
    x, far, move, fall = (reals(scenes, n, 3) for _ in range(4))
    return Case(x, far if origin else x.new_empty((0,)), 0.5 + reals(1, n).abs(), move, fall, *index)


def by_torch(c: Case) -> Ways:
    """As written down."""
    scenes, bodies, body = c.x.shape[0], len(c.ptr) - 1, c.body()

    def total(values: Tensor) -> Tensor:
        return values.new_zeros((scenes, bodies, *values.shape[2:])).index_add(1, body, values)

    weight = torch.where(c.held, 0.0, c.mass).expand(c.x.shape[:2])[..., None]
    at, tiny, eps = c.x + c.origin if c.origin.numel() else c.x, torch.finfo(c.x.dtype).tiny, 1e-9
    eps = max(eps, torch.finfo(c.x.dtype).eps)
    mass = total(weight).clamp(min=tiny)
    mean, center = total(weight * c.move) / mass, total(weight * at) / mass
    arm = at - center[:, body]
    square = arm.square().sum(-1)[..., None, None] * torch.eye(3, dtype=c.x.dtype, device=c.x.device)
    inertia = total(weight[..., None] * ((1 + eps) * square - arm[..., None] * arm[..., None, :]))
    spin = total(weight * torch.linalg.cross(arm, c.move))
    keeps = (~c.held_bodies).expand(scenes, -1)
    turns = keeps & (inertia.diagonal(dim1=-2, dim2=-1).sum(-1) > tolerance("sums_of_bodies") ** 2)
    safe = torch.where(turns[..., None, None], inertia, torch.eye(3, dtype=c.x.dtype, device=c.x.device))
    turn = torch.where(turns[..., None], torch.linalg.solve(safe, spin), 0.0)[:, body]
    turned = torch.linalg.cross(turn, arm)
    rigid = torch.where(keeps[..., None], mean, 0.0)[:, body] + turned

    def longest(lengths: Tensor, counts: Tensor) -> Tensor:
        zeros = lengths.new_zeros((scenes, bodies))
        return zeros.scatter_reduce(1, body.expand(lengths.shape), torch.where(counts, lengths, 0.0), "amax")

    free, turned = ~c.held, turned.norm(dim=-1)
    angle = longest(turned / arm.norm(dim=-1).clamp(min=tiny), free)
    ways = {
        "bends": longest((c.move - mean[:, body]).norm(dim=-1), free),
        "driven": longest(c.move.norm(dim=-1), c.held),
        "apart": longest((c.move - rigid).norm(dim=-1), free),
        "stretched": longest(turned, free) * angle / (1 + (1 + angle * angle).sqrt()),
        "falls": longest(c.fall.norm(dim=-1), free) if c.fall.numel() else mean.new_zeros((scenes, bodies)),
    }
    return Ways(rigid, torch.stack([ways[name] for name in WAYS]), torch.cat([total(weight * c.move), mass], -1))


def check(c: Case) -> None:
    got, again = c.found(), c.found()
    scale = torch.finfo(c.x.dtype).eps / torch.finfo(torch.float64).eps
    for name, one, expected, same in zip(Ways._fields, got, by_torch(c), again, strict=True):
        rtol = scale * tolerance("sums_of_bodies")
        torch.testing.assert_close(one, expected, rtol=rtol, atol=rtol, msg=lambda text, name=name: f"{name}: {text}")
        assert torch.equal(one, same)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("sizes", SIZES, ids=lambda sizes: f"{len(sizes)}-{sum(sizes)}")
def test_as_plain_torch_says(device: str, sizes: list[int], dtype: torch.dtype) -> None:
    if dtype == torch.float32:
        sizes = [n if n > 3 else 4 * n for n in sizes]  # of a point the inertia is rounding
    for scenes, held, origin in ((0, 0.0, True), (1, 0.3, False), (3, 0.0, True)):
        check(case(sizes, device, dtype, scenes, held, origin))


def test_rigid_motion_keeps_momentum_and_distances(device: str) -> None:
    c = case([20, 50], device)
    rigid, body, at = c.found().rigid, c.body(), c.x + c.origin
    for of in range(2):
        rows, m = body == of, c.mass[:, body == of, None]
        off = (rigid - c.move)[:, rows]
        assert float((m * off).sum(1).abs().max()) < tolerance("sums_of_bodies")
        assert float((m * torch.linalg.cross(at[:, rows], off)).sum(1).abs().max()) < tolerance("spin_of_ways")
        apart, change = (a[:, rows][:, :, None] - a[:, rows][:, None] for a in (at, rigid))
        assert float((apart * change).sum(-1).abs().max()) < tolerance("sums_of_bodies")
        assert float(rigid[:, rows].norm(dim=-1).min()) > 0


@pytest.mark.parametrize("held", [0.0, 0.02])
def test_adjoint_is_that_of_autograd(device: str, held: float) -> None:
    c = case([5, 40, 12, 1, 0], device, scenes=3, held=held)
    bar = torch.randn(c.x.shape, dtype=c.x.dtype, generator=torch.Generator().manual_seed(0)).to(device)
    x, mass, move = (t.clone().requires_grad_() for t in (c.x, c.mass.expand(3, -1).contiguous(), c.move))
    given = c.changed(x=x, mass=mass, move=move)
    expected = torch.autograd.grad((by_torch(given).rigid * bar).sum(), (x, mass, move))
    detached = c.changed(mass=mass.detach())
    for got, want, again in zip(detached.backward(bar), expected, detached.backward(bar), strict=True):
        torch.testing.assert_close(got, want, rtol=tolerance("sums_of_bodies"), atol=tolerance("sums_of_bodies"))
        assert torch.equal(got, again) and float(want.abs().max()) > 0


def test_bodies_of_which_something_is_held_take_none_and_points_no_turn(device: str) -> None:
    c = case([5, 1, 5], device)
    held = torch.zeros_like(c.held)
    held[c.order[0].long()] = True
    c = c.changed(held=held, held_bodies=torch.tensor([True, False, False], device=device))
    found, bars, body = c.found(), c.backward(torch.ones_like(c.x)), c.body()
    point, none = body == 1, body == 0
    assert not found.rigid[:, none].any() and torch.equal(found.rigid[:, point], c.move[:, point])
    assert found.longest[WAYS.index("stretched")].bool().tolist() == [[False, False, True]] * 2
    assert not any(bar[:, none].any() for bar in bars) and torch.equal(
        bars[2][:, point], torch.ones_like(c.x)[:, point]
    )


@pytest.mark.parametrize("field", ["x", "move", "fall"])
@pytest.mark.parametrize("value", [NAN, INF])
def test_what_is_not_finite_shows(device: str, field: str, value: float) -> None:
    """Of its body alone, wherever in it."""
    c = case([4, 3000, 3], device)
    for row in c.order.long()[[4, 1500, 3003]].tolist():
        values = getattr(c, field).clone()
        values[0, row, 2] = value
        longest = c.changed(**{field: values}).found().longest
        assert longest[:, 0, [0, 2]].isfinite().all() and longest[:, 1].isfinite().all()
        assert not longest[:, 0, 1].isfinite().all()


def test_threads_that_share_bodies_change_nothing() -> None:
    c, threads = case([20] * 600, "cpu", scenes=4), torch.get_num_threads()
    results: list[tuple[Any, ...]] = []
    try:
        for n in (1, 2, 4):
            torch.set_num_threads(n)
            results.append((*c.found(), *c.backward(c.fall)))
    finally:
        torch.set_num_threads(threads)
    assert all(torch.equal(a, b) for found in results for a, b in zip(found, results[0], strict=True))


def test_opcheck_and_bad_input(device: str) -> None:
    c = case([3, 0, 5], device)
    torch.library.opcheck(torch.ops.diffvbd.contact_motion.default, tuple(c))
    of_backward = (c.fall, c.x, c.origin, c.mass, c.move, c.held, c.held_bodies, c.order, c.ptr)
    torch.library.opcheck(torch.ops.diffvbd.contact_motion_backward.default, of_backward)
    for place, value in enumerate(c):
        other = value.float() if value.is_floating_point() else value.double()
        for bad in (value[..., :-1], other):
            with pytest.raises(ValueError, match="expected"):
                ops_motion.contact_motion(*c[:place], bad, *c[place + 1 :])
