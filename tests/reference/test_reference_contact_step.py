"""Claim: the reference's step with contact is differentiated as executed, and its bounds and parts are as defined.

The index data of a detection is made by hand or by brute force (helpers/two_tets.py).
"""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from helpers.two_tets import (
    CAP,
    COLLIDERS,
    GAMMA,
    RADII,
    REACH,
    detect,
    moved_state,
    scene_of,
    stand_in,
    two_tets,
)
from torch import Tensor

import diffvbd as dv
from diffvbd import reference
from diffvbd.reference import contact, distance
from diffvbd.testing import generator, relative_error, tolerance

MOTION = ("x", "v", "prescribed", "rest_points", "colliders", "colliders_before")


def step_scene(detections: int, scenes: int = 2, **changes: Any) -> tuple[Any, dict[str, Any]]:
    """Model and inputs of scenes in which every term acts: the pinned tet below is shifted, the upper one falls."""
    rng = generator("step")
    floor = dv.FloorBarrier(height=-1.0, kappa=300.0, dhat=0.2, damping=2.0)
    model = dv.Model(two_tets(), pinned=[1], energies=(dv.StableNeoHookean(), floor), saturation=0.3, relaxation=1.2)
    model = stand_in(model, detections=detections, **changes)

    def normal(*shape: int) -> Tensor:
        return torch.as_tensor(rng.standard_normal(shape))

    x = model.rest_points + 0.02 * normal(scenes, 8, 3)
    inputs = {
        "x": x,
        "v": torch.tensor([0.0, -3.0, 0.4]) * model.body[:, None].double() + 0.3 * normal(scenes, 8, 3),
        "mu": 2e4 * (1 + 0.1 * normal(scenes, 2)),
        "lam": 3e4 * (1 + 0.1 * normal(2)),
        "density": 900 * (1 + 0.1 * normal(scenes, 2)),
        "force": 3 * normal(scenes, 8, 3),
        "gravity": torch.tensor([0.3, -9.81, 0.1]).double(),
        "prescribed": x + 0.01 * normal(scenes, 8, 3),
        "rest_points": model.rest_points + 1e-3 * normal(scenes, 8, 3),
        "colliders": COLLIDERS + 0.01 * normal(scenes, 6, 3),
        "colliders_before": COLLIDERS + 0.01 * normal(6, 3),
        "time_step": 0.02,
        "parameters": {
            "pair_barrier.kappa": 3e3 * (1 + 0.1 * normal(scenes)),
            "pair_barrier.damping": torch.tensor(40.0).double(),
            "friction.coefficient": 0.5 + 0.1 * normal(scenes),
            "floor_barrier.kappa": torch.tensor(400.0).double(),
        },
    }
    return model, inputs


def parts_of(model: Any, inputs: dict[str, Any], island: list[int]) -> list[reference.Part]:
    """Detections at the start and a little further on; their indices are data, whatever state they come from."""
    x, begin, end = inputs["x"], inputs["colliders_before"].expand_as(inputs["colliders"]), inputs["colliders"]
    count = model.contact.detections
    lines = [(x + (n / count) * 2e-3 * inputs["v"], *(begin + (m / count) * (end - begin) for m in (n, n + 1)))
             for n in range(count)]  # fmt: skip
    return [detect(model, state, before, now, [island] * len(x)) for state, before, now in lines]


@pytest.fixture
def cuts(monkeypatch: pytest.MonkeyPatch) -> list[bool]:
    """Of every step and update that passed the bounds, whether a vertex kept it."""
    seen: list[bool] = []
    inner = contact.Bounds.cut

    def cut(self: contact.Bounds, x: Tensor, step: Tensor, vertices: Tensor) -> Tensor:
        out = inner(self, x, step, vertices)
        seen.extend((out == step).all(-2).flatten().tolist())
        return out

    monkeypatch.setattr(contact.Bounds, "cut", cut)
    return seen


@pytest.mark.parametrize("detections", (1, 2))
def test_step_against_central_differences(detections: int, cuts: list[bool]) -> None:
    model, inputs = step_scene(detections)
    parts = parts_of(model, inputs, [-1, 1])
    names = [name for name in inputs if isinstance(inputs[name], Tensor)]
    flat = {name: inputs[name] for name in names} | inputs["parameters"]
    rng = generator("loss of a step")
    weights = [torch.as_tensor(rng.standard_normal((2, 8, 3))) for _ in range(2)]

    def loss(values: dict[str, Tensor]) -> Tensor:
        given = {name: values[name] for name in names}
        parameters = {name: values[name] for name in inputs["parameters"]}
        x, v = reference.contact_step(model, time_step=0.02, sweeps=3, parts=parts, parameters=parameters, **given)
        return (weights[0] * x + 0.02 * weights[1] * v).sum()

    leaves = {name: value.clone().requires_grad_() for name, value in flat.items()}
    gradients = torch.autograd.grad(loss(leaves), list(leaves.values()))
    assert 0.02 < np.mean(cuts) < 0.98  # some motion is cut, some is not
    for name, gradient in zip(leaves, gradients, strict=True):
        direction = torch.as_tensor(rng.standard_normal(tuple(gradient.shape))) * flat[name].abs().max()
        size = 1e-7 if name in MOTION else 1e-4  # a longer one leaves the executed branch
        ends = [float(loss(flat | {name: flat[name] + sign * size * direction})) for sign in (1, -1)]
        expected = (ends[0] - ends[1]) / (2 * size)
        value = float((gradient * direction).sum())
        assert gradient.any(), name
        assert abs(value - expected) <= tolerance("finite_difference") * max(abs(expected), 1e-4), name


def test_scenes_and_order_of_pairs_change_rounding_alone() -> None:
    model, inputs = step_scene(2)
    parts = parts_of(model, inputs, [-1, 1])
    rng = generator("order")
    order = [torch.as_tensor(rng.permutation(len(part.pairs))) for part in parts]
    x, v = reference.contact_step(model, sweeps=5, parts=parts, **inputs)
    other, _ = reference.contact_step(model, sweeps=5, parts=parts, order=order, **inputs)
    assert 0 < relative_error(other, x) <= tolerance("property_subset")

    def of(value: Any, b: int) -> Any:
        return value[b] if isinstance(value, Tensor) and value.dim() and len(value) == 2 else value

    def part_of(part: reference.Part, b: int) -> reference.Part:
        rows = part.pairs[:, 5] == b
        pairs = part.pairs[rows] * torch.tensor([1, 1, 1, 1, 1, 0])
        return reference.Part(pairs, part.constants[rows], part.near_corners[b : b + 1], part.island[b : b + 1])

    for b in range(2):
        alone = {name: of(value, b) for name, value in inputs.items() if name != "lam"} | {"lam": inputs["lam"]}
        alone["parameters"] = {name: of(value, b) for name, value in inputs["parameters"].items()}
        own = [part_of(part, b) for part in parts]
        single, velocity = reference.contact_step(model, sweeps=5, parts=own, **alone)
        assert single.shape == (8, 3)
        assert relative_error(single, x[b]) <= tolerance("forward")
        assert relative_error(velocity, v[b]) <= tolerance("property_subset")


def nothing_near(scenes: int, colliders: int = 6) -> reference.Part:
    near = torch.full((scenes, 8 + colliders, 5), -1)
    pairs, island = torch.empty(0, 6, dtype=torch.int64), torch.tensor([[0, 1]] * scenes)
    return reference.Part(pairs, torch.empty(0, 3), near, island)


@pytest.mark.parametrize("detections", (1, 3))
def test_without_pairs_it_is_the_plain_step(detections: int) -> None:
    """Bounds that cut nothing leave the predictor as it is, and the parts share the sweeps among them."""
    energies = (dv.StableNeoHookean(),)  # a floor would stop the start of one part, and the next part would go on
    model, inputs = step_scene(detections, contact_numbers=(100.0, 10.0, GAMMA), energies=energies)
    del inputs["parameters"], inputs["prescribed"]
    x, v = reference.contact_step(model, sweeps=5, parts=[nothing_near(2)] * detections, **inputs)
    del inputs["colliders"], inputs["colliders_before"]
    expected_x, expected_v = reference.step(model, sweeps=5, **inputs)
    assert relative_error(x, expected_x) <= tolerance("forward")
    assert relative_error(v, expected_v) <= tolerance("property_subset")


def test_parts_move_what_is_held(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pinned vertices and colliders by thirds, planes seen ahead, lagged terms from the start of the step."""
    model, inputs = step_scene(3)
    parts = parts_of(model, inputs, [-1, 1])
    parts[1:] = [part._replace(pairs=part.pairs[1:], constants=part.constants[1:]) for part in parts[1:]]
    begin, end, x, target = (inputs[name] for name in ("colliders_before", "colliders", "x", "prescribed"))
    numbers, seen, sweeps, bounds = [], [], contact.run_sweeps, contact.Bounds.__init__

    def run_sweeps(scene: Any, energies: list, masses: list, y: Tensor, state: Tensor, *rest: Any) -> Tensor:
        r, (barrier, lagged) = len(numbers), energies[-2:]
        numbers.append(rest[1])
        now = begin + (r + 1) / 3 * (end - begin)
        assert torch.equal(barrier.colliders, now) and torch.equal(lagged.colliders, now)
        assert torch.equal(lagged.start, torch.cat((x, begin.expand_as(end)), 1))
        assert torch.equal(lagged.pairs.corners, parts[0].pairs[:, :4])
        assert torch.equal(barrier.pairs.corners, parts[r].pairs[:, :4])
        assert torch.allclose(state[..., 1], (x + (r + 1) / 3 * (target - x))[:, 1], atol=tolerance("ulps"))
        assert torch.equal(rest[0], x.mT)
        return sweeps(scene, energies, masses, y, state, *rest)

    def look(self: Any, scene: Any, part: Any, state: Tensor, wanted: Tensor, colliders: Tensor, floor: Any) -> None:
        before, now = (begin + n / 3 * (end - begin) for n in (len(seen), len(seen) + 1))
        seen.append(part)
        assert torch.equal(colliders[:, :3], before[:, :3]) and torch.equal(colliders[:, 3:], now[:, 3:])
        bounds(self, scene, part, state, wanted, colliders, floor)

    monkeypatch.setattr(contact, "run_sweeps", run_sweeps)
    monkeypatch.setattr(contact.Bounds, "__init__", look)
    after, _ = reference.contact_step(model, sweeps=5, parts=parts, **inputs)
    assert numbers == [2, 2, 1] and all(a is b for a, b in zip(seen, parts, strict=True))
    assert torch.allclose(after[:, 1], target[:, 1], atol=tolerance("ulps"))


def test_bounds_of_a_detection() -> None:
    """b from the gaps of the nearest pairs, less their radii; u as the mean over what an island may move, by mass."""
    model = stand_in(dv.Model(two_tets(), pinned=[7], density=torch.tensor([500.0, 2000.0]).double()))
    x = moved_state(model)
    wanted = torch.as_tensor(generator("wanted").standard_normal((8, 3)))
    points = torch.cat((x, COLLIDERS))
    part = detect(model, x[None], COLLIDERS[None], COLLIDERS[None], [[0, 0]])
    part.near_corners[0, 1] = torch.tensor([0, 1, 9, 10, distance.EDGE_EDGE])
    near = part.near_corners[0, :8]
    assert 8 in near[:, 0]
    scene = scene_of(model, x)
    bounds = contact.Bounds(scene, part, x.T, wanted.T, COLLIDERS[None])
    offset = 0.08 * (near[:, 0] == 8) + 0.1 * torch.isin(near[:, :4], torch.tensor([9, 10])).any(1)
    gap = distance.distance(near[:, 4], points[near[:, :4]]) - offset
    assert torch.allclose(bounds.radius, (GAMMA * gap).clamp(max=CAP), rtol=tolerance("geometry"))
    mean = (scene.mass[:7, None] * wanted[:7]).sum(0) / scene.mass[:7].sum()
    assert torch.allclose(bounds.center, (x + mean).T, atol=tolerance("formula"))
    part = part._replace(near_corners=torch.full_like(part.near_corners, -1), island=torch.tensor([[-1, 1]]))
    bounds = contact.Bounds(scene, part, x.T, wanted.T, COLLIDERS[None])
    assert torch.allclose(bounds.radius, torch.full((8,), min(GAMMA * REACH, CAP)).double())
    assert torch.equal(bounds.center[:, :4], x[:4].T)
    own = (scene.mass[4:7, None] * wanted[4:7]).sum(0) / scene.mass[4:7].sum()
    assert torch.allclose(bounds.center[:, 4:], (x[4:] + own).T, atol=tolerance("formula"))


def test_bodies_of_an_island_fall_together(cuts: list[bool]) -> None:
    """A centimeter apart at 10 m/s: one translation for both leaves free fall alone; without it the motion is cut."""
    colliders = {"collider_points": torch.empty(0, 3), "plane_points": torch.empty(0, dtype=torch.bool)}
    colliders["surface_of_contact"] = SimpleNamespace(radius=RADII[:8])
    barrier = SimpleNamespace(kappa=0.0, dhat=1e-4, damping=0.0, detections=1)
    model = stand_in(dv.Model(two_tets(1e-3)), friction=None, contact=barrier, **colliders)
    x = model.rest_points
    v = torch.tensor([0.0, -10.0, 0.0]).double().expand(8, 3)
    near = torch.full((1, 8, 5), -1)
    near[:, [0, 1, 2, 4]] = torch.tensor([4, 0, 2, 1, distance.POINT_TRIANGLE])
    step = {"mu": 1e4, "lam": 2e4, "time_step": 0.01, "sweeps": 4}
    free = reference.step(model, x, v, **step)[0]
    for island, cut in (([[0, 0]], False), ([[-1, -1]], True)):
        cuts.clear()
        part = reference.Part(*nothing_near(1, 0)[:2], near, torch.tensor(island))
        after, _ = reference.contact_step(model, x, v, parts=[part], **step)
        assert cut == (not all(cuts))
        if not cut:
            assert relative_error(after, free) <= tolerance("forward")
        else:
            limit = GAMMA * float(distance.distance(torch.tensor([0]), x[None, [4, 0, 2, 1]]))
            assert float((after - x)[[0, 1, 2, 4]].norm(dim=-1).max()) <= limit * (1 + tolerance("geometry"))


def test_bad_input() -> None:
    model, inputs = step_scene(2)
    parts = [nothing_near(2)] * 2
    with pytest.raises(ValueError, match="parts: expected one for each of 2 detections, got 1"):
        reference.contact_step(model, sweeps=1, parts=parts[:1], **inputs)
    with pytest.raises(ValueError, match="order: expected one for each of 2 detections, got 3"):
        reference.contact_step(model, sweeps=1, parts=parts, order=[torch.empty(0)] * 3, **inputs)
