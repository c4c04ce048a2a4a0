"""Claim: a stress-free deformation G is the rest shape of the elastic law: growth grows, fibres contract, its gradient
is exact, and what was activated can be recovered from a motion."""

from typing import Any

import pytest
import torch
from helpers.bad_input import raises
from torch import Tensor

import diffvbd as dv
from diffvbd.testing.soft_scenes import recovered_activation

MATERIAL: dict[str, Any] = {"young": 1e5, "poisson": 0.3}
NO_GRAVITY = (0.0, 0.0, 0.0)


def bar(**options: Any) -> dv.Model:
    mesh = dv.mesh.beam(5, 2, 2, size=(0.4, 0.1, 0.1))
    return dv.Model(mesh, pinned=mesh.points[:, 0] == 0, **options)


def matrix(*rows: tuple[float, float, float]) -> Tensor:
    return torch.tensor(rows, dtype=torch.float64)


def test_growth_is_another_rest_shape(device: str) -> None:
    """A uniform G moves a free body as rest points that are moved by G do, tet by tet."""
    model = dv.Model(dv.mesh.cube(3, size=0.2), device=device)
    grown = matrix((1.2, 0.1, 0.0), (0.0, 1.1, -0.05), (0.05, 0.0, 0.9)).to(device)
    x, v = model.rest_points, torch.zeros_like(model.rest_points)
    solver = dv.VBD(0.01, sweeps=6)
    by_points = dv.step(
        model, x, v, solver, rest_points=x @ grown.T, density=1000 / torch.linalg.det(grown), **MATERIAL
    )
    by_tets = dv.step(model, x, v, solver, stress_free=grown, **MATERIAL)
    assert float((by_tets[0] - x).abs().max()) > 1e-3
    assert float((by_points[0] - by_tets[0]).abs().max()) < 1e-13


def test_a_grown_body_rests_where_g_says() -> None:
    model = dv.Model(dv.mesh.cube(3, size=0.2))
    grown = matrix((1.3, 0.0, 0.0), (0.0, 0.9, 0.0), (0.0, 0.0, 1.1))
    x = model.rest_points @ grown.T
    after, v = dv.step(model, x, torch.zeros_like(x), dv.VBD(0.01, sweeps=3), stress_free=grown, gravity=NO_GRAVITY,
                       **MATERIAL)  # fmt: skip
    assert float((after - x).abs().max()) < 1e-15
    assert float(v.abs().max()) < 1e-12
    assert float(dv.stress(model, x, stress_free=grown, **MATERIAL).von_mises.max()) < 1e-8
    assert float(dv.stress(model, x, **MATERIAL).von_mises.max()) > 1e4


def test_fibres_contract_at_constant_volume() -> None:
    model = bar()
    along = matrix((1.0, 0.0, 0.0)).expand(model.mesh.num_tets, 3)
    contracted = dv.fibre_contraction(2 * along, torch.tensor(0.2, dtype=torch.float64))
    assert float((torch.linalg.det(contracted) - 1).abs().max()) < 1e-14
    assert float((contracted[:, 0, 0] - 0.8).abs().max()) < 1e-15
    x = model.rest_points
    motion = dv.rollout(model, x, torch.zeros_like(x), dv.VBD(0.05, sweeps=40, subspace="coarse"), steps=10,
                        stress_free=contracted, gravity=NO_GRAVITY, **MATERIAL)  # fmt: skip
    tip = x[:, 0] > 0.39
    length = float(motion.x[-1][tip, 0].mean()) / 0.4
    assert 0.80 < length < 0.83  # the pinned face keeps the fibres near it long


def test_activation_recovered_from_a_motion() -> None:
    """To 0.1 %, of four muscles at once, by the gradient of the frames of a motion."""
    true = torch.tensor([0.05, 0.15, 0.25, 0.1], dtype=torch.float64)
    assert float((recovered_activation(true) / true - 1).abs().max()) < 1e-3


@pytest.mark.parametrize("subspace", ("rigid", "coarse"))
def test_gradient_against_central_differences(subspace: Any) -> None:
    mesh = dv.mesh.join([dv.mesh.cube(2, size=0.1), dv.mesh.cube(2, size=0.1).translate((0.01, 0.105, 0.0))])
    model = dv.Model(mesh, energies=[dv.StableNeoHookean(), dv.PairBarrier(), dv.Friction(0.3)])
    generator = torch.Generator().manual_seed(1)
    x = model.rest_points + 1e-4 * torch.randn(model.rest_points.shape, dtype=torch.float64, generator=generator)
    v = 0.05 * torch.randn(x.shape, dtype=torch.float64, generator=generator)
    v[:, 1] -= torch.where(x[:, 1] > 0.1, 0.3, 0.0)
    g = torch.eye(3, dtype=torch.float64) + 0.05 * torch.randn(
        (mesh.num_tets, 3, 3), dtype=torch.float64, generator=generator
    )

    def loss(stress_free: Tensor, x: Tensor) -> Tensor:
        at, speed = x, v
        for _ in range(2):
            at, speed = dv.step(
                model, at, speed, dv.VBD(0.005, 4, subspace=subspace), stress_free=stress_free, **MATERIAL
            )
        weight = torch.linspace(-1, 1, at.numel(), dtype=torch.float64).reshape(at.shape)
        return ((at - model.rest_points) * weight).sum()

    found = dv.check_gradients(loss, {"stress_free": g, "x": x}, verbose=False)
    assert found.ok, str(found)
    assert all(row[1] > 0 for row in found.rows)


def test_bad_input() -> None:
    model = bar()
    x, v, solver = model.rest_points, torch.zeros_like(model.rest_points), dv.VBD(0.01, 2)
    flat = matrix((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 0.0))
    for value, got in ((flat, "got 0"), (-torch.eye(3, dtype=torch.float64), "got -1"), (torch.eye(3), "torch.float32"),
                       (x, r"shape \[20, 3\]"), (1.2, r"shape \[\]")):  # fmt: skip
        raises(lambda value=value: dv.step(model, x, v, solver, stress_free=value, **MATERIAL), "stress_free", got)
    loose = dv.Model(model.mesh, pinned=model.pinned, energies=[dv.Anchor(1.0)])
    raises(lambda: dv.step(loose, x, v, solver, stress_free=flat), "stress_free", "no elastic law")
    fibres = torch.ones((4, 3), dtype=torch.float64)
    for directions, activation, name, got in (
        (fibres[:, :2], 0.1, "directions", r"shape \[4, 2\]"),
        (0 * fibres, 0.1, "directions", "got 0"),
        (fibres, 1.0, "activation", "got 1"),
        (fibres, torch.zeros(3), "activation", r"shape \[3\]"),
        ([1.0, 0.0, 0.0], 0.1, "directions", "list"),
    ):
        raises(lambda d=directions, a=activation: dv.fibre_contraction(d, a), name, got)
