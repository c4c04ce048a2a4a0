"""Claim: on a collider that moves with it a body does what it does on one at rest: friction and damping have the forces
at the start of a step, wherever the collider goes in it."""

import math

import pytest
import torch

import diffvbd as dv
from diffvbd.testing import tolerance

TIME_STEP, DHAT = 0.005, 0.004
SPEEDS = ((0.0, -5.0, 0.0), (0.0, 5.0, 0.0), (0.0, -0.4, 0.0), (0.7, 0.3, -0.5))  # [m/s], of the first 25 mm a step


def turned(points: torch.Tensor, angle: float) -> torch.Tensor:
    """Points that have turned about the z axis."""
    c, s = math.cos(angle), math.sin(angle)
    return points @ points.new_tensor(((c, s, 0.0), (-s, c, 0.0), (0.0, 0.0, 1.0)))


def test_a_plane_that_turns_away_rubs_as_where_its_points_are(device: str) -> None:
    """It goes down by 60 mm a step where the body is, three meters from the axis, and its points are there or at it."""
    energies = (dv.StableNeoHookean(), dv.PairBarrier(1e4, DHAT, self_contact=False, detections=1), dv.Friction(0.4))
    mesh = dv.mesh.cube(2, size=0.1).translate((3.0, 0.8 * DHAT, 0.0))

    def way(of_points: float) -> torch.Tensor:
        """Of the body beside its free flight."""
        model = dv.Model(mesh, energies=energies, colliders=[dv.colliders.Plane((of_points, 0.0, 0.0))], device=device)
        x, at = model.rest_points, model.collider_points
        v = x.new_tensor((0.3, -0.05, 0.1)).expand_as(x)
        end, _ = dv.step(model, x, v, mu=1e5, lam=1e5, time_step=TIME_STEP, sweeps=150, gravity=(0.0, 0.0, 0.0),
                         colliders=turned(at, -0.02), colliders_before=at)  # fmt: skip
        return end - x - TIME_STEP * v

    near, far = way(3.0), way(0.0)
    assert near.abs().max() > 0.01 * DHAT and (far - near).abs().max() <= tolerance("property_subset")


def test_a_plane_that_leaves_no_way_raises(device: str) -> None:
    """It comes from below a body that stays, or begins above its lowest vertices."""
    mesh = dv.mesh.cube(2, size=0.1).translate((0.0, 0.8 * DHAT, 0.0))
    model = dv.Model(mesh, energies=(dv.StableNeoHookean(), dv.PairBarrier(1e4, DHAT, self_contact=False)),
                     colliders=[dv.colliders.Plane()], device=device)  # fmt: skip
    x, at = model.rest_points, model.collider_points
    up = at.new_tensor((0.0, 2 * DHAT, 0.0))
    given = {"mu": 1e5, "lam": 1e5, "time_step": TIME_STEP, "sweeps": 5}
    with pytest.raises(ValueError, match=r"colliders: expected motion that leaves bodies a way"):
        dv.step(model, x, torch.zeros_like(x), colliders=at + up, colliders_before=at, **given)
    for end in (at, at + up, at - up):
        with pytest.raises(ValueError, match=r"colliders: expected surfaces that do not touch"):
            dv.step(model, x, torch.zeros_like(x), colliders=end, colliders_before=at + 0.5 * up, **given)
    model = model.replace(colliders=[dv.colliders.Plane((2.0, 0.0, 0.0))])
    end = turned(model.collider_points, 0.01)
    v = up.expand_as(x) / TIME_STEP
    rising = {"colliders": end, "colliders_before": model.collider_points}
    step, _ = dv.step(model, x + up.new_tensor((3.0, 0.0, 0.0)), 4 * v, **rising, **given)  # goes ahead of it
    assert torch.isfinite(step).all()


def block_below() -> dv.colliders.Obstacle:
    below = dv.mesh.cube(2, size=1.0).translate((-0.4, -1.0, -0.4))
    return dv.colliders.Obstacle(below.points, below.surface)


@pytest.mark.parametrize("shape", ["plane", "obstacle"])
@pytest.mark.parametrize("part", ["friction", "damping", "both"])
def test_friction_and_damping_do_not_depend_on_the_frame(part: str, shape: str, device: str) -> None:
    collider = dv.colliders.Plane() if shape == "plane" else block_below()
    damping = 0.0 if part == "friction" else 20.0
    energies = (dv.StableNeoHookean(), dv.PairBarrier(1e4, DHAT, self_contact=False, detections=1, damping=damping),
                *(() if part == "damping" else (dv.Friction(0.4),)))  # fmt: skip
    mesh = dv.mesh.cube(2, size=0.1).translate((0.0, 0.8 * DHAT, 0.0))
    model = dv.Model(mesh, energies=energies, colliders=[collider], device=device)
    x, at = model.rest_points, model.collider_points
    own = x.new_tensor((0.3, -0.05, 0.1))

    def end(frame: torch.Tensor, steps: int = 3) -> tuple[torch.Tensor, torch.Tensor]:
        """Where the body is in the frame, and the gradient of a sum of that by its velocity."""
        times = TIME_STEP * torch.arange(1, steps + 1, dtype=x.dtype, device=device)
        v = (own + frame).expand_as(x).clone().requires_grad_()
        motion = dv.rollout(model, x, v, steps=steps, mu=1e5, lam=1e5, time_step=TIME_STEP, sweeps=150,
                            colliders=dv.per_step(at + times[:, None, None] * frame), colliders_before=at,
                            save="last")  # fmt: skip
        found = motion.x[-1] - times[-1] * frame
        weights = torch.linspace(-1, 1, found.numel(), dtype=x.dtype, device=device).view_as(found)
        return found.detach(), torch.autograd.grad((weights * found).sum(), v)[0]

    still, still_bar = end(torch.zeros_like(own))
    free = x + 3 * TIME_STEP * own
    assert (still - free)[:, 0].mean() < -0.01 * DHAT or part == "damping", "friction slows it down"
    for speed in SPEEDS:
        moved, moved_bar = end(x.new_tensor(speed))
        assert (moved - still).abs().max() <= tolerance("property_subset")
        assert still_bar.abs().max() > 0 and (moved_bar - still_bar).abs().max() <= tolerance("property_subset")
