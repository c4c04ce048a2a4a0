"""Claim: what contact leaves of the acceleration of each body, and its adjoint, are what plain torch says."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from torch import Tensor

import diffvbd as dv
from diffvbd.ops.contact import residual_acceleration
from diffvbd.testing import generator, relative_error, tolerance

H, DHAT = 0.01, 0.1
FLOOR = dv.FloorBarrier([0.0, 0.3], [(0.0, 1.0, 0.0), (0.6, 0.8, 0.0)], kappa=2.0, dhat=DHAT, damping=3.0)
# Of bodies whose force is so many times their own acceleration, against it: in flight, on its way up, bearing a part,
# at rest, pressed twice and five times as hard, and held by vertices of its own.
TIMES = (0.0, -1.0, 0.5, 1.0, 2.0, 5.0, 1.0)
SIZES = (5, 1, 3, 8, 2, 700, 4)
INPUTS = ("x", "h2a", "force", "mass", "planes")


class Case(NamedTuple):
    x: Tensor
    h2a: Tensor
    force: Tensor
    mass: Tensor
    planes: Tensor
    origin: Tensor
    constants: tuple

    def lifted(self) -> Tensor:
        return residual_acceleration(*self[:-1], *self[-1])

    def on(self, device: str | torch.device, dtype: torch.dtype) -> Case:
        *tensors, (pinned, order, ptr, step) = self
        index = (*(t.to(device) for t in (pinned, order, ptr)), step)
        return Case(*(t.to(device, dtype) for t in tensors), index)


def case(scenes: int = 2, sizes: tuple[int, ...] = SIZES, times: tuple[float, ...] = TIMES, shared: bool = False,
         floor: bool = True, origin: bool = False) -> Case:  # fmt: skip
    """Bodies in any order. shared: one lift, mass and floor for all scenes."""
    rng, n, ones = generator("unsupported", sizes, times), sum(sizes), 1 if shared else scenes
    order = rng.permutation(n)
    body = np.empty(n, np.int64)
    body[order] = np.repeat(np.arange(len(sizes)), sizes)
    # over and below the planes, near them and far away
    x = rng.uniform(-0.05, 0.4, (scenes, n, 3))
    h2a = H * H * (np.array([1.0, -9.81, 0.5]) + 0.1 * rng.standard_normal((ones, n, 3)))
    mass = rng.uniform(0.5, 2.0, (ones, n))
    force = -(mass[..., None] * h2a) * np.array(times)[body][:, None] / (H * H)
    force = force * (1 + 0.05 * rng.standard_normal((scenes, n, 3)))
    force = np.concatenate([force, rng.standard_normal((scenes, 6, 3))], 1)  # and of colliders
    data = FLOOR.pack({k: v[None] for k, v in FLOOR.constants(torch.zeros(1, 3).double()).items()}, None)
    planes = data.repeat(ones, 1) if floor else data.new_empty((0,))
    at = rng.standard_normal((scenes, len(sizes), 3))[:, body]
    pinned = torch.arange(len(sizes)) == 6
    index = (pinned, *(torch.from_numpy(a.astype(np.int32)) for a in (order, np.cumsum([0, *sizes]))), H)
    start = torch.from_numpy(np.ascontiguousarray(at)) if origin else torch.empty(0)
    return Case(torch.from_numpy(x - at if origin else x), *map(torch.from_numpy, (h2a, force, mass)), planes, start,
                index)  # fmt: skip


def by_torch(c: Case) -> tuple[Tensor, Tensor]:
    """As written down, and the share of each body before it is held between 0 and 1 [B, bodies]."""
    pinned, order, ptr, h = c.constants
    scenes, vertices = c.x.shape[:2]
    body = torch.empty_like(order, dtype=torch.int64)
    body[order.long()] = torch.repeat_interleave(torch.arange(len(pinned), device=ptr.device), ptr.diff())
    total = c.force[:, :vertices]
    if c.planes.numel():
        size, normal = FLOOR.normal_force(c.x, c.planes, c.origin if c.origin.numel() else None)
        total = total + (size[..., None] * normal).sum(2)
    mass = c.mass[..., None].expand(scenes, vertices, 1)
    columns = torch.cat([mass * c.h2a, h * h * total, mass], -1)
    sums = columns.new_zeros((scenes, len(pinned), 7)).index_add(1, body, columns)
    own, borne = sums[..., :3] / sums[..., 6:], sums[..., 3:6] / sums[..., 6:]
    size = borne.detach().abs().amax(-1, keepdim=True)
    bears = size > torch.finfo(c.x.dtype).eps * own.detach().abs().amax(-1, keepdim=True)
    size = torch.where(bears, size, 1.0)
    unit = torch.where(bears, borne / size, 1.0)
    asked = -(own / size * unit).sum(-1, keepdim=True) / (unit * unit).sum(-1, keepdim=True)
    fraction = torch.where(bears & ~pinned[:, None], asked.clamp(0, 1), 0.0)
    return c.h2a + (fraction * borne)[:, body], asked[..., 0]


def gradients(c: Case, h2a: Any, bar: Tensor) -> dict[str, Tensor]:
    """Of those inputs that are not empty."""
    leaves = {k: getattr(c, k).clone().requires_grad_() for k in INPUTS if getattr(c, k).numel()}
    found = torch.autograd.grad(h2a(c._replace(**leaves)), list(leaves.values()), bar, materialize_grads=True)
    return dict(zip(leaves, found, strict=True))


def check(c: Case) -> dict[str, Tensor]:
    """Its gradients, after a look at all numbers: those of float32 are rounded once, at the end."""
    single, double = c.x.dtype == torch.float32, c.on("cpu", torch.float64)  # where sums have one order
    got, bound = c.lifted(), tolerance("float32_forward" if single else "contact_adjoint")
    assert relative_error(got.cpu(), by_torch(double)[0]) <= tolerance("float32_forward" if single else "borne")
    assert torch.equal(got, c.lifted())
    bar = torch.as_tensor(generator("bar").standard_normal(got.shape)).to(got)
    found, by_autograd = gradients(c, Case.lifted, bar), gradients(double, lambda c: by_torch(c)[0], bar.double().cpu())
    for name, value in found.items():
        assert value.dtype == c.x.dtype and relative_error(value.cpu(), by_autograd[name]) <= bound, name
    again = gradients(c, Case.lifted, bar)
    assert all(torch.equal(again[name], value) for name, value in found.items())
    return found


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("origin", [False, True])
@pytest.mark.parametrize("floor", [False, True])
@pytest.mark.parametrize("shared", [False, True])
def test_as_plain_torch_says(device: str, shared: bool, floor: bool, origin: bool, dtype: torch.dtype) -> None:
    for scenes in (1, 3):
        c = case(scenes, shared=shared, floor=floor, origin=origin).on(device, dtype)
        found = check(c)
        assert set(found) == set(INPUTS) - (set() if floor else {"planes"})
        for name, value in found.items():
            assert bool(value.any()) or (name == "x" and not floor), name
        if floor:
            assert bool(found["planes"].reshape(-1, 7)[:, :6].all()) and not bool(found["planes"][:, 6::7].any())
            continue
        _, asked = by_torch(c)
        assert bool((asked[:, 1] < 0).all() and (asked[:, 2] > 1).all() and (asked[:, 4:6] < 1).all())
        assert bool((asked[:, 4:6] > 0).all())


def test_what_is_in_flight_or_held_keeps_its_lift(device: str) -> None:
    c = case(sizes=(5, 3, 4, 4, 4, 4, 6), floor=False).on(device, torch.float64)
    c.force[:, c.constants[1][:5].long()] = 0.0
    check(c)
    rows = torch.cat([c.constants[1][:8], c.constants[1][-6:]]).long()  # held, or pushed as it goes anyway
    assert torch.equal(c.lifted()[:, rows], c.h2a[:, rows])
