"""Cost of a backward by each route on one forward: time, memory, iterations, error; then over stiffness.

The preset scene of `python -m bench exactness` (115 vertices, four steps) at K = 20. Gradients are those to x0, v0, mu
and lam, the moduli being one number each; errors are those of x0 and v0. Conjugate gradients stop at 1e-10, as the
default does; iterations are those of the longest solve, and of all. Times are medians of rounds that visit all routes
in turn. Unrolled autograd is `dv.Unrolled()`, the same sweeps in torch, vectorised over each color.

Ours is compiled code, its opponents are sequences of torch operations on small tensors, as the paper's are. The matrix-
free opponent multiplies by hand-written products with the Hessian, where the paper's takes torch's double backward.

Memory, two definitions. Peak: on CUDA the growth of `torch.cuda.max_memory_allocated` over forward and backward, the
paper's own; on the CPU that of the resident memory of a process of its own, the median of several. Kept: bytes of the
distinct tensors that the graph holds between forward and backward. The paper's scene, its material and motion, and what
its counts of iterations count, are not stated; its times are those of an RTX 4090 Laptop GPU.
"""

from __future__ import annotations

import ctypes
import gc
import multiprocessing
import statistics
import time
import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

import diffvbd as dv
from bench import exactness, paper
from bench.exactness import GLOBAL, PRESET, UNROLLED, Case, Row, Scene, build, expected_of
from bench.measure import Card, kept_bytes, peak_memory, reset_peak_memory
from bench.tables import Table, times
from diffvbd import testing

SWEEPS = 20
TOLERANCE = 1e-10  # of the linear solves: the default, and about the errors in the paper's table
FULL, COMPACT = "reverse sweep, full tape", "reverse sweep, compact tape"
ROUTES = (FULL, COMPACT, UNROLLED, *GLOBAL)


def preset(quick: bool) -> Case:
    return replace(PRESET, size="small", steps=2) if quick else PRESET


class Task:
    """Forward and backward of a scene's rollout by one route."""

    def __init__(self, scene: Scene, name: str) -> None:
        case, like = scene.case, scene.x
        moduli = [torch.full((), m, dtype=like.dtype, device=like.device) for m in (case.mu, case.lam)]
        self.leaves = tuple(t.clone().requires_grad_() for t in (scene.x, scene.v, *moduli))
        self.options = scene.options(SWEEPS)
        self.options["solver"] = replace(self.options["solver"], tape="compact" if name == COMPACT else "full")
        self.scene, self.adjoint = scene, exactness.adjoint_of(name, TOLERANCE)
        rng = testing.generator("loss")
        self.weights = [torch.from_numpy(rng.standard_normal(tuple(like.shape))).to(like) for _ in range(2)]
        self.weights[1] *= case.time_step

    def forward(self) -> tuple[Tensor, Tensor]:
        x, v, mu, lam = self.leaves
        given = {**self.options, "mu": mu, "lam": lam, "adjoint": self.adjoint}
        done = dv.rollout(self.scene.model, x, v, checkpoint_every=None, save="last", **given)
        return done.x[-1], done.v[-1]

    def backward(self, end: tuple[Tensor, Tensor]) -> Any:
        return torch.autograd.grad(end, self.leaves, self.weights)

    def both(self) -> Any:
        return self.backward(self.forward())


def resident_growth(name: str, quick: bool) -> int:
    """Bytes by which forward and backward raise the peak of resident memory of a process of their own."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(_growth_here, (name, quick))


def _growth_here(name: str, quick: bool) -> int:
    task = Task(build(preset(quick)), name)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        task.both()  # libraries and thread pool are up
        gc.collect()
        try:  # what the first call has left free in the heap would hide what the second needs
            ctypes.CDLL("libc.so.6").malloc_trim(0)
        except OSError:
            pass  # another C library
        before = reset_peak_memory()
        task.both()
    return peak_memory() - before


PRESET_MODULUS = 1e4  # [Pa]
MODULI = (1e3, PRESET_MODULUS, 1e5, paper.STIFF_MODULUS, 1e6, 5e6)  # [Pa], mu = lam
PROCESSES = 5  # whose resident memory is read, one after another, for each route


def seconds(card: Card, task: Task) -> tuple[float, float]:
    """Wall-clock seconds of one forward and of its backward, from idle device to idle device."""
    card.sync()
    start = time.perf_counter()
    end = task.forward()
    card.sync()
    middle = time.perf_counter()
    task.backward(end)
    card.sync()
    return middle - start, time.perf_counter() - middle


def interleaved(card: Card, tasks: dict[Any, Task], rounds: dict[Any, int]) -> dict[Any, Row]:
    """Median milliseconds of each task. Rounds visit all tasks, so that a drift of the machine hits all alike, each
    round in another order, so that what a task leaves in the caches does; a task that takes longer takes part in fewer
    rounds, spread over the whole."""
    spans: dict[Any, list[tuple[float, float]]] = {key: [] for key in tasks}
    total, order = max(rounds.values()), testing.generator("order")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a solve that fails is a column of the table
        for task in tasks.values():
            task.both()
        for n in range(total):
            gc.collect()
            gc.disable()  # a collection that falls into one task's time is not that task's
            for key in (list(tasks)[k] for k in order.permutation(len(tasks))):
                if n * rounds[key] // total != (n + 1) * rounds[key] // total:
                    spans[key].append(seconds(card, tasks[key]))
            gc.enable()
    return {
        key: {
            "forward_ms": 1e3 * statistics.median(f for f, _ in values),
            "backward_ms": 1e3 * statistics.median(b for _, b in values),
            "both_ms": 1e3 * statistics.median(f + b for f, b in values),
            "repetitions": len(values),
        }
        for key, values in spans.items()
    }


def accuracy(scene: Scene, name: str, expected: dict[str, Tensor]) -> Row:
    """Gradient error of a route, its forward verified first, and what its linear solves took."""
    solves: list[Any] = []
    got = exactness.result_of(scene, SWEEPS, exactness.adjoint_of(name, TOLERANCE, solves.append))
    forward = exactness.verified_forward(got, expected, scene.case.time_step, name)
    return {"error": exactness.gradient_error(got, expected), "forward": forward, **exactness.summary(solves)}


def run(quick: bool, *, device: str = "cpu") -> dict[str, Any]:
    card = Card(torch.device(device), quick)
    rows, stiff = routes(card), stiffness(card)
    if card.cuda:  # last, because a capture that fails leaves torch on the stream of the capture
        unrolled = next(row for row in rows if row["route"] == UNROLLED)
        try:
            unrolled |= _captured(card, build(preset(quick), device), UNROLLED)
        except RuntimeError as error:
            unrolled["graph_failed"] = str(error).splitlines()[0][:200]
    return {"routes": rows, "stiffness": stiff, "device": card.device.type}


# --- one scene --------------------------------------------------------------------------------------------------------


def routes(card: Card) -> list[Row]:
    scene = build(preset(card.quick), str(card.device))
    expected = expected_of(scene, SWEEPS)
    errors = {name: accuracy(scene, name, expected) for name in ROUTES}
    tasks = {name: Task(scene, name) for name in ROUTES}
    many, few = (5, 1) if card.quick else (41, 7)
    rounds = {name: few if name == UNROLLED else many for name in ROUTES}
    rows = interleaved(card, tasks, rounds)
    for name, row in rows.items():
        row |= {"route": name, "mesh": scene.name, "steps": scene.case.steps, **errors[name]}
        row["kept"] = kept_bytes(tasks[name].forward)
        if card.cuda:
            tasks[name].both()  # libraries have their workspaces
            row["memory"] = card.peak(tasks[name].both)
        else:
            processes = PROCESSES if not card.quick else int(name in (FULL, UNROLLED))
            row["memories"] = [resident_growth(name, card.quick) for _ in range(processes)]
            row["memory"] = statistics.median(row["memories"]) if processes else None
    for name in (FULL, COMPACT):  # after all peaks: a capture makes torch drop the workspaces of cuBLAS
        rows[name] |= _captured(card, scene, name)
    return list(rows.values())


def _captured(card: Card, scene: Scene, name: str) -> Row:
    """Milliseconds in a CUDA graph; its backward alone cannot be captured and is a difference. Nothing on the CPU."""
    # with leaves of its own, which no graph of another stream has seen
    task = Task(scene, name)
    ahead, both = card.graph(task.forward), card.graph(task.both)
    if ahead is None or both is None:
        return {}
    return {"graph_forward_ms": 1e3 * ahead, "graph_backward_ms": 1e3 * (both - ahead), "graph_both_ms": 1e3 * both}


# --- stiffness --------------------------------------------------------------------------------------------------------


def stiffness(card: Card) -> list[Row]:
    """The same scene with mu = lam from soft to stiff: iterations, times and errors of the routes.

    Three groups of tasks are measured one after another: ours alone; ours among the global routes, round by round; and
    unrolled autograd, whose graph of tens of MB would empty the caches of whatever comes next.
    """
    moduli = (PRESET_MODULUS, paper.STIFF_MODULUS) if card.quick else MODULI
    scenes = {m: build(replace(preset(card.quick), mu=m, lam=m), str(card.device)) for m in moduli}
    alone, among, few = (5, 3, 1) if card.quick else (201, 21, 3)
    times = []
    for names, count in (((FULL,), alone), ((FULL, *GLOBAL), among), ((UNROLLED,), few)):
        tasks = {(m, name): Task(scene, name) for m, scene in scenes.items() for name in names}
        times.append(interleaved(card, tasks, dict.fromkeys(tasks, count)))
    rows = []
    for m, scene in scenes.items():
        expected = expected_of(scene, SWEEPS)
        row: Row = {"modulus": m, "time_step": scene.case.time_step, "steps": scene.case.steps,
                    "among_global": times[1][m, FULL], "routes": {}}  # fmt: skip
        for name in (FULL, UNROLLED, *GLOBAL):
            measured = next(group[m, name] for group in times if (m, name) in group)
            row["routes"][name] = {**measured, **accuracy(scene, name, expected)}
        rows.append(row)
    return rows


# --- tables -----------------------------------------------------------------------------------------------------------


def of_paper(key: str) -> Callable[[Row], Any]:
    return lambda row: paper.COST.get(row["route"], {}).get(key)


TABLES = (
    Table("Routes", "routes",
          {"route": "route", "forward [ms]": "forward_ms", "backward [ms]": "backward_ms",
           "paper": of_paper("backward_ms"), "in a CUDA graph": "graph_backward_ms", "iterations": "iterations",
           "paper, iterations": of_paper("iterations"), "in all": "total_iterations", "gradient error": "error",
           "paper, error": of_paper("error")}),
    Table("Memory [MB]", "routes", {"route": "route", "peak": times("memory", 1e-6), "kept": times("kept", 1e-6),
                                    "paper": of_paper("memory_mb")},
          note=f"The paper: {paper.LESS_TIME_THAN_UNROLLED} times less time than unrolled autograd, and "
               f"{paper.LESS_MEMORY_THAN_UNROLLED} times less memory; {paper.LESS_TIME_THAN_GLOBAL} times less than a "
               "global route."),
    Table("Stiffness: backward [ms], iterations and errors", "stiffness",
          {"mu = lam [Pa]": "modulus", "reverse sweep, alone": f"routes/{FULL}/backward_ms",
           "among global": "among_global/backward_ms", "error": f"routes/{FULL}/error",
           "unrolled": f"routes/{UNROLLED}/backward_ms",
           **{f"{name}{what}": f"routes/{name}/{key}" for name in GLOBAL for what, key in (
               ("", "backward_ms"), (", iterations", "iterations"), (", in all", "total_iterations"),
               (", error", "error"))}},
          note=f"The paper at {paper.STIFF_MODULUS:g} Pa: {paper.STIFF_ITERATIONS} iterations, {paper.STIFF_MS[0]} to "
               f"{paper.STIFF_MS[1]} ms; about {paper.SOFT_ITERATIONS} iterations for soft material."),
)  # fmt: skip
