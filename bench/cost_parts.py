"""What `python -m bench cost` measures of one route: its task, its memory, and where a global route's time goes."""

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
from bench.cpu import peak_memory, reset_peak_memory
from bench.exactness import PRESET, UNROLLED, Case, Row, Scene, Solves, build
from bench.gpu_measure import Card
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


# --- memory -----------------------------------------------------------------------------------------------------------


def kept_bytes(task: Task) -> int:
    """Bytes of the distinct tensor storages that the graph of a rollout keeps between its forward and its backward.

    What the graph of a second rollout shares with it (Model, arguments, index tables) is no tape and does not count.
    """
    graphs: list[Any] = []
    storages: list[dict[int, int]] = []
    for _ in range(2):
        found: dict[int, int] = {}

        def pack(t: Tensor, found: dict[int, int] = found) -> Tensor:
            found[t.untyped_storage().data_ptr()] = t.untyped_storage().nbytes()
            return t.detach()  # an output that its own graph holds would keep it alive for good

        with torch.autograd.graph.saved_tensors_hooks(pack, lambda t: t):
            graphs.append(task.forward())  # both stay alive, so that no address comes twice
        storages.append(found)
    first, second = storages
    return sum(size for address, size in second.items() if address not in first)


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
        row |= {"scipy": _by_scipy(card, systems), "cholesky": _by_cholesky(card, systems)}
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


def _by_cholesky(card: Card, systems: list[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> Row | None:
    """The same systems by torch's dense factorization on the device; None where a matrix is not positive definite."""
    times, differences = [], []
    for dense, b, solution in systems:
        matrix, right = (torch.from_numpy(a).to(card.device) for a in (dense, b[:, None]))

        def solve(matrix: Tensor = matrix, right: Tensor = right) -> tuple[Tensor, Tensor]:
            factor, failed = torch.linalg.cholesky_ex(matrix)
            return torch.cholesky_solve(right, factor), failed

        found, failed = solve()
        if bool(failed):
            return None
        times.append(_median_ms(card, solve))
        differences.append(_difference(found[:, 0].cpu().numpy(), solution))
    return {"ms": statistics.mean(times), "difference": max(differences)}
