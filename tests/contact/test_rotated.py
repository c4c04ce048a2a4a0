"""Claim: a body slides along a plane as it does along any other one, however few sweeps there are: what rounding makes
of a way along the plane does not hold it up."""

import numpy as np
import pytest
import torch

import diffvbd as dv
from diffvbd.testing import generator, tolerance


@pytest.mark.parametrize(("dtype", "bar"), [(torch.float64, "property_subset"), (torch.float32, "float32_forward")])
@pytest.mark.parametrize("sweeps", [1, 2])
@pytest.mark.parametrize("kappa", [50.0, 3000.0])  # the cube begins nearer to the plane than a start may bring it
def test_a_turned_scene_moves_as_it_did(kappa: float, sweeps: int, dtype: torch.dtype, bar: str, device: str) -> None:
    cube = dv.mesh.cube(2, size=0.2, split="kuhn").translate((0.0, 4e-4, 0.0))

    def way(turn: np.ndarray) -> torch.Tensor:
        """Where it gets, turned back."""
        plane = dv.colliders.Plane((0, 0, 0), tuple(turn @ [0.0, 1.0, 0.0]))
        barrier = dv.PairBarrier(kappa=kappa, dhat=0.01, self_contact=False)
        model = dv.Model(dv.TetMesh(cube.points @ turn.T, cube.tets), density=500.0, device=device, dtype=dtype,
                         energies=(dv.StableNeoHookean(), barrier), colliders=[plane])  # fmt: skip
        x = model.rest_points
        motion = dv.rollout(model, x, torch.zeros_like(x), mu=1e5, lam=1e5, steps=20, time_step=0.005, sweeps=sweeps,
                            gravity=tuple(turn @ [3.0, -9.81, 0.0]), save="last", check_contact=False,
                            check_energy=False)  # fmt: skip
        return (motion.x[-1] - x).cpu().double() @ torch.from_numpy(turn)

    still, rng = way(np.eye(3)), generator("turned")
    assert still[:, 0].min() > 0.01
    for _ in range(3):
        turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        turn *= np.sign(np.linalg.det(turn))
        assert (way(turn) - still).abs().max() <= tolerance(bar)
