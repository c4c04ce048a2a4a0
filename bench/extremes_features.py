"""Extreme inputs, of what is beside the elastic solver: is a rollout finite, does it gain energy, is it said where so?

Rollouts of 20 steps with coarse corrections, integrators, floors, colliders, pairs and friction,
each over the extremes of `AXES`. Nothing drives them but gravity, so none may gain energy. A case is *silent* where its
end is of no use - not finite, with more than 5 % more energy, a gradient that is not finite - and nothing was raised
and nothing warned of. The gradient of a loss of the end, along a random direction of velocity and stiffness, is held
against central differences.
"""

from __future__ import annotations

import math
import time
import warnings
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

import diffvbd as dv
from bench.common import markdown_table
from diffvbd import mesh, reference, testing

GAIN = 0.05  # share of the energy that came in, beyond which a result counts as useless
DIFFERENCES = (1e-5, 1e-7)  # relative steps of central differences; the best one counts
ALIKE = 1e-3  # error against differences below which a gradient counts as matching them
GRAVITY = 9.81
OBSTACLE = (-2.0, 3.0)  # over the size: from where to where it lies in both directions


@dataclass(frozen=True)
class Extreme:
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
QUICK = ("none", "mu 1e10 Pa, K = 1", "1000 m/s", "float32, size 1e-4 m")

# scene, options of the Model, integrator
FEATURES: dict[str, tuple[str, dict[str, Any], Any]] = {
    "plain, pinned": ("pinned", {}, None),
    "plain, free": ("free", {}, None),
    "coarse, pinned": ("pinned", {"coarse": "auto"}, None),
    "coarse, free": ("free", {"coarse": "auto", "relaxation": 1.5}, None),
    "SDIRK2, pinned": ("pinned", {}, dv.SDIRK2()),
    "SDIRK2, free": ("free", {}, dv.SDIRK2()),
    "BDF2, pinned": ("pinned", {}, dv.BDF2()),
    "BDF2, free": ("free", {}, dv.BDF2()),
    "floor": ("floor", {}, None),
    "floor, friction": ("floor", {"friction": 0.5}, None),
    "floor, coarse, BDF2": ("floor", {"coarse": "auto"}, dv.BDF2()),
    "plane": ("plane", {}, None),
    "plane, friction": ("plane", {"friction": 0.5}, None),
    "sphere, friction": ("sphere", {"friction": 0.5}, None),
    "obstacle, friction": ("obstacle", {"friction": 0.5}, None),
    "pairs": ("pairs", {}, None),
    "pairs, friction": ("pairs", {"friction": 0.5}, None),
    "pairs, friction, coarse": ("pairs", {"friction": 0.5, "coarse": "auto"}, None),
    "pairs, SDIRK2": ("pairs", {}, dv.SDIRK2()),
    "pairs, BDF2": ("pairs", {}, dv.BDF2()),
    "self-contact": ("horseshoe", {}, None),
    "self-contact, friction, coarse": ("horseshoe", {"friction": 0.5, "coarse": "auto"}, None),
}  # fmt: skip

CASES = [replace(Extreme(), feature=f, axis=a, **given) for f in FEATURES for a, given in AXES.items()]


# --- scenes -----------------------------------------------------------------------------------------------------------


def bodies(case: Extreme) -> dv.TetMesh:
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


def build(case: Extreme) -> tuple[dv.Model, Tensor, Tensor, dict[str, Any]]:
    """Model, state, and the material of each tet."""
    kind, options, _ = FEATURES[case.feature]
    options = dict(options)
    tets = bodies(case)
    scaled = tets.transform(case.size * np.eye(3))
    upper = np.array(tets.points[tets.tets].mean(1)[:, 0] > 0.5 * np.ptp(tets.points[:, 0]))
    half = torch.from_numpy(upper)
    energies: list[Any] = [dv.StableNeoHookean()]
    # about as stiff as the softer half
    barrier: dict[str, Any] = {"kappa": case.mu * case.size, "dhat": 0.05 * case.size}
    colliders: tuple[Any, ...] = ()
    if kind == "floor":
        energies.append(dv.FloorBarrier(**barrier))
    if kind in ("plane", "sphere", "obstacle", "pairs", "horseshoe"):
        energies.append(dv.PairBarrier(**barrier, self_contact=kind == "horseshoe"))
    if kind == "plane":
        colliders = (dv.colliders.Plane(),)
    elif kind == "sphere":
        colliders = (dv.colliders.Sphere((0.2 * case.size, -0.5 * case.size, 0.2 * case.size), 0.5 * case.size),)
    elif kind == "obstacle":
        low, high = OBSTACLE
        corners = case.size * np.array([[low, 0.0, low], [low, 0.0, high], [high, 0.0, low], [high, 0.0, high]])
        colliders = (dv.colliders.Obstacle(corners, np.array([[0, 1, 2], [2, 1, 3]])),)
    if "friction" in options:
        energies.append(dv.Friction(options.pop("friction"), velocity=0.01 * case.speed))
    pinned = np.isclose(tets.points[:, 0], 0.0) if kind == "pinned" else None
    density = torch.where(half, case.density * case.mass_contrast, case.density).to(torch.float64)
    dtype = torch.float32 if case.single else torch.float64
    model = dv.Model(scaled, density=density.to(dtype), pinned=pinned, energies=energies, colliders=colliders,
                     dtype=dtype, **options)  # fmt: skip
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


def check(case: Extreme) -> dict[str, Any]:
    """All figures of one case."""
    row: dict[str, Any] = {"feature": case.feature, "axis": case.axis, "raised": "", "warned": ""}
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        try:
            row |= _run(case)
        except (ValueError, RuntimeError) as error:
            row |= {
                "raised": str(error).split("\n")[0][:200],
                "finite": False,
                "gain": math.nan,
                "gradient_finite": False,
            }
    row["warned"] = ", ".join(sorted({str(w.message).split(":")[0] for w in found}))
    useless = not row["finite"] or not row["gain"] <= GAIN or not row["gradient_finite"]
    row["useless"] = useless
    row["silent"] = useless and not row["raised"] and not row["warned"]
    return row


def _run(case: Extreme) -> dict[str, Any]:
    model, x, v, material = build(case)
    integrator = FEATURES[case.feature][2]
    options: dict[str, Any] = {
        "steps": case.steps,
        "time_step": case.time_step,
        "sweeps": case.sweeps,
        "integrator": integrator,
    }
    begun = time.perf_counter()
    given: dict[str, Any] = {**options, **material}
    with torch.no_grad():
        motion = dv.rollout(model, x, v, **given)
    seconds = time.perf_counter() - begun
    finite = bool(torch.isfinite(motion.x).all()) and bool(torch.isfinite(motion.v).all())
    row: dict[str, Any] = {"finite": finite, "seconds": seconds, "gain": math.nan}
    if finite:
        corners = motion.x[-1][model.tets].to(torch.float64)
        row |= {"gain": gained(case, motion, material), "inverted": int((_volumes(corners) < 0).sum()),
                "crossings": _crossings(case, model, motion)}  # fmt: skip
    return row | _gradient(case, model, x, v, material, options)


def gained(case: Extreme, motion: dv.Trajectory, material: dict[str, Tensor]) -> float:
    """Most energy of a frame beyond that of the first, over what the scene had and what gravity did; barriers, which
    hold none at the start and are never negative, left out."""
    double = build(replace(case, single=False))[0]
    body = dv.Model(double.mesh, density=double._density, energies=(dv.StableNeoHookean(),), rigid=False)
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


def _through_obstacle(case: Extreme, model: dv.Model, motion: dv.Trajectory) -> int:
    low, high = (case.size * bound for bound in OBSTACLE)

    def above_or_below(points: Tensor) -> Tensor:
        return ((low <= points[..., ::2]) & (points[..., ::2] <= high)).all(-1)

    end = motion.x[-1][np.unique(model.mesh.surface)]
    found = int((above_or_below(end) & (end[:, 1] <= 0)).sum())
    surface = model.surface_of_contact
    assert surface is not None
    edges = surface.edges.long()
    edges = edges[(edges < model.num_vertices).all(1)]
    for x in motion.x:
        a, b = x[edges].unbind(1)
        passes = a[:, 1] * b[:, 1] < 0
        share = a[:, 1:2] / (a[:, 1:2] - b[:, 1:2])
        found += int((passes & above_or_below(a + share * (b - a))).sum())
    return found


def _crossings(case: Extreme, model: dv.Model, motion: dv.Trajectory) -> int:
    """Edges through triangles at the end, and vertices of the surface at or below the floor or plane; of an obstacle,
    off whose edge bodies may slide, vertices below it at the end, and edges through it in any frame."""
    kind = FEATURES[case.feature][0]
    end = motion.x[-1]
    if kind in ("floor", "plane"):
        return int((end[np.unique(model.mesh.surface), 1] <= 0).sum())
    if kind == "obstacle":
        return _through_obstacle(case, model, motion)
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


def _volumes(corners: Tensor) -> Tensor:
    return torch.linalg.det(corners[:, 1:] - corners[:, :1])


def _gradient(case: Extreme, model: dv.Model, x: Tensor, v: Tensor, material: dict[str, Tensor],
              options: dict[str, Any]) -> dict[str, Any]:  # fmt: skip
    """Whether the gradient is finite, and its error against differences along one direction (None in float32)."""
    random = testing.generator("features", case.feature)
    weights, way = (torch.from_numpy(random.standard_normal(tuple(x.shape))).to(x) for _ in range(2))
    way = case.speed * torch.where(model.pinned[:, None], 0.0, way)

    def loss(s: Tensor) -> Tensor:
        given: dict[str, Any] = {k: m * (1 + s) for k, m in material.items()}
        end = dv.rollout(
            model, x, v + s * way, **options, **given, save="last", check_contact=False, check_energy=False
        )
        return (weights * (end.x[-1] - x)).sum() / case.size

    at = torch.zeros((), dtype=x.dtype, requires_grad=True)
    value = loss(at)
    (slope,) = torch.autograd.grad(value, at)
    row: dict[str, Any] = {"gradient_finite": bool(torch.isfinite(slope)), "gradient": float(slope), "difference": None}
    if case.single or not row["gradient_finite"]:
        return row
    with torch.no_grad():
        found = [float(loss(at + d) - loss(at - d)) / (2 * d) for d in DIFFERENCES]
    scale = max(abs(float(slope)), 1e-300)
    return row | {"difference": min(abs(f - float(slope)) / scale for f in found)}


# --- the benchmark ----------------------------------------------------------------------------------------------------


def run(quick: bool, only: str | None = None) -> dict[str, Any]:
    chosen = [c for c in CASES if (c.axis in QUICK or not quick) and (only is None or only in c.feature)]
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        return {"base": {k: v for k, v in asdict(Extreme()).items() if k not in ("feature", "axis")},
                "rows": [check(case) for case in chosen]}  # fmt: skip
    finally:
        torch.set_num_threads(threads)


def verdict(row: dict[str, Any]) -> str:
    """Of the gradient: "alike", "kink" (finite, and not as differences have it), "not finite", "-" (not compared)."""
    if row["raised"] or row.get("difference") is None and row.get("gradient_finite"):
        return "-"
    if not row["gradient_finite"]:
        return "not finite"
    return "alike" if row["difference"] <= ALIKE else "kink"


def _counts(rows: list[dict[str, Any]], what: str) -> tuple[Any, ...]:
    compared = [r for r in rows if verdict(r) in ("alike", "kink")]
    return (what, len(rows), sum(r["finite"] for r in rows), sum(bool(r["raised"]) for r in rows),
            sum(r["finite"] and r["gain"] > GAIN for r in rows), sum(r["silent"] for r in rows),
            sum(r.get("crossings", 0) > 0 for r in rows), sum(r.get("inverted", 0) > 0 for r in rows),
            sum(r.get("gradient_finite", False) for r in rows),
            f"{sum(verdict(r) == 'alike' for r in compared)}/{len(compared)}")  # fmt: skip


def markdown(results: dict[str, Any]) -> str:
    rows = results["rows"]
    header = ("", "cases", "finite", "raised", "gain > 5 %", "silent", "crossings", "inverted tets", "gradient finite",
              "gradient as differences")  # fmt: skip
    text = ""
    for key in ("feature", "axis"):
        groups = [[r for r in rows if r[key] == name] for name in dict.fromkeys(r[key] for r in rows)]
        table = [_counts(group, group[0][key]) for group in groups]
        text += f"## Cases by {key}\n\n" + markdown_table((key, *header[1:]), [*table, _counts(rows, "all")]) + "\n"
    names = ("feature", "axis", "finite", "gain", "inverted", "crossings", "gradient_finite", "difference")

    def listed(title: str, chosen: list[dict[str, Any]]) -> str:
        cells = [(*(r.get(k) for k in names), r["warned"], r["raised"]) for r in chosen]
        return f"## {title}\n\n" + markdown_table((*names, "warned of", "raised"), cells) + "\n" if chosen else ""

    text += listed("Of no use, and nothing said", [r for r in rows if r["silent"]])
    text += listed("Of no use, and said so", [r for r in rows if r["useless"] and not r["silent"]])
    text += listed("Crossings", [r for r in rows if r.get("crossings")])
    return text + listed("Gradients unlike differences", [r for r in rows if verdict(r) in ("kink", "not finite")])
