"""Claim: the gradient of dv.equilibrium is that of central differences of the program, for every input."""

from collections.abc import Sequence
from typing import Any

import pytest
import torch
from helpers.coupled import coupled, inputs_of
from helpers.marks import slow
from torch import Tensor

import diffvbd as dv

SOLVER = dv.VBD(1.0, 0, subspace="coarse")
ADJOINT = dv.GlobalAdjoint(tolerance=1e-12)


def agrees(model: dv.Model, arguments: dict[str, Tensor], steps: Sequence[float] = (1e-4, 1e-5),
           start: Tensor | None = None, **fixed: Any) -> None:  # fmt: skip
    """Compares the gradient of a loss of the rest state with differences; no gradient may be zero."""
    weights = numbers(model.num_vertices, 3, seed=3)

    def loss(**inputs: Any) -> Tensor:
        x = inputs.pop("x", model.rest_points if start is None else start)
        if "prescribed" in inputs:
            inputs["prescribed"] = torch.where(model.pinned[:, None], inputs["prescribed"], torch.nan)
        done = dv.equilibrium(model, x, SOLVER, tolerance=1e-13, adjoint=ADJOINT, **inputs, **fixed)
        return (weights * done.x).sum() + done.x.square().sum()

    check = dv.check_gradients(loss, arguments, relative_steps=steps, verbose=False)
    assert check.ok and all(size > 0 for _, size, *_ in check.rows), str(check)


def supported() -> dv.Model:
    """A beam that is pinned at one end, held by springs and lies on a floor."""
    mesh = dv.mesh.beam(5, 2, 2, size=(0.4, 0.1, 0.1))
    far = torch.as_tensor(mesh.points[:, 0] > 0.39)
    floor = dv.FloorBarrier(height=-0.015, kappa=1e3, dhat=0.02)
    return dv.Model(mesh, pinned=mesh.points[:, 0] < 1e-9,
                    energies=(dv.StableNeoHookean(), floor, dv.Anchor(30.0, vertices=far)))  # fmt: skip


def numbers(*shape: int, size: float = 1.0, seed: int = 0) -> Tensor:
    return size * torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_two_scenes_with_floor_and_springs() -> None:
    model = supported()
    vertices, tets = model.num_vertices, model.num_tets
    x = model.rest_points
    arguments = {
        "x": torch.stack([x, x + 0.001]),
        "mu": 3e4 * (1 + 0.2 * numbers(2, tets).clamp(-1, 1)),
        "lam": 5e4 * (1 + 0.2 * numbers(tets).clamp(-1, 1)),
        "force": numbers(2, vertices, 3, size=0.05),
        "gravity": torch.tensor([0.3, -9.0, 0.5], dtype=torch.float64),
        "rest_points": x + numbers(vertices, 3, size=1e-3),
        "density": 1000 * (1 + 0.1 * numbers(tets).clamp(-1, 1)),
        "floor_kappa": torch.tensor([[1e3], [2e3]], dtype=torch.float64)[:, 0],
        "floor_dhat": torch.tensor(0.02, dtype=torch.float64),
        "floor_height": torch.tensor([-0.016], dtype=torch.float64),
        "floor_normal": torch.tensor([[0.05, 1.0, -0.02]], dtype=torch.float64),
        "anchor_stiffness": 30 * (1 + 0.1 * numbers(vertices).clamp(-1, 1)),
        "anchor_points": x + numbers(2, vertices, 3, size=1e-3),
    }
    agrees(model, arguments, (1e-5,))


@pytest.mark.parametrize("pinned", [[0], [0, 1]])
def test_a_body_that_may_turn_has_no_gradient(pinned: list[int]) -> None:
    """About a point under gravity, about an axis without: the solve meets its residual, with a solution of 1e9."""
    model = dv.Model(dv.mesh.beam(4, 2, 2, size=(0.3, 0.1, 0.1)), pinned=pinned)
    force = torch.zeros_like(model.rest_points).requires_grad_()
    gravity = None if len(pinned) == 1 else (0.0, 0.0, 0.0)
    end = dv.equilibrium(model, model.rest_points, SOLVER, mu=2e4, lam=3e4, force=force, gravity=gravity)
    with pytest.raises(RuntimeError, match="slide or turn freely there is no derivative"):
        (numbers(model.num_vertices, 3) * end.x).sum().backward()


def test_young_poisson_and_prescribed() -> None:
    mesh = dv.mesh.beam(5, 2, 2, size=(0.4, 0.1, 0.1))
    model = dv.Model(mesh, pinned=mesh.points[:, 0] < 1e-9)
    arguments = {"young": torch.tensor(5e4, dtype=torch.float64), "poisson": torch.tensor(0.35, dtype=torch.float64),
                 "prescribed": model.rest_points + numbers(model.num_vertices, 3, size=0.01)}  # fmt: skip
    agrees(model, arguments, (1e-5,))


def pressed() -> tuple[dv.Model, Tensor]:
    """Two blocks, the upper one pressed onto the lower, and where its top shall go."""
    low, high = dv.mesh.cube(2, size=0.2), dv.mesh.cube(2, size=0.16).translate([0.013, 0.21, 0.009])
    mesh = dv.mesh.join([low, high])
    y = torch.as_tensor(mesh.points[:, 1])
    top = y > float(y.max()) - 1e-9
    model = dv.Model(mesh, pinned=top | (y < 1e-9), energies=(dv.StableNeoHookean(), dv.PairBarrier(1e4, dhat=0.02)))
    down = model.rest_points - model.rest_points.new_tensor([0, 0.03, 0])
    return model, torch.where(top[:, None], down, model.rest_points)


def test_pairs() -> None:
    model, where = pressed()
    agrees(model, {"prescribed": where, "pair_kappa": torch.tensor(1e4, dtype=torch.float64)}, (1e-6,), young=3e4,
           poisson=0.3)  # fmt: skip


@pytest.mark.parametrize("kind", ("plane", "obstacle"))
def test_colliders(kind: str) -> None:
    mesh = dv.mesh.cube(3, size=0.2)
    block = dv.mesh.cube(2, size=0.5).translate([-0.1, -0.51, -0.22])
    under: Any = dv.colliders.Obstacle(block.points, block.surface)
    if kind == "plane":
        under = dv.colliders.Plane(point=(0, -0.01, 0))
    energies = (dv.StableNeoHookean(), dv.PairBarrier(1e4, dhat=0.02), dv.Anchor(50.0))
    model = dv.Model(mesh, energies=energies, colliders=under)
    kappa = torch.tensor(1e4, dtype=torch.float64)
    agrees(model, {"colliders": model.collider_points, "pair_kappa": kappa}, (1e-4, 1e-5), young=2e4, poisson=0.3,
           gravity=(0.4, -9.0, -0.2))  # fmt: skip


@pytest.mark.parametrize("gas", (False, slow(True)))
def test_springs_tendons_and_pressure(gas: bool) -> None:
    model = coupled(gas=gas, places=gas)
    arguments = inputs_of(model)
    del arguments["v"], arguments["x"]
    start = dv.equilibrium(model, model.rest_points, SOLVER, **arguments).x  # near those of the differences
    assert float((start - model.rest_points).abs().max()) > 5e-3
    agrees(model, {"prescribed": model.rest_points, **arguments}, (1e-5,), start=start)
