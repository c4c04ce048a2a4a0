"""Claim: each two bodies, colliders and floors may have their own friction, differentiated like one number."""

import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from conftest import DEVICES

import diffvbd as dv
from diffvbd.testing import relative_error, tolerance
from diffvbd.testing.contact_scenes import SCENES, Scene, compiled, unrolled

GRAVITY = 9.81


def matrix(n: int) -> torch.Tensor:
    return torch.linspace(0.2, 0.7, n * n, dtype=torch.float64).reshape(n, n)


def with_matrix(name: str) -> Scene:
    scene = SCENES[name]()
    model = scene.model
    mu = matrix(model.mesh.num_bodies + len(model.colliders) + (model.floor is not None))
    energies = [replace(e, coefficient=mu) if isinstance(e, dv.Friction) else e for e in model.energies]
    return replace(scene, model=model.replace(energies=energies), parameters={**scene.parameters, "friction": mu})


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("name", ("obstacles", "stacked", "batched"))
def test_gradients_are_those_of_the_executed_step(name: str, device: str) -> None:
    scene = with_matrix(name)
    solver = scene.solver(5, tape="full")
    found, substeps = compiled(scene, 1, solver, scene.model.to(device))
    expected = unrolled(scene, 1, solver, substeps)
    assert expected["grad_friction"].abs().max() > 0
    for key, value in expected.items():
        bar = tolerance("contact_adjoint" if key.startswith("grad_") else "contact_forward")
        assert relative_error(found[key], value) <= bar, key


def test_a_matrix_of_one_number_is_that_number_to_the_bit() -> None:
    scene = SCENES["obstacles"]()
    model = scene.model
    same = [replace(e, coefficient=torch.full((5, 5), 0.5)) if isinstance(e, dv.Friction) else e
            for e in model.energies]  # fmt: skip
    inputs: dict[str, Any] = {**scene.inputs, **scene.parameters, "solver": scene.solver(5)}
    inputs.pop("friction")
    ends = [dv.step(m, scene.x, scene.v, **inputs) for m in (model, model.replace(energies=same))]
    assert all(torch.equal(one, two) for one, two in zip(*ends, strict=True))


@pytest.mark.parametrize("surface", ("floor", "plane"))
def test_rubber_stops_before_steel(surface: str) -> None:
    """Two blocks slide over one ground: each stops after v^2 / (2 mu g), less the v h / 2 of implicit Euler."""
    box = dv.mesh.box((3, 2, 3), (0.2, 0.1, 0.2), split="kuhn")
    mu, h, speed = (0.2, 0.5), 1 / 100, 1.0
    table = torch.tensor([[0.0, 9.0, mu[0]], [9.0, 0.0, mu[1]], [mu[0], mu[1], 0.0]])
    ground: dict[str, Any] = {"energies": (dv.StableNeoHookean(), dv.FloorBarrier(kappa=1e4, dhat=0.01))}
    if surface == "plane":
        ground = {"energies": (dv.StableNeoHookean(), dv.PairBarrier(kappa=1e4, dhat=0.01, self_contact=False)),
                  "colliders": (dv.colliders.Plane(),)}  # fmt: skip
    ground["energies"] += (dv.Friction(table),)
    # at rest 18 vertices bear the weight: the gap at which the barrier's force is that
    model = dv.Model(dv.mesh.join([box, box.translate((0.0, 0.0, 1.0))]).translate((0.0, 0.008, 0.0)), **ground)
    x, solver = model.rest_points, dv.VBD(h, 20)
    for _ in range(40):
        x, _ = dv.step(model, x, torch.zeros_like(x), solver, mu=1e5, lam=2e5, friction=0 * table.double())
    v = torch.zeros_like(x)
    v[:, 0] = speed
    start, n = x.clone(), len(x) // 2
    for _ in range(math.ceil(speed / (min(mu) * GRAVITY) / h) + 5):
        x, v = dv.step(model, x, v, solver, mu=1e5, lam=2e5)
    gone = [float((x - start)[part, 0].mean()) for part in (slice(n), slice(n, None))]
    for way, own in zip(gone, mu, strict=True):
        assert way == pytest.approx(speed**2 / (2 * own * GRAVITY) - speed * h / 2, rel=0.03)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("shape", ((), (1,), (5,), (5, 1), (1, 5)))
def test_a_smaller_input_is_the_matrix_that_it_broadcasts_to(shape: tuple[int, ...], device: str) -> None:
    scene = with_matrix("obstacles")
    model, inputs = scene.model.to(device), {**scene.inputs, **scene.parameters, "solver": scene.solver(3)}
    small = torch.linspace(0.2, 0.7, math.prod(shape), dtype=torch.float64).reshape(shape)
    ends, slopes = [], []
    for given in (small, small.expand(5, 5).clone()):
        inputs["friction"] = friction = given.to(device).requires_grad_()
        on = {k: t.to(device) if isinstance(t, torch.Tensor) and k != "friction" else t for k, t in inputs.items()}
        x, _ = dv.step(model, scene.x.to(device), scene.v.to(device), **on)
        ends.append(x)
        slopes.append(torch.autograd.grad(x.square().sum(), friction)[0])
    assert torch.equal(*ends) and slopes[0].shape == shape and slopes[1].abs().max() > 0
    assert relative_error(slopes[0], slopes[1].sum_to_size(shape)) <= tolerance("sum")


def test_each_scene_may_have_one_number() -> None:
    scene = with_matrix("batched")
    model, count = scene.model, len(scene.x)
    n = len(scene.parameters["friction"])
    inputs: dict[str, Any] = {**scene.inputs, **scene.parameters, "solver": scene.solver(3)}
    each = torch.linspace(0.1, 0.6, count, dtype=torch.float64).reshape(count, 1, 1)
    ends = [dv.step(model, scene.x, scene.v, **{**inputs, "friction": f}) for f in (each, each.expand(count, n, n))]
    assert all(torch.equal(one, two) for one, two in zip(*ends, strict=True))


def test_a_matrix_is_copied_in_float64() -> None:
    given = matrix(3)
    energy = dv.Friction(given)
    given.fill_(-1.0)
    assert torch.equal(energy.coefficient, matrix(3))
    assert torch.equal(dv.Friction(matrix(3).tolist()).coefficient, matrix(3))
    assert torch.equal(dv.Friction(matrix(3).numpy()).coefficient, matrix(3))


@pytest.mark.parametrize(
    ("coefficient", "got"),
    (
        ([[0.1, 0.2], [0.3]], "list"),
        ([["a", "b"], ["c", "d"]], "list"),
        ([[1j, 0.0], [0.0, 0.0]], "list"),
        (torch.ones(2, 2, dtype=torch.complex64), "complex64"),
        (torch.ones(2, 2, dtype=torch.bool), "bool"),
        (torch.ones(2, 2).to_sparse(), "sparse"),
        (torch.ones(2, 2, requires_grad=True), "pass friction="),
        ([[torch.tensor(0.1, requires_grad=True)]], "require grad"),
    ),
)
def test_what_is_no_matrix_of_real_numbers_is_refused(coefficient: Any, got: str) -> None:
    with pytest.raises(TypeError, match=f"coefficient: expected .*{got}"):
        dv.Friction(coefficient)


def test_transforms_are_refused_in_words() -> None:
    scene = with_matrix("obstacles")
    inputs: dict[str, Any] = {**scene.inputs, **scene.parameters, "solver": scene.solver(2)}
    both = torch.stack([inputs.pop("friction")] * 2)
    with pytest.raises(NotImplementedError, match="contact are not supported"):
        torch.func.vmap(lambda friction: dv.step(scene.model, scene.x, scene.v, friction=friction, **inputs)[0])(both)


def test_wrong_matrices_are_named() -> None:
    with pytest.raises(ValueError, match="coefficient: expected a number or a matrix"):
        dv.Friction([0.1, 0.2])
    with pytest.raises(ValueError, match="coefficient: expected finite numbers >= 0, got -1"):
        dv.Friction([[0.0, -1.0], [0.0, 0.0]])
    energies = (dv.StableNeoHookean(), dv.FloorBarrier(), dv.Friction(torch.ones(3, 3)))
    with pytest.raises(ValueError, match=r"coefficient: expected a matrix \[2, 2\] of 1 bodies, 0 colliders and a flo"):
        dv.Model(dv.mesh.cube(), energies=energies)
