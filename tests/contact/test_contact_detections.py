"""Claim: a step that nobody has given a number of detections takes as many as its motion asks for, and an impact keeps
its momentum."""

import math
from typing import Any

import pytest
import torch
from conftest import DEVICES

import diffvbd as dv
from diffvbd.mesh import box, join
from diffvbd.ops.fields import MOST_COUPLED
from diffvbd.step.contact import MOST_DETECTIONS
from diffvbd.testing.tolerances import tolerance

STEPS = 9
MATERIAL: dict[str, Any] = {"mu": 8e3, "lam": 1.2e4, "gravity": (0.0, 0.0, 0.0)}


def meeting(speed: float, device: str, dtype: torch.dtype = torch.float64, **options: Any) -> tuple[dv.Model, Any, Any]:
    """A small cube thrown at a larger one, off its center."""
    lower, upper = box(4, 0.2, split="kuhn"), box(4, 0.12, split="kuhn").translate((0.04, 0.22, 0.03))
    barrier = dv.PairBarrier(kappa=1e4, dhat=0.01, self_contact=False, **options)
    model = dv.Model(join([lower, upper]), energies=(dv.StableNeoHookean(), barrier), device=device, dtype=dtype)
    v = torch.zeros_like(model.rest_points)
    v[lower.num_vertices :, 1] = -speed
    return model, model.rest_points, v


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", (torch.float64, torch.float32))
def test_only_fast_motion_beside_others_takes_more_than_one(dtype: torch.dtype, device: str) -> None:
    def counts(speed: float, together: bool) -> list[int]:
        model, x, v = meeting(speed, device, dtype)
        if together:
            v = torch.zeros_like(v)
            v[:, 1] = -speed
        out = []
        for _ in range(STEPS):
            with dv.record("contact") as found:
                x, v = dv.step(model, x, v, dv.VBD(1 / 60, 10), **MATERIAL)
            out.append(len(found))
            assert len(dv.contact.intersections(model, x)) == 0
        return out

    assert counts(0.5, False) == counts(20.0, True) == [1] * STEPS
    fast = counts(10.0, False)
    assert max(fast) > fast[-1] == 1  # slower after the impact


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(("speed", "sweeps"), ((5.0, 1), (5.0, 10), (10.0, 1), (10.0, 10)))
def test_an_impact_keeps_its_momentum(speed: float, sweeps: int, device: str) -> None:
    def lost(**options: Any) -> float:
        model, x, v = meeting(speed, device, **options)
        mass = model.mass[:, None]
        first = (mass * v).sum(0)
        for _ in range(STEPS):
            x, v = dv.step(model, x, v, dv.VBD(1 / 60, sweeps), **MATERIAL)
        assert float((mass * v)[: len(v) - 64].sum(0).norm()) > 0.2 * float(first.norm())  # they did collide
        return float(((mass * v).sum(0) - first).norm() / first.norm())

    assert lost() <= MOST_DETECTIONS * STEPS * tolerance("momentum")
    if (speed, sweeps) == (10.0, 10):
        assert lost(detections=1) > 0.01


def row(count: int, gap: float, speed: float, device: str, detections: int | None = None
        ) -> tuple[dv.Model, torch.Tensor, torch.Tensor]:  # fmt: skip
    """Cubes of 0.1 m in a row that are not quite in line, of which the first is thrown at the others."""
    cubes = [box(2, 0.1, split="kuhn").translate((i * (0.1 + gap), 0.003 * i, 0.002 * i)) for i in range(count)]
    barrier = dv.PairBarrier(kappa=1e5, dhat=1e-3, self_contact=False, detections=detections)
    model = dv.Model(join(cubes), energies=(dv.StableNeoHookean(), barrier), device=device)
    v = torch.zeros_like(model.rest_points)
    v[: cubes[0].num_vertices, 0] = speed
    return model, model.rest_points, v


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(("count", "gap", "speed"), ((4, 0.005, 3.0), (4, 0.01, 1.0), (4, 0.02, 3.0), (4, 0.02, 10.0),
                                                     (10, 0.002, 5.0), (10, 0.01, 5.0), (10, 0.01, 10.0)))  # fmt: skip
def test_a_row_that_is_struck_keeps_its_momentum(count: int, gap: float, speed: float, device: str) -> None:
    """Bodies that come so close to the next within a step that they push it push it within that step, and who is pushed
    may stay behind the bodies that it was joined with."""
    model, x, v = row(count, gap, speed, device)
    mass = model.mass[:, None]
    first, shares = (mass * v).sum(0), []
    for _ in range(math.ceil((count - 1) * gap / speed / 0.01) + count):
        with dv.record("contact") as found:
            x, v = dv.step(model, x, v, dv.VBD(0.01, 10), mu=4e5, lam=4e5, gravity=(0.0, 0.0, 0.0))
        assert float(((mass * v).sum(0) - first).norm()) <= STEPS * tolerance("momentum") * float(first.norm())
        shares += [part.corrections for part in found]
    assert float(v[-1, 0]) > 0.05 * speed
    assert speed == 1 or any(bool((taken[..., 1] >= 0).any()) for part in shares for taken in part)  # held up


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("sweeps", (1, 5))
def test_a_row_too_long_for_one_system_moves_as_a_shorter_one(sweeps: int, device: str) -> None:
    """And keeps its momentum, though its motions do not sum to that of all. Solved for one by one, its bodies kept a
    tenth of this energy."""
    kept = []
    for count in (MOST_COUPLED - 6, MOST_COUPLED + 6):
        model, x, v = row(count, 5e-4, 1.0, device)
        mass = model.mass[:, None]
        first, energy = (mass * v).sum(0), float((mass * v**2).sum())
        for _ in range(3):
            x, v = dv.step(model, x, v, dv.VBD(0.01, sweeps), mu=4e5, lam=4e5, gravity=(0.0, 0.0, 0.0))
            assert float(((mass * v).sum(0) - first).norm()) <= STEPS * tolerance("momentum") * float(first.norm())
        kept.append(float((mass * v**2).sum()) / energy)
    assert kept[1] > 0.7 * kept[0] > 0


@pytest.mark.parametrize("device", DEVICES)
def test_a_step_goes_on_for_the_scenes_of_which_pairs_hold_something_up(device: str) -> None:
    model, x, v = row(10, 0.002, 5.0, device)
    scenes = torch.stack([v, 0.01 * v])

    def ends(v: torch.Tensor) -> tuple[torch.Tensor, list[Any]]:
        with dv.record("contact") as found:
            _, v = dv.step(model, x.expand_as(v), v, dv.VBD(0.01, 10), mu=4e5, lam=4e5,
                           gravity=(0.0, 0.0, 0.0))  # fmt: skip
        return v, found

    together, found = ends(scenes)
    extra = [part for part in found if part.going is not None]
    assert 1 < len(found) <= MOST_DETECTIONS and extra
    assert extra[0].going.flatten().tolist() == [True, False]
    assert [part.sweeps for part in found] == [10] * len(found)
    for one, many in zip(scenes, together, strict=True):
        assert torch.equal(ends(one)[0], many)
    assert sum(dv.contact.status(model).truncated) == 0


@pytest.mark.parametrize("device", DEVICES)
def test_no_body_passes_through_one_that_could_turn_inside_out(device: str) -> None:
    """In free flight they would have passed each other within the step, with the least potential of all."""
    model, x, v = meeting(40.0, device)
    v[:64, 1] = 40.0
    end, _ = dv.step(model, x, v, dv.VBD(1 / 60, 20), **MATERIAL)
    assert dv.contact.status(model).truncated[0] > 0
    assert float((end - (x + v / 60)).abs().max()) > 0.1


@pytest.mark.parametrize("device", DEVICES)
def test_corrections_of_a_row_that_is_struck_are_differentiated(device: str) -> None:
    model, x, v = row(4, 0.005, 3.0, device)
    weights = torch.linspace(-1.0, 1.0, x.numel(), dtype=x.dtype, device=x.device).reshape(x.shape)
    aside = torch.linspace(1.0, -0.5, x.numel(), dtype=x.dtype, device=x.device).reshape(x.shape).sin()

    def end(v: torch.Tensor) -> torch.Tensor:
        _, after = dv.step(model, x, v, dv.VBD(0.01, 3), mu=4e5, lam=4e5, gravity=(0.0, 0.0, 0.0))
        return (weights * after).sum()

    v = v + 1e-3 * aside.flip(0)  # alike velocities are a tie, where a step may jump
    start = v.clone().requires_grad_()
    with dv.record("contact") as found:
        (slope,) = torch.autograd.grad(end(start), start)
    assert any(bool((taken[..., 1] >= 0).any()) for taken in found[-1].corrections)
    eps = 1e-6
    difference = float(end(v + eps * aside) - end(v - eps * aside)) / (2 * eps)
    assert abs(difference) > 1e-3
    assert abs(float((slope * aside).sum()) - difference) <= tolerance("finite_difference") * abs(difference)
