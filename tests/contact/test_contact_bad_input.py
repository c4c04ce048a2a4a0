"""Claim: what contact cannot do it says: bad input is named with what was expected and what came, more pairs than fit
are loud, and routes of differentiation that do not exist raise."""

import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from helpers.bad_input import INF, NAN
from helpers.two_boxes import STEP, ball, two_boxes
from torch import Tensor

import diffvbd as dv
from diffvbd import colliders
from diffvbd.mesh import box

TRIANGLE = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]


def raises(run: Callable[[], Any], name: str, got: str) -> None:
    """run() raises an error whose message begins with the argument and says what was expected and came."""
    with pytest.raises((ValueError, TypeError)) as error:
        run()
    message = str(error.value)
    assert type(error.value) in (ValueError, TypeError)
    assert message.startswith(f"{name}: expected") and re.search(got, message), message


# --- bad input -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "value", "got"),
    [
        ("kappa", -1.0, "-1"),
        ("kappa", NAN, "nan"),
        ("kappa", "stiff", "str"),
        ("dhat", 0.0, "0"),
        ("dhat", -1.0, "-1"),
        ("dhat", INF, "inf"),
        ("dhat", "near", "str"),
        ("damping", -1.0, "-1"),
        ("damping", [1.0], "list"),
        ("self_contact", 1, "int"),
        ("between_bodies", "yes", "str"),
        ("detections", 0, "0"),
        ("detections", 1001, "1001"),
        ("detections", 1.5, "float"),
        ("detections", True, "bool"),
        ("reach", 0.02, "0.02"),
        ("reach", -1.0, "-1"),
        ("reach", NAN, "nan"),
        ("reach", "far", "str"),
        ("capacity", 0, "0"),
        ("capacity", 10.5, "float"),
        ("capacity", 2**27, str(2**27)),
    ],
)
def test_pair_barrier(name: str, value: Any, got: str) -> None:
    raises(lambda: dv.PairBarrier(**{"dhat": 0.02, name: value}), name, got)


@pytest.mark.parametrize(
    ("name", "value", "got"),
    [("coefficient", -0.1, "-0.1"), ("coefficient", NAN, "nan"), ("coefficient", "rough", "str"),
     ("velocity", 0.0, "0"), ("velocity", -1.0, "-1"), ("velocity", True, "bool"), ("velocity", 1e-320, "1e-320")],
)  # fmt: skip
def test_friction(name: str, value: Any, got: str) -> None:
    raises(lambda: dv.Friction(**{name: value}), name, got)


@pytest.mark.parametrize(
    ("make", "name", "got"),
    [
        (lambda: colliders.Plane(normal=(0.0, 0.0, 0.0)), "normal", r"\(0.0, 0.0, 0.0\)"),
        (lambda: colliders.Plane(normal=(0.0, 1.0)), "normal", "2"),
        (lambda: colliders.Plane(point=(0.0, NAN, 0.0)), "point", "NaN"),
        (lambda: colliders.Sphere(radius=0.0), "radius", "0"),
        (lambda: colliders.Sphere(radius=-1.0), "radius", "-1"),
        (lambda: colliders.Sphere(center=(0.0, 0.0)), "center", "2"),
        (lambda: colliders.Sphere(center="here"), "center", "<U4"),
        (lambda: colliders.Capsule(radius=0.0), "radius", "0"),
        (lambda: colliders.Capsule((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)), "b", r"\(0.0, 0.0, 0.0\)"),
        (lambda: colliders.Capsule(a=(0.0, 0.0, INF)), "a", "Inf"),
        (lambda: colliders.Capsule((1.0, -1.0, 0.0), (2.0, -5.0, 0.0), 1e100), "radius", r"1e\+100"),
        (lambda: colliders.Sphere(radius=2e9), "radius", r"2e\+09"),
        (lambda: colliders.Sphere(torch.zeros(3, requires_grad=True)), "center", "requires grad"),
        (lambda: colliders.Plane(normal=torch.ones(3, requires_grad=True)), "normal", "requires grad"),
        (lambda: colliders.Obstacle(torch.eye(3, requires_grad=True), [[0, 1, 2]]), "points", "requires grad"),
        (lambda: colliders.Sphere((0.0, -1e38, 0.0)), "center", r"-1e\+38"),
        (lambda: colliders.Plane((0.0, 1e10, 0.0)), "point", r"1e\+10"),
        (lambda: colliders.Capsule(b=(1e300, 0.0, 0.0)), "b", r"1e\+300"),
        (lambda: colliders.Obstacle(1e20 * np.eye(3), [[0, 1, 2]]), "points", r"1e\+20"),
        (lambda: colliders.Obstacle(TRIANGLE, [[0, 1, 3]]), "triangles", "0..3"),
        (lambda: colliders.Obstacle(TRIANGLE, [[0, 1, -1]]), "triangles", "-1"),
        (lambda: colliders.Obstacle(TRIANGLE, [[0, 1, 1]]), "triangles", "0"),
        (lambda: colliders.Obstacle(TRIANGLE, []), "triangles", "0"),
        (lambda: colliders.Obstacle(TRIANGLE, [[0.0, 1.0, 2.0]]), "triangles", "float"),
        (lambda: colliders.Obstacle([[0.0, 0.0]], [[0, 0, 0]]), "points", "2"),
        (lambda: colliders.Obstacle(), "points", "object"),
    ],
)
def test_colliders(make: Callable[[], Any], name: str, got: str) -> None:
    """At the latest where a Model is made of them."""
    raises(lambda: dv.Model(box(2), energies=(dv.StableNeoHookean(), dv.PairBarrier()), colliders=[make()]), name, got)


@pytest.mark.parametrize(
    ("options", "name", "got"),
    [
        ({"colliders": [ball()]}, "colliders", "none"),
        ({"energies": (dv.StableNeoHookean(), dv.Friction())}, "energies", "none"),
        ({"energies": (dv.PairBarrier(), dv.PairBarrier())}, "energies", "two"),
        ({"energies": (dv.PairBarrier(), dv.Friction(), dv.Friction())}, "energies", "two"),
        ({"energies": (dv.PairBarrier(),), "colliders": "floor"}, "colliders", "str"),
        ({"energies": (dv.PairBarrier(),), "colliders": [box(2)]}, "colliders", "TetMesh"),
        ({"energies": (dv.PairBarrier(),), "colliders": [colliders.Sphere]}, "colliders", "type"),
    ],
)
@pytest.mark.filterwarnings("ignore:energies. no StableNeoHookean")
def test_model(options: dict[str, Any], name: str, got: str) -> None:
    raises(lambda: dv.Model(box(2), **options), name, got)


@pytest.mark.parametrize(
    ("options", "name", "got"),
    [
        ({"colliders": torch.zeros(2, 3).double()}, "colliders", r"\[2, 3\]"),
        ({"colliders": torch.zeros(1, 3)}, "colliders", "float32"),
        ({"colliders": [[0.0, 0.0, 0.0]]}, "colliders", "list"),
        ({"colliders_before": torch.zeros(4, 1, 3).double()}, "colliders_before", r"\[4, 1, 3\]"),
        ({"colliders_before": torch.zeros(1, 3).int()}, "colliders_before", "int32"),
        ({"colliders_before": torch.full((1, 3), 1e10).double()}, "colliders_before", r"1e\+10"),
        ({"friction_velocity": 0.1}, "friction_velocity", "is 'friction' meant"),
        ({"friction": torch.ones(2).double()}, "friction", r"\[2\]"),
        ({"pair_dhat": 0.01}, "pair_dhat", "is 'pair_damping' meant"),
        ({"pair_kappa": "stiff"}, "pair_kappa", "str"),
        ({"pair_damping": torch.ones(())}, "pair_damping", "float32"),
    ],
)
def test_step(options: dict[str, Any], name: str, got: str) -> None:
    model = two_boxes(things=[ball()])
    x = model.rest_points
    raises(lambda: dv.step(model, x, torch.zeros_like(x), **STEP, **options), name, got)


def test_colliders_of_a_model_without() -> None:
    points = torch.zeros(1, 3).double()
    for model in (two_boxes(), dv.Model(box(2))):
        x = model.rest_points
        for name in ("colliders", "colliders_before"):
            raises(lambda name=name, model=model, x=x: dv.step(model, x, x, **STEP, **{name: points}), name, "without")


@pytest.mark.parametrize("name", ("colliders", "colliders_before", "prescribed", "force"))
def test_values_that_are_not_finite(device: str, value_checks: None, name: str) -> None:
    model = dv.Model(box(2, 0.2), energies=(dv.StableNeoHookean(), dv.PairBarrier()), colliders=[ball()], pinned=[0],
                     device=device)  # fmt: skip
    x = model.rest_points
    value = (model.collider_points if name.startswith("colliders") else x).clone()
    value[0, 1] = NAN
    value = x.clone().index_fill(0, torch.tensor([3], device=device), NAN) if name == "force" else value
    raises(lambda: dv.step(model, x, 0 * x, **STEP, **{name: value}), name, "nan")


@pytest.mark.parametrize("value", (-5.0, NAN))
@pytest.mark.parametrize("name", ("pair_kappa", "pair_damping", "friction"))
def test_parameters_out_of_range(device: str, value_checks: None, name: str, value: float) -> None:
    model = two_boxes(device)
    x, given = model.rest_points, torch.tensor(value, dtype=torch.float64, device=device)
    raises(lambda: dv.step(model, x, 0 * x, **{name: given}, **STEP), name, f"{value:g}")


def test_rollout_and_contact_functions() -> None:
    model = two_boxes(things=[ball()])
    x, points = model.rest_points, model.collider_points

    def rollout(value: Any) -> Any:
        return dv.rollout(model, x, 0 * x, steps=3, colliders=value, **STEP)

    raises(lambda: rollout(lambda *_: points.expand(2, 3)), "colliders", r"\[2, 3\]")
    raises(lambda: rollout(dv.per_step(points.expand(2, 1, 3))), "colliders", r"\[2, 1, 3\]")
    raises(lambda: rollout(dv.per_step(points.expand(3, 2, 3).contiguous())), "colliders", r"\[2, 3\]")
    raises(lambda: dv.contact.status("model"), "model", "str")
    raises(lambda: dv.contact.reserve("model", 5), "model", "str")
    raises(lambda: dv.contact.intersections(None, model.rest_points), "model", "NoneType")
    raises(lambda: dv.contact.reserve(dv.Model(box(2)), 5), "model", "none")
    raises(lambda: dv.contact.reserve(model, 0), "pairs", "0")
    raises(lambda: dv.contact.reserve(model, 1.5), "pairs", "float")
    raises(lambda: dv.contact.intersections(model, x[:5]), "x", r"\[5, 3\]")
    raises(lambda: dv.contact.intersections(model, x.long()), "x", "int64")
    raises(lambda: dv.contact.intersections(model, x.tolist()), "x", "list")
    raises(lambda: dv.contact.intersections(model, x.to_sparse()), "x", "sparse")
    raises(lambda: dv.contact.intersections(model, x.to("meta")), "x", "meta")


# --- more pairs than fit ---------------------------------------------------------------------------------------------


def test_overflow_names_the_size_and_reserve_helps() -> None:
    model, roomy = two_boxes(capacity=3), two_boxes()
    x = model.rest_points.expand(2, -1, -1).contiguous()
    with pytest.raises(RuntimeError, match=r"capacity: \d+ pairs .* do not fit 6 \(3 per scene\)") as error:
        dv.step(model, x, 0 * x, **STEP)
    status = dv.contact.status(model)
    assert status.overflowed and status.capacity == 6
    found = re.search(r"capacity: (\d+) pairs.*reserve\(model, (\d+)\)", str(error.value))
    assert found is not None and int(found[1]) == status.pairs
    dv.contact.reserve(model, int(found[2]))
    for a, b in zip(dv.step(model, x, 0 * x, **STEP), dv.step(roomy, x, 0 * x, **STEP), strict=True):
        assert torch.equal(a, b)
    assert dv.contact.status(model).capacity == 2 * int(found[2]) and not dv.contact.status(model).overflowed
    assert model.contact is not None and model.contact.capacity == int(found[2])
    assert model.to(dtype=torch.float32).surface_of_contact.capacity == int(found[2])  # it stays


# --- what cannot be differentiated -----------------------------------------------------------------------------------


@pytest.mark.parametrize("adjoint", (dv.Unrolled(), dv.GlobalAdjoint()), ids=("Unrolled", "GlobalAdjoint"))
def test_other_adjoints_raise(adjoint: Any) -> None:
    model, floor = two_boxes(), dv.FloorBarrier(height=-1.0)
    rubbed = dv.Model(box(2), energies=(dv.StableNeoHookean(), floor, dv.Friction()))
    for m in (model, rubbed):
        x = m.rest_points
        for run in (dv.step, lambda *a, **k: dv.rollout(*a, steps=2, **k)):
            with pytest.raises(NotImplementedError, match=f"adjoint: .*ReverseSweep.*{type(adjoint).__name__}"):
                run(m, x, 0 * x, adjoint=adjoint, **STEP)


def speed_of(model: dv.Model, v: Tensor, **options: Any) -> Tensor:
    return (dv.step(model, model.rest_points, v, **STEP, **options)[0] ** 2).sum()


def test_second_derivatives_and_forward_mode_raise(device: str) -> None:
    model = two_boxes(device)
    v = torch.zeros_like(model.rest_points).requires_grad_()
    (slope,) = torch.autograd.grad(speed_of(model, v), v, create_graph=True)
    with pytest.raises(NotImplementedError, match="second derivatives"):
        torch.autograd.grad(slope.sum(), v)
    coefficient = torch.tensor(0.3, dtype=torch.float64, device=device, requires_grad=True)
    (slope,) = torch.autograd.grad(speed_of(model, v, friction=coefficient), coefficient, create_graph=True)
    with pytest.raises(NotImplementedError, match="second derivatives"):
        torch.autograd.grad(slope, coefficient)
    with pytest.raises(NotImplementedError, match="derivatives in forward mode"):
        torch.func.jvp(lambda v: speed_of(model, v), (v.detach(),), (torch.ones_like(v),))


@pytest.mark.parametrize("speed", (1e60, 1e100))
def test_motion_beyond_all_trust_regions_is_truncated(speed: float) -> None:
    """No fraction of it is small enough: nothing moves, and the status tells."""
    model = two_boxes()
    x = model.rest_points
    end, v = dv.step(model, x, torch.full_like(x, speed), **STEP)
    assert torch.isfinite(end).all() and torch.isfinite(v).all() and float((end - x).abs().max()) < 0.1
    assert dv.contact.status(model).truncated == [model.num_vertices]


def test_changing_where_colliders_were_before_a_checkpointed_backward_raises() -> None:
    ball = colliders.Sphere((0.1, -0.115, 0.1), 0.1)
    pairs = dv.PairBarrier(kappa=1e4, dhat=0.02, self_contact=False)
    model = dv.Model(box(3), energies=(dv.StableNeoHookean(), pairs), colliders=[ball])
    x, before = model.rest_points, model.collider_points.clone()
    v = torch.zeros_like(x).requires_grad_()
    path = dv.per_step(before.expand(4, -1, -1).clone())
    end = dv.rollout(model, x, v, steps=4, checkpoint_every=2, colliders=path, colliders_before=before, **STEP,
                     checks=dv.Checks(start=False)).x[-1]  # fmt: skip
    before.add_(-1e-4)
    with pytest.raises(RuntimeError, match="colliders_before: changed in place"):
        end.sum().backward()


@pytest.mark.parametrize("gap", (1e-11, 1e-14))
def test_gradients_beside_gaps_of_nothing_are_finite(gap: float) -> None:
    """No rigid correction is made of a matrix that is not positive definite, and nothing goes back through it."""
    mesh = dv.mesh.join([box(2, 0.2), box(2, 0.2).translate((0.03, 0.2 + gap, 0.02))])
    energies = (dv.StableNeoHookean(), dv.PairBarrier(kappa=1e4, dhat=0.01), dv.Friction(0.4))
    model = dv.Model(mesh, energies=energies)
    x = model.rest_points
    v = torch.zeros_like(x, requires_grad=True)
    end, _ = dv.step(model, x, v, dv.VBD(0.01, 3, subspace="coarse"), mu=2e4, lam=4e4)
    (grad,) = torch.autograd.grad(end.sum(), v)
    assert torch.isfinite(grad).all() and grad.abs().max() > 0


@pytest.mark.parametrize("name", ["colliders", "colliders_before"])
@pytest.mark.parametrize("integrator", [dv.ImplicitEuler(), dv.SDIRK2()], ids=str)
def test_a_plane_whose_corner_points_lie_on_a_line_is_named(name: str, integrator: Any) -> None:
    things = [colliders.Sphere((5.0, 0.0, 0.0), 0.1), colliders.Plane((0.0, -0.1, 0.0), (0.0, 1.0, 0.0))]
    model = dv.Model(box(2, 0.1), energies=(dv.StableNeoHookean(), dv.PairBarrier()), colliders=things)
    x, points = model.rest_points, model.collider_points
    line = points.clone()
    line[3] = 2 * line[2] - line[1]
    options: dict[str, Any] = {"mu": 1e4, "lam": 1e4, "solver": dv.VBD(0.01, 1, integrator=integrator)}
    for wrong in (line, points[:1], points[0]):
        given = {"colliders": points, "colliders_before": points} | {name: wrong}
        raises(lambda g=given: dv.step(model, x, 0 * x, **options, **g), name, "collider 1 on a line")
