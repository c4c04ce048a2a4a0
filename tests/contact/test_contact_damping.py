"""Claim: damping fades in, so that a motion does not jump where a contact comes to be closer than dhat, and gradients
are those of the motion that short steps approach."""

import math
from typing import Any

import pytest
import torch
from helpers.two_boxes import STEP, two_boxes

import diffvbd as dv
from diffvbd.testing import relative_error, tolerance

DHAT = 0.02
SUPPORTS = ("pairs", "floor")


def landing(gap: float, damping: float, support: str = "pairs", **options: Any) -> torch.Tensor:
    """Where a block ends that approaches another, or a floor, for a step, from a gap [m] between them."""
    lower = dv.mesh.box(2, 0.1)
    upper = lower.translate((0.013, 0.1 + gap, 0.017))
    if support == "floor":
        mesh = upper
        barrier: Any = dv.FloorBarrier(0.1, kappa=200.0, dhat=DHAT, damping=damping)
    else:
        mesh = dv.mesh.join([lower, upper])
        barrier = dv.PairBarrier(200.0, DHAT, self_contact=False, damping=damping, detections=1)
    model = dv.Model(mesh, energies=(dv.StableNeoHookean(), barrier), density=100.0)
    x, v = model.rest_points, torch.zeros_like(model.rest_points)
    v[-upper.num_vertices :, 1] = -0.5
    return dv.step(model, x, v, dv.VBD(0.005, 5), mu=1e4, lam=1e4, gravity=(0, 0, 0), **options)[0]  # fmt: skip


@pytest.mark.parametrize("support", SUPPORTS)
def test_no_jump_at_dhat(support: str) -> None:
    before, after = (landing(DHAT + away, 50.0, support) for away in (1e-9, -1e-9))
    assert relative_error(before, after) <= tolerance("damping_jump")
    # closer to it damping does act
    assert relative_error(landing(0.015, 50.0, support), landing(0.015, 0.0, support)) > 1e-6


@pytest.mark.parametrize(("support", "name"), (("pairs", "pair_kappa"), ("floor", "floor_kappa")))
def test_a_barrier_that_is_none_damps_nothing_and_has_a_gradient(support: str, name: str) -> None:
    kappa = torch.zeros((), dtype=torch.float64, requires_grad=True)
    given = {name: kappa}
    damped, free = (landing(0.015, damping, support, **given) for damping in (50.0, 0.0))
    assert torch.equal(damped, free)
    slopes = [torch.autograd.grad(end[:, 1].square().sum(), kappa)[0] for end in (damped, free)]
    assert torch.equal(*slopes) and slopes[0] != 0


@pytest.mark.parametrize("name", ("pair_damping", "friction"))
def test_none_is_as_much_as_zero(name: str) -> None:
    """Of damping or of friction, beside the other."""

    def ends(*, rubs: bool, damping: float, **options: Any) -> tuple[torch.Tensor, ...]:
        model = two_boxes(damping=damping, detections=1)
        if not rubs:
            model = dv.Model(model.mesh, energies=[e for e in model.energies if not isinstance(e, dv.Friction)])
        v = torch.zeros_like(model.rest_points)
        v[8:] = torch.tensor([0.3, -0.4, 0.1])
        v.requires_grad_()
        end = dv.step(model, model.rest_points, v, **STEP, **options)[0]
        return end, torch.autograd.grad(end.square().sum(), v)[0]

    damps = name == "friction"
    none = ends(rubs=not damps, damping=5.0 if damps else 0.0)
    zero = torch.zeros((), dtype=torch.float64, requires_grad=True)
    given = ends(rubs=True, damping=5.0 if damps else 0.0, **{name: zero})
    for a, b in zip(none, given, strict=True):
        assert relative_error(a, b) <= tolerance("contact_forward")
    both = ends(rubs=True, damping=5.0)
    assert relative_error(none[0], both[0]) > 1e-6


def bounced(speed: float, mass: float, kappa: float, damping: float, seconds: float) -> float:
    """Speed of a mass that has fallen on a damped barrier from 3 cm, by Runge and Kutta's method."""

    def rate(y: float, v: float) -> tuple[float, float]:
        if y >= DHAT:
            return v, -9.81
        force = kappa * (2 * (y - DHAT) * math.log(y / DHAT) + (y - DHAT) ** 2 / y)
        share = force / (force + kappa * DHAT / 10)
        return v, -9.81 + (force - damping * share * min(0.0, v)) / mass

    y, v, n = 0.03, speed, 4000
    h = seconds / n
    for _ in range(n):
        a = rate(y, v)
        b = rate(y + h / 2 * a[0], v + h / 2 * a[1])
        c = rate(y + h / 2 * b[0], v + h / 2 * b[1])
        d = rate(y + h * c[0], v + h * c[1])
        y += h / 6 * (a[0] + 2 * b[0] + 2 * c[0] + d[0])
        v += h / 6 * (a[1] + 2 * b[1] + 2 * c[1] + d[1])
    return v


def test_speed_and_gradient_of_a_damped_bounce() -> None:
    """Vertices without stiffness bounce on a floor; extrapolated to steps of no length, against the equation of motion.
    With damping that is switched on at dhat the derivative would be 1.9 times this one, however short the steps."""
    points = [[0.0, 0.03, 0.0], [0.0, 0.03, 0.1], [0.1, 0.03, 0.0], [0.03, 0.13, 0.02]]
    kappa, damping, seconds = 200.0, 3.0, 0.05
    barrier = dv.FloorBarrier(kappa=kappa, dhat=DHAT, damping=damping)
    model = dv.Model(dv.mesh.TetMesh(points, [[0, 1, 2, 3]]), energies=(dv.StableNeoHookean(), barrier))
    x = model.rest_points

    def end(steps: int) -> torch.Tensor:
        speed = torch.tensor(-1.0, dtype=torch.float64, requires_grad=True)
        v = torch.stack([0 * speed, speed, 0 * speed]).expand(4, 3)
        last = dv.rollout(
            model, x, v, dv.VBD(seconds / steps, 5, subspace=None), steps=steps, mu=0.0, lam=0.0, save="last"
        )
        reached = last.v[-1][0, 1]
        return torch.stack([reached.detach(), torch.autograd.grad(reached, speed)[0]])

    found = 2 * end(400) - end(200)
    mass, away = float(model.mass[0]), 1e-4
    at, less, more = (bounced(-1.0 + d, mass, kappa, damping, seconds) for d in (0.0, -away, away))
    expected = torch.tensor([at, (more - less) / (2 * away)], dtype=torch.float64)
    assert relative_error(found, expected) <= tolerance("damped_bounce")
