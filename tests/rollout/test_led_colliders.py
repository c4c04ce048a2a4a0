"""Claim: a function may move colliders in a rollout, looking at the state: their velocity follows from it, gradients go
through it under every schedule, and it is the same as the positions that it gives."""

from typing import Any

import pytest
import torch
from torch import Tensor

import diffvbd as dv
from diffvbd.testing import relative_error

F64 = torch.float64


def pushed() -> tuple[dv.Model, Tensor, Tensor]:
    """A cube on a frictional floor, and a ball beside it that comes to push it."""
    cube = dv.mesh.box(3, 0.1, split="kuhn").translate((0.0, 0.003, 0.0))
    ball = dv.colliders.Sphere((-0.06, 0.05, 0.05), 0.05)
    energies = (dv.StableNeoHookean(), dv.PairBarrier(), dv.Friction(0.3), dv.FloorBarrier())
    model = dv.Model(cube, energies=energies, colliders=(ball,))
    return model, model.rest_points, torch.zeros_like(model.rest_points)


MATERIAL = {"mu": 3e4, "lam": 5e4}
SOLVER = dv.VBD(0.01, 8)


def policy(model: dv.Model, gain: Tensor) -> Any:
    """The ball follows the cube's middle at a distance."""

    def points(step: int, x: Tensor, v: Tensor) -> Tensor:
        ahead = 0.002 * (step + 1) + gain * (x.mean(-2) - model.rest_points.mean(0)) + 0.01 * v.mean(-2)
        return model.collider_points + ahead[..., None, :] * torch.tensor(
            [1.0, 0.0, 0.0], dtype=x.dtype, device=x.device
        )

    return points


def end_of(gain: Tensor, steps: int = 8, **options: Any) -> Tensor:
    model, x, v = pushed()
    options.setdefault("colliders", policy(model, gain))
    return dv.rollout(model, x, v, SOLVER, steps=steps, save="last", **options, **MATERIAL).x[-1]


def test_it_is_the_positions_that_it_gives(device: str) -> None:
    model, x, v = pushed()
    model, x, v, given = model.to(device), x.to(device), v.to(device), []
    act = policy(model, torch.tensor(0.5, dtype=F64, device=device))

    def kept(*at: Any) -> Tensor:
        given.append(act(*at))
        return given[-1]

    before = model.collider_points - 0.001
    with torch.no_grad():
        led = dv.rollout(model, x, v, SOLVER, steps=8, colliders=kept, colliders_before=before, **MATERIAL)
    told = dv.rollout(model, x, v, SOLVER, steps=8, colliders=dv.per_step(torch.stack(given)), colliders_before=before,
                      **MATERIAL)  # fmt: skip
    assert torch.equal(led.x, told.x) and torch.equal(led.v, told.v)
    assert float((led.x[-1] - x).mean(0)[0]) > 1e-3  # it was pushed


def test_it_may_write_into_one_tensor() -> None:
    model, x, v = pushed()
    buffer, way = model.collider_points.clone(), torch.tensor([0.002, 0.0, 0.0], dtype=F64)

    def onward(step: int, x: Tensor, v: Tensor) -> Tensor:
        buffer.copy_(model.collider_points + (step + 1) * way)
        return buffer

    def anew(step: int, x: Tensor, v: Tensor) -> Tensor:
        return model.collider_points + (step + 1) * way

    with torch.no_grad():
        ends = [dv.rollout(model, x, v, SOLVER, steps=8, colliders=act, colliders_before=before, **MATERIAL).x[-1]
                for act, before in ((onward, buffer), (anew, buffer.clone()))]  # fmt: skip
    assert torch.equal(*ends) and not torch.equal(ends[0], x)


@pytest.mark.parametrize("every", [None, 3, dv.BinomialCheckpoints(2)], ids=str)
def test_gradients_go_through_it(every: Any) -> None:
    gain = torch.tensor(0.5, dtype=F64, requires_grad=True)
    (slope,) = torch.autograd.grad(end_of(gain, checkpoint_every=every).mean(0)[0], gain)
    with torch.no_grad():
        ends = [float(end_of(gain + sign * 1e-5).mean(0)[0]) for sign in (1, -1)]
    assert slope.abs() > 1e-6 and relative_error(slope, torch.tensor((ends[0] - ends[1]) / 2e-5, dtype=F64)) < 1e-5


@pytest.mark.parametrize("integrator", [dv.SDIRK2(), dv.BDF2()], ids=repr)
def test_integrators_and_batches(integrator: Any) -> None:
    model, x, v = pushed()
    solver, x = dv.VBD(0.01, 8, integrator=integrator), torch.stack([x, x + torch.tensor([0.004, 0.0, 0.0])])
    gain = torch.tensor(0.4, dtype=F64, requires_grad=True)

    def end(gain: Tensor, **options: Any) -> Tensor:
        act = policy(model, gain)
        done = dv.rollout(model, x, 0 * x, solver, steps=6, colliders=act, save="last", **options, **MATERIAL)
        return done.x[-1, ..., 0].mean()

    (slope,) = torch.autograd.grad(end(gain, checkpoint_every=2), gain)
    with torch.no_grad():
        difference = (end(gain + 1e-5) - end(gain - 1e-5)) / 2e-5
    assert slope.abs() > 1e-7 and relative_error(slope, difference) < 1e-4


def test_finer_steps_follow_it_in_straight_lines() -> None:
    gain = torch.tensor(0.5, dtype=F64)
    found = dv.refine(lambda: end_of(gain).mean(0)[0])
    assert found.smaller_steps != found.loss and abs(found.smaller_steps - found.loss) < 0.2 * abs(found.loss)


def test_bad_input() -> None:
    model, _, _ = pushed()
    gain = torch.tensor(0.5, dtype=F64)
    with pytest.raises(TypeError, match="colliders: expected a function of .*step, x, v"):
        end_of(gain, colliders=lambda t: model.collider_points)
    with pytest.raises(TypeError, match="colliders: expected a function that returns the value for a step, got None"):
        end_of(gain, colliders=lambda step, x, v: None)
    with pytest.raises(
        ValueError, match=r"colliders: expected a function that returns shape \[\.\.\., 1, 3\], got shape \[27, 3\]"
    ):
        end_of(gain, colliders=lambda step, x, v: x)
    with pytest.raises(TypeError, match="colliders_before: expected it with colliders per_step or by a function"):
        end_of(gain, colliders=model.collider_points, colliders_before=model.collider_points)
    with pytest.raises(TypeError, match="colliders_before: expected a tensor, got function"):
        end_of(gain, colliders_before=policy(model, gain))
