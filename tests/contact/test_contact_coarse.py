"""Claim: beside pairs and friction, coarse corrections bring steps nearer to converged ones in as many sweeps, their
gradients are those of the executed step, and nothing crosses."""

import functools
from dataclasses import replace
from typing import Any

import pytest
import torch
from conftest import DEVICES
from helpers.marks import hours, slow
from helpers.spreads import PARALLEL, assert_near_contact
from helpers.touching import TIME_STEP, pressed, stack
from torch import Tensor

import diffvbd as dv
from diffvbd.testing import relative_error, tolerance
from diffvbd.testing.contact_scenes import SCENES, Scene, compiled, noise, unrolled

SPACE = dv.CoarseSpace(functions=6, groups=2, every=2)
EVERY = [(name, *run) for name in SCENES for run in ((1, 7), (2, 6))]  # steps, sweeps
QUICK, LONG = [(name, 1, 7) for name in ("obstacles", "batched", "thrown")], ("fast", 2, 6)


@functools.cache
def scene_of(name: str) -> Scene:
    return SCENES[name]()


def check(scene: Scene, steps: int, sweeps: int, device: str, rounding: float = 1.0) -> Tensor:
    """Lengths of all corrections. rounding: Of gradients, over that of most scenes."""
    solver = scene.solver(sweeps, subspace=SPACE, tape="full")
    result, parts = compiled(scene, steps, solver, scene.model.to(device))
    expected = unrolled(scene, steps, solver, parts)
    others = [lambda: unrolled(scene, steps, solver, parts, seed=1)]
    forward, adjoint = (steps * tolerance(name) for name in ("contact_forward", "contact_adjoint"))
    assert_near_contact(result, expected, forward, rounding * adjoint, scene.time_step, others)
    for key in ("grad_x", "grad_v", "grad_mu", "grad_density"):
        assert expected[key].abs().max() > 0, key
    return torch.cat([part.lengths.reshape(-1) for own in parts for part in own if part.lengths is not None])


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(
    ("name", "steps", "sweeps"),
    [run if run in QUICK else (hours if run == LONG else slow)(*run) for run in EVERY],
)
def test_gradients_are_those_of_the_executed_step(name: str, steps: int, sweeps: int, device: str) -> None:
    lengths = check(scene_of(name), steps, sweeps, device, PARALLEL.get(name, 1.0))
    assert (lengths == 1).any() or name in ("fast", "thrown")


@pytest.mark.slow
@pytest.mark.parametrize("device", DEVICES)
def test_gradients_of_shortened_and_refused_corrections(device: str) -> None:
    scene = scene_of("batched")
    once = [replace(e, detections=1) if isinstance(e, dv.PairBarrier) else e for e in scene.model.energies]
    scene = replace(
        scene,
        model=scene.model.replace(energies=once),
        v=scene.v + noise("violent", "batched", shape=scene.v.shape, size=12.0),
    )
    lengths = check(scene, 2, 7, device)
    assert (lengths == 1).any() and ((lengths > 0) & (lengths < 1)).any() and (lengths == 0).any(), lengths


def test_a_correction_is_the_same_with_gradients_and_without() -> None:
    """To the bit: what was judged is what is done."""
    model, given = stack()
    x, solver = model.rest_points, dv.VBD(TIME_STEP, 7, subspace="coarse")
    with torch.no_grad():
        alone = dv.step(model, x, torch.zeros_like(x), solver, **given)[0]
    v = torch.zeros_like(x).requires_grad_()
    assert torch.equal(dv.step(model, x, v, solver, **given)[0], alone)


@pytest.mark.parametrize("build", [pressed, stack])
def test_nearer_in_as_many_sweeps(build: Any) -> None:
    model, given = build()
    x = model.rest_points

    def end(sweeps: int, subspace: Any) -> Tensor:
        return dv.step(model, x, torch.zeros_like(x), dv.VBD(TIME_STEP, sweeps, subspace=subspace), **given)[0]

    goal = end(4000, "rigid")
    errors = [float((end(16, subspace) - goal).norm() / (goal - x).norm()) for subspace in ("rigid", "coarse")]
    assert errors[1] < errors[0] / 10, errors


def test_gradients_of_the_rest_shape() -> None:
    """Against central differences, for which decisions stay as they were."""
    model, given = stack()
    x, solver = model.rest_points, dv.VBD(TIME_STEP, 7, subspace=SPACE)
    v = torch.zeros_like(x)
    v[:, 1] = -0.1 * x[:, 1]
    way = torch.linspace(-1, 1, x.numel(), dtype=x.dtype).reshape(x.shape).sin()

    def end(size: Any) -> Tensor:
        return (way * dv.step(model, x, v, solver, rest_points=x + size * way, **given)[0]).sum()

    with dv.record("subspace") as lengths:
        size = torch.zeros((), dtype=x.dtype, requires_grad=True)
        (slope,) = torch.autograd.grad(end(size), size)
    assert lengths[0].any() and slope.abs() > 0
    with torch.no_grad():
        errors = [abs(float((end(h) - end(-h)) / (2 * h) - slope)) for h in (1e-6, 1e-7, 1e-8)]
    assert min(errors) <= tolerance("contact_finite_difference") * abs(float(slope))


def test_float32_is_near_float64() -> None:
    model, given = stack()
    ends, solver = [], dv.VBD(TIME_STEP, 11, subspace="coarse")
    for dtype in (torch.float64, torch.float32):
        own = model.to(dtype=dtype)
        x = own.rest_points
        ends.append(dv.step(own, x, torch.zeros_like(x), solver, **given)[0])
    assert ends[1].dtype == torch.float32 and relative_error(*ends[::-1]) <= tolerance("float32_forward")


@pytest.mark.parametrize("device", DEVICES)
def test_scenes_of_a_batch_do_not_mix(device: str) -> None:
    """Beside a collider, whose corners come first in some pairs and are no vertices of any scene."""
    generator = torch.Generator().manual_seed(0)
    cube = dv.mesh.cube(3, size=0.1).translate((0.0, 0.06, 0.0))
    pairs = dv.PairBarrier(kappa=1e3, dhat=0.04, self_contact=False, detections=1)
    ball = dv.colliders.Sphere((0.03, 0.0, 0.04), 0.05)
    model = dv.Model(cube, energies=(dv.StableNeoHookean(), pairs), colliders=[ball], device=device)
    x = model.rest_points.expand(3, -1, -1)
    v = 0.05 * torch.randn(x.shape, generator=generator, dtype=x.dtype) - torch.tensor([0.0, 0.5, 0.0], dtype=x.dtype)
    weights, v = torch.randn(x.shape, generator=generator, dtype=x.dtype).to(device), v.to(device).requires_grad_()
    given: dict[str, Any] = {"mu": 1e5, "lam": 1e4, "solver": dv.VBD(0.01, 6, subspace="coarse")}
    together = dv.step(model, x, v, **given)[0]
    (grad,) = torch.autograd.grad((weights * together).sum(), v)
    for k in range(3):
        alone = dv.step(model, x[k], v[k], **given)[0]
        (own,) = torch.autograd.grad((weights[k] * alone).sum(), v)
        assert own[k].abs().max() > 0
        assert relative_error(together[k], alone) <= tolerance("coarse_forward")
        assert relative_error(grad[k], own[k]) <= tolerance("contact_adjoint")


@pytest.mark.parametrize("device", DEVICES)
def test_a_batch_of_no_scenes(device: str) -> None:
    model, given = stack()
    model = model.to(device)
    x = model.rest_points.expand(0, -1, -1).clone().requires_grad_()
    end = dv.step(model, x, torch.zeros_like(x), dv.VBD(TIME_STEP, 6, subspace="coarse"), **given)[0]
    assert torch.autograd.grad(end.sum(), x)[0].shape == end.shape == x.shape


def test_checkpoints_and_threads_change_no_bit() -> None:
    model, given = stack()
    solver = dv.VBD(TIME_STEP, 8, subspace="coarse")
    x, found, threads = model.rest_points, [], torch.get_num_threads()
    try:
        for every, count in ((None, 1), (2, 2)):
            torch.set_num_threads(count)
            v = torch.zeros_like(x).requires_grad_()
            run = dv.rollout(model, x, v, solver, steps=3, save="last", checkpoint_every=every, **given)
            found.append((run.x[-1].detach(), torch.autograd.grad(run.x[-1].square().sum(), v)[0]))
    finally:
        torch.set_num_threads(threads)
    assert all(torch.equal(*pair) for pair in zip(*found, strict=True)) and found[0][1].abs().max() > 0
