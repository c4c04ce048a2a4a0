"""Claim: PairBarrier() without numbers fits a scene: dhat follows from the mesh, kappa from mesh and mass."""

from typing import Any

import numpy as np
import pytest
import torch

import diffvbd as dv
from diffvbd.testing import tolerance


def cube(size: float, n: int = 3) -> dv.TetMesh:
    return dv.mesh.cube(n, size=size, split="kuhn")


def model_of(mesh: dv.TetMesh, density: float = 1000.0, **barrier: Any) -> dv.Model:
    energies = (dv.StableNeoHookean(), dv.PairBarrier(**barrier))
    return dv.Model(mesh, density=density, energies=energies, colliders=[dv.colliders.Plane()])


def test_reach_follows_from_the_finest_surface_and_stiffness_from_mass() -> None:
    alone = model_of(cube(0.1)).contact
    edges = np.unique(np.sort(cube(0.1).surface[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), 1), axis=0)
    points = cube(0.1).points
    assert alone.dhat == pytest.approx(0.1 * np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1).mean())
    # a side of 26 / 6 vertices stops 1 kg at 3 m/s within four fifths of dhat
    stored = 26 / 6 * alone.kappa * (0.8 * alone.dhat) ** 2 * np.log(5)
    assert stored == pytest.approx(0.5 * 1.0 * 3.0**2)
    both = dv.mesh.join([cube(0.1), cube(1.0).translate((2.0, 0.0, 0.0))])
    assert model_of(both).contact.dhat == pytest.approx(alone.dhat)
    assert model_of(both).contact.kappa == pytest.approx(1e3 * alone.kappa)  # of 1000 kg


def test_a_body_that_is_pinned_does_not_count() -> None:
    both = dv.mesh.join([cube(0.1), cube(1.0).translate((2.0, 0.0, 0.0))])
    table = dv.Model(both, pinned=both.body == 1, energies=(dv.StableNeoHookean(), dv.PairBarrier()))
    assert table.contact.kappa == pytest.approx(model_of(cube(0.1)).contact.kappa)
    still = dv.Model(cube(0.1), pinned=range(27), energies=(dv.StableNeoHookean(), dv.PairBarrier()))
    assert still.contact.kappa == model_of(cube(0.1)).contact.kappa


def test_what_is_given_counts() -> None:
    own = model_of(cube(0.1), kappa=123.0).contact
    assert own.kappa == 123.0 and own.dhat == model_of(cube(0.1)).contact.dhat
    stiff, soft = (model_of(cube(0.1), dhat=dhat).contact for dhat in (1e-3, 2e-3))
    assert (stiff.dhat, soft.dhat) == (1e-3, 2e-3) and stiff.kappa == pytest.approx(4 * soft.kappa)
    assert model_of(cube(0.1), reach=1e-3).contact.dhat == 5e-4
    assert model_of(cube(0.1)).inputs["pair_kappa"].default == f"{model_of(cube(0.1)).contact.kappa:g}"


def test_other_arguments_of_the_model_give_other_defaults() -> None:
    model = model_of(cube(0.1))
    heavy, single = model.replace(density=7800.0), model.to(dtype=torch.float32)
    assert heavy.contact.kappa == pytest.approx(7.8 * model.contact.kappa)
    assert single.contact.kappa == model.contact.kappa
    assert model_of(cube(0.1), kappa=5.0).replace(density=7800.0).contact.kappa == 5.0


@pytest.mark.parametrize(("size", "density", "mu"), [(0.02, 1000.0, 1e5), (0.1, 7800.0, 4e6), (1.0, 1000.0, 1e6)])
def test_a_first_scene_in_si_units_falls_and_rests(size: float, density: float, mu: float) -> None:
    """From 0.3 m; gaps stay within a tenth of dhat and dhat, and the Plane bears the weight."""
    model = model_of(cube(size).translate((0.0, 0.3, 0.0)), density)
    x, lam, weight = model.rest_points, 1.5 * mu, 9.81 * density * size**3
    end = dv.rollout(model, x, torch.zeros_like(x), dv.VBD(1 / 200, 20), steps=200, mu=mu, lam=lam)
    lowest = end.x[..., 1].amin(-1)
    assert 0.1 * model.contact.dhat < lowest.min() < model.contact.dhat
    assert 0.5 * model.contact.dhat < lowest[-1] < model.contact.dhat
    # long steps end its swinging
    still = dv.rollout(model, end.x[-1], 0 * x, dv.VBD(1 / 10, 100), steps=20, mu=mu, lam=lam).x[-1]
    pushed = dv.contact.forces(model, still).vertices.normal.sum(0)
    assert abs(float(pushed[1]) / weight - 1) < tolerance("settled")


def test_a_mesh_without_tets_has_a_barrier_too() -> None:
    points = dv.TetMesh(np.eye(3), np.zeros((0, 4), int))
    model = dv.Model(points, pinned=[0, 1, 2], energies=(dv.PairBarrier(reach=0.1),))
    assert model.contact.kappa > 0 and model.contact.dhat > 0
