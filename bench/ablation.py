"""Gradient error of adjoints that lack one of the terms which exactness at finite depth requires (paper, section 3.5).

Each variant is a subclass of `diffvbd.solvers.VertexBlock` with one method changed; the forward is the same to the bit:

* no saturation Jacobian: the incoming adjoint goes into the local solve as it is;
* no Hessian tangent: the block counts as a constant, for the state and for the material;
* validity gate: the Hessian tangent only of tets with det F > 0.5, which the forward knows nothing of.

Scene, the same on all meshes: the unit cube (Delaunay meshes of 26, 115 and 631 vertices), not held, paper preset
(`dv.VBD.paper`), density 1000 kg/m^3, mu = lam = 1e4 Pa, h = 1/60 s, one step under gravity. The cube starts at rest
shape, turning about its vertical axis by 4 rad/s per metre of height (zero at mid-height), with uniform noise of 1 m/s
on every velocity component. Noise of one size is a strain that grows as edges get shorter: that is what refinement does
to any motion whose wavelength the mesh barely resolves. The loss is a fixed random linear function of the end state.
Other draws of the noise are measured too, because one flat tet decides whether a gate fires on the coarse mesh.

The paper gives neither motion nor material of its ablation, so only the pattern can be compared: the full adjoint at
rounding level, each omission visible at K = 1 and larger on a finer mesh, the gate exact where no tet comes near
inversion. What an omission costs follows the length of the updates (saturation: their ratio to 0.1 m) and the strain
that they make (Hessian tangent).
"""

from __future__ import annotations

import statistics
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

import diffvbd as dv
from bench import paper
from bench.exactness import gradient_error, mesh_of, verified_forward
from bench.tables import Table
from diffvbd import testing
from diffvbd.solvers import VertexBlock, vertex_block_descent

SWEEPS = (1, 5, 20)
MODULUS = 1e4  # [Pa]
TIME_STEP = 1 / 60  # [s]
TWIST = 4.0  # [rad/s per m]
NOISE = 1.0  # [m/s]
GATE = 0.5  # least det F at which the gated adjoint keeps the tangent
DRAWS = 5  # of the noise, the first of which is the scene of the main table


class NoSaturationJacobian(VertexBlock):
    def saturation_vjp(self, z: Tensor, raw: Tensor) -> Tensor:
        return z


class NoHessianTangent(VertexBlock):
    def hessian_tangent(self, b: Any, p: Tensor, raw: Tensor) -> Any:
        return super().hessian_tangent(b, torch.zeros_like(p), raw)


class ValidityGate(VertexBlock):
    def hessian_tangent(self, b: Any, p: Tensor, raw: Tensor) -> Any:
        return super().hessian_tangent(b, torch.where(b.det > GATE, p, 0.0), raw)


VARIANTS: dict[str, type[VertexBlock]] = {
    "full adjoint": VertexBlock,
    "no saturation Jacobian": NoSaturationJacobian,
    "no Hessian tangent": NoHessianTangent,
    "validity gate det F > 0.5": ValidityGate,
}
STEP = "full adjoint, diffvbd.step"


def run(quick: bool, *, device: str = "cpu") -> dict[str, Any]:
    meshes, rows = [], []
    for size in testing.SIZES[:2] if quick else testing.SIZES:
        model, inputs = scene(size)
        for sweeps in SWEEPS[:1] if quick else SWEEPS:
            steps = {name: composed(model.to(device), sweeps, kind) for name, kind in VARIANTS.items()}
            steps[STEP] = partial(dv.step, model.to(device), solver=solver_of(sweeps))
            found = errors(model, inputs, sweeps, steps, device)
            rows += [{"variant": name, "vertices": model.num_vertices, "sweeps": sweeps, **row}
                     for name, row in found.items()]  # fmt: skip
        meshes.append(described(model, inputs))
    return {"rows": rows, "meshes": meshes, "draws": [] if quick else draws(device)}


def errors(model: dv.Model, inputs: dict[str, Any], sweeps: int, steps: dict[str, Any], device: str
           ) -> dict[str, dict[str, float]]:  # fmt: skip
    """Errors of the gradients and of the forward of each kind of step; another forward would make a comparison of
    gradients worthless."""
    expected, rows = testing.reference_result(model, inputs, solver_of(sweeps)), {}
    for name, step in steps.items():
        found = testing.evaluate(step, testing.on_device(inputs, device), TIME_STEP)
        forward = verified_forward(found, expected, TIME_STEP, name)
        rows[name] = {"error": gradient_error(found, expected), "forward": forward}
    return rows


def draws(device: str) -> list[dict[str, Any]]:
    """Errors at K = 1 over several draws of the noise: median, least and largest."""
    rows = []
    for size in testing.SIZES:
        found: dict[str, list[float]] = {name: [] for name in VARIANTS}
        for draw in range(DRAWS):
            model, inputs = scene(size, draw)
            steps = {name: composed(model.to(device), 1, kind) for name, kind in VARIANTS.items()}
            for name, row in errors(model, inputs, 1, steps, device).items():
                found[name].append(row["error"])
        rows += [{"variant": name, "vertices": model.num_vertices, "median": statistics.median(values),
                  "least": min(values), "largest": max(values)} for name, values in found.items()]  # fmt: skip
    return rows


def scene(size: str, draw: int = 0) -> tuple[dv.Model, dict[str, Any]]:
    """Model and inputs of a step, on the CPU."""
    model = dv.Model(mesh_of("delaunay", size)[1])
    points = model.mesh.points
    x, height, z = (points - 0.5).T
    twist = TWIST * height * np.stack((z, 0 * z, -x))
    noise = NOISE * testing.generator("ablation", size, draw).uniform(-1, 1, points.shape)
    given = {"mu": MODULUS, "lam": MODULUS, "x": points.copy(), "v": twist.T + noise, "gravity": [0.0, -9.81, 0.0]}
    tensors = {name: torch.as_tensor(value, dtype=torch.float64) for name, value in given.items()}
    return model, tensors


def solver_of(sweeps: int) -> dv.VBD:
    """The paper's preset by the sweeps alone, as the composed variants have them."""
    return dv.VBD.paper(TIME_STEP, sweeps, subspace=None)


def described(model: dv.Model, inputs: dict[str, Any]) -> dict[str, Any]:
    """What the first update of the step meets: tets at the predictor, and how far one sweep moves a vertex."""
    h = TIME_STEP
    y = inputs["x"] + h * inputs["v"] + h * h * inputs["gravity"]
    corners, at_rest = y[model.tets], model.rest_points[model.tets]
    det = torch.linalg.det(corners[:, 1:] - corners[:, :1]) / torch.linalg.det(at_rest[:, 1:] - at_rest[:, :1])
    end, _ = dv.step(model, solver=solver_of(1), **inputs)
    return {
        "vertices": model.num_vertices,
        "tets": model.num_tets,
        "least_det_F": float(det.min()),
        "gated_tets": int((det <= GATE).sum()),
        "inverted_tets": int((det <= 0).sum()),
        "largest_move_m": float((end - y).norm(dim=-1).max()),
    }


def composed(model: dv.Model, sweeps: int, kind: type[VertexBlock]) -> Callable[..., Any]:
    """A step whose sweep is composed of one kind of update."""
    solver = vertex_block_descent(model, solver_of(sweeps), kind)

    def step(x: Tensor, v: Tensor, mu: Tensor, lam: Tensor, gravity: Tensor) -> Any:
        y = x + TIME_STEP * v + TIME_STEP**2 * gravity
        (end,) = solver((y,), (y, mu, lam, model.mass), sweeps=sweeps)
        return end, (end - x) / TIME_STEP

    return step


TABLES = (
    Table("Gradient error, the larger of x0 and v0, against autograd through the executed sweeps", "rows",
          {"adjoint": "variant", "vertices": "vertices", "K": "sweeps", "error": "error",
           "paper": lambda row: paper.ABLATION[row["variant"]].get(row["vertices"]) if row["sweeps"] == 1 else None}),
    Table(f"Median, least and largest error at K = 1 over {DRAWS} draws of the noise", "draws"),
    Table("What the first sweep meets", "meshes"),
)  # fmt: skip
