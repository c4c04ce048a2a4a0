"""Claim: a Model with contact is used like any other: it can be copied, rolled out, checkpointed and repeated to the
bit; scenes do not mix, and a Model without contact runs no line of it."""

import copy
import dataclasses
import importlib
import pickle
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from helpers.two_boxes import STEP, ball, two_boxes
from torch import Tensor
from torch.profiler import ProfilerActivity, profile

import diffvbd as dv
from diffvbd.mesh import box
from diffvbd.testing import contact_scenes, relative_error, tolerance
from diffvbd.testing.contact_scenes import GRAVITY, Scene, compiled


def run(scene: Scene, model: dv.Model, steps: int = 2) -> dict[str, Tensor]:
    """End state and gradients of a scene."""
    return compiled(scene, steps, scene.solver(4), model)[0]


# --- a Model moves and is kept ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", contact_scenes.SCENES)
def test_float32_is_close(device: str, name: str) -> None:
    scene = contact_scenes.SCENES[name]()
    model = scene.model.to(device)
    single = model.to(dtype=torch.float32)
    assert single.collider_points.dtype == torch.float32 and single.contact is not None
    expected, result = run(scene, model, steps=1), run(scene, single, steps=1)
    moved = run(dataclasses.replace(scene, x=scene.x.float().double()), model, steps=1)
    assert dv.contact.status(single).pairs == dv.contact.status(model).pairs
    for key, value in expected.items():
        allowed = tolerance("contact_float32" if key.startswith("grad") else "contact_float32_forward")
        allowed = allowed / scene.time_step if key == "v" else allowed
        allowed = max(allowed, tolerance("float32_of_inputs") * relative_error(moved[key], expected[key]))
        assert relative_error(result[key], value) <= allowed, key


@pytest.mark.parametrize("way", ("pickle", "deepcopy", "to", "float32 and back"))
def test_a_copy_does_the_same(way: str) -> None:
    scene = contact_scenes.obstacles()
    model = scene.model
    copies: dict[str, Callable[[], dv.Model]] = {
        "pickle": lambda: pickle.loads(pickle.dumps(model)),
        "deepcopy": lambda: copy.deepcopy(model),
        "to": lambda: model.to("cpu"),
        "float32 and back": lambda: model.to(dtype=torch.float32).to(dtype=torch.float64),
    }
    other = copies[way]()
    assert other.collider_rows == model.collider_rows and torch.equal(other.collider_points, model.collider_points)
    expected, result = run(scene, model), run(scene, other)
    for key, value in expected.items():
        assert torch.equal(result[key], value), key
    assert dv.contact.status(other) == dv.contact.status(model)


def test_scenes_do_not_mix(one_regime: None, device: str) -> None:
    """Each scene of [2, 3, V, 3] as if alone, to the bit: pairs, islands, bounds and parameters."""
    model = two_boxes(device, things=[ball()])
    noise = contact_scenes.noise("scenes", shape=(2, 3, 16, 3), size=0.3).to(device)
    kappa = 400.0 * torch.arange(1, 7, dtype=torch.float64, device=device).reshape(2, 3)
    x = model.rest_points + 5e-3 * noise
    points = model.collider_points + 1e-3 * noise[..., :1, :]

    def run(x: Tensor, v: Tensor, points: Tensor, kappa: Tensor) -> tuple[Tensor, ...]:
        leaves = [t.clone().requires_grad_() for t in (x, v, points, kappa)]
        out = dv.step(model, *leaves[:2], colliders=leaves[2], colliders_before=points, pair_kappa=leaves[3], **STEP)
        return (*out, *torch.autograd.grad((out[0] ** 2).sum() + (out[1] ** 2).sum(), leaves))

    together = run(x, noise, points, kappa)
    status = dv.contact.status(model)
    for i in range(2):
        for j in range(3):
            alone = run(x[i, j], noise[i, j], points[i, j], kappa[i, j])
            for a, b in zip(together[:-1], alone[:-1], strict=True):
                assert torch.equal(a[i, j], b)
            # what kappa gets is a sum over pairs, and processors differ in its order
            assert relative_error(together[-1][i, j], alone[-1]) <= tolerance("contact_adjoint")
            own = dv.contact.status(model)
            assert (
                own.truncated[0] == status.truncated[3 * i + j]
                and own.smallest_gap[0] == status.smallest_gap[3 * i + j]
            )
    assert len(set(status.smallest_gap)) > 1


def test_no_scenes_no_pairs_no_sweeps() -> None:
    model = two_boxes(things=[ball()])
    x = model.rest_points
    none = x.new_zeros(0, 16, 3)
    assert dv.step(model, none, none, **STEP)[0].shape == (0, 16, 3)
    assert dv.contact.status(model).truncated == []
    for integrator in (dv.SDIRK2(), dv.BDF2()):
        ran = dv.rollout(model, none, none, dv.VBD(0.01, 3, integrator=integrator), steps=1, mu=2e4, lam=4e4)
        assert ran.x.shape == (2, 0, 16, 3)
    mu = none.new_ones((0, 1)).requires_grad_()
    ran = dv.rollout(model, none, none, steps=2, **(STEP | {"mu": mu}))
    assert torch.autograd.grad(ran.x.sum(), mu)[0].shape == (0, 1)
    empty = dv.Model(dv.TetMesh(np.zeros((0, 3)), np.zeros((0, 4), np.int64)), energies=model.energies)
    assert dv.rollout(empty, x[:0], x[:0], steps=1, **STEP).x.shape == (2, 0, 3)
    held = dv.Model(model.mesh, energies=model.energies, colliders=model.colliders, pinned=range(16))
    assert torch.equal(dv.step(held, x, 0 * x, **STEP)[0], x)
    assert dv.contact.status(held).pairs == 0
    before = x.clone()
    apart = two_boxes(things=[ball()], dhat=1e-3)
    end, _ = dv.step(apart, x, 0 * x, dv.VBD(0.01, 0), mu=2e4, lam=4e4)
    assert relative_error(end - x, (0 * x).index_fill(1, torch.tensor([1]), -9.81e-4)) <= tolerance("property_subset")
    assert torch.equal(x, before)


# --- rollouts and the other ways to take a step ----------------------------------------------------------------------


def moving() -> tuple[dv.Model, Tensor, Tensor, Tensor]:
    """Two boxes over a ball that moves; points of its center at the ends of the steps [steps, 1, 3]."""
    model = two_boxes(things=[ball()])
    v = torch.zeros_like(model.rest_points)
    v[8:, 1] = -0.3
    path = torch.arange(1, 7, dtype=torch.float64)[:, None, None] * torch.tensor([5e-4, 1e-3, 0.0], dtype=torch.float64)
    return model, model.rest_points, v, model.collider_points + path


def test_rollout_with_moving_colliders_equals_a_loop() -> None:
    model, x0, v0, path = moving()
    results = []
    for looped in (False, True):
        leaves = [t.clone().requires_grad_() for t in (v0, path)]
        if looped:
            x, v = x0, leaves[0]
            before = model.collider_points
            for now in leaves[1].unbind(0):
                x, v = dv.step(model, x, v, colliders=now, colliders_before=before, **STEP)
                before = now
        else:
            end = dv.rollout(model, x0, leaves[0], steps=len(path), colliders=dv.per_step(leaves[1]), **STEP)
            x, v = end.x[-1], end.v[-1]
        results.append((x, v, *torch.autograd.grad((x**2).sum() + (v**2).sum(), leaves)))
    for a, b in zip(*results, strict=True):
        assert torch.equal(a, b) and a.any()


@pytest.mark.parametrize("every", (1, 2, 4, dv.BinomialCheckpoints(2)), ids=str)
def test_a_checkpointed_rollout_is_the_same_to_the_bit(every: Any) -> None:
    model, x0, v0, path = moving()
    results = []
    for checkpoints in (None, every):
        named = {"pair_kappa": 1600.0, "pair_damping": 1.0, "friction": 0.4}
        named = {k: torch.tensor(v, dtype=torch.float64, requires_grad=True) for k, v in named.items()}
        v, points = v0.clone().requires_grad_(), path.clone().requires_grad_()
        end = dv.rollout(model, x0, v, steps=len(path), colliders=dv.per_step(points), **named,
                         checkpoint_every=checkpoints, **STEP)  # fmt: skip
        leaves = (v, points, *named.values())
        results.append((end.x, end.v, *torch.autograd.grad((end.x[-1] ** 2).sum() + (end.v**2).sum(), leaves)))
    for a, b in zip(*results, strict=True):
        assert torch.equal(a, b) and a.any()


def test_step_forward_and_backward() -> None:
    scene = contact_scenes.obstacles()
    leaves = scene.leaves()
    options: dict[str, Any] = {"gravity": GRAVITY, "solver": scene.solver(3)}
    out = dv.step(scene.model, **leaves, **options)
    grads = [torch.ones_like(out[0]), 1e-2 * torch.ones_like(out[1])]
    expected = torch.autograd.grad(out, list(leaves.values()), grads)
    plain = {k: v.detach() for k, v in leaves.items()}
    x, v, tape = dv.step_forward(scene.model, wrt=tuple(leaves), **plain, **options)
    assert torch.equal(x, out[0]) and torch.equal(v, out[1])
    result = dv.step_backward(tape, *grads)
    assert {"colliders", "colliders_before", "friction"} <= set(result)
    for (name, value), slope in zip(result.items(), expected, strict=True):
        assert torch.equal(value, slope) and value.any(), name


# --- to the bit ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", contact_scenes.SCENES)
def test_runs_repeat_to_the_bit(device: str, name: str) -> None:
    scene = contact_scenes.SCENES[name]()
    model = scene.model.to(device)
    first = run(scene, model)
    for key, value in run(scene, model).items():
        assert torch.equal(value, first[key]), key


@pytest.mark.parametrize("name", contact_scenes.SCENES)
def test_threads_change_nothing(name: str) -> None:
    scene = contact_scenes.SCENES[name]()
    before, results = torch.get_num_threads(), []
    try:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            results.append(run(scene, scene.model))
    finally:
        torch.set_num_threads(before)
    for key, value in results[0].items():
        assert torch.equal(results[1][key], value), key


# --- without contact -------------------------------------------------------------------------------------------------


def called(run: Callable[[], Any]) -> set[str]:
    """Operators of the package that run."""
    with profile(activities=[ProfilerActivity.CPU]) as seen:
        run()
    return {e.key for e in seen.key_averages() if e.key.startswith("diffvbd::")}


@pytest.mark.parametrize("energies", ((), (dv.FloorBarrier(height=-0.01, kappa=1e4), dv.Anchor(1.0))))
def test_a_model_without_contact_runs_none_of_it(monkeypatch: pytest.MonkeyPatch, energies: tuple) -> None:
    model = dv.Model(box(3, 0.2), energies=(dv.StableNeoHookean(), *energies))
    x, v = model.rest_points, torch.zeros_like(model.rest_points).requires_grad_()

    def forward_and_backward() -> None:
        end, _ = dv.step(model, x, v, **STEP)
        torch.autograd.grad(end.sum(), v)

    def touching() -> None:
        other = two_boxes()
        dv.step(other, other.rest_points, 0 * other.rest_points, **STEP)

    operators = called(forward_and_backward)
    assert operators and not any("contact" in name for name in operators)
    assert any("contact" in name for name in called(touching))
    solve = importlib.import_module("diffvbd.step.advance")
    monkeypatch.setattr(solve, "run_contact", lambda *_: pytest.fail("contact"))
    forward_and_backward()
    assert model.surface_of_contact is None and not model.touches


@pytest.mark.parametrize("detections", (1, 3))
def test_contact_that_meets_nothing_changes_nothing(detections: int) -> None:
    """A body alone with a PairBarrier that finds no pair takes the same steps, in any number of parts."""
    plain = dv.Model(box(3, 0.2), pinned=[0])
    barrier = dv.PairBarrier(self_contact=False, reach=1.0, detections=detections)
    model = dv.Model(plain.mesh, energies=(dv.StableNeoHookean(), barrier), pinned=[0])
    x, v = plain.rest_points, contact_scenes.noise("alone", shape=(27, 3), size=0.3)
    for sweeps in (0, 1, 5):
        solver = dv.VBD(0.01, sweeps)
        for a, b in zip(*(dv.step(m, x, v, solver, mu=2e4, lam=4e4) for m in (model, plain)), strict=True):
            assert relative_error(a, b) <= tolerance("forward" if a.abs().max() < 1 else "invariance")
    assert dv.contact.status(model).truncated == [0] and dv.contact.status(model).pairs == 0
