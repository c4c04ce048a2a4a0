"""Claim: steps whose tets average volumes over patches, and their gradients, equal autograd through an independent
execution of the same bounds and sweeps; the gradients are those of differences; no sweep raises the potential; and
GlobalAdjoint has the gradients of the averaged energy."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from helpers.executed import assert_converged, assert_executed, assert_like_differences, assert_of_equation, run_of
from helpers.marks import slow
from helpers.results import saved_bytes
from helpers.spreads import assert_near_contact
from torch import Tensor

import diffvbd as dv
from diffvbd.model.system import system_of
from diffvbd.rollout.checks import mechanical_energy
from diffvbd.rollout.refine import halved
from diffvbd.step.arguments import material_of, prepare
from diffvbd.testing import contact_scenes, evaluate, generator, relative_error, tolerance

STEP = 0.01
LAW = dv.StableNeoHookean(patches="auto")
FLOOR = dv.FloorBarrier(height=-0.01, kappa=1e4, dhat=0.03)
CASES: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "plain": ({}, {}),
    "free": ({"pinned": False}, {}),
    "floor": ({"pinned": False, "extra": (FLOOR,)}, {}),
    "anchor": ({"extra": (dv.Anchor(20.0),)}, {}),
    "springs": ({"springs": True, "pinned": False}, {}),
    "viscous": ({"viscous": True}, {}),
    "grown": ({"grown": True}, {}),
    "coarse": ({}, {"subspace": "coarse"}),
    "free_coarse": ({"pinned": False, "extra": (FLOOR,)}, {"subspace": "coarse"}),
    "inside_out": ({"jitter": 0.03}, {}),
    "relaxed": ({}, {"relaxation": 1.5}),
    "sdirk2": ({}, {"integrator": dv.SDIRK2()}),
}
RUNS = [("plain", 1, 1), ("plain", 8, 1), ("plain", 2, 3), *((name, 2, 1) for name in CASES if name != "plain")]
LONG = [(name, sweeps, steps) for name in CASES for sweeps, steps in ((1, 3), (8, 1)) if name != "plain"]


def built(*, pinned: bool = True, extra: tuple[Any, ...] = (), springs: bool = False, device: Any = "cpu",
          law: Any = LAW, **_: Any) -> dv.Model:  # fmt: skip
    mesh = dv.mesh.join([dv.mesh.beam(4, 3, 3, size=(0.3, 0.15, 0.15), split="kuhn"),
                         dv.mesh.cube(3, 0.1).translate((0.4, 0.1, 0.1))])  # fmt: skip
    if springs:
        ends = [dv.Embedding.of_points(mesh, [[x, 0.12, 0.12]]) for x in (0.3, 0.42)]
        extra = (*extra, dv.Springs(*ends, 300.0))
    pins = mesh.points[:, 0] < 1e-9 if pinned else None
    return dv.Model(mesh, pinned=pins, energies=(law, *extra), device=device)


def inputs_of(model: dv.Model, batch: tuple[int, ...] = (), *, viscous: bool = False, grown: bool = False,
              jitter: float = 2e-3, **_: Any) -> dict[str, Tensor]:  # fmt: skip
    rng = generator("patches", batch)

    def noise(*shape: int) -> Tensor:
        return torch.from_numpy(rng.standard_normal(shape))

    rest, state, tets = model.rest_points.cpu(), (*batch, model.num_vertices, 3), (*batch, model.num_tets)
    values = {
        "x": rest + jitter * noise(*state),
        "v": 0.2 * noise(*state),
        "mu": 2e4 * torch.exp(0.2 * noise(*tets)),
        "lam": 4e5 * torch.exp(0.2 * noise(*tets)),
        "force": 0.3 * noise(*state),
        "rest_points": rest + 1e-3 * noise(model.num_vertices, 3),
        "density": model.density.cpu() * torch.exp(0.1 * noise(model.num_tets)),
    }
    if viscous:
        values |= {"viscosity": 30 * torch.exp(0.2 * noise(*tets)), "drag": torch.exp(0.2 * noise(model.num_vertices)),
                   "volume_viscosity": 20 * torch.exp(0.2 * noise(*tets))}  # fmt: skip
    if grown:
        values["stress_free"] = torch.eye(3) + 0.05 * noise(model.num_tets, 3, 3)
    if "spring_stiffness" in model.inputs:
        values["spring_stiffness"] = torch.tensor([300.0])
    if "anchor_stiffness" in model.inputs:
        values["anchor_stiffness"] = torch.from_numpy(rng.uniform(10, 30, model.num_vertices))
    return {name: value.double().to(model.device) for name, value in values.items()}


@pytest.mark.parametrize(("case", "sweeps", "steps"), [*RUNS, *(slow(*run) for run in LONG)])
def test_gradients_are_those_of_the_executed_sweeps(device: str, case: str, sweeps: int, steps: int) -> None:
    scene, options = CASES[case]
    model, solver = built(**scene), dv.VBD(STEP, sweeps, **options)
    assert_executed((model, built(**scene, device=device)), solver, steps, lambda of: inputs_of(of, **scene))


@pytest.mark.parametrize("case", ["springs", "viscous", *map(slow, ("free", "floor", "anchor", "grown", "sdirk2"))])
def test_global_adjoint_is_the_derivative_of_a_converged_step(device: str, case: str) -> None:
    scene, options = CASES[case]
    models = built(**scene), built(**scene, device=device)
    assert_converged(models, dv.VBD(STEP, 400, **options), lambda of: inputs_of(of, **scene))


def test_global_adjoint_of_a_converged_step_is_that_of_differences() -> None:
    scene, model = CASES["viscous"][0], built()
    run = run_of(model, dv.VBD(STEP, 400), adjoint=dv.GlobalAdjoint(tolerance=tolerance("linear_residual")))
    assert_like_differences(run, inputs_of(model, **scene), STEP)


def test_global_adjoint_of_one_sweep_is_of_the_energy_and_not_of_its_bound() -> None:
    model = built()

    def potential(end: Tensor, x: Tensor, v: Tensor, mu: Tensor, lam: Tensor, force: Tensor) -> Tensor:
        y = x + STEP * v + STEP**2 * (x.new_tensor([0, -9.81, 0]) + force / model.mass[:, None])
        return (model.mass[:, None] / 2 * (end - y) ** 2).sum() + STEP**2 * energy_of(model, end, mu, lam)

    run = run_of(model, dv.VBD(STEP, 1), adjoint=dv.GlobalAdjoint(tolerance=tolerance("linear_residual")))
    values = {k: v for k, v in inputs_of(model).items() if k not in ("rest_points", "density")}
    values["lam"] = values["lam"].mean()
    assert_of_equation(model, run, potential, values)


@pytest.mark.parametrize("sweeps", [2, slow(8)])
def test_scenes_of_a_batch_are_those_alone(device: str, sweeps: int) -> None:
    model, solver = built(device=device), dv.VBD(STEP, sweeps)
    values = inputs_of(model, (2,))
    both = evaluate(run_of(model, solver), values, STEP)
    alone = {name: value if name in ("rest_points", "density") else value[1] for name, value in values.items()}
    x, v = run_of(model, solver)(**alone)
    assert torch.equal(x, both["x"][1]) and torch.equal(v, both["v"][1])
    expected = evaluate(run_of(built(), solver, adjoint=dv.Unrolled()), inputs_of(built(), (2,)), STEP)
    for name, value in expected.items():
        assert value.any() and relative_error(both[name], value) <= tolerance("coupled_adjoint"), name


@pytest.mark.parametrize(("case", "sweeps"), [("plain", 1), ("viscous", 2), slow("grown", 8), slow("coarse", 8)])
def test_gradients_are_those_of_differences(case: str, sweeps: int) -> None:
    scene, options = CASES[case]
    model, solver = built(**scene), dv.VBD(STEP, sweeps, **options)
    assert_like_differences(run_of(model, solver), inputs_of(model, **scene), STEP)


def test_bodies_that_touch(device: str) -> None:
    tets = contact_scenes.boxes((0, 0, 0), (0.03, 0.213, 0.02))
    energies = (dv.PairBarrier(kappa=3e4, dhat=0.02, damping=3.0), dv.Friction(0.4, 0.05))
    for options in ({}, {"subspace": "coarse"}):
        scene = contact_scenes.build("patches", tets, energies)
        scene = replace(scene, model=scene.model.replace(energies=(LAW, *energies)))
        solver = scene.solver(3, **options)
        result, parts = contact_scenes.compiled(scene, 1, solver, scene.model.to(device))
        expected = contact_scenes.unrolled(scene, 1, solver, parts)
        others = [lambda seed=seed, s=scene, v=solver, p=parts: contact_scenes.unrolled(s, 1, v, p, seed=seed)
                  for seed in (1, 2)]  # fmt: skip
        forward, adjoint = tolerance("contact_forward"), tolerance("contact_adjoint")
        assert_near_contact(result, expected, forward, adjoint, scene.time_step, others)
        assert all(result[f"grad_{name}"].any() for name in ("mu", "lam", "pair_kappa"))


def energy_of(model: dv.Model, x: Tensor, mu: Tensor, lam: Tensor) -> Tensor:
    """Of a state [V, 3], by deformation gradients [J]; mu, lam of all tets."""
    rest, now = (p[model.tets] for p in (model.rest_points, x))
    rest, now = ((p[:, 1:] - p[:, :1]).mT for p in (rest, now))
    f, volume = now @ torch.linalg.inv(rest), torch.linalg.det(rest) / 6
    ratio = torch.linalg.det(f)
    total = volume * (mu / 2 * (f.square().sum((1, 2)) - 3) - mu * (ratio - 1) + mu / 2 * (ratio - 1) ** 2)
    assert model.patches is not None
    for patch in range(int(model.patches.label.max()) + 1):
        own = model.patches.label == patch
        whole = volume[own].sum()
        total = total + lam / 2 * whole * ((volume[own] * ratio[own]).sum() / whole - 1) ** 2 / len(total)
    return total.sum()


def test_no_sweep_raises_the_potential() -> None:
    """At nu = 0.499, from a state far out of shape, with tets inside out: what sweeps see bounds the energy."""
    model, mu, lam = built(), 1e4, 5e6
    x = model.rest_points + 0.03 * torch.from_numpy(generator("far").standard_normal((model.num_vertices, 3)))
    x = torch.where(model.pinned[:, None], model.rest_points, x)
    assert (torch.linalg.det(x[model.tets][:, 1:] - x[model.tets][:, :1]) < 0).any()
    potentials = []
    for sweeps in range(8):
        solver = dv.VBD(STEP, sweeps, start="inertia", subspace=None)
        end, _ = dv.step(model, x, torch.zeros_like(x), solver, mu=mu, lam=lam, gravity=(0, 0, 0))
        inertia = (model.mass[:, None] * (end - x) ** 2).sum() / 2
        potentials.append(float(inertia / STEP**2 + energy_of(model, end, mu, lam)))
    falls = np.diff(potentials)
    assert (falls < 0).all() and falls[0] < -0.1 * potentials[0]


def test_a_converged_step_is_that_of_the_averaged_energy() -> None:
    """The gradient of the potential vanishes there; diagnose and solve see it."""
    model, mu, lam = built(), 2e4, 1e5
    values = {"mu": mu, "lam": lam, "gravity": (0.0, -9.81, 0.0)}
    x, v = model.rest_points, torch.zeros_like(model.rest_points)
    end = dv.solve(model, x, v, dv.VBD(STEP, 0), tolerance=1e-9, max_sweeps=4000, **values)
    found = dv.diagnose(model, end.x, dv.VBD(STEP, end.sweeps), previous=(x, v), warn=False, **values)
    assert end.converged and float(found.unbalanced) < 1e-8
    prepared = prepare(system_of(model, dv.VBD(STEP, 0)), (), material_of(mu=mu, lam=lam), time_step=STEP, sweeps=0)
    one, two = (mechanical_energy(system_of(model, dv.VBD(STEP, 0)), prepared, p, v) for p in (end.x, x))
    assert relative_error(one - two, energy_of(model, end.x, mu, lam)[None]) <= 1e-9
    at = end.x.detach().clone().requires_grad_()
    (slope,) = torch.autograd.grad(energy_of(model, at, mu, lam), at)
    y = x + STEP**2 * x.new_tensor([0, -9.81, 0])
    left = torch.where(model.pinned[:, None], 0.0, model.mass[:, None] * (end.x - y) / STEP**2 + slope)
    assert left.norm() <= 1e-7 * slope.norm()


def test_patches_of_one_tet_change_nothing() -> None:
    one = built(law=dv.StableNeoHookean(patches=torch.arange(built().num_tets)))
    bare, solver, values = built(law=dv.StableNeoHookean()), dv.VBD(STEP, 4), inputs_of(built())
    result, expected = (evaluate(run_of(model, solver), values, STEP) for model in (one, bare))
    assert bare.patches is None and not bare._renews
    assert all(relative_error(result[name], value) <= tolerance("coupled_adjoint") for name, value in expected.items())


def test_float32_transforms_and_bits(device: str) -> None:
    double, single = built(), built().to(device, torch.float32)
    solver, values = dv.VBD(STEP, 3), inputs_of(double)
    expected = evaluate(run_of(double, solver), values, STEP)
    result = evaluate(run_of(single, solver), {k: v.to(device, torch.float32) for k, v in values.items()}, STEP)
    for name in (key for key in expected if key.startswith("grad_")):
        assert relative_error(result[name], expected[name]) <= tolerance("coupled_float32"), name
    again = evaluate(run_of(built(device=device), solver), {k: v.to(device) for k, v in values.items()}, STEP)
    same = evaluate(run_of(built(device=device), solver), {k: v.to(device) for k, v in values.items()}, STEP)
    assert all(torch.equal(value, same[name]) for name, value in again.items())

    def end(lam: Tensor) -> Tensor:
        return run_of(double, solver)(**{**values, "lam": lam})[0].square().sum()

    several = torch.stack([values["lam"], 2 * values["lam"]])
    mapped = torch.func.vmap(torch.func.grad(end))(several)
    alone = torch.func.grad(end)(values["lam"])
    assert alone.any() and relative_error(mapped[0], alone) <= tolerance("coupled_adjoint")


def test_memory_counts_the_laws_of_sweeps() -> None:
    model, kept = built(), []
    for sweeps in (4, 8):
        x, solver = model.rest_points, dv.VBD(STEP, sweeps)
        mu = torch.full((model.num_tets,), 1e4, dtype=x.dtype, requires_grad=True)
        own = [t for rows in model.patches[1:] for t in rows if isinstance(t, Tensor)]  # type: ignore[index]
        kept.append(saved_bytes(lambda s=solver, x=x, mu=mu: dv.step(model, x, torch.zeros_like(x), s, mu=mu, lam=1e5),
                                [x, mu, *own]))  # fmt: skip
    one, two = (dv.memory(model, dv.VBD(STEP, sweeps))["step"] for sweeps in (4, 8))
    assert abs((two - one) / (kept[1] - kept[0]) - 1) <= tolerance("memory")


def test_a_finer_mesh_has_no_labels() -> None:
    labels = dv.Model(dv.mesh.cube(), energies=[dv.StableNeoHookean(patches=[0] * 5)])
    with pytest.raises(ValueError, match="mesh: expected False: a finer mesh has other patches than the labels"):
        halved(labels)
    assert halved(dv.Model(dv.mesh.cube(), energies=[LAW])).model.patches is not None
