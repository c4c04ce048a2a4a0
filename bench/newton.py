"""Newton's VBD solver on the scene of the GPU benchmark, where warp-lang and newton are installed."""

from __future__ import annotations

import importlib
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

import diffvbd as dv


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
