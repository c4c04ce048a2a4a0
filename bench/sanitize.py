"""NVIDIA's compute-sanitizer over every regime, with and without contact: steps and their gradients.

Each tool runs each small scene in a process of its own: memcheck (addresses), racecheck (shared memory), initcheck
(memory that nobody has written) and synccheck (barriers). Where initcheck finds something, the scene is run up to twice
more, and the least count is taken: kernels do the same work in each run, but initcheck has reported, in some runs of
one scene with pairs, the read of a number that another multiprocessor had just written. With that memory full of NaN
all results keep their bits (tests/step/test_uninitialized_memory.py).
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import torch
from torch import Tensor

import diffvbd as dv
from bench import common
from bench.tables import Table
from diffvbd import mesh
from diffvbd.testing import regime

DEVICE = "cuda"
SANITIZER = "compute-sanitizer"
TOOLS = ("memcheck", "racecheck", "initcheck", "synccheck")
SUMMARY = re.compile(r"(?:ERROR SUMMARY: (\d+) error|RACECHECK SUMMARY: (\d+) hazard)")
STEPS, SWEEPS = 2, 3
# steps and sweeps of a tool that takes minutes for more, and of a scene for which it takes minutes even so
LESS = {"racecheck": (1, 2)}
LEAST = {("racecheck", "pairs, many scenes"): (1, 1)}
AGAIN = {"initcheck": 2}  # more runs, at most, of a scene in which a tool has found something
LONGEST = 330  # [s] of a tool and a scene
# torch gives tensors memory that others have written, with room at their ends; so each has its own
UNCACHED = {"PYTORCH_NO_CUDA_MEMORY_CACHING": "1"}
WORKERS = 14  # processes side by side: each keeps one core and little of the device busy
Scene = tuple[dv.Model, Tensor, dict[str, Any]]  # Model, velocities, regime and options of the solver


def _free(regime: str | None, *energies: Any, dtype: torch.dtype = torch.float64, **solver: Any) -> Scene:
    """Scenes without pairs: a beam that is held at one end, bent by its weight, and one that flies."""
    body = mesh.beam(4, 2, 2, size=(0.3, 0.1, 0.1), split="kuhn")
    both = mesh.join([body, body.translate((0.0, 0.3, 0.0))])
    held = torch.tensor((both.points[:, 0] < 1e-9) & (both.body == 0))
    model = dv.Model(both, pinned=held, energies=(dv.StableNeoHookean(), *energies), device=DEVICE, dtype=dtype)
    return model, _moving(model, 3), {"regime": regime, "solver": solver}


def _touching(scenes: int, *energies: Any, size: int = 3, colliders: tuple[Any, ...] = (),
              dtype: torch.dtype = torch.float64, **solver: Any) -> Scene:  # fmt: skip
    """Three cubes that fly into one another, on what else there is."""
    cube = mesh.box(size, 0.1, split="kuhn")
    bodies = mesh.join([cube.translate((0.104 * k, 0.103 * (k == 2) + 0.004, 0.01 * k)) for k in range(3)])
    model = dv.Model(bodies, energies=(dv.StableNeoHookean(), dv.PairBarrier(kappa=1e4, dhat=2e-3), *energies),
                     colliders=colliders, device=DEVICE, dtype=dtype)  # fmt: skip
    return model, _moving(model, scenes), {"regime": None, "solver": solver}


def _moving(model: dv.Model, scenes: int) -> Tensor:
    """Velocities of each scene [B, V, 3]: toward the middle, each body turning."""
    x = model.rest_points
    v = 3.0 * (x.mean(0) - x) / x.std()
    spin = torch.linalg.cross(x.new_tensor([1.0, 2.0, 3.0]).expand_as(x), x - x.mean(0))
    return (v + spin) * torch.linspace(0.5, 1.0, scenes, dtype=x.dtype, device=x.device)[:, None, None]


FLOOR, FRICTION = dv.FloorBarrier(height=-0.003, kappa=1e4, dhat=2e-3), dv.Friction(0.5)
PLANE = dv.colliders.Plane((0.0, -0.003, 0.0))
SCENES: dict[str, Callable[[], Scene]] = {
    "thread": partial(_free, "thread"),
    "block": partial(_free, "block"),
    "grid": partial(_free, "grid"),
    "color": partial(_free, "color"),
    "floor, float32": partial(_free, "block", FLOOR, dtype=torch.float32),
    "floor, thread": partial(_free, "thread", FLOOR),
    "floor and friction": partial(_free, "color", FLOOR, FRICTION),
    "coarse": partial(_free, None, subspace="coarse", relaxation=1.5),
    "pairs": partial(_touching, 1),
    "pairs, friction, a collider": partial(_touching, 2, FRICTION, colliders=(PLANE,)),
    "pairs, floor, float32": partial(_touching, 2, FLOOR, dtype=torch.float32),
    "pairs, coarse": partial(_touching, 1, subspace="coarse"),
    "pairs, many scenes": partial(_touching, 70),
    "pairs, a larger scene": partial(_touching, 1, size=12),
}


def step_of(scene: Scene, steps: int, sweeps: int) -> None:
    """Some steps and their gradients with respect to state and material, with each tape."""
    model, v, options = scene
    x = model.rest_points.expand_as(v).clone()
    tapes = ("full",) if model.touches else ("full", "compact", "recompute")
    for tape in tapes:
        leaves = [t.clone().requires_grad_() for t in (x, v, x.new_full((1, model.num_tets), 1e5))]
        now, speed, mu = leaves
        solver = dv.VBD(0.005, sweeps, tape=tape, **options["solver"])
        with regime(options["regime"]):
            for _ in range(steps):
                now, speed = dv.step(model, now, speed, solver, mu=mu, lam=1e5)
            gradients = torch.autograd.grad((now - x).square().sum(), leaves)
        assert all(bool(g.abs().max() > 0) for g in gradients)


def run(quick: bool, device: str = DEVICE, only: str = "") -> dict[str, Any]:
    """``only``: tools or scenes, split by semicolons, since names of scenes have commas."""
    wanted = [] if not only else common.chosen(only, (*TOOLS, *SCENES))
    if shutil.which(SANITIZER) is None:
        raise SystemExit(f"sanitize: expected NVIDIA's {SANITIZER} on the PATH, and found none")
    tools = [tool for tool in TOOLS if tool in wanted] or list(TOOLS)
    names = [name for name in SCENES if name in wanted] or list(SCENES)[: 1 if quick else None]
    work = [(tool, name) for name in reversed(names) for tool in tools]  # those that take long first
    with ThreadPoolExecutor(WORKERS) as pool:
        found = list(pool.map(lambda item: _of_processes(*item, device), work))
    rows = []
    for tool in tools:
        own = [f for (t, _), f in zip(work, found, strict=True) if t == tool]
        done = [f for f in own if f["found"] is not None]
        rows.append({"tool": tool, "scenes": len(done), "found": sum(f["found"] for f in done),
                     "first": next((f["first"] for f in done if f["found"]), ""),
                     "not found again": [f"{f['scene']}: {f['once']}" for f in done if f["once"]],
                     "not done": [f["scene"] for f in own if f["found"] is None]})  # fmt: skip
    return {"rows": rows, "scenes": names}


def _of_processes(tool: str, name: str, device: str) -> dict[str, Any]:
    """What a tool finds in a scene; and, as ``once``, what it has not found again where it may be wrong."""
    first = run = _of_process(tool, name, device)
    for _ in range(AGAIN.get(tool, 0)):
        if not run["found"]:
            break
        again = _of_process(tool, name, device)
        if again["found"] is not None and again["found"] < run["found"]:
            run = again
    return run | {"once": first["first"] if first["found"] and not run["found"] else ""}


def _of_process(tool: str, name: str, device: str) -> dict[str, Any]:
    """What a tool finds in a scene; None: it takes too long."""
    counts = [str(count) for count in LEAST.get((tool, name), LESS.get(tool, (STEPS, SWEEPS)))]
    command = [SANITIZER, "--tool", tool, "--error-exitcode", "9", sys.executable, "-m", "bench.sanitize",
               device, *counts, name]  # fmt: skip
    try:
        done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=LONGEST,
                              env=os.environ | UNCACHED, check=False)  # fmt: skip
    except subprocess.TimeoutExpired:
        print(f"{tool}, {name}: over {LONGEST} s", file=sys.stderr, flush=True)
        return {"scene": name, "found": None, "first": ""}
    summaries = SUMMARY.findall(done.stdout)
    if done.returncode not in (0, 9) or not summaries or f"done {name}\n" not in done.stdout:
        raise RuntimeError(f"{tool}, {name}: expected a summary, got status {done.returncode}:\n{done.stdout[-2000:]}")
    found = sum(int(a or b) for a, b in summaries)
    first = _first(done.stdout) if found else ""
    print(f"{tool}, {name}: {found} {first}".rstrip(), file=sys.stderr, flush=True)
    return {"scene": name, "found": found, "first": first}


def _first(text: str) -> str:
    """What a tool says of the first thing that it finds."""
    lines = [line.removeprefix("========= ") for line in text.splitlines() if line.startswith("========= ")]
    return " | ".join(line.strip() for line in lines[1:4] if "SUMMARY" not in line)


TABLES = (
    Table("compute-sanitizer", "rows",
          {"tool": "tool", "scenes": "scenes", "found": "found", "the first": "first",
           "not found again": lambda row: "; ".join(row["not found again"]),
           "not done in time": lambda row: "; ".join(row["not done"])}),
)  # fmt: skip


def main(arguments: list[str]) -> None:
    """The scenes themselves, inside a tool."""
    global DEVICE
    DEVICE, steps, sweeps = arguments[0], *map(int, arguments[1:3])
    for name in arguments[3:]:
        step_of(SCENES[name](), steps, sweeps)
        print(f"done {name}", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
