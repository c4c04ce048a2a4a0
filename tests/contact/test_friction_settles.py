"""The friction of rigid corrections is solved for until it has settled, so that gradients are those of what ran."""

import pytest
import torch

import diffvbd as dv
from diffvbd.testing import tolerance

STEP = 1e-7  # [m/s] of the differences


def tilted(velocity: float, device: str) -> dv.Model:
    """Nine cubes, a little askew, close to each other above a floor."""
    draw = torch.Generator().manual_seed(1)
    cube, parts = dv.mesh.cube(2, size=0.1), []
    for i in range(9):
        angle = (torch.rand(3, generator=draw, dtype=torch.float64) - 0.5) * 0.1
        turn = torch.linalg.matrix_exp(torch.linalg.cross(torch.eye(3).double(), angle.expand(3, 3)))
        place = torch.tensor([0.115 * (i % 3), 0.062, 0.115 * (i // 3)], dtype=torch.float64)
        points = (torch.tensor(cube.points) - 0.05) @ turn.T + place
        parts.append(dv.TetMesh(points.numpy(), cube.tets))
    energies = (dv.StableNeoHookean(), dv.PairBarrier(kappa=2e3, self_contact=False), dv.FloorBarrier(kappa=2e3),
                dv.Friction(0.5, velocity=velocity))  # fmt: skip
    return dv.Model(dv.mesh.join(parts), energies=energies, device=device)


@pytest.mark.parametrize("sweeps", [0, 5])
@pytest.mark.parametrize("velocity", [1e-2, 1e-3])
def test_gradients_of_rubbing_bodies_are_those_of_differences(device: str, velocity: float, sweeps: int) -> None:
    model = tilted(velocity, device)
    x = model.rest_points
    draw = torch.Generator().manual_seed(1)
    own = torch.randn(9, 3, generator=draw, dtype=torch.float64) * 0.1 + torch.tensor([0.3, -0.3, 0.1]).double()
    v = own.repeat_interleave(8, 0).to(device)
    direction = torch.randn(v.shape, generator=draw, dtype=torch.float64).to(device)

    def end(share: float | torch.Tensor) -> torch.Tensor:
        given = {"mu": 1e5, "lam": 1e5, "time_step": 0.005, "sweeps": sweeps}
        return dv.step(model, x, v + share * direction, **given)[0][:, 0].mean()

    share = torch.zeros((), dtype=torch.float64, device=device, requires_grad=True)
    (found,) = torch.autograd.grad(end(share), share)
    with torch.no_grad():
        differences = (end(STEP) - end(-STEP)) / (2 * STEP)
    assert found.abs() > 0
    assert float(found) == pytest.approx(float(differences), rel=tolerance("settled_friction"))


@pytest.mark.parametrize("sweeps", [0, 4])
@pytest.mark.parametrize("velocity", [1e-2, 1e-3, 1e-5])
def test_where_a_body_comes_to_rest_within_a_small_part_of_its_way(device: str, velocity: float, sweeps: int) -> None:
    """A tet that comes down on a floor and a capsule at 3 m/s; Newton's steps must end within `velocity` h of rest."""
    corners = [[0.00728, 0.00325, -0.02147], [0.04852, 0.01187, 0.07379], [0.06225, 0.08179, -0.05321],
               [-0.06474, 0.06184, 0.00126]]  # fmt: skip
    x = torch.tensor([[0.0168426, 0.00417075, -0.00503961], [0.0579942, 0.0127741, 0.0902392],
                      [0.0718259, 0.0825594, -0.0368182], [-0.0552433, 0.0626022, 0.0177206]]).double()  # fmt: skip
    v = torch.tensor([[1.726, -2.678, 0.7771], [2.978, -1.805, 0.58], [1.472, -2.975, -0.0583],
                      [2.098, -2.804, 1.107]]).double()  # fmt: skip
    capsule = dv.colliders.Capsule((0.117977, 0.01883, -0.099285), (0.016005, 0.145289, -0.126344), 0.0542)
    pairs = dv.PairBarrier(1272.6, 0.03, damping=7.215, detections=1)
    energies = (dv.StableNeoHookean(), dv.FloorBarrier(-5e-4, kappa=1876.7, dhat=0.03, damping=5.0), pairs,
                dv.Friction(0.4, velocity=velocity))  # fmt: skip
    model = dv.Model(dv.TetMesh(corners, [[0, 1, 2, 3]]), energies=energies, colliders=[capsule], device=device)
    x, v = x.to(device), v.to(device)
    weights = torch.sin(torch.arange(12).double()).reshape(4, 3).to(device)
    direction = torch.cos(torch.arange(12).double()).reshape(4, 3).to(device)

    def loss(v: torch.Tensor) -> torch.Tensor:
        return (weights * dv.step(model, x, v, mu=2e4, lam=3.5e4, time_step=0.02, sweeps=sweeps)[0]).sum()

    own = v.clone().requires_grad_()
    (grad,) = torch.autograd.grad(loss(own), own)
    found = float((grad * direction).sum())
    with torch.no_grad():
        differences = float(loss(v + 100 * STEP * direction) - loss(v - 100 * STEP * direction)) / (200 * STEP)
    assert found != 0
    assert found == pytest.approx(differences, rel=tolerance("settled_friction"))
