"""What bounds each kernel on a GPU: NVIDIA's ncu over a step and its reverse, of scenes of each kind.

Each scene is a process of its own, which warms up and then makes one step and its gradients, twice: once for the time
and launches of each kernel, by torch's profiler, and once under ncu, which tells how a kernel fills the device and what
share of the device's rates it reaches. Of scenes with contact, which make hundreds of launches, ncu looks at the first
of a kernel and at every tenth. A kernel that takes more than a small share of the time has a row. ncu fixes the clock
at its base, below what the times are taken at, and leaves the caches as they are.

A kernel with at least 3 % of the time has a row. Rates are means of the launches that ncu looked at. *Warps active* is
of those that a multiprocessor has room for, *issue active* of the cycles in which a scheduler could issue an
instruction, *threads of 32* those that an instruction is for, and *memory*, *L2* and *float64* are of the device's
rates. A kernel is bound by a rate of which it reaches 60 %, or else by what its warps wait for most. Kernels of the
regime `"color"` count the time in which they wait for the one before.
"""

from __future__ import annotations

import csv
import json
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch
from torch.profiler import ProfilerActivity, profile

import diffvbd as dv
from bench import common, gpu
from bench.measure import Card, Work, forward_reverse, model_of, scene_of
from bench.tables import Table, times

DEVICE = "cuda"
LEAST = 0.03  # share of the time of all kernels from which one has a row
MOST = 0.6  # of a rate of the device, from which it is what bounds a kernel
LONGEST = 120  # [s] of a scene
BLOCKS, REGISTERS, CYCLES = "launch__grid_size", "launch__registers_per_thread", "sm__cycles_elapsed.max"
RATES = {
    "memory": "dram__throughput.avg.pct_of_peak_sustained_elapsed",
    "L2 cache": "lts__throughput.avg.pct_of_peak_sustained_elapsed",
    "float64": "sm__inst_executed_pipe_fp64.avg.pct_of_peak_sustained_active",
}
WARPS = "sm__warps_active.avg.pct_of_peak_sustained_active"
ISSUES = "smsp__issue_active.avg.pct_of_peak_sustained_active"
THREADS = "smsp__thread_inst_executed_per_inst_executed.ratio"
# Kernels that do many things
TOLD_APART = (
    "scene_kernel",
    "each_body",
    "small_bodies",
    "medium_bodies",
    "large_bodies",
    "vertex_kernel",
    "body_kernel",
)
STALL = "smsp__average_warps_issue_stalled_{}_per_issue_active.ratio"
STALLS = {
    "long_scoreboard": "latency of memory",
    "barrier": "barriers",
    "wait": "latency of arithmetic",
    "short_scoreboard": "latency of shared memory",
    "lg_throttle": "queue of memory",
    "math_pipe_throttle": "arithmetic units",
    "branch_resolving": "branches",
    "no_instruction": "fetch of instructions",
}
Row = dict[str, Any]


def _plain(axis: int) -> Callable[[Card], Work]:
    def scene(card: Card) -> Work:
        model = model_of(dv.mesh.cube(axis, split="five"), card)
        return forward_reverse(scene_of(model).requiring("x", "v", "material"), 20, 1, "full")

    return scene


def _cubes(card: Card) -> Work:
    model = model_of(dv.mesh.cube(size=0.003, split="kuhn"), card, pinned=False)
    scene = scene_of(model, 1_000_000, "per scene", noise=1e-5).requiring("x", "v", "mu")
    return forward_reverse(scene, 5, 1, "recompute")


# Launches of a kernel, counted from 1. Those of the warm-up may count, so that the second and third are first ones too.
EACH, TENTH = (), ("--kernel-id", "::regex:.*:[1-3]|.*7")
SCENES: dict[str, tuple[Callable[[Card], Work], tuple[str, ...]]] = {
    "1,024 grippers": (lambda card: gpu.grippers(card, 1024, 1)[2], TENTH),
    "cover-the-spot, disks that lie on each other": (gpu.landed_step, TENTH),
    "195,112 vertices, K = 20": (_plain(58), EACH),
    "125 vertices, K = 20": (_plain(5), EACH),
    "1,000,000 cubes, K = 5, recompute": (_cubes, EACH),
    "29,791 vertices, K = 20": (_plain(31), EACH),
}


def run(quick: bool, device: str = DEVICE, only: str = "", out: Path | None = None) -> dict[str, Any]:
    """Each scene is written as it ends, beside what earlier runs on the same device have left of the others; ``only``:
    scenes, split by semicolons, since their names have commas."""
    if shutil.which("ncu") is None:
        raise SystemExit("ncu: expected NVIDIA Nsight Compute on the path, and it is not there")
    names = common.chosen(only, SCENES)[: 1 if quick and not only else None]
    groups = {name: lambda name=name: measured(name, device) for name in SCENES}
    return common.by_group("kernels", groups, quick=quick, device=device, home=DEVICE, only=";".join(names), out=out)


def measured(name: str, device: str) -> list[Row]:
    """The rows of a scene; one that says why, where it failed, so that the others still come."""
    try:
        return _rows(name, _times(name, device), list(_launches(name, device)))
    except (subprocess.TimeoutExpired, RuntimeError) as error:
        return [{"scene": name, "failed": str(error).strip()[-300:]}]


def _process(command: list[str], name: str) -> str:
    """What a process writes; with it end all that it has begun."""
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
                          start_new_session=True) as process:  # fmt: skip
        try:
            out, err = process.communicate(timeout=LONGEST)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            raise
    if process.returncode:
        raise RuntimeError(f"{name}: expected status 0, got {process.returncode}:\n{(out + err)[-2000:]}")
    return out


def _times(name: str, device: str) -> dict[str, tuple[int, float]]:
    """Launches and seconds of each kernel of a scene."""
    out = _process([sys.executable, "-m", "bench.kernels", device, name, "times"], name)
    return {kernel: tuple(found) for kernel, found in json.loads(out.splitlines()[-1]).items()}


def _launches(name: str, device: str) -> Iterator[dict[str, str]]:
    """What ncu says of launches of a scene."""
    metrics = ",".join((BLOCKS, REGISTERS, CYCLES, *RATES.values(), WARPS, ISSUES, THREADS,
                        *(STALL.format(s) for s in STALLS)))  # fmt: skip
    command = ["ncu", "--profile-from-start", "off", "--cache-control", "none", *SCENES[name][1], "--metrics", metrics,
               "--csv", "--page", "raw", sys.executable, "-m", "bench.kernels", device, name]  # fmt: skip
    lines = [line for line in _process(command, name).splitlines() if line.startswith('"')]
    if len(lines) < 3:
        raise RuntimeError(f"{name}: expected launches, got none")
    header, _, *rows = csv.reader(lines)
    for row in rows:
        yield dict(zip(header, row, strict=True))


def _rows(scene: str, times: dict[str, tuple[int, float]], launches: list[dict[str, str]]) -> list[Row]:
    of: dict[str, list[dict[str, str]]] = {}
    for launch in launches:
        of.setdefault(_named(launch["Kernel Name"]), []).append(launch)
    total, rows = sum(seconds for _, seconds in times.values()), []
    for kernel, (count, seconds) in times.items():
        if seconds < LEAST * total:
            continue
        row: Row = {"scene": scene, "kernel": kernel, "launches": count, "share": seconds / total,
                    "seconds": seconds / count, "looked at": len(of.get(kernel, ())), "bound": None}  # fmt: skip
        rows.append(row)
        if kernel not in of:
            continue

        def each(name: str, own: list[dict[str, str]] = of[kernel]) -> list[float]:
            return [float(launch[name].replace(",", "")) for launch in own]

        def mean(name: str, each: Callable[[str], list[float]] = each) -> float:  # by time
            weights = each(CYCLES)
            return sum(w * value for w, value in zip(weights, each(name), strict=True)) / sum(weights)

        row |= {"blocks": max(each(BLOCKS)), "registers": max(each(REGISTERS)), "warps": mean(WARPS) / 100,
                "issues": mean(ISSUES) / 100, "threads": mean(THREADS)}  # fmt: skip
        row |= {f"rate of {name}": mean(metric) / 100 for name, metric in RATES.items()}
        row |= {f"stalled by {stall}": mean(STALL.format(stall)) for stall in STALLS}
        row["bound"] = _bound(row)
    return sorted(rows, key=lambda row: -row["share"])


def _named(text: str) -> str:
    """A kernel's name; with what it does or is given where that is all that tells two apart."""
    plain = re.sub(r"\((?:int|bool|long|unsigned int|anonymous namespace)\)|<?unnamed>", "", text)
    plain = re.sub(r"\w*::", "", plain)  # namespaces
    found = re.search(r"(\w+)(?:<(.*)>)?\((\w+)?", plain)
    if not found:
        return text
    name, given, first = found.groups()
    if name != "scene_kernel":
        first = next((word for word in re.findall(r"\w+", given or "") if word[0].isupper()), None)
    return f"{name}, {first}" if first and name in TOLD_APART else name


def _bound(row: Row) -> str:
    """The rate that it comes near; else what its warps wait for most."""
    rate = max(RATES, key=lambda name: row[f"rate of {name}"])
    if row[f"rate of {rate}"] >= MOST:
        return rate
    return STALLS[max(STALLS, key=lambda stall: row[f"stalled by {stall}"])]


TABLES = (
    Table("What bounds each kernel: {}", "*",
          {"kernel": "kernel", "of the time": "share", "launches": "launches", "us each": times("seconds", 1e6),
           "blocks": "blocks", "registers": "registers", "warps active": "warps", "issue active": "issues",
           "threads of 32": "threads", **{rate: f"rate of {rate}" for rate in RATES}, "bound by": "bound",
           "failed": "failed"}),
)  # fmt: skip


def main(arguments: list[str]) -> None:
    """The scenes themselves, inside ncu; or, with "times", inside torch's profiler, printed as JSON."""
    device, name, *times = arguments
    work = SCENES[name][0](Card(torch.device(device), False))
    work()
    torch.cuda.synchronize()
    if times:
        with profile(activities=[ProfilerActivity.CUDA]) as profiled:
            work()
            torch.cuda.synchronize()
        found: dict[str, list[float]] = {}
        for event in profiled.events() or ():
            if event.device_type.name == "CUDA" and "(" in event.name and not event.name.startswith("Mem"):
                entry = found.setdefault(_named(event.name), [0, 0.0])
                entry[0] += 1
                entry[1] += 1e-6 * event.self_device_time_total
        print(json.dumps(found))
        return
    torch.cuda.profiler.start()
    work()
    torch.cuda.synchronize()
    torch.cuda.profiler.stop()


if __name__ == "__main__":
    main(sys.argv[1:])
