"""Claim: what XPBD and projective dynamics cannot work with raises ValueError or TypeError that names the argument."""

import re
from typing import Any

import pytest
import torch

import diffvbd as dv
from diffvbd.solvers import XPBD, ProjectiveDynamics

MESH = dv.mesh.cube()  # 8 vertices, 6 tets, 19 edges
X = torch.from_numpy(MESH.points.copy())
GIVEN = {"x": X, "v": torch.zeros_like(X), "time_step": 0.01, "sweeps": 1, "stiffness": 1e3}


def xpbd(**changes: Any) -> Any:
    return XPBD.from_mesh(MESH).step(**(GIVEN | changes))


def pd(**changes: Any) -> Any:
    return ProjectiveDynamics.from_mesh(MESH, springs=True).step(**(GIVEN | {"tet_stiffness": 1e4} | changes))


FACTOR = ProjectiveDynamics.from_mesh(MESH).factor(time_step=0.01, tet_stiffness=1.0)
BAD: list[tuple[Any, str]] = [
    *[(lambda s=s: s(x=X[:5]), r"x: expected shape \[..., 8, 3\], got shape \[5, 3\]") for s in (xpbd, pd)],
    *[(lambda s=s: s(x=X.float()), "x: expected dtype .*64 .the solver's., got torch.float32") for s in (xpbd, pd)],
    *[(lambda s=s: s(v=X[None]), r"v: expected x's shape \[8, 3\]") for s in (xpbd, pd)],
    *[(lambda s=s: s(time_step=0.0), "time_step: expected a finite number > 0 s, got 0") for s in (xpbd, pd)],
    *[(lambda s=s: s(sweeps=1.5), "sweeps: expected an integer, got float 1.5") for s in (xpbd, pd)],
    *[(lambda s=s: s(force=X[:, :2]), r"force: expected a shape that broadcasts to \[8, 3\]") for s in (xpbd, pd)],
    *[(lambda s=s: s(gravity=9.81), "gravity: expected 3 numbers or a tensor, got 9.81") for s in (xpbd, pd)],
    *[(lambda s=s: s(prescribed=[0.0]), "prescribed: expected a tensor, got list") for s in (xpbd, pd)],
    *[(lambda s=s: s(mass=0.0), "mass: expected finite numbers > 0 kg where not pinned, got 0.0") for s in (xpbd, pd)],
    *[(lambda s=s: s(stiffness=X), r"stiffness: expected a shape that broadcasts to \[.*19\]") for s in (xpbd, pd)],
    *[(lambda s=s: s(rest_length=-1.0), "rest_length: expected numbers >= 0, got -1.0") for s in (xpbd, pd)],
    (lambda: xpbd(stiffness=0.0), "stiffness: expected numbers > 0, got 0.0"),
    (lambda: pd(stiffness=-1.0), "stiffness: expected numbers >= 0, got -1.0"),
    (lambda: pd(tet_stiffness=None), r"tet_stiffness: expected a value \(the solver has such constraints\), got None"),
    (lambda: pd(time_step=None), "time_step: expected a number of seconds, or a factor, got None"),
    (lambda: pd(factor=FACTOR), "time_step: expected None, because factor has it, got 0.01"),
    (lambda: pd(factor=3), "factor: expected what ProjectiveDynamics.factor returns, got int"),
    (lambda: ProjectiveDynamics.from_mesh(MESH).step(X, X, sweeps=1, time_step=0.1, stiffness=1.0, tet_stiffness=1.0),
     r"stiffness: expected None \(the solver has no such constraints\), got 1.0"),
    (lambda: XPBD(8, [[0, 1]], 1.0).step(**GIVEN), "rest_length: expected a value, because .* without rest positions"),
    (lambda: XPBD(X, [[0, 0]], 1.0), r"edges: expected two different indices from 0 to 7, got \[0, 0\]"),
    (lambda: XPBD(X, [[0, 8]], 1.0), r"edges: expected two different indices from 0 to 7, got \[0, 8\]"),
    (lambda: XPBD(X, [[0, 1, 2]], 1.0), r"edges: expected shape \[C, 2\], got shape \[1, 3\]"),
    (lambda: XPBD(X, [[0.0, 1.0]], 1.0), "edges: expected integers, got torch.float32"),
    (lambda: XPBD(X, [[0, 1]], -1.0), "mass: expected finite numbers > 0 kg"),
    (lambda: XPBD(X, [[0, 1]], [1.0]), r"mass: expected a number or shape \[8\], got shape \[1\]"),
    (lambda: XPBD(X, [[0, 1]], 1.0, order="random"), "order: expected \"sequential\" or \"colored\", got 'random'"),
    (lambda: XPBD(X[:, :2], [[0, 1]], 1.0), r"points: expected shape \[V, 3\]"),
    (lambda: XPBD(X, [[0, 1]], 1.0, pinned=[9]), "pinned"),
    (lambda: XPBD.from_mesh(X), "mesh: expected a diffvbd.TetMesh, got Tensor"),
    (lambda: XPBD.from_mesh(MESH, density=0.0), "density: expected a finite number > 0"),
    (lambda: XPBD.from_mesh(MESH, dtype=torch.float16), "dtype: expected torch.float64 or torch.float32"),
    (lambda: ProjectiveDynamics(8, 1.0, tets=[[0, 1, 2, 3]]), "points: expected rest positions, because"),
    (lambda: ProjectiveDynamics(5000, 1.0, [[0, 1]]), r"points: expected at most 4096 free particles .*, got 5000"),
]  # fmt: skip


@pytest.mark.parametrize(("run", "message"), BAD, ids=[b[1][:40] for b in BAD])
def test_bad_input(run: Any, message: str) -> None:
    with pytest.raises((ValueError, TypeError)) as error:
        run()
    assert re.match(message, str(error.value)), error.value
