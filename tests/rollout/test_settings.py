"""What a solver is refused for, and the number of its steps over a duration."""

import dataclasses
import math
import re

import pytest
import torch

import diffvbd as dv
from diffvbd.testing import debug_checks

MATERIAL = {"mu": 1e5, "lam": 1e5}


@pytest.mark.parametrize(
    ("given", "error", "text"),
    [
        ({}, TypeError, "steps: expected either steps or duration, got neither"),
        ({"steps": 2, "duration": 1.0}, TypeError, "steps: expected either steps or duration, got both"),
        ({"duration": -1.0}, ValueError, "duration: expected"),
        ({"solver": 0.01, "steps": 2}, TypeError, "solver: expected"),
        ({"steps": 2, "sweeps": 3}, TypeError, "sweeps: expected an input of this Model"),
        ({"steps": 2, "floor_kapa": 3.0}, TypeError, "floor_kapa: expected .*no FloorBarrier|is 'floor_kappa' meant"),
        ({"steps": 2, "pair_kappa": 3.0}, TypeError, "pair_kappa: expected .*which has no PairBarrier"),
        ({"steps": 2, "checks": True}, TypeError, "checks: expected a diffvbd.Checks"),
    ],
)
def test_what_does_not_go_together_raises(given, error, text) -> None:
    model = dv.Model(dv.mesh.cube(), pinned=[0])
    x = model.rest_points
    with pytest.raises(error, match=text):
        dv.rollout(model, x, 0 * x, **{"solver": dv.VBD(0.01, 5), **MATERIAL, **given})


@pytest.mark.parametrize(
    ("given", "error", "text"),
    [
        ({"time_step": 0.0}, ValueError, "time_step: expected"),
        ({"sweeps": -1}, ValueError, "sweeps: expected"),
        ({"integrator": dv.SDIRK2}, ValueError, "integrator: expected an object"),
        ({"tape": "some"}, ValueError, "tape: expected"),
        ({"block": "other"}, ValueError, "block: expected"),
        ({"start": "rest"}, ValueError, "start: expected"),
        ({"relaxation": 2.0}, ValueError, "relaxation: expected a number in"),
        ({"relaxation": None}, TypeError, "relaxation: expected a number, got NoneType"),
        ({"subspace": "yes"}, TypeError, "subspace: expected"),
        ({"subspace": "coarse", "block": "paper"}, ValueError, "subspace: expected no coarse space"),
        ({"subspace": "coarse", "saturation": 0.1}, ValueError, "subspace: expected no coarse space"),
        ({"saturation": -1.0}, ValueError, "saturation: expected"),
        ({"regularization": -1.0}, ValueError, "regularization: expected"),
    ],
)
def test_a_solver_is_checked_where_it_is_made(given, error, text) -> None:
    with pytest.raises(error, match=text):
        dv.VBD(**{"time_step": 0.01, "sweeps": 5} | given)


FLOOR = (dv.StableNeoHookean(), dv.FloorBarrier(height=-1.0, kappa=1e3, dhat=0.02))


@pytest.mark.parametrize(
    ("call", "name", "where"),
    [
        ("Model", "time_step", "got an argument of dv.VBD"),
        ("Model", "relaxation", "got an argument of dv.VBD"),
        ("Model", "mu", "got an input of dv.step and dv.rollout"),
        ("Model", "densty", "is 'density' meant"),
        ("VBD", "coarse", 'it is dv.VBD(subspace="coarse") now'),
        ("VBD", "gravity", "got an input of dv.step and dv.rollout"),
        ("VBD", "detections", "got an argument of dv.PairBarrier"),
        ("Checks", "estimate_errors", "it is dv.Checks(errors=True) now"),
        ("memory", "sweeps", "got an argument of dv.VBD"),
        ("step", "steps", "got an argument of dv.rollout"),
        ("step", "settings", "it is a dv.VBD, the argument solver now"),
        ("step", "floor_barrier.height", "is 'floor_height' meant"),
        ("rollout", "time_step", "got an argument of dv.VBD"),
        ("rollout", "parameters", "it is an input of its own for each parameter, as floor_kappa= now"),
        ("rollout", "check_start", "it is dv.Checks(start=) now"),
        ("rollout", "stepss", "is 'steps' meant"),
        ("solve", "coarse", 'it is dv.VBD(subspace="coarse") now'),
        ("advise", "sweeps", "got an argument of dv.VBD"),
    ],
)
def test_a_name_that_a_call_does_not_have_raises_and_says_what_has_it(call: str, name: str, where: str) -> None:
    model, solver = dv.Model(dv.mesh.cube(), energies=FLOOR), dv.VBD(0.01, 5)
    state = (model.rest_points, torch.zeros_like(model.rest_points))
    calls = {
        "Model": lambda **given: dv.Model(model.mesh, **given),
        "VBD": lambda **given: dv.VBD(0.01, 5, **given),
        "Checks": dv.Checks,
        "memory": lambda **given: dv.memory(model, solver, **given),
        "step": lambda **given: dv.step(model, *state, solver, **MATERIAL, **given),
        "rollout": lambda **given: dv.rollout(model, *state, solver, steps=1, **MATERIAL, **given),
        "solve": lambda **given: dv.solve(model, *state, solver, **MATERIAL, **given),
        "advise": lambda **given: dv.advise(model, *state, duration=0.1, **MATERIAL, **given),
    }
    with pytest.raises(TypeError, match=rf"^{re.escape(name)}: expected an (argument|input) of .*{re.escape(where)}"):
        calls[call](**{name: 1})


@pytest.mark.parametrize(
    ("call", "error", "text"),
    [
        (lambda m, x: dv.rollout(None, x, x, dv.VBD(0.01, 5), steps=1), TypeError, "model: expected a diffvbd.Model"),
        (lambda m, x: dv.step(m, x, 0 * x, dv.VBD(0.01, 5), floor_height=math.nan, **MATERIAL), ValueError,
         "floor_height: expected finite values, got nan"),
        (lambda m, x: dv.step(m, x, 0 * x, dv.VBD(0.01, 5), floor_kappa=-1.0, **MATERIAL), ValueError,
         "floor_kappa: expected >= 0 N/m, got -1 at"),
        (lambda m, x: dv.step(m, x, 0 * x, dv.VBD(0.01, 5), floor_normal=0 * x[0], **MATERIAL), ValueError,
         "floor_normal: expected normals of finite length > 0"),
        (lambda m, x: dv.contact.forces(m, x, floor_height=math.nan), ValueError, "floor_height: expected finite"),
        (lambda m, x: dv.advise(m, x, 0 * x, duration=0.1, progress=3, **MATERIAL), TypeError,
         "progress: expected a bool, got int"),
        (lambda m, x: dv.memory(m, dv.VBD(0.01, 5), save="first"), ValueError, 'save: expected "all", "last"'),
        (lambda m, x: debug_checks("no").__enter__(), TypeError, "enabled: expected a bool, got str"),
        (lambda m, x: dv.VBD(0.01, 5, prediction=3), TypeError, "prediction: expected None, got int"),
        (lambda m, x: dv.Model(m.mesh, energies=(dv.StableNeoHookean,)), TypeError, "got the class StableNeoHookean"),
        (lambda m, x: dv.StableNeoHookean(mu=1.0), TypeError, r"mu: .*\(patches\), got an input of dv.step"),
        (lambda m, x: dv.FloorBarrier(heigth=1.0), TypeError, "heigth: .*dv.FloorBarrier .*: is 'height' meant"),
        (lambda m, x: dv.Anchor(stifness=1.0), TypeError, "stifness: .*dv.Anchor .*: is 'stiffness' meant"),
        (lambda m, x: dv.PairBarrier(pair_dhat=0.1), TypeError, "pair_dhat: .*dv.PairBarrier .*: is 'dhat' meant"),
        (lambda m, x: dv.Friction(coeficient=0.1), TypeError, "coeficient: .*: is 'coefficient' meant"),
        (lambda m, x: dv.CoarseSpace(function=8), TypeError, "function: .*dv.CoarseSpace .*: is 'functions' meant"),
        (lambda m, x: dv.GlobalAdjoint(tolerence=0.1), TypeError, "tolerence: .*: is 'tolerance' meant"),
        (lambda m, x: dv.ReverseSweep(tape="full"), TypeError, "tape: .*dv.ReverseSweep .*, got an argument of dv.VBD"),
    ],
)  # fmt: skip
def test_bad_values_raise_by_the_name_of_their_argument(call, error, text) -> None:
    model = dv.Model(dv.mesh.cube(), energies=FLOOR)
    with pytest.raises(error, match=text):
        call(model, model.rest_points)


@pytest.mark.parametrize("duration", [0.0, -1.0, float("nan"), float("inf"), "1", None])
def test_steps_of_what_is_no_duration_raise(duration) -> None:
    with pytest.raises((ValueError, TypeError), match="duration: expected"):
        dv.VBD(0.01, 5).steps(duration)


def test_a_duration_is_equal_steps_of_at_most_the_time_step() -> None:
    model = dv.Model(dv.mesh.cube(), pinned=[0])
    x, solver = model.rest_points, dv.VBD(0.04, 5)
    found = dv.rollout(model, x, 0 * x, solver, duration=0.1, **MATERIAL)
    same = dv.rollout(model, x, 0 * x, dataclasses.replace(solver, time_step=0.1 / 3), steps=3, **MATERIAL)
    assert torch.equal(found.x, same.x) and found.steps == [0, 1, 2, 3]


def test_inputs_print_as_a_table() -> None:
    energies = (dv.StableNeoHookean(), dv.FloorBarrier(height=(0.0, 1.0)), dv.Anchor(2.0))
    inputs = dv.Model(dv.mesh.cube(), energies=energies).inputs
    assert inputs["floor_height"].shape == "[..., 2]" and inputs["floor_height"].unit == "m"
    assert inputs["floor_kappa"].source == "FloorBarrier" and {"mu", "young", "anchor_points"} <= set(inputs)
    assert len(str(inputs).splitlines()) == len(inputs) + 1
    assert "mu" not in dv.Model(dv.mesh.cube(), energies=dv.Anchor(1.0)).inputs
