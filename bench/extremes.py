"""Extreme inputs: is a step finite, does it descend, does its gradient match; are features of no use without a word?

Elastic cases: the gradient is held against the bar of the exactness tests, max(1e-12, 10 x spread), where spread is the
disagreement of two references with permuted tets. Beyond the bar the conditioning decides: how far the reference's
gradient moves when every input moves by one rounding of its largest entry. An error of that size says that the gradient
has no more digits to give; one beyond it is a fault. Long rollouts: the gradient is held against central differences.

Features: rollouts of 20 steps with coarse corrections, integrators, floors, colliders, pairs and friction, each over
the extremes of `AXES`. Nothing drives them but gravity, so none may gain energy. A case is *silent* where its end is of
no use - not finite, with more than 5 % more energy, a gradient that is not finite - and nothing was raised and nothing
warned of. The gradient of a loss of the end, along a random direction of velocity and stiffness, is held against
central differences.
"""

from __future__ import annotations

import itertools
import math
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

import diffvbd as dv
from bench.measure import Card
from bench.tables import Table, count, median, most
from diffvbd import mesh, reference, results, testing

EPS = float(np.finfo(np.float64).eps)
NO_DIGITS = 0.01  # conditioning beyond which a gradient has no digits to compare
RISE = 64.0  # roundings of the potential's own terms below which a rise counts as none


@dataclass(frozen=True)
class Extreme:
    """One extreme. Lengths scale with `size`; everything else is absolute."""

    axis: str  # the claim that the case belongs to
    name: str
    size: float = 1.0  # [m] edge of the cube
    cells: int = 2
    mesh: str = "cube"  # cube, layer (one layer of thickness `sliver`), sliver (an almost flat tet)
    sliver: float = 1e-3
    mu: float = 1e5  # [Pa]
    lam: float = 1.5e5  # [Pa]
    contrast: float = 1.0  # stiffness of one half of the body over the other's
    density: float = 1e3  # [kg/m^3]
    mass_contrast: float = 1.0
    time_step: float = 1 / 60  # [s]
    sweeps: int = 5
    steps: int = 1
    state: str = "jitter"
    jitter: float = 0.05  # of a cell
    stretch: float = 1.0  # of the far scattered state
    speed: float = 0.1  # [size/s]
    pinned: bool = True
    block: str = "exact"
    relaxation: float = 1.0
    saturation: float | None = None
    regularization: float = 0.0
    floor: bool = False
    quick: bool = False

    @property
    def solver(self) -> dv.VBD:
        return dv.VBD(self.time_step, self.sweeps, block=self.block, relaxation=self.relaxation,
                      saturation=self.saturation, regularization=self.regularization)  # fmt: skip

    @property
    def must_descend(self) -> bool:
        """The exact block minimises in its vertex; other blocks and barriers do not promise it."""
        return self.block == "exact" and not self.floor


def _materials() -> Iterator[Extreme]:
    """All decades of mu, lam / mu and h; moduli stay below 1e12 Pa."""
    decades, ratios, times = (1e-2, 1.0, 1e2, 1e4, 1e6, 1e8, 1e10, 1e12), (0, 1, 1e3, 1e6), (1e-6, 1e-3, 1 / 60, 1)
    for mu, ratio, h in itertools.product(decades, ratios, times):
        if mu * ratio <= 1e12:
            quick = mu in (1e-2, 1e6, 1e12) and ratio in (0, 1e6, 1) and h in (1e-6, 1)
            name = f"mu {mu:g}, lam/mu {ratio:g}, h {h:.3g}"
            yield Extreme("mu, lam, lam/mu, h", name, mu=mu, lam=mu * ratio, time_step=h, quick=quick)
    for mu, lam in ((0.0, 1e-2), (0.0, 1e12), (0.0, 0.0), (1e5, -1e5), (1e5, -0.6e5)):
        yield Extreme("mu = 0, lam < 0", f"mu {mu:g}, lam {lam:g}", mu=mu, lam=lam, quick=lam <= 0)


SAFE: dict[str, Any] = {"saturation": 0.1, "regularization": 1e-6}


def _cases() -> Iterator[Extreme]:
    yield from _materials()
    for c in (1e2, 1e4, 1e6):
        yield (soft := Extreme("stiffness contrast", f"{c:g}", contrast=c, mu=1e3, lam=1e3, quick=c == 1e6))
        yield replace(soft, name=f"{c:g}, K = 50", sweeps=50, quick=False)
    for size, density in itertools.product((1e-6, 1e-3, 1e3, 1e4), (1e-3, 1e5)):
        name = f"{size:g} m, {density:g} kg/m^3"
        yield Extreme("size, density", name, size=size, density=density, quick=size in (1e-6, 1e4))
        yield Extreme("size, density", f"{name}, paper preset", size=size, density=density, block="paper", **SAFE)
    for m in (1e2, 1e4, 1e8):
        yield Extreme("mass ratio", f"{m:g}", mass_contrast=m, density=1e-3, quick=m == 1e8)
        yield Extreme("mass ratio", f"{m:g}, soft", mass_contrast=m, density=1e-3, mu=10, lam=10)
    for thin in (1e-3, 1e-6, 1e-9):
        yield Extreme("slivers", f"layer of {thin:g}", mesh="layer", sliver=thin, quick=thin == 1e-6)
        yield Extreme("slivers", f"flat tet of {thin:g}", mesh="sliver", sliver=thin, pinned=False, quick=thin == 1e-6)
    for state in ("mirrored", "flat", "line", "point", "half", "scattered"):
        yield Extreme("inverted, collapsed", f"{state}, exact", state=state, quick=True)
        yield Extreme("inverted, collapsed", f"{state}, paper", state=state, block="paper", **SAFE)
        yield Extreme("inverted, collapsed", f"{state}, free", state=state, pinned=False, sweeps=20)
    for far, k in itertools.product((10.0, 1e2, 1e3, 1e4, 1e5, 1e6), (1, 20)):
        yield Extreme("huge strain", f"{far:g}, K = {k}", state="far scattered", stretch=far, sweeps=k, pinned=False)
    for k in (0, 1, 20, 100, 1000):
        yield Extreme("sweeps", f"K = {k}", sweeps=k, cells=1 if k == 1000 else 2, mu=1e7, lam=1e7, quick=k <= 20)
    for omega, state in itertools.product((0.1, 1.5, 1.7, 1.9, 1.99), ("jitter", "mirrored", "scattered")):
        yield Extreme("relaxation", f"{omega}, {state}", relaxation=omega, state=state, sweeps=10, quick=omega == 1.9)
    for speed in (1.0, 1e2, 1e4):
        falling = Extreme("floor", f"fall at {speed:g} m/s", floor=True, pinned=False, speed=speed, state="falling")
        yield replace(falling, quick=speed == 1e4)
        yield replace(falling, name=f"{falling.name}, 4 steps", steps=4)
    for k, n in ((1, 20), (5, 4)):
        yield Extreme("steps", f"{n} steps, K = {k}", sweeps=k, steps=n, quick=n == 4)


CASES = list(_cases())


@dataclass(frozen=True)
class Rollout:
    """A long rollout on a small mesh; its gradient is held against central differences."""

    name: str
    steps: int
    block: str = "exact"
    relaxation: float = 1.0
    sweeps: int = 5
    floor: bool = False


ROLLOUTS = [
    Rollout("cantilever", 10_000),
    Rollout("cantilever, relaxation 1.6", 10_000, relaxation=1.6),
    Rollout("cantilever, one sweep", 10_000, sweeps=1),
    Rollout("paper preset", 10_000, block="paper"),
    Rollout("drop onto a floor", 10_000, floor=True),
]


def build(case: Extreme) -> tuple[dv.Model, dict[str, Any]]:
    """Model and inputs of a case, as `testing.evaluate` takes them."""
    rng = testing.generator(case.axis, case.name)
    points, tets = _mesh(case)
    mesh = dv.TetMesh(points * case.size, tets)
    points = torch.from_numpy(mesh.points.copy())
    half = torch.from_numpy(mesh.points[mesh.tets].mean(1)[:, 1] > 0.5 * case.size)
    energies: tuple[Any, ...] = (dv.StableNeoHookean(),)
    if case.floor:
        energies += (dv.FloorBarrier(height=-0.05 * case.size, kappa=1e4, dhat=0.04 * case.size, damping=10.0),)
    model = dv.Model(mesh, density=of_halves(half, case.density, case.mass_contrast), energies=energies,
                     pinned=mesh.points[:, 0] < 1e-9 * case.size if case.pinned else None)  # fmt: skip
    stiff = of_halves(half, 1.0, case.contrast)
    noise = torch.from_numpy(rng.uniform(-1, 1, (2, *mesh.points.shape)))
    x = _state(case, points, noise[0])
    v = case.size * case.speed * noise[1]
    if case.state == "falling":
        v = case.speed * torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64) + 0.01 * case.speed * noise[1]
    x = torch.where(model.pinned[:, None], points, x)
    inputs: dict[str, Any] = {"x": x, "v": v, "mu": case.mu * stiff, "lam": case.lam * stiff, "density": model.density,
                              "rest_points": points, "force": 0.1 * model.mass[:, None] * noise[1],
                              "gravity": torch.tensor([0.0, -9.81, 0.0], dtype=torch.float64)}  # fmt: skip
    return model, inputs


def of_halves(half: Tensor, value: float, contrast: float) -> Tensor:
    """A value of each tet, of one half of the body so many times as large."""
    return torch.where(half, value * contrast, value).to(torch.float64)


def _mesh(case: Extreme) -> tuple[np.ndarray, np.ndarray]:
    if case.mesh == "sliver":
        d = case.sliver
        points = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, d], [0, -1, d], [0, 0, 2.0]]) / 2
        return points, np.array([[0, 1, 2, 3], [0, 1, 2, 4]])[:, [0, 2, 1, 3]][[0, 1]]
    points, tets = testing.structured((case.cells,) * 3)
    if case.mesh == "layer":
        points[np.isclose(points[:, 1], 0.5), 1] = 1 - case.sliver
    return points, tets


def _state(case: Extreme, points: Tensor, noise: Tensor) -> Tensor:
    cell = case.size / case.cells
    x = points + case.jitter * cell * noise * (case.sliver if case.mesh != "cube" else 1.0)
    along_x, along_y, _ = torch.eye(3, dtype=points.dtype)
    return {
        "jitter": x,
        "falling": x,
        "mirrored": points * (1 - 2 * along_x),
        "flat": points * (1 - along_y),
        "line": points * along_x,
        "point": torch.zeros_like(points),
        "half": 0.3 * points,
        "scattered": points + 2 * case.size * noise,
        "far scattered": case.stretch * case.size * noise,
    }[case.state]


def check(case: Extreme) -> dict[str, Any]:
    """Finite, monotone and gradient figures of one case."""
    model, inputs = build(case)

    def run(**options: Any) -> tuple[Tensor, Tensor]:
        trajectory = dv.rollout(model, solver=case.solver, steps=case.steps, save="last", **options)
        return trajectory.x[-1], trajectory.v[-1]

    expected = testing.reference_result(model, inputs, case.solver, case.steps)
    spread = testing.spread(model, inputs, case.solver, case.steps, expected)
    got = testing.evaluate(run, inputs, case.time_step)
    errors = {k: testing.relative_error(got[k], expected[k]) for k in got if k.startswith("grad_")}
    margin = {k: errors[k] / testing.bar(spread[k]) for k in errors}
    condition = dict.fromkeys(errors, 0.0)
    # one perturbation underestimates the worst by chance: beyond the bar more are tried
    for seed in range(1 if all(m <= 1 for m in margin.values()) else 8):
        rounded = testing.reference_result(model, _rounded(inputs, seed), case.solver, case.steps)
        condition = {k: max(c, testing.relative_error(rounded[k], expected[k])) for k, c in condition.items()}
    beyond = {k: errors[k] / max(testing.bar(spread[k]), 10 * condition[k]) for k in errors}
    worst = max(margin, key=lambda k: margin[k] if math.isfinite(margin[k]) else math.inf)
    return {
        **{k: v for k, v in asdict(case).items() if k != "quick"},
        "finite": all(bool(torch.isfinite(t).all()) for t in got.values()),
        "reference_finite": all(bool(torch.isfinite(t).all()) for t in expected.values()),
        "forward_error": testing.relative_error(got["x"], expected["x"]),
        "rise": potential_rise(case, model, inputs),
        "must_descend": case.must_descend,
        "gradient_error": float(np.max(list(errors.values()))),
        "spread": max(spread[k] for k in errors),
        "condition": max(condition.values()),
        "worst_argument": worst.removeprefix("grad_"),
        "error_over_bar": margin[worst],
        "error_over_condition": max(beyond.values()),
    }


def _rounded(inputs: dict[str, Any], seed: int) -> dict[str, Any]:
    """Inputs whose entries have moved up or down by one rounding of the largest entry of their tensor."""
    rng = testing.generator("rounded", seed)
    signs = {
        k: torch.from_numpy(rng.choice([-1.0, 1.0], tuple(t.shape))) for k, t in inputs.items() if torch.is_tensor(t)
    }
    return {k: t + EPS * float(t.abs().max()) * signs[k] if k in signs else t for k, t in inputs.items()}


def potential_rise(case: Extreme, model: dv.Model, inputs: dict[str, Any]) -> float:
    """Largest rise of the incremental potential from one sweep to the next, in roundings of its terms; without rigid
    corrections, since how much the last one takes off differs from one number of sweeps to the next."""
    options = {k: inputs[k] for k in ("mu", "lam", "force", "gravity")}
    counts = [k for k in (*range(11), 12, 15, 20, 35, 50, 75, 100, 200, 500, 1000) if k <= max(case.sweeps, 5)]
    x, v, h = inputs["x"], inputs["v"], case.time_step
    y = x + h * v + h**2 * (options["gravity"] + options["force"] / model.mass[:, None])
    y = torch.where(model.pinned[:, None], x, y)
    rise, last = 0.0, math.inf
    for k in counts:
        with torch.no_grad():
            at, _ = dv.step(model, x, v, replace(case.solver, sweeps=k, subspace=None), **options)
            value = float(reference.incremental_potential(model, at, y, options["mu"], options["lam"], h, x))
        if not math.isfinite(value):
            return math.inf
        terms = _rounding_scale(model, at, y, options["mu"], options["lam"], h)
        rise = max(rise, (value - last) / (EPS * terms)) if terms > 0 else rise
        last = value
    return rise


def _rounding_scale(model: dv.Model, x: Tensor, y: Tensor, mu: Tensor, lam: Tensor, h: float) -> float:
    """What an error of one eps in positions and sums changes in the potential: the sum of its terms' magnitudes."""
    at_rest, now = (p[model.tets] for p in (model.rest_points, x))
    dm, ds = (torch.stack([p[:, k] - p[:, 0] for k in (1, 2, 3)], -1) for p in (at_rest, now))
    volume = torch.linalg.det(dm) / 6
    f = ds @ torch.linalg.inv(dm)
    size, j = f.square().sum((-2, -1)), torch.linalg.det(f)
    # entries of F carry the rounding of positions, enlarged where rest tets are flat
    enlarged = torch.linalg.norm(torch.linalg.inv(dm), dim=(-2, -1)) * now.abs().amax((-2, -1)) + size.sqrt()
    stress = mu * size.sqrt() + ((mu + lam) * (j - 1).abs() + mu) * size
    elastic = volume * (stress * enlarged + mu * (size + 3) + (mu + lam) * (j - 1) ** 2)
    inertia = model.mass * ((x - y).norm(dim=-1) * (x.norm(dim=-1) + y.norm(dim=-1)))
    return float(inertia.sum() + h**2 * elastic.sum())


def check_rollout(case: Rollout) -> dict[str, Any]:
    mesh = dv.mesh.beam(4, 2, 2, size=(0.3, 0.1, 0.1), split="kuhn")
    floor = (dv.FloorBarrier(height=-0.2, kappa=1e4, damping=1.0),) if case.floor else ()
    make = dv.VBD.paper if case.block == "paper" else dv.VBD
    solver = make(1 / 60, case.sweeps, relaxation=case.relaxation)
    pinned = None if case.floor else mesh.points[:, 0] < 1e-9
    model = dv.Model(mesh, pinned=pinned, energies=(dv.StableNeoHookean(), *floor))
    x, v = model.rest_points.clone(), torch.zeros_like(model.rest_points)
    weights = torch.from_numpy(testing.generator("rollout").standard_normal(tuple(x.shape)))
    lowest: list[float] = []

    def loss(scale: Tensor) -> Tensor:
        trajectory = dv.rollout(model, x, v, solver, steps=case.steps, mu=1e5 * scale, lam=1.5e5 * scale, save="last")
        lowest.append(float(trajectory.x[-1][:, 1].detach().min()))
        return (weights * trajectory.x[-1]).sum()

    scale = torch.ones((), dtype=torch.float64, requires_grad=True)
    value = loss(scale)
    (gradient,) = torch.autograd.grad(value, scale)
    off = difference_error(loss, scale, float(gradient), (1e-3, 1e-4, 1e-5))
    finite = bool(torch.isfinite(value)) and bool(torch.isfinite(gradient))
    return {**asdict(case), "finite": finite, "gradient": float(gradient), "difference_error": off,
            "lowest": min(lowest)}  # fmt: skip


def difference_error(loss: Callable[[Tensor], Tensor], at: Tensor, slope: float, steps: Sequence[float]) -> float:
    """Relative error of a slope against central differences, the least over their steps."""
    with torch.no_grad():
        found = [float(loss(at + d) - loss(at - d)) / (2 * d) for d in steps]
    return min(abs(f - slope) / max(abs(slope), 1e-300) for f in found)


def verdict(row: dict[str, Any]) -> str:
    """One of "ok", "conditioning" (beyond the bar but not beyond that), "no digits" (nothing to compare), "fault"."""
    if row["condition"] > NO_DIGITS:
        return "no digits"
    if not row["finite"] or (row["must_descend"] and row["rise"] > RISE):
        return "fault"
    if row["error_over_bar"] <= 1:
        return "ok"
    return "conditioning" if row["error_over_condition"] <= 1 else "fault"


GAIN = 0.05  # share of the energy that came in, beyond which a result counts as useless
DIFFERENCES = (1e-5, 1e-7)  # relative steps of central differences; the best one counts
ALIKE = 1e-3  # error against differences below which a gradient counts as matching them
GRAVITY = 9.81


@dataclass(frozen=True)
class Case:
    """A rollout. Lengths scale with `size`; everything else is absolute."""

    feature: str = ""
    axis: str = "none"
    size: float = 0.4  # [m] length of the scene
    mu: float = 1e5  # [Pa]
    poisson: float = 0.3
    contrast: float = 1.0  # stiffness of one half of each body over the other's
    density: float = 1e3  # [kg/m^3]
    mass_contrast: float = 1.0
    time_step: float = 1e-2  # [s]
    speed: float = 1.0  # [m/s]
    sweeps: int = 10
    steps: int = 20
    single: bool = False  # float32
    sliver: float = 0.0  # thickness of a layer of tets over that of the others; 0: none


AXES: dict[str, dict[str, Any]] = {
    "none": {},
    "mu 1e2 Pa": {"mu": 1e2},
    "mu 1e10 Pa": {"mu": 1e10},
    "mu 1e10 Pa, K = 1": {"mu": 1e10, "sweeps": 1},
    "contrast 1e6": {"mu": 1e4, "contrast": 1e6},
    "nu 0.4999": {"poisson": 0.4999},
    "h 1e-5 s": {"time_step": 1e-5},
    "h 1 s": {"time_step": 1.0},
    "h 1 s, K = 1": {"time_step": 1.0, "sweeps": 1},
    "size 1e-4 m": {"size": 1e-4, "speed": 2.5e-4},
    "size 1e3 m": {"size": 1e3, "speed": 2.5e3},
    "0.01 m/s": {"speed": 0.01},
    "1000 m/s": {"speed": 1e3},
    "1000 m/s, K = 1": {"speed": 1e3, "sweeps": 1},
    "density 1 kg/m^3": {"density": 1.0},
    "density 1e5 kg/m^3": {"density": 1e5},
    "K = 1": {"sweeps": 1},
    "K = 100": {"sweeps": 100},
    "float32": {"single": True},
    "float32, mu 1e10 Pa": {"single": True, "mu": 1e10},
    "float32, 1000 m/s": {"single": True, "speed": 1e3},
    "float32, size 1e-4 m": {"single": True, "size": 1e-4, "speed": 2.5e-4},
    "float32, size 1e3 m": {"single": True, "size": 1e3, "speed": 2.5e3},
    "slivers 1e-3": {"sliver": 1e-3},
    "mass contrast 1e6": {"mass_contrast": 1e6, "density": 1.0},
}
QUICK_AXES = ("none", "mu 1e10 Pa, K = 1", "1000 m/s", "float32, size 1e-4 m")

# scene, friction, options of the solver
FEATURES: dict[str, tuple[str, float, dict[str, Any]]] = {
    "plain, pinned": ("pinned", 0.0, {}),
    "plain, free": ("free", 0.0, {}),
    "coarse, pinned": ("pinned", 0.0, {"subspace": "coarse"}),
    "coarse, free": ("free", 0.0, {"subspace": "coarse", "relaxation": 1.5}),
    "SDIRK2, pinned": ("pinned", 0.0, {"integrator": dv.SDIRK2()}),
    "SDIRK2, free": ("free", 0.0, {"integrator": dv.SDIRK2()}),
    "BDF2, pinned": ("pinned", 0.0, {"integrator": dv.BDF2()}),
    "BDF2, free": ("free", 0.0, {"integrator": dv.BDF2()}),
    "floor": ("floor", 0.0, {}),
    "floor, friction": ("floor", 0.5, {}),
    "floor, coarse, BDF2": ("floor", 0.0, {"subspace": "coarse", "integrator": dv.BDF2()}),
    "plane": ("plane", 0.0, {}),
    "plane, friction": ("plane", 0.5, {}),
    "sphere, friction": ("sphere", 0.5, {}),
    "pairs": ("pairs", 0.0, {}),
    "pairs, friction": ("pairs", 0.5, {}),
    "pairs, friction, coarse": ("pairs", 0.5, {"subspace": "coarse"}),
    "pairs, SDIRK2": ("pairs", 0.0, {"integrator": dv.SDIRK2()}),
    "pairs, BDF2": ("pairs", 0.0, {"integrator": dv.BDF2()}),
    "self-contact": ("horseshoe", 0.0, {}),
    "self-contact, friction, coarse": ("horseshoe", 0.5, {"subspace": "coarse"}),
}  # fmt: skip

FEATURE_CASES = [replace(Case(), feature=f, axis=a, **given) for f in FEATURES for a, given in AXES.items()]


# --- scenes -----------------------------------------------------------------------------------------------------------


def bodies(case: Case) -> dv.TetMesh:
    """Of length 1: a bar, a block above y = 0, two of them above each other, or a horseshoe that opens upwards."""
    kind = FEATURES[case.feature][0]
    if kind in ("pinned", "free"):
        return _with_slivers(mesh.box((6, 3, 3), (1.0, 0.3, 0.3), split="kuhn"), case.sliver)
    block = _with_slivers(mesh.box(3, 0.4, split="kuhn"), case.sliver)
    if kind == "pairs":
        return mesh.join([block, block.translate((0.07, 0.5, 0.04))])
    if kind == "horseshoe":
        whole = mesh.box((6, 4, 2), (1.0, 0.6, 0.2), split="kuhn")
        center = whole.points[whole.tets].mean(1)
        tets = whole.tets[(np.abs(center[:, 0] - 0.5) > 0.1) | (center[:, 1] < 0.2)]
        used, numbers = np.unique(tets, return_inverse=True)
        return _with_slivers(dv.TetMesh(whole.points[used], numbers.reshape(-1, 4)), case.sliver)
    return block.translate((0.0, 0.1, 0.0))


def _with_slivers(body: dv.TetMesh, thickness: float) -> dv.TetMesh:
    """The lowest inner layer of points moved down to just above the layer below."""
    if not thickness:
        return body
    points = body.points.copy()
    levels = np.unique(points[:, 1].round(9))
    points[np.isclose(points[:, 1], levels[1]), 1] = levels[0] + thickness * (levels[1] - levels[0])
    return dv.TetMesh(points, body.tets, body.body)


def build_feature(case: Case) -> tuple[dv.Model, Tensor, Tensor, dict[str, Any]]:
    """Model, state, and the material of each tet."""
    kind, friction, _ = FEATURES[case.feature]
    tets = bodies(case)
    scaled = tets.transform(case.size * np.eye(3))
    upper = np.array(tets.points[tets.tets].mean(1)[:, 0] > 0.5 * np.ptp(tets.points[:, 0]))
    half, size = torch.from_numpy(upper), case.size
    energies: list[Any] = [dv.StableNeoHookean()]
    # about as stiff as the softer half
    barrier: dict[str, Any] = {"kappa": case.mu * size, "dhat": 0.05 * size}
    if kind == "floor":
        energies.append(dv.FloorBarrier(**barrier))
    if kind in ("plane", "sphere", "pairs", "horseshoe"):
        energies.append(dv.PairBarrier(**barrier, self_contact=kind == "horseshoe"))
    under = {"plane": dv.colliders.Plane(),
             "sphere": dv.colliders.Sphere((0.2 * size, -0.5 * size, 0.2 * size), 0.5 * size)}  # fmt: skip
    colliders = (under[kind],) if kind in under else ()
    if friction:
        energies.append(dv.Friction(friction, velocity=0.01 * case.speed))
    pinned = np.isclose(tets.points[:, 0], 0.0) if kind == "pinned" else None
    dtype = torch.float32 if case.single else torch.float64
    density = of_halves(half, case.density, case.mass_contrast).to(dtype)
    model = dv.Model(scaled, density, pinned, energies, colliders=colliders, dtype=dtype)
    stiffness = torch.where(half, case.contrast, 1.0).to(dtype) * case.mu
    lam = stiffness * (2 * case.poisson / (1 - 2 * case.poisson))
    points = torch.from_numpy(tets.points.copy()).to(dtype)
    return model, model.rest_points.clone(), case.speed * _motion(kind, points, tets), {"mu": stiffness, "lam": lam}


def _motion(kind: str, points: Tensor, tets: dv.TetMesh) -> Tensor:
    """Velocities of about 1 m/s."""
    v = torch.zeros_like(points)
    if kind in ("pinned", "free"):
        v[:, 1], v[:, 2] = points[:, 0].square(), 0.3 * points[:, 0]
    elif kind == "pairs":
        v[:, 1] = torch.where(torch.from_numpy(np.asarray(tets.body) == 1), -1.0, 0.0)
        v[:, 0] = 0.2 * points[:, 1]
    elif kind == "horseshoe":  # its legs go to each other
        v[:, 0] = -torch.sign(points[:, 0] - 0.5) * points[:, 1] / 0.6
    else:
        v[:, 0], v[:, 1] = 0.5, -1.0
    return v


# --- what is looked at ------------------------------------------------------------------------------------------------


def check_feature(case: Case) -> dict[str, Any]:
    """All figures of one case."""
    row: dict[str, Any] = {"feature": case.feature, "axis": case.axis, "raised": "", "warned": ""}
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        try:
            row |= _run(case)
        except (ValueError, RuntimeError) as error:
            row |= {"raised": str(error).split("\n")[0][:200], "finite": False, "gain": math.nan,
                    "gradient_finite": False}  # fmt: skip
    row["warned"] = ", ".join(sorted({str(w.message).split(":")[0] for w in found}))
    row["useless"] = not row["finite"] or not row["gain"] <= GAIN or not row["gradient_finite"]
    row["silent"] = row["useless"] and not row["raised"] and not row["warned"]
    return row


def _run(case: Case) -> dict[str, Any]:
    model, x, v, material = build_feature(case)
    solver = dv.VBD(case.time_step, case.sweeps, **FEATURES[case.feature][2])
    options: dict[str, Any] = {"steps": case.steps, "solver": solver}
    begun = time.perf_counter()
    with torch.no_grad():
        motion = dv.rollout(model, x, v, **options, **material)  # type: ignore[arg-type]
    seconds = time.perf_counter() - begun
    finite = bool(torch.isfinite(motion.x).all()) and bool(torch.isfinite(motion.v).all())
    row: dict[str, Any] = {"finite": finite, "seconds": seconds, "gain": math.nan}
    if finite:
        corners = motion.x[-1][model.tets].to(torch.float64)
        volumes = torch.linalg.det(corners[:, 1:] - corners[:, :1])
        row |= {"gain": gained(case, motion, material), "inverted": int((volumes < 0).sum()),
                "crossings": _crossings(case, model, motion)}  # fmt: skip
    return row | _gradient(case, model, x, v, material, options)


def gained(case: Case, motion: results.Trajectory, material: dict[str, Tensor]) -> float:
    """Most energy of a frame beyond that of the first, over what the scene had and what gravity did; barriers, which
    hold none at the start and are never negative, left out."""
    double = build_feature(replace(case, single=False))[0]
    body = dv.Model(double.mesh, density=double._density, energies=(dv.StableNeoHookean(),))
    x, v = motion.x.to(torch.float64), motion.v.to(torch.float64)
    mu, lam = (material[k].to(torch.float64) for k in ("mu", "lam"))
    elastic = torch.stack([reference.incremental_potential(body, a, a, mu, lam, 1.0) for a in x])
    mass = body.mass[:, None]
    moving = 0.5 * (mass * v.square()).sum((-1, -2))
    fallen = GRAVITY * (mass[:, 0] * x[..., 1]).sum(-1)
    fallen = fallen - fallen[0]
    scale = moving[0] + elastic[0] + GRAVITY * mass.sum() * case.size + fallen.abs().max()
    if motion.x.dtype == torch.float32:  # energy that rounding of positions alone is worth
        scale = scale + elastic[0]
    return float(((moving + elastic + fallen).max() - moving[0] - elastic[0]) / scale)


def _crossings(case: Case, model: dv.Model, motion: results.Trajectory) -> int:
    """Edges through triangles at the end, and vertices of the surface at or below the floor or plane."""
    kind = FEATURES[case.feature][0]
    end = motion.x[-1]
    if kind in ("floor", "plane"):
        return int((end[np.unique(model.mesh.surface), 1] <= 0).sum())
    if kind not in ("pairs", "horseshoe"):
        return 0
    found = dv.contact.intersections(model, end)
    if kind == "horseshoe":
        return len(found)
    surface = model.surface_of_contact
    assert surface is not None
    # of bodies without self-contact, edges through another body
    body = model.body.cpu()
    return int((body[surface.edges[found[:, 1], 0].long()] != body[surface.triangles[found[:, 2], 0].long()]).sum())


def _gradient(case: Case, model: dv.Model, x: Tensor, v: Tensor, material: dict[str, Tensor],
              options: dict[str, Any]) -> dict[str, Any]:  # fmt: skip
    """Whether the gradient is finite, and its error against differences along one direction (None in float32)."""
    random = testing.generator("features", case.feature)
    weights, way = (torch.from_numpy(random.standard_normal(tuple(x.shape))).to(x) for _ in range(2))
    way = case.speed * torch.where(model.pinned[:, None], 0.0, way)

    def loss(s: Tensor) -> Tensor:
        given: dict[str, Any] = {k: m * (1 + s) for k, m in material.items()}
        end = dv.rollout(
            model, x, v + s * way, **options, **given, save="last", checks=dv.Checks(contact=False, energy=False)
        )
        return (weights * (end.x[-1] - x)).sum() / case.size

    at = torch.zeros((), dtype=x.dtype, requires_grad=True)
    value = loss(at)
    (slope,) = torch.autograd.grad(value, at)
    row: dict[str, Any] = {"gradient_finite": bool(torch.isfinite(slope)), "gradient": float(slope), "difference": None}
    if case.single or not row["gradient_finite"]:
        return row
    return row | {"difference": difference_error(loss, at, float(slope), DIFFERENCES)}


def gradient_verdict(row: dict[str, Any]) -> str:
    """Of the gradient: "alike", "kink" (finite, and not as differences have it), "not finite", "-" (not compared)."""
    if row["raised"] or row.get("difference") is None and row.get("gradient_finite"):
        return "-"
    if not row["gradient_finite"]:
        return "not finite"
    return "alike" if row["difference"] <= ALIKE else "kink"


# --- groups and tables ------------------------------------------------------------------------------------------------


def long_rollouts(card: Card) -> list[dict[str, Any]]:
    few = [Rollout("cantilever", 300), Rollout("drop onto a floor", 300, floor=True)]
    return [check_rollout(case) for case in (few if card.quick else ROLLOUTS)]


def is_fault(row: dict[str, Any]) -> bool:
    return verdict(row) == "fault"


THREADS = 1
GROUPS: dict[str, Callable[[Card], list[dict[str, Any]]]] = {
    "elastic": lambda card: [check(case) for case in CASES if case.quick or not card.quick],
    "rollouts": long_rollouts,
    "features": lambda card: [check_feature(c) for c in FEATURE_CASES if c.axis in QUICK_AXES or not card.quick],
}
WORST = ("axis", "name", "gradient_error", "spread", "condition", "forward_error", "worst_argument", "finite", "rise")
FEATURE = ("feature", "axis", "finite", "gain", "inverted", "crossings", "gradient_finite", "difference", "warned",
           "raised")  # fmt: skip
OF_FEATURES: dict[str, Any] = {
    "cases": count(), "finite": count("finite"), "raised": count("raised"),
    "gain > 5 %": count(lambda row: row["finite"] and row["gain"] > GAIN), "silent": count("silent"),
    "crossings": count("crossings"), "inverted tets": count("inverted"), "gradient finite": count("gradient_finite"),
    "gradient as differences": count(lambda row: gradient_verdict(row) == "alike"),
    "not": count(lambda row: gradient_verdict(row) == "kink"),
}  # fmt: skip
TABLES = (
    Table("Elastic cases", "elastic",
          {"cases": count(), "finite": count("finite"), "must descend": count("must_descend"),
           "of these rise": count(lambda row: row["must_descend"] and row["rise"] > RISE),
           "gradient within bar": count(lambda row: row["error_over_bar"] <= 1), "faults": count(is_fault),
           "median gradient error": median("gradient_error"), "largest": most("gradient_error"),
           "largest conditioning": most("condition")}, by="axis"),
    Table("Faults", "elastic", WORST, only=is_fault),
    Table("Beyond the bar, within the conditioning", "elastic", WORST, only=lambda row: verdict(row) == "conditioning"),
    Table("No digits left in double precision", "elastic", WORST, only=lambda row: verdict(row) == "no digits"),
    Table("Long rollouts", "rollouts", ("name", "steps", "sweeps", "finite", "difference_error")),
    Table("Features", "features", OF_FEATURES, by="feature"),
    Table("Features by extreme", "features", OF_FEATURES, by="axis"),
    Table("Of no use, and nothing said", "features", FEATURE, only=lambda row: row["silent"]),
    Table("Crossings", "features", FEATURE, only=lambda row: row.get("crossings")),
    Table("Gradients unlike differences", "features", FEATURE,
          only=lambda row: gradient_verdict(row) in ("kink", "not finite")),
)  # fmt: skip
