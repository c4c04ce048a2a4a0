"""Claim: where a floor stops a body, gradients are those of the start that ran, and it slides on unhindered."""

from typing import Any

import pytest
import torch

import diffvbd as dv
from diffvbd.testing import tolerance

BESIDE = {
    "friction": (dv.Friction(0.4),),
    "pairs": (dv.PairBarrier(kappa=1e4, self_contact=False),),
    "own pairs": (dv.PairBarrier(kappa=1e4), dv.Friction(0.4)),
}
FLOORS = {
    "one plane": {"height": 0.0, "normal": (0.1, 1.0, 0.0)},
    "a wedge": {"height": [0.0, 0.0], "normal": [(0.5, 1.0, 0.1), (-0.5, 1.0, 0.0)]},
    "a corner": {"height": [0.0, -0.004], "normal": [(0.0, 1.0, 0.0), (1.0, 0.0, 0.0)]},
}


@pytest.mark.parametrize("floor", FLOORS)
@pytest.mark.parametrize("beside", BESIDE)
def test_gradients_of_a_landing(beside: str, floor: str) -> None:
    generator = torch.Generator().manual_seed(0)

    def random(size: float) -> torch.Tensor:
        return size * torch.randn((27, 3), generator=generator, dtype=torch.float64)

    mesh = dv.mesh.cube(3, size=0.2).translate((0.0 if floor == "a corner" else -0.1, 0.03, 0.0))
    barrier: Any = dv.FloorBarrier(kappa=1e4, dhat=0.02, **FLOORS[floor])
    model = dv.Model(mesh, energies=(dv.StableNeoHookean(), barrier, *BESIDE[beside]))
    x, v = model.rest_points + random(1e-3), random(0.1)
    if floor == "a wedge":
        x = x + torch.tensor([0.0, 0.04, 0.0], dtype=x.dtype)
    v = v - torch.tensor([0.5, 3.0, 0.2], dtype=v.dtype)
    weights, height = random(1.0), torch.tensor(model.floor.height, dtype=x.dtype) if model.floor else x

    def loss(x: torch.Tensor, v: torch.Tensor, height: torch.Tensor) -> torch.Tensor:
        given: dict[str, Any] = {"mu": 1e5, "lam": 2e5, "solver": dv.VBD(0.01, 3)}
        for _ in range(2):
            x, v = dv.step(model, x, v, floor_height=height, **given)
        return (weights * x).sum() + 1e-2 * (weights * v).sum()

    leaves = [t.clone().requires_grad_() for t in (x, v, height)]
    grads = torch.autograd.grad(loss(*leaves), leaves)
    for number, grad in enumerate(grads):
        way = torch.randn(grad.shape, generator=generator, dtype=grad.dtype)
        ends = []
        for sign in (1, -1):
            moved = [x, v, height]
            moved[number] = moved[number] + sign * 1e-7 * way
            ends.append(float(loss(*moved)))
        slope = float((grad * way).sum())
        difference = (ends[0] - ends[1]) / 2e-7
        assert slope == pytest.approx(difference, rel=tolerance("contact_finite_difference")) and slope != 0
