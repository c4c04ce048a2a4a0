"""Claim: viscosity damps changes of shape and no rigid motion, at the rate of theory; drag damps all motion; both are
implicit, in every scheme, and their gradients are exact."""

import math
from typing import Any

import pytest
import torch
from helpers.bad_input import INF, NAN, raises
from torch import Tensor

import diffvbd as dv
from diffvbd.adjoint.potential import IncrementalPotential
from diffvbd.model.system import system_of
from diffvbd.ops import SweepFields
from diffvbd.step.arguments import given_of, prepare
from diffvbd.step.damping import damped
from diffvbd.testing.soft_scenes import MODULI, STILL, Mode


def randn(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def forces(model: dv.Model, start: Tensor, x: Tensor, **inputs: Any) -> Tensor:
    """Elastic and viscous forces at x of a step of 10 ms from start [N], [V, 3]."""
    system, flat = system_of(model, dv.VBD(0.01, 1)), x[None]
    prepared = prepare(system, (), given_of(system, inputs), time_step=0.01, sweeps=1)
    of = damped(system, prepared, start)
    fields = SweepFields(flat, flat, flat, of.mu, of.lam, of.mass, of.rest, model._energy_data, None)
    return IncrementalPotential(system, flat, fields, 0.01).elastic()[0] / 1e-4


def test_viscosity_damps_no_rigid_motion() -> None:
    model = dv.Model(dv.mesh.cube(3, size=0.2))
    start = model.rest_points + 0.01 * randn(model.mesh.num_vertices, 3)
    c, s = math.cos(0.7), math.sin(0.7)
    turn = torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]], dtype=torch.float64)
    moved = start @ turn.T + torch.tensor([0.3, 0.1, -0.2], dtype=torch.float64)
    viscous = {"mu": 0.0, "lam": 0.0, "viscosity": 100.0, "volume_viscosity": 50.0}
    sheared = forces(model, start, start + 1e-3 * randn(*start.shape, seed=1), **viscous)
    assert float(forces(model, start, moved, **viscous).abs().max()) < 1e-12 * float(sheared.abs().max())
    alone = forces(model, start, moved, **MODULI)
    with_elasticity = forces(model, start, moved, viscosity=100.0, volume_viscosity=50.0, **MODULI)
    assert float((with_elasticity - alone).abs().max()) < 1e-12 * float(alone.abs().max())


def test_viscous_force_of_a_small_strain() -> None:
    """2 viscosity d + volume_viscosity tr(d) I on a cube that is stretched evenly."""
    model = dv.Model(dv.mesh.cube(2, size=0.2))
    start, rate, h = model.rest_points, 1e-4, 0.01
    x = start * torch.tensor([1 + rate * h, 1.0, 1.0], dtype=torch.float64)
    on = forces(model, start, x, mu=0.0, lam=0.0, viscosity=300.0, volume_viscosity=200.0)
    face = start[:, 0] > 0.19
    assert float(on[face, 0].sum()) == pytest.approx(0.04 * (2 * 300 + 200) * rate, rel=1e-5)
    face = start[:, 1] > 0.19
    assert float(on[face, 1].sum()) == pytest.approx(0.04 * 200 * rate, rel=1e-5)


@pytest.fixture(scope="module")
def mode() -> Mode:
    return Mode()


@pytest.mark.parametrize("integrator", (dv.SDIRK2(), dv.BDF2()), ids=str)
@pytest.mark.parametrize("kind", ("viscosity", "drag"))
def test_ring_down_at_the_rate_of_theory(mode: Mode, kind: str, integrator: Any) -> None:
    w, ratio, per_period = mode.frequency, 0.05, 60 if isinstance(integrator, dv.SDIRK2) else 120
    steps = 2 * per_period
    damping = mode.viscosities(ratio) if kind == "viscosity" else {"drag": 2 * ratio * w}
    solver = mode.solver(per_period, 30, integrator)
    found, exact = mode.amplitudes(solver, steps, **damping), mode.ring(solver, steps, ratio)
    assert float((found - exact).abs().max()) < 0.01 * float(exact.abs().max())
    undamped = mode.amplitudes(solver, steps)
    assert float((undamped - exact).abs().max()) > 0.3 * float(exact.abs().max())


def test_damping_ratio_recovered_from_a_noisy_motion(mode: Mode) -> None:
    """To 1 % with 1 % of noise, by the gradient of the rollout."""
    assert mode.recovered(0.04) == pytest.approx(0.04, rel=0.01)


@pytest.mark.parametrize("steps", (1, 20))
def test_drag_slows_free_fall_as_implicit_euler_does(steps: int) -> None:
    """At steps longer than 1 / drag as well, where an explicit force would explode."""
    model = dv.Model(dv.mesh.cube(3, size=0.2))
    x, v = model.rest_points, torch.zeros_like(model.rest_points)
    h, drag = 0.1, 25.0
    motion = dv.rollout(model, x, v, dv.VBD(h, sweeps=2), steps=steps, drag=drag, **MODULI)
    speed = 0.0
    for _ in range(steps):
        speed = (speed - 9.81 * h) / (1 + h * drag)
    assert float((motion.v[-1][:, 1] - speed).abs().max()) < 1e-11 * abs(speed)
    assert steps == 1 or speed == pytest.approx(-9.81 / drag, rel=1e-6)


def test_stable_where_an_explicit_force_is_not() -> None:
    model = dv.Model(dv.mesh.cube(3, size=0.1))
    x, v = model.rest_points, 0.5 * randn(model.mesh.num_vertices, 3)
    motion = dv.rollout(model, x, v, dv.VBD(0.02, sweeps=10), steps=30, viscosity=1e5, volume_viscosity=1e5, drag=100.0,
                        gravity=STILL, **MODULI)  # fmt: skip
    assert float(motion.v[-1].abs().max()) < 1e-3
    assert float(motion.v[1:].norm(dim=(-2, -1)).diff().max()) < 1e-3


def test_spin_is_kept_and_momentum_is_not_made() -> None:
    model = dv.Model(dv.mesh.beam(4, 3, 2, size=(0.3, 0.2, 0.1)))
    x = model.rest_points
    spin = torch.tensor([0.0, 0.0, 3.0], dtype=torch.float64)
    v = torch.linalg.cross(spin.expand_as(x), x - x.mean(0)) + torch.tensor([0.5, 0.2, 0.0], dtype=torch.float64)

    def momenta(motion: Any) -> tuple[Tensor, Tensor]:
        weight, at = model.mass[:, None], motion.x[-1] - motion.x[-1].mean(0)
        return (weight * motion.v[-1]).sum(0), torch.linalg.cross(at, weight * motion.v[-1]).sum(0)

    ends = [momenta(dv.rollout(model, x, v, dv.VBD(0.005, 20), steps=40, gravity=STILL, **MODULI, **damping))
            for damping in ({}, {"viscosity": 3e3, "volume_viscosity": 3e3})]  # fmt: skip
    assert float((ends[0][0] - ends[1][0]).abs().max()) < 1e-12
    assert float((ends[0][1] - ends[1][1]).norm() / ends[0][1].norm()) < 2e-3


@pytest.mark.parametrize("integrator", (dv.SDIRK2(), dv.BDF2()), ids=str)
def test_strong_viscosity_neither_swells_nor_drives_a_turning_body(integrator: Any) -> None:
    """Where strain rates were measured from extrapolated positions, the body grew by 1 % and gained 60 % of energy."""
    model = dv.Model(dv.mesh.beam(4, 3, 2, size=(0.3, 0.2, 0.1)))
    x = model.rest_points
    spin = torch.tensor([0.0, 0.0, 5.5], dtype=torch.float64)
    v = torch.linalg.cross(spin.expand_as(x), x - x.mean(0))
    solver = dv.VBD(0.01, 30, subspace="coarse", integrator=integrator)
    motion = dv.rollout(model, x, v, solver, steps=50, viscosity=1e5, volume_viscosity=1e5, gravity=STILL, **MODULI)
    energy = (model.mass[:, None] * motion.v.square()).sum((-2, -1))
    size = (motion.x - motion.x.mean(1, keepdim=True)).norm(dim=(-2, -1))
    assert float(energy.max() / energy[0]) < 1.002 and float(energy[-1] / energy[0]) > 0.85
    assert float((size / size[0] - 1).abs().max()) < 5e-4


@pytest.mark.parametrize("integrator", (dv.ImplicitEuler(), dv.SDIRK2(), dv.BDF2()), ids=str)
@pytest.mark.parametrize("subspace", ("rigid", "coarse"))
def test_gradient_against_central_differences(device: str, integrator: Any, subspace: Any) -> None:
    """A body that falls on another one with friction, and one that hangs, in one scene."""
    upper = dv.mesh.cube(2, size=0.1).translate((0.01, 0.105, 0.0))
    far = dv.mesh.cube(2, size=0.1).translate((1.0, 0.0, 0.0))
    mesh = dv.mesh.join([dv.mesh.cube(2, size=0.1), upper, far])
    energies = [dv.StableNeoHookean(), dv.PairBarrier(), dv.Friction(0.3)]
    model = dv.Model(mesh, pinned=mesh.points[:, 0] > 1.099, energies=energies, device=device)
    x = model.rest_points + 1e-4 * randn(mesh.num_vertices, 3).to(device)
    v = 0.05 * randn(mesh.num_vertices, 3, seed=1).to(device)  # a body at rest lies at a kink of friction
    v[:, 1] -= torch.where(x[:, 1] > 0.1, 0.5, 0.0)
    weight = randn(mesh.num_vertices, 3, seed=2).to(device)

    solver = dv.VBD(0.004, 4, subspace=subspace, integrator=integrator)

    def loss(x: Tensor, v: Tensor, viscosity: Tensor, volume_viscosity: Tensor, drag: Tensor) -> Tensor:
        motion = dv.rollout(model, x, v, solver, steps=2, save="last", young=1e5, poisson=0.3, viscosity=viscosity,
                            volume_viscosity=volume_viscosity, drag=drag)  # fmt: skip
        return (weight * (motion.x[-1] - model.rest_points + 0.01 * motion.v[-1])).sum()

    def between(low: float, high: float, count: int) -> Tensor:
        return torch.linspace(low, high, count, dtype=torch.float64, device=device)

    viscosities = {"viscosity": between(10, 200, mesh.num_tets), "volume_viscosity": between(200, 20, mesh.num_tets)}
    arguments = {"x": x, "v": v, **viscosities, "drag": between(1, 30, mesh.num_vertices)}
    found = dv.check_gradients(loss, arguments, tolerance=1e-5, verbose=False)  # that of contact
    assert found.ok, str(found)
    assert all(row[1] > 0 for row in found.rows)


def test_global_adjoint_of_a_converged_step() -> None:
    model = dv.Model(dv.mesh.beam(4, 2, 2, size=(0.3, 0.1, 0.1)), pinned=[0, 1, 2, 3])
    x = model.rest_points + 1e-3 * randn(model.mesh.num_vertices, 3)
    v, weight = 0.1 * randn(*x.shape, seed=1), randn(*x.shape, seed=2)

    def loss(x: Tensor, viscosity: Tensor, drag: Tensor) -> Tensor:
        end = dv.solve(model, x, v, dv.VBD(0.01, 1), tolerance=1e-13, viscosity=viscosity, drag=drag, young=1e5,
                       poisson=0.3)  # fmt: skip
        return (weight * end.x).sum()

    numbers = {"viscosity": torch.tensor(100.0, dtype=torch.float64), "drag": torch.tensor(3.0, dtype=torch.float64)}
    found = dv.check_gradients(loss, {"x": x, **numbers}, verbose=False)
    assert found.ok, str(found)


def test_reactions_hold_what_damping_asks_for() -> None:
    """The forces on all vertices add up to what accelerates the body."""
    model = dv.Model(dv.mesh.beam(4, 2, 2, size=(0.3, 0.1, 0.1)), pinned=[0, 1, 2, 3])
    x, v = model.rest_points, 0.3 * randn(model.mesh.num_vertices, 3)
    v[model.pinned] = 0
    solver, inputs = dv.VBD(0.01, 300), {"viscosity": 500.0, "drag": 4.0, "young": 1e5, "poisson": 0.3}
    x1, v1 = dv.step(model, x, v, solver, **inputs)
    held = dv.reactions(model, x1, solver=solver, previous=(x, v), **inputs).sum(0)
    mass = model.mass[:, None]
    wanted = (mass * ((v1 - v) / 0.01 + 4.0 * v1)).sum(0) - model.mass.sum() * torch.tensor([0, -9.81, 0])
    assert float((held - wanted).norm() / wanted.norm()) < 1e-6
    raises(lambda: dv.reactions(model, x1, **inputs), "previous", "None")


def test_gradient_of_a_viscosity_of_zero_without_shear_modulus() -> None:
    model = dv.Model(dv.mesh.cube(2, size=0.1), pinned=[0])
    x = model.rest_points + 0.005 * randn(8, 3)

    def loss(viscosity: Tensor) -> Tensor:
        end = dv.step(model, x, torch.zeros_like(x), dv.VBD(0.01, 10), mu=0.0, lam=1e4, viscosity=viscosity)[0]
        return (end * randn(8, 3, seed=1)).sum()

    at = [torch.tensor(value, dtype=torch.float64, requires_grad=True) for value in (0.0, 1e-4)]
    (slope,) = torch.autograd.grad(loss(at[0]), at[0])
    assert float(slope) == pytest.approx(float((loss(at[1]) - loss(at[0])).detach()) / 1e-4, rel=1e-3)


def test_stress_is_the_elastic_one_and_says_so() -> None:
    model = dv.Model(dv.mesh.cube(2, size=0.2))
    x = model.rest_points * 1.1
    with pytest.warns(UserWarning, match="viscosity: the stress is the elastic one alone"):
        damped = dv.stress(model, x, viscosity=1.0, **MODULI)
    assert torch.equal(damped.cauchy, dv.stress(model, x, **MODULI).cauchy)


def test_float32() -> None:
    model = dv.Model(dv.mesh.cube(3, size=0.2), dtype=torch.float32)
    twin = dv.Model(dv.mesh.cube(3, size=0.2))
    x, v = model.rest_points + 5, randn(model.mesh.num_vertices, 3).float()
    inputs = {"viscosity": 300.0, "drag": 5.0, "young": 1e5, "poisson": 0.3}
    x1, v1 = dv.step(model, x, v, dv.VBD(0.01, 5), **inputs)
    x2, v2 = dv.step(twin, x.double(), v.double(), dv.VBD(0.01, 5), **inputs)
    assert float((x1.double() - x2).abs().max()) < 2e-6
    assert float((v1.double() - v2).norm() / v2.norm()) < 2e-4


def test_bad_input() -> None:
    model = dv.Model(dv.mesh.cube(split="kuhn"))
    x, v = model.rest_points, torch.zeros_like(model.rest_points)

    def step(**inputs: Any) -> None:
        dv.step(model, x, v, **{"solver": dv.VBD(0.01, 2), **MODULI, **inputs})

    for name in ("viscosity", "volume_viscosity", "drag"):
        for value in (-1.0, NAN, INF):
            raises(lambda name=name, value=value: step(**{name: value}), name, f"got {value:g}")
        raises(lambda name=name: step(**{name: torch.ones(5, dtype=torch.float64)}), name, r"shape \[5\]")
        raises(lambda name=name: step(**{name: torch.ones(6)}), name, "torch.float32")
        batch = torch.tensor([1.0, -1.0], dtype=torch.float64)
        raises(lambda name=name, batch=batch: torch.func.vmap(lambda b: dv.step(
            model, x, v, dv.VBD(0.01, 2), **MODULI, **{name: b})[0])(batch), name, "got -1")  # fmt: skip
    raises(lambda: step(solver=dv.VBD.paper(0.01, 2), viscosity=1.0), "viscosity", 'block="paper"')
    with pytest.raises(NotImplementedError, match="damping with SDIRK2"):
        dv.step(model, x, v, dv.VBD(0.01, 2, integrator=dv.SDIRK2()), adjoint=dv.Unrolled(), drag=1.0, **MODULI)
