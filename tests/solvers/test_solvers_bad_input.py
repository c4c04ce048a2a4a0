"""Claim: what XPBD and projective dynamics cannot work with raises ValueError or TypeError that names the argument.

Values are looked at on the CPU."""

import re
from typing import Any

import pytest
import torch

import diffvbd as dv
from diffvbd.solvers import XPBD, ProjectiveDynamics

MESH = dv.mesh.cube(split="kuhn")  # 8 vertices, 6 tets, 19 edges
X = torch.from_numpy(MESH.points.copy())
NAN = torch.where(torch.arange(8)[:, None] == 2, torch.nan, X)
INF = float("inf")
LEAF = torch.tensor(0.01, dtype=torch.float64, requires_grad=True)
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
    *[(lambda s=s: s(prescribed=[0.0]), "prescribed: expected a number or a tensor, got list") for s in (xpbd, pd)],
    *[(lambda s=s: s(mass=0.0), "mass: expected finite numbers > 0 kg where not pinned, got 0.0") for s in (xpbd, pd)],
    *[(lambda s=s: s(stiffness=X), r"stiffness: expected a shape that broadcasts to \[.*19\]") for s in (xpbd, pd)],
    *[(lambda s=s: s(rest_length=-1.0), "rest_length: expected finite numbers >= 0, got -1.0") for s in (xpbd, pd)],
    *[(lambda s=s, n=n: s(**{n: NAN}), rf"{n}: expected finite values, got nan at \[2, 0\]")
      for s in (xpbd, pd) for n in ("x", "v", "force", "gravity")],
    *[(lambda k=k, o=o: k.from_mesh(MESH, pinned=[2]).step(**(GIVEN | o), prescribed=NAN), "prescribed: .*finite")
      for k, o in ((XPBD, {}), (ProjectiveDynamics, {"stiffness": None, "tet_stiffness": 1e4}))],
    *[(lambda s=s: s(gravity=(0.0, INF, 0.0)), r"gravity: expected finite .* inf at \[0, 1\]") for s in (xpbd, pd)],
    *[(lambda s=s: s(v=X + 1e307, time_step=1e3, force=X), "x, v, force, mass, time_step: expected a finite predictor")
      for s in (xpbd, pd)],
    *[(lambda s=s: s(rest_length=INF), "rest_length: expected finite numbers >= 0, got inf") for s in (xpbd, pd)],
    *[(lambda s=s: s(stiffness=float("nan")), "stiffness: expected .*numbers >.* got nan") for s in (xpbd, pd)],
    *[(lambda s=s: s(time_step=LEAF), "time_step: expected a number, got a tensor that requires") for s in (xpbd, pd)],
    *[(lambda s=s, h=h: s(time_step=h), f"time_step: .* whose square lies between .*, got {h}".replace("+", r"\+"))
      for s in (xpbd, pd) for h in (1e-170, 1e170)],
    (lambda: xpbd(stiffness=1e-305, time_step=1e-3), "stiffness: expected numbers for which the compliance .* finite"),
    (lambda: pd(stiffness=INF), "stiffness: expected finite numbers >= 0, got inf"),
    (lambda: pd(tet_stiffness=INF), "tet_stiffness: expected finite numbers >= 0, got inf"),
    (lambda: ProjectiveDynamics(X, 1e-9, [[0, 1]]).factor(time_step=0.01, stiffness=1e25),
     "stiffness, mass, time_step: expected masses of the scale .*torch.float64., got 1e.25, 1e-09, 0.01"),
    (lambda: pd(stiffness=1e308, time_step=1e3), "stiffness, tet_stiffness, mass, time_step: expected masses"),
    *[(lambda k=k: k.from_mesh(MESH, device="tpu"), 'device: expected "cpu" or "cuda", got \'tpu\'')
      for k in (XPBD, ProjectiveDynamics)],
    (lambda: XPBD.from_mesh(MESH, device="meta"), 'device: expected "cpu" or "cuda", got \'meta\''),
    (lambda: xpbd(stiffness=0.0), "stiffness: expected numbers > 0, got 0.0"),
    (lambda: pd(stiffness=-1.0), "stiffness: expected finite numbers >= 0, got -1.0"),
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


def test_what_is_not_used_may_be_anything() -> None:
    """A free particle's prescribed position, a pinned one's force; and infinite stiffness is no bad value."""
    solver = XPBD.from_mesh(MESH, pinned=[2])
    given = GIVEN | {"stiffness": INF}
    found = solver.step(**given, force=NAN, prescribed=torch.where(solver.pinned[:, None], X, torch.nan))
    expected = solver.step(**given, force=X)
    assert all(torch.equal(*pair) and pair[0].any() for pair in zip(found, expected, strict=True))


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_cuda_where_there_is_none() -> None:
    for kind in (XPBD, ProjectiveDynamics):
        with pytest.raises(RuntimeError, match="^diffvbd: .*CUDA"):
            kind.from_mesh(MESH, device="cuda")
