"""Claim: bodies that touch are corrected together, however many others a scene has; more than MOST_COUPLED in parts."""

import importlib
from typing import Any

import pytest
import torch
from torch import Tensor

import diffvbd as dv
from diffvbd import mesh
from diffvbd.ops.fields import MOST_COUPLED
from diffvbd.testing import relative_error, tolerance

corrections = importlib.import_module("diffvbd.step.contact_rigid")
LOW, HALF_GAP, SPEED = -5e-4, 2.5e-4, 1e-3
ENERGIES = (dv.StableNeoHookean(), dv.FloorBarrier(LOW, kappa=1e4, dhat=1e-3),
            dv.PairBarrier(1e4, 1e-3, self_contact=False), dv.Friction(0.5, SPEED))  # fmt: skip


def stacks(heights: list[int], device: str) -> dv.Model:
    """Cubes of 0.1 m, one upon the other, on a floor; each is within reach of the next."""
    cube = mesh.cube(2, size=0.1)
    cube = cube.translate((0.0, -float(cube.points[:, 1].min()), 0.0))
    step = 0.1 + 2 * HALF_GAP
    tets = mesh.join([cube.translate((0.3 * n + 0.003 * (k % 2), step * k, 0.002 * (k % 3)))
                      for n, high in enumerate(heights) for k in range(high)])  # fmt: skip
    return dv.Model(tets, energies=ENERGIES, device=device)


def run(model: dv.Model, steps: int, sweeps: int, **options: Any) -> tuple[Tensor, Tensor]:
    x = model.rest_points
    out = dv.rollout(model, x, torch.zeros_like(x), dv.VBD(0.01, sweeps), steps=steps, mu=1e6, lam=1e6,
                     **options)  # fmt: skip
    return out.x[-1], out.v[-1]


def test_a_group_moves_and_is_differentiated_as_alone(device: str) -> None:
    """Without sweeps, whose order depends on the colors of all vertices."""
    found = []
    for heights in ([5, 3], [5, 3, *[1] * (MOST_COUPLED - 7)]):
        model = stacks(heights, device)
        force = torch.zeros_like(model.rest_points).requires_grad_()
        pushed = model.mass[:, None] * model.rest_points.new_tensor([1.0, 0.2, 0.3])
        x, v = run(model, 3, 0, force=force + pushed)
        own = 8 * 8  # vertices of those eight
        weights = torch.linspace(-1.0, 1.0, 3 * own, dtype=x.dtype, device=x.device).reshape(own, 3)
        (slope,) = torch.autograd.grad((weights * (x[:own] + v[:own])).sum(), force)
        assert float(slope.abs().max()) > 0
        found.append((x[:own].detach(), slope[:own]))
    for one, other, name in zip(*found, ("contact_forward", "contact_adjoint"), strict=True):
        assert relative_error(other, one) <= tolerance(name), name


@pytest.mark.parametrize(("high", "sweeps"), [(5, 5), (10, 10)])
def test_stacks_stand(high: int, sweeps: int, device: str) -> None:
    """As wide as a body may be off, far from falling: five at K = 5, ten at K = 10."""
    model = stacks([high] * 2 + [1] * (MOST_COUPLED - 2 * high + 1), device)
    x, v = run(model, 50, sweeps)
    assert float((x - model.rest_points).abs().max()) < 2 * high * HALF_GAP
    assert float(v.abs().max()) < 20 * SPEED


def test_a_coefficient_of_zero_is_differentiated_as_one_next_to_it(device: str) -> None:
    """One cube slides under another that lifts off, and into a third: without friction nothing joins the first two."""
    cube = mesh.cube(2, size=0.1)
    places = [(0.0, 0.0, 0.0), (0.01, 0.1003, 0.0), (0.1003, 0.0, 0.003), (2.0, 0.0, 0.0)]
    energies = (dv.StableNeoHookean(), dv.PairBarrier(1e3, 1e-3, self_contact=False), dv.Friction(0.0, 0.1))
    model = dv.Model(mesh.join([cube.translate(place) for place in places]), energies=energies, device=device)
    x = model.rest_points
    v = torch.zeros_like(x)
    v[:8, 0], v[8:16, 1], v[8:16, 2] = 0.3, 0.5, 0.1
    weights = torch.linspace(-1.0, 1.0, x.numel(), dtype=x.dtype, device=x.device).reshape(x.shape)
    slopes = []
    for value in (0.0, 1e-9):
        coefficient = x.new_tensor(value).requires_grad_()
        _, end = dv.step(model, x, v, dv.VBD(0.01, 0), mu=1e6, lam=1e6, gravity=(0.0, 0.0, 0.0),
                         friction=coefficient)  # fmt: skip
        (slope,) = torch.autograd.grad((weights * end).sum(), coefficient)
        slopes.append(slope)
    assert float(slopes[0].abs()) > 0
    assert relative_error(slopes[0], slopes[1]) <= tolerance("finite_difference")


@pytest.mark.parametrize("seed", [76, 220, 319])  # with these the stack moved otherwise when scenes decided as a whole
def test_what_happens_elsewhere_changes_nothing(seed: int, device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """How far corrections go is decided by bodies that may press each other: a stack that stands does not know of three
    cubes that are thrown far away, whose corrections are shortened."""
    shares: list[Tensor] = []

    def correct(*arguments: Any, **options: Any) -> Any:
        out = original(*arguments, **options)
        shares.append(out.taken[0, :, 0])
        return out

    original, step = corrections.corrected, importlib.import_module("diffvbd.step.contact")
    monkeypatch.setattr(step, "corrected", correct)
    barrier = dv.PairBarrier(1e4, 1e-3, self_contact=False, detections=1)  # whose number faster bodies would raise
    energies = (*ENERGIES[:2], barrier, dv.Friction(2.0, 1.0))
    model = dv.Model(stacks([4, 2, 1], device).mesh, energies=energies, device=device)
    x, own = model.rest_points.clone(), 4 * 8
    x[own:, 0] += 2.0
    x[own + 2 * 8 :, 0] -= 0.195
    arm = x[own:].reshape(3, 8, 3) - x[own:].reshape(3, 8, 3).mean(1, keepdim=True)
    shift, turn = (torch.randn(3, 1, 3, dtype=x.dtype, generator=torch.Generator().manual_seed(seed + k)).to(x.device)
                   for k in (0, 1000))  # fmt: skip
    thrown = 3 * shift + 30 * torch.linalg.cross(turn.expand(3, 8, 3), arm)
    ends, taken = [], []
    for speed in (0.0, 1.0):
        shares.clear()
        v = torch.zeros_like(x)
        v[own:] = speed * thrown.reshape(-1, 3)
        end, after = dv.step(model, x, v, dv.VBD(0.01, 3), mu=1e6, lam=1e6)
        ends.append(torch.cat([end[:own], after[:own]]))
        taken.append(torch.stack(shares))
    assert bool((taken[1][:2, 4:] < 1).any())
    assert torch.equal(taken[0][:2, :4], taken[1][:2, :4])
    assert torch.equal(*ends)
