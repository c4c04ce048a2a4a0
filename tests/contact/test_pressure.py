"""Claim: the pressure map of a patch sums up to the force that presses on it, its shear to the friction, and both are
differentiable."""

from typing import Any

import pytest
import torch
from torch import Tensor

import diffvbd as dv
from diffvbd.testing import relative_error

F64 = torch.float64
GIVEN: dict[str, Any] = {"mu": 3e4, "lam": 5e4}


def resting(speed: float = 0.0) -> tuple[dv.Model, Tensor, Tensor, Any, dv.VBD]:
    """A block on a plane, at rest or sliding; its state before a step, after it, and the triangles of its sole."""
    block = dv.mesh.box(4, 0.1, split="kuhn").translate((0.0, 0.002, 0.0))
    model = dv.Model(block, 500.0, energies=(dv.StableNeoHookean(), dv.PairBarrier(), dv.Friction(0.5, 0.02)),
                     colliders=(dv.colliders.Plane((0, 0, 0), (0, 1, 0)),))  # fmt: skip
    solver, x = dv.VBD(0.01, 30), model.rest_points
    done = dv.rollout(model, x, torch.zeros_like(x), solver, steps=40, **GIVEN)
    if speed > 0:
        away = torch.tensor([speed, 0.0, 0.0], dtype=F64)
        done = dv.rollout(model, done.x[-1], done.v[-1] + away, solver, steps=5, **GIVEN)
    sole = block.surface[(block.points[block.surface][:, :, 1] < 0.003).all(1)]
    return model, done.x[-2], done.x[-1], (sole, done.v[-2]), solver


def test_it_sums_up_to_the_weight() -> None:
    model, _, x, (sole, _), _ = resting()
    found = dv.contact.pressure(dv.contact.forces(model, x), x, sole)
    assert found.vertices.shape == (16,) and bool((found.pressure > 0).all())
    assert float(found.total()) == pytest.approx(500.0 * 1e-3 * 9.81, rel=0.01)
    assert float(found.area.sum()) == pytest.approx(0.01, rel=0.01)
    mean = float((found.pressure * found.area).sum() / found.area.sum())
    assert mean == pytest.approx(490.5, rel=0.01) and float(found.shear.abs().max()) < 0.2 * mean


def test_its_shear_sums_up_to_the_friction() -> None:
    model, before, x, (sole, v), solver = resting(1.0)
    forces = dv.contact.forces(model, x, solver, previous=(before, v))
    found = dv.contact.pressure(forces, x, sole)
    shear = (found.shear * found.area[:, None]).sum(0)
    total = forces.bodies.total[0]
    assert float(shear[0]) < 0 and relative_error(shear[0], total[0]) < 0.02
    assert relative_error(found.total(), total[1]) < 0.01


def test_gradients_batches_and_devices(device: str) -> None:
    model, _, x, (sole, _), _ = resting()
    model, x = model.to(device), x.to(device)
    way = torch.cos(torch.arange(x.numel(), dtype=F64)).view_as(x).to(device)

    def felt(x: Tensor) -> Tensor:
        found = dv.contact.pressure(dv.contact.forces(model, x), x, sole)
        return (found.pressure * torch.arange(16, device=x.device)).sum(-1) + found.shear[..., 0].square().sum(-1)

    leaf = x.clone().requires_grad_()
    (grad,) = torch.autograd.grad(felt(leaf), leaf)
    slope = (felt(x + 1e-8 * way) - felt(x - 1e-8 * way)) / 2e-8
    assert slope.abs() > 0 and relative_error((grad * way).sum(), slope) < 1e-5
    both = felt(torch.stack([x, x + 1e-5 * way]))
    assert relative_error(both, torch.stack([felt(x), felt(x + 1e-5 * way)])) < 1e-12


def test_bad_input() -> None:
    model, _, x, (sole, _), _ = resting()
    forces = dv.contact.forces(model, x)
    with pytest.raises(TypeError, match="forces: expected"):
        dv.contact.pressure(forces.vertices, x, sole)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"x: expected shape \[64, 3\] of the forces, got \[63, 3\]"):
        dv.contact.pressure(forces, x[1:], sole)
    with pytest.raises(ValueError, match="triangles: expected at least one, of vertices 0 to 63"):
        dv.contact.pressure(forces, x, [[0, 1, 64]])
    with pytest.raises(ValueError, match="triangles: expected triangles with an area"):
        dv.contact.pressure(forces, x, [[0, 1, 1]])
