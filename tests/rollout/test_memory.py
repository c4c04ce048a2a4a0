"""`dv.memory` against bytes that torch's allocator and autograd report, within the tolerance "memory"."""

import gc
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from helpers.marks import slow
from helpers.results import saved_bytes
from torch import Tensor
from torch.profiler import ProfilerActivity, profile

import diffvbd as dv
from diffvbd import results
from diffvbd.model.system import system_of
from diffvbd.testing import tolerance

SWEEPS = 20


def beam_model(
    floor: bool = False, dtype: torch.dtype = torch.float64, planes: int = 1, pinned: bool = True
) -> dv.Model:
    """The 1,029-vertex beam: large enough that bookkeeping of a few kB per step does not decide."""
    mesh = dv.mesh.beam()
    energies = (
        (dv.StableNeoHookean(), dv.FloorBarrier([-1.0, -1.1, -1.2, -1.3, -1.4][:planes]))
        if floor
        else (dv.StableNeoHookean(),)
    )
    held = mesh.points[:, 0] < 1e-9 if pinned else None
    return dv.Model(mesh, pinned=held, energies=energies, dtype=dtype)


def allocated_bytes(run: Callable[[], Any]) -> tuple[int, int]:
    """What run() and its result still hold at the end, and the largest amount held on the way [bytes]."""
    gc.collect()  # what tests before this left in cycles is not freed while it counts
    with profile(activities=[ProfilerActivity.CPU], profile_memory=True) as profiler:
        result = run()
    events = profiler.profiler.kineto_results.events()
    changes = sorted(((e.start_ns(), e.nbytes()) for e in events if e.name() == "[memory]"), key=lambda e: e[0])
    now = peak = 0
    for _, change in changes:
        now += change
        peak = max(peak, now)
    del result
    return now, peak


def own_tensors(of: dv.Model, solver: dv.VBD) -> list[Tensor]:
    model = system_of(of, solver)
    parts = (vars(model).values(), model._topology, model._bodies, model._other_bodies)
    parts += () if model.coarse is None else (model._coarse_plan,)
    return [t for part in parts for t in part if isinstance(t, Tensor)]


def assert_near(predicted: int, measured: int) -> None:
    assert measured > 0
    assert abs(predicted - measured) <= tolerance("memory") * measured, f"predicted {predicted}, measured {measured}"


@pytest.mark.parametrize("tape", ["full", "compact", "recompute"])
@pytest.mark.parametrize("floor", [False, True])
@pytest.mark.parametrize("scenes", [1, 3])
@pytest.mark.parametrize("wanted", ["v", "mu", "rest_points"])
def test_bytes_of_one_step(tape: str, floor: bool, scenes: int, wanted: str) -> None:
    model = beam_model(floor)
    x = model.rest_points.repeat(scenes, 1, 1)
    arguments = {"v": torch.zeros_like(x), "mu": torch.full((model.num_tets,), 1e4, dtype=x.dtype)}
    arguments["rest_points"] = model.rest_points.clone()
    arguments[wanted].requires_grad_()
    if wanted != "rest_points":
        del arguments["rest_points"]
    solver = dv.VBD(0.01, SWEEPS, tape=tape)
    given = [x, *arguments.values(), *own_tensors(model, solver)]
    measured = saved_bytes(lambda: dv.step(model, x, solver=solver, lam=1e4, **arguments), given)
    predicted = dv.memory(model, solver, scenes=scenes, rest=wanted == "rest_points")
    graph = dv.memory(model, dv.VBD(0.01, SWEEPS), rest=True)["kept"] - dv.memory(model, dv.VBD(0.01, SWEEPS))["kept"]
    assert_near(predicted["step"] + (graph if wanted == "rest_points" else 0), measured)


@pytest.mark.parametrize("floor", [False, True])
@pytest.mark.parametrize("wanted", ["x", "mu"])
def test_bytes_of_one_step_with_coarse_corrections(floor: bool, wanted: str) -> None:
    energies = (dv.StableNeoHookean(), *((dv.FloorBarrier(-1.0),) if floor else ()))
    mesh = dv.mesh.beam()
    model = dv.Model(mesh, pinned=mesh.points[:, 0] < 1e-9, energies=energies)
    x = model.rest_points[None]
    arguments = {"x": x, "v": torch.zeros_like(x), "mu": torch.full((model.num_tets,), 1e4, dtype=x.dtype)}
    arguments[wanted].requires_grad_()
    solver = dv.VBD(0.01, 8, tape="compact", subspace="coarse")
    given = [*arguments.values(), *own_tensors(model, solver)]
    measured = saved_bytes(lambda: dv.step(model, solver=solver, lam=1e4, **arguments), given)
    predicted = dv.memory(model, solver, material=wanted == "mu")
    frame = 2 * x.numel() * x.element_size()  # which a rollout returns
    assert_near(predicted["kept"] - frame, measured)


@pytest.mark.parametrize("sweeps", [5, 20])
def test_bytes_of_corrections_of_joined_bodies(sweeps: int) -> None:
    half = dv.mesh.beam(17, 9, 9, size=(0.3, 0.1, 0.1))
    mesh = dv.mesh.join([half, half.translate((0.3, 0, 0))])
    at = np.flatnonzero(abs(mesh.points[:, 0] - 0.3) < 1e-9)
    ends = [dv.Embedding.of_vertices(at[(at >= half.num_vertices) == side]) for side in (False, True)]
    springs = dv.Springs(*ends, stiffness=1e3)
    model = dv.Model(mesh, pinned=mesh.points[:, 0] < 1e-9, energies=(dv.StableNeoHookean(), springs))
    solver, x = dv.VBD(0.01, sweeps, subspace="coarse"), model.rest_points
    v = torch.zeros_like(x).requires_grad_()
    measured = saved_bytes(lambda: dv.step(model, x, v, solver, mu=1e4, lam=1e4), [x, v, *own_tensors(model, solver)])
    assert_near(dv.memory(model, solver)["step"], measured)


@pytest.mark.parametrize("rigid", [(1,), (0, 1)])
def test_bytes_of_corrections_between_sweeps(rigid: tuple[int, ...]) -> None:
    """Rigid bodies that touch: what 20 more sweeps keep; and a long rollout of them has checkpoints."""
    lower, upper = (dv.mesh.box(5, 0.1, split="kuhn").translate((0.0, y, 0.0)) for y in (0.0, 0.103))
    energies = (dv.StableNeoHookean(), dv.PairBarrier(self_contact=False))
    model = dv.Model(dv.mesh.join([lower, upper]), energies=energies, rigid=rigid)
    x, few, more = model.rest_points.requires_grad_(), dv.VBD(0.005, 4), dv.VBD(0.005, 24)
    first, second = (
        saved_bytes(lambda s=s: dv.step(model, x, 0 * x.detach(), s, mu=1e4, lam=1e4)) for s in (few, more)
    )
    predicted = dv.memory(model, more)["step"] - dv.memory(model, few)["step"]
    assert_near(predicted, second - first)
    assert dv.memory(model, more, steps=10**6)["kept"] < 2**31


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize(("tape", "scalars"), [("full", 9), ("compact", 3), ("recompute", 0)])
def test_the_tape_is_what_the_documentation_says(tape: str, scalars: int, dtype: torch.dtype) -> None:
    """72, 24 or 0 bytes for each active vertex and sweep in float64, half of it in float32; 104 or 32 with a floor."""
    for floor, extra in ((False, 0), (True, {"full": 4, "compact": 1, "recompute": 0}[tape])):
        model = beam_model(floor, dtype)
        item = model.mass.element_size()
        tape_bytes = dv.memory(
            model,
            dv.VBD(0.01, SWEEPS, tape=tape),
            scenes=2,
        )["tape"]
        assert tape_bytes == 2 * SWEEPS * model.num_active * (scalars + extra) * item
        x = model.rest_points.repeat(2, 1, 1)
        sizes = []
        for sweeps in (SWEEPS, 2 * SWEEPS):
            v = torch.zeros_like(x).requires_grad_()
            solver = dv.VBD(0.01, sweeps, tape=tape)

            def run(v: Tensor = v, solver: dv.VBD = solver, x: Tensor = x, model: dv.Model = model) -> Any:
                return dv.step(model, x, v, solver, mu=1e4, lam=1e4)

            sizes.append(saved_bytes(run, own_tensors(model, solver)))
        assert sizes[1] - sizes[0] == tape_bytes


@pytest.mark.parametrize(("name", "value"), [("steps", None), ("material", 1), ("rest", None)])
def test_bad_arguments_are_named(name: str, value: Any) -> None:
    with pytest.raises(TypeError, match=f"^{name}: expected"):
        dv.memory(beam_model(), dv.VBD(0.01, 3), **{name: value})


def test_auto_chooses_by_size() -> None:
    model = beam_model()
    small, large = (dv.memory(model, dv.VBD(0.01, sweeps, tape="auto")) for sweeps in (20, 60_000))
    assert small["tape"] == 20 * model.num_active * 72
    assert large["tape"] == 60_000 * model.num_active * 24
    long = dv.memory(model, dv.VBD(0.01, 20), steps=100_000)
    assert long["kept"] < 0.05 * dv.memory(model, dv.VBD(0.01, 20), steps=100_000, checkpoint_every=None)["kept"]


ROLLOUTS = [
    ("full", 12, None, "last"),
    ("full", 12, None, "all"),
    ("full", 12, 4, "last"),
    ("full", 12, 1, "last"),
    ("full", 12, 5, 3),
    ("full", 24, dv.BinomialCheckpoints(3), "last"),
    ("full", 24, dv.BinomialCheckpoints(5), "all"),
    ("compact", 12, None, "last"),
    ("compact", 12, 4, "all"),
    ("compact", 24, dv.BinomialCheckpoints(4), "last"),
    ("recompute", 12, None, "all"),
    ("recompute", 24, 10, "last"),
]


ROLLOUTS_OF = [(*case, True) for case in ROLLOUTS] + [(*case, False) for case in ROLLOUTS if case[0] == "recompute"]
# each tape, schedule and choice of states once
ONCE = [("full", None, "last"), ("full", 5, 3), ("compact", 4, "all"), ("recompute", None, "all")]
ROLLOUTS_OF = [case if case[4] and (case[0], *case[2:4]) in ONCE else slow(*case) for case in ROLLOUTS_OF]


@pytest.mark.parametrize(("tape", "steps", "schedule", "save", "pinned"), ROLLOUTS_OF)
def test_bytes_of_a_rollout(tape: str, steps: int, schedule: Any, save: Any, pinned: bool) -> None:
    model = beam_model(pinned=pinned)
    x = model.rest_points.clone()
    v = torch.zeros_like(x).requires_grad_()
    mu = torch.full((model.num_tets,), 1e4, dtype=x.dtype, requires_grad=True)
    solver, quiet = dv.VBD(0.01, SWEEPS, tape=tape), dv.Checks(energy=False)  # a look takes some memory for a moment

    def forward(steps: int = steps, schedule: Any = schedule, save: Any = save) -> results.Trajectory:
        return dv.rollout(model, x, v, solver, steps=steps, checkpoint_every=schedule, save=save, checks=quiet, mu=mu,
                          lam=1e4)  # fmt: skip

    def backward(*given: Any) -> None:
        trajectory = forward(*given)
        torch.autograd.grad(trajectory.x.sum(), (v, mu))

    backward()  # what a Model measures once is over
    # what the backward of a step needs in passing is measured on one step and taken off
    passing = (
        allocated_bytes(lambda: backward(1, None, "last"))[1] - allocated_bytes(lambda: forward(1, None, "last"))[0]
    )
    held, _ = allocated_bytes(forward)
    peak = allocated_bytes(backward)[1]
    predicted = dv.memory(model, solver, steps=steps, checkpoint_every=schedule, save=save)
    if isinstance(schedule, dv.BinomialCheckpoints) and save != "last":  # an upper estimate, see its documentation
        assert 0.7 * predicted["kept"] <= peak - passing <= predicted["kept"]
    else:
        assert_near(predicted["kept"], peak - passing)
    assert peak <= (1 + tolerance("memory")) * predicted["total"]
    if schedule is None:
        assert_near(predicted["kept"], held)


@pytest.mark.slow
def test_binomial_keeps_less_than_even_and_even_less_than_all() -> None:
    model = beam_model()
    x = model.rest_points.clone()
    v = torch.zeros_like(x).requires_grad_()
    options = {"mu": 1e4, "lam": 1e4, "steps": 36, "save": "last", "checks": dv.Checks(energy=False),
               "solver": dv.VBD(0.01, SWEEPS, tape="full")}  # fmt: skip
    dv.rollout(model, x, v, **options)  # what a Model measures once is over
    peaks = []
    for schedule in (None, 6, dv.BinomialCheckpoints(3)):
        kept = {"checkpoint_every": schedule}
        peaks.append(allocated_bytes(lambda k=kept: dv.rollout(model, x, v, **options, **k).x.sum().backward())[1])
    assert peaks[1] < 0.25 * peaks[0]
    assert peaks[2] < 0.3 * peaks[1]


def test_bytes_of_the_model_are_those_of_its_tensors() -> None:
    model = beam_model()
    storages = {t.data_ptr(): t.numel() * t.element_size() for t in own_tensors(model, dv.VBD(0.01, 1))}
    found = dv.memory(model, dv.VBD(0.01, 1))
    assert found["model"] == sum(storages.values())
    assert dv.memory(model, dv.VBD(0.01, 1))["total"] == sum(
        dv.memory(model, dv.VBD(0.01, 1))[k] for k in ("kept", "scratch")
    )
