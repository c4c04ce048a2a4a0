"""Claim: beside pairs and friction, coarse corrections bring steps nearer to converged ones in as many sweeps, their
gradients are those of the executed step, and nothing crosses."""

import functools
from dataclasses import replace
from typing import Any

import pytest
import torch
from conftest import DEVICES
from helpers.marks import slow
from helpers.spreads import assert_near_contact
from helpers.touching import pressed, rebuilt, stack
from torch import Tensor

import diffvbd as dv
from diffvbd.testing import relative_error, tolerance
from diffvbd.testing.contact_scenes import GRAVITY, SCENES, Scene, compiled, noise, unrolled

SPACE = dv.CoarseSpace(functions=6, groups=2, every=2)


@functools.cache
def corrected(name: str) -> Scene:
    scene = SCENES[name]()
    return replace(scene, model=rebuilt(scene.model, coarse=SPACE))


def lengths_in(detections: list[Any]) -> list[Tensor]:
    return [d.lengths for d in detections if d.lengths is not None]


def check(scene: Scene, steps: int, sweeps: int, device: str) -> Tensor:
    """Lengths of all corrections."""
    result, parts = compiled(scene, steps, sweeps, "full", scene.model.to(device))
    expected = unrolled(scene, steps, sweeps, parts)
    others = [lambda: unrolled(scene, steps, sweeps, parts, seed=1)]
    forward, adjoint = (steps * tolerance(name) for name in ("contact_forward", "contact_adjoint"))
    assert_near_contact(result, expected, forward, adjoint, scene.time_step, others)
    for key in ("grad_x", "grad_v", "grad_mu", "grad_density"):
        assert expected[key].abs().max() > 0, key
    return torch.cat([part.lengths.reshape(-1) for own in parts for part in own if part.lengths is not None])


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(("steps", "sweeps"), [(1, 7), slow(1, 9), slow(3, 6)])
@pytest.mark.parametrize("name", list(SCENES))
def test_gradients_are_those_of_the_executed_step(name: str, steps: int, sweeps: int,
                                                  device: str) -> None:  # fmt: skip
    lengths = check(corrected(name), steps, sweeps, device)
    assert (lengths == 1).any() or name in ("fast", "thrown")


@pytest.mark.parametrize("device", DEVICES)
def test_gradients_of_shortened_and_refused_corrections(device: str) -> None:
    scene = corrected("batched")
    once = [replace(e, detections=1) if isinstance(e, dv.PairBarrier) else e for e in scene.model.energies]
    scene = replace(
        scene,
        model=scene.model.replace(energies=once),
        v=scene.v + noise("violent", "batched", shape=scene.v.shape, size=25.0),
    )
    lengths = check(scene, 2, 7, device)
    assert (lengths == 1).any() and ((lengths > 0) & (lengths < 1)).any() and (lengths == 0).any(), lengths


def test_a_correction_is_the_same_with_gradients_and_without() -> None:
    """To the bit: what was judged is what is done."""
    model, given = stack(coarse="auto")
    x = model.rest_points
    with torch.no_grad():
        alone = dv.step(model, x, torch.zeros_like(x), sweeps=7, **given)[0]
    assert torch.equal(dv.step(model, x, torch.zeros_like(x), sweeps=7, **given)[0], alone)


@pytest.mark.parametrize("build", [pressed, stack])
def test_nearer_in_as_many_sweeps(build: Any) -> None:
    plain, given = build()
    x = plain.rest_points
    v = torch.zeros_like(x)
    goal = dv.step(plain, x, v, sweeps=4000, **given)[0]
    errors = [float((dv.step(m, x, v, sweeps=16, **given)[0] - goal).norm() / (goal - x).norm())
              for m in (plain, build(coarse="auto")[0])]  # fmt: skip
    assert errors[1] < errors[0] / 10, errors


@pytest.mark.parametrize("name", ["fast", "crossed", "stacked"])
def test_nothing_crosses(name: str) -> None:
    """Every step looks for intersections at its start."""
    scene = corrected(name)
    x, v, lengths = scene.x, scene.v, []
    for _ in range(12):
        with dv.debug_checks(), dv.contact.record() as found:
            x, v = dv.step(scene.model, x, v, time_step=scene.time_step, sweeps=9, gravity=GRAVITY, **scene.inputs)
        lengths += [t.reshape(-1) for t in lengths_in(found)]
        assert min(dv.contact.status(scene.model).smallest_gap) > 0
    assert torch.cat(lengths).any()


def test_a_stiff_body_in_flight_keeps_its_spin() -> None:
    """As it does without contact. One rigid correction after the coarse ones let it gain 4 % of its energy."""

    def spin_and_energy(*contact: Any) -> tuple[Tensor, Tensor]:
        mesh = dv.mesh.box((2, 3, 4), (0.1, 0.2, 0.3))
        model = dv.Model(mesh, energies=(dv.StableNeoHookean(), *contact), coarse="auto")
        x, mass = model.rest_points, model.mass[:, None]
        arm = x - (mass * x).sum(0) / mass.sum()
        v = torch.linalg.cross(torch.tensor([0.1, 3.0, 0.05], dtype=x.dtype).expand_as(arm), arm)
        run = dv.rollout(model, x, v, steps=100, time_step=0.02, mu=1e8, lam=1e8, sweeps=12, gravity=(0.0, 0.0, 0.0),
                         integrator=dv.BDF2())  # fmt: skip
        return torch.linalg.cross(run.x[-1], mass * run.v[-1]).sum(0), (mass * run.v.square()).sum((-1, -2))

    (free, energy), (beside, other) = spin_and_energy(), spin_and_energy(dv.PairBarrier(1e3, 0.01, self_contact=False))
    assert relative_error(beside, free) <= tolerance("spin_beside_contact")
    assert relative_error(other, energy) <= tolerance("spin_beside_contact")


def test_records() -> None:
    scene = corrected("stacked")
    with dv.coarse.record() as lengths:
        for sweeps in (0, 1, 2, 6):
            dv.step(scene.model, scene.x, scene.v, time_step=scene.time_step, sweeps=sweeps, **scene.inputs)
    assert [t.shape for t in lengths] == [(1, n, 2) for n in (0, 0, 1, 3)] and lengths[-1].any()


def test_more_functions_than_can_be_solved_for_together_are_refused() -> None:
    tets = dv.mesh.box((9, 9, 9), (1.0, 1.0, 1.0))
    energies = (dv.StableNeoHookean(), dv.PairBarrier(1e3, 0.01))
    with pytest.raises(ValueError, match="at most 512 functions of all bodies"):
        dv.Model(tets, energies=energies, coarse=dv.CoarseSpace(functions=600))


def test_gradients_of_the_rest_shape() -> None:
    """Against central differences, for which decisions stay as they were."""
    model, given = stack(coarse=SPACE)
    x = model.rest_points
    v = torch.zeros_like(x)
    v[:, 1] = -0.1 * x[:, 1]
    way = torch.linspace(-1, 1, x.numel(), dtype=x.dtype).reshape(x.shape).sin()

    def end(size: Any) -> Tensor:
        return (way * dv.step(model, x, v, sweeps=7, rest_points=x + size * way, **given)[0]).sum()

    with dv.coarse.record() as lengths:
        size = torch.zeros((), dtype=x.dtype, requires_grad=True)
        (slope,) = torch.autograd.grad(end(size), size)
    assert lengths[0].any() and slope.abs() > 0
    with torch.no_grad():
        errors = [abs(float((end(h) - end(-h)) / (2 * h) - slope)) for h in (1e-6, 1e-7, 1e-8)]
    assert min(errors) <= tolerance("contact_finite_difference") * abs(float(slope))


def test_float32_is_near_float64() -> None:
    model, given = stack(coarse="auto")
    ends = []
    for dtype in (torch.float64, torch.float32):
        own = model.to(dtype=dtype)
        x = own.rest_points
        ends.append(dv.step(own, x, torch.zeros_like(x), sweeps=11, **given)[0])
    assert ends[1].dtype == torch.float32 and relative_error(*ends[::-1]) <= tolerance("float32_forward")


@pytest.mark.parametrize("device", DEVICES)
def test_scenes_of_a_batch_do_not_mix(device: str) -> None:
    """Beside a collider, whose corners come first in some pairs and are no vertices of any scene."""
    generator = torch.Generator().manual_seed(0)
    cube = dv.mesh.cube(3, size=0.1).translate((0.0, 0.06, 0.0))
    pairs = dv.PairBarrier(kappa=1e3, dhat=0.04, self_contact=False, detections=1)
    ball = dv.colliders.Sphere((0.03, 0.0, 0.04), 0.05)
    model = dv.Model(cube, energies=(dv.StableNeoHookean(), pairs), colliders=[ball], coarse="auto", device=device)
    x = model.rest_points.expand(3, -1, -1)
    v = 0.05 * torch.randn(x.shape, generator=generator, dtype=x.dtype) - torch.tensor([0.0, 0.5, 0.0], dtype=x.dtype)
    weights, v = torch.randn(x.shape, generator=generator, dtype=x.dtype).to(device), v.to(device).requires_grad_()
    given: dict[str, Any] = {"mu": 1e5, "lam": 1e4, "time_step": 0.01, "sweeps": 6}
    together = dv.step(model, x, v, **given)[0]
    (grad,) = torch.autograd.grad((weights * together).sum(), v)
    for k in range(3):
        alone = dv.step(model, x[k], v[k], **given)[0]
        (own,) = torch.autograd.grad((weights[k] * alone).sum(), v)
        assert own[k].abs().max() > 0
        assert relative_error(together[k], alone) <= tolerance("coarse_forward")
        assert relative_error(grad[k], own[k]) <= tolerance("contact_adjoint")


def test_checkpoints_and_threads_change_no_bit() -> None:
    model, given = stack(coarse="auto")
    x, found, threads = model.rest_points, [], torch.get_num_threads()
    try:
        for every, count in ((None, 1), (2, 2)):
            torch.set_num_threads(count)
            v = torch.zeros_like(x).requires_grad_()
            run = dv.rollout(model, x, v, steps=3, sweeps=8, save="last", checkpoint_every=every, **given)
            found.append((run.x[-1].detach(), torch.autograd.grad(run.x[-1].square().sum(), v)[0]))
    finally:
        torch.set_num_threads(threads)
    assert all(torch.equal(*pair) for pair in zip(*found, strict=True)) and found[0][1].abs().max() > 0


def test_compiled_from_the_first_call() -> None:
    """With a gradient, and before anything has been derived from the Model."""
    found = []
    for run in (torch.compile(dv.step, backend="eager"), dv.step):
        torch._dynamo.reset()
        model, given = stack(coarse="auto")
        x = model.rest_points
        v = torch.zeros_like(x).requires_grad_()
        end, _ = run(model, x, v, sweeps=6, **given)
        found.append((end.detach(), torch.autograd.grad(end.square().sum(), v)[0]))
    assert found[1][1].abs().max() > 0
    assert all(relative_error(*pair) <= tolerance("contact_forward") for pair in zip(*found, strict=True))
