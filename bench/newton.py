"""Newton's VBD solver on the scene of the GPU benchmark, where warp-lang and newton are installed."""

from __future__ import annotations

import importlib
import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

import diffvbd as dv

SIZES = (5, 11, 31, 58)
# [ms per step] of an earlier version on an H100, to see at once whether a run is sound
EARLIER = {5: 0.83, 11: 0.81, 31: 2.21, 58: 14.0}


def rows(device: str, quick: bool, sizes: tuple[int, ...] = SIZES) -> list[dict[str, Any]]:
    """Milliseconds per step for cubes of n vertices per axis: float32, K = 20, 10 steps in one CUDA graph."""
    try:
        warp, newton = importlib.import_module("warp"), importlib.import_module("newton")
        warp.init()
        warp.get_device(device)
    except Exception as error:
        reason = f"{type(error).__name__}: {error}".splitlines()[0]
        return [{"name": "Newton SolverVBD", "error": f"not available ({reason})"}]
    out = []
    for n in sizes[:1] if quick else sizes:
        name = f"Newton SolverVBD, cube of {n} vertices per axis"
        try:
            out.append(_measure(warp, newton, device, n, quick))
        except Exception as error:
            out.append({"name": name, "error": f"{type(error).__name__}: {error}".splitlines()[0][:300]})
    return out


def _measure(warp: Any, newton: Any, device: str, n: int, quick: bool, sweeps: int = 20) -> dict[str, Any]:
    start = time.perf_counter()
    mesh = dv.mesh.cube(n, split="five")
    model = build(newton, mesh, device)
    solver = newton.solvers.SolverVBD(model, iterations=sweeps)
    states, control = [model.state(), model.state()], model.control()
    steps = 2 if quick else 10  # even, so that the graph ends in the state that it starts from

    def work() -> None:
        for _ in range(steps):
            solver.step(states[0], states[1], control, None, 5e-3)
            states.reverse()

    work()  # compiles the kernels
    warp.synchronize_device(device)
    built = time.perf_counter() - start
    y = states[0].particle_q.numpy()[:, 1]
    if not np.isfinite(y).all():
        raise RuntimeError("positions are not finite")
    eager = statistics.median(_spans(warp, device, work, 2 if quick else 3))
    graph = None
    if warp.get_device(device).is_cuda:
        with warp.ScopedCapture(device, force_module_load=False) as capture:
            work()
        graph = statistics.median(_spans(warp, device, lambda: warp.capture_launch(capture.graph), 20))
    return {
        "name": f"Newton SolverVBD {newton.__version__} (warp {warp.__version__}), {mesh.num_vertices} v / "
        f"{mesh.num_tets} t, K = {sweeps}, float32",
        "part": "forward",
        "vertices": mesh.num_vertices,
        "ms": None if graph is None else 1e3 * graph / steps,
        "eager_ms": 1e3 * eager / steps,
        "earlier_ms": EARLIER.get(n),
        "colors": len(model.particle_color_groups),
        "sank_mm": 1e3 * float((mesh.points[:, 1] - y).max()),  # > 0: the scene did run
        "setup_s": built,
    }


def ladder(
    mesh: dv.TetMesh,
    pinned: NDArray[np.bool_],
    material: tuple[float, float],
    duration: float,
    sweeps: tuple[int, ...],
    rungs: int,
    frames: int,
    distance: Callable[[NDArray[np.float64]], float],
    v: NDArray[np.float64],
    device: str = "cpu",
) -> list[dict[str, Any]]:
    """Time and error of a motion under gravity with ever more steps; `distance` is of its frames [F, V, 3], v the
    velocity at first [V, 3].

    Raises ImportError where Newton is not installed.
    """
    warp, newton = importlib.import_module("warp"), importlib.import_module("newton")
    model = build(newton, mesh, device, pinned, material)
    rows = []
    for count in sweeps:
        solver = newton.solvers.SolverVBD(model, iterations=count)
        for rung in range(-1, rungs):  # the first compiles
            steps, states, seen = frames * 2 ** max(rung, 0), [model.state(), model.state()], []
            states[0].particle_qd.assign(v.astype(np.float32))
            warp.synchronize_device(device)
            start = time.perf_counter()
            for n in range(1, steps + 1):
                solver.step(states[0], states[1], model.control(), None, duration / steps)
                states.reverse()
                if n % (steps // frames) == 0:
                    seen.append(states[0].particle_q.numpy().copy())  # on the CPU it is a view
            seconds = time.perf_counter() - start
            if rung >= 0:
                rows.append({"solver": f"Newton {newton.__version__} SolverVBD", "iterations": count, "steps": steps,
                             "ms": 1e3 * seconds, "error": distance(np.stack(seen).astype(float)),
                             "note": "implicit Euler in float32"})  # fmt: skip
    return rows


def build(
    newton: Any,
    mesh: dv.TetMesh,
    device: str,
    pinned: NDArray[np.bool_] | None = None,
    material: tuple[float, float] = (1e5, 1e5),
) -> Any:
    """Newton's model of a mesh with mu and lam [Pa], held where it is pinned; None: by the face at y = 0.

    Fills the builder's lists, because its own loop over tets takes a minute for the largest mesh. Surface triangles are
    left out: without stiffness or contact they would only cost memory.
    """
    points, tets = mesh.points, mesh.tets
    shape = (points[tets[:, 1:]] - points[tets[:, :1]]).swapaxes(1, 2)  # columns are edges
    weight = 1000.0 * np.linalg.det(shape) / 24
    mass = np.bincount(tets.ravel(), np.repeat(weight, 4), len(points))
    pinned = points[:, 1] < 1e-9 if pinned is None else pinned
    mass[pinned] = 0.0
    flags = np.where(pinned, 0, int(newton.ParticleFlags.ACTIVE))
    builder = newton.ModelBuilder(gravity=(0.0, -9.81, 0.0))
    builder.add_particles(pos=list(points), vel=[(0.0, 0.0, 0.0)] * len(points), mass=mass.tolist(),
                          flags=flags.tolist())  # fmt: skip
    builder.tet_indices.extend(map(tuple, tets.tolist()))
    builder.tet_poses.extend(np.linalg.inv(shape).tolist())
    builder.tet_activations.extend([0.0] * len(tets))
    builder.tet_materials.extend([(*material, 0.0)] * len(tets))
    builder.color()
    return builder.finalize(device=device)


def _spans(warp: Any, device: str, work: Any, count: int) -> list[float]:
    """Seconds of each of several calls, by events on CUDA."""
    cuda = warp.get_device(device).is_cuda
    out = []
    for _ in range(count):
        warp.synchronize_device(device)
        if cuda:
            with warp.ScopedDevice(device):
                first, last = warp.Event(enable_timing=True), warp.Event(enable_timing=True)
                warp.record_event(first)
                work()
                warp.record_event(last)
                out.append(warp.get_event_elapsed_time(first, last) / 1e3)
        else:
            start = time.perf_counter()
            work()
            out.append(time.perf_counter() - start)
    return out
