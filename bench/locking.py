"""Locking of linear tets near incompressibility, with and without patches: Cook's membrane, a cantilever, one step.

Deflection at rest (`dv.equilibrium`, no sweeps) under a small shear load, as a mean over the loaded face weighted by
the load, over that of a finer mesh of Taylor-Hood elements (quadratic displacement, linear pressure), which do not
lock. Those are of scikit-fem (`pip install scikit-fem`); without it only the cantilever has a reference, Timoshenko's
beam. `plain`: tets alone; `patches`: volumes averaged over patches="auto".

Cook's membrane is the solid of thickness 16 whose sides are free, clamped at x = 0 and sheared at x = 48 (Cook 1974 has
it as a plane problem). The cantilever is 5 x 1 x 1. `cells` counts those along the short edges, each of six tets.
`small_strain` checks that nu is that of linear elasticity, whatever constants the law has of its own.

`sweeps`: a beam of 0.5 x 0.1 x 0.1 m with 4 cells across, of 1 MPa, that begins to sag in one step of 0.02 s: motion of
its end after K sweeps over that of the converged step of its law. `locked` is the converged step over that with
patches. A converged step is the rest state with anchors of stiffness m / h^2 at the predictor.
"""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import torch

import diffvbd as dv
from bench.tables import Table

POISSON = (0.3, 0.45, 0.49, 0.499, 0.4999)
YOUNG = 1e6  # [Pa]
STRAIN = 1e-5  # deflection over length, about: what is small against it are the terms beyond linear elasticity
SOLVER = dv.VBD(1.0, 0, subspace="coarse")


def cantilever(n: int) -> dv.TetMesh:
    """5 x 1 x 1, n cells across."""
    return dv.mesh.beam(5 * n + 1, n + 1, n + 1, size=(5.0, 1.0, 1.0), split="kuhn")


def cook(n: int) -> dv.TetMesh:
    """Cook's membrane of thickness 16: from (0, 0)-(0, 44) to (48, 44)-(48, 60), in units of 0.1 m."""
    depth = max(n // 2, 1)
    mesh = dv.mesh.box((n + 1, n + 1, depth + 1), (1.0, 1.0, 1.0), split="kuhn")
    s, t, z = mesh.points.T
    y = (1 - s) * 44 * t + s * (44 + 16 * t)
    return dv.TetMesh(0.1 * np.stack([48 * s, y, 16 * z], 1), mesh.tets)


CASES = {"cantilever": (cantilever, (2, 4, 8)), "cook": (cook, (4, 8, 16))}
SWEEPS = (10, 30, 100, 300, 1000)
FINE = {"cantilever": 4, "cook": 10}  # cells of Taylor-Hood elements


def run(quick: bool) -> dict[str, Any]:
    out: dict[str, Any] = {"small_strain": [small_strain(nu) for nu in POISSON]}
    for name, (make, sizes) in CASES.items():
        rows, fine = [], 2 if quick else FINE[name]
        for nu in POISSON[:1] if quick else POISSON:
            known = {k: taylor_hood(make(k), nu) for k in sorted({fine // 2, fine})}
            timoshenko = beam_theory(nu) if name == "cantilever" else None
            for n in sizes[:1] if quick else sizes:
                rows.append(row(make(n), nu, n) | {"timoshenko": timoshenko, "reference": known[fine],
                                                   "reference_coarser": known[fine // 2]})  # fmt: skip
        out[name] = rows
    out["sweeps"] = [
        r for nu in (POISSON[:1] if quick else POISSON) for r in one_step(nu, SWEEPS[:1] if quick else SWEEPS)
    ]
    return out


def loads(mesh: dv.TetMesh) -> np.ndarray:
    """Share of a uniform shear of the face at the largest x that each vertex bears [V]; they add up to 1."""
    x = mesh.points[:, 0]
    faces = mesh.surface[(x[mesh.surface] > x.max() - 1e-9).all(1)]
    a, b, c = (mesh.points[faces[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    share = np.bincount(faces.reshape(-1), np.repeat(area, 3), mesh.num_vertices)
    return share / share.sum()


def row(mesh: dv.TetMesh, nu: float, n: int) -> dict[str, Any]:
    """Deflection [m/N]."""
    x = mesh.points
    length, total = np.ptp(x[:, 0]), STRAIN * YOUNG * np.ptp(x[:, 1]) * np.ptp(x[:, 2]) / 100
    share = torch.from_numpy(loads(mesh))
    force = torch.zeros(mesh.num_vertices, 3, dtype=torch.float64)
    force[:, 1] = total * share
    out = {"poisson": nu, "cells": n, "vertices": mesh.num_vertices, "tets": mesh.num_tets, "length": length}
    for name, energy in LAWS.items():
        model = dv.Model(mesh, pinned=x[:, 0] < 1e-9, energies=[energy])
        rest = dv.equilibrium(model, model.rest_points, SOLVER, young=YOUNG, poisson=nu, gravity=(0, 0, 0),
                              force=force, tolerance=1e-6)  # fmt: skip
        out[name] = float((share * (rest.x - model.rest_points)[:, 1]).sum() / total)
        out[f"{name}_iterations"] = rest.iterations
    return out


LAWS = {"plain": dv.StableNeoHookean(), "patches": dv.StableNeoHookean(patches="auto")}


def beam_theory(nu: float) -> float:
    """Deflection of the cantilever [m/N] by Timoshenko, with Cowper's shear coefficient of a rectangle."""
    length, area, second = 5.0, 1.0, 1 / 12
    shear = YOUNG / (2 * (1 + nu))
    return length**3 / (3 * YOUNG * second) + length * (12 + 11 * nu) / (10 * (1 + nu) * shear * area)


def one_step(nu: float, sweeps: tuple[int, ...]) -> list[dict[str, Any]]:
    """Rows of both laws, without and with coarse corrections."""
    mesh, h, gravity = dv.mesh.beam(21, 5, 5, size=(0.5, 0.1, 0.1), split="kuhn"), 0.02, (0.0, -9.81, 0.0)
    pinned, end = mesh.points[:, 0] < 1e-9, torch.as_tensor(mesh.points[:, 0] > 0.5 - 1e-9)
    values, rows = {"young": YOUNG, "poisson": nu}, []
    for name, energy in LAWS.items():
        model = dv.Model(mesh, pinned=pinned, energies=[energy])
        x = model.rest_points
        inertia = dv.Model(mesh, pinned=pinned, energies=[energy, dv.Anchor(0.0)])
        found = dv.equilibrium(inertia, x, SOLVER, gravity=(0, 0, 0), anchor_stiffness=model.mass / h**2,
                               anchor_points=x + h * h * x.new_tensor(gravity), **values)  # fmt: skip
        converged = float((found.x - x)[end, 1].mean())
        for subspace in ("rigid", "coarse"):
            row = {"poisson": nu, "law": name, "subspace": subspace, "converged": converged}
            for k in sweeps:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")  # of too few sweeps
                    moved = dv.step(model, x, 0 * x, dv.VBD(h, k, subspace=subspace), gravity=gravity, **values)[0] - x
                row[str(k)] = float(moved[end, 1].mean()) / converged
            rows.append(row)
    for row in rows:
        row["locked"] = row["converged"] / rows[-1]["converged"]
    return rows


def small_strain(nu: float) -> dict[str, float]:
    """Stress of a tet that is stretched by a small strain along x and shrunk by nu times as much across: along x over
    Young's modulus times the strain, and across over along. 1 and 0 if nu is what linear elasticity calls so."""
    model = dv.Model(dv.mesh.cube(), energies=[*LAWS.values()][:1])
    strain = 1e-8
    x = model.rest_points * (1 + strain * torch.tensor([1.0, -nu, -nu], dtype=torch.float64))
    along, across, _ = dv.stress(model, x, young=YOUNG, poisson=nu).cauchy[0].diagonal().tolist()
    return {"poisson": nu, "stress_along": along / (YOUNG * strain), "across_over_along": across / along}


def taylor_hood(mesh: dv.TetMesh, nu: float) -> float | None:
    """Deflection [m/N] by quadratic displacements and linear pressures on a mesh; None without scikit-fem."""
    try:
        import skfem
        from skfem.helpers import ddot, div, sym_grad
    except ImportError:
        return None
    from scipy.sparse import bmat

    grid = skfem.MeshTet(np.ascontiguousarray(mesh.points.T), np.ascontiguousarray(mesh.tets.T))
    mu, lam = dv.lame(YOUNG, nu)
    basis = skfem.Basis(grid, skfem.ElementVector(skfem.ElementTetP2()), intorder=3)
    pressure = basis.with_element(skfem.ElementTetP1())
    end = grid.facets_satisfying(lambda x: np.isclose(x[0], grid.p[0].max()))
    face = skfem.FacetBasis(grid, basis.elem, facets=end)
    a = skfem.BilinearForm(lambda u, v, w: 2 * mu * ddot(sym_grad(u), sym_grad(v))).assemble(basis)
    b = skfem.BilinearForm(lambda u, q, w: div(u) * q).assemble(basis, pressure)
    c = skfem.BilinearForm(lambda p, q, w: p * q / lam).assemble(pressure)
    f = skfem.LinearForm(lambda v, w: v[1]).assemble(face)
    f /= skfem.Functional(lambda w: 1.0 + 0 * w.x[0]).assemble(face)
    k = bmat([[a, b.T], [b, -c]]).tocsr()
    right = np.concatenate([f, np.zeros(c.shape[0])])
    held = basis.get_dofs(lambda x: np.isclose(x[0], 0.0)).all()
    solution = skfem.solve(*skfem.condense(k, right, D=held))
    return float(f @ solution[: len(f)])


def _nu(row: Any) -> str:
    return str(row["poisson"])


def _over(name: str) -> Any:
    def value(row: Any) -> float | None:
        known = row["reference"] or row["timoshenko"]
        return None if known is None else row[name] / known

    return value


TABLES = (
    Table("Deflection over the reference: cantilever", "cantilever",
          {"nu": _nu, "cells": "cells", "vertices": "vertices", **{name: _over(name) for name in LAWS},
           "Timoshenko": lambda row: row["timoshenko"] / row["reference"] if row["reference"] else None}),
    Table("Deflection over the reference: Cook's membrane", "cook",
          {"nu": _nu, "cells": "cells", "vertices": "vertices", **{name: _over(name) for name in LAWS}}),
    Table("One step of 0.02 s: motion over that of the converged step, by sweeps", "sweeps",
          {"nu": _nu, "law": "law", "subspace": "subspace", **{str(k): str(k) for k in SWEEPS},
           "locked": "locked"}),
    Table("Small strains: stress of an affine state of uniaxial tension", "small_strain"),
)  # fmt: skip
