"""Claim: a block on an incline sticks, slides and stops as Coulomb's law says, on a floor, a plane and another body.

Converged sweeps on purpose (K = 60 on 8 vertices). The block starts in the shape that it has while friction acts in
full, so that its center of mass follows the closed form from the first step on, with the error h / t of backward Euler.
"""

import math
from dataclasses import dataclass
from typing import Any

import pytest
import torch
from helpers.marks import slow
from torch import Tensor

import diffvbd as dv
from diffvbd import reference, results
from diffvbd.energies import log_barrier
from diffvbd.mesh import box, join
from diffvbd.testing import relative_error, tolerance
from diffvbd.testing.contact_scenes import noise, substep_of

GRAVITY = 9.81  # [m/s^2]
KAPPA, DHAT, GAP = 2e3, 0.05, 0.025  # [N/m], [m], gap of the undeformed block [m]
CREEP = 1e-3  # eps_v [m/s]
LAME, SWEEPS = 2e4, 60  # [Pa]
SUPPORTS = ("floor", "plane", "body")
TWO = ("floor", slow("plane"), "body")  # pairs carry the block on the last two
ANGLE = math.radians(20)


@dataclass
class Block:
    """A block of 2 kg above a support whose normal is y; positions [V, 3] of everything at rest."""

    model: dv.Model
    x: Tensor

    @property
    def free(self) -> Tensor:
        return ~self.model.pinned

    def mean(self, values: Tensor) -> Tensor:
        """Mean over the block by mass of the components along x."""
        weight = self.model.mass * self.free
        return (weight * values[..., 0]).sum() / weight.sum()


def block_on(support: str, *friction: dv.Friction, device: str = "cpu") -> Block:
    block, pinned, floor, colliders = box(2, (0.2, 0.1, 0.2), split="kuhn"), None, (), ()
    if support == "floor":
        floor = (dv.FloorBarrier(height=-GAP, kappa=KAPPA, dhat=DHAT),)
    else:
        floor = (dv.PairBarrier(KAPPA, DHAT, self_contact=False, detections=1),)
    if support == "plane":
        colliders = (dv.colliders.Plane((0.0, -GAP, 0.0)),)
    elif support == "body":  # one triangle of it lies below the whole way: every normal is y
        block, pinned = (
            join([block, box(2, (6.0, 1.0, 6.0), split="kuhn").translate((-4.5, -1.0 - GAP, -1.5))]),
            range(8, 16),
        )
    energies = (dv.StableNeoHookean(), *floor, *friction)
    model = dv.Model(block, density=500.0, pinned=None if pinned is None else list(pinned), energies=energies,
                     colliders=colliders, device=device)  # fmt: skip
    return Block(model, model.rest_points)


def settle(block: Block, angle: float, shear: float) -> None:
    """Brings a block to rest on its incline, its feet held back by ``shear`` times the load that each carries."""
    model, x = block.model, block.x
    free, still = block.free, torch.zeros_like(x)
    normal = GRAVITY * math.cos(angle)
    options: dict[str, Any] = {"gravity": (shear * normal, -normal, 0.0)}
    if model.friction is not None:
        options["friction"] = 0.0
    for _ in range(80):
        kappa, dhat = torch.full_like(x[:, 1], KAPPA), torch.full_like(x[:, 1], DHAT)
        load = torch.where(free, -log_barrier(x[:, 1] + GAP, kappa, dhat)[1], 0.0)
        weight = normal * (model.mass * free).sum()
        load = load * (weight / load.sum().clamp(min=1e-3 * weight))
        force = torch.stack([-shear * load, 0 * load, 0 * load], -1)
        x, v = dv.step(model, x, still, dv.VBD(0.05, 100), mu=LAME, lam=LAME, force=force, **options)
    assert float(v.abs().max()) < tolerance("settled_speed")
    block.x = x


def slide(block: Block, angle: float, h: float, duration: float, speed: float = 0.0, coefficient: Any = None
          ) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Positions and velocities after ``duration``; no pair may have held anything up."""
    model, x, v = block.model, block.x, torch.zeros_like(block.x)
    v[block.free, 0] = speed
    gravity = (GRAVITY * math.sin(angle), -GRAVITY * math.cos(angle), 0.0)
    parameters = {} if coefficient is None else {"friction": coefficient}
    for _ in range(round(duration / h)):
        x, v = dv.step(model, x, v, dv.VBD(h, SWEEPS), mu=LAME, lam=LAME, gravity=gravity, **parameters)  # fmt: skip
        assert model.contact is None or dv.contact.status(model).truncated == [0]
    return x, v


def distance(block: Block, *args: Any, **options: Any) -> Tensor:
    return block.mean(slide(block, *args, **options)[0] - block.x)


def order_of(errors: list[float]) -> float:
    """Of convergence, over halvings of h."""
    return math.log2(abs(errors[-2] / errors[-1]))


@pytest.mark.parametrize("support", SUPPORTS)
def test_sticks_below_the_angle_of_friction(device: str, support: str) -> None:
    """mu_f 10 % above tan(angle): every foot creeps at less than eps_v."""
    block, duration = block_on(support, dv.Friction(1.1 * math.tan(ANGLE), CREEP), device=device), 0.4
    settle(block, ANGLE, math.tan(ANGLE))
    x, v = slide(block, ANGLE, 0.01, duration)
    moved = (x - block.x)[block.free]
    feet = block.x[block.free, 1] < 0.05
    assert int(feet.sum()) == 4
    assert float(moved[feet][:, [0, 2]].norm(dim=-1).max()) <= CREEP * duration
    assert abs(float(block.mean(x - block.x))) <= CREEP * duration
    assert float(block.mean(x - block.x)) > 0.1 * CREEP * duration  # it creeps: the price of smoothing
    assert abs(float(block.mean(v))) <= CREEP


@pytest.mark.parametrize("support", SUPPORTS)
def test_slides_above_the_angle_of_friction(device: str, support: str) -> None:
    """mu_f 10 % below tan(angle): half of (g sin - mu_f g cos) t^2, plus the half step of backward Euler."""
    coefficient, duration, h = 0.9 * math.tan(ANGLE), 0.4, 0.01
    block = block_on(support, dv.Friction(coefficient, CREEP), device=device)
    settle(block, ANGLE, coefficient)
    a = GRAVITY * (math.sin(ANGLE) - coefficient * math.cos(ANGLE))
    expected = a * duration * (duration + h) / 2
    assert float(distance(block, ANGLE, h, duration)) == pytest.approx(expected, rel=tolerance("sliding"))


@pytest.mark.parametrize("support", TWO)
def test_a_sliding_block_stops(support: str) -> None:
    """After v0^2 / (2 mu_f g), and it stays there."""
    coefficient, duration = 0.4, 0.16
    speed = coefficient * GRAVITY * duration
    block = block_on(support, dv.Friction(coefficient, CREEP))
    settle(block, 0.0, coefficient)
    expected = speed**2 / (2 * coefficient * GRAVITY)
    errors = []
    for h in (0.02, 0.01, 0.005):
        x, v = slide(block, 0.0, h, duration, speed)
        errors.append(float(block.mean(x - block.x)) / expected - 1)
        assert abs(float(block.mean(v))) < tolerance("stopped") * speed
        later, _ = slide(block, 0.0, h, duration + 0.3, speed)
        feet = block.x[:, 1] < 0.05
        moved = (later - x)[feet & block.free]  # the block springs back to its shape, on feet that hold
        assert len(moved) == 4 and float(moved[:, [0, 2]].norm(dim=-1).max()) <= CREEP * 0.3
    assert order_of(errors) == pytest.approx(1.0, abs=tolerance("order"))
    finest = 0.005 / duration
    assert errors[-1] == pytest.approx(-finest, rel=tolerance("sliding") / finest)


@pytest.mark.parametrize("support", TWO)
def test_gradient_of_the_sliding_distance(support: str) -> None:
    """-g cos t (t + h) / 2 per unit of mu_f, down to mu_f = 0, where the distance has no friction in it."""
    duration, h = 0.2, 0.01
    for value in (0.3, 0.0):
        block = block_on(support, dv.Friction(value, CREEP))
        settle(block, ANGLE, value)

        def run(coefficient: Tensor, block: Block = block) -> Tensor:
            return distance(block, ANGLE, h, duration, coefficient=coefficient)

        coefficient = torch.tensor(value, dtype=torch.float64, requires_grad=True)
        (gradient,) = torch.autograd.grad(run(coefficient), coefficient)
        expected = -GRAVITY * math.cos(ANGLE) * duration * (duration + h) / 2
        assert float(gradient) == pytest.approx(expected, rel=tolerance("sliding"))
        eps = 1e-4
        with torch.no_grad():
            if value > 0:
                difference = float(run(coefficient + eps) - run(coefficient - eps)) / (2 * eps)
            else:  # from one side, in second order: a coefficient is not negative
                there = [float(run(coefficient + k * eps)) for k in range(3)]
                difference = (-3 * there[0] + 4 * there[1] - there[2]) / (2 * eps)
        assert float(gradient) == pytest.approx(difference, rel=tolerance("finite_difference"))


@pytest.mark.parametrize("support", SUPPORTS)
def test_friction_at_rest_has_finite_gradients(support: str) -> None:
    """No motion at first, so no direction of slip: the smoothed force has a derivative there all the same. The barrier
    lifts and so tilts the block a little, which is all that friction has a hand in."""
    block = block_on(support, dv.Friction(0.5, CREEP))
    x = block.x.clone().requires_grad_()
    v = torch.zeros_like(x, requires_grad=True)
    coefficient = torch.tensor(0.5, dtype=torch.float64, requires_grad=True)

    def end(coefficient: Tensor) -> Tensor:
        return dv.step(block.model, x, v, dv.VBD(0.01, 3), mu=0.0, lam=0.0, gravity=(0.0, 0.0, 0.0),
                       friction=coefficient)[0][:, 0].sum()  # fmt: skip

    gradients = torch.autograd.grad(end(coefficient), (x, v, coefficient))
    assert all(torch.isfinite(g).all() for g in gradients)
    with torch.no_grad():
        difference = float(end(coefficient + 1e-3) - end(coefficient - 1e-3)) / 2e-3
    assert float(gradients[2]) == pytest.approx(difference, rel=tolerance("kinked_difference")) and difference != 0.0
    feet = block.free & (block.x[:, 1] == 0)
    assert (gradients[1][feet, 0] > 0).all() and (gradients[1][feet, 0] < 0.5 * 0.01).all()  # stuck, not free


def test_gradient_without_slip_is_that_of_the_reference() -> None:
    """Where |u| is zero but for rounding, the kink of the smoothed force has no direction."""
    tets = join([box(2, 0.2), box(2, 0.2).translate((0.02, 0.208, 0.03))])
    energies = (dv.StableNeoHookean(), dv.PairBarrier(dhat=0.02, detections=1), dv.Friction(0.4, 0.05))
    model = dv.Model(tets, energies=energies)
    step: dict[str, Any] = {"mu": LAME, "lam": LAME, "solver": dv.VBD(0.01, 2)}
    gradients = []
    with dv.record("contact") as found:
        for run in (dv.step, reference.contact_step):
            v = torch.full_like(model.rest_points, 0.01).requires_grad_()
            more = {} if run is dv.step else {"substeps": [substep_of(found[0])]}
            x, _ = run(model, model.rest_points, v, **more, **step)
            gradients.append(torch.autograd.grad((noise("slip", shape=x.shape, size=1.0) * x).sum(), v)[0])
    assert relative_error(*gradients) <= tolerance("contact_adjoint")


@pytest.mark.parametrize("support", ("plane", "body"))
def test_a_moving_support_drags(support: str) -> None:
    """A plane, and a prescribed body, at 0.05 m/s along x: a block that sticks soon moves as fast."""
    block, h, speed, steps = block_on(support, dv.Friction(0.5, CREEP)), 0.01, 0.05, 40
    settle(block, 0.0, 0.0)
    shift = torch.tensor([speed * h, 0.0, 0.0], dtype=torch.float64)
    x, v = block.x, torch.zeros_like(block.x)
    points = block.model.collider_points
    for n in range(steps):
        moved: dict[str, Any] = {"prescribed": x + shift * block.model.pinned[:, None]}
        if support == "plane":
            moved = {"colliders_before": points + n * shift, "colliders": points + (n + 1) * shift}
        x, v = dv.step(block.model, x, v, dv.VBD(h, SWEEPS), mu=LAME, lam=LAME, **moved)
    feet = block.free & (block.x[:, 1] < 0.05)
    assert int(feet.sum()) == 4
    assert float((v[feet, 0] - speed).abs().max()) < CREEP
    assert 0 < speed * steps * h - float(block.mean(x - block.x)) < 2 * speed**2 / (0.5 * GRAVITY) + CREEP * steps * h


# --- friction of rigid corrections ------------------------------------------------------------------------------------


STEP = 1e-7  # [m/s] of the differences


def tilted(velocity: float, device: str) -> dv.Model:
    """Nine cubes, a little askew, close to each other above a floor."""
    draw = torch.Generator().manual_seed(1)
    cube, parts = dv.mesh.cube(2, size=0.1), []
    for i in range(9):
        angle = (torch.rand(3, generator=draw, dtype=torch.float64) - 0.5) * 0.1
        turn = torch.linalg.matrix_exp(torch.linalg.cross(torch.eye(3).double(), angle.expand(3, 3)))
        place = torch.tensor([0.115 * (i % 3), 0.062, 0.115 * (i // 3)], dtype=torch.float64)
        points = (torch.tensor(cube.points) - 0.05) @ turn.T + place
        parts.append(dv.TetMesh(points.numpy(), cube.tets))
    energies = (dv.StableNeoHookean(), dv.PairBarrier(kappa=2e3, self_contact=False), dv.FloorBarrier(kappa=2e3),
                dv.Friction(0.5, velocity=velocity))  # fmt: skip
    return dv.Model(dv.mesh.join(parts), energies=energies, device=device)


@pytest.mark.parametrize("sweeps", [0, 5])
@pytest.mark.parametrize("velocity", [1e-2, 1e-3])
def test_gradients_of_rubbing_bodies_are_those_of_differences(device: str, velocity: float, sweeps: int) -> None:
    model = tilted(velocity, device)
    x = model.rest_points
    draw = torch.Generator().manual_seed(1)
    own = torch.randn(9, 3, generator=draw, dtype=torch.float64) * 0.1 + torch.tensor([0.3, -0.3, 0.1]).double()
    v = own.repeat_interleave(8, 0).to(device)
    direction = torch.randn(v.shape, generator=draw, dtype=torch.float64).to(device)

    def end(share: float | torch.Tensor) -> torch.Tensor:
        given = {"mu": 1e5, "lam": 1e5, "solver": dv.VBD(0.005, sweeps)}
        return dv.step(model, x, v + share * direction, **given)[0][:, 0].mean()

    share = torch.zeros((), dtype=torch.float64, device=device, requires_grad=True)
    (found,) = torch.autograd.grad(end(share), share)
    with torch.no_grad():
        differences = (end(STEP) - end(-STEP)) / (2 * STEP)
    assert found.abs() > 0
    assert float(found) == pytest.approx(float(differences), rel=tolerance("settled_friction"))


@pytest.mark.parametrize("sweeps", [0, 4])
@pytest.mark.parametrize("velocity", [1e-2, 1e-3, 1e-5])
def test_where_a_body_comes_to_rest_within_a_small_part_of_its_way(device: str, velocity: float, sweeps: int) -> None:
    """A tet that comes down on a floor and a capsule at 3 m/s; Newton's steps must end within `velocity` h of rest."""
    corners = [[0.00728, 0.00325, -0.02147], [0.04852, 0.01187, 0.07379], [0.06225, 0.08179, -0.05321],
               [-0.06474, 0.06184, 0.00126]]  # fmt: skip
    x = torch.tensor([[0.0168426, 0.00417075, -0.00503961], [0.0579942, 0.0127741, 0.0902392],
                      [0.0718259, 0.0825594, -0.0368182], [-0.0552433, 0.0626022, 0.0177206]]).double()  # fmt: skip
    v = torch.tensor([[1.726, -2.678, 0.7771], [2.978, -1.805, 0.58], [1.472, -2.975, -0.0583],
                      [2.098, -2.804, 1.107]]).double()  # fmt: skip
    capsule = dv.colliders.Capsule((0.117977, 0.01883, -0.099285), (0.016005, 0.145289, -0.126344), 0.0542)
    pairs = dv.PairBarrier(1272.6, 0.03, damping=7.215, detections=1)
    energies = (dv.StableNeoHookean(), dv.FloorBarrier(-5e-4, kappa=1876.7, dhat=0.03, damping=5.0), pairs,
                dv.Friction(0.4, velocity=velocity))  # fmt: skip
    model = dv.Model(dv.TetMesh(corners, [[0, 1, 2, 3]]), energies=energies, colliders=[capsule], device=device)
    x, v = x.to(device), v.to(device)
    weights = torch.sin(torch.arange(12).double()).reshape(4, 3).to(device)
    direction = torch.cos(torch.arange(12).double()).reshape(4, 3).to(device)

    def loss(v: torch.Tensor) -> torch.Tensor:
        return (weights * dv.step(model, x, v, dv.VBD(0.02, sweeps), mu=2e4, lam=3.5e4)[0]).sum()

    own = v.clone().requires_grad_()
    (grad,) = torch.autograd.grad(loss(own), own)
    found = float((grad * direction).sum())
    with torch.no_grad():
        differences = float(loss(v + 100 * STEP * direction) - loss(v - 100 * STEP * direction)) / (200 * STEP)
    assert found != 0
    assert found == pytest.approx(differences, rel=tolerance("settled_friction"))


# --- sticking ---------------------------------------------------------------------------------------------------------


COEFFICIENT, CREEP_ALLOWED, LOW = 0.5, 1e-3, -5e-4
STEPS, TIME_STEP = 60, 0.01


def block(support: str, bodies: int = 1) -> dv.Model:
    """Cubes in a row over a support, that do not touch each other."""
    cube = dv.mesh.cube(3, size=0.1)
    cube = cube.translate((0.0, -float(cube.points[:, 1].min()), 0.0))
    mesh = dv.mesh.join([cube.translate((0.2 * k, 0.0, 0.0)) for k in range(bodies)])
    friction = dv.Friction(COEFFICIENT, CREEP_ALLOWED)
    if support == "floor":
        return dv.Model(mesh, energies=(dv.StableNeoHookean(), dv.FloorBarrier(LOW, kappa=1e4, dhat=1e-3), friction))
    pairs = dv.PairBarrier(1e4, 1e-3, self_contact=False)
    plane = dv.colliders.Plane((0.0, LOW, 0.0), (0.0, 1.0, 0.0))
    return dv.Model(mesh, energies=(dv.StableNeoHookean(), pairs, friction), colliders=[plane])


def pushed(
    model: dv.Model, share: float | Tensor, sweeps: int, stiffness: float, steps: int = STEPS
) -> results.Trajectory:
    """By a share of what friction holds."""
    x = model.rest_points
    force = model.mass[:, None] * 9.81 * COEFFICIENT * share * torch.tensor([1.0, 0.0, 0.0], dtype=x.dtype)
    given: dict[str, Any] = {"mu": stiffness, "lam": stiffness, "solver": dv.VBD(TIME_STEP, sweeps)}
    return dv.rollout(model, x, torch.zeros_like(x), steps=steps, force=force, **given)


@pytest.mark.parametrize("support", ["floor", "plane"])
@pytest.mark.parametrize(("stiffness", "sweeps"), [(1e5, 10), (1e6, 5), (1e7, 5)])
@pytest.mark.parametrize("share", [0.5, 0.9])
def test_what_holds_creeps_as_smoothed_friction_does(share: float, stiffness: float, sweeps: int, support: str) -> None:
    speed = float(pushed(block(support), share, sweeps, stiffness).v[-1, :, 0].mean())
    assert speed == pytest.approx(CREEP_ALLOWED * (1 - math.sqrt(1 - share)), rel=tolerance("contact_motion"))


def test_what_does_not_hold_slides() -> None:
    v = pushed(block("plane"), 1.5, 5, 1e6).v
    gained = float(v[-1, :, 0].mean() - v[STEPS // 2, :, 0].mean())
    expected = 0.5 * COEFFICIENT * 9.81 * (STEPS - STEPS // 2) * TIME_STEP
    assert gained == pytest.approx(expected, rel=tolerance("contact_motion"))


@pytest.mark.parametrize("support", ["floor", "plane"])
def test_the_derivative_of_rest_is_that_of_rest(support: str) -> None:
    """Some fifty times less than that of the sliding which one Newton step with a bound for friction left."""
    share = torch.tensor(0.5, dtype=torch.float64, requires_grad=True)
    speed = pushed(block(support), share, 5, 1e6).v[-1, :, 0].mean()
    (slope,) = torch.autograd.grad(speed, share)
    assert float(slope) == pytest.approx(CREEP_ALLOWED / (2 * math.sqrt(1 - 0.5)), rel=tolerance("contact_motion"))


def test_stacks_of_many_bodies_stand() -> None:
    """Thirty-five stacks of two cubes, pushed by half of what friction holds, creep and do not fall. Without a share of
    friction for each side they slide and fall."""
    cube = dv.mesh.cube(2, size=0.1)
    cube = cube.translate((0.0, -float(cube.points[:, 1].min()), 0.0))
    places = [(0.3 * k, 0.0, 0.0) for k in range(35)] + [(0.3 * k + 0.01, 0.1 - LOW, 0.01) for k in range(35)]
    model = dv.Model(
        dv.mesh.join([cube.translate(place) for place in places]),
        energies=(dv.StableNeoHookean(), dv.FloorBarrier(LOW, kappa=1e4, dhat=1e-3),
                  dv.PairBarrier(1e4, 1e-3, self_contact=False), dv.Friction(COEFFICIENT, CREEP_ALLOWED)))  # fmt: skip
    speed = pushed(model, 0.5, 5, 1e6).v[-1, :, 0].reshape(2, 35, -1).mean(-1)
    assert float(speed.abs().max()) < 3 * CREEP_ALLOWED
    assert float(speed.mean()) > 0.1 * CREEP_ALLOWED
