"""Claim: steps with springs, tendons and pressure, and their gradients, equal autograd through an independent execution
of the same bounds and sweeps; and the gradients are those of differences. GlobalAdjoint has those of the energies."""

from typing import Any

import pytest
import torch
from helpers.coupled import coupled, inputs_of
from helpers.executed import assert_converged, assert_executed, assert_like_differences, assert_of_equation, run_of
from helpers.marks import slow
from helpers.spreads import assert_near_contact
from torch import Tensor

import diffvbd as dv
from diffvbd import reference
from diffvbd.testing import contact_scenes, evaluate, generator, relative_error, tolerance
from diffvbd.testing.soft_scenes import finger

FLOOR = dv.FloorBarrier(height=-0.01, kappa=1e4, dhat=0.03)
STEP = 0.01

CASES: dict[str, tuple[dict[str, Any], tuple[Any, ...], dict[str, Any]]] = {
    "plain": ({}, (), {}),
    "free": ({"pinned": False}, (), {}),
    "gas": ({"gas": True, "pinned": False}, (), {}),
    "places": ({"places": True}, (), {}),
    "cables": ({"tension_only": True}, (), {}),
    "floor": ({"pinned": False}, (FLOOR,), {}),
    "anchor": ({}, (dv.Anchor(20.0),), {}),
    "coarse": ({}, (), {"subspace": "coarse"}),
    "free_coarse": ({"pinned": False, "places": True}, (FLOOR,), {"subspace": "coarse"}),
    "coarse_gas": ({"gas": True}, (), {"subspace": "coarse", "integrator": dv.SDIRK2()}),
    "relaxed": ({}, (), {"relaxation": 1.5}),
    "sdirk2": ({}, (), {"integrator": dv.SDIRK2()}),
}
RUNS = [("plain", 1, 1), ("plain", 8, 1), ("plain", 2, 3), *((name, 2, 1) for name in CASES if name != "plain")]
EVERY = [(name, sweeps, steps) for name in CASES for sweeps in (1, 2, 8) for steps in (1, 3)
         if (name, sweeps, steps) not in RUNS]  # fmt: skip
LONG = [run for i, run in enumerate(EVERY) if i % 4 == 0]  # which takes all cases, sweeps and steps in turn
HOURS = [pytest.param(*run, marks=pytest.mark.hours) for run in EVERY if run not in LONG]


@pytest.mark.parametrize(("case", "sweeps", "steps"), [*RUNS, *(slow(*run) for run in LONG), *HOURS])
def test_gradients_are_those_of_the_executed_sweeps(device: str, case: str, sweeps: int, steps: int) -> None:
    scene, energies, options = CASES[case]
    model, solver = coupled(*energies, **scene), dv.VBD(STEP, sweeps, **options)
    assert_executed((model, coupled(*energies, **scene, device=device)), solver, steps, inputs_of)


@pytest.mark.parametrize("sweeps", [2, slow(8)])
def test_scenes_of_a_batch_are_those_alone(device: str, sweeps: int) -> None:
    model, solver = coupled(device=device), dv.VBD(STEP, sweeps)
    values = inputs_of(model, (2,))
    both = evaluate(run_of(model, solver), values, STEP)
    twin = coupled()
    expected = evaluate(run_of(twin, solver, adjoint=dv.Unrolled()), inputs_of(twin, (2,)), STEP)
    for name, value in expected.items():
        assert value.any() and relative_error(both[name], value) <= tolerance("coupled_adjoint"), name
    shared = ("rest_points", "density", "spring_stiffness", "spring_rest_length", "tendon_stiffness",
              "tendon_rest_length")  # fmt: skip
    alone = {name: value if name in shared else value[1] for name, value in values.items()}
    x, v = run_of(model, solver)(**alone)
    assert torch.equal(x, both["x"][1]) and torch.equal(v, both["v"][1])


@pytest.mark.parametrize(("case", "sweeps"), [("gas", 1), ("places", 2), slow("plain", 8), slow("coarse", 8)])
def test_gradients_are_those_of_differences(case: str, sweeps: int) -> None:
    scene, energies, options = CASES[case]
    model, solver = coupled(*energies, **scene), dv.VBD(STEP, sweeps, **options)
    assert_like_differences(run_of(model, solver), inputs_of(model), STEP)


@pytest.mark.parametrize("case", ["gas", "places", *map(slow, (c for c in CASES if c not in ("gas", "places")))])
def test_global_adjoint_is_the_derivative_of_a_converged_step(device: str, case: str) -> None:
    scene, energies, options = CASES[case]
    models = coupled(*energies, **scene), coupled(*energies, **scene, device=device)
    assert_converged(models, dv.VBD(STEP, 150, **options), inputs_of)


def test_the_gradient_of_a_converged_step_is_that_of_differences() -> None:
    """GlobalAdjoint is what solve takes if not told otherwise."""
    model = coupled(places=True)

    def run(x: Tensor, v: Tensor, **inputs: Tensor) -> tuple[Tensor, Tensor]:
        done = dv.solve(model, x, v, dv.VBD(STEP, 0), tolerance=1e-13, **inputs)
        return done.x, done.v

    assert_like_differences(run, inputs_of(model), STEP)


@pytest.mark.parametrize("kind", ["gas", "places"])
def test_global_adjoint_of_one_sweep_is_of_the_energies_and_not_of_their_bound(kind: str) -> None:
    model = coupled(**{kind: True})

    def potential(end: Tensor, x: Tensor, v: Tensor, mu: Tensor, lam: Tensor, force: Tensor, **parameters: Tensor
                  ) -> Tensor:  # fmt: skip
        y = x + STEP * v + STEP**2 * (x.new_tensor([0, -9.81, 0]) + force / model.mass[:, None])
        return reference.incremental_potential(model, end, y, mu, lam, STEP, x, parameters=parameters)

    run = run_of(model, dv.VBD(STEP, 1), adjoint=dv.GlobalAdjoint(tolerance=tolerance("linear_residual")))
    values = {k: v for k, v in inputs_of(model).items() if k not in ("rest_points", "density")}
    assert_of_equation(model, run, potential, values)


def test_a_cable_of_no_length_resists_only_without_slack() -> None:
    mesh, rest = dv.mesh.cube(2, 0.1), torch.tensor([0.0, 0.02], dtype=torch.float64)
    at = dv.Embedding.of_vertices([6, 7])
    cables = dv.Springs(at, torch.from_numpy(mesh.points[6:8].copy()), 50.0, rest, tension_only=True)
    model = dv.Model(mesh, pinned=[0], energies=(dv.StableNeoHookean(), cables))
    x = model.rest_points.requires_grad_()
    found = dv.coupling_forces(model, x).springs
    assert found is not None and not found.any()
    slopes = torch.autograd.grad(found[:, 0].sum(), x)[0]
    assert slopes[6:].tolist() == [[-50.0, 0.0, 0.0], [0.0, 0.0, 0.0]]


def test_the_gradient_at_a_straight_tendon_is_smooth() -> None:
    """At rest a route is straight but for rounding, and dl / dx of its inner points is zero."""
    model = finger((8, 3, 3), (0.1, 0.02, 0.02), 6, 200.0)
    x = model.rest_points

    def gradient(x: Tensor) -> Tensor:
        at = x.clone().requires_grad_()
        end, _ = dv.step(
            model, at, torch.zeros_like(x), dv.VBD(STEP, 4), young=1e5, poisson=0.3, tendon_rest_length=0.09
        )
        return torch.autograd.grad((end * torch.cos(40 * x)).sum(), at)[0]

    nudged = x + 1e-16 * torch.from_numpy(generator("straight").standard_normal(x.shape))
    assert relative_error(gradient(nudged), gradient(x)) < 1e-12


def test_attached_bodies_touch(device: str) -> None:
    """A box that a spring pulls onto another one: pairs, friction and couplings in one step."""
    tets = contact_scenes.boxes((0, 0, 0), (0.03, 0.213, 0.02), points=2)
    first = dv.Embedding.of_points(tets, [[0.1, 0.2, 0.1], [0.05, 0.15, 0.1]])
    second = dv.Embedding.of_points(tets, [[0.12, 0.213, 0.12], [0.1, 0.3, 0.1]])
    energies = (dv.PairBarrier(kappa=1e4, dhat=0.02, damping=1.0), dv.Friction(0.3, 0.1),
                dv.Springs(first, second, 300.0, 0.01), dv.Tendons(second, [[0, 1]], 100.0, 0.05))  # fmt: skip
    for options in ({}, {"subspace": "coarse"}):
        scene = contact_scenes.build("coupled", tets, energies)
        names = ("spring_stiffness", "spring_rest_length", "tendon_stiffness", "tendon_rest_length")
        constants = {f"{e.name}_{k}": v for e in scene.model.couplings for k, v in scene.model.constants(e).items()}
        scene.parameters |= {name: constants[name].clone() for name in names}
        solver = scene.solver(3, **options)
        result, parts = contact_scenes.compiled(scene, 1, solver, scene.model.to(device))
        expected = contact_scenes.unrolled(scene, 1, solver, parts)
        others = [lambda seed=seed, s=scene, v=solver, p=parts: contact_scenes.unrolled(s, 1, v, p, seed=seed)
                  for seed in (1, 2)]  # fmt: skip
        forward, adjoint = tolerance("contact_forward"), tolerance("contact_adjoint")
        assert_near_contact(result, expected, forward, adjoint, scene.time_step, others)
        assert all(result[f"grad_{name}"].any() for name in names)


def test_without_couplings_nothing_changes_and_with_slack_ones_little() -> None:
    """A spring of no stiffness, a slack tendon and no pressure leave the positions of the plain sweeps; of one, since
    more have more rigid corrections."""
    model, solver = coupled(), dv.VBD(STEP, 1)
    values = inputs_of(model)
    none = {"spring_stiffness": 0.0, "tendon_stiffness": 0.0, "pressure": 0.0}
    bare = model.replace(energies=[dv.StableNeoHookean()])
    assert not bare.couplings and not bare.vertex_energies and "spring_stiffness" not in bare.inputs
    x, _ = run_of(model, solver)(**values | none)
    own = {k: v for k, v in values.items() if k.split("_")[0] not in ("spring", "tendon", "pressure")}
    y, _ = run_of(bare, solver)(**own)
    assert relative_error(x, y) <= tolerance("coupled_forward")


def test_rollouts_take_inputs_per_step_and_as_functions() -> None:
    model, solver = coupled(places=True), dv.VBD(STEP, 2)
    values = inputs_of(model)
    x, v = values["x"], values["v"]
    lengths = torch.linspace(0.2, 0.15, 4, dtype=x.dtype)[:, None].requires_grad_()
    frame = values["spring_points"]
    motion = dv.rollout(model, x, v, solver, steps=4, mu=2e4, lam=4e4, tendon_rest_length=dv.per_step(lengths),
                        spring_points=lambda step, x, v: frame + 0.01 * step, checkpoint_every=2)  # fmt: skip
    for k in range(4):
        x, v = dv.step(model, x, v, solver, mu=2e4, lam=4e4, tendon_rest_length=lengths[k],
                       spring_points=frame + 0.01 * k)  # fmt: skip
    assert torch.equal(motion.x[-1], x)
    motion.x[-1].square().sum().backward()
    assert lengths.grad is not None and (lengths.grad != 0).all()


def test_float32_and_other_devices(device: str) -> None:
    double, single = coupled(), coupled().to(device, torch.float32)
    solver, values = dv.VBD(STEP, 4), inputs_of(double)
    expected = evaluate(run_of(double, solver), values, STEP)
    result = evaluate(run_of(single, solver), {k: v.to(device, torch.float32) for k, v in values.items()}, STEP)
    assert relative_error(result["x"], expected["x"]) <= tolerance("float32_forward")
    for name in (key for key in expected if key.startswith("grad_")):
        assert relative_error(result[name], expected[name]) <= tolerance("coupled_float32"), name


def test_the_same_bits_from_run_to_run(device: str) -> None:
    model, solver = coupled(device=device), dv.VBD(STEP, 3)
    one, two = (evaluate(run_of(model, solver), inputs_of(model, (2,)), STEP) for _ in range(2))
    assert all(torch.equal(value, two[name]) for name, value in one.items())


def test_forces_are_minus_the_gradient_and_pull_on_pins() -> None:
    model = coupled(gas=True)
    values = inputs_of(model)
    parameters = {k: v for k, v in values.items() if k.split("_")[0] in ("spring", "tendon", "pressure")}
    x = values["x"].requires_grad_()
    found = dv.coupling_forces(model, x, **parameters)
    assert found.springs is not None and found.tendons is not None and found.volume is not None
    (spring,) = (e for e in model.couplings if isinstance(e, dv.Springs))
    d = spring.first.at(x) - spring.second.at(x)
    length = d.norm(dim=-1)
    energy = (values["spring_stiffness"] / 2 * (length - values["spring_rest_length"]) ** 2).sum()
    energy = energy + (found.tendons**2 / values["tendon_stiffness"] / 2).sum()
    absolute = values["pressure"] + 101_325.0
    rest = dv.coupling_forces(model, model.rest_points, **parameters).volume
    energy = energy + (101_325.0 * found.volume - absolute * rest * found.volume.log()).sum()
    (gradient,) = torch.autograd.grad(energy, x, retain_graph=True)
    assert relative_error(-gradient, found.vertices) <= tolerance("coupled_forward")
    pull = -values["spring_stiffness"] * (length - values["spring_rest_length"])
    assert relative_error(found.springs, pull[:, None] * d / length[:, None]) <= tolerance("formula")
    held = dv.reactions(model, x, mu=2e4, lam=4e4, **parameters)
    bare = dv.reactions(model.replace(energies=[dv.StableNeoHookean()]), x, mu=2e4, lam=4e4)
    assert relative_error(held - bare, -torch.where(model.pinned[:, None], found.vertices, 0.0)) <= tolerance("sum")


def test_the_residual_of_a_converged_step_is_that_of_the_energies() -> None:
    """diagnose sees the exact gradient, not that of a bound about another state; solve ends where it vanishes."""
    model, values = coupled(), inputs_of(coupled())
    parameters = {k: v for k, v in values.items() if k not in ("x", "v", "density", "rest_points", "force")}
    x, v, solver = values["x"], values["v"], dv.VBD(STEP, 0)
    end = dv.solve(model, x, v, solver, tolerance=1e-9, max_sweeps=4000, **parameters)
    assert end.converged
    found = dv.diagnose(model, end.x, dv.VBD(STEP, end.sweeps), previous=(x, v), warn=False, **parameters)
    assert float(found.unbalanced) < 1e-8
    loads = dv.coupling_forces(model, end.x, **{k: v for k, v in parameters.items() if k not in ("mu", "lam")})
    bare = model.replace(energies=[dv.StableNeoHookean()])
    moduli = {k: parameters[k] for k in ("mu", "lam")}
    same = dv.diagnose(bare, end.x, solver, previous=(x, v), warn=False, force=loads.vertices, **moduli)
    assert float(same.unbalanced) < 1e-8
    route = dv.solve(model, x, v, solver, adjoint=dv.Unrolled(), tolerance=1e-6, **parameters)
    assert route.converged
