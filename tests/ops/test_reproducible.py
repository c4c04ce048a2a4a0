"""Claim: results are bitwise equal run to run, for any number of threads, and alone or in a batch.

Of CUDA see also test_cuda_regimes.py.
"""

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.results import assert_same_bits, evaluated
from torch import Tensor

import diffvbd as dv
from diffvbd import testing
from diffvbd.testing import build_scene, generator, relative_error, structured, tolerance

OPTIONS: dict[str, Any] = {"time_step": 1 / 60}


@pytest.fixture
def threads() -> Iterator[None]:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def large() -> tuple[dv.Model, dict[str, Any]]:
    """32,768 vertices over a floor: every color has far more blocks than a parallel region needs."""
    points, tets = structured((31, 31, 31))
    energies = (dv.StableNeoHookean(), dv.FloorBarrier(height=-0.01, kappa=1e3, dhat=0.05, damping=5.0))
    model = dv.Model(dv.TetMesh(points, tets), pinned=points[:, 0] == 0, energies=energies, relaxation=1.2)
    smallest = int(model.color_ptr.diff().min())
    assert smallest > 4 * 48 * 8, smallest  # at least 48 blocks of 8 vertices for each of 4 threads
    rng = generator("large")

    def tensor(value: Any) -> Tensor:
        return torch.as_tensor(value, dtype=torch.float64)

    inputs = {
        "x": model.rest_points + tensor(1e-3 * rng.uniform(-1, 1, points.shape)),
        "v": tensor(rng.uniform(-1, 1, points.shape) - [0.0, 2.0, 0.0]),
        "mu": tensor(1e4),
        "lam": tensor(2e4),
        "gravity": tensor([0.0, -9.81, 0.0]),
        "density": tensor(1e3),
        "rest_points": model.rest_points,
        "parameters": {"floor_barrier.kappa": tensor(1e3), "floor_barrier.height": tensor([-0.01])},
    }
    return model, inputs | OPTIONS


@pytest.mark.parametrize("tape", ("full", "compact"))
def test_any_number_of_threads(large: tuple, tape: str, threads: None) -> None:
    model, inputs = large
    torch.set_num_threads(1)
    expected = evaluated(model, inputs, 2, tape)
    for count in (1, 2, 4):
        torch.set_num_threads(count)
        assert_same_bits(expected, evaluated(model, inputs, 2, tape))


@pytest.mark.parametrize("kind", ("random", "delaunay"))
def test_batch_equals_single_scenes(device: str, one_regime: None, kind: str, threads: None) -> None:
    """Fewer scenes than threads and more: the loop over blocks is parallel, or that over scenes."""
    scene = build_scene("batch", kind, "medium")
    model, inputs = scene.model(device), scene.inputs(device=device)
    weights = torch.as_tensor(generator("weights").standard_normal(tuple(inputs["x"].shape)), device=device)
    names = ("x", "v", "mu", "lam", "force", "prescribed")

    def run(i: Any) -> tuple[Tensor, ...]:
        leaves = [inputs[name][i].clone().requires_grad_() for name in names]
        given = {k: inputs[k] for k in ("gravity", "density", "rest_points", "time_step", "parameters")}
        x, v = dv.step(model, sweeps=3, **dict(zip(names, leaves, strict=True)), **given)
        return x.detach(), v.detach(), *torch.autograd.grad((weights[i] * (x + 0.01 * v)).sum(), leaves)

    singles = [run(i) for i in range(3)]
    for count in (1, 2, 4) if device == "cpu" else (1,):
        torch.set_num_threads(count)
        batched = run(slice(None))
        for i, single in enumerate(singles):
            for name, all_scenes, one in zip(("x", "v", *names), batched, single, strict=True):
                assert one.any() and torch.equal(all_scenes[i], one), name


@pytest.mark.parametrize("kind", testing.KINDS)
def test_numbering_of_vertices_is_the_users(device: str, kind: str) -> None:
    """A renumbered mesh gives renumbered results. Colors follow the numbers, and with them the order of the updates, so
    a finite step is compared with a reference in the same order, and converged steps with each other."""
    scene = build_scene("plain", kind, "small")
    rank = generator("rank", kind).permutation(len(scene.points))  # new number of each vertex
    back = np.argsort(rank)
    model, inputs = scene.model(), scene.inputs()
    renumbered = dv.Model(dv.TetMesh(scene.points[back], rank[scene.tets]), pinned=scene.pinned[back],
                          density=model.density)  # fmt: skip
    ours, theirs = model.to(device), renumbered.to(device)
    moved = dict(inputs)
    for name in ("x", "v", "force", "prescribed", "rest_points"):
        moved[name] = inputs[name][back]
    assert relative_error(renumbered.mass[rank], model.mass) <= tolerance("ulps")
    expected = testing.reference_result(renumbered, moved, 2)
    small = evaluated(theirs, testing.on_device(moved, device), 2, "auto")
    assert relative_error(small["x"], expected["x"]) <= tolerance("forward")
    weights = torch.as_tensor(generator("weights").standard_normal(tuple(inputs["x"].shape)))
    ends = []
    for m, given, w in ((ours, inputs, weights), (theirs, moved, weights[back])):
        given, w = testing.on_device(given, device), w.to(device)
        leaves = {name: a.clone().requires_grad_() for name, a in given.items() if name != "time_step"}
        x, _ = dv.step(m, sweeps=3000, time_step=given["time_step"], **leaves)
        gradients = torch.autograd.grad((w * x).sum(), list(leaves.values()))
        ends.append({"end": x.detach()} | dict(zip(leaves, gradients, strict=True)))
    for name, value in ends[0].items():
        per_vertex = name == "end" or inputs[name].shape[:1] == (len(rank),)
        other = ends[1][name][rank] if per_vertex else ends[1][name]
        assert value.any() and relative_error(other, value) <= tolerance("closed_form"), name


@pytest.mark.parametrize("case", ("plain", "paper", "saturated", "inverted", "floor_damped", "anchored"))
def test_dot_product(device: str, case: str) -> None:
    """<J v, w> = <v, J^T w>, J v by central differences of the whole step in all arguments at once."""
    scene = build_scene(case, "delaunay", "small")
    model, inputs = scene.model(device), scene.inputs(device=device)
    time_step, parameters = inputs.pop("time_step"), inputs.pop("parameters", {})
    flat = inputs | parameters
    rng = generator("dot", case)
    # relative directions for material and parameters, absolute ones for positions: each moves the result
    directions = {
        name: torch.as_tensor(rng.standard_normal(tuple(a.shape)), device=device) * (1.0 if a.dim() == 2 else a.abs())
        for name, a in flat.items()
    }
    w = [torch.as_tensor(rng.standard_normal(tuple(flat["x"].shape)), device=device) for _ in range(2)]

    def run(values: dict[str, Tensor]) -> Tensor:
        given = {k: values[k] for k in inputs}
        named = {k: values[k] for k in parameters} or None
        x, v = dv.step(model, sweeps=4, time_step=time_step, parameters=named, **given)
        return (w[0] * x).sum() + time_step * (w[1] * v).sum()

    leaves = {k: a.clone().requires_grad_() for k, a in flat.items()}
    gradients = torch.autograd.grad(run(leaves), list(leaves.values()))
    best = float("inf")
    for name, gradient in zip(leaves, gradients, strict=True):
        adjoint = float((gradient * directions[name]).sum())
        errors = []
        for eps in (1e-4, 1e-5, 1e-6):
            ahead, behind = (run(flat | {name: flat[name] + s * eps * directions[name]}) for s in (1, -1))
            errors.append(abs(float(ahead - behind) / (2 * eps) - adjoint) / abs(adjoint) if adjoint else float("inf"))
        if not gradient.any():
            assert name == "prescribed" and not scene.pinned.any()
            continue
        assert min(errors) <= tolerance("finite_difference"), (name, errors)
        best = min(best, *errors)
    assert best < tolerance("best_difference")


OF_SHEETS = """
import torch
import diffvbd as dv
from diffvbd import testing
sheet = dv.mesh.sheet(13, 10, size=(0.32, 0.24), thickness=0.005)
mesh = dv.mesh.join([sheet, sheet.translate((0.011, 0.015, 0.007))])
barrier = dv.PairBarrier(kappa=1e4, dhat=0.012, self_contact=False, detections=1)
floor = dv.FloorBarrier(height=-0.01, kappa=1e3, dhat=0.02)
model = dv.Model(mesh, energies=(dv.StableNeoHookean(), barrier, floor), coarse="auto")
x, size = model.rest_points, torch.full((), 1e5, dtype=torch.float64)
inputs = {"x": x, "v": -0.3 * torch.cos(7 * x), "mu": size, "lam": 2 * size, "time_step": 0.01}
inputs["parameters"] = {"pair_barrier.kappa": 0.1 * size, "floor_barrier.kappa": 0.01 * size}
found = testing.evaluate(lambda **given: dv.step(model, sweeps=4, **given), inputs)
"""


def test_sheets_that_touch_with_coarse_corrections(threads: None, tmp_path: Path) -> None:
    """By torch's setting and by that of the process: dense algebra may take its order of sums from either."""
    file = tmp_path / "found.pt"
    code = f"{OF_SHEETS}\ntorch.save(found, {str(file)!r})"
    subprocess.run([sys.executable, "-c", code], check=True, env=os.environ | {"OMP_NUM_THREADS": "2"})
    other = torch.load(file)
    assert all(value.any() for value in other.values())
    for count in (1, 2):
        torch.set_num_threads(count)
        here: dict[str, Any] = {}
        exec(OF_SHEETS, here)
        assert_same_bits(here["found"], other)
