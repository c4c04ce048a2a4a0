"""Claim: which bodies take implicit Euler in a step of SDIRK2 or BDF2 follows from how things move against each other:
it is the same however fast all of them move together, and planes that turn count where a body is."""

from typing import Any

import pytest
import torch
from torch import Tensor

import diffvbd as dv
from diffvbd import results
from diffvbd.testing import tolerance

GRAVITY = (0.0, 0.0, 0.0)
TIME_STEP = 0.01
SECOND = (dv.SDIRK2(), dv.BDF2())
BLOCK = dv.mesh.cube(2, size=0.4).translate((-0.15, -0.4, -0.15))
SHAPES = {
    "plane": dv.colliders.Plane(),
    "sphere": dv.colliders.Sphere((0.05, -0.2, 0.05), 0.2),
    "obstacle": dv.colliders.Obstacle(BLOCK.points, BLOCK.surface),
}


def model_above(shape: str, gap: float, device: str) -> dv.Model:
    cube = dv.mesh.cube(2, size=0.1).translate((0.0, gap, 0.0))
    pairs = dv.PairBarrier(kappa=4e4, dhat=0.01, self_contact=False, detections=1)
    return dv.Model(cube, energies=(dv.StableNeoHookean(), pairs), colliders=[SHAPES[shape]], device=device)


def run(model: dv.Model, v: Tensor, ways: Tensor, integrator: Any) -> tuple[list[Tensor], results.Trajectory]:
    """A rollout whose colliders go by `ways` [steps, ..., 3]: who took implicit Euler, and the motion."""
    at = model.collider_points
    with dv.record("integrator") as euler:
        motion = dv.rollout(model, model.rest_points, v, dv.VBD(TIME_STEP, 200, integrator=integrator), steps=len(ways),
                            mu=1e5, lam=1e5, gravity=GRAVITY, colliders=dv.per_step(at + ways),
                            colliders_before=at)  # fmt: skip
    return list(euler), motion


def in_frame(model: dv.Model, own: tuple[float, float, float], speed: float, integrator: Any
             ) -> tuple[list[Tensor], Tensor]:  # fmt: skip
    """Who took implicit Euler, and the motion [3, V, 3], of a body with a velocity of its own, seen from its collider;
    both go up at ``speed`` [m/s]."""
    v = torch.zeros_like(model.rest_points) + model.rest_points.new_tensor(own)
    v[:, 1] += speed
    times = TIME_STEP * torch.arange(1, 4, dtype=v.dtype, device=v.device)
    ways = v.new_zeros((3, 1, 3))
    ways[:, 0, 1] = speed * times
    euler, motion = run(model, v, ways, integrator)
    return euler, motion.x[1:] - ways


@pytest.mark.parametrize("integrator", SECOND, ids=str)
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize(("gap", "toward"), [(0.02, -1.5), (0.016, -0.1), (0.012, -0.6)])
def test_a_frame_that_moves_changes_nothing(shape: str, gap: float, toward: float, integrator: Any, device: str
                                            ) -> None:  # fmt: skip
    model = model_above(shape, gap, device)
    found = [in_frame(model, (0.0, toward, 0.0), speed, integrator) for speed in (0.0, -2.0, 0.5)]
    for euler, moved in found[1:]:
        assert all(torch.equal(a, b) for a, b in zip(euler, found[0][0], strict=True))
        assert (moved - found[0][1]).abs().max() <= tolerance("property_subset")
    assert bool(found[0][0][0].any()) == (toward < -0.1)


@pytest.mark.parametrize("integrator", SECOND, ids=str)
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize(("gap", "toward", "friction"), [(0.018, 0.0, 0.4), (0.0085, -0.1, None)])
def test_colliders_go_on_from_where_the_first_solve_has_left_them(
    shape: str, gap: float, toward: float, friction: float | None, integrator: Any, device: str
) -> None:
    """What glides above a collider that goes with it is not rubbed; what comes down on one lands on it."""
    model = model_above(shape, gap, device)
    if friction is not None:
        model = model.replace(energies=(*model.energies, dv.Friction(friction)))
    own = (0.1, toward, 0.0)
    found = [in_frame(model, own, speed, integrator)[1] for speed in (0.0, -2.0, -4.0, 4.0)]
    free = model.rest_points + TIME_STEP * found[0].new_tensor(own)
    assert bool((found[0][0] - free).abs().max() > tolerance("property_subset")) == (friction is None)
    for moved in found[1:]:
        assert (moved - found[0]).abs().max() <= tolerance("property_subset")


@pytest.mark.parametrize("integrator", (dv.ImplicitEuler(), dv.SDIRK2()), ids=str)
def test_colliders_end_at_those_of_the_model_unless_they_are_given(integrator: Any, device: str) -> None:
    model = model_above("plane", 0.011, device)
    x, at = model.rest_points, model.collider_points
    solver = dv.VBD(TIME_STEP, 5, integrator=integrator)
    given = {"mu": 1e5, "lam": 1e5, "colliders_before": at - 1e-3}
    own, same = (dv.step(model, x, 0 * x, solver, **given, **more)[0] for more in ({}, {"colliders": at}))
    assert torch.equal(own, same) and (own - x).abs().max() > 0


@pytest.mark.parametrize(("gap", "rises", "touches"), [(0.035, 0.0, False), (0.035, 0.03, True), (0.009, -0.06, True)])
def test_a_plane_that_turns_counts_where_the_body_is(gap: float, rises: float, touches: bool, device: str) -> None:
    """Three meters from the points of a plane, which hardly move, it goes up or down."""
    energies = model_above("plane", gap, device).energies
    model = dv.Model(dv.mesh.cube(2, size=0.1).translate((3.0, gap, 0.0)), energies=energies,
                     colliders=[SHAPES["plane"]], device=device)  # fmt: skip
    at = model.collider_points
    assert (at.abs() < 2).all()
    ways = torch.zeros_like(at)
    ways[:, 1] = rises / 3 * at[:, 0]
    euler, _ = run(model, torch.zeros_like(model.rest_points), ways[None], dv.SDIRK2())
    assert bool(euler[0].any()) == touches


@pytest.mark.parametrize("integrator", SECOND, ids=str)
def test_a_body_above_a_floor_moves_as_it_does_alone(integrator: Any, device: str) -> None:
    """Whether another one that it cannot meet takes implicit Euler does not matter, however few sweeps there are."""
    cube = dv.mesh.cube(2, size=0.2)
    energies = (dv.StableNeoHookean(), dv.FloorBarrier(height=-0.005, kappa=400.0, dhat=0.01))

    def end(mesh: dv.TetMesh) -> Tensor:
        model = dv.Model(mesh, density=500.0, energies=energies, device=device)
        x, v = model.rest_points, torch.zeros_like(model.rest_points)
        v[:8, 0], v[:8, 1], v[8:, 1] = 3.0 * x[:8, 1], -0.5, 0.1
        with dv.record("integrator") as euler:
            motion = dv.rollout(model, x, v, dv.VBD(0.01, 1, integrator=integrator, relaxation=0.7), steps=10, mu=2e4,
                                lam=2e4, save="last", checks=dv.Checks(energy=False))  # fmt: skip
        if len(x) > 8:
            assert any(bool(of[..., :8].any() != of[..., 8:].any()) for of in euler)
        return motion.x[-1, :8] - x[:8]

    alone, beside = end(cube), end(dv.mesh.join([cube, cube.translate((1.0, 0.0, 0.0))]))
    assert alone.abs().max() > 0.02 and (alone - beside).abs().max() <= tolerance("property_subset")
