"""Claim: an impact gains no energy, however few the sweeps are that follow it.

Bodies that others hold up are not bent by the start of a step where that raises their potential. Nor does a body gain
energy that turns in the air: the straight ways of its vertices stretch it, and the sweeps have room to take that back.
"""

import pytest
import torch

import diffvbd as dv
from diffvbd import reference
from diffvbd.testing import tolerance

MODULUS, TIME_STEP = 1e5, 1 / 60


def heap(speed: float) -> tuple[dv.Model, torch.Tensor]:
    """Four boxes that meet in the middle."""
    box = dv.mesh.box(3, 0.06)
    places = ((0.0, 0.0, 0.0), (0.1, 0.011, 0.007), (0.05, 0.09, -0.012), (0.048, -0.085, 0.009))
    mesh = dv.mesh.join([box.translate(place) for place in places])
    model = dv.Model(mesh, energies=(dv.StableNeoHookean(), dv.PairBarrier(kappa=1e4, dhat=2e-3)))
    toward = torch.tensor([[1.0, 0, 0], [-1, 0, 0], [0, -1, 0], [0, 1, 0]], dtype=torch.float64)
    return model, speed * toward[torch.from_numpy(mesh.body.copy())]


def energy(model: dv.Model, body: dv.Model, x: torch.Tensor, v: torch.Tensor) -> float:
    """Kinetic and elastic [J]."""
    elastic = float(reference.incremental_potential(body, x, x, MODULUS, MODULUS, 1.0))
    return float((0.5 * model.mass[:, None] * v.square()).sum()) + elastic


@pytest.mark.parametrize("sweeps", (1, 5, 10))
@pytest.mark.parametrize("speed", (2.0, 8.0))
def test_an_impact_gains_no_energy(speed: float, sweeps: int) -> None:
    model, v = heap(speed)
    body, x = dv.Model(model.mesh), model.rest_points
    start = energy(model, body, x, v)
    course = []
    for _ in range(12):
        x, v = dv.step(model, x, v, mu=MODULUS, lam=MODULUS, time_step=TIME_STEP, sweeps=sweeps, gravity=(0, 0, 0))
        course.append(energy(model, body, x, v))
    assert max(course) <= start * (1 + tolerance("energy_gain")), (start, course)
    assert course[-1] < 0.9 * start  # they have met
    assert len(dv.contact.intersections(model, x)) == 0


@pytest.mark.parametrize("self_contact", (False, True))
@pytest.mark.parametrize("spin", (10.0, 20.0, 40.0))
def test_a_body_that_turns_in_the_air_gains_no_energy(spin: float, self_contact: bool) -> None:
    mesh, modulus = dv.mesh.cube(2, size=0.2), 1e6
    model = dv.Model(mesh, energies=(dv.StableNeoHookean(), dv.PairBarrier(self_contact=self_contact)))
    axis = torch.nn.functional.normalize(torch.tensor([1.0, -2.0, 0.5], dtype=torch.float64), dim=0)
    x = model.rest_points
    v = spin * torch.linalg.cross(axis.expand_as(x), x - x.mean(0))
    speed = float((model.mass[:, None] * v.square()).sum())
    for _ in range(12):
        x, v = dv.step(model, x, v, mu=modulus, lam=modulus, time_step=0.02, sweeps=20, gravity=(0, 0, 0))
        now = float((model.mass[:, None] * v.square()).sum())
        assert 0 < now <= speed * (1 + tolerance("energy_gain"))
        speed = now


def test_impacts_on_a_plane_gain_no_energy() -> None:
    """Four of 1,000 that did before bodies had room to be pressed and bent by what a plane stops."""
    mesh, generator = dv.mesh.cube(2, size=0.2), torch.Generator().manual_seed(0)
    plane = dv.colliders.Plane((0.0, -0.3, 0.0), (0.0, 1.0, 0.0))
    model = dv.Model(mesh, energies=(dv.StableNeoHookean(), dv.PairBarrier(kappa=1e4, dhat=0.01)), colliders=[plane])
    x = model.rest_points.expand(1000, -1, -1).clone()
    x[..., 1] += 0.2 * torch.rand((1000, 1), generator=generator, dtype=x.dtype)
    arm = x - x.mean(1, keepdim=True)
    spin, v = (torch.randn((1000, 1, 3), generator=generator, dtype=x.dtype) for _ in range(2))
    v = v + torch.linalg.cross((6 * spin).expand_as(arm), arm) - torch.tensor([0.0, 4.0, 0.0], dtype=x.dtype)
    x, v, body = (*(t[[446, 603, 952, 956]] for t in (x, v)), dv.Model(mesh))

    def energies() -> torch.Tensor:
        height = (9.81 * model.mass * (x[..., 1] + 0.3)).sum(-1)
        return height + torch.tensor([energy(model, body, *pair) for pair in zip(x, v, strict=True)])

    start = energies()
    for _ in range(8):
        x, v = dv.step(model, x, v, mu=MODULUS, lam=MODULUS, time_step=0.02, sweeps=15)
        assert (energies() <= start * (1 + tolerance("energy_gain"))).all()
    assert (energies() < 0.9 * start).all()  # they have met the plane


def test_a_soft_coarse_body_gains_no_energy_from_a_floor() -> None:
    model = dv.Model(
        dv.mesh.box(2, 0.1),
        energies=(dv.StableNeoHookean(), dv.PairBarrier(kappa=1e4, dhat=1e-2)),
        colliders=dv.colliders.Plane(),
    )
    turn = torch.tensor([[-0.1896, 0.1298, 0.9732], [-0.3140, -0.9472, 0.0652], [0.9303, -0.2933, 0.2203]])
    velocity, spin = torch.tensor([-0.989, -1.111, -0.933]).double(), torch.tensor([9.89, 8.30, -7.39]).double()
    arm = (model.rest_points - model.rest_points.mean(0)) @ torch.linalg.qr(turn.double().T)[0]
    x = arm + torch.tensor([0.0, 0.12, 0.0], dtype=torch.float64)
    v = velocity + torch.linalg.cross(spin.expand_as(arm), arm)
    start = float((model.mass[:, None] * v.square()).sum())
    for _ in range(12):
        x, v = dv.step(model, x, v, mu=3e3, lam=6e3, time_step=0.02, sweeps=20, gravity=(0, 0, 0))
        assert float((model.mass[:, None] * v.square()).sum()) <= start * (1 + tolerance("energy_gain"))
    assert x[:, 1].min() < 0.01  # it has met the floor
