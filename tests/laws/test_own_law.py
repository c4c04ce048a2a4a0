"""Claim: a compiled law of one's own has what a built-in one has: the exact adjoint of the executed sweeps for every
input, forward equal to the reference, descent, corrections, integrators, other routes, physics.

One law with every invariant and function is compiled for all quick tests, once a session, in a temporary folder.
"""

import math
from typing import Any

import pytest
import torch
from helpers.coupled import coupled
from helpers.coupled import inputs_of as inputs_of_coupled
from helpers.executed import assert_executed, assert_like_differences, run_of
from helpers.laws import LOG, MESH, PINNED, STABLE, TEXT, VALUES, compiled_laws, inputs_of_law, law_of, model_of
from helpers.paths import needs_csrc
from torch import Tensor

import diffvbd as dv
from diffvbd import reference
from diffvbd.laws import tets
from diffvbd.model.material import shape_gradients
from diffvbd.testing import evaluate, relative_error
from diffvbd.testing.dense_statics import coupling_energy, residual, weight

pytestmark = [needs_csrc, pytest.mark.slow]  # a law is compiled
__all__ = ["compiled_laws"]
F64 = torch.float64


def compare(model: dv.Model, solver: dv.VBD, inputs: dict[str, Any], bar: float = 1e-11) -> None:
    def run(adjoint: Any, **given: Any) -> tuple[Tensor, Tensor]:
        return dv.step(model, given.pop("x"), given.pop("v"), solver, adjoint=adjoint, **given)

    result = evaluate(lambda **given: run(dv.ReverseSweep(), **given), inputs, solver.time_step)
    expected = evaluate(lambda **given: run(dv.Unrolled(), **given), inputs, solver.time_step)
    for name, value in expected.items():
        assert relative_error(result[name], value) <= bar, name
        assert float(value.nan_to_num().abs().max()) > 0, name


@pytest.mark.parametrize(("sweeps", "jitter"), [(1, 0.005), (1, 0.06), pytest.param(4, 0.06, marks=pytest.mark.hours)])
def test_gradients_are_those_of_the_executed_sweeps(sweeps: int, jitter: float) -> None:
    """Against autograd through the reference; the larger jitter turns tets inside out and shortens updates."""
    model = model_of()
    compare(
        model, dv.VBD(0.01, sweeps, relaxation=1.3, saturation=0.5, regularization=0.01), inputs_of_law(model, jitter)
    )


def test_batches_floors_anchors() -> None:
    model = model_of(dv.FloorBarrier(height=-0.03, kappa=500.0, dhat=0.05, damping=5.0), dv.Anchor(40.0), pinned=None)
    inputs = {k: v for k, v in inputs_of_law(model, 0.004, (2,)).items() if k != "stress_free"}
    compare(model, dv.VBD(0.005, 2), inputs | {"anchor_stiffness": torch.tensor(40.0, dtype=F64)}, 1e-10)


def held_and_pulled(**options: Any) -> tuple[dv.Model, dict[str, Tensor]]:
    """Bodies of the law with springs, tendons and pressure, and every input."""
    model = coupled(law=law_of(TEXT), **options)
    inputs = inputs_of_coupled(model)
    stiff = inputs["mu"]
    inputs |= {"c": stiff / 5, "m": stiff / 4, "k": stiff / 2, "s": VALUES["s"] + 0 * stiff}
    inputs["a0"] = torch.tensor([1.0, 0.3, -0.2], dtype=F64) + torch.sin(torch.arange(3 * len(stiff), dtype=F64)
                                                                          ).view(-1, 3) / 4  # fmt: skip
    return model, inputs


@pytest.mark.parametrize(("sweeps", "options"), [(1, {}), (5, {}), (5, {"gas": True, "places": True})], ids=str)
def test_couplings(sweeps: int, options: dict[str, Any]) -> None:
    model, inputs = held_and_pulled(**options)
    assert_executed((model, model), dv.VBD(0.01, sweeps), 1, lambda model: inputs)


@pytest.mark.parametrize("sweeps", [1, 5])
def test_central_differences_with_couplings(sweeps: int) -> None:
    model, inputs = held_and_pulled(gas=True, places=True)
    assert_like_differences(run_of(model, dv.VBD(0.01, sweeps)), inputs, 0.01)


def test_rest_states_with_couplings() -> None:
    """Forces balance, those of a spring and a tendon from their definitions; gradients are those of differences."""
    end, route = (dv.Embedding.of_points(MESH, p) for p in ([[0.3, 0.1, 0.12]], [[0.28, 0.2, 0.1], [0.05, 0.2, 0.07]]))
    springs = dv.Springs(end, torch.tensor([[0.35, 0.3, 0.2]], dtype=F64), 900.0, 0.1)
    model = model_of(springs, dv.Tendons(route, [[0, 1]], 500.0, 0.2))
    law, x, solver = law_of(TEXT), model.rest_points, dv.VBD(1.0, 0, subspace="coarse")
    names = ("spring_stiffness", "spring_rest_length", "spring_points", "tendon_stiffness", "tendon_rest_length")
    inputs = {f"{e.name}_{k}": v for e in model.couplings for k, v in model.constants(e).items()}
    inputs = {name: inputs[name] for name in names} | {k: v.expand(model.num_tets) for k, v in law.values.items()}
    fibres = shape_gradients(x[model.tets])[0] @ (law.a0 / law.a0.norm())
    parameters = torch.stack([inputs[name] for name in law.density.parameters], -1)
    scalars = torch.cat([model.rest_scalars[0], fibres, parameters], -1)

    def energy(at: Tensor) -> Tensor:
        elastic = tets.energy(law.density, at[model.tets], scalars).sum()
        return elastic + coupling_energy(model, at, inputs) - (weight(model) * at).sum()

    options: Any = {"tolerance": 1e-10, "adjoint": dv.GlobalAdjoint(tolerance=1e-12)}
    rest = dv.equilibrium(model, x, solver, **options, **inputs).x
    assert float((rest - x).abs().max()) > 5e-3
    assert residual(model, energy, weight(model), rest) < 1e-8

    def loss(**given: Any) -> Tensor:
        return dv.equilibrium(model, rest, solver, **options, **given).x.square().sum()

    inputs = {name: inputs[name] for name in (*names, "mu", "k")}
    check = dv.check_gradients(loss, inputs, relative_steps=(1e-3, 1e-4), verbose=False)
    assert check.ok and all(size > 0 for _, size, *_ in check.rows), str(check)


def test_a_step_to_an_infinite_energy_is_not_taken() -> None:
    """The first whole Newton step stretches fibres until the exponential overflows."""
    model = coupled(law=law_of(TEXT))
    done = dv.equilibrium(model, model.rest_points, dv.VBD(1.0, 0))
    assert done.converged and float((done.x - model.rest_points).abs().max()) > 5e-3


def test_a_block_that_is_squeezed_to_a_fifth_keeps_its_tets() -> None:
    """With a logarithm of J; the built-in law, which has none, turns tets inside out (test_equilibrium_interface)."""
    mesh = dv.mesh.cube(4, size=0.2)
    y = torch.tensor(mesh.points[:, 1])
    model = dv.Model(mesh, pinned=(y < 1e-9) | (y > 0.2 - 1e-9), energies=(law_of(TEXT),))
    low = torch.where(model.pinned[:, None], model.rest_points * y.new_tensor([1.0, 0.2, 1.0]), torch.nan)
    done = dv.equilibrium(model, model.rest_points, dv.VBD(1.0, 0), prescribed=low)
    corners = done.x[torch.tensor(mesh.tets)]
    assert done.converged and bool((torch.linalg.det(corners[:, 1:] - corners[:, :1]) > 0).all())


@pytest.mark.hours  # other laws are compiled; all of their terms are in TEXT
@pytest.mark.parametrize("law", [
    dv.law("C10*(I1*J**(-2/3) - 3) + C01*(I2*J**(-4/3) - 3) + K/2*(J - 1)**2", C10=4e4, C01=1e4, K=4e5),
    dv.law(LOG + " + k1/(2*k2)*(exp(k2*(I4 - 1)**2) - 1)", mu=3e4, lam=1e5, k1=5e4, k2=2.0, a0=(1.0, 0.0, 0.0)),
], ids=["Mooney-Rivlin", "fibres"])  # fmt: skip
@pytest.mark.parametrize("sweeps", [1, 5])
def test_laws_of_the_guide(law: Any, sweeps: int) -> None:
    model = dv.Model(MESH, pinned=PINNED, energies=(law,))
    compare(model, dv.VBD(0.01, sweeps), inputs_of_law(model, 0.005))


def test_coarse_corrections() -> None:
    model = model_of()
    inputs = {k: v for k, v in inputs_of_law(model, 0.003).items() if k not in ("stress_free", "rest_points")}
    with dv.record("subspace") as lengths:
        compare(model, dv.VBD(0.01, 4, subspace="coarse"), inputs, 1e-10)
    assert any(float(length.max()) > 0 for length in lengths)


def test_coarse_corrections_know_of_stiff_fibres() -> None:
    """400 times as stiff as the rest: with coarse corrections eight sweeps are nearer than 20 without."""
    mesh = dv.mesh.box((13, 3, 3), (0.8, 0.1, 0.1))
    model = dv.Model(mesh, pinned=mesh.points[:, 0] == 0.0, energies=(law_of(TEXT),))
    x = model.rest_points

    def end(sweeps: int, subspace: Any) -> Tensor:
        solver = dv.VBD(1 / 60, sweeps, relaxation=1.0, subspace=subspace)
        return dv.step(model, x, torch.zeros_like(x), solver, k=4e6, a0=x.new_tensor([1.0, 0.0, 0.0]))[0]

    converged = end(300, "coarse")
    errors = [float((end(*way) - converged).norm() / (converged - x).norm()) for way in ((8, "coarse"), (20, None))]
    assert errors[0] < 0.1 * errors[1] and errors[1] > 1e-3


@pytest.mark.hours  # another law is compiled
def test_coarse_corrections_of_a_law_without_parameters() -> None:
    law = dv.law(
        "1.5e4*(I1 - 3) - 3e4*log(J) + 4e4*log(J)**2 + 2e4*(I4 - 1)**2 + 1e3*(I4 - 1 - log(J))", a0=(1.0, 0.5, 0.0)
    )
    model = dv.Model(MESH, pinned=PINNED, energies=(law,))
    inputs = {k: v for k, v in inputs_of_law(model, 0.003).items() if k not in ("stress_free", "rest_points")}
    compare(model, dv.VBD(0.01, 4, subspace="coarse"), inputs, 1e-10)


@pytest.mark.parametrize("integrator", [dv.SDIRK2(), dv.BDF2()], ids=repr)
def test_integrators(integrator: Any) -> None:
    """Gradients of a short rollout against central differences of it."""
    model = model_of()
    x, v = model.rest_points, torch.zeros_like(model.rest_points)
    solver = dv.VBD(0.01, 3, integrator=integrator)

    def height(mu: Tensor) -> Tensor:
        return dv.rollout(model, x, v, solver, steps=3, mu=mu).x[-1, :, 1].sum()

    mu = torch.tensor(4e4, dtype=F64, requires_grad=True)
    (grad,) = torch.autograd.grad(height(mu), mu)
    with torch.no_grad():
        slope = (height(mu + 1.0) - height(mu - 1.0)) / 2.0
    assert grad.abs() > 0 and relative_error(grad, slope) < 1e-6


def test_central_differences() -> None:
    """Of one sweep, along a random direction of each input."""
    model, solver = model_of(), dv.VBD(0.01, 1)
    inputs = inputs_of_law(model, 0.004)
    rng = torch.Generator().manual_seed(3)
    weight = torch.randn(inputs["x"].shape, generator=rng, dtype=F64)

    def loss(**given: Any) -> Tensor:
        return (weight * dv.step(model, given.pop("x"), given.pop("v"), solver, **given)[0]).sum()

    leaves = {name: value.clone().requires_grad_() for name, value in inputs.items()}
    gradients = dict(zip(leaves, torch.autograd.grad(loss(**leaves), list(leaves.values())), strict=True))
    for name, value in inputs.items():
        way = torch.randn(value.shape, generator=rng, dtype=F64) * value.nan_to_num().abs().mean()
        eps = 1e-5 if name in ("x", "v", "rest_points", "prescribed", "stress_free") else 1e-4
        with torch.no_grad():
            ends = [loss(**{**inputs, name: value + sign * eps * way}) for sign in (1, -1)]
        slope, found = (ends[0] - ends[1]) / (2 * eps), (gradients[name].nan_to_num() * way).sum()
        assert found.abs() > 0 and relative_error(found, slope) < 2e-6, name


def test_tapes_agree_and_updates_are_shortened() -> None:
    """Tapes bit for bit; no sweep raises the potential, at a violent state where whole Newton steps would."""
    model = model_of()
    inputs = inputs_of_law(model, 0.08)
    weight = torch.linspace(0, 1, inputs["x"].numel(), dtype=F64).view_as(inputs["x"])
    found = []
    for tape in ("full", "compact", "recompute"):
        leaves = {name: inputs[name].clone().requires_grad_() for name in ("x", "mu", "a0")}
        end, _ = dv.step(model, leaves["x"], inputs["v"], dv.VBD(0.01, 3, tape=tape), mu=leaves["mu"], a0=leaves["a0"])
        found.append(torch.autograd.grad((weight * end).sum(), list(leaves.values())))
    for other in found[1:]:
        for one, two in zip(found[0], other, strict=True):
            assert torch.equal(one, two)
    x, v = inputs["x"], inputs["v"]
    y = x + 0.01 * v + 1e-4 * torch.tensor([0, -9.81, 0], dtype=F64)
    y = torch.where(model.pinned[:, None], x, y)

    def potential(at: Tensor) -> Tensor:
        return reference.incremental_potential(model, at, y, None, None, 0.01)

    values = [potential(y)]
    for sweeps in range(1, 6):
        values.append(potential(dv.step(model, x, v, dv.VBD(0.01, sweeps, start="predictor"))[0]))
    assert bool((torch.stack(values).diff() <= 1e-12 * values[0].abs()).all())
    assert values[-1] < 0.9 * values[0]


def closed_form(a: float, b: float) -> tuple[float, float]:
    """First Piola-Kirchhoff stress of F = diag(a, b, b) with fibres along x."""
    g, j, i2 = VALUES, a * b * b, 2 * a * a * b * b + b**4

    def along(own: float, of_i2: float) -> float:
        log = g["mu"] * own + (g["lam"] * math.log(j) - g["mu"]) / own
        second = g["c"] * j ** (-4 / 3) * (of_i2 - 4 / 3 * i2 / own)
        return log + second + 2 * g["m"] * (a + 2 * b - 3)

    e = a * a - 1
    return along(a, 4 * a * b * b) + 2 * a * g["k"] * e * math.exp(g["s"] * e * e), along(b, 2 * b * (a * a + b * b))


def test_uniaxial_stretch_stays_under_its_closed_form_load() -> None:
    """A free block, stretched evenly and loaded on its faces by the stress of the closed form, does not move; with
    another load it does."""
    a, b = 1.15, 0.94
    model = model_of(pinned=None)
    x = model.rest_points * torch.tensor([a, b, b], dtype=F64)
    stress = torch.diag(torch.tensor([*closed_form(a, b), closed_form(a, b)[1]], dtype=F64))
    corners = model.rest_points[model.surface]
    area = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2
    load = torch.zeros_like(x)
    for corner in range(3):
        load.index_add_(0, model.surface[:, corner], area @ stress / 3)

    def moved(scale: float) -> float:
        end, _ = dv.step(model, x, torch.zeros_like(x), dv.VBD(0.01, 20), force=scale * load,
                         gravity=(0.0, 0.0, 0.0), a0=torch.tensor([1.0, 0.0, 0.0], dtype=F64))  # fmt: skip
        return float((end - x).abs().max())

    assert moved(1.0) < 1e-12 and moved(1.02) > 1e-5


def test_converged_routes_and_rest_states() -> None:
    """GlobalAdjoint agrees with the reverse sweep where the sweeps have converged; `equilibrium` finds the state in
    which steps come to rest, and its gradient is that of the state found again."""
    model = model_of()
    x, v = model.rest_points, torch.zeros_like(model.rest_points)
    grads = []
    for adjoint in (dv.ReverseSweep(), dv.GlobalAdjoint()):
        mu = torch.tensor(4e4, dtype=F64, requires_grad=True)
        end, _ = dv.step(model, x, v, dv.VBD(0.02, 400), mu=mu, adjoint=adjoint)
        grads.append(torch.autograd.grad(end[:, 1].sum(), mu)[0])
    assert grads[0].abs() > 0 and relative_error(grads[1], grads[0]) < 1e-7

    def sag(mu: Any) -> Tensor:
        return dv.equilibrium(model, x, dv.VBD(0.02, 1), mu=mu).x[:, 1].sum()

    mu = torch.tensor(4e4, dtype=F64, requires_grad=True)
    (grad,) = torch.autograd.grad(sag(mu), mu)
    with torch.no_grad():
        slope = (sag(mu + 10) - sag(mu - 10)) / 20
    assert grad.abs() > 0 and relative_error(grad, slope) < 1e-5
    stress = dv.stress(model, dv.equilibrium(model, x, dv.VBD(0.02, 1)).x)
    assert float(stress.von_mises.max()) > 0


def test_inputs_and_refusals() -> None:
    model = model_of()
    x, v, solver = model.rest_points, torch.zeros_like(model.rest_points), dv.VBD(0.01, 2)
    assert {"mu", "lam", "c", "m", "k", "s", "a0", "stress_free", "viscosity", "drag"} <= set(model.inputs)
    assert "young" not in model.inputs
    for name, value in (("young", 1e5), ("poisson", 0.3)):
        with pytest.raises(TypeError, match=f"{name}: expected an input of this Model .*which has no StableNeoHookean"):
            dv.step(model, x, v, solver, **{name: value})
    with pytest.raises(ValueError, match='block: expected "exact" with a law of your own'):
        dv.step(model, x, v, dv.VBD(0.01, 2, block="paper"))
    with pytest.raises(ValueError, match="k: expected finite values"):
        dv.step(model, x, v, solver, k=torch.tensor(float("nan"), dtype=F64))
    with pytest.raises(ValueError, match="law: expected parameters with a shear modulus at rest >= 0 Pa, got -"):
        dv.step(model, x, v, solver, mu=-1e6)
    with pytest.raises(ValueError, match="a0: expected directions of finite length > 0"):
        dv.step(model, x, v, solver, a0=torch.zeros(3, dtype=F64))
    assert "law(" in repr(model) and bool(dv.diagnose(model, x, solver).smallest_volume_ratio > 0.9)


def test_a_modulus_of_zero_is_given() -> None:
    """It is not taken for the law's own; in the reference, too."""
    model, solver = model_of(), dv.VBD(0.01, 2)
    inputs = inputs_of_law(model, 0.004)
    x, v = inputs["x"], inputs["v"]
    own, without = (dv.step(model, x, v, solver, **given)[0] for given in ({}, {"lam": 0.0}))
    assert float((own - without).abs().max()) > 1e-6
    for expected, given in ((own, {}), (without, {"lam": 0.0})):
        assert relative_error(reference.step(model, x, v, solver, **given)[0], expected) < 1e-12


@pytest.mark.hours
def test_the_built_in_law_as_a_law_of_ones_own() -> None:
    """A law that is quadratic in one vertex: values and gradients of StableNeoHookean, in float32 too; parameters that
    make it concave are refused."""
    own, built_in, solver = model_of(text=STABLE), dv.Model(MESH, pinned=PINNED), dv.VBD(0.01, 5)
    inputs = inputs_of_law(own, 0.03)
    results = [evaluate(lambda model=model, **given: dv.step(model, given.pop("x"), given.pop("v"), solver, **given),
                        inputs, 0.01) for model in (own, built_in)]  # fmt: skip
    for name, value in results[1].items():
        assert relative_error(results[0][name], value) < 1e-12, name
    single = [dv.step(model.to(dtype=torch.float32), inputs["x"].float(), inputs["v"].float(), solver, mu=4e4, lam=9e4)
              for model in (own, built_in)]  # fmt: skip
    assert relative_error(single[0][0], single[1][0]) < 1e-5
    with pytest.raises(ValueError, match="law: expected parameters that make the second derivative of .* by J >= 0"):
        dv.step(own, inputs["x"], inputs["v"], solver, lam=-5e4)
