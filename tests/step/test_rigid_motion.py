"""Claim: with the rigid correction any number of sweeps falls freely, keeps momentum, turns as converged steps do."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

import diffvbd as dv
from diffvbd.model.system import system_of
from diffvbd.testing import relative_error
from diffvbd.testing.tolerances import tolerance


def momenta(model: dv.Model, x: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
    """Linear momentum, and angular momentum about the center of mass."""
    m = model.mass[:, None]
    center = (m * x).sum(0) / m.sum()
    return (m * v).sum(0), torch.linalg.cross(x - center, m * v).sum(0)


def spinning(model: dv.Model) -> tuple[Tensor, Tensor]:
    x = model.rest_points.clone()
    spin = torch.tensor([0.0, 0.0, 8.0], dtype=x.dtype, device=x.device)
    drift = torch.tensor([1.0, 0.0, 0.0], dtype=x.dtype, device=x.device)
    return x, torch.linalg.cross(spin.expand_as(x), x - x.mean(0)) + drift


def flown(model: dv.Model, mu: float, solver: dv.VBD) -> tuple[float, float]:
    """Relative loss of momentum, and share of the angular momentum that is left, after 60 steps of 10 ms."""
    x, v = spinning(model)
    p, spin = momenta(model, x, v)
    with torch.no_grad():
        for _ in range(60):
            x, v = dv.step(model, x, v, solver, mu=mu, lam=mu, gravity=(0.0, 0.0, 0.0))
    p1, spin1 = momenta(model, x, v)
    return float((p1 - p).norm() / p.norm()), float(spin1[2] / spin[2])


@pytest.mark.parametrize("mu", (1e5, 1e7))
def test_free_flight(device: str, mu: float) -> None:
    model = dv.Model(dv.mesh.cube(4, size=0.2, split="kuhn"), device=device)
    for sweeps in (1, 2, 5, 20):
        lost, left = flown(model, mu, dv.VBD(0.01, sweeps))
        assert lost <= tolerance("rigid_momentum")
        assert abs(left - 0.7548) <= tolerance("rigid_spin")  # implicit Euler's own loss, of converged steps
    alone, left = flown(model, mu, dv.VBD(0.01, 2, subspace=None))
    assert alone > 0.05 and left < 0.745  # what sweeps alone do


def test_spin_of_a_stiff_body_by_each_integrator() -> None:
    """Where a step does not resolve the vibrations that hold a body together, BDF2 keeps its order; SDIRK2 falls to the
    first, as it does for a rigid pendulum, and loses half of the spin that implicit Euler does."""
    model = dv.Model(dv.mesh.cube(2, size=0.2, split="kuhn"))

    def lost(mu: float, integrator: Any, steps: int) -> float:
        x, v = spinning(model)
        start = momenta(model, x, v)[1]
        end = dv.rollout(model, x, v, dv.VBD(0.3 / steps, 20, integrator=integrator), steps=steps, mu=mu, lam=mu,
                         save="last", gravity=(0.0, 0.0, 0.0))  # fmt: skip
        return 1 - float(momenta(model, end.x[-1], end.v[-1])[1][2] / start[2])

    euler, sdirk, bdf = ([lost(1e8, i, n) for n in (30, 60)] for i in (dv.ImplicitEuler(), dv.SDIRK2(), dv.BDF2()))
    assert 1.8 < sdirk[0] / sdirk[1] < 2.2 and 0.4 < sdirk[0] / euler[0] < 0.6
    assert bdf[0] / bdf[1] > 4 and abs(bdf[0]) < 0.01 * euler[0]
    # a soft body's vibrations are resolved
    assert lost(1e4, dv.SDIRK2(), 30) < 0.05 * lost(1e4, dv.ImplicitEuler(), 30)


def test_a_body_of_thousands_among_small_ones(device: str) -> None:
    """Bodies of all sizes go together: on CUDA each size has its own team of threads."""
    parts = [
        dv.mesh.cube(27, split="kuhn"),
        dv.mesh.cube(2, split="kuhn"),
        dv.mesh.cube(9, split="kuhn"),
        dv.mesh.cube(2, split="kuhn"),
    ]  # 19,683, 8, 729 and 8 vertices
    mesh = dv.mesh.join([part.translate((2.0 * i, 0.0, 0.0)) for i, part in enumerate(parts)])
    model = dv.Model(mesh, device=device)
    x = model.rest_points.clone()
    spin = torch.tensor([0.3, 0.2, 0.1], dtype=x.dtype, device=device)
    v = torch.linalg.cross(spin.expand_as(x), x)
    x1, v1 = dv.step(model, x, v, dv.VBD(0.01, 1), mu=1e5, lam=1e5)
    one, start = 0, 0.01 * v
    for part in parts:
        rows = slice(one, one + part.num_vertices)
        one = rows.stop
        m = model.mass[rows, None]
        wanted = (m * start[rows]).sum(0) / m.sum() + torch.tensor([0.0, -9.81e-4, 0.0], dtype=x.dtype, device=device)
        got = (m * (x1 - x)[rows]).sum(0) / m.sum()
        assert relative_error(got, wanted) <= tolerance("rigid_fall")
    again, _ = dv.step(model, x, v, dv.VBD(0.01, 1), mu=1e5, lam=1e5)
    assert torch.equal(again, x1)


def test_float32_falls_and_flies(device: str) -> None:
    model = dv.Model(dv.mesh.cube(4, size=0.2, split="kuhn"), dtype=torch.float32, device=device)
    lost, left = flown(model, 1e5, dv.VBD(0.01, 5))
    assert lost <= tolerance("rigid_momentum_float32") and abs(left - 0.7548) <= tolerance("rigid_spin")


def test_it_can_be_left_out(device: str) -> None:
    mesh, solver = dv.mesh.cube(3, split="kuhn"), dv.VBD(0.01, 1)
    model = dv.Model(mesh, device=device)
    assert system_of(model, solver).corrects and not system_of(model, replace(solver, subspace=None)).corrects
    assert not system_of(dv.Model(mesh, pinned=[0], device=device), solver).corrects  # there is no free body
    touching = dv.Model(mesh, energies=(dv.StableNeoHookean(), dv.PairBarrier()), device=device)
    assert not system_of(touching, solver).rigid  # pairs have a correction of their own
    with pytest.raises(TypeError, match='subspace: expected "rigid", "coarse", .* or None, got False'):
        dv.VBD(0.01, 1, subspace=False)  # pyright: ignore[reportArgumentType]
