"""Claim: the rigid motion with the momentum of the wanted displacements, and the longest displacements of each body,
are those of plain torch."""

from __future__ import annotations

from typing import NamedTuple

import pytest
import torch
from helpers.grouped import grouped
from torch import Tensor

from diffvbd.ops.contact import contact_find
from diffvbd.ops.fields import DISPLACEMENTS
from diffvbd.testing import generator, tolerance

SIZES = [[0, 3, 0, 1], [1] * 40, [300, 20, 0], [8] * 7, [6000, 5], [0], []]


class Displacements(NamedTuple):
    """These of Found."""

    rigid: Tensor
    longest: Tensor
    sums: Tensor


class Case(NamedTuple):
    x: Tensor
    origin: Tensor
    mass: Tensor
    move: Tensor
    gravity_move: Tensor
    pinned: Tensor
    pinned_bodies: Tensor
    order: Tensor
    ptr: Tensor

    def changed(self, **values: Tensor) -> Case:
        return Case(**(self._asdict() | values))

    def found(self) -> Displacements:
        """Of bodies without a surface."""
        n, none, empty = self.x.shape[1], self.x.new_empty((0,)), self.order[:0]
        colliders, far = self.x.new_empty((len(self.x), 0, 3)), self.mass.new_ones((len(self.ptr) - 1,))
        surface = (self.x.new_zeros((n, 3)), self.x.new_zeros((n,)), empty.reshape(0, 3), empty.reshape(0, 2), empty,
                   empty.reshape(0, 3), self.body().to(torch.int32), self.pinned[:n], empty, none)  # fmt: skip
        found = contact_find(self.x, self.origin, colliders, colliders, self.mass, self.move, self.gravity_move, none,
                             surface, (self.pinned_bodies, self.order, self.ptr, far, far), True, True, 0.1, 1.5, 0.1,
                             0)  # fmt: skip
        return Displacements(found.rigid, found.longest, found.sums)

    def body(self) -> Tensor:
        body = torch.empty_like(self.order, dtype=torch.int64)
        of = torch.repeat_interleave(torch.arange(len(self.ptr) - 1, device=self.ptr.device), self.ptr.diff())
        body[self.order.long()] = of
        return body


def case(sizes: list[int], device: str, dtype: torch.dtype = torch.float64, scenes: int = 2, pinned: float = 0.0,
         origin: bool = True) -> Case:  # fmt: skip
    """Bodies of these sizes whose vertices have any numbers, and a share of which is held."""
    rng, n = generator("motion", *sizes), sum(sizes)

    def reals(*shape: int) -> Tensor:
        return torch.as_tensor(rng.standard_normal(shape), dtype=dtype, device=device)

    index = grouped(sizes, rng, pinned, device)
    x, far, move, gravity_move = (reals(scenes, n, 3) for _ in range(4))
    return Case(x, far if origin else x.new_empty((0,)), 0.5 + reals(1, n).abs(), move, gravity_move, *index)


def by_torch(c: Case) -> Displacements:
    """As written down."""
    scenes, bodies, body = c.x.shape[0], len(c.ptr) - 1, c.body()

    def total(values: Tensor) -> Tensor:
        return values.new_zeros((scenes, bodies, *values.shape[2:])).index_add(1, body, values)

    weight = torch.where(c.pinned, 0.0, c.mass).expand(c.x.shape[:2])[..., None]
    at, tiny, eps = c.x + c.origin if c.origin.numel() else c.x, torch.finfo(c.x.dtype).tiny, 1e-9
    eps = max(eps, torch.finfo(c.x.dtype).eps)
    mass = total(weight).clamp(min=tiny)
    mean, center = total(weight * c.move) / mass, total(weight * at) / mass
    arm = at - center[:, body]
    square = arm.square().sum(-1)[..., None, None] * torch.eye(3, dtype=c.x.dtype, device=c.x.device)
    inertia = total(weight[..., None] * ((1 + eps) * square - arm[..., None] * arm[..., None, :]))
    spin = total(weight * torch.linalg.cross(arm, c.move))
    keeps = (~c.pinned_bodies).expand(scenes, -1)
    turns = keeps & (inertia.diagonal(dim1=-2, dim2=-1).sum(-1) > tolerance("sums_of_bodies") ** 2)
    safe = torch.where(turns[..., None, None], inertia, torch.eye(3, dtype=c.x.dtype, device=c.x.device))
    turn = torch.where(turns[..., None], torch.linalg.solve(safe, spin), 0.0)[:, body]
    turned = torch.linalg.cross(turn, arm)
    rigid = torch.where(keeps[..., None], mean, 0.0)[:, body] + turned

    def longest(lengths: Tensor, counts: Tensor) -> Tensor:
        zeros = lengths.new_zeros((scenes, bodies))
        return zeros.scatter_reduce(1, body.expand(lengths.shape), torch.where(counts, lengths, 0.0), "amax")

    free, turned = ~c.pinned, turned.norm(dim=-1)
    angle = longest(turned / arm.norm(dim=-1).clamp(min=tiny), free)
    displacements = {
        "bends": longest((c.move - mean[:, body]).norm(dim=-1), free),
        "driven": longest(c.move.norm(dim=-1), c.pinned),
        "apart": longest((c.move - rigid).norm(dim=-1), free),
        "stretched": longest(turned, free) * angle / (1 + (1 + angle * angle).sqrt()),
        "gravity": longest(c.gravity_move.norm(dim=-1), free)
        if c.gravity_move.numel()
        else mean.new_zeros((scenes, bodies)),
    }
    return Displacements(rigid, torch.stack([displacements[name] for name in DISPLACEMENTS]),
                         torch.cat([total(weight * c.move), mass], -1))  # fmt: skip


def check(c: Case) -> None:
    got, again = c.found(), c.found()
    scale = torch.finfo(c.x.dtype).eps / torch.finfo(torch.float64).eps
    for name, one, expected, same in zip(Displacements._fields, got, by_torch(c), again, strict=True):
        rtol = scale * tolerance("sums_of_bodies")
        torch.testing.assert_close(one, expected, rtol=rtol, atol=rtol, msg=lambda text, name=name: f"{name}: {text}")
        assert torch.equal(one, same)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("sizes", SIZES, ids=lambda sizes: f"{len(sizes)}-{sum(sizes)}")
def test_as_plain_torch_says(device: str, sizes: list[int], dtype: torch.dtype) -> None:
    if dtype == torch.float32:
        sizes = [n if n > 3 else 4 * n for n in sizes]  # of a point the inertia is rounding
    for scenes, pinned, origin in ((0, 0.0, True), (1, 0.3, False), (3, 0.0, True)):
        check(case(sizes, device, dtype, scenes, pinned, origin))
