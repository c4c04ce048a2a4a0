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
