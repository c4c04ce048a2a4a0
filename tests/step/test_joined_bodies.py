"""Claim: coarse corrections move bodies that couplings join by one another, so that few sweeps do; where sweeps do not,
a rollout says so."""

import warnings

import numpy as np
import pytest
import torch
from helpers.coupled import coupled, inputs_of
from helpers.executed import assert_executed
from torch import Tensor

import diffvbd as dv
from diffvbd.testing.soft_scenes import finger, finger_on_palm, hollow_finger

MATERIAL = {"young": 3e5, "poisson": 0.35}


@pytest.fixture(scope="module")
def rest() -> Tensor:
    model, _ = finger_on_palm()
    return dv.equilibrium(model, model.rest_points, dv.VBD(1.0, 0, subspace="coarse"), **MATERIAL).x


def run(sweeps: int, start: Tensor, subspace: str = "coarse") -> Tensor:
    """Heights of the tip [m] over 0.2 s."""
    model, tip = finger_on_palm()
    motion = dv.rollout(model, start, torch.zeros_like(start), dv.VBD(0.02, sweeps, subspace=subspace), steps=10,
                        **MATERIAL)  # fmt: skip
    return tip.at(motion.x)[:, 0, 1]


def test_a_finger_on_a_palm_stays_at_rest(rest: Tensor) -> None:
    height = run(60, rest)
    assert abs(float(height[0]) - 6.872e-3) < 1e-6
    torch.testing.assert_close(height, height[:1].expand_as(height), rtol=0, atol=2e-6)


def test_few_sweeps_move_it_as_many_do() -> None:
    model, _ = finger_on_palm()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        many, few = run(200, model.rest_points), run(60, model.rest_points)
    assert float(many.max() - many.min()) > 5e-3
    torch.testing.assert_close(few, many, rtol=0, atol=1e-6)


def test_sweeps_that_do_not_do_are_warned_of(rest: Tensor) -> None:
    with pytest.warns(UserWarning, match='sweeps: they leave steps unsolved, worst in body 1.*subspace="coarse"'):
        height = run(60, rest, "rigid")
    assert float(height[-1]) < 0  # of the body alone a solve would see 2e-7 m a step


@pytest.mark.parametrize("stiffness", [5e3, 5e5])
def test_a_joint_of_any_stiffness_takes_ten_sweeps(stiffness: float) -> None:
    """Two beams that springs join face to face, up to 100 times as stiff as a vertex, swing as one that is whole."""
    half = dv.mesh.beam(7, 3, 3, size=(0.3, 0.1, 0.1))
    mesh, one = dv.mesh.join([half, half.translate((0.3, 0, 0))]), dv.mesh.beam(13, 3, 3, size=(0.6, 0.1, 0.1))
    at = np.flatnonzero(abs(mesh.points[:, 0] - 0.3) < 1e-9)
    sides = [dv.Embedding.of_vertices(at[(at >= half.num_vertices) == side]) for side in (False, True)]
    heights = []
    for tets, sweeps, energies in ((one, 100, ()), (mesh, 10, (dv.Springs(*sides, stiffness=stiffness),))):
        model = dv.Model(tets, pinned=tets.points[:, 0] < 1e-9, energies=(dv.StableNeoHookean(), *energies))
        x = model.rest_points
        motion = dv.rollout(model, x, torch.zeros_like(x), dv.VBD(0.01, sweeps, subspace="coarse"), steps=60,
                            young=1e5, poisson=0.3)  # fmt: skip
        heights.append(motion.x[:, x[:, 0] > 0.599, 1].mean(1))
    swing = float(heights[0].max() - heights[0].min())
    assert swing > 0.5
    assert float((heights[1] - heights[0]).abs().max()) < 0.005 * swing


def test_tendons_and_gas_of_any_stiffness_take_few_sweeps() -> None:
    stiff = finger((16, 4, 4), (0.1, 0.02, 0.02), 6, 2000.0)
    gas = hollow_finger()
    still = {"gravity": (0.0, 0.0, 0.0), "poisson": 0.4}
    for model, inputs in (
        (stiff, {"young": 1e5, "tendon_rest_length": 0.0998}),
        (gas, {"young": 3e4, "pressure": 1e4}),
    ):
        x = model.rest_points
        few, many = (dv.rollout(model, x, torch.zeros_like(x), dv.VBD(0.01, k, subspace="coarse"), steps=5, save="last",
                                **inputs, **still).x[-1] for k in (40, 320))  # fmt: skip
        assert float((many - x).abs().max()) > 2e-4
        assert float((few - many).norm()) < 0.05 * float((many - x).norm())


def test_a_cable_that_becomes_taut_shortens_a_correction(device: str) -> None:
    """Gradients are those of the executed sweeps, with lengths of corrections that couplings alone ask for."""
    models = [coupled(tension_only=True, pinned=False, device=d) for d in ("cpu", device)]

    def inputs(model: dv.Model) -> dict[str, Tensor]:
        values, thrown = inputs_of(model), torch.arange(model.num_vertices)[:, None] >= 64
        given = {"v": thrown * torch.tensor([-128.0, 93.0, 133.0]),
                 "spring_stiffness": torch.tensor([55772.0, 485119.0]),
                 "spring_rest_length": torch.tensor([0.35, 0.13]), "tendon_stiffness": torch.tensor([10198.0, 324.0]),
                 "tendon_rest_length": torch.tensor([0.36, 0.35])}  # fmt: skip
        return values | {name: value.to(values["v"]) for name, value in given.items()}

    solver = dv.VBD(0.01, 5, subspace="coarse")
    assert_executed((models[0], models[1]), solver, 1, inputs)
    values = inputs(models[1])
    with dv.record("subspace") as lengths:
        dv.step(models[1], values.pop("x"), values.pop("v"), solver, **values)
    assert lengths[0].flatten().tolist() == [1.0, 0.5]


def test_groups_of_joined_bodies_are_each_by_itself() -> None:
    """Three pairs of cubes in one mesh move as each pair alone."""
    cube = dv.mesh.cube(3, size=0.1)

    def pairs(count: int) -> dv.Model:
        cubes = [cube.translate((0.12 * side, 0.3 * n, 0)) for n in range(count) for side in (0, 1)]
        mesh = dv.mesh.join(cubes)
        at = [
            [x, 0.3 * n + y, z] for n in range(count) for y in (0.02, 0.08) for z in (0.02, 0.08) for x in (0.1, 0.12)
        ]
        one, two = (dv.Embedding.of_points(mesh, at[side::2]) for side in (0, 1))
        return dv.Model(
            mesh, pinned=mesh.points[:, 0] < 1e-9, energies=(dv.StableNeoHookean(), dv.Springs(one, two, 3e3))
        )

    ends = []
    for count in (1, 3):
        model = pairs(count)
        x = model.rest_points
        v = torch.zeros_like(x)
        v[-27:, 1] = 1.0  # only the last pair is different from the others
        ends.append(dv.rollout(model, x, v, dv.VBD(0.01, 8, subspace="coarse"), steps=5, young=1e5, poisson=0.3).x[-1])
    torch.testing.assert_close(ends[1][-54:] - ends[0].new_tensor([0.0, 0.6, 0.0]), ends[0], rtol=0, atol=1e-13)


def test_too_many_functions_of_joined_bodies_are_refused() -> None:
    cube, count = dv.mesh.cube(3, size=0.1), 20
    mesh = dv.mesh.join([cube.translate((0.12 * n, 0, 0)) for n in range(count)])
    ends = [dv.Embedding.of_vertices([27 * n + corner for n in range(count - 1)]) for corner in (26, 27)]
    model = dv.Model(mesh, energies=(dv.StableNeoHookean(), dv.Springs(*ends, stiffness=100.0)))
    x = model.rest_points
    dv.step(model, x, torch.zeros_like(x), dv.VBD(0.01, 4, subspace="coarse"), young=1e5, poisson=0.3)
    with pytest.raises(ValueError, match="subspace: expected at most 512 functions of bodies that springs or tendons"):
        dv.step(model, x, torch.zeros_like(x), dv.VBD(0.01, 4, subspace=dv.CoarseSpace(27)), young=1e5, poisson=0.3)
