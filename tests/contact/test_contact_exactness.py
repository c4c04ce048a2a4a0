"""Claim: a step with contact and its reverse equal autograd through an independent execution of the same step.

The detections of the compiled step give the reference its indices; everything else the reference computes for itself.
The bar of a gradient is max(1e-11, 10 x spread), the spread being the disagreement of two references that differ only
in the order of pairs and tets, or the largest of three such.
"""

import functools
from typing import Any

import pytest
import torch
from conftest import DEVICES
from helpers.marks import hours, slow
from helpers.spreads import PARALLEL, assert_near_contact

import diffvbd as dv
from diffvbd import reference
from diffvbd.testing import relative_error
from diffvbd.testing.contact_scenes import GRAVITY, SCENES, compiled, noise, substep_of, unrolled
from diffvbd.testing.tolerances import tolerance

# (steps, sweeps)
RUNS = [(1, 1), (1, 5), (4, 5)]
# Each scene is quick once with one sweep or with several, and the small ones with all runs.
QUICK = {("held_up", 1, 5), *((name, 1, 1) for name in SCENES if name != "held_up"), ("batched", 1, 5),
         ("thrown", 1, 5), *((name, *run) for name in ("obstacles", "on_held") for run in RUNS)}  # fmt: skip
SLOW = [(1, 0), (1, 20), (4, 1)]
LONG = [(3, 20), (20, 2)]  # in turn; `-m hours` runs both
SHORT = {"fast", "thrown", "held_up"}  # like the others after a few steps, each of several substeps
# the fourth step of one folds so that rounding grows beyond its bar; in one sweep no pair of the other is damped
OTHERS = {("folded", (4, 1)): (3, 1), ("held_up", (4, 1)): (4, 2)}
HOURS = [(20, 5), (20, 20)]
# Bounds hold every vertex back in the first step, which therefore starts without a pair closer than dhat.
NONE_YET = {"grad_pair_damping", "grad_friction"}
ZERO = {("fast", 1): NONE_YET, ("held_up", 1): NONE_YET}


@functools.cache
def scene_of(name: str) -> Any:
    return SCENES[name]()


def check(name: str, steps: int, sweeps: int, device: str) -> None:
    scene = scene_of(name)
    solver = scene.solver(sweeps, tape="full")
    result, parts = compiled(scene, steps, solver, scene.model.to(device))
    expected = unrolled(scene, steps, solver, parts)
    # one sample of rounding is at times too kind
    others = [lambda seed=seed: unrolled(scene, steps, solver, parts, seed=seed) for seed in (1, 2, 3)]
    forward, adjoint = steps * tolerance("contact_forward"), PARALLEL.get(name, 1.0) * tolerance("contact_adjoint")
    assert_near_contact(result, expected, forward, adjoint, scene.time_step, others)
    for key, value in expected.items():
        if key.startswith("grad_") and sweeps > 0 and key not in ZERO.get((name, steps), set()):
            assert float(value.abs().max()) > 0, key


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(
    ("name", "steps", "sweeps"),
    [run if run in QUICK else (hours if run == ("fast", 4, 5) else slow)(*run)
     for run in ((name, *run) for name in SCENES for run in RUNS)],
)  # fmt: skip
def test_gradients_are_those_of_the_executed_step(name: str, steps: int, sweeps: int, device: str) -> None:
    check(name, steps, sweeps, device)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(
    ("name", "steps", "sweeps"),
    [*(slow(name, *OTHERS.get((name, run), run)) for name in SCENES for run in SLOW),
     *((slow if i % 2 == (run == LONG[0]) else hours)(name, *run)
       for i, name in enumerate(SCENES) for run in LONG if name not in SHORT),
     *(hours(name, *run) for name in SCENES if name not in SHORT for run in HOURS)],
)  # fmt: skip
def test_gradients_of_longer_runs(name: str, steps: int, sweeps: int, device: str) -> None:
    check(name, steps, sweeps, device)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("tape", ["compact", "recompute"])
@pytest.mark.parametrize("name", list(SCENES))
def test_smaller_tapes_give_the_same_gradients(name: str, tape: str, device: str) -> None:
    scene = scene_of(name)
    model = scene.model.to(device)
    full, small = (compiled(scene, 2, scene.solver(3, tape=t), model)[0] for t in ("full", tape))
    for key, value in full.items():
        if device == "cpu":
            assert torch.equal(value, small[key]), key
        else:  # other kernels, in which products and sums fuse otherwise
            assert relative_error(small[key], value) <= tolerance("contact_adjoint"), key


def test_the_scenes_meet_every_kind_of_contact() -> None:
    """Point-triangle, edge-edge and point-plane pairs; closest points on faces, edges and corners; vertices that are
    truncated and vertices that are not; mollified pairs of edges."""
    kinds, features, cut, free, mollified = set(), set(), 0, 0, 0
    for name in SCENES:
        scene = scene_of(name)
        with dv.record("contact") as found:
            dv.step(scene.model, scene.x, scene.v, scene.solver(2), gravity=GRAVITY, **scene.inputs)
        held = dv.contact.status(scene.model).truncated
        cut, free = cut + sum(held), free + scene.x[..., 0].numel() - sum(held)
        for detection in found:
            part = substep_of(detection)
            kinds |= set(part.pairs[:, 4].tolist())
            near, values = detection.near_corners, detection.near_values
            touching = (values[..., 7] < scene.model.contact.dhat) & (near[..., 4] >= 0)
            corners = (values[touching][:, :4] != 0).sum(-1)
            features |= set(zip(near[touching][:, 4].tolist(), corners.tolist(), strict=True))
            mollified += int((part.constants[:, 2] > 0).sum())
    assert kinds == {0, 1, 2}
    assert {(0, 4), (0, 3), (0, 2), (1, 4)} <= features  # point on face, edge, corner; edge across edge
    assert cut > 0
    assert free > 0
    assert mollified > 0


@pytest.mark.parametrize("name", ["obstacles", slow("stacked"), slow("crossed")])
def test_central_differences_over_fifty_steps(name: str) -> None:
    scene = scene_of(name)
    static = {
        k: v for k, v in scene.inputs.items() if k not in ("colliders", "colliders_before", "force", "prescribed")
    }
    start, velocity = scene.x, 0.2 * scene.v
    weights = noise("differences", name, shape=start.shape, size=1.0)
    direction = noise("direction", name, shape=start.shape, size=1.0)

    def run(size: Any) -> torch.Tensor:
        x, v = start, velocity + size * direction
        for _ in range(50):
            x, v = dv.step(scene.model, x, v, dv.VBD(1 / 200, 4), **static)
        return (weights * x).sum()

    size = torch.zeros((), dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(run(size), size)
    with torch.no_grad():
        errors = (abs(float((run(h) - run(-h)) / (2 * h) - slope)) for h in (1e-5, 1e-6, 1e-4, 1e-7))
        assert abs(float(slope)) > 0
        assert any(error <= tolerance("contact_finite_difference") * abs(float(slope)) for error in errors)


@pytest.mark.parametrize("thing", [dv.colliders.Sphere((0.04, -0.055, 0.045), 0.05),
                                   dv.colliders.Capsule((0.0, -0.055, 0.045), (0.1, -0.055, 0.045), 0.05)])  # fmt: skip
def test_a_round_collider_pushes_in_the_rigid_correction_of_the_reference(thing: Any, device: str) -> None:
    """Its corner is the first of a pair, and is of no body."""
    energies = (dv.StableNeoHookean(), dv.PairBarrier(1e3, 0.01, self_contact=False))
    model = dv.Model(dv.mesh.box(2, 0.1), energies=energies, colliders=[thing], device=device)
    x, solver = model.rest_points, dv.VBD(0.01, 0)
    v, material = torch.zeros_like(x), {"mu": 1e5, "lam": 1e5, "gravity": (0.0, 0.0, 0.0)}
    with dv.record("contact") as found:
        end = dv.step(model, x, v, solver, **material)
    twin = reference.contact_step(model.to("cpu"), x.cpu(), v.cpu(), solver, substeps=[substep_of(d) for d in found],
                                  **material)  # fmt: skip
    assert float((end[0] - x).abs().max()) > 1e-4
    assert relative_error(twin[0], end[0].cpu()) <= tolerance("contact_forward")
