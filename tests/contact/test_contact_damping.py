"""Claim: damping fades in, so that a motion does not jump where a pair comes to be closer than dhat."""

from typing import Any

import torch

import diffvbd as dv
from diffvbd.testing import relative_error, tolerance


def landing(gap: float, damping: float, **options: Any) -> torch.Tensor:
    """Where a block ends that approaches another for a step, from a gap [m] between them."""
    dhat = 0.02
    lower = dv.mesh.box(2, 0.1)
    upper = lower.translate((0.013, 0.1 + gap, 0.017))
    barrier = dv.PairBarrier(200.0, dhat, self_contact=False, damping=damping, detections=1)
    model = dv.Model(dv.mesh.join([lower, upper]), energies=(dv.StableNeoHookean(), barrier), density=100.0)
    x, v = model.rest_points, torch.zeros_like(model.rest_points)
    v[lower.num_vertices :, 1] = -0.5
    return dv.step(model, x, v, mu=1e4, lam=1e4, time_step=0.005, sweeps=5, gravity=(0, 0, 0),
                   **options)[0]  # fmt: skip


def test_no_jump_at_dhat() -> None:
    before, after = (landing(0.02 + away, 50.0) for away in (1e-9, -1e-9))
    assert relative_error(before, after) <= tolerance("damping_jump")
    # closer to it damping does act
    assert relative_error(landing(0.015, 50.0), landing(0.015, 0.0)) > 1e-6


def test_a_barrier_that_is_none_damps_nothing_and_has_a_gradient() -> None:
    kappa = torch.zeros((), dtype=torch.float64, requires_grad=True)
    damped, free = (landing(0.015, damping, parameters={"pair_barrier.kappa": kappa}) for damping in (50.0, 0.0))
    assert torch.equal(damped, free)
    slopes = [torch.autograd.grad(end[:, 1].square().sum(), kappa)[0] for end in (damped, free)]
    assert torch.equal(*slopes) and slopes[0] != 0
