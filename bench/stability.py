"""How many sweeps keep vibrations far shorter than a step from growing: by integrator, relaxation and lam over mu.

Without coarse corrections from the eigenvalues of K sweeps over the stiffness at rest: each is what is left of an error
of a vibration after a step, and with it the scheme of the integrator is a small matrix, whose powers must not grow. Of
three meshes the worst counts. With coarse corrections from runs of a bar, at two stiffnesses.
"""

from __future__ import annotations

import math
import time
import warnings
from typing import Any

import numpy as np
import torch

import diffvbd as dv
from bench.common import markdown_table
from diffvbd import mesh, reference
from diffvbd.model.growth import MANY, RATIOS, RELAXATIONS

GROWS = 1.01  # times from one step to the next: less is taken for none
COARSE = (1, 2, 3, 4, 5, 6, 8, 12, 16, 24)  # sweeps of runs
MODULI, STEPS, TIME_STEP, CALM = (1e6, 1e8), 200, 0.01, 5.0  # [Pa], -, [s], [m/s] of a bar that sags
SCHEMES: dict[str, Any] = {"ImplicitEuler": dv.ImplicitEuler(), "BDF2": dv.BDF2(), "SDIRK2": dv.SDIRK2()}


def _meshes() -> list[dv.TetMesh]:
    return [
        mesh.beam(7, 2, 2, size=(0.6, 0.1, 0.1), split="kuhn"),
        mesh.cube(4, size=0.2, split="kuhn"),
        mesh.beam(6, 3, 3, size=(0.5, 0.2, 0.2), split="kuhn"),
    ]


def stiffness(body: dv.TetMesh, lam: float) -> np.ndarray:
    """Of linear elasticity with mu = 1 Pa, [3 V, 3 V]: that of all laws at rest."""
    out = np.zeros((3 * len(body.points), 3 * len(body.points)))
    for tet in body.tets:
        edges = (body.points[tet[1:]] - body.points[tet[0]]).T
        slopes = np.linalg.inv(edges)
        slopes = np.vstack([-slopes.sum(0), slopes])
        volume = abs(np.linalg.det(edges)) / 6
        for a, i in zip(slopes, tet, strict=True):
            for b, j in zip(slopes, tet, strict=True):
                block = lam * np.outer(a, b) + np.outer(b, a) + a @ b * np.eye(3)
                out[3 * i : 3 * i + 3, 3 * j : 3 * j + 3] += volume * block
    return out


def sweep(matrix: np.ndarray, order: list[int], relaxation: float) -> np.ndarray:
    """What a sweep leaves of an error, [3 V, 3 V]."""
    out = np.eye(len(matrix))
    for vertex in order:
        rows = slice(3 * vertex, 3 * vertex + 3)
        out[rows] -= relaxation * np.linalg.solve(matrix[rows, rows], matrix[rows] @ out)
    return out


def growth(scheme: str, left: complex) -> float:
    """By how much a step multiplies a vibration at rest whose solves leave this share of an error."""
    if scheme == "ImplicitEuler":  # x' = left (x + h v), h v' = x' - x
        return float(np.abs(np.roots([1, -2 * left, left])).max())
    if scheme == "BDF2":  # h v' = 3/2 x' - 2 x + 1/2 x_before
        return float(np.abs(np.roots([1, -2.5 * left, 2 * left, -0.5 * left])).max())
    share = 1 - 1 / math.sqrt(2)
    step = np.zeros((2, 2), dtype=complex)
    for k, (x, v) in enumerate(np.eye(2)):
        x1 = left * (x + share * v)
        v1 = (x1 - x) / share
        carried = math.sqrt(2) * v1
        x2 = left * (x1 + share * (v + (1 + math.sqrt(2)) * (v1 - v) + carried))
        step[:, k] = x2, (x2 - x1) / share - carried
    return float(np.abs(np.linalg.eigvals(step)).max())


def _of_sweeps(quick: bool) -> dict[str, dict[str, list[list[int]]]]:
    """Least sweeps by kind and scheme, of each relaxation and ratio."""
    kinds = ("all", "but_last", "free")
    out = {kind: {scheme: [[1] * len(RATIOS) for _ in RELAXATIONS] for scheme in SCHEMES} for kind in kinds}
    for body in _meshes()[: 1 if quick else None]:
        for kind in kinds:
            held = (body.points[:, 0] < 1e-9) & (kind != "free")
            model = dv.Model(body, pinned=torch.tensor(held))
            order = [int(v) for color in reference.build_layout(model).colors for v in color.vertices]
            free = np.repeat(~held, 3)
            turns = _without_rigid(body) if kind == "free" else np.eye(free.sum())
            for c, ratio in enumerate(RATIOS[: 2 if quick else None]):
                matrix = stiffness(body, ratio)
                plain = sweep(matrix, order, 1.0)[np.ix_(free, free)]
                for r, relaxation in enumerate(RELAXATIONS):
                    one = sweep(matrix, order, relaxation)[np.ix_(free, free)]
                    done = one if kind == "all" else plain
                    for sweeps in range(1, MANY):
                        left = np.linalg.eigvals(turns @ done @ turns)
                        left = left[np.abs(left) > 1e-3]  # others are gone at once
                        for scheme in SCHEMES:
                            if max((growth(scheme, z) for z in left), default=0.0) > GROWS:
                                row = out[kind][scheme][r]
                                row[c] = max(row[c], sweeps + 1)
                        done = done @ one
    return out


def _without_rigid(body: dv.TetMesh) -> np.ndarray:
    """Takes rigid motions off, which the rigid correction solves for."""
    arms = body.points - body.points.mean(0)
    ways = [np.broadcast_to(axis, arms.shape).ravel() for axis in np.eye(3)]
    ways += [np.cross(axis, arms).ravel() for axis in np.eye(3)]
    base, _ = np.linalg.qr(np.array(ways).T)
    return np.eye(arms.size) - base @ base.T


def _of_runs(quick: bool) -> dict[str, list[list[int]]]:
    """The same with coarse corrections: after which number of sweeps no run grows any more."""
    body = _meshes()[0]
    out = {scheme: [[1] * len(RATIOS) for _ in RELAXATIONS] for scheme in SCHEMES}
    for scheme, integrator in SCHEMES.items():
        for r, relaxation in enumerate(RELAXATIONS):
            model = dv.Model(body, pinned=torch.tensor(body.points[:, 0] < 1e-9), relaxation=relaxation, coarse="auto")
            for c, ratio in enumerate(RATIOS[: 2 if quick else None]):
                for k, sweeps in enumerate(COARSE[: 3 if quick else None]):
                    if max(_fastest(model, integrator, sweeps, modulus, ratio) for modulus in MODULI) > CALM:
                        out[scheme][r][c] = (*COARSE, MANY)[k + 1]
    return out


def _fastest(model: dv.Model, integrator: Any, sweeps: int, modulus: float, ratio: float) -> float:
    """Largest speed at the end [m/s]."""
    x = model.rest_points
    with warnings.catch_warnings(), torch.no_grad():
        warnings.simplefilter("ignore")
        try:
            end = dv.rollout(model, x, torch.zeros_like(x), steps=STEPS, mu=modulus, lam=ratio * modulus, save="last",
                             time_step=TIME_STEP, sweeps=sweeps, integrator=integrator, check_energy=False)  # fmt: skip
        except ValueError:  # positions that are not finite
            return math.inf
    return float(end.v[-1].norm(dim=-1).max().nan_to_num(nan=math.inf))


def run(quick: bool) -> dict[str, Any]:
    began = time.perf_counter()
    least = {**_of_sweeps(quick), "coarse": _of_runs(quick)}
    return {"relaxations": RELAXATIONS, "ratios": RATIOS, "least": least, "seconds": time.perf_counter() - began}


TITLES = {"all": "pinned bodies, all sweeps over-relaxed", "but_last": "pinned bodies beside free ones",
          "free": "free bodies", "coarse": "coarse corrections"}  # fmt: skip


def markdown(results: dict[str, Any]) -> str:
    header = ("", "integrator", "relaxation", *(f"lam / mu = {ratio:g}" for ratio in results["ratios"]))
    rows = []
    for kind, title in TITLES.items():
        for scheme, table in results["least"][kind].items():
            for relaxation, row in zip(results["relaxations"], table, strict=True):
                rows.append([title, scheme, f"{relaxation:g}", *(f"> {MANY - 1}" if n >= MANY else n for n in row)])
    return "## Sweeps from which on stiff vibrations do not grow\n\n" + markdown_table(header, rows)
