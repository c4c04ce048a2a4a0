"""Claim: wrong arguments of springs, tendons and pressure raise, naming argument, expected and actual."""

import pickle
from typing import Any

import pytest
import torch
from helpers.coupled import coupled, hollow_box, inputs_of

import diffvbd as dv

ONE, TWO = dv.Embedding.of_vertices([0]), dv.Embedding.of_vertices([1, 2])
BOX = hollow_box()
CUBE = dv.mesh.cube(2, 0.1)
FACES = CUBE.surface
NAN = float("nan")


def model(energy: Any, mesh: dv.TetMesh = BOX) -> dv.Model:
    return dv.Model(mesh, energies=(dv.StableNeoHookean(), energy))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: dv.Springs([0], TWO, 1.0), "first: expected a diffvbd.Embedding, got list"),
        (lambda: dv.Springs(ONE, TWO, 1.0), r"second: expected 1 points, as many as first has, or .* got 2 points"),
        (lambda: dv.Springs(TWO, torch.zeros(3, 3), 1.0), r"second: expected 2 points, .* got shape \[3, 3\]"),
        (lambda: dv.Springs(ONE, torch.zeros(1, 3).requires_grad_(), 1.0), "second: .*pass spring_points= to a step"),
        (lambda: dv.Springs(ONE, torch.full((1, 3), NAN), 1.0), "second: expected finite numbers, got nan"),
        (lambda: dv.Springs(TWO, TWO, -1.0), "stiffness: expected numbers >= 0 N/m, got -1.0"),
        (lambda: dv.Springs(TWO, TWO, True), "stiffness: expected numbers, got True"),
        (lambda: dv.Springs(TWO, TWO, torch.ones(2) > 0), "stiffness: expected numbers, got tensor"),
        (lambda: dv.Springs(TWO, TWO, NAN), "stiffness: expected finite numbers, got nan"),
        (lambda: dv.Springs(TWO, TWO, torch.ones(3)), r"stiffness: expected a number or shape \[2\], one for each"),
        (lambda: dv.Springs(TWO, TWO, 1.0, "long"), "rest_length: expected numbers"),
        (lambda: dv.Springs(TWO, TWO, 1.0, tension_only=1), "tension_only: expected a bool"),
        (lambda: dv.Springs(TWO, TWO, torch.ones(2).requires_grad_()), "stiffness: .*spring_stiffness="),
        (lambda: dv.Springs(TWO, TWO, k=1.0), "k: expected an argument of dv.Springs"),
        (lambda: model(dv.Springs(dv.Embedding.of_vertices([999]), ONE, 1.0)), r"first: expected vertices in \[0, "),
        (lambda: model(dv.Springs(ONE, dv.Embedding.of_vertices([999]), 1.0)), r"second: expected vertices in \[0, "),
        (lambda: dv.Tendons(TWO, [], 1.0, 1.0), "routes: expected a list of lists of points"),
        (lambda: dv.Tendons(TWO, [[0]], 1.0, 1.0), r"routes\[0\]: expected at least two points, got 1"),
        (lambda: dv.Tendons(TWO, [[0, 1], [0, 2]], 1.0, 1.0), r"routes\[1\]: expected indices in \[0, 2\), got 0..2"),
        (lambda: dv.Tendons(TWO, [[0, 1.5]], 1.0, 1.0), r"routes\[0\]: expected integers"),
        (lambda: dv.Tendons(TWO, [[0, 1]], 1.0, torch.ones(2)), r"rest_length: .*shape \[1\], one for each tendon"),
        (lambda: dv.Pressure(pressure=NAN), "pressure: expected finite numbers"),
        (lambda: dv.Pressure(gas=True, ambient=-1.0), "ambient: expected a finite number >= 0 Pa, got -1.0"),
        (lambda: dv.Pressure([]), r"triangles: expected shape \[\*, 3\], got \[0\]"),
        (lambda: dv.Pressure(pressure=-2e5, gas=True), "pressure: expected numbers >= -101325 Pa, got"),
        (lambda: dv.Pressure([[0, 1]]), r"triangles: expected shape \[\*, 3\]"),
        (lambda: model(dv.Pressure(), CUBE), "triangles: expected closed surfaces, or a mesh with cavities, got"),
        (lambda: model(dv.Pressure(FACES[1:]), CUBE), r"triangles: expected a closed .* open edge \(\d+, \d+\)"),
        (lambda: model(dv.Pressure([FACES, FACES[1:]]), CUBE), r"triangles\[1\]: expected a closed surface, got an"),
        (lambda: model(dv.Pressure([*FACES[:-1].tolist(), FACES[-1][::-1].tolist()]), CUBE), "triangles: .* alike"),
        (lambda: model(dv.Pressure(FACES + 100), CUBE), r"triangles: expected vertices in \[0, 8\), got 100..107"),
        (lambda: model(dv.Pressure([[0, 1, 2], [2, 1, 0]]), CUBE), "triangles: expected a surface that encloses"),
        (lambda: model(dv.Pressure(pressure=torch.ones(2))), r"pressure: .*shape \[1\], one for each cavity"),
        (lambda: dv.Model(BOX, energies=(dv.Pressure(), dv.Pressure())), "energies: expected one Pressure"),
    ],
)  # fmt: skip
def test_constructors_name_what_is_wrong(make, message: str) -> None:
    with pytest.raises((ValueError, TypeError), match=message):
        make()


SCENE = coupled(places=True)
SOLVER = dv.VBD(0.01, 2)


@pytest.mark.parametrize(
    ("inputs", "message"),
    [
        ({"spring_stiffness": torch.ones(3, dtype=torch.float64)}, "spring_stiffness: expected a shape that"),
        ({"spring_stiffness": torch.ones(2)}, "spring_stiffness: expected dtype torch.float64"),
        ({"spring_stiffness": -1.0}, r"spring_stiffness: expected finite numbers >= 0, got -1"),
        ({"spring_rest_length": NAN}, "spring_rest_length: expected finite numbers >= 0, got nan"),
        ({"spring_points": torch.full((2, 3), NAN, dtype=torch.float64)}, "spring_points: expected finite numbers"),
        ({"tendon_rest_length": "short"}, "tendon_rest_length: expected a number or a tensor"),
        ({"pressure": torch.zeros(4, dtype=torch.float64)}, "pressure: expected a shape that broadcasts"),
        ({"pressures": 1.0}, "pressures: expected an input of this Model .* is 'pressure' meant"),
        ({"tendon_length": 1.0}, "tendon_length: .* is 'tendon_rest_length' meant"),
        ({"anchor_stiffness": 1.0}, "anchor_stiffness: .* has no Anchor among its energies"),
    ],
)  # fmt: skip
def test_steps_name_what_is_wrong(inputs: dict[str, Any], message: str) -> None:
    x = SCENE.rest_points
    with pytest.raises((ValueError, TypeError), match=message):
        dv.step(SCENE, x, torch.zeros_like(x), SOLVER, mu=1e4, lam=1e4, **inputs)


def test_gas_that_is_pressed_through_nothing_is_named() -> None:
    box = model(dv.Pressure(gas=True))
    x = box.rest_points
    with pytest.raises(ValueError, match=r"x: expected cavities of positive volume .*, got -.* of scene 0 \(in step"):
        dv.rollout(box, x, -60 * (x - 0.15), dv.VBD(0.02, 20), steps=5, mu=1e3, lam=1e3)


def test_what_was_given_may_change_later() -> None:
    stiffness, places = torch.full((2,), 10.0, dtype=torch.float64), torch.zeros(2, 3, dtype=torch.float64)
    springs = dv.Springs(TWO, places, stiffness)
    stiffness.mul_(-1)
    places.fill_(NAN)
    assert springs.stiffness.tolist() == [10.0, 10.0] and not springs.points.any()


def test_models_without_couplings_say_so() -> None:
    bare = dv.Model(CUBE)
    x = bare.rest_points
    with pytest.raises(TypeError, match="spring_stiffness: .*which has no Springs among its energies"):
        dv.step(bare, x, torch.zeros_like(x), SOLVER, mu=1e4, lam=1e4, spring_stiffness=1.0)
    with pytest.raises(ValueError, match="model: expected Springs, Tendons or Pressure among its energies, got none"):
        dv.coupling_forces(bare, x)


def test_what_a_bound_has_not_is_refused() -> None:
    """A finer mesh has other vertices."""
    x = SCENE.rest_points
    with pytest.raises(NotImplementedError, match="errors: the error of a step with springs, tendons or pressure"):
        dv.rollout(SCENE, x, torch.zeros_like(x), SOLVER, steps=1, mu=1e4, lam=1e4, checks=dv.Checks(errors=True))


def test_results_are_printed_by_their_shapes() -> None:
    of = model(dv.Springs(TWO, TWO, 1.0))
    found = repr(dv.coupling_forces(of, of.rest_points))
    assert found == f"CouplingForces(springs of shape [2, 3], vertices of shape [{of.num_vertices}, 3])"


def test_inputs_are_declared_and_models_are_copied() -> None:
    names = {"spring_stiffness", "spring_rest_length", "spring_points", "tendon_stiffness", "tendon_rest_length",
             "pressure"}  # fmt: skip
    assert names <= set(SCENE.inputs) and "anchor_stiffness" not in SCENE.inputs
    assert "spring_points" not in coupled().inputs and SCENE.inputs["spring_points"].shape == "[..., 2, 3]"
    values = inputs_of(SCENE)
    x, _ = dv.step(SCENE, solver=SOLVER, **values)
    copies = (pickle.loads(pickle.dumps(SCENE)), SCENE.to("cpu"), SCENE.replace(density=1000.0))
    for copy in copies:
        assert torch.equal(dv.step(copy, solver=SOLVER, **values)[0], x)
    assert torch.equal(dv.step(SCENE.to(dtype=torch.float32).to(dtype=torch.float64), solver=SOLVER, **values)[0], x)


def test_cavities_are_the_inner_surfaces() -> None:
    two = dv.mesh.join([BOX, BOX.translate((1, 0, 0)), CUBE.translate((2, 0, 0))])
    found = dv.mesh.cavities(two)
    assert [len(part) for part in found] == [12, 12] and dv.mesh.cavities(CUBE) == []
    state = dv.coupling_forces(model(dv.Pressure(), two), torch.from_numpy(two.points.copy()))
    assert state.volume is not None and torch.allclose(state.volume, torch.full((2,), 1e-3, dtype=torch.float64))
    turned = model(dv.Pressure([part[:, ::-1] for part in found]), two)
    again = dv.coupling_forces(turned, torch.from_numpy(two.points.copy()))
    assert again.volume is not None and torch.equal(again.volume, state.volume)
