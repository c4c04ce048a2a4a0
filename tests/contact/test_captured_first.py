"""What a Model keeps of its first step is right where that step was captured into a CUDA graph."""

import pytest
import torch

import diffvbd as dv

GIVEN = {"mu": 1e4, "lam": 1e4, "solver": dv.VBD(0.01, 5)}


def stack(device: str) -> tuple[dv.Model, torch.Tensor]:
    """Two cubes, the upper one 1 mm above the lower one, of which a vertex is pinned."""
    cube = dv.mesh.cube(3, size=0.1)
    mesh = dv.mesh.join([cube, cube.translate([0.01, 0.101, 0.02])])
    barrier = dv.PairBarrier(kappa=100.0, dhat=2e-3, damping=1.0, detections=1)
    energies = (dv.StableNeoHookean(), dv.FloorBarrier(height=-2e-3, kappa=100.0, dhat=2e-3), barrier)
    model = dv.Model(mesh, pinned=[0], energies=energies, device=device)
    return model, model.rest_points


@pytest.mark.cuda
def test_a_step_after_a_capture_that_was_the_first() -> None:
    model, x = stack("cuda")
    v = torch.zeros_like(x)
    expected = [t.clone() for t in dv.step(*stack("cuda"), v, **GIVEN)]
    assert not torch.equal(expected[0], x)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        captured = dv.step(model, x, v, **GIVEN)
    for found in (dv.step(model, x, v, **GIVEN), (graph.replay(), captured)[1], dv.step(model, x, v, **GIVEN)):
        for a, b in zip(found, expected, strict=True):
            assert torch.equal(a, b)
