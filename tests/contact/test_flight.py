"""Claim: in flight rounding holds nobody up: a step makes one rigid correction before its sweeps and one after them.

What is left of the potential there is the square of a rounding, which may as well rise as fall.
"""

import pytest
import torch

import diffvbd as dv

BARRIER = dv.PairBarrier(kappa=400.0, dhat=0.02, self_contact=False, damping=8.0, detections=1, reach=0.1)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("spin", [0.0, 3.0])
def test_nobody_is_held_up_in_flight(device: str, dtype: torch.dtype, spin: float) -> None:
    bodies = [dv.mesh.box(3, 0.3).translate((0.7 * k - 0.4, 2.5 + 0.4 * k, 0.3 * k)) for k in range(3)]
    energies = (dv.StableNeoHookean(), dv.FloorBarrier(kappa=400.0, dhat=0.02), BARRIER)
    model = dv.Model(dv.mesh.join(bodies), density=1000.0, energies=energies, dtype=dtype, device=device)
    x = model.rest_points
    arm = x - torch.stack([x[model.body == k].mean(0) for k in range(3)])[model.body]
    v = torch.linalg.cross(arm.new_tensor([0.3, spin, 0.1]).expand_as(arm), arm) + arm.new_tensor([0.4, -0.2, 0.1])
    made = []
    for _ in range(12):
        with dv.contact.record() as found:
            x, v = dv.step(model, x, v, mu=2e4, lam=2e4, time_step=1 / 150, sweeps=2)
        made.extend(len(d.corrections) for d in found if d.corrections is not None)
        assert dv.contact.status(model).cut == [0]
    assert made == [2] * 12
