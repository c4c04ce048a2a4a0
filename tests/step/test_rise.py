"""Which vertices are of a body whose potential a motion raises: what the starts of parts ask."""

import numpy as np
import torch

import diffvbd as dv
from diffvbd.adjoint.rise import rise_parts
from diffvbd.step.arguments import acceleration_of, prepare
from diffvbd.step.predict import begin


def test_the_vertices_of_bodies_whose_potential_rises() -> None:
    """Of two scenes of two bodies, of which each raises another; what does not move raises nothing."""
    mesh = dv.mesh.replicate(dv.mesh.cube(2), np.array([[0.0, 0, 0], [3, 0, 0]]))
    energies = (dv.StableNeoHookean(), dv.PairBarrier(kappa=100.0, dhat=0.01))
    model = dv.Model(mesh, pinned=[0], energies=energies)
    x = model.rest_points.expand(2, -1, -1).contiguous()
    given = {"mu": 1e5, "lam": 1e5, "rest_points": None, "density": None}
    prepared = prepare(model, (2,), time_step=0.01, sweeps=1, parameters=None, **given)
    begun = begin(model, x, torch.zeros_like(x), prepared, None, acceleration_of((0.0, 0.0, 0.0), x), None)
    parts = rise_parts(model, begun.fields(model, prepared), 0.01)
    to = x.clone()
    to[0, :8] *= 1.1  # away from the predictor, and stretched
    to[1, 8:] *= 1.1
    expected = torch.zeros((2, 16), dtype=torch.bool)
    expected[0, 1:8] = expected[1, 8:] = True
    assert torch.equal(parts.raises(x, to), expected)
    still = dv.Model(mesh, pinned=list(range(16)), energies=energies)
    prepared = prepare(still, (2,), time_step=0.01, sweeps=1, parameters=None, **given)
    begun = begin(still, x, torch.zeros_like(x), prepared, None, acceleration_of((0.0, 0.0, 0.0), x), None)
    assert not rise_parts(still, begun.fields(still, prepared), 0.01).raises(x, to).any()
