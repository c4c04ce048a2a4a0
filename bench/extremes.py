"""Extreme inputs: is a step finite, does it descend, does its gradient match autograd through the reference?

Every case is one row of `CASES`. The gradient is held against the bar of the exactness tests, max(1e-12, 10 x spread),
where spread is the disagreement of two references with permuted tets. Beyond the bar the conditioning decides: how far
the reference's gradient moves when every input moves by one rounding of its largest entry. An error of that size says
that the gradient has no more digits to give; one beyond it is a fault.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

import diffvbd as dv
from bench.common import markdown_table
from diffvbd import reference, testing

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
    def must_descend(self) -> bool:
        """The exact block minimises in its vertex; other blocks and barriers do not promise it."""
        return self.block == "exact" and not self.floor


def _materials() -> list[Extreme]:
    """All decades of mu, lam / mu and h; moduli stay below 1e12 Pa."""
    out = []
    for mu, ratio, h in itertools.product(
        [1e-2, 1.0, 1e2, 1e4, 1e6, 1e8, 1e10, 1e12], [0, 1, 1e3, 1e6], [1e-6, 1e-3, 1 / 60, 1]
    ):
        if mu * ratio <= 1e12:
            quick = mu in (1e-2, 1e6, 1e12) and ratio in (0, 1e6, 1) and h in (1e-6, 1)
            name = f"mu {mu:g}, lam/mu {ratio:g}, h {h:.3g}"
            out.append(Extreme("mu, lam, lam/mu, h", name, mu=mu, lam=mu * ratio, time_step=h, quick=quick))
    zero = [(0.0, 1e-2), (0.0, 1e12), (0.0, 0.0), (1e5, -1e5), (1e5, -0.6e5)]
    return out + [Extreme("mu = 0, lam < 0", f"mu {m:g}, lam {la:g}", mu=m, lam=la, quick=la <= 0) for m, la in zero]


def _cases() -> list[Extreme]:
    out = _materials()

    def add(axis: str, name: str, **options: Any) -> None:
        out.append(Extreme(axis, name, **options))

    for c in (1e2, 1e4, 1e6):
        add("stiffness contrast", f"{c:g}", contrast=c, mu=1e3, lam=1e3, quick=c == 1e6)
        add("stiffness contrast", f"{c:g}, K = 50", contrast=c, mu=1e3, lam=1e3, sweeps=50)
    for size in (1e-6, 1e-3, 1e3, 1e4):
        for density in (1e-3, 1e5):
            name = f"{size:g} m, {density:g} kg/m^3"
            add("size, density", name, size=size, density=density, quick=size in (1e-6, 1e4))
            add("size, density", f"{name}, paper preset", size=size, density=density, block="paper", saturation=0.1,
                regularization=1e-6)  # fmt: skip
    for m in (1e2, 1e4, 1e8):
        add("mass ratio", f"{m:g}", mass_contrast=m, density=1e-3, quick=m == 1e8)
        add("mass ratio", f"{m:g}, soft", mass_contrast=m, density=1e-3, mu=10, lam=10)
    for thin in (1e-3, 1e-6, 1e-9):
        add("slivers", f"layer of {thin:g}", mesh="layer", sliver=thin, quick=thin == 1e-6)
        add("slivers", f"flat tet of {thin:g}", mesh="sliver", sliver=thin, pinned=False, quick=thin == 1e-6)
    for state in ("mirrored", "flat", "line", "point", "half", "scattered"):
        for block in ("exact", "paper"):
            safe = {"saturation": 0.1, "regularization": 1e-6} if block == "paper" else {}
            add("inverted, collapsed", f"{state}, {block}", state=state, block=block, quick=block == "exact", **safe)
        add("inverted, collapsed", f"{state}, free", state=state, pinned=False, sweeps=20)
    for stretch in (10.0, 1e2, 1e3, 1e4, 1e5, 1e6):
        for k in (1, 20):
            add("huge strain", f"{stretch:g}, K = {k}", state="far scattered", stretch=stretch, sweeps=k, pinned=False)
    for k in (0, 1, 20, 100, 1000):
        add("sweeps", f"K = {k}", sweeps=k, cells=1 if k == 1000 else 2, mu=1e7, lam=1e7, quick=k <= 20)
    for omega in (0.1, 1.5, 1.7, 1.9, 1.99):
        for state in ("jitter", "mirrored", "scattered"):
            add("relaxation", f"{omega}, {state}", relaxation=omega, state=state, sweeps=10, quick=omega == 1.9)
    for speed in (1.0, 1e2, 1e4):
        add(
            "floor",
            f"fall at {speed:g} m/s",
            floor=True,
            pinned=False,
            speed=speed,
            state="falling",
            quick=speed == 1e4,
        )
        add("floor", f"fall at {speed:g} m/s, 4 steps", floor=True, pinned=False, speed=speed, state="falling", steps=4)
    for k, n in ((1, 20), (5, 4)):
        add("steps", f"{n} steps, K = {k}", sweeps=k, steps=n, quick=n == 4)
    return out


CASES: list[Extreme] = _cases()


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
    energies: tuple[Any, ...] = (dv.StableNeoHookean(case.block),)
    if case.floor:
        energies += (dv.FloorBarrier(height=-0.05 * case.size, kappa=1e4, dhat=0.04 * case.size, damping=10.0),)
    model = dv.Model(
        mesh,
        density=torch.where(half, case.density * case.mass_contrast, case.density).to(torch.float64),
        pinned=mesh.points[:, 0] < 1e-9 * case.size if case.pinned else None,
        energies=energies,
        saturation=case.saturation,
        regularization=case.regularization,
        relaxation=case.relaxation,
    )
    stiff = torch.where(half, case.contrast, 1.0).to(torch.float64)
    noise = torch.from_numpy(rng.uniform(-1, 1, (2, *mesh.points.shape)))
    x = _state(case, points, noise[0])
    v = case.size * case.speed * noise[1]
    if case.state == "falling":
        v = case.speed * torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64) + 0.01 * case.speed * noise[1]
    x = torch.where(model.pinned[:, None], points, x)
    inputs: dict[str, Any] = {"x": x, "v": v, "mu": case.mu * stiff, "lam": case.lam * stiff, "density": model.density,
                              "rest_points": points, "force": 0.1 * model.mass[:, None] * noise[1],
                              "gravity": torch.tensor([0.0, -9.81, 0.0], dtype=torch.float64),
                              "time_step": case.time_step}  # fmt: skip
    return model, inputs


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
    along_x = torch.tensor([1.0, 0.0, 0.0], dtype=points.dtype)
    along_y = torch.tensor([0.0, 1.0, 0.0], dtype=points.dtype)
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
        trajectory = dv.rollout(model, steps=case.steps, sweeps=case.sweeps, save="last", **options)
        return trajectory.x[-1], trajectory.v[-1]

    expected = testing.reference_result(model, inputs, case.sweeps, case.steps)
    spread = testing.spread(model, inputs, case.sweeps, case.steps, expected)
    got = testing.evaluate(run, inputs)
    errors = {k: testing.relative_error(got[k], expected[k]) for k in got if k.startswith("grad_")}
    margin = {k: errors[k] / testing.bar(spread[k]) for k in errors}
    condition = dict.fromkeys(errors, 0.0)
    # one perturbation underestimates the worst by chance: beyond the bar more are tried
    for seed in range(1 if all(m <= 1 for m in margin.values()) else 8):
        rounded = testing.reference_result(model, _rounded(inputs, seed), case.sweeps, case.steps)
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
    model = model.replace(rigid=False)
    options = {k: inputs[k] for k in ("mu", "lam", "force", "gravity", "time_step")}
    counts = [k for k in (*range(11), 12, 15, 20, 35, 50, 75, 100, 200, 500, 1000) if k <= max(case.sweeps, 5)]
    x, v, h = inputs["x"], inputs["v"], case.time_step
    y = x + h * v + h**2 * (options["gravity"] + options["force"] / model.mass[:, None])
    y = torch.where(model.pinned[:, None], x, y)
    rise, last = 0.0, math.inf
    for k in counts:
        with torch.no_grad():
            at, _ = dv.step(model, x, v, sweeps=k, **options)
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
    energies: tuple[Any, ...] = (dv.StableNeoHookean(case.block),)
    if case.floor:
        energies += (dv.FloorBarrier(height=-0.2, kappa=1e4, damping=1.0),)
    options = {"saturation": 0.1, "regularization": 1e-6} if case.block == "paper" else {}
    pinned = None if case.floor else mesh.points[:, 0] < 1e-9
    model = dv.Model(mesh, pinned=pinned, energies=energies, relaxation=case.relaxation, **options)
    x, v = model.rest_points.clone(), torch.zeros_like(model.rest_points)
    weights = torch.from_numpy(testing.generator("rollout").standard_normal(tuple(x.shape)))
    lowest: list[float] = []

    def loss(scale: Tensor, steps: int = case.steps) -> Tensor:
        trajectory = dv.rollout(model, x, v, steps=steps, mu=1e5 * scale, lam=1.5e5 * scale, time_step=1 / 60,
                                sweeps=case.sweeps, save="last")  # fmt: skip
        lowest.append(float(trajectory.x[-1][:, 1].detach().min()))
        return (weights * trajectory.x[-1]).sum()

    scale = torch.ones((), dtype=torch.float64, requires_grad=True)
    value = loss(scale)
    (gradient,) = torch.autograd.grad(value, scale)
    differences = []
    with torch.no_grad():
        for step in (1e-3, 1e-4, 1e-5):
            ahead, behind = loss(scale + step), loss(scale - step)
            differences.append(abs(float(ahead - behind) / (2 * step) - float(gradient)) / abs(float(gradient)))
    return {
        **asdict(case),
        "finite": bool(torch.isfinite(value)) and bool(torch.isfinite(gradient)),
        "gradient": float(gradient),
        "difference_error": min(differences),
        "lowest": min(lowest),
    }


def run(quick: bool) -> dict[str, Any]:
    rollouts = [Rollout("cantilever", 300), Rollout("drop onto a floor", 300, floor=True)] if quick else ROLLOUTS
    return {
        "rows": [check(case) for case in CASES if case.quick or not quick],
        "rollouts": [check_rollout(case) for case in rollouts],
    }


def verdict(row: dict[str, Any]) -> str:
    """One of "ok", "conditioning" (beyond the bar but not beyond that), "no digits" (nothing to compare), "fault"."""
    if row["condition"] > NO_DIGITS:
        return "no digits"
    if not row["finite"] or (row["must_descend"] and row["rise"] > RISE):
        return "fault"
    if row["error_over_bar"] <= 1:
        return "ok"
    return "conditioning" if row["error_over_condition"] <= 1 else "fault"


def markdown(results: dict[str, Any]) -> str:
    rows = results["rows"]
    summary = []
    for axis in dict.fromkeys(row["axis"] for row in rows):
        group = [row for row in rows if row["axis"] == axis]
        promised = [row for row in group if row["must_descend"]]
        summary.append(
            (
                axis,
                len(group),
                f"{sum(r['finite'] for r in group)}/{len(group)}",
                f"{sum(r['rise'] <= RISE for r in promised)}/{len(promised)}",
                f"{sum(r['error_over_bar'] <= 1 for r in group)}/{len(group)}",
                sum(verdict(r) == "fault" for r in group),
                float(np.nanmedian([r["gradient_error"] for r in group])),
                float(np.nanmax([r["gradient_error"] for r in group])),
                max(r["condition"] for r in group),
            )
        )
    header = ("axis", "cases", "finite", "descends", "gradient within bar", "faults", "median gradient error",
              "largest", "largest conditioning")  # fmt: skip
    text = "## Cases by axis\n\n" + markdown_table(header, summary)
    columns = ("axis", "name", "gradient_error", "spread", "condition", "forward_error", "worst_argument")
    names = ("axis", "case", "gradient error", "spread", "conditioning", "forward error", "argument")

    def listed(title: str, chosen: list[dict[str, Any]], also: tuple[str, ...] = ()) -> str:
        if not chosen:
            return ""
        table = markdown_table((*names, *also), [[r[k] for k in (*columns, *also)] for r in chosen])
        return f"\n## {title}\n\n" + table

    text += listed("Faults", [r for r in rows if verdict(r) == "fault"], ("finite", "rise", "error_over_bar"))
    beyond = [r for r in rows if verdict(r) == "conditioning"]
    text += listed("Beyond the bar, within the conditioning", beyond, ("error_over_bar",))
    lost = [r for r in rows if verdict(r) == "no digits"]
    text += listed("No digits left in double precision", lost, ("finite", "rise", "error_over_bar"))
    text += listed("Worst conditioned", sorted(rows, key=lambda r: -r["condition"])[:12])
    risen = [r for r in rows if r["rise"] > RISE]
    text += listed("Potential rose (not promised for the paper's block and floors)", risen, ("rise", "block"))
    header = ("rollout", "steps", "sweeps", "finite", "gradient against differences")
    long = [(r["name"], r["steps"], r["sweeps"], r["finite"], r["difference_error"]) for r in results["rollouts"]]
    return text + "\n## Long rollouts\n\n" + markdown_table(header, long)
