"""Digits of gradients where one direction is far stiffer than the others: small gaps to planes, lam far above mu."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

import diffvbd as dv
from bench.common import markdown_table
from diffvbd import testing
from diffvbd.testing import many_digits

GAPS = (1e-3, 1e-4, 1e-5, 1e-6, 3e-7, 1e-7)  # [m]
NORMALS = ((0.0, 1.0, 0.0), (0.3, 0.9, -0.3), (1.0, 2.0, 3.0), (-0.7, 0.7, 0.02))
CORNER = ((0.3, 0.9, -0.3), (0.9, 0.2, 0.3))  # two planes that meet at the same vertex of the cube
RATIOS = (1.0, 1e2, 1e4, 1e6, 1e8, 1e9, 1e10, 1e12)  # lam / mu
SWEEPS = (1, 3)
GRAVITY = (0.0, -9.81, 0.0)
PLACE = np.array([0.3, 0.7, 0.2])  # of the cube [m]: coordinates without zeros have an ulp to move by
STATE = ("x", "mu", "lam")
PLANES = tuple(f"floor_barrier.{name}" for name in ("height", "normal", "kappa", "dhat"))


class Scene(NamedTuple):
    model: dv.Model
    inputs: dict[str, Any]
    names: tuple[str, ...]  # of the inputs that are differentiated
    block: str


def oblique(gap: float, normals: tuple = NORMALS[1:2]) -> Scene:
    """A cube of 8 vertices, 1 m and 1000 kg, with a vertex `gap` above planes; the predictor moves along them, and
    away by a hundredth of the gap, so that rounding does not decide whether the start has an approach to remove."""
    mesh = dv.mesh.cube(2, split="kuhn")
    points = mesh.points + PLACE
    planes = np.array(normals) / np.linalg.norm(normals, axis=1, keepdims=True)
    height = (points @ planes.T).min(0) - gap
    floor = dv.FloorBarrier(height=height.tolist(), normal=planes.tolist(), kappa=2e4, dhat=0.1, damping=0.0)
    model = dv.Model(mesh, energies=(dv.StableNeoHookean(), floor), rigid=False, start="predictor")
    noise = testing.generator("oblique").uniform(-1, 1, points.shape)
    across = np.linalg.pinv(planes) @ planes  # what of a vector changes the gaps
    away = np.linalg.pinv(planes) @ np.full(len(planes), 0.01 * gap * 60)
    v = noise - (noise + np.array(GRAVITY) / 60) @ across + away
    number = {"kappa": 2e4, "dhat": 0.1, "height": height, "normal": planes}
    inputs = {
        "x": torch.from_numpy(points),
        "v": torch.from_numpy(v),
        "mu": torch.tensor(1e4, dtype=torch.float64),
        "lam": torch.tensor(2e4, dtype=torch.float64),
        "gravity": torch.tensor(GRAVITY, dtype=torch.float64),
        "time_step": 1 / 60,
        "parameters": {f"floor_barrier.{k}": torch.as_tensor(v, dtype=torch.float64) for k, v in number.items()},
    }
    return Scene(model, inputs, STATE + PLANES, "exact")


def volumetric(ratio: float, block: str = "exact") -> Scene:
    """A cube of 8 vertices, 1 m, one face pinned, strained by some per cent, with lam = ratio mu."""
    mesh = dv.mesh.cube(2, split="kuhn")
    rng = testing.generator("volumetric")
    points = torch.from_numpy(mesh.points.copy())
    pinned = mesh.points[:, 0] < 1e-9
    model = dv.Model(mesh, pinned=pinned, energies=(dv.StableNeoHookean(block),), start="predictor")
    mu = 1e4 * torch.from_numpy(rng.uniform(0.8, 1.2, mesh.num_tets))
    inputs = {
        "x": points + 0.05 * torch.from_numpy(rng.uniform(-1, 1, points.shape)) + torch.from_numpy(PLACE),
        "v": torch.from_numpy(rng.uniform(-1, 1, points.shape)),
        "mu": mu,
        "lam": ratio * mu,
        "time_step": 1 / 60,
    }
    return Scene(model, inputs, STATE, block)


class Errors(NamedTuple):
    """Relative to the largest entry, by entry of `testing.evaluate`."""

    sensitivity: dict[str, float]
    errors: dict[str, float]

    def ratios(self) -> dict[str, float]:
        """Of each gradient, its error over what an ulp in the inputs does to it; below an ulp counts as an ulp."""
        return {
            k: e / max(self.sensitivity[k], many_digits.ULP) for k, e in self.errors.items() if k.startswith("grad_")
        }

    def worst(self) -> str:
        ratios = self.ratios()
        return max(ratios, key=lambda k: ratios[k])


def measure(scene: Scene, truth: many_digits.Exact, sweeps: int, tape: Any = "full", device: str = "cpu") -> Errors:
    """A step and its gradients against 120 digits, which `exact` has of the same scene."""
    model, inputs = scene.model, scene.inputs
    there, adjoint = model.to(device), dv.ReverseSweep(tape=tape)

    def run(**options: Any) -> tuple[Tensor, Tensor]:
        return dv.step(there, sweeps=sweeps, adjoint=adjoint, **options)

    return Errors(truth.sensitivity, many_digits.compare(run, truth, testing.on_device(inputs, device)))


def exact(scene: Scene, sweeps: int) -> many_digits.Exact:
    rng = testing.generator("loss")  # that of testing.evaluate
    weights = [torch.as_tensor(rng.standard_normal(tuple(scene.inputs["x"].shape))) for _ in range(2)]
    return many_digits.exact_step(scene.model, scene.inputs, sweeps, weights, scene.names, scene.block)


def run(quick: bool, *, device: str = "cpu") -> dict[str, Any]:
    gaps, ratios = (GAPS[::5], RATIOS[::7]) if quick else (GAPS, RATIOS)
    planes = [((n,), str(n)) for n in (NORMALS[1:2] if quick else NORMALS)] + ([] if quick else [(CORNER, "two")])
    return {
        "oblique": [
            {"normal": name, "gap": gap, **row(oblique(gap, normals), device)}
            for normals, name in planes
            for gap in gaps
        ],
        "volumetric": [
            {"block": block, "lam_over_mu": ratio, **row(volumetric(ratio, block), device)}
            for block in ("exact", "paper")
            for ratio in ratios
        ],
    }


def row(scene: Scene, device: str) -> dict[str, Any]:
    """The worst of one and three sweeps and all tapes."""
    found = []
    for k in SWEEPS:
        truth = exact(scene, k)
        found += [(measure(scene, truth, k, tape, device), k) for tape in ("full", "compact")]
    errors, sweeps = max(found, key=lambda entry: max(entry[0].ratios().values()))
    name = errors.worst()
    return {
        "sweeps": sweeps,
        "argument": name.removeprefix("grad_"),
        "error": errors.errors[name],
        "sensitivity": errors.sensitivity[name],
        "error_over_sensitivity": errors.ratios()[name],
    }


def markdown(results: dict[str, Any]) -> str:
    text = (
        "Relative error of the gradient that is farthest from a step in 120 digits, over what an ulp in every input "
        "does to that gradient. One step of a cube of 8 vertices; the worst of one and three sweeps, full and compact "
        "tape.\n"
    )
    titles = {"oblique": "A plane at a small gap", "volumetric": "lam far above mu"}
    for name, title in titles.items():
        rows = results[name]
        header = [k.replace("_", " ") for k in rows[0]]
        text += f"\n## {title}\n\n" + markdown_table(header, [list(r.values()) for r in rows])
    return text
