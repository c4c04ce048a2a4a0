"""Claim: beside pairs and friction, Anderson acceleration brings steps nearer to converged ones in as many sweeps, its
gradients are those of the executed step, nothing crosses, and no combination raises the potential of bodies that pairs
join."""

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
from diffvbd.step.trials import connected_rows
from diffvbd.testing import relative_error, tolerance
from diffvbd.testing.contact_scenes import GRAVITY, SCENES, Scene, boxes, compiled, unrolled


@functools.cache
def accelerated(name: str, window: int = 2) -> Scene:
    scene = SCENES[name]()
    return replace(scene, model=rebuilt(scene.model, acceleration=dv.Anderson(window)))


def taken_in(detections: list[Any]) -> list[Tensor]:
    return [d.combined.taken for d in detections if d.combined is not None]


def recorded(scene: Scene, sweeps: int) -> list[Any]:
    with dv.contact.record() as found:
        dv.step(scene.model, scene.x, scene.v, time_step=scene.time_step, sweeps=sweeps, gravity=GRAVITY,
                **scene.inputs)  # fmt: skip
    return found


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(("steps", "sweeps", "window"), [(1, 9, 2), slow(3, 10, 3)])
@pytest.mark.parametrize("name", list(SCENES))
def test_gradients_are_those_of_the_executed_step(name: str, steps: int, sweeps: int, window: int, device: str) -> None:
    scene = accelerated(name, window)
    result, parts = compiled(scene, steps, sweeps, "full", scene.model.to(device))
    expected = unrolled(scene, steps, sweeps, parts)
    assert any(part.combined is not None for own in parts for part in own)
    others = [lambda seed=seed: unrolled(scene, steps, sweeps, parts, seed=seed) for seed in (1, 2)]
    forward, adjoint = (steps * tolerance(name) for name in ("contact_forward", "contact_adjoint"))
    assert_near_contact(result, expected, forward, adjoint, scene.time_step, others)
    for key in ("grad_x", "grad_v", "grad_mu", "grad_density"):
        assert expected[key].abs().max() > 0, key


def test_combinations_that_are_taken_and_that_are_not_occur() -> None:
    """What the comparison above is worth; and bodies that pairs join decide together."""
    every = torch.cat([t.reshape(-1) for name in SCENES for t in taken_in(recorded(accelerated(name), 7))])
    assert every.any() and not every.all()
    for name in ("stacked", "crossed"):
        (detection,) = recorded(accelerated(name), 7)
        sets, taken = detection.combined
        assert (sets == sets[:, :1]).all() and (taken == taken[..., :1]).all() and taken.any()


def test_same_as_without_where_nothing_is_combined() -> None:
    scene = accelerated("stacked")
    plain = rebuilt(scene.model)
    for sweeps in (0, 1, 2, 7):
        ends = [dv.step(m, scene.x, scene.v, time_step=scene.time_step, sweeps=sweeps, **scene.inputs)[0]
                for m in (plain, scene.model)]  # fmt: skip
        assert torch.equal(*ends) == (sweeps < 3)


@pytest.mark.parametrize(("build", "sweeps", "window"), [(pressed, 60, 5), (stack, 40, 5)])
def test_nearer_in_as_many_sweeps(build: Any, sweeps: int, window: int) -> None:
    plain, given = build()
    x = plain.rest_points
    v = torch.zeros_like(x)
    goal = dv.step(plain, x, v, sweeps=4000, **given)[0]
    errors = [float((dv.step(m, x, v, sweeps=sweeps, **given)[0] - goal).norm() / (goal - x).norm())
              for m in (plain, build(acceleration=dv.Anderson(window))[0])]  # fmt: skip
    assert errors[1] < errors[0] / 3, errors


@pytest.mark.parametrize("name", ["fast", "crossed", "stacked"])
def test_nothing_crosses(name: str) -> None:
    """Every step looks for intersections at its start."""
    scene = accelerated(name)
    x, v, taken = scene.x, scene.v, []
    for _ in range(12):
        with dv.debug_checks(), dv.contact.record() as found:
            x, v = dv.step(scene.model, x, v, time_step=scene.time_step, sweeps=9, gravity=GRAVITY, **scene.inputs)
        taken += taken_in(found)
        assert min(dv.contact.status(scene.model).smallest_gap) > 0
    assert torch.cat(taken).any()


def test_scenes_do_not_mix() -> None:
    scene = accelerated("batched")
    ends, _ = dv.step(scene.model, scene.x, scene.v, time_step=scene.time_step, sweeps=8, **scene.inputs)
    for n in range(len(scene.x)):
        own = {k: t[n] for k, t in scene.inputs.items()}
        end, _ = dv.step(scene.model, scene.x[n], scene.v[n], time_step=scene.time_step, sweeps=8, **own)
        assert relative_error(ends[n], end) <= tolerance("contact_forward")


def test_bodies_that_pairs_join() -> None:
    """Directly, or by others; the least of each set stands for it."""
    one, two = torch.tensor([[7, 3], [3, 5], [2, 2], [9, 8], [8, 7]]).T
    assert connected_rows(one, two, 11).tolist() == [0, 1, 2, 3, 4, 3, 6, 3, 3, 3, 10]
    chain = torch.arange(999, 0, -1)
    assert not connected_rows(chain, chain - 1, 1000).any()


def test_records_and_refusals() -> None:
    scene = accelerated("stacked")
    with dv.acceleration.record() as taken:
        dv.step(scene.model, scene.x, scene.v, time_step=scene.time_step, sweeps=8, **scene.inputs)
    assert taken[0].shape == (1, 6, 2) and taken[0].dtype == torch.bool and taken[0].any()
    with pytest.raises(ValueError, match="acceleration: expected None with saturation"):
        rebuilt(scene.model, acceleration=dv.Anderson(), saturation=0.1)


def test_records_leave_out_parts_that_a_scene_does_not_take() -> None:
    scene = SCENES["held_up"]()  # of which one half goes on
    model = rebuilt(scene.model, acceleration=dv.Anderson(), coarse=dv.CoarseSpace(functions=4, every=2))
    with dv.acceleration.record() as taken, dv.coarse.record() as lengths, dv.contact.record() as found:
        dv.step(model, scene.x, scene.v, time_step=scene.time_step, sweeps=20, **scene.inputs)
    last = found[-1]
    assert last.going.flatten().tolist() == [True, False] and last.combined.taken.any() and last.lengths[:, 1].all()
    combined, corrected = (record[0][:, -len(part) :] for record, part in ((taken, last.combined.taken),
                                                                           (lengths, last.lengths)))  # fmt: skip
    assert combined[0].any() and corrected[0].all(-1).any()
    assert not combined[1].any() and not corrected[1].any()


@pytest.mark.parametrize("coarse", [None, dv.CoarseSpace(functions=4, every=2)])
def test_gradients_on_a_floor_with_friction_alone(coarse: dv.CoarseSpace | None) -> None:
    """Against central differences, for which decisions stay as they were."""
    tets = boxes((0, 0, 0))
    energies = (dv.StableNeoHookean(), dv.FloorBarrier(height=-0.01, kappa=1e4, dhat=0.02), dv.Friction(0.4, 0.05))
    model = dv.Model(tets, energies=energies, coarse=coarse, acceleration=dv.Anderson(2))
    x = model.rest_points
    v = torch.zeros_like(x) + torch.tensor([0.5, -0.2, 0.1], dtype=x.dtype)
    way = torch.linspace(-1, 1, x.numel(), dtype=x.dtype).reshape(x.shape).sin()

    def end(size: Any) -> Tensor:
        return (way * dv.step(model, x, v + size * way, mu=2e4, lam=4e4, time_step=0.01, sweeps=12)[0]).sum()

    with dv.acceleration.record() as taken, dv.coarse.record() as lengths:
        size = torch.zeros((), dtype=x.dtype, requires_grad=True)
        (slope,) = torch.autograd.grad(end(size), size)
    assert taken[0].any() and slope.abs() > 0 and (coarse is None or lengths[0].any())
    with torch.no_grad():
        errors = [abs(float((end(h) - end(-h)) / (2 * h) - slope)) for h in (1e-4, 1e-5, 1e-6)]
    assert min(errors) <= tolerance("contact_finite_difference") * abs(float(slope))
