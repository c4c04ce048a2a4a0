"""Claim: sweeps on a floor come to a converged step that shares no code with them."""

from typing import Any

import numpy as np
import pytest
import torch

import diffvbd as dv
from bench.converged_floor import Body, apart, ball
from diffvbd.testing import tolerance

STEPS = 12


@pytest.mark.parametrize(("subspace", "friction"), [("rigid", 0.0), ("rigid", 0.3), ("coarse", 0.0)])
def test_a_ball_bounces_as_converged_steps_say(subspace: Any, friction: float) -> None:
    """71 vertices, which meet the floor at 2 m/s."""
    mesh = ball(0.05, 0.025)
    mesh = mesh.translate((0.0, 0.004 - mesh.points[:, 1].min(), 0.0))
    v = np.zeros_like(mesh.points) + (0.5, -2.0, 0.0)
    body = Body(mesh.points, mesh.tets, 1e5, 0.3, 2e-3, 6e4, 3e-3, friction=friction, gravity=(0.0, -9.81, 0.0))
    exact = body.rollout(mesh.points, v, STEPS)
    assert max(body.iterations) > 3 and exact[1][-1, :, 1].mean() > 0.5  # it has left the floor again
    rubbing = (dv.Friction(friction, velocity=body.eps_v),) if friction else ()
    energies = (dv.StableNeoHookean(), dv.FloorBarrier(kappa=body.kappa, dhat=body.dhat), *rubbing)
    model = dv.Model(mesh, body.density, energies=energies)
    solver = dv.VBD(body.time_step, 200, subspace=subspace)
    with torch.no_grad():
        motion = dv.rollout(model, model.rest_points, torch.from_numpy(v), solver, steps=STEPS, young=body.young,
                            poisson=body.poisson, gravity=body.gravity)  # fmt: skip
    assert apart(body, motion, exact) < tolerance("converged_floor")
