"""Claim: results are bitwise equal run to run, for any number of threads, and alone or in a batch.

Of CUDA see also test_cuda_regimes.py.
"""

import functools
import os
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import torch
from helpers.results import assert_same_bits, evaluated
from torch import Tensor

import diffvbd as dv
from diffvbd import testing
from diffvbd.testing import build_scene, generator, relative_error, structured, tolerance


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
    model = dv.Model(dv.TetMesh(points, tets), pinned=points[:, 0] == 0, energies=energies)
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
        "floor_kappa": tensor(1e3),
        "floor_height": tensor([-0.01]),
    }
    return model, inputs


@pytest.mark.parametrize("tape", ("full", "compact"))
def test_any_number_of_threads(large: tuple, tape: Any, threads: None) -> None:
    (model, inputs), solver = large, dv.VBD(1 / 60, 2, relaxation=1.2, tape=tape)
    torch.set_num_threads(1)
    expected = evaluated(model, inputs, solver)
    for count in (1, 2, 4):
        torch.set_num_threads(count)
        assert_same_bits(expected, evaluated(model, inputs, solver))


@pytest.mark.parametrize("kind", ("random", "delaunay"))
def test_batch_equals_single_scenes(device: str, one_regime: None, kind: str, threads: None) -> None:
    """Fewer scenes than threads and more: the loop over blocks is parallel, or that over scenes."""
    scene = build_scene("batch", kind, "medium")
    model, inputs = scene.model(device), scene.inputs(device=device)
    weights = torch.as_tensor(generator("weights").standard_normal(tuple(inputs["x"].shape)), device=device)
    names = ("x", "v", "mu", "lam", "force", "prescribed")
    shared = {name: value for name, value in inputs.items() if name not in names}

    def run(i: Any) -> tuple[Tensor, ...]:
        leaves = [inputs[name][i].clone().requires_grad_() for name in names]
        x, v = dv.step(model, solver=scene.solver(3), **dict(zip(names, leaves, strict=True)), **shared)
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
    solver = scene.solver(2, tape="auto")
    expected = testing.reference_result(renumbered, moved, solver)
    small = evaluated(theirs, testing.on_device(moved, device), solver)
    assert relative_error(small["x"], expected["x"]) <= tolerance("forward")
    weights = torch.as_tensor(generator("weights").standard_normal(tuple(inputs["x"].shape)))
    ends = []
    for m, given, w in ((ours, inputs, weights), (theirs, moved, weights[back])):
        given, w = testing.on_device(given, device), w.to(device)
        leaves = {name: a.clone().requires_grad_() for name, a in given.items()}
        x, _ = dv.step(m, solver=scene.solver(3000), **leaves)
        gradients = torch.autograd.grad((w * x).sum(), list(leaves.values()))
        ends.append({"end": x.detach()} | dict(zip(leaves, gradients, strict=True)))
    for name, value in ends[0].items():
        per_vertex = name == "end" or inputs[name].shape[:1] == (len(rank),)
        other = ends[1][name][rank] if per_vertex else ends[1][name]
        assert value.any() and relative_error(other, value) <= tolerance("closed_form"), name


# --- instruction sets -------------------------------------------------------------------------------------------------


SETS = ("newest", "baseline", "v3", "v9")
# Other packages are loaded once, which takes seconds; the set is chosen where each child process loads the kernels.
SCRIPT = """
import os, sys, warnings, meshio, torch, torch._dynamo
os.environ.pop("DIFFVBD_ISA", None)
for name in sys.argv[1:]:
    print("set", name, flush=True)
    assert "diffvbd" not in sys.modules
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of threads, which numpy may have started and no import waits for
        child = os.fork()
    if child == 0:
        if name != "newest":
            os.environ["DIFFVBD_ISA"] = name
        try:
            from bench.bits import of_case
            for dtype in (torch.float64, torch.float32):
                for case in ("plain", "paper", "floor_corner", "free_anchored"):
                    print(of_case(case, "cpu", dtype), flush=True)
        except Exception as error:
            print("refused" if "DIFFVBD_ISA: expected" in str(error) else repr(error), flush=True)
        os._exit(0)
    assert os.wait()[1] == 0
"""


@functools.cache
def hashes() -> dict[str, list[str]]:
    """What each set prints: hashes, "refused" where this processor or build lacks it, or what went wrong."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, "-c", SCRIPT, *SETS]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr[-2000:]
    parts = [part.split() for part in done.stdout.split("set ")[1:]]
    return {name: lines for name, *lines in parts}


@pytest.mark.slow
def test_the_same_bits() -> None:
    found = hashes()
    newest = found["newest"]
    assert len(newest) == len(set(newest)) == 8
    assert found["baseline"] == newest
    assert found["v3"] in (newest, ["refused"])  # an older processor, or a build without it


@pytest.mark.slow
def test_an_unknown_set_is_refused() -> None:
    assert hashes()["v9"] == ["refused"]


# --- memory that nobody has written -----------------------------------------------------------------------------------


FLOOR, FRICTION = dv.FloorBarrier(height=-0.003, kappa=1e4, dhat=2e-3), dv.Friction(0.5)
PAIRS = dv.PairBarrier(kappa=1e4, dhat=2e-3)
PLANE = dv.colliders.Plane((0.0, -0.003, 0.0))
SCENES: dict[str, dict[str, Any]] = {
    "plain": {},
    "floor, friction": {"energies": (FLOOR, FRICTION)},
    "coarse": {},
    "pairs": {"energies": (PAIRS,)},
    "pairs, coarse": {"energies": (PAIRS,)},
    "pairs, friction, a collider": {"energies": (PAIRS, FRICTION), "colliders": (PLANE,)},
    "pairs, floor, float32": {"energies": (PAIRS, FLOOR), "dtype": torch.float32},
}


@pytest.fixture
def filled() -> Iterator[None]:
    """As with torch.use_deterministic_algorithms, without which memory is never filled."""
    before, warns = torch.are_deterministic_algorithms_enabled(), torch.is_deterministic_algorithms_warn_only_enabled()
    fills = torch.utils.deterministic.fill_uninitialized_memory
    torch.use_deterministic_algorithms(True, warn_only=True)
    yield
    torch.use_deterministic_algorithms(before, warn_only=warns)
    torch.utils.deterministic.fill_uninitialized_memory = fills


def run(name: str, scenes: int, device: str, fill: bool) -> list[Tensor]:
    """Three cubes that fly into one another, two steps on; and gradients."""
    torch.utils.deterministic.fill_uninitialized_memory = fill
    assert not fill or bool(torch.empty((1000,), device=device).isnan().all())
    cube = dv.mesh.box(3, 0.1)
    bodies = dv.mesh.join([cube.translate((0.104 * k, 0.103 * (k == 2) + 0.004, 0.01 * k)) for k in range(3)])
    options: dict[str, Any] = {"energies": (), **SCENES[name]}
    options["energies"] = (dv.StableNeoHookean(), *options["energies"])
    model = dv.Model(bodies, device=device, **options)
    x = model.rest_points
    v = 3.0 * (x.mean(0) - x) / x.std() * torch.linspace(0.5, 1.0, scenes).to(x)[:, None, None]
    solver = dv.VBD(0.005, 3, subspace="coarse" if "coarse" in name else "rigid")
    leaves = [t.clone().requires_grad_() for t in (x.expand_as(v), v, x.new_full((1, model.num_tets), 1e5))]
    now, speed, mu = leaves
    for _ in range(2):
        now, speed = dv.step(model, now, speed, solver, mu=mu, lam=1e5)
    return [now.detach(), speed.detach(), *torch.autograd.grad((now - x).square().sum(), leaves)]


@pytest.mark.filterwarnings("ignore:.*does not have a deterministic implementation")
@pytest.mark.parametrize("scenes", [1, 2])
@pytest.mark.parametrize("name", SCENES)
def test_what_memory_held_before_does_not_matter(filled: None, name: str, scenes: int, device: str) -> None:
    first, second = (run(name, scenes, device, fill) for fill in (False, True))
    for one, other in zip(first, second, strict=True):
        assert bool(one.isfinite().all()) and float(one.abs().max()) > 0
        assert torch.equal(one, other)
