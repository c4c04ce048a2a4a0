"""How benchmarks measure: wall clock and CUDA graphs, memory, and the steps that are measured."""

from __future__ import annotations

import gc
import statistics
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import diffvbd as dv

STEP = 5e-3  # [s]
MODULUS = 1e5  # [Pa], mu and lam
Work = Callable[[], Any]
Row = dict[str, Any]


@dataclass(frozen=True)
class Card:
    """Where to measure. On the CPU nothing is captured and the wall clock is read: that only tries the script out."""

    device: torch.device
    quick: bool

    @property
    def cuda(self) -> bool:
        return self.device.type == "cuda"

    def sync(self) -> None:
        if self.cuda:
            torch.cuda.synchronize(self.device)

    def tidy(self) -> None:
        gc.collect()
        if self.cuda:
            torch.cuda.synchronize(self.device)
            torch.cuda.empty_cache()

    def allocated(self) -> int:
        return torch.cuda.memory_allocated(self.device) if self.cuda else 0

    def eager(self, work: Work, repetitions: int = 5) -> float:
        """Median seconds of `work`, called anew each time, after a first call that does not count."""
        return statistics.median(self._spans(work, 1 + (2 if self.quick else repetitions))[1:])

    def graph(self, work: Work, replays: int = 20, budget: float | None = None) -> float | None:
        """Median seconds of replays of `work`, captured in one CUDA graph; None on the CPU. A budget [s] replays slow
        work less often."""
        if not self.cuda:
            return None
        with torch.cuda.device(self.device):
            graph, kept = capture(work)  # kept: what the graph writes, tapes included, as a user's code would
            first = self._spans(graph.replay, 2)[1]
            if budget is not None:
                replays = max(3, min(replays, int(budget / first)))
            spans = self._spans(graph.replay, 3 if self.quick else replays)
            del kept, graph
        return statistics.median(spans)

    def _spans(self, work: Work, count: int) -> list[float]:
        """Seconds of each of several calls; on CUDA by events, so that the host's share shows only where it is late."""
        if not self.cuda:
            return [timed(work) for _ in range(count)]
        with torch.cuda.device(self.device):
            events = [[torch.cuda.Event(enable_timing=True) for _ in range(2)] for _ in range(count)]
            for start, end in events:
                start.record()
                work()
                end.record()
            torch.cuda.synchronize()
        return [start.elapsed_time(end) / 1e3 for start, end in events]

    def peak(self, work: Work) -> int | None:
        """Growth of torch's peak of allocated bytes over one call; None on the CPU."""
        if not self.cuda:
            work()
            return None
        self.tidy()
        before = self.allocated()
        torch.cuda.reset_peak_memory_stats(self.device)
        work()
        torch.cuda.synchronize(self.device)
        return torch.cuda.max_memory_allocated(self.device) - before


def capture(work: Work) -> tuple[torch.cuda.CUDAGraph, Any]:
    """A graph of `work` and what it writes, captured after two calls on a side stream, as torch asks for."""
    side = torch.cuda.Stream()
    side.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(side):
        for _ in range(2):
            work()
    torch.cuda.current_stream().wait_stream(side)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        return graph, work()


def attempt(card: Card, rows: list[Row], about: Row, measure: Callable[[], Row | list[Row]]) -> None:
    """Appends what `measure` returns, each row with `about`; an error becomes a row, so that the others still come."""
    try:
        got = measure()
        rows.extend({**about, **row} for row in (got if isinstance(got, list) else [got]))
    except Exception as error:
        lines = str(error).strip().splitlines()
        rows.append({**about, "error": f"{type(error).__name__}: {lines[0] if lines else ''}"[:300]})
    try:
        card.tidy()
    except RuntimeError:
        pass  # a broken context: the rows that follow will say so themselves


# --- steps of one scene -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Scene:
    """A Model and the tensors of a step, which stay where they are, as a graph wants them."""

    model: dv.Model
    x: Tensor
    v: Tensor
    mu: Tensor
    lam: Tensor
    plain: bool = False  # sweeps alone: from the predictor, without rigid correction

    def solver(self, sweeps: int, tape: Any = "auto") -> dv.VBD:
        plain = {"subspace": None, "start": "predictor"} if self.plain else {}
        return dv.VBD(STEP, sweeps, tape=tape, **plain)

    @property
    def leaves(self) -> tuple[Tensor, ...]:
        return self.x, self.v, self.mu, self.lam

    @property
    def bytes(self) -> int:
        return sum(t.numel() * t.element_size() for t in self.leaves)

    def requiring(self, *names: str) -> Scene:
        """The same scene with tensors of its own, of which those named require grad (mu and lam are "material")."""
        names = tuple(n for name in names for n in (("mu", "lam") if name == "material" else (name,)))
        own = {k: getattr(self, k).detach().clone().requires_grad_(k in names) for k in ("x", "v", "mu", "lam")}
        return replace(self, **own)


def model_of(
    mesh: dv.TetMesh, card: Card, dtype: torch.dtype = torch.float64, pinned: bool = True, **options: Any
) -> dv.Model:
    """A Model at 1000 kg/m^3, held by the face at y = 0."""
    mask = torch.from_numpy(mesh.points[:, 1] < 1e-9) if pinned else None
    return dv.Model(mesh, pinned=mask, dtype=dtype, device=card.device, **options)


def scene_of(model: dv.Model, scenes: int | None = None, material: str = "scalar", noise: float = 1e-3) -> Scene:
    """A Model slightly off rest, in one scene or a batch; material: "scalar", "per tet" or "per scene"."""
    like = model.rest_points
    lead = () if scenes is None else (scenes,)
    shape = {"scalar": (), "per tet": (model.num_tets,), "per scene": (*lead, 1)}[material]
    generator = torch.Generator(like.device).manual_seed(0)
    off = torch.randn((*lead, *like.shape), generator=generator, dtype=like.dtype, device=like.device)
    x = off.mul_(noise).add_(like)
    modulus = torch.full(shape, MODULUS, dtype=like.dtype, device=like.device)
    return Scene(model, x, torch.zeros_like(x), modulus, modulus.clone())


def forward(scene: Scene, sweeps: int, steps: int, tape: Any = "auto") -> Work:
    """Steps of the public interface; with a tape where a tensor of the scene requires grad."""

    def work() -> tuple[Tensor, Tensor]:
        x, v = scene.x, scene.v
        for _ in range(steps):
            x, v = dv.step(scene.model, x, v, scene.solver(sweeps, tape), mu=scene.mu, lam=scene.lam)
        return x, v

    return work


def forward_reverse(scene: Scene, sweeps: int, steps: int, tape: Any = "auto") -> Work:
    """The same steps and the gradients of the sum of final positions and velocities."""
    run = forward(scene, sweeps, steps, tape)
    ones = torch.ones_like(scene.x)
    wanted = [t for t in scene.leaves if t.requires_grad]
    return lambda: torch.autograd.grad(run(), wanted, (ones, ones))


def milliseconds(seconds: float | None, steps: int = 1) -> float | None:
    return None if seconds is None else 1e3 * seconds / steps


# --- what a call enters, and what it leaves to autograd ---------------------------------------------------------------


def calls_of(work: Callable[[], Any]) -> tuple[int, int]:
    """Python calls within the package, and how many of its files they enter."""
    files: Counter[str] = Counter()

    def seen(frame: Any, event: str, _: Any) -> None:
        if event == "call" and "/diffvbd/" in frame.f_code.co_filename:
            files[frame.f_code.co_filename] += 1

    sys.setprofile(seen)
    try:
        work()
    finally:
        sys.setprofile(None)
    return sum(files.values()), len(files)


def nodes_of(outputs: Iterable[Tensor]) -> int:
    """Nodes of autograd's graph, without leaves."""
    found, left = set(), [t.grad_fn for t in outputs]
    while left:
        node = left.pop()
        if node is not None and node not in found and type(node).__name__ != "AccumulateGrad":
            found.add(node)
            left += [after for after, _ in node.next_functions]
    return len(found)


# --- time and memory of this process ---------------------------------------------------------------------------------


def timed(work: Work, clock: Callable[[], float] = time.perf_counter) -> float:
    """Seconds of a call."""
    begun = clock()
    work()
    return clock() - begun


def least(function: Callable[[], float], repetitions: int) -> float:
    """The least of what a function returns; garbage of one run does not count in the next."""
    best = float("inf")
    for _ in range(repetitions):
        gc.collect()
        best = min(best, function())
    return best


def reset_peak_memory() -> int:
    """Resident bytes now; from here on the kernel counts the peak anew (Linux)."""
    Path("/proc/self/clear_refs").write_text("5")
    return _status("VmRSS")


def peak_memory() -> int:
    return _status("VmHWM")


def _status(field: str) -> int:
    line = next(a for a in Path("/proc/self/status").read_text().splitlines() if a.startswith(field))
    return int(line.split()[1]) * 1024


def kept_bytes(once: Callable[[], Any]) -> int:
    """Bytes that the graph of a forward keeps for its backward, without what a second graph shares with it (Model,
    arguments, index tables)."""
    storages: list[dict[int, int]] = []
    alive: list[Tensor] = []
    for _ in range(2):
        found: dict[int, int] = {}

        def pack(t: Tensor, found: dict[int, int] = found) -> Tensor:
            storage = t.untyped_storage()
            found[storage.data_ptr()] = storage.nbytes()
            alive.append(t.detach())
            return t.detach()

        with torch.autograd.graph.saved_tensors_hooks(pack, lambda t: t):
            once()
        storages.append(found)
    first, second = storages
    return sum(size for address, size in second.items() if address not in first)
