"""Claim: few sweeps turn a free body as converged ones do, and do not stretch it, with and without contact (there from
eight sweeps on)."""

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import diffvbd as dv
from diffvbd.testing.tolerances import tolerance

STEP, SPIN = 0.01, 19.0  # 0.19 rad a step
EULER = dv.ImplicitEuler()
# beside the kinetic energy at the start: the centrifugal forces' own, and what few sweeps leave
CHANGED = 5e-3  # where a scheme has just given way to another, whose velocities are others
ELASTIC = {(1e5, 1): 2e-3, (1e5, 2): 2e-3, (4.4e6, 1): 1e-3, (4.4e6, 2): 2e-4}
IN_CONTACT = 8  # sweeps with contact, where a start goes straight on and sweeps take the stretch back
ELASTIC_IN_CONTACT = {1e5: 2e-3, 4.4e6: 4e-4}


def scene(device: str, contact: bool) -> tuple[dv.Model, Tensor, Tensor]:
    """A cube that turns about a skew axis, far above what it could touch."""
    energies: tuple[Any, ...] = (dv.StableNeoHookean(),)
    colliders = []
    if contact:
        energies = (*energies, dv.PairBarrier(kappa=1e4, dhat=0.005, self_contact=False))
        colliders = [dv.colliders.Plane((0.0, -3.0, 0.0))]
    model = dv.Model(dv.mesh.cube(4, size=0.2), energies=energies, colliders=colliders, density=1000.0, device=device)
    x = model.rest_points.clone()
    axis = torch.tensor([0.36, -0.48, 0.8], dtype=x.dtype, device=x.device)
    return model, x, torch.linalg.cross((SPIN * axis).expand_as(x), x - x.mean(0))


def elastic_energy(model: dv.Model, x: Tensor, mu: float, lam: float) -> float:
    """Saint Venant-Kirchhoff's, which small strains have in common with all laws [J]."""
    points, tets = model.rest_points, model.tets
    rest, now = ((p[tets[:, 1:]] - p[tets[:, :1]]).mT for p in (points, x))
    f = now @ torch.linalg.inv(rest)
    strain = 0.5 * (f.mT @ f - torch.eye(3, dtype=x.dtype, device=x.device))
    density = mu * strain.square().sum((1, 2)) + 0.5 * lam * strain.diagonal(dim1=1, dim2=2).sum(1).square()
    return float((torch.linalg.det(rest) / 6 * density).sum())


def turned(device: str, contact: bool, young: float, sweeps: int, integrator: Any = EULER) -> tuple[float, float]:
    """After 30 steps: elastic energy over the kinetic one at the start, and the share of the spin that is left."""
    model, x, v = scene(device, contact)
    mu, lam = dv.lame(young, 0.3)
    mass = model.mass[:, None]
    spin = torch.linalg.cross(x - x.mean(0), mass * v).sum(0)
    kinetic = float((0.5 * mass * v * v).sum())
    with torch.no_grad():
        end = dv.rollout(model, x, v, dv.VBD(STEP, sweeps, integrator=integrator), steps=30, mu=mu, lam=lam,
                         save="last", gravity=(0.0, 0.0, 0.0))  # fmt: skip
    x, v = end.x[-1], end.v[-1]
    center = (mass * x).sum(0) / mass.sum()
    left = torch.linalg.cross(x - center, mass * v).sum(0)
    return elastic_energy(model, x, mu, lam) / kinetic, float(left.norm() / spin.norm())


@pytest.mark.parametrize("young", (1e5, 4.4e6))
@pytest.mark.parametrize("contact", (False, True), ids=("free", "contact"))
def test_implicit_euler(device: str, contact: bool, young: float) -> None:
    _, converged = turned(device, contact, young, 40)
    for sweeps in (IN_CONTACT,) if contact else (1, 2):
        elastic, left = turned(device, contact, young, sweeps)
        assert 0 < elastic <= (ELASTIC_IN_CONTACT[young] if contact else ELASTIC[young, sweeps])
        assert abs(left - converged) <= tolerance("turning")


def test_implicit_euler_within_a_step_of_bdf2(device: str) -> None:
    """A body that contact has just made take implicit Euler is not stretched, whatever the scheme of the step."""
    one, _, _ = scene(device, True)
    both = dv.mesh.replicate(one.mesh, np.array([[0.0, 0.0, 0.0], [5.0, 0.0, 0.0]]))
    model = dv.Model(both, energies=one.energies, colliders=one.colliders, density=1000.0, device=device)
    x, half = model.rest_points.clone(), one.num_vertices
    r = torch.cat([part - part.mean(0) for part in (x[:half], x[half:])])
    v = torch.linalg.cross((SPIN * r.new_tensor([0.36, -0.48, 0.8])).expand_as(r), r)
    mu, lam = dv.lame(4.4e6, 0.3)
    kinetic = float((0.5 * model.mass[:half, None] * v[:half].square()).sum())
    solver, history = dv.VBD(STEP, IN_CONTACT, integrator=dv.BDF2()), None
    euler = torch.arange(model.num_vertices, device=device) < half
    for k in range(11):
        end = dv.rollout(model, x, v, solver, steps=1, mu=mu, lam=lam, gravity=(0.0, 0.0, 0.0), history=history)
        assert end.history is not None
        x, v, history = end.x[-1], end.v[-1], end.history._replace(smooth=~euler)
        assert k == 0 or 0 < elastic_energy(one, x[:half], mu, lam) <= CHANGED * kinetic
    assert elastic_energy(one, x[:half], mu, lam) <= 2 * ELASTIC[4.4e6, 1] * kinetic


@pytest.mark.parametrize("contact", (False, True), ids=("free", "contact"))
def test_second_order(device: str, contact: bool) -> None:
    for integrator in (dv.BDF2(), dv.SDIRK2()):
        _, converged = turned(device, contact, 4.4e6, 40, integrator)
        elastic, left = turned(device, contact, 4.4e6, IN_CONTACT if contact else 2, integrator)
        assert 0 < elastic <= (4 * ELASTIC_IN_CONTACT[4.4e6] if contact else 5 * ELASTIC[4.4e6, 2])
        assert abs(left - converged) <= tolerance("turning")


def test_without_the_correction_few_sweeps_stretch(device: str) -> None:
    model, x, v = scene(device, False)
    mu, lam = dv.lame(4.4e6, 0.3)
    kinetic = float((0.5 * model.mass[:, None] * v * v).sum())
    for _ in range(30):
        x, v = dv.step(model, x, v, dv.VBD(STEP, 1, subspace=None), mu=mu, lam=lam, gravity=(0.0, 0.0, 0.0))
    assert elastic_energy(model, x, mu, lam) > 0.5 * kinetic
