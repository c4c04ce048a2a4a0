"""Claim: the reference's coarse correction is a projected Newton step, of a length that lowers the potential, and is
differentiated as executed.

Two boxes, one of them pinned, above a floor; functions and groups as a Model's coarse space has them.
"""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from helpers.marks import slow
from torch import Tensor

import diffvbd as dv
from diffvbd import reference
from diffvbd.model.coarse import CoarseSpace, build_coarse
from diffvbd.model.system import system_of
from diffvbd.reference import coarse, sweep
from diffvbd.reference.scene import build_layout, build_scene
from diffvbd.testing import generator, relative_error, structured, tolerance

NAMES = ("tets", "rest_points", "density", "pinned", "color_ptr", "color_vertices", "energies", "saturation")
NAMES += ("regularization", "relaxation", "block", "rigid", "starts_from")
POINTS, BODIES, SCENES, H = 72, 2, 2, 0.02
TURN = torch.linalg.matrix_exp(torch.tensor([[0.0, -0.5, 0.9], [0.5, 0.0, 0.3], [-0.9, -0.3, 0.0]]).double())


def stand_in(every: int = 2, coarse: bool = True, **options: Any) -> Any:
    """A model with what the reference reads, a coarse space among it."""
    (left, tets), (right, more) = structured((2, 2, 2)), structured((4, 2, 2), (2.0, 1.0, 1.0))
    mesh = dv.TetMesh(np.concatenate((left, right + [0.0, 1.7, 0.3])), np.concatenate((tets, more + len(left))))
    floor = dv.FloorBarrier(height=-0.05, kappa=2e4, dhat=0.1, damping=20.0)
    energies = (dv.StableNeoHookean(), dv.Anchor(300.0, vertices=torch.tensor([3, 60])), floor)
    model = dv.Model(mesh, pinned=np.flatnonzero(left[:, 0] == 0), energies=energies)
    system = system_of(model, dv.VBD(0.01, 1, **options))
    values = {name: getattr(system, name) for name in NAMES}
    if coarse:
        space = CoarseSpace(functions=12, groups=3, every=every)
        geometry = build_coarse(mesh.points, mesh.tets, model.pinned.numpy(), np.arange(POINTS) >= len(left), space)
        values |= {"coarse": space, "coarse_geometry": geometry}
    return SimpleNamespace(**values)


def inputs_of(model: Any, jitter: float = 0.02) -> dict[str, Any]:
    """Inputs of two scenes: the free box turned, everything jittered."""
    rng = generator("coarse step")

    def normal(*shape: int) -> Tensor:
        return torch.as_tensor(rng.standard_normal(shape))

    rest, count = model.rest_points, len(model.tets)
    free = torch.arange(POINTS) >= 27
    center = rest[free].mean(0)
    turned = torch.where(free[:, None], (rest - center) @ TURN.T + center, rest)
    x = turned + jitter * normal(SCENES, POINTS, 3)
    return {
        "x": x,
        "v": 0.4 * normal(SCENES, POINTS, 3),
        "mu": 8e3 * (1 + 0.2 * normal(SCENES, count).clamp(-2, 2)),
        "lam": 2e4 * (1 + 0.2 * normal(count).clamp(-2, 2)),
        "density": 900 * (1 + 0.1 * normal(SCENES, count).clamp(-2, 2)),
        "force": 3 * normal(SCENES, POINTS, 3),
        "gravity": torch.tensor([0.3, -9.81, 0.1]).double(),
        "prescribed": x + 0.01 * normal(SCENES, POINTS, 3),
        "rest_points": rest + 5e-3 * normal(SCENES, POINTS, 3),
        "anchor_stiffness": 300 * (1 + 0.1 * normal(SCENES, POINTS).clamp(-2, 2)),
    }


def coarse_of(model: Any, x: Tensor, energies: Any = None, **changes: Any) -> tuple[coarse.Coarse, Any]:
    """The correction of a run from x, and its scene."""
    options = {"mu": 8e3, "lam": 2e4, "time_step": H, "rest_points": None, "density": None, "parameters": None}
    scene = build_scene(model, build_layout(model), x, **(options | changes))
    return coarse.Coarse(scene, sweep.build_energies(scene) if energies is None else energies), scene


def test_stiffness_is_the_projected_hessian_at_rest() -> None:
    model = stand_in()
    inputs = inputs_of(model)
    values = {name: inputs[name] for name in ("mu", "lam", "rest_points")}
    values = {name: value[1] if name != "lam" else value for name, value in values.items()}
    correction, scene = coarse_of(model, model.rest_points, **values)
    elastic = correction.energies[0]
    rest = scene.rest_points

    def energy(x: Tensor) -> Tensor:
        return elastic.energy(x, x) / scene.time_step**2

    hessian = torch.autograd.functional.hessian(energy, rest)  # [3, V, 3, V]
    assert isinstance(hessian, Tensor)
    projected = torch.einsum("ivjw,vf,wk->fikj", hessian, correction.weight, correction.weight)
    for own, stiffness in zip(correction.own, correction.stiffness, strict=True):
        assert relative_error(stiffness.sum(0), projected[own, :, own, :]) <= tolerance("hessian")
    assert not projected[correction.own[0], :, correction.own[1], :].any()


def test_rotations_against_central_differences() -> None:
    """Also where singular values are equal; and where nothing determines a rotation there is none to differentiate."""
    rng = generator("rotations and differences")
    some = torch.as_tensor(rng.standard_normal((3, 3)))
    some = some @ some.T + torch.as_tensor(0.2 * rng.standard_normal((3, 3)))
    mirrored = TURN @ torch.diag(torch.tensor([3.0, 2.0, -0.5]).double())
    least = torch.tensor(1e-3).double()
    for f in (TURN.clone(), 2 * TURN @ torch.diag(torch.tensor([2.0, 1.0, 1.0]).double()), some, mirrored):
        torch.autograd.gradcheck(lambda f: coarse.nearest_rotation(f, least), f.requires_grad_())
    flat = torch.diag(torch.tensor([1.0, 1e-4, 0.0]).double()).requires_grad_()
    turn = coarse.nearest_rotation(flat, least)
    assert torch.equal(turn, torch.eye(3).double())
    assert not torch.autograd.grad(turn.square().sum() + turn.sum(), flat)[0].any()


def test_functions_that_span_everything_make_a_newton_step() -> None:
    """W the identity on the vertices that move, two tets of a group each, at rest, where the rotations are 1."""
    points = np.array([[0.0, 0, 0], [1, 0.1, 0], [0.1, 1, 0.1], [0, 0.1, 1], [1, 1.1, 0.9]])
    tets = np.array([[0, 1, 2, 3], [1, 2, 3, 4]])
    tets[1] = tets[1] if np.linalg.det(points[tets[1, 1:]] - points[tets[1, 0]]) > 0 else [2, 1, 3, 4]
    model = dv.Model(dv.TetMesh(points, tets), pinned=[0], energies=(dv.StableNeoHookean(), dv.Anchor(0.0)))
    geometry = SimpleNamespace(
        function_ptr=[0, 4], vertex=[1, 2, 3, 4], function=[0, 1, 2, 3], weight=[1.0] * 4, tet_group=[0, 1],
        group_body=[0, 0], filling=[False] * 4,
    )  # fmt: skip
    model = system_of(model, dv.VBD(H, 1))
    model = SimpleNamespace(**{n: getattr(model, n) for n in NAMES}, coarse=CoarseSpace(), coarse_geometry=geometry)
    rest = model.rest_points
    correction, scene = coarse_of(model, rest)
    y = rest + torch.where(model.pinned[:, None], 0.0, 0.05 * torch.as_tensor(generator("y").standard_normal((5, 3))))

    def potential(z: Tensor) -> Tensor:
        z = torch.cat((rest[:1], z))
        return reference.incremental_potential(model, z, y, 8e3, 2e4, scene.time_step)

    gradient = torch.autograd.functional.jacobian(potential, rest[1:])
    hessian = torch.autograd.functional.hessian(potential, rest[1:])
    assert isinstance(hessian, Tensor) and isinstance(gradient, Tensor)
    step = -torch.linalg.solve(hessian.reshape(12, 12), gradient.reshape(12)).reshape(4, 3)
    matrix = correction.begin(rest.T)
    assert relative_error(matrix, hessian.reshape(12, 12)) <= tolerance("hessian")
    moved, s = correction.correct(rest.T, y.T, rest.T, matrix)
    assert s.tolist() == [1.0]
    assert torch.equal(moved.T[0], rest[0])
    assert relative_error(moved.T[1:] - rest[1:], step) <= tolerance("cancelling")


@pytest.mark.parametrize(
    ("sweeps", "subspace"),
    [(0, None), (1, None), *(slow(*a) for a in ((0, "rigid"), (1, "rigid"), (4, None), (4, "rigid")))],
)
def test_step_against_central_differences(sweeps: int, subspace: Any) -> None:
    """With as many sweeps, and the lengths of the corrections as they were found."""
    model, solver = stand_in(relaxation=1.3, subspace=subspace, start="predictor"), dv.VBD(H, sweeps)
    inputs = inputs_of(model)
    rng = generator("loss of a coarse step")
    weights = [torch.as_tensor(rng.standard_normal((SCENES, POINTS, 3))) for _ in range(2)]
    lengths: list[Tensor] = []
    reference.step(model, solver=solver, record=lengths, **inputs)
    assert lengths[0].shape == (model.coarse.corrections(sweeps), SCENES, BODIES) and (lengths[0] > 0).any()

    def loss(values: dict[str, Tensor]) -> Tensor:
        x, v = reference.step(model, solver=solver, coarse_steps=lengths[0], **values)
        return (weights[0] * x + H * weights[1] * v).sum()

    leaves = {name: value.clone().requires_grad_() for name, value in inputs.items()}
    gradients = torch.autograd.grad(loss(leaves), list(leaves.values()))
    for name, gradient in zip(leaves, gradients, strict=True):
        direction = torch.as_tensor(rng.standard_normal(tuple(gradient.shape))) * inputs[name].abs().max()
        value = float((gradient * direction).sum())

        def error(size: float, name: str = name, value: float = value, direction: Tensor = direction) -> float:
            ends = [float(loss(inputs | {name: inputs[name] + sign * size * direction})) for sign in (1, -1)]
            return abs(value - (ends[0] - ends[1]) / (2 * size))

        assert gradient.any(), name
        assert any(error(s) <= tolerance("finite_difference") * abs(value) for s in (1e-6, 1e-5, 1e-7, 1e-3)), name


@pytest.mark.parametrize(
    ("sweeps", "every", "expected"),
    [(0, 3, "c"), (1, 3, "sc"), (2, 3, "scs"), (4, 3, "scsss"), (5, 3, "scssscs"), (4, 1, "scscscs")],
)
def test_order_of_a_step(sweeps: int, every: int, expected: str, monkeypatch: pytest.MonkeyPatch) -> None:
    model = stand_in(every=every, relaxation=1.4)
    seen, relaxations, corrected, swept = [], [], coarse.Coarse.correct, sweep.run_sweeps

    def correct(*args: Any) -> Any:
        seen.append("c")
        return corrected(*args)

    def run_sweeps(*args: Any, relaxation: float | None = None) -> Tensor:
        seen.extend("s" * args[6])
        relaxations.extend([relaxation] * args[6])
        return swept(*args, relaxation=relaxation)

    monkeypatch.setattr(coarse.Coarse, "correct", correct)
    monkeypatch.setattr(sweep, "run_sweeps", run_sweeps)
    reference.step(model, solver=dv.VBD(H, sweeps), **inputs_of(model))
    assert "".join(seen) == expected and relaxations == [None] * (sweeps - 1) + [1.0] * min(sweeps, 1)
