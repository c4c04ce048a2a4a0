"""Scenes and a million cubes over one and two GPUs: time, memory of each rank, and whether the bits are the same.

On CUDA with nccl, a GPU for each rank; with `--device cpu --quick` two processes with gloo try the script out. All
steps of scenes are called eagerly, those of the cubes are a CUDA graph, as in the task. Times are the median of several
iterations of forward and reverse, from when all ranks begin until all have ended; memory is that of the first.

Of scenes: 10 steps, K = 10, gradients of a network and of mu by `distributed.backward`.
"""

from __future__ import annotations

import hashlib
import json
import os
import resource
import statistics
import tempfile
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import torch
import torch.distributed as dist
import torch.multiprocessing as mp
from torch import Tensor

import diffvbd as dv
from bench.tables import Table
from diffvbd import distributed
from diffvbd.tasks import Settings, million_cubes
from diffvbd.tasks.runner import captured

DEVICE = "cuda"
RANKS = (1, 2)
SCENES, QUICK_SCENES = 2_048, 8
PARTS, QUICK_PARTS = 8, 4
STEPS, SWEEPS = 10, 10
MODULUS, STEP = 1e5, 5e-3  # [Pa], [s]
Row = dict[str, Any]


def run(quick: bool, *, device: str = DEVICE) -> dict[str, Any]:
    cuda = torch.device(device).type == "cuda"
    if cuda and not torch.cuda.is_available():
        raise SystemExit(f"device: no CUDA device here; `--device {device}` needs one, `--device cpu --quick` does not")
    if not cuda and not quick:
        raise SystemExit("device: the CPU only tries the script out; give --quick")
    here = torch.cuda.device_count() if cuda else max(RANKS)
    found: dict[str, list[Row]] = {"scenes": [], "cubes": []}
    for ranks in (n for n in RANKS if n <= here):
        with tempfile.TemporaryDirectory() as folder:
            mp.spawn(_rank, args=(ranks, Path(folder), cuda, quick), nprocs=ranks)  # pyright: ignore
            each = [json.loads((Path(folder) / f"{rank}.json").read_text()) for rank in range(ranks)]
        for group, rows in found.items():
            rows += [_together(list(same)) for same in zip(*(one[group] for one in each), strict=True)]
    for rows in found.values():
        for row in rows:
            first = next(r for r in rows if r["parts"] == row["parts"])
            row["same_bits"] = None if first is row else row["digest"] == first["digest"]
    return found


def _rank(rank: int, ranks: int, folder: Path, cuda: bool, quick: bool) -> None:
    if cuda:
        torch.cuda.set_device(rank)
    else:
        torch.set_num_threads(max(1, (os.cpu_count() or 1) // ranks))
    backend = "nccl" if cuda else "gloo"
    dist.init_process_group(backend, init_method=f"file://{folder / 'meeting'}", rank=rank, world_size=ranks)
    found = {"scenes": _scenes(ranks, cuda, quick), "cubes": _cubes(ranks, cuda, quick)}
    (folder / f"{rank}.json").write_text(json.dumps(found))
    dist.destroy_process_group()


def _together(rows: list[Row]) -> Row:
    """One row of those of all ranks."""
    assert len({row["digest"] for row in rows}) == 1, "ranks differ"
    repeats = all(row["repeats"] for row in rows)
    return rows[0] | {"peak_bytes": [row["peak_bytes"] for row in rows], "repeats": repeats}


def _measured(gradient: Callable[[], Tensor], leaves: Iterable[Tensor], cuda: bool, quick: bool, graph: bool) -> Row:
    """Seconds, peak and a hash of a loss and its gradient, which all ranks work out, after a first time that does not
    count; with ``graph``, on a GPU, the seconds of a graph, and whether it has the bits of the first time."""
    leaves = list(leaves)

    def digest(loss: Tensor) -> str:
        ends = [loss, *(leaf.grad for leaf in leaves if leaf.grad is not None)]
        assert len(ends) == 1 + len(leaves)
        return hashlib.sha256(b"".join(t.detach().cpu().numpy().tobytes() for t in ends)).hexdigest()[:16]

    def once() -> float:
        dist.barrier()
        if cuda:
            torch.cuda.synchronize()
        start = time.perf_counter()
        work()
        if cuda:
            torch.cuda.synchronize()
        dist.barrier()
        return time.perf_counter() - start

    if cuda:
        torch.cuda.reset_peak_memory_stats()
    first = digest(gradient())
    # of a process on the CPU all that it ever had, libraries included
    peak = torch.cuda.max_memory_allocated() if cuda else 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    work = captured(gradient) if cuda and graph else gradient
    same = digest(work()) == first
    seconds = statistics.median(once() for _ in range(2 if quick else 5))
    return {"seconds": seconds, "peak_bytes": peak, "digest": first, "repeats": same}


def _scenes(ranks: int, cuda: bool, quick: bool) -> list[Row]:
    """Gradients of a small network and of mu through scenes that fly and vibrate, in parts; and in one part for each
    rank, which is what fixed parts cost."""
    scenes, parts = (QUICK_SCENES, QUICK_PARTS) if quick else (SCENES, PARTS)
    device = "cuda" if cuda else "cpu"
    model = dv.Model(dv.mesh.cube(3 if quick else 11, split="five"), device=device)
    torch.manual_seed(0)
    network = torch.nn.Linear(3, 3).to(device, model.dtype)
    log_mu = torch.full((), MODULUS, dtype=model.dtype, device=device).log().requires_grad_()
    goals = torch.rand(scenes, 3, dtype=model.dtype).to(device)
    leaves = [*network.parameters(), log_mu]
    stretched = model.rest_points * model.rest_points.new_tensor([1.0, 0.95, 1.0])

    def loss(part: slice) -> Tensor:
        v = network(goals[part])[:, None].expand(-1, model.num_vertices, -1)
        end = dv.rollout(model, stretched.expand_as(v), v, dv.VBD(STEP, SWEEPS), steps=STEPS, mu=log_mu.exp(),
                         lam=MODULUS, save="last")  # fmt: skip
        return (end.x[-1] - goals[part, None]).square().sum() / scenes

    def gradient(parts: int) -> Tensor:
        for leaf in leaves:
            leaf.grad = None
        return distributed.backward(loss, leaves, scenes, parts)

    rows = []
    for count in (parts, ranks):
        row = _measured(lambda count=count: gradient(count), leaves, cuda, quick, False)
        rows.append({"ranks": ranks, "scenes": scenes, "parts": count, "vertices": model.num_vertices,
                     "scenes_per_s": scenes / row["seconds"], **row})  # fmt: skip
    return rows


def _cubes(ranks: int, cuda: bool, quick: bool) -> list[Row]:
    """Loss and gradient of the task million-cubes, with pushes, from velocities that take each body to its place.

    Without pushes each body would fly straight to its place and arrive in time, which is close to what the task ends
    with. Of a million, the most overlap three quarters of the way: 0.9 pairs a body. Bodies of a rank stay beside each
    other: of those of other ranks, two ranks need one for every 200 of their own.
    """
    settings = Settings(Path("unused"), "cuda" if cuda else "cpu", quick=quick)
    version = million_cubes.chosen(quick, None, None if quick else million_cubes.TARGET_STEP, None)
    cubes = million_cubes.Cubes(settings, version)
    cubes.begin(0, touching=True)
    duration = version.target_step * million_cubes.TIME_STEP
    with torch.no_grad():
        way = cubes.target - torch.as_tensor(million_cubes.launch_pad(version.bodies)).to(cubes.target)
        cubes.velocity.copy_(way / duration + way.new_tensor([0.0, 9.81 * duration / 2, 0.0]))

    def gradient() -> Tensor:
        cubes.velocity.grad = cubes.material.grad = None
        total = cubes.loss()
        total.backward()
        return total.detach()

    row = _measured(gradient, (cubes.velocity, cubes.material), cuda, quick, True)
    return [{"ranks": ranks, "bodies": version.bodies, "parts": None, "steps": version.steps, **row}]


PEAKS = {"peak of each rank [GB]": lambda row: ", ".join(f"{peak / 1e9:.2f}" for peak in row["peak_bytes"]),
         "bits of one rank": "same_bits", "of the first call": "repeats"}  # fmt: skip
TABLES = (
    Table("Scenes", "scenes", {"ranks": "ranks", "parts": "parts", "scenes": "scenes", "vertices of each": "vertices",
                               "scenes/s, forward and reverse": "scenes_per_s", **PEAKS}),
    Table("The task million-cubes, with pushes", "cubes",
          {"ranks": "ranks", "bodies": "bodies", "steps": "steps", "forward and reverse [s]": "seconds", **PEAKS}),
)  # fmt: skip
