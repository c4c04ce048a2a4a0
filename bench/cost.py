"""Cost of a backward by each route on one forward: time, memory, iterations, error; then over stiffness.

The preset scene of `python -m bench exactness` (115 vertices, four steps) at K = 20. Gradients are those to x0, v0, mu
and lam, the moduli being one number each; errors are those of x0 and v0. Conjugate gradients stop at 1e-10, as the
default does; iterations are those of the longest solve, and of all. Times are medians of rounds that visit all routes
in turn. Unrolled autograd is `dv.Unrolled()`, the same sweeps in torch, vectorised over each color.

Ours is compiled code, its opponents are sequences of torch operations on small tensors, as the paper's are. So the
linear systems of the global routes are also given to scipy's sparse product in numpy's conjugate gradients, with the
same preconditioner and tolerance: what is left of the factor then bounds what dispatch costs. The matrix-free opponent
multiplies by hand-written products with the Hessian, where the paper's takes torch's double backward.

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
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any
from unittest import mock

import numpy as np
import torch
from torch import Tensor

import diffvbd as dv
from bench import paper
from bench.exactness import (
    PRESET,
    UNROLLED,
    Case,
    Row,
    Scene,
    Solves,
    build,
    expected_of,
    gradient_error,
    result_of,
    verify_forward,
)
from bench.measure import Card, kept_bytes, peak_memory, reset_peak_memory
from bench.tables import Table, times, value_of
from diffvbd import testing
from diffvbd.adjoint import implicit as global_adjoint

SWEEPS = 20
TOLERANCE = 1e-10  # of the linear solves: the default, and about the errors in the paper's table
FULL, COMPACT = "reverse sweep, full tape", "reverse sweep, compact tape"
GLOBAL = ("global, assembled", "global, matrix-free")
ROUTES = (FULL, COMPACT, UNROLLED, *GLOBAL)
PARTS = ("set_up_ms", "solve_ms", "gradients_ms", "other_ms")  # of a step of a global backward


def route(name: str, solves: Solves | None = None) -> Any:
    """The adjoint of a route."""
    if name in GLOBAL:
        return dv.GlobalAdjoint(assembled=name == GLOBAL[0], tolerance=TOLERANCE, on_failure="warn", report=solves)
    return {FULL: dv.ReverseSweep("full"), COMPACT: dv.ReverseSweep("compact"), UNROLLED: dv.Unrolled()}[name]


def preset(quick: bool) -> Case:
    return replace(PRESET, size="small", steps=2) if quick else PRESET


class Task:
    """Forward and backward of a scene's rollout by one route."""

    def __init__(self, scene: Scene, name: str) -> None:
        case, like = scene.case, scene.x
        moduli = [torch.full((), m, dtype=like.dtype, device=like.device) for m in (case.mu, case.lam)]
        self.leaves = tuple(t.clone().requires_grad_() for t in (scene.x, scene.v, *moduli))
        self.options = scene.options(SWEEPS)
        self.scene, self.adjoint = scene, route(name)
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


# --- where the time of a global route goes ----------------------------------------------------------------------------


@dataclass
class Recorded:
    """What a global backward has done: its seconds, the times between the parts of its steps, their linear systems."""

    whole: float = 0.0
    times: list[list[float]] = field(default_factory=list)
    systems: list[tuple[Any, Tensor, Tensor]] = field(default_factory=list)  # product, right-hand side, solution

    def milliseconds(self) -> np.ndarray:
        """Of each of PARTS, per step."""
        parts = np.diff(self.times, axis=-1).mean(0)
        return 1e3 * np.append(parts, self.whole / len(self.times) - parts.sum())


@contextmanager
def recording(card: Card) -> Iterator[Recorded]:
    """Within, steps of global backwards are recorded; in `diffvbd.adjoint.implicit` itself, so that it is what runs."""
    done = Recorded()

    def now() -> float:
        card.sync()
        return time.perf_counter()

    class Potential(global_adjoint.IncrementalPotential):
        def __init__(self, *args: Any) -> None:
            done.times.append([now()])
            super().__init__(*args)

        def dependence(self, *args: Any) -> Any:
            bars = super().dependence(*args)
            done.times[-1].append(now())
            return bars

    solve = global_adjoint.conjugate_gradients

    def solved(product: Any, b: Tensor, *args: Any) -> Any:
        done.times[-1].append(now())
        found = solve(product, b, *args)
        done.times[-1].append(now())
        done.systems.append((product, b, found.x))
        return found

    with mock.patch.multiple(global_adjoint, IncrementalPotential=Potential, conjugate_gradients=solved):
        start = now()
        yield done
        done.whole = now() - start


def split(card: Card, scene: Scene, name: str) -> Row:
    """Milliseconds per step of each part of a global backward; of the assembled one, what other solvers need."""
    task, runs = Task(scene, name), []
    for _ in range(3 if card.quick else 15):
        end = task.forward()
        with recording(card) as done, warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a solve that fails is a column of the table
            task.backward(end)
        runs.append(done)
    row: Row = dict(zip(PARTS, np.median([run.milliseconds() for run in runs[1:]], 0).tolist(), strict=True))
    if name == GLOBAL[0]:
        systems = [_system(scene, *system) for system in runs[-1].systems]
        row |= {"scipy": _by_scipy(card, systems)}
    return row


def _system(scene: Scene, product: Any, b: Tensor, solution: Tensor) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Dense matrix [3A, 3A], right-hand side and the package's solution [3A] between the A free vertices."""
    free = (~scene.model.pinned).cpu().numpy()
    dense = product.matrix.to_dense().cpu().numpy()
    index = np.repeat(free, 3)
    return dense[np.ix_(index, index)], b[0].cpu().numpy()[free].ravel(), solution[0].cpu().numpy()[free].ravel()


def _median_ms(card: Card, work: Callable[[], Any]) -> float:
    spans = []
    for _ in range(3 if card.quick else 15):
        card.sync()
        start = time.perf_counter()
        work()
        card.sync()
        spans.append(time.perf_counter() - start)
    return 1e3 * statistics.median(spans[1:])


def _difference(found: np.ndarray, solution: np.ndarray) -> float:
    return float(np.abs(found - solution).max() / np.abs(solution).max())


def _by_scipy(card: Card, systems: list[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> Row | None:
    """The same systems by a compiled sparse product on the CPU; None without scipy."""
    try:
        from scipy import sparse
    except ImportError:
        return None
    times, counts, differences = [], [], []
    for dense, b, solution in systems:
        each = np.arange(len(b) // 3)
        blocks = np.linalg.inv(dense.reshape(len(each), 3, len(each), 3)[each, :, each])
        matrix, inverse = sparse.csr_matrix(dense), sparse.bsr_matrix((blocks, each, np.arange(len(each) + 1))).tocsr()
        found, count = _conjugate_gradients(matrix, inverse, b)
        times.append(_median_ms(card, lambda m=matrix, i=inverse, b=b: _conjugate_gradients(m, i, b)))
        counts.append(count)
        differences.append(_difference(found, solution))
    return {"ms": statistics.mean(times), "iterations": max(counts), "total_iterations": sum(counts),
            "difference": max(differences)}  # fmt: skip


def _conjugate_gradients(matrix: Any, inverse: Any, b: np.ndarray) -> tuple[np.ndarray, int]:
    """Solution and iterations: the recurrence, preconditioner and end of `diffvbd.adjoint.implicit`, in numpy."""
    x, r, goal, count = np.zeros_like(b), b.copy(), TOLERANCE**2 * (b @ b), 0
    p = z = inverse @ r
    rz = r @ z
    while r @ r > goal and count < 10 * len(b):
        q = matrix @ p
        alpha = rz / (p @ q)
        x += alpha * p
        r -= alpha * q
        z = inverse @ r
        before, rz = rz, r @ z
        p = z + (rz / before) * p
        count += 1
    return x, count


PRESET_MODULUS = 1e4  # [Pa]
MODULI = (1e3, PRESET_MODULUS, 1e5, paper.STIFF_MODULUS, 1e6, 5e6)  # [Pa], mu = lam
SPLIT_AT = (PRESET_MODULUS, paper.STIFF_MODULUS)  # where the time of the global routes is taken apart
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
    solves = Solves()
    got = result_of(scene, SWEEPS, route(name, solves))
    forward = verify_forward(scene, got, expected, name)
    return {"error": gradient_error(got, expected), "forward": forward, **solves.summary()}


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
    moduli = SPLIT_AT if card.quick else MODULI
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
        if m in SPLIT_AT:
            for name in GLOBAL:
                row["routes"][name] |= {"split": split(card, scene, name)}
        rows.append(row)
    return rows


# --- tables -----------------------------------------------------------------------------------------------------------


def split_of(name: str) -> Table:
    """Where a global route's time goes, beside the reverse sweep's backward of a step among the same rounds."""
    parts = f"routes/{name}/split"

    def over_ours(*keys: str) -> Callable[[Row], Any]:
        def factor(row: Row) -> Any:
            values = [value_of(row, f"{parts}/{key}") for key in keys]
            ours = row["among_global"]["backward_ms"] / row["steps"]
            return None if None in values else sum(values) / ours

        return factor

    others = ("set_up_ms", "gradients_ms", "other_ms")
    return Table(
        f"Milliseconds a step of a backward, {name}", "stiffness",
        {"mu = lam [Pa]": "modulus", "potential and matrix": f"{parts}/set_up_ms", "solve": f"{parts}/solve_ms",
         "gradients": f"{parts}/gradients_ms", "other": f"{parts}/other_ms",
         "all over the reverse sweep": over_ours("solve_ms", *others),
         "solved by scipy": over_ours("scipy/ms", *others), "solve by scipy alone": over_ours("scipy/ms")},
        only=lambda row: "split" in row["routes"][name],
    )  # fmt: skip


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
               f"{paper.LESS_MEMORY_THAN_UNROLLED} times less memory; {paper.LESS_TIME_THAN_GLOBAL} times less than a global "
               "route."),
    *map(split_of, GLOBAL),
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
