"""Speed and memory of the CPU backend: throughput, scaling, Model building, what a scene pays.

Times are the least of several repetitions, wall clock, of the public interface, predictor and checks included.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

import diffvbd as dv
from bench.measure import Card, kept_bytes, least
from bench.tables import Table, times

MATERIAL = ("state", "material")  # of which gradients are wanted


def clamped_cube(n: int, dtype: torch.dtype = torch.float64, energies: tuple = ()) -> tuple[dv.Model, Tensor]:
    """The peers' scene (docs/performance.md): unit cube, five tets a cell, one face pinned; slightly off rest."""
    mesh = dv.mesh.cube(n, split="five")
    model = dv.Model(mesh, pinned=torch.from_numpy(mesh.points[:, 1] < 1e-9), dtype=dtype,
                     energies=(dv.StableNeoHookean(), *energies))  # fmt: skip
    noise = torch.randn(model.rest_points.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return model, model.rest_points + (1e-3 * noise).to(dtype)


def time_step(
    model: dv.Model, x: Tensor, sweeps: int, wants: tuple[str, ...], tape: str = "full", **options: Any
) -> tuple[float, float]:
    """Seconds of the forward and of the backward of one step."""
    leaf = {
        "state": {"x": x.clone(), "v": torch.zeros_like(x)},
        "material": {k: torch.full((model.num_tets,), 1e5, dtype=x.dtype) for k in ("mu", "lam")},
        "rest": {"rest_points": model.rest_points.clone()},
    }
    given: dict[str, Any] = {"x": x, "v": torch.zeros_like(x), "mu": 1e5, "lam": 1e5}
    for group in wants:
        given.update({k: t.requires_grad_() for k, t in leaf[group].items()})
    start = time.perf_counter()
    x_end, v_end = dv.step(model, given.pop("x"), given.pop("v"), dv.VBD(5e-3, sweeps, tape=tape, **options),
                           **given)  # type: ignore[arg-type]  # fmt: skip
    middle = time.perf_counter()
    if wants:
        (x_end.sum() + v_end.sum()).backward()
    return middle - start, time.perf_counter() - middle


def throughput(n: int, sweeps: int, quick: bool) -> list[dict[str, Any]]:
    torch.set_num_threads(1)
    rows = []
    targets = {("forward", torch.float64): 8.0, ("forward", torch.float32): 12.0,
               ("reverse, full tape", torch.float64): 3.5}  # fmt: skip
    parts = {
        "forward": ((), "full", 0),
        "forward with full tape": (MATERIAL, "full", 0),
        "reverse, full tape": (MATERIAL, "full", 1),
        "reverse, compact tape": (MATERIAL, "compact", 1),
    }
    for dtype in (torch.float64, torch.float32):
        model, x = clamped_cube(n, dtype)
        for part, (wants, tape, at) in parts.items():
            seconds = least_part(model, x, sweeps, wants, tape, at, 3 if quick else 15)
            name = f"{model.num_vertices} v / {model.num_tets} t, K = {sweeps}, 1 core, {part}, {str(dtype)[6:]}"
            rows.append(speed(name, model.num_active * sweeps, seconds, targets.get((part, dtype))))
    return rows


def least_part(model: dv.Model, x: Tensor, sweeps: int, wants: tuple[str, ...], tape: str, at: int, repetitions: int
               ) -> float:  # fmt: skip
    """Least seconds of the forward (at 0) or the backward (1) of a step."""
    return least(lambda: time_step(model, x, sweeps, wants, tape)[at], repetitions)


def speed(name: str, updates: int, seconds: float, target: float | None) -> dict[str, Any]:
    return {"name": name, "unit": "M vertex updates/s", "value": updates / 1e6 / seconds, "target": target,
            "ms_per_step": seconds * 1e3}  # fmt: skip


def scaling(n: int, threads: int, quick: bool) -> list[dict[str, Any]]:
    model, x = clamped_cube(n)
    sweeps, repetitions = 10, 2 if quick else 7
    seconds: dict[int, tuple[float, float]] = {}
    for count in (1, threads):
        torch.set_num_threads(count)
        seconds[count] = (least_part(model, x, sweeps, (), "full", 0, repetitions),
                          least_part(model, x, sweeps, MATERIAL, "full", 1, repetitions))  # fmt: skip
    rows = []
    for i, part in enumerate(("forward", "reverse, full tape")):
        one, all_ = seconds[1][i], seconds[threads][i]
        name = f"{model.num_vertices} v, K = {sweeps}, float64, {part}"
        rows.append(speed(f"{name}, one core", model.num_active * sweeps, one, None))
        rows.append({"name": f"{name}, {threads} cores against one", "unit": "times faster", "target": 1.7,
                     "value": one / all_, "ms_per_step": all_ * 1e3})  # fmt: skip
    return rows


def building(quick: bool) -> list[dict[str, Any]]:
    rows = []
    for n in (10, 20) if quick else (15, 30, 59):
        mesh = dv.mesh.beam(n, n, n, size=(1.0, 1.0, 1.0), split="kuhn")
        rows.append(_built(f"grid, {mesh.num_vertices} v / {mesh.num_tets} t", mesh, 2.0 if n == 59 else None))
    cube = dv.mesh.cube(size=0.003, split="kuhn")
    for count in (1_000,) if quick else (10_000, 100_000, 1_000_000):
        i = np.arange(count)
        offsets = np.stack([i % 100, i // 100 % 100, i // 10_000], -1) * 0.01
        mesh = dv.mesh.replicate(cube, offsets)
        target = 40.0 if count == 1_000_000 else None
        rows.append(_built(f"{count} cubes joined, {mesh.num_vertices} v", mesh, target))
        del mesh
    return rows


def _built(name: str, mesh: dv.TetMesh, target: float | None) -> dict[str, Any]:
    start = time.perf_counter()
    model = dv.Model(mesh)
    seconds = time.perf_counter() - start
    return {"name": f"Model of {name}", "unit": "s", "value": seconds, "target": target, "colors": model.num_colors}


def requirements(n: int, quick: bool) -> list[dict[str, Any]]:
    """What a scene pays for what it requires: bytes kept for the backward, and time, of one step."""
    torch.set_num_threads(1)
    sweeps, repetitions = 10, 2 if quick else 9
    floor = dv.FloorBarrier(height=-0.01)
    rows = []
    for label, energies, options in (
        ("elastic", (), {}),
        ("elastic + floor", (floor,), {}),
        ("elastic + floor + anchors", (floor, dv.Anchor(10.0)), {}),
        ("elastic, saturated and relaxed", (), {"saturation": 0.1, "relaxation": 1.5}),
    ):
        model, x = clamped_cube(n, energies=energies)
        for wants in ((), ("state",), MATERIAL, (*MATERIAL, "rest")):

            def once(m: Any = model, a: Any = x, w: Any = wants, o: Any = options) -> tuple[float, float]:
                return time_step(m, a, sweeps, w, **o)

            forward = least(lambda once=once: once()[0], repetitions)
            backward = least(lambda once=once: once()[1], repetitions) if wants else None
            rows.append({"name": f"{label}, gradients: {' + '.join(wants) or 'none'}", "forward_ms": forward * 1e3,
                         "backward_ms": None if backward is None else backward * 1e3,
                         "kept_bytes": kept_bytes(once)})  # fmt: skip
    return rows


def _threads() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


THREADS = 1
GROUPS: dict[str, Callable[[Card], list[dict[str, Any]]]] = {
    "throughput": lambda card: throughput(5 if card.quick else 11, 20, card.quick),
    "scaling": lambda card: scaling(9 if card.quick else 31, _threads(), card.quick),
    "building": lambda card: building(card.quick),
    "requirements": lambda card: requirements(5 if card.quick else 11, card.quick),
}
COLUMNS = {"what": "name", "measured": "value", "target": "target", "unit": "unit"}
TABLES = (
    *(Table(name.capitalize(), name, COLUMNS) for name in ("throughput", "scaling", "building")),
    Table("One step, K = 10", "requirements", {"gradients": "name", "forward [ms]": "forward_ms",
                                               "backward [ms]": "backward_ms", "kept [MB]": times("kept_bytes", 1e-6)}),
)  # fmt: skip
