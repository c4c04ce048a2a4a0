"""What bounds each kernel on a GPU: NVIDIA's ncu over a step and its reverse, of scenes of each kind.

A scene is a process of its own, which warms up and then makes one step and its gradients under ncu. Of scenes with
contact, which make hundreds of launches, every tenth launch of a kernel is looked at. Of each kernel that takes more
than a small share of the time that was looked at there is a row: its time, how it fills the device, and which share of
the device's rates it reaches. ncu fixes the clock at its base, below what other benchmarks run at.
"""

from __future__ import annotations

import csv
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any

import torch

import diffvbd as dv
from bench import gpu_contact
from bench.common import markdown_table
from bench.gpu_measure import Card, Work, forward_reverse, model_of, scene_of

DEVICE = "cuda"
LEAST = 0.03  # share of the time of a step's kernels from which a kernel has a row
MOST = 0.6  # of a rate of the device, from which it is what bounds a kernel
LONGEST = 120  # [s] of a scene
SECONDS, BLOCKS, REGISTERS = "gpu__time_duration.sum", "launch__grid_size", "launch__registers_per_thread"
RATES = {
    "memory": "dram__throughput.avg.pct_of_peak_sustained_elapsed",
    "L2 cache": "lts__throughput.avg.pct_of_peak_sustained_elapsed",
    "float64": "sm__inst_executed_pipe_fp64.avg.pct_of_peak_sustained_active",
}
WARPS = "sm__warps_active.avg.pct_of_peak_sustained_active"
ISSUES = "smsp__issue_active.avg.pct_of_peak_sustained_active"
THREADS = "smsp__thread_inst_executed_per_inst_executed.ratio"
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
UNITS = {"nsecond": 1e-9, "usecond": 1e-6, "msecond": 1e-3, "second": 1.0, "ns": 1e-9, "us": 1e-6, "ms": 1e-3, "s": 1.0}
Row = dict[str, Any]


def _plain(axis: int) -> Callable[[Card], Work]:
    def scene(card: Card) -> Work:
        model = model_of(dv.mesh.cube(axis, split="five"), card)
        return forward_reverse(scene_of(model).requiring("x", "v", "material"), 20, 1, "full")

    return scene


def _cubes(card: Card) -> Work:
    model = model_of(dv.mesh.cube(size=0.003), card, pinned=False)
    scene = scene_of(model, 1_000_000, "per scene", noise=1e-5).requiring("x", "v", "mu")
    return forward_reverse(scene, 5, 1, "recompute")


EACH, TENTH = (), ("--kernel-id", "::regex:.*:.*7")  # launches of a kernel
SCENES: dict[str, tuple[Callable[[Card], Work], tuple[str, ...]]] = {
    "1,024 grippers": (lambda card: gpu_contact.grippers(card, 1024, 1)[2], TENTH),
    "cover-the-spot, disks that lie on each other": (gpu_contact.landed_step, TENTH),
    "195,112 vertices, K = 20": (_plain(58), EACH),
    "125 vertices, K = 20": (_plain(5), EACH),
    "1,000,000 cubes, K = 5, recompute": (_cubes, EACH),
    "29,791 vertices, K = 20": (_plain(31), EACH),
}


def run(quick: bool, device: str = DEVICE, only: str = "") -> dict[str, Any]:
    """``only``: scenes, split by semicolons, since their names have commas."""
    if shutil.which("ncu") is None:
        raise SystemExit("ncu: expected NVIDIA Nsight Compute on the path, and it is not there")
    names = [name for name in only.split(";") if name] or list(SCENES)[: 1 if quick else None]
    rows: list[Row] = []
    for name in names:
        began = time.perf_counter()
        try:
            rows += _rows(name, list(_launches(name, device)))
        except (subprocess.TimeoutExpired, RuntimeError) as error:  # the others still come
            print(f"{name}: {error}", file=sys.stderr, flush=True)
        print(f"{name}: {time.perf_counter() - began:.0f} s", file=sys.stderr, flush=True)
    return {"rows": rows}


def _launches(name: str, device: str) -> Iterator[dict[str, str]]:
    """What ncu says of each launch of a scene, with units as a prefix where it gives any."""
    metrics = ",".join((SECONDS, BLOCKS, REGISTERS, *RATES.values(), WARPS, ISSUES, THREADS,
                        *(STALL.format(s) for s in STALLS)))  # fmt: skip
    command = ["ncu", "--profile-from-start", "off", *SCENES[name][1], "--metrics", metrics, "--csv", "--page", "raw"]
    command += [sys.executable, "-m", "bench.kernels", device, name]
    done = subprocess.run(command, capture_output=True, text=True, timeout=LONGEST, check=False)
    lines = [line for line in done.stdout.splitlines() if line.startswith('"')]
    if done.returncode or len(lines) < 3:
        text = (done.stdout + done.stderr)[-2000:]
        raise RuntimeError(f"{name}: expected launches, got status {done.returncode}:\n{text}")
    header, units, *rows = csv.reader(lines)
    for row in rows:
        yield {key: f"{unit} {value}" if key == SECONDS else value
               for key, unit, value in zip(header, units, row, strict=True)}  # fmt: skip


def _rows(scene: str, launches: list[dict[str, str]]) -> list[Row]:
    def number(launch: dict[str, str], name: str) -> float:
        return float(launch[name].replace(",", ""))

    def seconds(launch: dict[str, str]) -> float:
        unit, value = launch[SECONDS].split()
        return UNITS[unit] * float(value.replace(",", ""))

    total, of = sum(map(seconds, launches)), {}
    for launch in launches:
        of.setdefault(_named(launch["Kernel Name"]), []).append(launch)
    rows = []
    for kernel, own in of.items():
        span = sum(map(seconds, own))
        if span < LEAST * total:
            continue

        def mean(name: str, own: list[dict[str, str]] = own, span: float = span) -> float:
            return sum(seconds(launch) * number(launch, name) for launch in own) / span

        row: Row = {"scene": scene, "kernel": kernel, "launches": len(own), "share": span / total,
                    "seconds": span / len(own), "blocks": max(number(a, BLOCKS) for a in own),
                    "registers": max(number(a, REGISTERS) for a in own), "warps": mean(WARPS) / 100,
                    "issues": mean(ISSUES) / 100, "threads": mean(THREADS)}  # fmt: skip
        row |= {f"rate of {name}": mean(metric) / 100 for name, metric in RATES.items()}
        row |= {f"stalled by {stall}": mean(STALL.format(stall)) for stall in STALLS}
        rows.append(row | {"bound": _bound(row)})
    return sorted(rows, key=lambda row: -row["share"])


def _named(text: str) -> str:
    """A kernel's name; with what it is given where that is all that tells two apart."""
    plain = re.sub(r"\((?:int|bool|long|unsigned int)\)", "", text)  # of template arguments
    found = re.search(r"(\w+)(<[^(]*>)?\((?:[\w:]*::)?(\w+)?", plain)
    if not found:
        return text
    name, _, first = found.groups()
    return f"{name}, {first}" if name in ("scene_kernel", "each_body") and first else name


def _bound(row: Row) -> str:
    """The rate that it comes near; else what its warps wait for most."""
    rate = max(RATES, key=lambda name: row[f"rate of {name}"])
    if row[f"rate of {rate}"] >= MOST:
        return rate
    return STALLS[max(STALLS, key=lambda stall: row[f"stalled by {stall}"])]


def markdown(results: dict[str, Any]) -> str:
    header = ("scene", "kernel", "of the time", "launches", "us each", "blocks", "registers", "warps active",
              "issue active", "threads of 32", "memory", "L2", "float64", "bound by")  # fmt: skip
    percent = "{:.0%}".format
    rows = [(r["scene"], f"`{r['kernel']}`", percent(r["share"]), r["launches"], f"{1e6 * r['seconds']:.3g}",
             int(r["blocks"]), int(r["registers"]), percent(r["warps"]), percent(r["issues"]), f"{r['threads']:.0f}",
             *(percent(r[f"rate of {name}"]) for name in RATES), r["bound"]) for r in results["rows"]]  # fmt: skip
    return "## What bounds each kernel\n\n" + markdown_table(header, rows)


def main(arguments: list[str]) -> None:
    """The scenes themselves, inside ncu."""
    work = SCENES[arguments[1]][0](Card(torch.device(arguments[0]), False))
    work()
    torch.cuda.synchronize()
    torch.cuda.profiler.start()
    work()
    torch.cuda.synchronize()
    torch.cuda.profiler.stop()


if __name__ == "__main__":
    main(sys.argv[1:])
