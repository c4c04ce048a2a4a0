"""Gradient error of XPBD and projective dynamics by composed block updates (paper, appendix on other block solvers).

Each solver is compared with autograd through its reference in plain torch (`diffvbd.reference`), forward first. The
networks are the edges, or the tets, of the Delaunay meshes of the unit cube with 26 and 115 vertices, masses those of
1000 kg/m^3, the vertices with x < 0.2 pinned, h = 1/60 s, one step under gravity. The body starts bent by a sine of
0.1 m amplitude, moving by one of 2 m/s; springs have 3e3 to 3e4 N/m and rest lengths up to 20 % off those of the mesh,
tets 3e4 to 3e5 Pa.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

import diffvbd as dv
from bench import paper
from bench.ablation import forward_error, mesh_of
from bench.common import markdown_table
from diffvbd import testing
from diffvbd.reference import projective_dynamics as reference_pd
from diffvbd.reference import xpbd as reference_xpbd
from diffvbd.solvers import XPBD, ProjectiveDynamics

SWEEPS = (1, 5, 20)
TIME_STEP = 1 / 60  # [s]
SOLVERS: dict[str, Callable[..., Any]] = {
    "XPBD, one constraint after another": functools.partial(XPBD.from_mesh, order="sequential"),
    "XPBD, by colors": XPBD.from_mesh,
    "PD, springs": functools.partial(ProjectiveDynamics.from_mesh, springs=True, tets=False),
    "PD, tets": ProjectiveDynamics.from_mesh,
}


def run(quick: bool, *, device: str = "cpu") -> dict[str, Any]:
    rows = []
    for name, make in SOLVERS.items():
        for size in testing.SIZES[:1] if quick else testing.SIZES[:2]:
            for sweeps in SWEEPS[:2] if quick else SWEEPS:
                rows.append({"solver": name, **measured(make, size, sweeps, device)})
    return {"rows": rows}


def measured(make: Callable[..., Any], size: str, sweeps: int, device: str) -> dict[str, Any]:
    """Errors of one step on one mesh: of the forward, of the gradients of x0 and v0, the worst of all gradients."""
    mesh = mesh_of(size)
    pinned = mesh.points[:, 0] < 0.2
    here, there = make(mesh, pinned=pinned), make(mesh, pinned=pinned, device=device)
    inputs = scene(mesh, here)

    def step(**given: Any) -> tuple[Tensor, Tensor]:
        return there.step(**given, sweeps=sweeps)

    expected = testing.evaluate(functools.partial(reference_of(here), sweeps=sweeps), inputs)
    found = testing.on_device(testing.evaluate(step, testing.on_device(inputs, device)), "cpu")
    forward = forward_error(found, expected, TIME_STEP)
    if forward > testing.tolerance("forward"):
        raise RuntimeError(f"{size}, K = {sweeps}: forward differs from the reference by {forward:.1e}")
    errors = {n: testing.relative_error(found[n], expected[n]) for n in expected if n.startswith("grad_")}
    worst = max(errors, key=lambda name: errors[name])
    return {
        "vertices": mesh.num_vertices,
        "constraints": len(here.edges) or mesh.num_tets,
        "sweeps": sweeps,
        "error": max(errors["grad_x"], errors["grad_v"]),
        "worst_error": errors[worst],
        "worst_gradient": worst[5:],
        "forward": forward,
    }


def scene(mesh: dv.TetMesh, solver: Any) -> dict[str, Any]:
    """Everything that a step takes, differentiable, on the CPU."""
    rng = testing.generator("generality", mesh.num_vertices)
    waves, phases = rng.uniform(-1.5, 1.5, (2, 3, 3)), rng.uniform(0, 6, (2, 3))
    bend, motion = (np.sin(mesh.points @ waves[k] + phases[k]) for k in (0, 1))
    x, v = mesh.points + 0.1 * bend, 2 * motion
    given = {"x": x, "v": v, "prescribed": x + TIME_STEP * v, "mass": solver.mass, "gravity": [0.0, -9.81, 0.0],
             "force": rng.uniform(-1, 1, x.shape)}  # fmt: skip
    if count := len(solver.edges):
        given["stiffness"] = 10 ** rng.uniform(3.5, 4.5, count)
        given["rest_length"] = solver.rest_length.numpy() * rng.uniform(0.8, 1.2, count)
    else:
        given["tet_stiffness"] = 10 ** rng.uniform(4.5, 5.5, mesh.num_tets)
    tensors = {name: torch.as_tensor(value, dtype=torch.float64) for name, value in given.items()}
    return tensors | {"time_step": TIME_STEP}


def reference_of(solver: Any) -> Callable[..., tuple[Tensor, Tensor]]:
    """The reference step of a solver's network."""
    network = {"edges": solver.edges, "pinned": solver.pinned}
    if isinstance(solver, XPBD):
        return functools.partial(reference_xpbd.step, **network, groups=solver.groups)
    absent = {"tet_stiffness": 0.0} if len(solver.edges) else {"stiffness": 0.0, "rest_length": 0.0}
    body = {"rest_points": solver.rest_points, "tets": solver.tets.nodes}
    return functools.partial(reference_pd.step, **network, **body, **absent)


def markdown(results: dict[str, Any]) -> str:
    rows = results["rows"]
    depths = sorted({r["sweeps"] for r in rows})
    groups = list(dict.fromkeys((r["solver"], r["vertices"], r["constraints"]) for r in rows))
    by = {(r["solver"], r["vertices"], r["sweeps"]): r for r in rows}

    def error(name: str, vertices: int, sweeps: int) -> str:
        theirs = paper.GENERALITY.get(name, {}).get(vertices, {}).get(sweeps)
        return f"{by[name, vertices, sweeps]['error']:.1e}" + ("" if theirs is None else f" (paper {theirs:.1e})")

    def worst(name: str, vertices: int, sweeps: int) -> str:
        row = by[name, vertices, sweeps]
        return f"{row['worst_error']:.1e} ({row['worst_gradient']})"

    header = ["solver", "vertices", "constraints", *(f"K = {k}" for k in depths)]
    parts = [
        f"## {title}\n\n" + markdown_table(header, [[*g, *(value(g[0], g[1], k) for k in depths)] for g in groups])
        for title, value in (("Gradient error, the larger of x0 and v0", error), ("The worst of all gradients", worst))
    ]
    parts.append(
        "The meshes have the paper's sizes, but points, stiffness and motion are ours, and so is the way in which PD "
        "and its reference are computed: both leave pinned vertices out of the matrix and solve for the change of "
        "positions, from a residual of differences. The paper's table has no colors and no tets. Gradients of masses "
        "and moduli are made of moves and strains, small differences of positions, and keep fewer digits.\n"
    )
    return "\n".join(parts)
