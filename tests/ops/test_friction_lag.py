"""Claim: friction and damping of pairs, the forces of pairs on corner points, and their adjoints are what plain torch
says, of scenes with colliders, with coefficients of each scene or of all, and with either alone."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

import diffvbd as dv
from diffvbd._contact import detection
from diffvbd.adjoint.contact import Pairs, friction_lag, of_scene, pair_lag, sum_at_corners
from diffvbd.energies import damped_fraction
from diffvbd.testing import relative_error, tolerance

SCENES, DHAT = 3, 0.02
LEAVES = ("x", "collider", "kappa", "friction", "damping")


def case(device: str, coefficients: int) -> tuple[dict[str, Tensor], Pairs, Tensor]:
    """Two cubes, one turned, whose edges and faces are close to each other and to a plane, in scenes that differ."""
    cube = dv.mesh.cube(2, size=0.2)
    turn = torch.tensor([[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    mesh = dv.mesh.join([cube, cube.translate((0.03, 0.33, 0.02))])
    plane = dv.colliders.Plane((0.0, -0.008, 0.0))
    model = dv.Model(mesh, energies=(dv.StableNeoHookean(), dv.PairBarrier(1e3, DHAT)), colliders=(plane,)).to(device)
    rows = model.body == 1
    x = model.rest_points.clone()
    middle = x[rows].mean(0)
    x[rows] = middle + (x[rows] - middle) @ turn.to(x).T
    x[rows, 1] += 0.207 - x[rows, 1].min()
    noise = torch.randn((SCENES, *x.shape), generator=torch.Generator().manual_seed(3), dtype=torch.float64).to(x)
    x = x + 1e-3 * noise
    surface, barrier = model.surface_of_contact, model.contact
    assert surface is not None and barrier is not None
    points = surface.collider_points.expand(SCENES, -1, -1).contiguous()
    pairs, constants, ptr, entry, *_ = detection.detect(x, x.new_empty((0,)), points, points, surface, barrier, 1024)
    values = {"x": x, "collider": points} | {
        name: value * torch.linspace(1.0, 2.0, coefficients).to(x)
        for name, value in (("kappa", 1e3), ("friction", 0.4), ("damping", 2.0))
    }
    return values, Pairs(pairs, constants, ptr, entry), x.new_empty((0,))


def plain(x: Tensor, collider: Tensor, kappa: Tensor, friction: Tensor, damping: Tensor, origin: Tensor,
          listed: Pairs) -> tuple[Tensor, Tensor]:  # fmt: skip
    force, _, rest = pair_lag(x, collider, kappa, origin, listed).split((1, 1, 7), -1)

    def of_pair(value: Tensor) -> Tensor:
        return of_scene(value.expand(SCENES), listed)[:, None] if len(value) else torch.zeros_like(force)

    fraction = damped_fraction(force, of_pair(kappa), listed.constants[:, :1])
    push = (force * rest[:, 3:])[..., None] * rest[:, None, :3]
    points = x.shape[1] + collider.shape[1]
    lag = torch.cat([of_pair(friction) * force, of_pair(damping) * fraction, rest], -1)
    return lag, sum_at_corners(push, listed, SCENES, points)


@pytest.mark.parametrize("parts", ((0, 1), (0,), (1,)))
@pytest.mark.parametrize("absent", ((), ("friction",), ("damping",), ("friction", "damping")))
@pytest.mark.parametrize("coefficients", (1, SCENES))
def test_rubbing_and_its_adjoint(coefficients: int, absent: tuple[str, ...], parts: tuple[int, ...], device: str
                                 ) -> None:  # fmt: skip
    values, listed, origin = case(device, coefficients)
    values |= {name: values[name][:0] for name in absent}
    found = {}
    for name, function in (("op", friction_lag), ("plain", plain)):
        leaves = {key: value.clone().requires_grad_() for key, value in values.items()}
        out = function(*leaves.values(), origin, listed)
        loss = sum((out[i] * torch.linspace(-1, 2, out[i].numel()).to(out[i]).view_as(out[i])).sum() for i in parts)
        present = [leaf for leaf in leaves.values() if leaf.numel()]
        grads = torch.autograd.grad(loss, present, allow_unused=True)
        found[name] = (*(t.detach() for t in out), *grads)
    acts = found["plain"][0][:, 1 if absent == ("friction",) else 0]
    assert set(absent) == {"friction", "damping"} or int((acts > 0).sum()) > 20
    names = ("lag", "push", *(key for key in LEAVES if key not in absent))
    for key, own, expected in zip(names, found["op"], found["plain"], strict=True):
        if expected is None:
            assert not own.any(), key
            continue
        if key == "kappa" and "friction" in absent and parts == (0,):  # of which a share of damping has nothing
            assert float(own.abs().max()) <= tolerance("contact_adjoint")
            continue
        assert expected.any() or (key in LEAVES[3:] and parts == (1,)), key
        assert relative_error(own, expected) <= tolerance("contact_adjoint"), key
