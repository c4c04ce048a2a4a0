"""Claim: `dv.contact.forces` are the forces that the executed step felt, and at rest they carry the weight."""

from typing import Any

import numpy as np
import pytest
import torch
from helpers.marks import slow
from torch import Tensor

import diffvbd as dv
from diffvbd.mesh import box, join
from diffvbd.testing import contact_scenes, relative_error, tolerance

GRAVITY = 9.81  # [m/s^2]
SOFT: dict[str, Any] = {"mu": 2e4, "lam": 2e4}


def per_body(model: dv.Model, values: Tensor) -> Tensor:
    """Sums of vertex values [..., V, 3] over each body, [..., bodies, 3]."""
    count = int(model.body.max()) + 1
    shape = (*values.shape[:-2], count, values.shape[-1])
    return values.new_zeros(shape).index_add(-2, model.body, values)


def stack(support: str, *more: Any, device: str = "cpu") -> dv.Model:
    """A small box on a larger one, on a floor or on the plane of a collider."""
    energies = [dv.StableNeoHookean(), dv.PairBarrier(2e3, 0.02, self_contact=False, detections=1, reach=0.2), *more]
    things = [dv.colliders.Plane((0, -0.015, 0))] if support == "plane" else []
    if support == "floor":
        energies.append(dv.FloorBarrier(height=-0.015, kappa=2e3, dhat=0.02))
    blocks = join([box(2, 0.2), box(2, 0.1).translate((0.06, 0.215, 0.04))])
    return dv.Model(blocks, density=500.0, energies=energies, colliders=things, device=device)


def resting(support: str, device: str) -> dv.Model:
    """A box on a floor, a collider's plane, or one large triangle of a pinned body: every normal is y."""
    barrier: Any = dv.PairBarrier(2e3, 0.05, self_contact=False, detections=1, reach=0.4)
    body, things, pinned = box(2, (0.2, 0.1, 0.2), split="kuhn"), (), []
    if support == "floor":
        barrier = dv.FloorBarrier(height=-0.025, kappa=2e3, dhat=0.05)
    elif support == "plane":
        things = (dv.colliders.Plane((0.0, -0.025, 0.0)),)
    else:
        body, pinned = (
            join([body, box(2, (6.0, 1.0, 6.0), split="kuhn").translate((-4.5, -1.025, -1.5))]),
            list(range(8, 16)),
        )
    return dv.Model(body, density=500.0, pinned=pinned, energies=(dv.StableNeoHookean(), barrier), colliders=things,
                    device=device)  # fmt: skip


def settled(model: dv.Model) -> Tensor:
    """Where bodies rest: steps from rest, until nothing moves but by rounding."""
    x = model.rest_points
    for _ in range(60):
        x, _ = dv.step(model, x, 0 * x, dv.VBD(0.05, 500), **SOFT)
    return x


@pytest.mark.parametrize("support", ("floor", "plane", "body"))
def test_at_rest_forces_carry_the_weight(device: str, support: str) -> None:
    model = resting(support, device)
    x = settled(model)
    found = dv.contact.forces(model, x)
    weight = float(model.mass[:8].sum()) * GRAVITY
    up = x.new_tensor([0.0, weight, 0.0])
    least = tolerance("closed_form") * weight
    ground = {"floor": found.floors, "plane": found.colliders, "body": found.between}[support]
    assert ground.normal.shape == {"floor": (1, 1, 3), "plane": (1, 1, 3), "body": (1, 3)}[support]
    assert float((ground.total.reshape(3) - up).abs().max()) <= least
    assert float((per_body(model, found.vertices.total)[0] - up).abs().max()) <= least
    assert not found.vertices.tangential.any()  # at rest, and no step is known
    if support == "body":
        assert found.body_pairs.tolist() == [[0, 1]]
        borne = dv.reactions(model, x, gravity=(0.0, 0.0, 0.0), **SOFT)
        assert not borne[:8].any() and float((borne.sum(0) - up).abs().max()) <= least


@pytest.mark.parametrize("support", ("floor", "plane", "body"))
def test_at_rest_torques_balance_the_weights(device: str, support: str) -> None:
    model = resting(support, device)
    x = settled(model)
    mass = model.mass[:8, None]
    center, weight = (mass * x[:8]).sum(0) / mass.sum(), x.new_tensor([0.0, float(mass.sum()) * GRAVITY, 0.0])
    about = center + x.new_tensor([0.3, -0.2, 0.5])
    found = dv.contact.forces(model, x, about=about)
    expected = torch.linalg.cross(center - about, weight)
    ground = {"floor": found.floors, "plane": found.colliders, "body": found.between}[support]
    for torque in (ground.torque.reshape(3), found.bodies.torque[0], per_body(model, found.vertices.torque)[0]):
        assert float((torque - expected).abs().max()) <= tolerance("closed_form") * float(weight.norm())
    own = dv.contact.forces(model, x, about=center).bodies
    assert float(own.torque[0].norm()) <= tolerance("closed_form") * float(weight.norm())


def test_torques_are_differentiated_and_turn_with_the_point() -> None:
    model, options = run(contact_scenes.SCENES["obstacles"](), 5)
    x = options.pop("x").detach()

    def torque(at: torch.Tensor, about: torch.Tensor) -> torch.Tensor:
        found = dv.contact.forces(model, at, about=about, **options)
        return found.colliders.torque.sum((-3, -2)) + found.bodies.torque.sum(-2)

    point, way = x.new_tensor([0.1, 0.2, -0.3]), contact_scenes.noise("torque", shape=x.shape, size=1.0)
    at = x.clone().requires_grad_()
    slope = float((torch.autograd.grad(torque(at, point)[0], at)[0] * way).sum())
    h = 1e-9
    central = float((torque(x + h * way, point) - torque(x - h * way, point))[0]) / (2 * h)
    assert slope != 0 and abs(slope - central) <= 1e-5 * abs(slope)
    found = dv.contact.forces(model, x, about=point, **options).bodies
    moved = dv.contact.forces(model, x, about=point + way[0], **options).bodies
    shifted = found.torque - torch.linalg.cross(way[0].expand_as(found.total), found.total)
    assert float((moved.torque - shifted).abs().max()) <= 1e-10 * float(
        found.torque.abs().max() + found.total.abs().max()
    )
    with pytest.raises(ValueError, match="about: expected a point"):
        dv.contact.forces(model, x, about=(0.0, 1.0), **options)
    lost = [torch.tensor(0.1, requires_grad=True), torch.tensor(0.0), torch.tensor(0.0)]
    for wrong in (None, "abc", lost, torch.ones(3, dtype=torch.complex64), torch.zeros(3).to_sparse()):
        with pytest.raises(TypeError, match="about: expected"):
            dv.contact.forces(model, x, about=wrong, **options)  # type: ignore[arg-type]


def test_transforms_of_other_inputs_than_x_are_refused_in_words() -> None:
    model = resting("floor", "cpu")
    x, point = settled(model), torch.ones(3, dtype=torch.float64)

    def torque(x: torch.Tensor, about: torch.Tensor) -> torch.Tensor:
        return dv.contact.forces(model, x, about=about).bodies.torque.sum()

    with pytest.raises(NotImplementedError, match="forces of contact"):
        torch.func.grad(torque, argnums=1)(x, point)
    with pytest.raises(NotImplementedError, match="forces of contact"):
        torch.func.vmap(lambda about: torque(x, about))(point[None])
    tracked = x.clone().requires_grad_()
    expected = torch.autograd.grad(torque(tracked, point), tracked)[0]
    assert torch.equal(torch.func.grad(torque)(x, point), expected)


def test_no_vertices_bear_no_forces() -> None:
    mesh = dv.TetMesh(np.zeros((0, 3)), np.zeros((0, 4), dtype=np.int64))
    for barrier in (dv.FloorBarrier(), dv.PairBarrier()):
        model = dv.Model(mesh, energies=(dv.StableNeoHookean(), barrier, dv.Friction(0.1)))
        x = model.rest_points
        assert dv.contact.forces(model, x.expand(2, 0, 3)).bodies.torque.shape == (2, 0, 3)
        assert len(dv.contact.intersections(model, x)) == 0
        assert dv.reactions(model, x, **SOFT).shape == (0, 3)


def test_printed_they_say_who_presses_whom() -> None:
    model = resting("body", "cpu")
    x = settled(model)
    found = dv.contact.forces(model, x)
    weight = float(model.mass[:8].sum()) * GRAVITY
    text = str(found)
    assert text.startswith("on body 0 by body 1: normal (") and text.endswith("friction (0 0 0) N")
    assert f"{weight:.4g}" in text and "\n" not in text
    assert str(dv.contact.forces(model, x + 10.0 * model.body[:, None])) == "no forces of contact"
    assert "scenes [2], 1 pairs" in str(dv.contact.forces(model, torch.stack([x, x])))


def run(scene: contact_scenes.Scene, sweeps: int, model: dv.Model | None = None) -> tuple[dv.Model, dict[str, Any]]:
    """A Model and a step of it, as `dv.contact.forces` takes it."""
    model = scene.model if model is None else model
    given = {**scene.inputs, **scene.parameters, "x": scene.x, "v": scene.v}
    given = {k: v.to(model.device, model.dtype) for k, v in given.items()}
    x, v = given.pop("x"), given.pop("v")
    end, _ = dv.step(model, x, v, scene.solver(sweeps), gravity=contact_scenes.GRAVITY, **given)
    read = {k: given[k] for k in ("colliders", "colliders_before", *scene.parameters) if k in given}
    return model, {"x": end, "solver": scene.solver(sweeps), "previous": (x, v), **read}


@pytest.mark.parametrize("name", contact_scenes.SCENES)
def test_sums_over_bodies_colliders_and_planes_are_those_over_vertices(name: str) -> None:
    model, options = run(contact_scenes.SCENES[name](), 5)
    found = dv.contact.forces(model, **options)
    for part in range(2):
        on_bodies = per_body(model, found.vertices[part])
        total = found.floors[part].sum(-2) + found.colliders[part].sum(-2)
        for column, (a, b) in enumerate(found.body_pairs.tolist()):
            total[..., a, :] += found.between[part][..., column, :]
            total[..., b, :] -= found.between[part][..., column, :]
        size = float(found.vertices[part].abs().sum())
        assert float((on_bodies - total).abs().max()) <= tolerance("formula") * size
        # without friction, or not near at the start
        assert size > 0 or (name in ("folded", "fast", "thrown", "held_up") and part == 1)


@pytest.mark.parametrize("scene", ("floor", "plane"))
def test_a_converged_step_is_newtons_second_law(device: str, scene: str) -> None:
    """Contact, weight and the change of momentum of each body, with friction and damping of a sliding stack."""
    model = stack(scene, dv.Friction(0.3, 0.05), device=device)
    x = model.rest_points
    v = torch.zeros_like(x)
    v[:8, 0], v[8:, 2] = 0.2, 0.1
    solver = dv.VBD(0.005, 1)
    done = dv.solve(model, x, v, solver, tolerance=1e-12, pair_damping=5.0, **SOFT)
    assert dv.contact.status(model).truncated == [0]
    found = dv.contact.forces(model, done.x, solver, previous=(x, v), pair_damping=5.0)
    mass = model.mass[:, None]
    gained = per_body(model, mass * (done.v - v)) / solver.time_step + per_body(model, mass) * mass.new_tensor(
        [0.0, GRAVITY, 0.0]
    )
    on_bodies = per_body(model, found.vertices.total)
    assert relative_error(on_bodies, gained) <= tolerance("closed_form")
    ground = (found.floors if scene == "floor" else found.colliders).tangential[0, 0]
    rubbed = found.between.tangential[0]
    assert ground[0] < -0.1 and rubbed[0] < -0.1 and rubbed[2] > 0.1  # against the motion


@pytest.mark.parametrize("name", ["obstacles", "batched", slow("stacked"), slow("crossed")])
def test_gradients_agree_with_differences(name: str) -> None:
    scene = contact_scenes.SCENES[name]()
    model, options = run(scene, 6)
    x, (before, v), solver = options.pop("x"), options.pop("previous"), options.pop("solver")
    options.pop("floor_height", None)  # without a derivative here
    arguments = {"x": x, "before": before, **options}

    def loss(x: Tensor, before: Tensor, **given: Tensor) -> Tensor:
        found = dv.contact.forces(model, x, solver, previous=(before, v), **given)
        out = x.new_zeros(())
        for part in (found.vertices, found.between, found.colliders, found.floors):
            for number, values in enumerate(part):
                weights = contact_scenes.noise("weights", number, shape=values.shape, size=1.0)
                out = out + (weights * values).sum() / 100
        return out

    check = dv.check_gradients(loss, arguments, verbose=False)
    assert check.ok, str(check)
    damped = name == "stacked"  # in the others no pair that was near at the start comes closer
    zero = [argument for argument, size, *_ in check.rows if size == 0]
    assert zero == ([] if damped else ["pair_damping"]), str(check)


def test_scenes_of_a_batch_are_as_if_alone(device: str) -> None:
    scene = contact_scenes.batched()
    model, options = run(scene, 5, scene.model.to(device))
    found = dv.contact.forces(model, **options)
    for k in range(3):
        previous = tuple(t[k] for t in options["previous"])
        parameters = {n: options[n][k] if options[n].shape[:1] == (3,) else options[n] for n in scene.parameters}
        own = dv.contact.forces(model, options["x"][k], options["solver"], previous=previous, **parameters)
        assert own.body_pairs.tolist() == found.body_pairs.tolist() == [[0, 1]]
        for name in ("vertices", "between", "colliders", "floors"):
            for a, b in zip(getattr(found, name), getattr(own, name), strict=True):
                assert relative_error(a[k], b) <= tolerance("formula"), name
    empty = dv.contact.forces(model, options["x"][:0])
    assert empty.vertices.normal.shape == (0, 16, 3) and empty.floors.normal.shape == (0, 2, 1, 3)


STEP = dv.VBD(0.1, 1)
BELOW, LOST = torch.full((16, 3), -9.0).double(), torch.full((16, 3), torch.nan).double()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"x": torch.zeros(3, 3).double()}, r"x: expected shape \[..., 16, 3\], got shape \[3, 3\]"),
        ({"x": torch.zeros(16, 3)}, "x: expected dtype torch.float64"),
        ({"previous": torch.zeros(16, 3).double()}, "previous: expected positions and velocities"),
        ({"previous": (torch.zeros(3).double(), torch.zeros(3).double())}, "previous: x: expected shape"),
        ({"previous": (torch.zeros(2, 16, 3).double(),) * 2, "solver": STEP}, "previous: expected x's shape"),
        ({"previous": (torch.zeros(16, 3).double(),) * 2}, "solver: expected"),
        ({"solver": -1.0}, "solver: expected"),
        ({"colliders": torch.zeros(1, 3).double()}, "colliders: expected a Model with colliders"),
        ({"pair_kapa": 1.0}, "pair_kapa: expected an input of this Model .*: is 'pair_kappa' meant"),
        ({"pair_kappa": torch.tensor(-1.0).double()}, "pair_kappa: expected finite"),
        ({"x": LOST}, "x: expected finite values, got nan"),
        (
            {"previous": (LOST, LOST), "solver": STEP},
            "previous: x: .* finite",
        ),
        ({"x": BELOW}, "x: expected every unpinned vertex above the floor, got vertex 0"),
        (
            {"previous": (BELOW, BELOW), "solver": STEP},
            "previous: x: expected every",
        ),
        ({"x": torch.zeros(16, 3).double()}, "x: expected surfaces that do not touch, got .* pairs without a gap"),
    ],
)
def test_bad_input(change: dict[str, Any], message: str) -> None:
    model = stack("floor", dv.Friction(0.3))
    with pytest.raises((ValueError, TypeError), match=message):
        dv.contact.forces(model, **({"x": model.rest_points} | change))
