"""Claim: every CUDA regime executes the same sweeps: each equals the reference within the bars of helpers/exactness.py,
each repeats itself to the bit, and the automatic choice is one of them."""

import itertools
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from helpers.exactness import BATCHED, check, check_shapes
from helpers.regimes import REGIMES, forced, large_inputs, large_solver
from helpers.results import TAPES, assert_same_bits, evaluated
from torch import Tensor
from torch.profiler import ProfilerActivity, profile

import diffvbd as dv
from diffvbd import testing
from diffvbd.model.system import system_of
from diffvbd.ops import regimes
from diffvbd.testing import (
    CASES,
    KINDS,
    generator,
    on_device,
    relative_error,
    sensitivity,
    tolerance,
)
from diffvbd.testing.contact_scenes import SCENES, compiled

pytestmark = pytest.mark.cuda


# --- against the reference --------------------------------------------------------------------------------------------


def rows() -> list[tuple]:
    """Every case with every sweep count; mesh kinds and steps rotate. The small meshes fit a thread."""
    out = []
    for i, case in enumerate(CASES):
        for j, sweeps in enumerate((0, 1, 5, 20)):
            out.append((case, KINDS[(i + j) % 3], "small", sweeps, 4 if sweeps == 5 and i % 3 == 0 else 1))
        out.append((case, KINDS[i % 3], "medium", 5, 1))
    return [*out, ("floor_filtered", "structured", "large", 5, 1), ("paper", "random", "large", 2, 1)]


def rows_of_regimes() -> list[tuple]:
    return [(regime, *row) for row in rows() for regime in REGIMES if regime != "thread" or row[2] == "small"]


@pytest.mark.parametrize(("regime", "case", "kind", "size", "sweeps", "steps"), rows_of_regimes())
def test_every_regime_equals_the_reference(
    regime: str, case: str, kind: str, size: str, sweeps: int, steps: int
) -> None:
    """State and all gradients, under each tape."""
    check(f"cuda {regime}", case, kind, size, sweeps, steps)


@pytest.mark.parametrize("regime", REGIMES)
@pytest.mark.parametrize("sweeps", (1, 3))
@pytest.mark.parametrize("shapes", BATCHED)
def test_every_shape_of_every_argument(shapes: str, sweeps: int, regime: str) -> None:
    """Batches with values shared by scenes, shared by tets, or of each."""
    check_shapes("cuda", shapes, sweeps, regime)


# --- scenes that strain the layout ------------------------------------------------------------------------------------


def ball(rings: int, around: int) -> dv.TetMesh:
    """A sphere's triangles joined to its centre: vertex 0 is in all of 2 rings x around tets."""
    theta = np.pi * np.arange(1, rings + 1) / (rings + 1)
    phi = 2 * np.pi * np.arange(around) / around
    ring = np.stack([np.outer(np.sin(theta), np.cos(phi)), np.outer(np.sin(theta), np.sin(phi)),
                     np.outer(np.cos(theta), np.ones(around))], -1)  # fmt: skip
    points = np.concatenate([np.zeros((1, 3)), [[0.0, 0.0, 1.0]], ring.reshape(-1, 3), [[0.0, 0.0, -1.0]]])
    last, faces = len(points) - 1, []
    for j in range(around):
        k = (j + 1) % around
        faces += [(1, 2 + j, 2 + k), (last, last - around + k, last - around + j)]
        for i in range(rings - 1):
            a, b, c, d = (2 + (i + m) * around + n for m, n in ((0, j), (1, j), (0, k), (1, k)))
            faces += [(a, b, c), (c, b, d)]
    tets = np.concatenate([np.zeros((len(faces), 1), dtype=np.int64), np.array(faces)], 1)
    negative = testing.volumes(points, tets) < 0
    tets[negative] = tets[negative][:, [0, 2, 1, 3]]
    return dv.TetMesh(points, tets)


def cube_with_loose_vertices() -> dv.TetMesh:
    cube = dv.mesh.cube()
    return dv.TetMesh(np.concatenate([cube.points, 3 + np.eye(3)]), cube.tets)


def bodies() -> dv.TetMesh:
    cube = dv.mesh.cube()
    return dv.mesh.join([cube, cube.translate([3.0, 0.0, 0.0]), cube.translate([0.0, 2.0, 4.0])])


FLOOR = dv.FloorBarrier(height=-0.2, kappa=2e4, dhat=0.5, damping=20.0)  # below a cube
BELOW = dv.FloorBarrier(height=-1.2, kappa=2e4, dhat=0.5, damping=20.0)  # below a ball
BODY = dv.StableNeoHookean()
ODD: dict[str, tuple[Callable[[], dv.TetMesh], dict[str, Any], tuple[str, ...]]] = {  # mesh, options, regimes
    "fan for a thread": (lambda: ball(4, 7), {"energies": (BODY, BELOW)}, REGIMES),
    "fan of 98": (lambda: ball(8, 12), {"energies": (BODY, BELOW, dv.Anchor(10.0)), "pinned": [1]}, REGIMES[1:]),
    "fan of 602": (lambda: ball(20, 30), {"energies": (BODY,)}, REGIMES[1:]),
    "bodies": (bodies, {"energies": (BODY, FLOOR), "pinned": [0]}, REGIMES),
    "isolated vertices": (cube_with_loose_vertices, {"energies": (BODY, FLOOR), "pinned": [0, 8, 9, 10]}, REGIMES),
    "one tet": (lambda: dv.TetMesh(np.eye(4)[:, 1:], [[0, 1, 2, 3]]), {"energies": (BODY,)}, REGIMES),
    "no energies": (dv.mesh.cube, {"energies": ()}, REGIMES),
    "floor alone": (dv.mesh.cube, {"energies": (FLOOR,)}, REGIMES),
    "anchor alone": (dv.mesh.cube, {"energies": (dv.Anchor(50.0, vertices=[1, 4]),)}, REGIMES),
    "all pinned": (dv.mesh.cube, {"energies": (BODY, FLOOR), "pinned": range(8)}, REGIMES),
    "no tets": (lambda: dv.TetMesh(np.eye(3)[:2], np.zeros((0, 4), dtype=int)), {"pinned": [0, 1]}, REGIMES),
}

SOLVERS = {"fan of 602": {"relaxation": 1.3}, "anchor alone": {"saturation": 0.05}}


def odd_scene(name: str, scenes: tuple[int, ...]) -> tuple[dv.Model, dict[str, Any]]:
    """Model and inputs of an entry of ODD on the CPU."""
    mesh, options, _ = ODD[name]
    model = dv.Model(mesh(), density=100.0, **options)
    rng = generator("odd", name)

    def noise(*shape: int, size: float) -> Tensor:
        return torch.as_tensor(size * rng.uniform(-1, 1, shape))

    full = (*scenes, model.num_vertices, 3)
    x = model.rest_points + noise(*full, size=0.05)
    inputs: dict[str, Any] = {
        "x": x,
        "v": noise(*full, size=1.0) - torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64),
        "force": noise(*full, size=1.0),
        "prescribed": torch.where(model.pinned[:, None].cpu(), x + noise(*full, size=0.01), torch.nan),
        "rest_points": model.rest_points + noise(model.num_vertices, 3, size=0.01),
        "density": torch.tensor(90.0, dtype=torch.float64),
    }
    if "mu" in model.inputs:
        inputs |= {"mu": 1e4 * (1 + noise(*scenes, model.num_tets or 1, size=0.5)),
                   "lam": torch.tensor(2e4, dtype=torch.float64)}  # fmt: skip
    if model.floor is not None:
        inputs["floor_kappa"] = torch.tensor(3e4, dtype=torch.float64)
    return model, inputs


@pytest.mark.filterwarnings("ignore:energies")
@pytest.mark.parametrize("sweeps", (0, 1, 4))
@pytest.mark.parametrize("scenes", ((), (5,)), ids=("one", "batch"))
@pytest.mark.parametrize(("name", "regime"), [(name, r) for name, entry in ODD.items() for r in entry[2]])
def test_odd_scenes_equal_the_cpu(name: str, regime: str, scenes: tuple[int, ...], sweeps: int) -> None:
    assert_equal_to_the_cpu(*odd_scene(name, scenes), regime, sweeps, **SOLVERS.get(name, {}))


def assert_equal_to_the_cpu(model: dv.Model, inputs: dict[str, Any], regime: str, sweeps: int, **options: Any) -> None:
    """State and all gradients, under each tape."""
    for tape in TAPES:
        solver = dv.VBD(0.02, sweeps, tape=tape, **options)
        expected = evaluated(model, inputs, solver)
        with forced(regime):
            result = evaluated(model.to("cuda"), on_device(inputs, "cuda"), solver)
        assert relative_error(result["x"], expected["x"]) <= tolerance("spread_factor") * tolerance("forward")
        for key, value in expected.items():
            if key.startswith("grad_"):
                error = relative_error(result[key], value)
                # masses of a body that falls freely hardly matter: what is left of their gradient is small differences
                moved = 0.0 if error <= tolerance("adjoint") else sensitivity(model, inputs, solver)[key]
                assert error <= testing.bar(moved), (key, tape)


ALL = (10**9, 10**9)
THREADS = {"few": ((0, 0), (0, 0)), "some": ((0, 0), ALL), "many": (ALL, ALL)}  # vertices of a color up to which


@pytest.mark.parametrize("what", ("plain", "floor", "uneven"))
@pytest.mark.parametrize("material", ((), (3, 1), (3, 320)), ids=("one", "of scenes", "of tets"))
@pytest.mark.parametrize("threads", THREADS)
def test_any_number_of_threads_per_vertex(
    threads: str, material: tuple[int, ...], what: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of vertices with 1, 8 and 32 tets: a thread has as few as one and as many as 16."""
    many, some = THREADS[threads]
    monkeypatch.setattr(regimes, "MANY_LANES_VERTICES", many)
    monkeypatch.setattr(regimes, "SOME_LANES_VERTICES", some)
    mesh = dv.mesh.cube(5, split="five")
    energies = (BODY, dv.FloorBarrier(height=-0.2, kappa=2e3, dhat=0.5)) if what == "floor" else (BODY,)
    model = dv.Model(mesh, energies=energies, pinned=mesh.points[:, 1] > 0.9)
    rng = generator("threads", len(material))

    def noise(*shape: int, size: float) -> Tensor:
        return torch.as_tensor(size * rng.uniform(-1, 1, shape))

    x = model.rest_points + noise(3, model.num_vertices, 3, size=0.02)
    inputs = {"x": x, "v": noise(*x.shape, size=1.0), "mu": 1e4 * (1 + noise(*material, size=0.5)),
              "lam": (1e8 if what == "uneven" else 2e4) * (1 + noise(*material, size=0.5))}  # fmt: skip
    assert_equal_to_the_cpu(model, inputs, "color", 6)


@pytest.mark.parametrize("regime", (None, *REGIMES))
def test_no_scenes(regime: str | None) -> None:
    model = dv.Model(dv.mesh.cube(), device="cuda")
    x = model.rest_points.expand(0, -1, -1).clone().requires_grad_()
    with forced(regime):
        end, v = dv.step(model, x, torch.zeros_like(x), dv.VBD(0.01, 2), mu=1e4, lam=1e4)
        assert end.shape == v.shape == (0, 8, 3)
        (slope,) = torch.autograd.grad(end.sum() + v.sum(), x)
    assert slope.shape == x.shape


# --- to the bit -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", (torch.float64, torch.float32), ids=("float64", "float32"))
@pytest.mark.parametrize("tape", TAPES)
@pytest.mark.parametrize(
    ("regime", "cells", "lead"),
    [("thread", 2, (3000,)), ("block", 10, (200,)), ("grid", 10, ()), ("grid", 31, ()), ("grid", 4, (7,)),
     ("color", 31, ()), ("color", 4, (7,)), (None, 2, (3000,)), (None, 10, (200,)), (None, 10, ()), (None, 31, ())],
)  # fmt: skip
def test_runs_repeat_to_the_bit(
    regime: str | None, cells: int, lead: tuple[int, ...], tape: str, dtype: torch.dtype
) -> None:
    (model, inputs), solver = large_inputs(cells, *lead, dtype=dtype), large_solver(3, tape=tape)
    with forced(regime):
        expected = evaluated(model, inputs, solver)
        for i in range(3):
            # memory that held other numbers, and other work on the device at the same time
            torch.full((1 << 24,), float("nan"), device="cuda")
            side = torch.cuda.Stream()
            with torch.cuda.stream(side):
                busy = torch.ones(1 << 24, device="cuda")
                for _ in range(10 * i):
                    busy.mul_(1.5)
            assert_same_bits(evaluated(model, inputs, solver), expected)
            side.synchronize()


@pytest.mark.parametrize("regime", REGIMES)
@pytest.mark.parametrize("tape", TAPES)
def test_a_scene_is_the_same_alone_and_in_a_batch(regime: str, tape: Any) -> None:
    """Its place in the batch matters as little. So does the size of that, unless another number of threads shares a
    vertex: they add up in another order, and the batches differ by rounding."""
    (model, inputs), solver = large_inputs(2 if regime == "thread" else 4, 130), large_solver(3, tape=tape)
    inputs["lam"] = inputs["lam"] * torch.linspace(0.5, 1.5, 130, dtype=torch.float64, device="cuda")[:, None]
    weights = torch.as_tensor(generator("weights").standard_normal(tuple(inputs["x"].shape)), device="cuda")
    names = ("x", "v", "mu", "lam")
    shared = {name: value for name, value in inputs.items() if name not in names}

    def run(i: Any) -> tuple[Tensor, ...]:
        leaves = [inputs[name][i].clone().requires_grad_() for name in names]
        options = {**dict(zip(names, leaves, strict=True)), **shared}
        x, v = dv.step(model, solver=solver, **options)
        return x.detach(), v.detach(), *torch.autograd.grad((weights[i] * (x + 0.01 * v)).sum(), leaves)

    batches = [range(130), range(20, 130), range(60, 101), range(62, 66), *(range(i, i + 1) for i in (0, 31, 64, 129))]
    results, launches = {}, {}
    with forced(regime):
        for batch in batches:
            if len(batch) == 1:
                results[batch] = [value[None] for value in run(batch[0])]
            else:
                results[batch] = run(slice(batch.start, batch.stop))
            launch = launch_of(model, solver, len(batch))
            launches[batch] = launch[:1] if regime == "thread" else launch  # there a vertex has one thread anyway
    scales = [float(value.abs().max()) for value in results[batches[0]]]
    scales[1] = scales[0] / solver.time_step  # v is a difference of positions
    bars = [tolerance("spread_factor") * tolerance("forward")] * 2 + [tolerance("adjoint")] * len(names)
    equal = set()
    for batch, part in itertools.permutations(batches, 2):
        if not set(part) < set(batch):
            continue
        at = slice(part.start - batch.start, part.stop - batch.start)
        if launches[batch] == launches[part]:
            equal.add((len(batch), len(part)))
        pairs = zip(("x", "v", *names), results[batch], results[part], scales, bars, strict=True)
        for name, larger, smaller, scale, bar in pairs:
            assert smaller.any(), name
            if launches[batch] == launches[part]:
                assert torch.equal(larger[at], smaller), (name, batch, part)
            else:
                assert float((larger[at] - smaller).abs().max()) <= bar * scale, (name, batch, part)
    # both kinds of pairs were compared to the bit: batches with each other, and with a scene alone
    assert any(size > 1 for _, size in equal) and any(size == 1 for _, size in equal), equal


# --- the choice -------------------------------------------------------------------------------------------------------


def launch_of(model: dv.Model, solver: dv.VBD, scenes: int) -> tuple[int, ...]:
    """How so many scenes are spread over the device."""
    return system_of(model, solver).settings(solver.time_step, solver.sweeps, scenes).launch


def launches(model: dv.Model, inputs: dict[str, Any], solver: dv.VBD) -> tuple[int, int]:
    """Of sweeps and of reverse sweeps in one step: of each color where that is the regime."""
    with profile(activities=[ProfilerActivity.CUDA]) as seen:
        evaluated(model, inputs, solver)
        torch.cuda.synchronize()
    of = {
        name: sum(e.count for e in seen.key_averages() if name in e.key) for name in ("sweep_forward", "sweep_reverse")
    }
    return of["sweep_forward"], of["sweep_reverse"]


@pytest.mark.parametrize("tape", TAPES)
def test_the_reverse_may_take_another_regime_than_the_sweeps(tape: str) -> None:
    (model, inputs), solver = large_inputs(9, 80), large_solver(3, tape=tape)
    inputs.pop("rest_points")
    assert launch_of(model, solver, 80)[:2] == (regimes.GRID, regimes.COLOR)
    chosen = evaluated(model, inputs, solver)
    with forced("grid"):
        forward = evaluated(model, inputs, solver)
        few = launches(model, inputs, solver)
    with forced("color"):
        reverse = evaluated(model, inputs, solver)
        many = launches(model, inputs, solver)
    assert all(torch.equal(chosen[k], forward[k]) for k in ("x", "v"))
    assert few[0] < many[0] and few[1] < many[1]
    assert launches(model, inputs, solver) == (few[0], many[1])
    limit = tolerance("property_factor") * tolerance("adjoint")
    for key, value in reverse.items():
        assert value.any() and (key == "v" or relative_error(chosen[key], value) <= limit), key


@pytest.mark.parametrize(("cells", "lead"), ((1, (20_000,)), (4, (256,)), (9, (80,)), (10, ()), (31, ())))
def test_the_choice_does_not_depend_on_what_is_differentiated(cells: int, lead: tuple[int, ...]) -> None:
    """A step of an inference run equals the step of a training run to the bit, whatever the tape."""
    model, inputs = large_inputs(cells, *lead)
    inputs.pop("rest_points")
    bare = dv.step(model, solver=large_solver(3), **inputs)
    for tape in TAPES:
        taped = evaluated(model, inputs, large_solver(3, tape=tape))
        assert torch.equal(taped["x"], bare[0]) and torch.equal(taped["v"], bare[1]), tape


def test_a_regime_that_cannot_run_a_scene_raises() -> None:
    model, inputs = large_inputs(10)
    with forced("thread"), pytest.raises(ValueError, match="regime"):
        dv.step(model, solver=large_solver(1), **inputs)
    dv.step(model, solver=large_solver(1), **inputs)  # outside, the choice is free again


@pytest.mark.parametrize("name", ("warp", "", "Thread", 3))
def test_an_unknown_regime_raises(name: Any) -> None:
    with pytest.raises((ValueError, TypeError), match="regime"), testing.regime(name):
        pass


# --- sweeps with contact ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("tape", TAPES)
@pytest.mark.parametrize("sweeps", (1, 4))
@pytest.mark.parametrize("name", list(SCENES))
def test_one_launch_and_a_launch_for_each_color_give_the_same_bits(name: str, sweeps: int, tape: str) -> None:
    scene = SCENES[name]()
    model, found = scene.model.to("cuda"), []
    for regime in ("grid", "color"):
        with forced(regime):
            found.append(compiled(scene, 2, scene.solver(sweeps, tape=tape), model)[0])
    for key, value in found[0].items():
        assert torch.equal(value, found[1][key]), key
    assert all(found[0][key].any() for key in ("x", "v", "grad_x", "grad_v"))


def cubes(scenes: int) -> tuple[dv.Model, dict[str, Tensor]]:
    """A cube that falls on another one, with friction, over a floor, in scenes that differ."""
    cube = dv.mesh.cube(3, size=0.2)
    mesh = dv.mesh.join([cube, cube.translate((0.03, 0.205, 0.02))])
    energies = (dv.StableNeoHookean(), dv.FloorBarrier(height=-0.005, kappa=1e4, dhat=0.01),
                dv.PairBarrier(1e4, 0.01, damping=1.0, detections=1), dv.Friction(0.3, 0.05))  # fmt: skip
    model = dv.Model(mesh, energies=energies).to("cuda")
    shares = torch.linspace(0.5, 1.5, scenes + 1, dtype=torch.float64, device="cuda")[:scenes, None]
    x = model.rest_points.expand(scenes, -1, -1).clone()
    v = torch.zeros_like(x)
    v[:, cube.num_vertices :, 1] = -0.5 * shares
    return model, {"x": x, "v": v, "mu": 1e5 * shares.expand(-1, model.num_tets).clone()}


def solver_of_cubes(tape: Any = "auto") -> dv.VBD:
    return dv.VBD(0.01, 5, subspace=dv.CoarseSpace(every=3), tape=tape)


def run_of_contact(
    model: dv.Model, given: dict[str, Tensor], tape: str, scenes: int | None = None
) -> dict[str, Tensor]:
    """The state after a step of the first scenes, and gradients of a fixed sum of it for each scene."""
    leaves = {key: value[:scenes].clone().requires_grad_() for key, value in given.items()}
    x, v = dv.step(model, solver=solver_of_cubes(tape), **leaves, lam=1e5)
    weights = torch.linspace(-1, 1, x[0].numel(), dtype=x.dtype, device=x.device).view_as(x[0])
    grads = torch.autograd.grad((weights * (x + 0.01 * v)).sum(), list(leaves.values()))
    return {"x": x.detach(), "v": v.detach(), **{f"grad_{k}": g for k, g in zip(leaves, grads, strict=True)}}


@pytest.mark.parametrize("tape", TAPES)
def test_more_vertices_than_blocks(tape: str) -> None:
    """With coarse corrections between launches of an odd and of an even number of sweeps."""
    scenes = 100
    model, given = cubes(scenes)
    blocks = 4 * torch.cuda.get_device_properties("cuda").multi_processor_count
    assert blocks < model.num_vertices * scenes / model.num_colors <= regimes.MANY_LANES_VERTICES[0]
    found = []
    for regime in ("grid", "color"):
        with forced(regime):
            found.append(run_of_contact(model, given, tape))
    assert_same_bits(*found)
    assert dv.contact.status(model).pairs > scenes


@pytest.mark.parametrize("tape", TAPES)
def test_some_threads_a_vertex(tape: str) -> None:
    model, given = cubes(400)
    launch = launch_of(model, solver_of_cubes(), 400)
    assert launch == (regimes.COLOR, regimes.COLOR, regimes.SOME_LANES, regimes.SOME_REVERSE_LANES)
    launch = launch_of(model, solver_of_cubes(), 1)
    assert launch == (regimes.GRID, regimes.GRID, regimes.MANY_LANES, regimes.MANY_LANES)
    many, one = run_of_contact(model, given, tape), run_of_contact(model, given, tape, 1)
    for key, value in one.items():
        assert value.any(), key
        bar = tolerance("contact_adjoint" if key.startswith("grad") else "contact_forward")
        assert relative_error(many[key][:1], value) <= tolerance("property_factor") * bar, key
