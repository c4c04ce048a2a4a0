"""Claim: on a floor sweeps come to the converged step of `bench floors`, which shares no code with them; so do coarse
corrections."""

from typing import Any

import numpy as np
import pytest

from bench import floors, floors_scenes
from bench.floors_newton import Body
from diffvbd.testing import tolerance


def a_ball(friction: float) -> floors_scenes.Scene:
    """71 vertices, which meet the floor at 2 m/s."""
    mesh = floors_scenes.ball(0.05, 0.025)
    mesh = mesh.translate((0.0, 0.004 - mesh.points[:, 1].min(), 0.0))
    body = Body(mesh.points, mesh.tets, 1e5, 0.3, 2e-3, 6e4, 3e-3, friction=friction, gravity=(0.0, -9.81, 0.0))
    return floors_scenes.Scene("ball", mesh, body, np.zeros_like(mesh.points) + (0.5, -2.0, 0.0), 12)


@pytest.mark.parametrize(("coarse", "friction"), [(None, 0.0), (None, 0.3), ("auto", 0.0)])
def test_sweeps_come_to_the_converged_step(coarse: Any, friction: float) -> None:
    scene = a_ball(friction)
    exact = scene.body.rollout(scene.mesh.points, scene.v, scene.steps)
    assert max(scene.body.iterations) > 3 and exact[1][-1, :, 1].mean() > 0.5  # it has left the floor again
    motion, _, _ = scene.executed(200, coarse)
    assert max(floors.apart(scene, motion, exact).values()) < tolerance("converged_floor")
