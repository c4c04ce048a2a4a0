"""Where the solver's limits lie: the F = 0 well, float32, conditioning, relaxation, rest, stiff directions.

The last two are of one direction that is far stiffer than the others: small gaps to planes, and lam far above mu. There
the gradient farthest from a step in 120 digits has a row: its error over what an ulp in every input does to that
gradient, the worst of one and three sweeps, full and compact tape.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple
from unittest import mock

import numpy as np
import torch
from torch import Tensor

import diffvbd as dv
from bench.measure import Card
from bench.tables import Table
from diffvbd import testing
from diffvbd.inspect.diagnose import collapse_stretch
from diffvbd.model.system import system_of
from diffvbd.testing import many_digits

ARGUMENTS = ("grad_x", "grad_v", "grad_mu", "grad_lam")
TIME_STEP = 1 / 60  # [s]


def step_of(model: dv.Model, inputs: dict[str, Any], solver: dv.VBD) -> dict[str, Tensor]:
    """End state and gradients of one step."""
    return testing.evaluate(partial(dv.step, model, solver=solver), inputs, solver.time_step)


# --- the F = 0 well ---------------------------------------------------------------------------------------------------


def well(quick: bool) -> list[dict[str, Any]]:
    """Where uniform compression stops recovering, and which share of random single tets ends at a point."""
    out = []
    # a regular tet with equal masses: forces then act on F as the stress does
    mesh = dv.TetMesh([[1, 1, 1], [-1, 1, -1], [1, -1, -1], [-1, -1, 1]], [[0, 1, 2, 3]], orient=True)
    model = dv.Model(mesh)
    for ratio in (1.0,) if quick else (0.0, 1.0, 10.0, 100.0):
        mu, lam = 1e4, 1e4 * ratio
        critical = float(collapse_stretch(torch.tensor(mu), torch.tensor(lam)))
        low, high = 0.5 * critical, min(1.5 * critical, 0.99)
        for _ in range(6 if quick else 12):
            middle = 0.5 * (low + high)
            collapsed = _collapsed(model, middle * torch.eye(3, dtype=torch.float64)[None], mu, lam)
            low, high = (middle, high) if bool(collapsed.any()) else (low, middle)
        row = {"lam_over_mu": ratio, "critical_stretch": critical, "measured_stretch": 0.5 * (low + high)}
        rng = testing.generator("well", ratio)
        for margin in (0.5, 0.99, 1.01, 1.2, 1.5, 2.0):
            f = rng.standard_normal((100 if quick else 1000, 3, 3))
            f *= margin * np.sqrt(3) * critical / np.linalg.norm(f, axis=(1, 2), keepdims=True)
            row[f"collapsed_at_{margin:g}"] = float(_collapsed(model, torch.from_numpy(f), mu, lam).double().mean())
        out.append(row)
    return out


def _collapsed(model: dv.Model, f: Tensor, mu: float, lam: float) -> Tensor:
    """Whether single tets that start with deformation gradient f [B, 3, 3] end at a point, inertia taken away."""
    x = model.rest_points @ f.transpose(-1, -2)
    v = torch.zeros_like(x)
    # steps short enough to follow the force, long enough in all to arrive
    for h, steps in ((0.02, 400), (0.2, 100)):
        for _ in range(steps):
            x, _ = dv.step(model, x, v, dv.VBD(h, 20), mu=mu, lam=lam, gravity=(0.0, 0.0, 0.0))
    return (x[:, 1:] - x[:, :1]).norm(dim=(-2, -1)) < 1e-2


# --- float32 ----------------------------------------------------------------------------------------------------------


def float32(quick: bool) -> list[dict[str, Any]]:
    """float32 gradients of one step of a 1 m cube (cells of 0.5 m and 0.25 m) far from the origin."""
    out, solver = [], dv.VBD(TIME_STEP, 10)
    for cells, offset in [(2, 0), (2, 1e3)] if quick else [(n, o) for n in (2, 4) for o in (0, 10, 1e3, 1e5)]:
        points, tets = testing.structured((cells,) * 3)
        model = dv.Model(dv.TetMesh(points + offset, tets), pinned=points[:, 0] < 1e-9)
        rng = testing.generator("float32")
        x = model.rest_points + 0.05 / cells * torch.from_numpy(rng.uniform(-1, 1, points.shape))
        v = torch.from_numpy(rng.uniform(-0.1, 0.1, points.shape))
        mu = torch.full((len(tets),), 1e4, dtype=torch.float64)
        exact = {"x": x, "v": v, "mu": mu, "lam": 2 * mu}
        single, small = model.to(dtype=torch.float32), {k: t.float() for k, t in exact.items()}
        local, truth = step_of(single, small, solver), step_of(model, {k: t.double() for k, t in small.items()}, solver)
        naive = testing.reference_result(single, small, solver)

        def worst(value: dict[str, Tensor], expected: dict[str, Tensor]) -> float:
            return max(testing.relative_error(value[k], expected[k]) for k in ARGUMENTS)

        options = {"mu": 1e4, "lam": 2e4, "save": "last", "solver": solver}
        ends = [dv.rollout(m, i["x"], i["v"], steps=100, **options).x[-1] for m, i in ((model, exact), (single, small))]
        out.append({"offset": float(offset), "edge": 1 / cells,
                    "resolution": torch.finfo(torch.float32).eps * max(offset, 1.0) * cells,
                    "body_local": worst(local, truth), "global": worst(naive, truth),
                    "body_local_and_input": worst(local, step_of(model, exact, solver)),
                    "rollout_error_over_edge": float((ends[1].double() - ends[0]).norm(dim=-1).max()) * cells,
                    })  # fmt: skip
    return out


# --- conditioning of the gradient -------------------------------------------------------------------------------------


def conditioning(quick: bool) -> list[dict[str, Any]]:
    """Error of the compiled gradient and disagreement of two references, over the strain of one step."""
    out = []
    for strain in (1e-6, 1e2) if quick else (1e-9, 1e-6, 1e-3, 0.1, 1.0, 10.0, 1e2, 1e3, 1e4):
        case = replace(testing.CASES["plain"], speed=60 * strain, jitter=min(strain, 0.01), force=0.0,
                       gravity=(0, 0, 0))  # fmt: skip
        with mock.patch.dict(testing.CASES, {"strain": case}):
            scene = testing.build_scene("strain")
        model, inputs, solver = scene.model(), scene.inputs(), scene.solver(5)
        expected = testing.reference_result(model, inputs, solver)
        spread = testing.spread(model, inputs, solver, expected=expected)
        got = step_of(model, inputs, solver)
        errors = {k: testing.relative_error(got[k], expected[k]) for k in expected if k.startswith("grad_")}
        worst = max(errors, key=lambda k: errors[k])
        out.append({"strain": strain, "error": errors[worst], "argument": worst.removeprefix("grad_"),
                    "spread": max(spread[k] for k in errors),
                    "error_x_v": max(errors["grad_x"], errors["grad_v"])})  # fmt: skip
    return out


# --- over-relaxation in rollouts --------------------------------------------------------------------------------------


def relaxation(quick: bool) -> list[dict[str, Any]]:
    """How many of 24 violent rollouts grow without bound, for each relaxation."""
    mesh = dv.mesh.beam(5, 3, 3, size=(1.0, 0.5, 0.5), split="kuhn")
    points = torch.from_numpy(mesh.points.copy())
    turned, stretched = points.clone(), points * torch.tensor([3.0, 1.0, 1.0])
    turned[:, 0] *= -1.0
    squashed = points * torch.tensor([1.0, 0.05, 1.0])
    materials = ((1e3, 1e3), (1e5, 1.5e5), (1e6, 1e8), (1e8, 1e8))
    states = torch.stack([s for s in (turned, stretched, squashed) for _ in materials])
    mu, lam = (torch.tensor([m[i] for _ in range(3) for m in materials])[:, None].double() for i in (0, 1))
    out = []
    for omega in (1.0, 1.9) if quick else (1.0, 1.5, 1.6, 1.7, 1.8, 1.85, 1.9, 1.95):
        model = dv.Model(mesh, pinned=mesh.points[:, 0] < 1e-9)
        grown = 0
        for h in (1 / 60, 0.2):
            x = torch.where(model.pinned[:, None], points, states)
            v, lost = torch.zeros_like(x), torch.zeros(len(x), dtype=torch.bool)
            for _ in range(50 if quick else 300):
                x, v = dv.step(model, x, v, dv.VBD(h, 5, relaxation=omega), mu=mu, lam=lam, gravity=(0.0, 0.0, 0.0))
                # no start is longer than 3 m: at 30 m the sweeps have added energy
                lost |= (~torch.isfinite(x).all(-1) | (x.norm(dim=-1) > 30)).any(-1)
                x, v = torch.where(lost[:, None, None], points, x), torch.where(lost[:, None, None], 0.0, v)
            grown += int(lost.sum())
        out.append({"relaxation": omega, "grown": grown, "rollouts": 2 * len(states)})
    return out


# --- bodies at rest ---------------------------------------------------------------------------------------------------

REST_SWEEPS = (0, 1, 2, 3, 5, 10)


def at_rest(quick: bool, device: str) -> list[dict[str, Any]]:
    """A cube of 27 vertices, 0.2 m and 3000 kg/m^3, let go 2 mm above where the barrier of a frictionless floor begins,
    1,500 steps."""
    mesh = dv.mesh.cube(3, size=0.2, split="kuhn").translate((0.0, 0.012, 0.0))
    energies = (dv.StableNeoHookean(), dv.FloorBarrier(height=0.0, kappa=1e3, dhat=1e-2))
    model, out = dv.Model(mesh, density=3000.0, energies=energies, device=device), []
    steps = 50 if quick else (1500 if device == "cpu" else 400)
    counts, relaxations = ((1, 5), (1.0,)) if quick else (REST_SWEEPS, (0.5, 1.0, 1.6))
    for subspace, sweeps, relaxation in itertools.product((None, "rigid"), counts, relaxations):
        solver = dv.VBD(0.01, sweeps, relaxation=relaxation, subspace=subspace)
        row = {"rigid": subspace == "rigid", "sweeps": sweeps, "relaxation": relaxation, "steps": steps}
        out.append(row | _watched(model, solver, steps))
    return out


@torch.no_grad()
def _watched(model: dv.Model, solver: dv.VBD, steps: int) -> dict[str, Any]:
    """What became of a body that was let go."""
    x, v = model.rest_points.clone(), torch.zeros_like(model.rest_points)
    low, mu = torch.full((), torch.inf, dtype=x.dtype, device=x.device), 2e5
    for _ in range(steps):
        try:
            x, v = dv.step(model, x, v, solver, mu=mu, lam=2 * mu)
        except ValueError:  # the state before was no longer finite, or below the floor
            x, v, low = x * torch.nan, v * torch.nan, low * torch.nan
            break
        low = torch.minimum(low, x[:, 1].min())
    moved = (x - model.rest_points).mean(0)
    return {"lowest_gap": float(low), "gap": float(x[:, 1].min()), "speed": float(v.norm(dim=-1).max()),
            "drift": float(moved[[0, 2]].norm())}  # fmt: skip


# --- one direction far stiffer than the others ------------------------------------------------------------------------

GAPS = (1e-3, 1e-4, 1e-5, 1e-6, 3e-7, 1e-7)  # [m]
NORMALS = ((0.0, 1.0, 0.0), (0.3, 0.9, -0.3), (1.0, 2.0, 3.0), (-0.7, 0.7, 0.02))
CORNER = ((0.3, 0.9, -0.3), (0.9, 0.2, 0.3))  # two planes that meet at the same vertex of the cube
RATIOS = (1.0, 1e2, 1e4, 1e6, 1e8, 1e9, 1e10, 1e12)  # lam / mu
SWEEPS = (1, 3)
GRAVITY = (0.0, -9.81, 0.0)
PLACE = np.array([0.3, 0.7, 0.2])  # of the cube [m]: coordinates without zeros have an ulp to move by
STATE = ("x", "mu", "lam")
PLANES = ("floor_height", "floor_normal", "floor_kappa", "floor_dhat")


class Scene(NamedTuple):
    model: dv.Model
    inputs: dict[str, Any]
    names: tuple[str, ...]  # of the inputs that are differentiated
    options: dict[str, Any]  # of the solver

    def solver(self, sweeps: int, tape: Any = "full") -> dv.VBD:
        return dv.VBD(TIME_STEP, sweeps, start="predictor", tape=tape, **self.options)


def oblique(gap: float, normals: tuple = NORMALS[1:2]) -> Scene:
    """A cube of 8 vertices, 1 m and 1000 kg, with a vertex `gap` above planes; the predictor moves along them, and
    away by a hundredth of the gap, so that rounding does not decide whether the start has an approach to remove."""
    mesh = dv.mesh.cube(2, split="kuhn")
    points = mesh.points + PLACE
    planes = np.array(normals) / np.linalg.norm(normals, axis=1, keepdims=True)
    height = (points @ planes.T).min(0) - gap
    floor = dv.FloorBarrier(height=height.tolist(), normal=planes.tolist(), kappa=2e4, dhat=0.1, damping=0.0)
    model = dv.Model(mesh, energies=(dv.StableNeoHookean(), floor))
    noise = testing.generator("oblique").uniform(-1, 1, points.shape)
    across = np.linalg.pinv(planes) @ planes  # what of a vector changes the gaps
    away = np.linalg.pinv(planes) @ np.full(len(planes), 0.01 * gap * 60)
    v = noise - (noise + np.array(GRAVITY) / 60) @ across + away
    number = {"kappa": 2e4, "dhat": 0.1, "height": height, "normal": planes}
    values = {"x": points, "v": v, "mu": 1e4, "lam": 2e4, "gravity": GRAVITY,
              **{f"floor_{k}": value for k, value in number.items()}}  # fmt: skip
    inputs = {name: torch.as_tensor(value, dtype=torch.float64) for name, value in values.items()}
    return Scene(model, inputs, STATE + PLANES, {"subspace": None})


def volumetric(ratio: float, block: str = "exact") -> Scene:
    """A cube of 8 vertices, 1 m, one face pinned, strained by some per cent, with lam = ratio mu."""
    mesh = dv.mesh.cube(2, split="kuhn")
    rng = testing.generator("volumetric")
    points = torch.from_numpy(mesh.points.copy())
    pinned = mesh.points[:, 0] < 1e-9
    model = dv.Model(mesh, pinned=pinned, energies=(dv.StableNeoHookean(),))
    mu = 1e4 * torch.from_numpy(rng.uniform(0.8, 1.2, mesh.num_tets))
    x = points + 0.05 * torch.from_numpy(rng.uniform(-1, 1, points.shape)) + torch.from_numpy(PLACE)
    v = torch.from_numpy(rng.uniform(-1, 1, points.shape))
    return Scene(model, {"x": x, "v": v, "mu": mu, "lam": ratio * mu}, STATE, {"block": block})


class Errors(NamedTuple):
    """Relative to the largest entry, by entry of `testing.evaluate`."""

    sensitivity: dict[str, float]
    errors: dict[str, float]

    def ratios(self) -> dict[str, float]:
        """Of each gradient, its error over what an ulp in the inputs does to it; below an ulp counts as an ulp."""
        return {k: e / max(self.sensitivity[k], many_digits.ULP)
                for k, e in self.errors.items() if k.startswith("grad_")}  # fmt: skip

    def worst(self) -> str:
        ratios = self.ratios()
        return max(ratios, key=lambda k: ratios[k])


def measure(scene: Scene, truth: many_digits.Exact, sweeps: int, tape: Any = "full", device: str = "cpu") -> Errors:
    """A step and its gradients against 120 digits, which `exact` has of the same scene."""
    found = step_of(scene.model.to(device), testing.on_device(scene.inputs, device), scene.solver(sweeps, tape))
    errors = {name: testing.relative_error(found[name], value) for name, value in truth.values.items()}
    return Errors(truth.sensitivity, errors)


def exact(scene: Scene, sweeps: int) -> many_digits.Exact:
    rng = testing.generator("loss")  # that of testing.evaluate
    weights = [torch.as_tensor(rng.standard_normal(tuple(scene.inputs["x"].shape))) for _ in range(2)]
    inputs = {**scene.inputs, "time_step": TIME_STEP}
    system = system_of(scene.model, scene.solver(sweeps))  # it has what the solver decides
    return many_digits.exact_step(system, inputs, sweeps, weights, scene.names, scene.solver(sweeps).block)


def row(scene: Scene, device: Any) -> dict[str, Any]:
    """The worst of one and three sweeps and all tapes."""
    found = []
    for k in SWEEPS:
        truth = exact(scene, k)
        found += [(measure(scene, truth, k, tape, str(device)), k) for tape in ("full", "compact")]
    errors, sweeps = max(found, key=lambda entry: max(entry[0].ratios().values()))
    name = errors.worst()
    return {"sweeps": sweeps, "argument": name.removeprefix("grad_"), "error": errors.errors[name],
            "sensitivity": errors.sensitivity[name], "error_over_sensitivity": errors.ratios()[name]}  # fmt: skip


def of_cpu(group: Callable[[bool], list[dict[str, Any]]]) -> Callable[[Card], list[dict[str, Any]]]:
    """A group that has no device of its own."""
    return lambda card: [] if card.cuda else group(card.quick)


GROUPS: dict[str, Callable[[Card], list[dict[str, Any]]]] = {
    "well": of_cpu(well),
    "float32": of_cpu(float32),
    "conditioning": of_cpu(conditioning),
    "relaxation": of_cpu(relaxation),
    "rest": lambda card: at_rest(card.quick, str(card.device)),
    "oblique": lambda card: [
        {"normals": str(normals), "gap": gap, **row(oblique(gap, normals), card.device)}
        for normals in ([NORMALS[1:2]] if card.quick else [*((n,) for n in NORMALS), CORNER])
        for gap in GAPS[:: 5 if card.quick else 1]
    ],
    "volumetric": lambda card: [
        {"block": block, "lam_over_mu": ratio, **row(volumetric(ratio, block), card.device)}
        for block in ("exact", "paper")
        for ratio in RATIOS[:: 7 if card.quick else 1]
    ],
}
ANYWHERE = True
TABLES = (
    Table("The F = 0 well: uniform stretch; share of random tets with |F| = margin sqrt(3) s* that collapse", "well"),
    Table("float32: largest relative error of the gradients of one step (x, v, mu, lam), K = 10", "float32"),
    Table("Conditioning of the gradient over the strain of one step, K = 5", "conditioning"),
    Table("Rollouts of 300 steps that grow without bound, K = 5", "relaxation"),
    Table("A cube at rest on a frictionless floor: gaps [m], speed [m/s], drift [m]", "rest"),
    Table("Gradients beside a plane at a small gap", "oblique"),
    Table("Gradients with lam far above mu", "volumetric"),
)
