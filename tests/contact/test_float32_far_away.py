"""Claim: in float32, too, a body goes on where its gaps are no larger than what rounding makes of positions: away from
what it touches, and along it."""

import numpy as np
import pytest
import torch

import diffvbd as dv
from diffvbd.testing import tolerance

OFFSET = np.array((100.0, 50.0, -30.0))  # [m], where 32 roundings of a position are 0.7 mm
GAP = 4e-4


@pytest.mark.parametrize("v", [(0.0, 1.0, 0.0), (1.0, 0.0, 0.5)], ids=("away", "along"))
def test_a_body_goes_as_in_float64(v: tuple[float, float, float], device: str) -> None:
    """It begins in balance with its weight, some 0.4 mm above a plane."""

    def way(dtype: torch.dtype) -> torch.Tensor:
        barrier = dv.PairBarrier(kappa=1500.0, dhat=5e-3, self_contact=False)
        model = dv.Model(dv.mesh.cube(2, size=0.2).translate(OFFSET + (0.0, GAP, 0.0)), density=500.0, dtype=dtype,
                         energies=(dv.StableNeoHookean(), barrier), device=device,
                         colliders=[dv.colliders.Plane(tuple(OFFSET))])  # fmt: skip
        x = model.rest_points
        velocity = x.new_tensor(v).expand_as(x).contiguous()
        motion = dv.rollout(model, x, velocity, mu=1e5, lam=1e5, steps=20, time_step=0.005, sweeps=20, save="last")
        assert len(dv.contact.intersections(model, motion.x[-1])) == 0
        return (motion.x[-1] - x).double().cpu()

    exact, single = way(torch.float64), way(torch.float32)
    assert exact.norm(dim=-1).min() > 0.04
    assert (single - exact).abs().max() <= tolerance("contact_float32") * exact.abs().max()
