"""Claim: a rigid body moves by six unknowns, with the mass and inertia of its tets; it keeps its shape, turns as
Euler's equations say, and its gradients are those of the executed step. On floors, springs and in contact alike."""

import re
import warnings
from typing import Any

import numpy as np
import pytest
import torch
from helpers.executed import assert_executed, assert_like_differences, run_of
from helpers.marks import slow
from torch import Tensor

import diffvbd as dv
from diffvbd.testing import generator, relative_error
from diffvbd.testing.contact_scenes import SCENES, compiled, unrolled
from diffvbd.testing.tolerances import tolerance

F64 = torch.float64
SIZE = (0.1, 0.2, 0.3)
BRICK = dv.mesh.box((3, 4, 5), SIZE, split="kuhn")


def about_center(model: dv.Model, values: Tensor) -> Tensor:
    mass = model.mass[:, None]
    return values - (mass * values).sum(-2, keepdim=True) / mass.sum()


def test_mass_and_inertia_follow_the_density_of_a_step() -> None:
    """An uneven density is that of a Model with it; the gradient by the density of each tet is that of differences."""
    model, center = dv.Model(BRICK, rigid=[0]), torch.from_numpy(BRICK.points[BRICK.tets].mean(1))
    density = torch.where(center[:, 0] > 0.05, 2000.0, 900.0).to(F64)
    other, x = model.replace(density=density), model.rest_points
    v = torch.linalg.cross(torch.tensor([1.0, 2.0, 3.0], dtype=F64).expand_as(x), x - x.mean(0))
    solver, given = dv.VBD(0.01, 1), {"mu": 1.0, "lam": 1.0, "gravity": (0.0, 0.0, 0.0)}
    ends = [dv.step(m, x, v, solver, density=density, **given)[0] for m in (model, other)]
    torch.testing.assert_close(*ends, rtol=0, atol=1e-12)

    def loss(density: Tensor) -> Tensor:
        return (dv.step(model, x, v, solver, density=density, **given)[0] * torch.cos(x * 40)).sum()

    assert dv.check_gradients(loss, {"density": density}, verbose=False).ok


def spinning(model: dv.Model, speed: tuple[float, float, float]) -> Tensor:
    arm = about_center(model, model.rest_points)
    return torch.linalg.cross(torch.tensor(speed, dtype=F64).expand_as(arm), arm)


def test_mass_and_inertia_are_those_of_the_tets() -> None:
    density = torch.from_numpy(generator("rigid").uniform(500, 2000, BRICK.num_tets))
    model = dv.Model(BRICK, density, rigid=[0])
    even = dv.Model(BRICK, rigid=[0])
    arm = about_center(even, even.rest_points)
    inertia = (even.mass[:, None, None] * arm[:, :, None] * arm[:, None, :]).sum(0)
    assert relative_error(inertia, torch.diag(6 * torch.tensor(SIZE, dtype=F64) ** 2 / 12)) < 1e-12
    # of uneven density: each tet halved four times in every direction, and summed
    fine = BRICK
    for _ in range(2):
        fine = dv.mesh.subdivide(fine)
    points = torch.from_numpy(fine.points[fine.tets].mean(1))
    mass = density.repeat_interleave(64) * torch.from_numpy(fine.volume.copy())
    wanted = (mass[:, None] * points).sum(0)
    assert relative_error((model.mass[:, None] * model.rest_points).sum(0), wanted) < 1e-12
    with pytest.warns(UserWarning, match="rigid: the inertia of body 0 is wrong by up to 200%"):
        dv.Model(dv.mesh.cube(2), rigid=[0])


@pytest.mark.parametrize("sweeps", [0, 1, 8])
def test_it_turns_as_eulers_equations_say(device: str, sweeps: int) -> None:
    """About its middle axis a brick tumbles, without a torque; energy, spin and shape stay."""
    model = dv.Model(BRICK, rigid=[0], device=device)
    x, h, steps, speed = model.rest_points, 2e-3, 1000, (0.3, 6.0, 0.1)
    v, solver = spinning(model.to("cpu"), speed).to(device), dv.VBD(h, sweeps, integrator=dv.BDF2())
    end = dv.rollout(model, x, v, solver, steps=steps, mu=1e4, lam=1e4, gravity=(0.0, 0.0, 0.0))
    omega, square = np.array(speed), np.array(SIZE) ** 2
    inertia = square.sum() - square
    turn, tiny = np.eye(3), 20  # by small steps of the midpoint rule

    def rate(w: Any) -> Any:
        return np.cross(inertia * w, w) / inertia

    for _ in range(steps * tiny):
        w = omega + h / tiny / 2 * rate(omega)
        angle = np.linalg.norm(w) * h / tiny
        k = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]]) / np.linalg.norm(w)
        turn = turn @ (np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k)
        omega = omega + h / tiny * rate(w)
    arm = about_center(model, x)
    wanted = arm @ torch.from_numpy(turn.T).to(device)
    # of second order in h; 6e-4 of the same motion in bench/results/rigid.json, with another split of the box
    assert float((about_center(model, end.x[-1]) - wanted).norm() / arm.norm()) < 0.03
    assert omega[1] < 0  # it has tumbled
    torch.testing.assert_close(torch.pdist(end.x[-1].cpu()), torch.pdist(x.cpu()), rtol=1e-13, atol=1e-13)


def resting(device: Any = "cpu") -> dv.Model:
    """A brick that lies askew on a floor, tied to a soft cube by springs."""
    mesh = dv.mesh.join([BRICK, dv.mesh.box(2, 0.1, split="kuhn").translate((0.2, 0.0, 0.1))])
    springs = dv.Springs(dv.Embedding.of_vertices([59, 40]), dv.Embedding.of_vertices([60, 61]), stiffness=500.0)
    floor = dv.FloorBarrier(height=-0.01, kappa=1e4, dhat=0.03)
    return dv.Model(mesh, energies=(dv.StableNeoHookean(), floor, springs), rigid=[0], device=device)


def inputs_of(model: dv.Model, batch: tuple[int, ...] = ()) -> dict[str, Tensor]:
    rng = generator("rigid")

    def noise(*shape: int, size: float) -> Tensor:
        return torch.from_numpy(rng.normal(scale=size, size=(*batch, *shape))).to(model.device)

    n, t = model.num_vertices, model.num_tets
    soft = (model.body == 1)[:, None].to(F64)
    return {"x": model.rest_points + soft * noise(n, 3, size=2e-3), "v": noise(n, 3, size=0.3),
            "mu": 2e4 * noise(t, size=0.2).exp(), "lam": 3e4 * noise(t, size=0.2).exp(),
            "density": 1000 * noise(t, size=0.1).exp(), "force": noise(n, 3, size=0.5),
            "rest_points": model.rest_points + noise(n, 3, size=1e-3)}  # fmt: skip


CASES: dict[str, dict[str, Any]] = {"plain": {}, "coarse": {"subspace": "coarse"}, "relaxed": {"relaxation": 1.5},
                                    "sdirk2": {"integrator": dv.SDIRK2()}}  # fmt: skip


@pytest.mark.parametrize(("case", "sweeps", "steps"), [("plain", 1, 1), ("plain", 5, 2), ("coarse", 5, 1),
                                                       slow("relaxed", 3, 2)])  # fmt: skip
def test_gradients_are_those_of_the_executed_sweeps(device: str, case: str, sweeps: int, steps: int) -> None:
    solver = dv.VBD(0.01, sweeps, **CASES[case])
    assert_executed((resting(), resting(device=device)), solver, steps, inputs_of)


@pytest.mark.parametrize("case", ["plain", "coarse", "sdirk2"])
def test_central_differences(case: str) -> None:
    model, solver = resting(), dv.VBD(0.01, 3, **CASES[case])
    assert_like_differences(run_of(model, solver, 2), inputs_of(model), 0.01)


@pytest.mark.parametrize(("name", "rigid", "steps", "sweeps", "subspace"), [
    ("stacked", 0, 1, 1, "rigid"), slow("stacked", 1, 2, 5, "rigid"), ("stacked", 0, 1, 5, "coarse"),
    ("crossed", 1, 1, 5, "rigid"), ("batched", 0, 1, 5, "rigid"), slow("fast", 1, 1, 5, "rigid"),
    slow("crossed", 0, 2, 8, "coarse"), slow("on_held", 1, 2, 8, "rigid"), slow("thrown", 1, 1, 5, "rigid"),
])  # fmt: skip
def test_gradients_in_contact(device: str, name: str, rigid: int, steps: int, sweeps: int, subspace: Any) -> None:
    scene = SCENES[name]()
    scene.model = scene.model.replace(rigid=[rigid])
    solver = scene.solver(sweeps, subspace=subspace)
    result, parts = compiled(scene, steps, solver, scene.model.to(device))
    expected = unrolled(scene, steps, solver, parts)
    for key, value in expected.items():
        assert relative_error(result[key], value) <= tolerance("contact_adjoint"), key
        assert value.any() or key in ("grad_friction", "grad_pair_damping"), key


@pytest.mark.parametrize("integrator", [dv.ImplicitEuler(), dv.SDIRK2(), dv.BDF2()], ids=repr)
@pytest.mark.parametrize("pairs", [True, False], ids=["pairs", "floor"])
def test_central_differences_in_contact(integrator: Any, pairs: bool) -> None:
    scene = SCENES["stacked"]()
    kept = [e for e in scene.model.energies if pairs or not isinstance(e, dv.PairBarrier)]
    model, solver = scene.model.replace(rigid=[0], energies=kept), scene.solver(4, integrator=integrator)
    values = {k: v for k, v in {"x": scene.x, "v": scene.v, **scene.inputs, **scene.parameters}.items()
              if pairs or not k.startswith("pair")}  # fmt: skip

    def run(x: Tensor, v: Tensor, **inputs: Any) -> tuple[Tensor, Tensor]:
        motion = dv.rollout(model, x, v, solver, steps=2, **inputs)
        return motion.x[-1], motion.v[-1]

    assert_like_differences(run, values, scene.time_step)


def pressed() -> tuple[dv.Model, dict[str, Any]]:
    """A rigid finger on a soft bed, pushed down by 3 N."""
    bed = dv.mesh.box((4, 2, 4), (0.12, 0.04, 0.12))
    finger = dv.mesh.box((3, 5, 3), (0.03, 0.06, 0.03)).translate((0.045, 0.042, 0.045))
    mesh = dv.mesh.join([bed, finger])
    energies = (dv.StableNeoHookean(), dv.PairBarrier(), dv.Friction(0.5))
    model = dv.Model(mesh, 1000.0, mesh.points[:, 1] < 1e-9, energies, rigid=[1])

    def push(step: int, x: Tensor, v: Tensor) -> Tensor:
        return model.wrench(x, 1, force=(0.0, -3.0, 0.0))

    return model, {"mu": 3e4, "lam": 3e4, "drag": 20.0, "force": push}


def test_a_finger_pressed_with_three_newtons_holds_three_newtons() -> None:
    model, inputs = pressed()
    x = model.rest_points
    solver = dv.VBD(0.005, 10)
    motion = dv.rollout(model, x, torch.zeros_like(x), solver, steps=150, **inputs)
    last = {**inputs, "force": inputs["force"](0, motion.x[-2], None)}
    forces = dv.contact.forces(model, motion.x[-1], solver, previous=(motion.x[-2], motion.v[-2]), **last)
    weight = float(model.mass[model.body == 1].sum()) * 9.81
    assert abs(float(forces.bodies.total[1, 1]) - 3.0 - weight) < 1e-3 * (3.0 + weight)
    assert not dv.diagnose(model, motion.x[-1], solver, previous=(motion.x[-2], motion.v[-2]), **last).messages


def test_a_wrench_turns_and_pushes() -> None:
    model = dv.Model(BRICK, rigid=[0])
    x, h = model.rest_points.expand(2, -1, -1), 1e-3
    force = torch.tensor([[1.0, 2.0, -3.0], [0.0, 0.0, 0.0]], dtype=F64, requires_grad=True)
    torque = torch.tensor([0.02, -0.01, 0.03], dtype=F64, requires_grad=True)
    on = model.wrench(x, 0, force, torque)
    arm = about_center(model, x)
    assert relative_error(on.sum(-2), force) < 1e-13
    assert relative_error(torch.linalg.cross(arm, on).sum(-2), torque.expand(2, 3)) < 1e-13
    _, v = dv.step(model, x, torch.zeros_like(x), dv.VBD(h, 1), mu=1.0, lam=1.0, force=on, gravity=(0.0,) * 3)
    spin = torch.linalg.cross(arm, model.mass[:, None] * v).sum(-2)
    assert relative_error(spin, h * torque.expand(2, 3)) < 1e-4
    (slope,) = torch.autograd.grad(spin[0, 0], torque)
    assert abs(float(slope[0]) / h - 1) < 1e-4


@pytest.mark.parametrize(("given", "message"), [
    (3, "rigid: expected a sequence of numbers of bodies, got int"),
    ([2], "rigid: expected an integer <= 1, got 2"),
    ([0, 0], "rigid: expected different numbers of bodies, got 0 twice"),
    ([1], "rigid: expected bodies without pinned vertices, got body 1, which has some"),
])  # fmt: skip
def test_bad_bodies_are_named(given: Any, message: str) -> None:
    mesh = dv.mesh.join([BRICK, BRICK.translate((1.0, 0.0, 0.0))])
    with pytest.raises((ValueError, TypeError), match=re.escape(message)):
        dv.Model(mesh, pinned=mesh.points[:, 0] > 1.05, rigid=given)


@pytest.mark.parametrize(("stiffness", "lost"), [(1e3, 1e-5), (1e6, 0.3)])
def test_stiff_joints_between_rigid_bodies_are_warned_of(stiffness: float, lost: float) -> None:
    """Two bars on a hinge; one turns about it. With stiff springs they lose momentum, which a warning says."""
    bar = dv.mesh.box((5, 3, 3), (0.2, 0.03, 0.03))
    mesh = dv.mesh.join([bar, bar.translate((0.2, 0.0, 0.0))])
    ends = [[int(np.square(mesh.points[rows] - p).sum(1).argmin()) + 45 * k for p in ((0.2, 0, 0), (0.2, 0, 0.03))]
            for k, rows in enumerate((slice(0, 45), slice(45, 90)))]  # fmt: skip
    springs = dv.Springs(*map(dv.Embedding.of_vertices, ends), stiffness=stiffness)
    model = dv.Model(mesh, energies=(dv.StableNeoHookean(), springs), rigid=[0, 1])
    x, v = model.rest_points, torch.zeros(90, 3, dtype=F64)
    arm = x[:45] - torch.tensor([0.2, 0.015, 0.0], dtype=F64)
    v[:45] = torch.linalg.cross(torch.tensor([0.0, 0.0, 5.0], dtype=F64).expand_as(arm), arm)
    solver = dv.VBD(0.002, 20, integrator=dv.BDF2())
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        motion = dv.rollout(model, x, v, solver, steps=100, gravity=(0.0, 0.0, 0.0), mu=1e5, lam=1e5)
    momentum = (model.mass[:, None] * motion.v).sum(1)
    loses = bool((momentum - momentum[0]).norm(dim=-1).max() > lost * momentum[0].norm())
    warned = any("springs: between rigid bodies a stiffness of" in str(w.message) for w in said)
    assert warned == loses == (stiffness > 1e5)


def test_what_is_refused() -> None:
    model = dv.Model(BRICK, rigid=[0])
    x = model.rest_points
    with pytest.raises(ValueError, match='subspace: expected "rigid" or "coarse" with rigid bodies, got None'):
        dv.step(model, x, x, dv.VBD(0.01, 1, subspace=None), mu=1.0, lam=1.0)
    with pytest.raises(NotImplementedError, match="adjoint: expected ReverseSweep or Unrolled with rigid bodies"):
        dv.step(model, x, x, dv.VBD(0.01, 1), mu=1.0, lam=1.0, adjoint=dv.GlobalAdjoint())
    with pytest.raises(NotImplementedError, match="model: expected no rigid bodies in an equilibrium"):
        dv.equilibrium(model, x, dv.VBD(0.01, 1), mu=1.0, lam=1.0)
    with pytest.raises(ValueError, match="torque: expected shape"):
        model.wrench(x, 0, torque=torch.zeros(2, dtype=F64))
    with pytest.raises(ValueError, match="body: expected"):
        model.wrench(x, 1)
    with pytest.raises(ValueError, match="force: expected finite numbers"):
        model.wrench(x, 0, force=(0.0, float("nan"), 0.0))
    with pytest.raises(ValueError, match="prescribed: expected positions for pinned vertices"):
        dv.step(model, x, 0 * x, dv.VBD(0.01, 1), mu=1.0, lam=1.0, prescribed=x + 1)
    with pytest.raises(ValueError, match="model: expected no rigid bodies"):
        dv.solvers.vertex_block_descent(model, dv.VBD(0.01, 1))
    assert dv.solve(model, x, 0 * x, dv.VBD(0.01, 5), mu=1e4, lam=1e4).x.isfinite().all()
