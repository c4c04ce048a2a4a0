"""Claim: a rollout warns of what pairs held up and of friction that has not converged, and says what helps."""

import warnings
from typing import Any

import pytest
import torch
from helpers.two_boxes import two_boxes

import diffvbd as dv
from diffvbd.mesh import box
from diffvbd.step.contact_cycles import CUT
from diffvbd.step.held_up import SEVERAL, cut_share

FAST: dict[str, Any] = {"mu": 2e4, "lam": 4e4, "time_step": 0.002, "sweeps": 3}


def thrown() -> tuple[dv.Model, torch.Tensor, torch.Tensor]:
    """Two boxes that meet at speed."""
    model = two_boxes(detections=1)
    v = torch.zeros_like(model.rest_points)
    v[8:, 1] = -60.0
    return model, model.rest_points, v


def sliding(**friction: float) -> tuple[dv.Model, torch.Tensor, torch.Tensor]:
    floor = dv.FloorBarrier(height=-0.01, kappa=2e3)
    model = dv.Model(box(3, 0.2, split="kuhn"), energies=(dv.StableNeoHookean(), floor, dv.Friction(**friction)))
    v = torch.zeros_like(model.rest_points)
    v[:, 0] = 1e-3
    return model, model.rest_points, v


def messages(run: Any) -> list[str]:
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        run()
    return [str(w.message) for w in found]


def test_motion_that_pairs_held_up_is_warned_of() -> None:
    model, x, v = thrown()
    with pytest.warns(UserWarning, match=r"pair_barrier: pairs held up .* larger reach") as found:
        dv.rollout(model, x, v, steps=1, check_contact=True, **FAST)
    assert found[0].filename == __file__
    assert sum("pairs held up" in str(w.message) for w in found) == 1
    assert cut_share(model) > CUT


def test_friction_that_has_not_converged_is_warned_of() -> None:
    model, x, v = sliding(coefficient=0.5, velocity=1e-4)
    stiff: dict[str, Any] = {"mu": 1e5, "lam": 2e5, "time_step": 0.01}
    with pytest.warns(UserWarning, match=r"friction: .* not balanced .*more sweeps .*a smaller time_step") as found:
        dv.rollout(model, x, v, steps=10, sweeps=1, **stiff)
    said = [str(w.message) for w in found]  # of the friction, and of the motion
    assert len(said) == 2 and said[1].startswith("sweeps:") and found[0].filename == __file__
    assert messages(lambda: dv.rollout(model, x, v, steps=10, sweeps=1, **stiff)) == said  # each time
    soft, x, v = sliding(coefficient=0.5, velocity=0.1)
    assert not messages(lambda: dv.rollout(soft, x, v, steps=10, sweeps=400, **stiff))


def test_it_is_said_once_by_any_schedule_and_changes_nothing() -> None:
    model, x, v = thrown()
    ends = []
    for every in (None, 3, dv.BinomialCheckpoints(2)):
        for check in (True, False):
            start = v.clone().requires_grad_()

            def run(start: torch.Tensor = start, every: Any = every, check: bool = check) -> None:
                end = dv.rollout(model, x, start, steps=3, checkpoint_every=every, check_contact=check, **FAST)
                ends.append((end.x[-1].detach(), torch.autograd.grad(end.x[-1].square().sum(), start)[0]))

            assert sum("pairs held up" in text for text in messages(run)) == int(check)
    for end, slope in ends[1:]:
        assert torch.equal(end, ends[0][0]) and torch.equal(slope, ends[0][1]) and slope.any()


def test_bad_input() -> None:
    model, x, v = thrown()
    with pytest.raises(TypeError, match="check_contact: expected a bool or None, got str"):
        dv.rollout(model, x, v, steps=1, check_contact="yes", **FAST)  # pyright: ignore[reportArgumentType]


def test_steps_made_one_by_one_are_warned_of_once_pairs_have_held_up_several() -> None:
    """Prescribed motion of 6 mm a step, where a body may go 2 mm beside another."""
    lower, upper = box(2, 0.1), box(2, 0.1).translate((0.0, 0.103, 0.0))
    barrier = dv.PairBarrier(kappa=1e3, dhat=2e-3, detections=1, reach=6e-3)
    mesh = dv.mesh.join([lower, upper])
    held = torch.from_numpy(mesh.points[:, 1] < 0.05)
    model = dv.Model(mesh, pinned=held, energies=(dv.StableNeoHookean(), barrier))
    x, v = model.rest_points, torch.zeros_like(model.rest_points)
    shares, said = [], []
    for k in range(SEVERAL + 6):
        goal = torch.where(held[:, None], model.rest_points + torch.tensor([0.0, 6e-3 * (k + 1), 0.0]), torch.nan)
        after: list[tuple[torch.Tensor, torch.Tensor]] = []
        said.append(messages(lambda: after.append(dv.step(model, x, v, prescribed=goal, **FAST))))  # noqa: B023
        x, v = after[0]
        shares.append(float(cut_share(model)) > CUT)
    assert sum(shares) >= SEVERAL
    late = next(k for k in range(len(shares)) if k + 1 >= SEVERAL and all(shares[k + 1 - SEVERAL : k + 1]))  # first
    assert [bool(texts) for texts in said] == [k == late for k in range(len(said))]
    assert f"more than 1 % in each of the last {SEVERAL}" in said[late][0] and "larger reach" in said[late][0]
