"""Error of each backward route against autograd through the executed sweeps, over sweeps K, meshes and scenes.

The scene. A body of about 1 m with the paper's preset (`dv.VBD.paper`: block "paper", saturation 0.1 m, regularization
1e-6 kg), 1000 kg/m^3, under gravity, held where x lies in the lowest tenth of the body. It starts twisted about its
long axis by 1 rad from end to end, turning by another 5 rad/s, with uniform noise of `speed` on every component of the
velocities, so that one sweep leaves it far from stationary. Two materials at h = 10 ms:

* preset: mu = lam = 1e4 Pa, noise of 5 m/s; what `python -m bench cost` measures, too;
* soft: mu = 2e3 Pa, lam = 1e3 Pa, so that inertia dominates; noise of 10 m/s, so that one sweep still falls short.

The gradient is that of a fixed random linear function of the end state (`testing.evaluate`), with respect to x0 and v0;
errors are max |difference| / max |reference|, the larger of the two. The reference is autograd through
`diffvbd.reference` on the CPU. Unrolled autograd is `dv.Unrolled()`, the same code on the device of the run: its error
says only that the package's interface changes nothing, and what another device rounds differently.

Residuals are norms of grad G over unpinned vertices in the h^2-scaled form [kg m], at the executed end of the worst
step; relative ones are to the norm where the sweeps start. Both global routes solve by conjugate gradients to 1e-13,
and their iterations are those of the longest solve. The paper publishes neither material nor initial state of its
scene, so that only the course of its figures can agree: the reverse sweep at rounding level for every K, the global
routes off by tens of per cent at K = 1 and better as the residual falls. A bar is max(5e-15, 10 x spread), where spread
is the disagreement of two references that sum in another order.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

import diffvbd as dv
from bench import paper
from bench.tables import Table
from diffvbd import reference, testing

SWEEPS = (1, 5, 20)
OURS, UNROLLED = "reverse sweep", "unrolled autograd"
GLOBAL = ("global, assembled", "global, matrix-free")
TIGHT = 1e-13  # tolerance of the linear solves: what is left of their error is that of the equation
GRAVITY = (0.0, -9.81, 0.0)
RABBIT = Path(__file__).parent / "meshes" / "rabbit.mesh"
Row = dict[str, Any]


@dataclass(frozen=True)
class Case:
    """A scene without its Model: mesh, material and motion. `amount` scales twist, velocities and gravity together."""

    kind: str = "delaunay"  # of testing.KINDS, or "file"
    size: str = "medium"  # of testing.SIZES
    mu: float = 1e4  # [Pa]
    lam: float = 1e4  # [Pa]
    speed: float = 5.0  # [m/s] noise on the start velocities
    time_step: float = 1e-2  # [s]
    steps: int = 4
    amount: float = 1.0


PRESET = Case()
SOFT = Case(mu=2e3, lam=1e3, speed=10.0)


@dataclass(frozen=True)
class Scene:
    """A Model in motion, and what its rollout needs."""

    case: Case
    model: dv.Model
    x: Tensor
    v: Tensor

    @property
    def name(self) -> str:
        return f"{self.case.kind}, {self.model.num_vertices} v / {self.model.num_tets} t"

    def options(self, sweeps: int) -> dict[str, Any]:
        c = self.case
        gravity = torch.tensor([c.amount * g for g in GRAVITY], dtype=self.x.dtype, device=self.x.device)
        solver = dv.VBD.paper(c.time_step, sweeps, tape="full")
        return {"solver": solver, "steps": c.steps, "mu": c.mu, "lam": c.lam, "gravity": gravity}

    def to(self, device: str) -> Scene:
        return Scene(self.case, self.model.to(device), self.x.to(device), self.v.to(device))


def mesh_of(kind: str, size: str) -> tuple[str, dv.TetMesh]:
    """Kind and mesh. Without scipy, which Delaunay meshes need, a structured one of nearly as many vertices."""
    if kind == "file":
        return kind, dv.mesh.load(RABBIT)
    try:
        return kind, dv.TetMesh(*testing.build_mesh(kind, size))
    except ImportError:
        return "structured", dv.TetMesh(*testing.build_mesh("structured", size))


def build(case: Case, device: str = "cpu") -> Scene:
    """The scene of a case, its initial state a deterministic function of the case."""
    kind, mesh = mesh_of(case.kind, case.size)
    case, points = replace(case, kind=kind), mesh.points
    low, high = points.min(0), points.max(0)
    along = (points[:, 0] - low[0]) / (high[0] - low[0])
    pinned = along < 0.1
    arm = (points - (low + high) / 2) * np.array([0.0, 1.0, 1.0])  # from the long axis

    def turned(angle: np.ndarray) -> np.ndarray:
        cos, sin = np.cos(angle), np.sin(angle)
        return np.stack([0 * sin, cos * arm[:, 1] - sin * arm[:, 2], sin * arm[:, 1] + cos * arm[:, 2]], -1)

    x = points - arm + turned(case.amount * along)
    spin = 5.0 * along[:, None] * np.stack([0 * along, -arm[:, 2], arm[:, 1]], -1)
    noise = testing.generator("exactness", case.kind, case.size).uniform(-1.0, 1.0, points.shape)
    v = np.where(pinned[:, None], 0.0, case.amount * (spin + case.speed * noise))
    model = dv.Model(mesh, pinned=pinned)
    return Scene(case, model, torch.from_numpy(x), torch.from_numpy(v)).to(device)


# --- routes -----------------------------------------------------------------------------------------------------------


def summary(solves: list[Any]) -> Row:
    """Of the linear solves of a backward: iterations of the longest and of all, and whether every one converged. Empty
    where none was made."""
    if not solves:
        return {}
    counts = [int(torch.as_tensor(solve.iterations).max()) for solve in solves]
    return {"iterations": max(counts), "total_iterations": sum(counts),
            "converged": all(bool(solve.converged) for solve in solves)}  # fmt: skip


ROUTES = (OURS, UNROLLED, *GLOBAL)


def adjoint_of(route: str, tolerance: float = TIGHT, report: Callable[[Any], None] | None = None) -> Any:
    """The adjoint of a route; tolerance: of its linear solves, of which each is reported."""
    if route in GLOBAL:
        return dv.GlobalAdjoint(assembled=route == GLOBAL[0], tolerance=tolerance, on_failure="warn", report=report)
    return dv.Unrolled() if route == UNROLLED else dv.ReverseSweep()


def expected_of(scene: Scene, sweeps: int) -> dict[str, Tensor]:
    """End state and gradients by autograd through the reference, on the CPU."""
    here = scene.to("cpu")
    options = here.options(sweeps)

    def run(x: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
        done = reference.rollout(here.model, x, v, **options)
        return done.x[-1], done.v[-1]

    return testing.evaluate(run, {"x": here.x, "v": here.v}, here.case.time_step)


def result_of(scene: Scene, sweeps: int, adjoint: Any) -> dict[str, Tensor]:
    """End state and gradients by one of the package's routes, every tape kept."""

    def run(x: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
        done = dv.rollout(scene.model, x, v, adjoint=adjoint, checkpoint_every=None, save="last",
                          **scene.options(sweeps))  # fmt: skip
        return done.x[-1], done.v[-1]

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a solve that fails is a column of the tables
        return testing.evaluate(run, {"x": scene.x, "v": scene.v}, scene.case.time_step)


def forward_error(got: dict[str, Tensor], expected: dict[str, Tensor], time_step: float) -> float:
    """Of positions, and of velocities on the scale on which positions are rounded."""
    scale = float(expected["x"].abs().max()) / time_step
    velocity = float((got["v"].cpu() - expected["v"]).abs().max()) / scale
    return max(testing.relative_error(got["x"], expected["x"]), velocity)


def gradient_error(got: dict[str, Tensor], expected: dict[str, Tensor]) -> float:
    return max(testing.relative_error(got[f"grad_{name}"], expected[f"grad_{name}"]) for name in "xv")


def verified_forward(got: dict[str, Tensor], expected: dict[str, Tensor], time_step: float, route: str) -> float:
    """The error of a route's end state; a gradient of another forward would measure nothing, so that raises."""
    error, most = forward_error(got, expected, time_step), testing.tolerance("forward")
    if not error <= most:
        raise RuntimeError(f"{route}: expected the reference's end state within {most:g}, got an error of {error:.2g}")
    return error


# --- measurements -----------------------------------------------------------------------------------------------------


def residuals(scene: Scene, sweeps: int) -> Row:
    """Norms of grad G over unpinned vertices at the end of each executed step, the worst of the steps.

    h^2-scaled, [kg m]; and relative to its norm where the sweeps start, at the predictor y.
    """
    here, c = scene.to("cpu"), scene.case
    options = here.options(sweeps)
    with torch.no_grad():
        done = dv.rollout(here.model, here.x, here.v, **options)
    free, norms, shares = ~here.model.pinned, [], []
    for x, v, end in zip(done.x[:-1], done.v[:-1], done.x[1:], strict=True):
        y = x + c.time_step * v + c.time_step**2 * options["gravity"]
        y = torch.where(free[:, None], y, x)
        left, first = (float(reference.residual(here.model, at, y, c.mu, c.lam, c.time_step)[free].norm())
                       for at in (end, y))  # fmt: skip
        norms.append(left)
        shares.append(left / first)
    return {"residual": max(norms), "relative_residual": max(shares)}


def measure(scene: Scene, sweeps: int) -> Row:
    """Forward and gradient error of each route on one scene, and how far the two global ones disagree."""
    expected, gradients = expected_of(scene, sweeps), {}
    c = scene.case
    row: Row = {"mesh": scene.name, "mu": c.mu, "lam": c.lam, "time_step": c.time_step, "steps": c.steps,
                "sweeps": sweeps, "forward": 0.0, **residuals(scene, sweeps), "routes": {}}  # fmt: skip
    for route in ROUTES:
        solves: list[Any] = []
        gradients[route] = got = result_of(scene, sweeps, adjoint_of(route, TIGHT, solves.append))
        forward = verified_forward(got, expected, c.time_step, route)
        row["forward"] = max(row["forward"], forward)
        row["routes"][route] = {"error": gradient_error(got, expected), "forward": forward, **summary(solves)}
    row["global_difference"] = gradient_error(*(gradients[route] for route in GLOBAL))
    return row


def run(quick: bool, *, device: str = "cpu") -> dict[str, Any]:
    cases = {"preset": PRESET, "soft": SOFT}
    scenes = {name: [measure(build(case, device), k) for k in SWEEPS] for name, case in cases.items()}
    return {"scenes": scenes, "meshes": meshes(quick, device), "axes": axes(quick, device)}


def meshes(quick: bool, device: str) -> list[Row]:
    """The preset scene on other meshes: structured ones of about the same sizes, and a body from a file."""
    kinds = [("structured", size) for size in testing.SIZES] + [("delaunay", "small"), ("delaunay", "large")]
    kinds = [*(kinds[:1] if quick else kinds), ("file", "medium")]
    return [
        measure(build(replace(PRESET, kind=kind, size=size), device), k)
        for kind, size in kinds
        for k in (SWEEPS[:1] if quick else SWEEPS)
    ]


AXES: dict[str, list[tuple[str, dict[str, Any]]]] = {
    "mesh": [(size, {"size": size}) for size in testing.SIZES],
    "steps": [(str(n), {"steps": n}) for n in (1, 4)],
    "mu = lam [Pa]": [(f"{m:g}", {"mu": m, "lam": m}) for m in (1e3, 1e4, 1e5, 1e6)],
    "time step [s]": [(f"{h:.3g}", {"time_step": h}) for h in (1e-2, 1 / 60)],
    "motion, times the preset's": [(f"{a:g}", {"amount": a}) for a in (1e-4, 1e-3, 1e-2, 1e-1, 1.0)],
}


def axes(quick: bool, device: str) -> list[Row]:
    """Error of the two exact routes along each axis that the paper names, at the K that is worst for ours."""
    rows = []
    for axis, values in AXES.items():
        for label, change in values[:1] if quick else values:
            scene = build(replace(PRESET, **change), device)
            rows.append({"axis": axis, "value": label, "mesh": scene.name, **_worst_over_sweeps(scene, quick)})
    return rows


def _worst_over_sweeps(scene: Scene, quick: bool) -> Row:
    """Error, and the bar that the scene's own conditioning sets, at the K whose error is largest."""
    found = []
    for k in SWEEPS[:1] if quick else SWEEPS:
        expected = expected_of(scene, k)
        got, other = (result_of(scene, k, adjoint_of(route)) for route in (OURS, UNROLLED))
        h = scene.case.time_step
        forward = max(verified_forward(g, expected, h, r) for g, r in ((got, OURS), (other, UNROLLED)))
        here = scene.to("cpu")
        options = here.options(k)
        inputs = {"x": here.x, "v": here.v, **{name: options[name] for name in ("mu", "lam", "gravity")}}
        spreads = testing.spread(here.model, inputs, options["solver"], scene.case.steps)
        spread = max(spreads[f"grad_{name}"] for name in "xv")
        found.append({"sweeps": k, "forward": forward, "error": gradient_error(got, expected),
                      "unrolled_error": gradient_error(other, expected), "spread": spread, "bar": scaled_bar(spread),
                      "update": _largest_update(scene)})  # fmt: skip
    return max(found, key=lambda row: row["error"])


def scaled_bar(spread: float) -> float:
    """Largest error that the conditioning of a scene excuses."""
    return max(testing.tolerance("headline"), testing.tolerance("spread_factor") * spread)


def _largest_update(scene: Scene) -> float:
    """Longest way of a vertex in the first sweep [m]."""
    with torch.no_grad():
        ends = [dv.rollout(scene.model, scene.x, scene.v, **scene.options(k) | {"steps": 1}).x[-1] for k in (0, 1)]
    return float((ends[1] - ends[0]).norm(dim=-1).max())


# --- tables -----------------------------------------------------------------------------------------------------------


def theirs(route: str) -> Callable[[Row], Any]:
    return lambda row: paper.EXACTNESS.get(row["sweeps"], {}).get(route)


ERRORS: dict[str, Any] = {route: f"routes/{route}/error" for route in ROUTES}
ITERATIONS: dict[str, Any] = {f"iterations, {route}": f"routes/{route}/iterations" for route in GLOBAL}
RESIDUALS: dict[str, Any] = {"K": "sweeps", "residual [kg m]": "residual", "relative": "relative_residual"}
TABLES = (
    Table("Gradient error of each route, the {} scene", "scenes/*",
          {**RESIDUALS, **ERRORS, **ITERATIONS, "the two global routes differ by": "global_difference"}),
    Table("The paper's figures for its scene, beside the preset's", "scenes/preset",
          {"K": "sweeps", "residual, paper": theirs("residual"), "residual": "residual",
           **{f"{route}{who}": of for route in (OURS, *GLOBAL)
              for who, of in ((", paper", theirs(route)), ("", ERRORS[route]))}}),
    Table("The preset scene on other meshes", "meshes", {"mesh": "mesh", **RESIDUALS, **ERRORS, **ITERATIONS}),
    Table("The exact routes along the axes of the paper", "axes",
          {"axis": "axis", "value": "value", "mesh": "mesh", "largest first update [m]": "update", "K": "sweeps",
           OURS: "error", UNROLLED: "unrolled_error", "spread": "spread", "bar": "bar"},
          note=f"One thing is changed at a time; each row is the K with the largest error. The paper's worst error: "
               f"{paper.WORST_OF_ALL_AXES:.1e}."),
)  # fmt: skip
