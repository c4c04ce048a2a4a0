"""Claim: no executed step lets surfaces cross, at any speed and any K, and the bounds that see to it cost nothing in
common motion. The independent check compares every edge with every triangle (dv.contact.intersections)."""

import itertools
import math
import sys
from typing import Any

import numpy as np
import pytest
import torch
from helpers.marks import slow
from torch import Tensor

import diffvbd as dv
from diffvbd import colliders
from diffvbd.mesh import TetMesh, box, join
from diffvbd.testing import generator, relative_error, tolerance

GRAVITY = 9.81  # [m/s^2]
WEIGHTLESS = (0.0, 0.0, 0.0)
MATERIAL: dict[str, Any] = {"mu": 2e4, "lam": 4e4}  # [Pa]


def barrier(**options: Any) -> dv.PairBarrier:
    return dv.PairBarrier(**({"kappa": 1e4, "dhat": 5e-3} | options))


def turned(mesh: TetMesh, rng: np.random.Generator) -> TetMesh:
    """Turned about its middle at random."""
    rotation, upper = np.linalg.qr(rng.standard_normal((3, 3)))
    rotation *= np.sign(np.diag(upper))
    rotation[:, 0] *= np.linalg.det(rotation)
    middle = mesh.points.mean(0)
    return TetMesh((mesh.points - middle) @ rotation.T, mesh.tets)


def apart(model: dv.Model, x: Tensor) -> bool:
    return bool(torch.isfinite(x).all()) and len(dv.contact.intersections(model, x)) == 0


def skin(model: dv.Model) -> Tensor:
    """Vertices of the surface: those inside a body touch nothing."""
    return model.surface.unique()


def thrown_together(seed: int, *, pinned: bool = False, floor: bool = False, **options: Any) -> tuple[dv.Model, Tensor]:
    """Three turned boxes around the origin, and unit velocities [V, 3] toward it with spin and noise."""
    rng = generator("thrown", seed)
    middles = 0.2 * np.array([[math.cos(a), 0.2 * a, math.sin(a)] for a in (0.0, 2.1, 4.2)])
    sizes = rng.uniform(0.08, 0.14, (3, 3))
    bodies = [turned(box(3, size), rng).translate(middle) for size, middle in zip(sizes, middles, strict=True)]
    energies: list[Any] = [dv.StableNeoHookean(), barrier(**options)]
    if floor:
        lowest = min(b.points[:, 1].min() for b in bodies)
        energies.append(dv.FloorBarrier(height=lowest - 0.01, kappa=1e4, dhat=5e-3))
    model = dv.Model(join(bodies), energies=energies, pinned=range(4) if pinned else None)
    toward = -torch.from_numpy(middles / np.linalg.norm(middles, axis=1, keepdims=True))[model.body]
    noise = torch.from_numpy(rng.normal(scale=0.2, size=(model.num_vertices, 3)))
    return model, torch.where(model.pinned[:, None], 0.0, toward + noise)


# Quick are those in which each two of the three arguments meet once.
PLACES = [at for at in itertools.product(range(3), repeat=3)]
THROWS = [(i, (1.0, 10.0, 1e3)[j], (1, 2, 4)[k]) for i, j, k in PLACES]


@pytest.mark.parametrize(
    ("seed", "speed", "detections"),
    [throw if sum(at) % 3 == 0 else slow(*throw) for at, throw in zip(PLACES, THROWS, strict=True)],
)
def test_nothing_crosses_at_any_speed(seed: int, speed: float, detections: int) -> None:
    model, v = thrown_together(seed, pinned=seed == 2, detections=detections)
    x, v, near = model.rest_points, speed * v, math.inf
    for step in range(24):
        x, v = dv.step(model, x, v, dv.VBD(1 / 60, (1, 4, 0, 7)[step % 4]), gravity=WEIGHTLESS, **MATERIAL)
        assert apart(model, x), f"step {step}"
        near = min(near, *dv.contact.status(model).smallest_gap)
    assert model.contact is not None and 0 < near < model.contact.dhat  # they did meet


@pytest.mark.parametrize("detections", (1, 2, 4))
@pytest.mark.parametrize("sweeps", (0, 1, 5))
def test_boxes_side_by_side_fall_freely(device: str, sweeps: int, detections: int) -> None:
    """Eight boxes 1 mm apart at 10 m/s and faster: no bound cuts anything, x_n = x_0 + n h v + g h^2 n (n + 1) / 2."""
    offsets = [0.101 * np.array([i, j, k]) for i in range(2) for j in range(2) for k in range(2)]
    tets = join([box(2, 0.1).translate(offset) for offset in offsets])
    model = dv.Model(tets, energies=(dv.StableNeoHookean(), barrier(dhat=5e-4, detections=detections)), device=device)
    start, h, n = model.rest_points, 1 / 60, 20
    velocity = torch.tensor([0.5, -10.0, 0.2], dtype=torch.float64, device=device)
    x, v = start, velocity.expand_as(start)
    for _ in range(n):
        x, v = dv.step(model, x, v, dv.VBD(h, sweeps), **MATERIAL)
        status = dv.contact.status(model)
        assert status.truncated == [0] and status.smallest_gap[0] > 5e-4  # dhat; some parts do not look as far as 1 mm
    gravity = torch.tensor([0.0, -GRAVITY, 0.0], dtype=torch.float64, device=device)
    assert relative_error(x, start + n * h * velocity + gravity * h**2 * n * (n + 1) / 2) <= tolerance("free_fall")


@pytest.mark.parametrize("detections", (1, 2, 4))
@pytest.mark.parametrize("speed", (0.1, 5.0, 200.0))
def test_edges_that_cross_do_not_pass(speed: float, detections: int) -> None:
    """Two edges of 1 m, 1 mm apart where they cross and half a meter from any vertex."""
    lower = TetMesh([[-0.5, 0, 0], [0.5, 0, 0], [0, -0.3, -0.5], [0, -0.3, 0.5]], [[0, 1, 2, 3]], orient=True)
    upper = TetMesh([[0, 1e-3, -0.5], [0, 1e-3, 0.5], [-0.5, 0.3, 0], [0.5, 0.3, 0]], [[0, 1, 2, 3]], orient=True)
    energies = (dv.StableNeoHookean(), barrier(kappa=1e3, dhat=1e-2, detections=detections))
    model = dv.Model(join([lower, upper]), density=50.0, energies=energies)
    x = model.rest_points
    v = torch.zeros_like(x)
    v[:, 1] = torch.where(model.body == 0, speed, -speed)
    for _ in range(10):
        x, v = dv.step(model, x, v, dv.VBD(1 / 60, 3), mu=1e3, lam=1e3, gravity=WEIGHTLESS)
        a, b, c, d = x[[0, 1, 4, 5]]
        assert float(torch.dot(torch.linalg.cross(d - c, b - a), c - a)) > 0  # the upper edge is still above
        assert apart(model, x)


# --- what bounds cut, and what is reported of it ---------------------------------------------------------------------


@pytest.mark.parametrize("detections", (1, 2, 4))
def test_cut_vertices_are_reported(device: str, detections: int) -> None:
    """By no sweep the step is the predictor, except where a bound has cut: as many vertices as status says. Per scene:
    the second one stands still."""
    model, v = thrown_together(0, detections=detections)
    model = model.to(device)
    x = model.rest_points.expand(2, -1, -1).contiguous()
    v = torch.stack([20.0 * v, 0.0 * v]).to(device)
    still = {"gravity": WEIGHTLESS, **MATERIAL}
    end, after = dv.step(model, x, v, dv.VBD(1 / 60, 0), **still)
    moved = (end - (x + v / 60)).norm(dim=-1) > 1e-12
    cut = dv.contact.status(model).truncated
    assert cut[1] == 0 and not moved[1].any() and 0 < cut[0] <= model.num_vertices
    if detections == 1:
        assert int(moved[0].sum()) == cut[0]
    else:  # a later part may catch up with what an earlier one has cut
        assert 0 < int(moved[0].sum()) <= cut[0]
    # what is cut is lost as velocity
    assert float((after - (end - x) * 60).abs().max()) <= tolerance("cancelling") * float(v.abs().max())
    dv.step(model, end, 0.01 * v, dv.VBD(1 / 60, 4), **still)
    gaps = dv.contact.status(model).smallest_gap
    assert gaps[0] != gaps[1] and min(gaps) > 0


# --- pinned, prescribed, colliders -----------------------------------------------------------------------------------


def falling_on(speed: float, **options: Any) -> tuple[dv.Model, Tensor, Tensor]:
    """A box 1 cm above a slab that is pinned."""
    tets = join([box(2, (0.4, 0.1, 0.4)), turned(box(3, 0.1), generator("fall")).translate((0.2, 0.2, 0.2))])
    model = dv.Model(tets, energies=(dv.StableNeoHookean(), barrier(**options)), pinned=range(8))
    x = model.rest_points.clone()
    x[8:, 1] += 0.11 - x[8:, 1].min()
    v = torch.zeros_like(x)
    v[8:, 1] = -speed
    return model, x, v


@pytest.mark.parametrize("detections", (1, 2, 4))
@pytest.mark.parametrize("speed", (0.0, 3.0, 300.0))
def test_a_pinned_body_is_not_crossed(speed: float, detections: int) -> None:
    model, x, v = falling_on(speed, detections=detections)
    for _ in range(12):
        x, v = dv.step(model, x, v, dv.VBD(1 / 60, 5), **MATERIAL)
        assert apart(model, x) and torch.equal(x[:8], model.rest_points[:8])
        points = x[skin(model)[8:]]
        assert not ((points >= 0) & (points <= torch.tensor([0.4, 0.1, 0.4], dtype=torch.float64))).all(-1).any()


def test_a_prescribed_body_pushes() -> None:
    """A slab that rises at 0.2 m/s under a box carries it along, itself exactly where it was told to be."""
    model, x, v = falling_on(0.0, dhat=0.02)
    h, rise = 1 / 100, torch.tensor([0.0, 0.2 / 100, 0.0], dtype=torch.float64)
    start = x
    for n in range(40):
        x, v = dv.step(
            model, x, v, dv.VBD(h, 8), prescribed=torch.where(model.pinned[:, None], x + rise, x), **MATERIAL
        )
        assert apart(model, x)
        assert relative_error(x[:8], start[:8] + (n + 1) * rise) <= tolerance("formula")
        assert dv.contact.status(model).infeasible == 0
    assert float(v[8:, 1].mean()) == pytest.approx(0.2, rel=tolerance("carried"))


@pytest.mark.parametrize(("detections", "height"), ((1, 0.008), (2, 0.0085), (4, 0.009)))
def test_prescribed_motion_above_a_bound(device: str, value_checks: None, detections: int, height: float) -> None:
    """The gap is 1 cm at first; every part may close 0.9 of what the parts before have left."""
    model, x, v = falling_on(0.0, detections=detections)
    model, x, v = model.to(device), x.to(device), v.to(device)
    step: dict[str, Any] = {"gravity": WEIGHTLESS, **MATERIAL, "solver": dv.VBD(1 / 100, 4)}
    up = torch.tensor([0.0, height, 0.0], dtype=torch.float64, device=device) * model.pinned[:, None]
    end, _ = dv.step(model, x, v, prescribed=x + up, **step)
    assert dv.contact.status(model).infeasible == 0 and apart(model, end)
    with pytest.raises(ValueError, match=r"prescribed or colliders: expected feasible motion, got \d+ pairs .*"
                                         rf"in substep \d of {detections} .* a motion of .* m: move it"):  # fmt: skip
        dv.step(model, x, v, prescribed=x + 2 * up, **step)
    assert dv.contact.status(model).infeasible > 0


def ball(detections: int, dhat: float = 5e-3, device: str = "cpu") -> dv.Model:
    """A box, and 5 cm below it a sphere of 20 cm."""
    sphere = colliders.Sphere((0.1, -0.25, 0.1), 0.2)
    energies = (dv.StableNeoHookean(), barrier(reach=0.2, dhat=dhat, detections=detections))
    return dv.Model(box(3, 0.2), energies=energies, colliders=[sphere], device=device)


def test_a_collider_above_its_bound_raises_and_in_smaller_parts_does_not(device: str) -> None:
    """0.9 of the gap are 4.5 cm: 4.6 cm are too far in one part, and not in several."""
    up = torch.tensor([0.0, 0.046, 0.0], dtype=torch.float64, device=device)
    for detections in (1, 2, 4):
        model = ball(detections, device=device)
        x, before = model.rest_points, model.collider_points
        options: dict[str, Any] = {"gravity": WEIGHTLESS, **MATERIAL, "solver": dv.VBD(0.01, 4)}
        options |= {"colliders": before + up, "colliders_before": before}
        if detections == 1:
            with pytest.raises(ValueError, match=r"prescribed or colliders: .* got \d+ pairs in substep 0 of 1"):
                dv.step(model, x, torch.zeros_like(x), **options)
        else:
            end, _ = dv.step(model, x, torch.zeros_like(x), **options)
            assert float((end - before - up).norm(dim=-1).min()) > 0.2
        assert (dv.contact.status(model).infeasible > 0) == (detections == 1)


@pytest.mark.parametrize(("before", "after"), [(0.0, 0.046), (0.06, 0.06)], ids=["too far", "touching"])
def test_a_captured_step_loses_the_scene_alone_that_is_not_valid(
    before: float, after: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where nothing may be read, as in a captured step, on the CPU."""
    model, v = ball(1), torch.zeros(2, 27, 3, dtype=torch.float64)
    up = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64) * torch.tensor([[[1.0]], [[0.5]]])
    x = model.rest_points.expand(2, -1, -1)
    given: dict[str, Any] = {"colliders": model.collider_points + after * up, "gravity": WEIGHTLESS, **MATERIAL,
                             "colliders_before": model.collider_points + before * up}  # fmt: skip
    one = {name: given[name][1:] if name.startswith("colliders") else value for name, value in given.items()}
    alone, _ = dv.step(model, x[1:], v[1:], dv.VBD(0.01, 4), **one)
    step = sys.modules["diffvbd.step.contact"]
    monkeypatch.setattr(step, "is_captured", lambda x: True)
    monkeypatch.setattr(step, "may_read", lambda x: False)
    end, _ = dv.step(model, x, v, dv.VBD(0.01, 4), **given)
    assert bool(end[0].isnan().all()) and torch.equal(end[1], alone[0])
    status = dv.contact.status(model)
    assert (status.infeasible > 0) == (after > before) and (status.touching > 0) == (after == before)


@pytest.mark.parametrize("detections", (1, 2, 4))
def test_a_moving_sphere_pushes_and_does_not_enter(detections: int) -> None:
    model = ball(detections, dhat=0.02)
    x, points, h = model.rest_points, model.collider_points, 1 / 100
    v, up = torch.zeros_like(x), torch.tensor([0.0, 0.004, 0.0], dtype=torch.float64)
    for n in range(30):
        x, v = dv.step(model, x, v, dv.VBD(h, 5), gravity=WEIGHTLESS, colliders_before=points + n * up,
                       colliders=points + (n + 1) * up, **MATERIAL)  # fmt: skip
        assert float((x - points[0] - (n + 1) * up).norm(dim=-1).min()) > 0.2 and apart(model, x)
    assert float((x - model.rest_points)[:, 1].mean()) > 0.06


@pytest.mark.parametrize("shape", ("capsule", "obstacle", "plane"))
@pytest.mark.parametrize("speed", (1.0, 100.0))
def test_no_collider_is_entered(shape: str, speed: float) -> None:
    wall = [[-1.0, -0.06, -1.0], [1.0, -0.05, -1.0], [0.0, -0.05, 2.0]]
    things: dict[str, colliders.Collider] = {
        "capsule": colliders.Capsule((-0.5, -0.1, 0.1), (0.5, -0.12, 0.1), 0.05),
        "obstacle": colliders.Obstacle(wall, [[0, 2, 1]]),
        "plane": colliders.Plane((0.0, -0.05, 0.0), (0.1, 1.0, 0.0)),
    }
    model = dv.Model(box(3, 0.2), energies=(dv.StableNeoHookean(), barrier()), colliders=[things[shape]])
    x = model.rest_points
    v = torch.zeros_like(x)
    v[:, 1] = -speed
    corners, lowest = model.collider_points, 0.0
    for _ in range(12):
        x, v = dv.step(model, x, v, dv.VBD(1 / 60, 4), **MATERIAL)
        assert torch.isfinite(x).all()
        lowest = min(lowest, float(x[:, 1].min()))
        points = x[skin(model)]
        if shape == "capsule":
            axis = corners[1] - corners[0]
            t = ((points - corners[0]) @ axis / axis.dot(axis)).clamp(0, 1)
            assert float((points - corners[0] - t[:, None] * axis).norm(dim=-1).min()) > 0.05
        else:  # the box stays over the inside of the triangle
            a, b, c = corners if shape == "plane" else corners[[0, 2, 1]]
            normal = torch.linalg.cross(b - a, c - a)
            assert float(((points - a) @ normal).min()) > 0
    assert lowest < 0.0  # it has fallen toward it


# --- a start that touches --------------------------------------------------------------------------------------------


TOUCHING = {"face": (0.0, 0.2, 0.0), "inside": (0.05, 0.2, 0.05), "corner": (0.2, 0.2, 0.2)}


@pytest.mark.parametrize("offset", TOUCHING.values(), ids=TOUCHING)
def test_a_start_that_touches_raises(device: str, offset: tuple[float, float, float]) -> None:
    model = dv.Model(join([box(2, 0.2), box(2, 0.2).translate(offset)]), energies=(dv.StableNeoHookean(), barrier()),
                     device=device)  # fmt: skip
    x = model.rest_points
    said = (
        r"do not touch, got \d+ pairs without a gap at the start of .* scene 0: move them apart, best by about dhat, 0"
    )
    with pytest.raises(ValueError, match="x: expected surfaces that " + said):
        dv.step(model, x, torch.zeros_like(x), dv.VBD(0.01, 1), **MATERIAL)
    assert dv.contact.status(model).touching > 0


def test_a_plane_moved_through_a_body_raises() -> None:
    plane = colliders.Plane((0.0, -0.05, 0.0))
    model = dv.Model(box(2, 0.2), energies=(dv.StableNeoHookean(), barrier()), colliders=[plane])
    x, up = model.rest_points, torch.tensor([0.0, 0.3, 0.0], dtype=torch.float64)
    with pytest.raises(ValueError, match=r"expected feasible motion, .* body 0 and collider 0 in .* of 0.3 m"):
        dv.step(model, x, torch.zeros_like(x), dv.VBD(0.01, 1), colliders=model.collider_points + up,
                colliders_before=model.collider_points, **MATERIAL)  # fmt: skip
