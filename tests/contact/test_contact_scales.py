"""Claim: steps with contact and friction do the same at any size of the scene, in single precision as well."""

import math
from typing import Any

import numpy as np
import pytest
import torch

import diffvbd as dv
from diffvbd.testing import generator, relative_error, tolerance

SIZES = (200.0, 1e-3, 2e-5)  # of the scene's edge of 0.2 m, as factors


def end_of(size: float, dtype: torch.dtype, own: bool) -> tuple[torch.Tensor, torch.Tensor]:
    """State and slope by the start velocity, in units of the size, of a cube that lands on its edge and turns. Moduli,
    stiffness and gravity grow with the size such that the motion does not."""
    cube = dv.mesh.cube(3, size=0.2)
    angle = torch.tensor(0.3, dtype=torch.float64)
    turn = torch.stack([torch.stack([angle.cos(), angle.sin()]), torch.stack([-angle.sin(), angle.cos()])])
    points = torch.tensor(cube.points)
    points = torch.cat([points[:, :2] @ turn, points[:, 2:]], 1)
    points[:, 1] += 0.012 - points[:, 1].min()
    mesh = dv.TetMesh((size * points).numpy(), cube.tets)
    energies = (
        dv.StableNeoHookean(),
        dv.FloorBarrier(kappa=1e4 * size**3, dhat=0.02 * size),
        dv.PairBarrier(kappa=1e4 * size**3, dhat=0.02 * size, self_contact=own),
        dv.Friction(0.4, velocity=0.01 * size),
    )
    model = dv.Model(mesh, energies=energies, dtype=dtype)
    jitter = torch.randn((27, 3), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    x = model.rest_points + (1e-3 * size * jitter).to(dtype)  # lest it is at a kink
    v = 5.0 * torch.linalg.cross(torch.tensor([0.3, 0.1, 1.0], dtype=dtype).expand_as(x), x - x.mean(0))
    v.requires_grad_()
    given: dict[str, Any] = {"mu": 1e5 * size**2, "lam": 2e5 * size**2, "solver": dv.VBD(0.01, 5)}
    end = dv.rollout(model, x, v, steps=8, gravity=(0.0, -9.81 * size, 0.0), save="last", **given).x[-1] / size
    weights = torch.linspace(-1, 1, end.numel(), dtype=dtype).reshape(end.shape)
    (slope,) = torch.autograd.grad((weights * end).sum(), v)
    return end.detach().double(), slope.double() * size


@pytest.mark.parametrize("own", (False, True))
@pytest.mark.parametrize("size", SIZES)
def test_a_scene_of_another_size(size: float, own: bool) -> None:
    end, slope = end_of(1.0, torch.float64, own)
    scaled = end_of(size, torch.float64, own)
    for one, other in zip(scaled, (end, slope), strict=True):
        assert torch.isfinite(one).all() and relative_error(one, other) < tolerance("property_factor") * tolerance(
            "contact_adjoint"
        )
    assert slope.abs().max() > 0


@pytest.mark.parametrize("size", SIZES)
def test_in_single_precision(size: float) -> None:
    for one, other in zip(end_of(size, torch.float32, True), end_of(1.0, torch.float32, True), strict=True):
        assert torch.isfinite(one).all() and relative_error(one, other) < tolerance("property_factor") * tolerance(
            "float32_forward"
        )


# --- turned scenes ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("dtype", "bar"), [(torch.float64, "property_subset"), (torch.float32, "float32_forward")])
@pytest.mark.parametrize("sweeps", [1, 2])
@pytest.mark.parametrize("kappa", [50.0, 3000.0])  # the cube begins nearer to the plane than a start may bring it
def test_a_turned_scene_moves_as_it_did(kappa: float, sweeps: int, dtype: torch.dtype, bar: str, device: str) -> None:
    cube = dv.mesh.cube(2, size=0.2, split="kuhn").translate((0.0, 4e-4, 0.0))

    def way(turn: np.ndarray) -> torch.Tensor:
        """Where it gets, turned back."""
        plane = dv.colliders.Plane((0, 0, 0), tuple(turn @ [0.0, 1.0, 0.0]))
        barrier = dv.PairBarrier(kappa=kappa, dhat=0.01, self_contact=False)
        model = dv.Model(dv.TetMesh(cube.points @ turn.T, cube.tets), density=500.0, device=device, dtype=dtype,
                         energies=(dv.StableNeoHookean(), barrier), colliders=[plane])  # fmt: skip
        x = model.rest_points
        motion = dv.rollout(model, x, torch.zeros_like(x), dv.VBD(0.005, sweeps), mu=1e5, lam=1e5, steps=20,
                            gravity=tuple(turn @ [3.0, -9.81,
                                                  0.0]), save="last", checks=dv.Checks(contact=False,
                                                                                       energy=False))  # fmt: skip
        return (motion.x[-1] - x).cpu().double() @ torch.from_numpy(turn)

    still, rng = way(np.eye(3)), generator("turned")
    assert still[:, 0].min() > 0.01
    for _ in range(3):
        turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        turn *= np.sign(np.linalg.det(turn))
        assert (way(turn) - still).abs().max() <= tolerance(bar)


# --- float32 far from the origin --------------------------------------------------------------------------------------


OFFSET = np.array((100.0, 50.0, -30.0))  # [m], where 32 roundings of a position are 0.7 mm
GAP = 4e-4


@pytest.mark.parametrize("v", [(0.0, 1.0, 0.0), (1.0, 0.0, 0.5)], ids=("away", "along"))
def test_a_body_goes_as_in_float64(v: tuple[float, float, float], device: str) -> None:
    """It begins in balance with its weight, some 0.4 mm above a plane."""

    def way(dtype: torch.dtype) -> torch.Tensor:
        barrier = dv.PairBarrier(kappa=1500.0, dhat=5e-3, self_contact=False)
        model = dv.Model(dv.mesh.cube(2, size=0.2).translate(OFFSET + (0.0, GAP, 0.0)), density=500.0, dtype=dtype,
                         energies=(dv.StableNeoHookean(), barrier), device=device,
                         colliders=[dv.colliders.Plane(tuple(OFFSET))])  # fmt: skip
        x = model.rest_points
        velocity = x.new_tensor(v).expand_as(x).contiguous()
        motion = dv.rollout(model, x, velocity, dv.VBD(0.005, 20), mu=1e5, lam=1e5, steps=20, save="last")
        assert len(dv.contact.intersections(model, motion.x[-1])) == 0
        return (motion.x[-1] - x).double().cpu()

    exact, single = way(torch.float64), way(torch.float32)
    assert exact.norm(dim=-1).min() > 0.04
    assert (single - exact).abs().max() <= tolerance("contact_float32") * exact.abs().max()


# --- frames that move -------------------------------------------------------------------------------------------------


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
        end, _ = dv.step(model, x, v, dv.VBD(TIME_STEP, 150), mu=1e5, lam=1e5, gravity=(0.0, 0.0, 0.0),
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
    given = {"mu": 1e5, "lam": 1e5, "solver": dv.VBD(TIME_STEP, 5)}
    with pytest.raises(ValueError, match=r"colliders: expected feasible motion"):
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
        motion = dv.rollout(model, x, v, dv.VBD(TIME_STEP, 150), steps=steps, mu=1e5, lam=1e5, colliders_before=at,
                            colliders=dv.per_step(at + times[:, None, None] * frame), save="last")  # fmt: skip
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


# --- flight -----------------------------------------------------------------------------------------------------------


BARRIER = dv.PairBarrier(kappa=400.0, dhat=0.02, self_contact=False, damping=8.0, detections=1, reach=0.1)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("spin", [0.0, 3.0])
def test_nobody_is_held_up_in_flight(device: str, dtype: torch.dtype, spin: float) -> None:
    bodies = [dv.mesh.box(3, 0.3).translate((0.7 * k - 0.4, 2.5 + 0.4 * k, 0.3 * k)) for k in range(3)]
    energies = (dv.StableNeoHookean(), dv.FloorBarrier(kappa=400.0, dhat=0.02), BARRIER)
    model = dv.Model(dv.mesh.join(bodies), density=1000.0, energies=energies, dtype=dtype, device=device)
    x = model.rest_points
    arm = x - torch.stack([x[model.body == k].mean(0) for k in range(3)])[model.body]
    v = torch.linalg.cross(arm.new_tensor([0.3, spin, 0.1]).expand_as(arm), arm) + arm.new_tensor([0.4, -0.2, 0.1])
    made = []
    for _ in range(12):
        with dv.record("contact") as found:
            x, v = dv.step(model, x, v, dv.VBD(1 / 150, 2), mu=2e4, lam=2e4)
        made.extend(len(d.corrections) for d in found if d.corrections is not None)
        assert dv.contact.status(model).truncated == [0]
    assert made == [2] * 12
