"""Claim: converged sweeps with contact are mechanics: bodies rest where the barrier carries them, pairs push equally
and oppositely, and a collision keeps what it must. Sweeps are converged on purpose; K is stated with each test."""

import math
from typing import Any

import pytest
import torch
from torch import Tensor

import diffvbd as dv
from diffvbd.mesh import box, join
from diffvbd.reference.distance import distance, log_barrier, weight
from diffvbd.testing import tolerance

GRAVITY = 9.81  # [m/s^2]


def per_body(model: dv.Model, values: Tensor) -> Tensor:
    """Sums of vertex values [V, n] over each body."""
    return torch.stack([values[model.body == k].sum(0) for k in range(int(model.body.max()) + 1)])


def pair_forces(model: dv.Model, x: Tensor, detection: dv.contact.Detection) -> tuple[Tensor, Tensor]:
    """Force of the barrier on every corner point at the state x [N], by autograd, and e b' of each listed pair."""
    count = int(detection.counts[0])
    pairs, (dhat, offset, measure) = detection.listed.pairs[:count].cpu().long(), (
        detection.listed.constants[:count, :3].cpu().unbind(1)
    )  # fmt: skip
    points = torch.cat([x, model.collider_points]).detach().cpu().requires_grad_()
    corners, kappa = points[pairs[:, :4]], torch.tensor(model.contact.kappa).double()
    b, slope, _ = log_barrier(distance(pairs[:, 4], corners) - offset, kappa, dhat)
    e = weight(pairs[:, 4], corners, dhat, measure)
    (gradient,) = torch.autograd.grad((e * b).sum(), points)
    return -gradient, (e * slope).detach()


# --- rest ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("support", ("floor", "plane", "both"))
def test_resting_gap(device: str, support: str) -> None:
    """Without stiffness each vertex settles where -b'(d) = m g; floor and plane are one potential. K = 5."""
    from scipy.optimize import brentq

    kappa, dhat = 100.0, 0.1
    barrier = dv.PairBarrier(kappa, dhat, self_contact=False, detections=1, damping=10.0)
    energies: list[Any] = [dv.StableNeoHookean(), barrier]
    colliders = []
    if support != "plane":
        energies.append(dv.FloorBarrier(height=-0.05, kappa=kappa, dhat=dhat, damping=10.0))
    if support != "floor":
        colliders.append(dv.colliders.Plane((3.0, -0.05, 0.0)))
    model = dv.Model(box(2, 0.2), density=100.0, energies=energies, colliders=colliders, device=device)
    x = model.rest_points
    end = dv.rollout(model, x, torch.zeros_like(x), dv.VBD(0.02, 5), steps=300, mu=0.0, lam=0.0, save="last")
    gaps, times = end.x[-1, :, 1] + 0.05, 2.0 if support == "both" else 1.0

    def excess(d: float, weight: float) -> float:
        return times * kappa * (2 * (d - dhat) * math.log(d / dhat) + (d - dhat) ** 2 / d) - weight

    for gap, mass in zip(gaps.tolist(), model.mass.tolist(), strict=True):
        rest = brentq(excess, 1e-6, dhat * (1 - 1e-12), args=(mass * GRAVITY,), xtol=1e-15)
        assert gap == pytest.approx(rest, rel=tolerance("closed_form"))
    assert float(gaps.max() - gaps.min()) > 1e-4  # masses differ, and so do the gaps


@pytest.mark.parametrize("support", ("floor", "plane"))
def test_stacked_blocks_carry_each_other(support: str) -> None:
    """The pairs between two blocks carry the upper one, and the ground carries both. K = 200."""
    h, kappa, dhat = 0.02, 2e3, 0.02
    energies: list[Any] = [dv.StableNeoHookean(), dv.PairBarrier(kappa, dhat, self_contact=False, detections=1)]
    colliders = [dv.colliders.Plane((0, -0.015, 0))] if support == "plane" else []
    if support == "floor":
        energies.append(dv.FloorBarrier(height=-0.015, kappa=kappa, dhat=dhat))
    blocks = join([box(2, 0.2), box(2, 0.1).translate((0.06, 0.215, 0.04))])
    model = dv.Model(blocks, density=500.0, energies=energies, colliders=colliders)
    x = model.rest_points
    step: dict[str, Any] = {"mu": 2e4, "lam": 2e4, "solver": dv.VBD(h, 200)}
    for _ in range(100):
        x, _ = dv.step(model, x, torch.zeros_like(x), **step)
    with dv.record("contact") as found:
        x, v = dv.step(model, x, torch.zeros_like(x), **step)
    assert dv.contact.status(model).truncated == [0]
    forces, slopes = pair_forces(model, x, found[0])
    assert int((slopes < 0).sum()) >= 4
    weights = per_body(model, model.mass[:, None])[:, 0] * GRAVITY
    impulses = per_body(model, model.mass[:, None] * v) / h  # what is left of the motion
    on_bodies = per_body(model, forces[: model.num_vertices])
    gap = x[:, 1] + 0.015
    on_ground = -log_barrier(gap, torch.tensor(kappa), torch.full_like(gap, dhat))[1].sum()
    if support == "floor":
        on_bodies[0, 1] += on_ground
    balance = on_bodies - impulses
    balance[:, 1] -= weights
    assert float(balance.abs().max()) <= tolerance("closed_form") * float(weights.sum())
    assert float(on_bodies[1, 1]) == pytest.approx(float(weights[1]), rel=tolerance("settled"))
    assert float(on_ground) == pytest.approx(float(weights.sum()), rel=tolerance("settled"))
    between = slopes[found[0].listed.pairs[: len(slopes), 4] != 2]
    # normals are vertical up to the tilt that the faces of blocks of six tets take
    assert -float(between.sum()) == pytest.approx(float(weights[1]), rel=tolerance("settled"))


# --- action and reaction ---------------------------------------------------------------------------------------------


def approaching(detections: int, **options: Any) -> tuple[dv.Model, Tensor, Tensor]:
    """Two boxes of different mass that meet off center at 0.8 m/s."""
    friction = options.pop("friction", ())
    tets = join([box(2, 0.2, split="kuhn"), box(2, 0.2, split="kuhn").translate((0.27, 0.02, 0.04))])
    density = torch.tensor([500.0] * 6 + [300.0] * 6, dtype=torch.float64)
    barrier = dv.PairBarrier(2e3, 0.05, self_contact=False, detections=detections, **options)
    model = dv.Model(tets, density=density, energies=(dv.StableNeoHookean(), barrier, *friction))
    side = torch.where(model.body == 0, 1.0, -1.0)[:, None]
    v = side * torch.tensor([0.4, 0.03, -0.02], dtype=torch.float64)
    return model, model.rest_points, v


def test_pair_forces_are_equal_and_opposite() -> None:
    model, x, v = approaching(1)
    for _ in range(16):
        with dv.record("contact") as found:
            x, v = dv.step(model, x, v, dv.VBD(5e-3, 20), mu=1e4, lam=1e4, gravity=(0.0, 0.0, 0.0))
    forces, _ = pair_forces(model, x, found[0])
    on_bodies = per_body(model, forces)
    size = float(forces.abs().sum())
    assert float(on_bodies[0, 0]) < -1.0
    assert float(on_bodies.sum(0).abs().max()) <= tolerance("formula") * size
    assert float(torch.linalg.cross(x, forces).sum(0).abs().max()) <= tolerance("formula") * size


@pytest.mark.parametrize("detections", (1, 2))
@pytest.mark.parametrize("lagged", (False, True), ids=("barrier", "with_friction_and_damping"))
def test_collision_conserves_momentum(lagged: bool, detections: int) -> None:
    """Without gravity sum m v is kept by every step, to rounding, at K = 1 as at K = 400: touching bodies move
    together. The barrier keeps L_{n+1} - L_n = h sum m v_{n+1} x v_n, too; friction acts along the gap, at an arm."""
    options: dict[str, Any] = {"damping": 3.0, "friction": (dv.Friction(0.4, 0.05),)} if lagged else {}
    h, drift = 5e-3, {}
    for sweeps in (1, 400):
        model, x, v = approaching(detections, **options)
        mass, size = model.mass[:, None], float((model.mass * v.norm(dim=-1)).sum())
        first, linear, angular = per_body(model, mass * v), 0.0, 0.0
        for _ in range(40):
            x1, v1 = dv.step(model, x, v, dv.VBD(h, sweeps), mu=1e4, lam=1e4, gravity=(0.0, 0.0, 0.0))
            assert dv.contact.status(model).truncated == [0]
            linear = max(linear, float((mass * (v1 - v)).sum(0).norm()))
            gained = torch.linalg.cross(x1, mass * v1) - torch.linalg.cross(x, mass * v)
            angular = max(angular, float((gained - h * torch.linalg.cross(mass * v1, v)).sum(0).norm()))
            x, v = x1, v1
        assert float((per_body(model, mass * v) - first)[0, 0]) < -0.5 * size / 2  # they did collide
        drift[sweeps] = linear / size, angular / size
    print(f"{lagged=} {detections=} drift (linear, angular) by K: {drift}")
    assert max(drift[1][0], drift[400][0]) <= tolerance("momentum")
    if lagged:
        assert drift[400][1] <= tolerance("friction_torque")
    else:
        assert drift[400][1] <= tolerance("momentum")


def test_collision_in_one_dimension() -> None:
    """Head on: speeds (m1 - m2) / (m1 + m2) v and 2 m1 / (m1 + m2) v as h -> 0, in first order; K = 20."""
    speed, duration, errors = 0.3, 0.15, []
    tets = join([box(2, 0.2, split="kuhn"), box(2, 0.2, split="kuhn").translate((0.251, 0.0, 0.0))])
    density = torch.tensor([500.0] * 6 + [250.0] * 6, dtype=torch.float64)
    energies = (dv.StableNeoHookean(), dv.PairBarrier(150.0, 0.05, self_contact=False, detections=1))
    model = dv.Model(tets, density=density, energies=energies)
    masses = per_body(model, model.mass[:, None])[:, 0]
    expected = speed * torch.stack([masses[0] - masses[1], 2 * masses[0]]) / masses.sum()
    for h in (2e-3, 1e-3, 5e-4):
        x = model.rest_points
        v = torch.zeros_like(x)
        v[model.body == 0, 0] = speed
        for _ in range(round(duration / h)):
            x, v = dv.step(model, x, v, dv.VBD(h, 20), mu=2e5, lam=0.0, gravity=(0.0, 0.0, 0.0))
            assert dv.contact.status(model).truncated == [0]
        assert dv.contact.status(model).smallest_gap[0] > 0.05  # they have parted
        ends = per_body(model, model.mass[:, None] * v)[:, 0] / masses
        assert float((masses * ends).sum()) == pytest.approx(float(masses[0]) * speed, rel=tolerance("closed_form"))
        errors.append(float((ends - expected).abs().max()) / speed)
    order = math.log2(errors[-2] / errors[-1])
    print(errors, order)
    assert errors[-1] < 0.05 and 0.9 < order < 1.1
