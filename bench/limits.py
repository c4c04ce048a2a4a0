"""Where the solver's limits lie: the F = 0 well, float32, gradient conditioning, relaxation, small bodies, momentum."""

from __future__ import annotations

from dataclasses import replace
from typing import Any
from unittest import mock

import numpy as np
import torch
from torch import Tensor

import diffvbd as dv
from bench.common import titled_tables
from diffvbd import testing
from diffvbd.inspect.diagnose import collapse_stretch

ARGUMENTS = ("grad_x", "grad_v", "grad_mu", "grad_lam")


def run(quick: bool) -> dict[str, Any]:
    return {
        "well": well(quick),
        "float32": float32(quick),
        "conditioning": conditioning(quick),
        "relaxation": relaxation(quick),
        "paper_preset": paper_preset(quick),
        "momentum": momentum(quick),
    }


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
            share = float(_collapsed(model, torch.from_numpy(f), mu, lam).double().mean())
            row[f"collapsed_at_{margin:g}"] = share
        out.append(row)
    return out


def _collapsed(model: dv.Model, f: Tensor, mu: float, lam: float) -> Tensor:
    """Whether single tets that start with deformation gradient f [B, 3, 3] end at a point, inertia taken away."""
    x = model.rest_points @ f.transpose(-1, -2)
    v = torch.zeros_like(x)
    # steps short enough to follow the force, long enough in all to arrive
    for h, steps in ((0.02, 400), (0.2, 100)):
        for _ in range(steps):
            x, _ = dv.step(model, x, v, mu=mu, lam=lam, time_step=h, sweeps=20, gravity=(0.0, 0.0, 0.0))
    return (x[:, 1:] - x[:, :1]).norm(dim=(-2, -1)) < 1e-2


# --- float32 ----------------------------------------------------------------------------------------------------------


def float32(quick: bool) -> list[dict[str, Any]]:
    """float32 gradients of one step of a 1 m cube (cells of 0.5 m and 0.25 m) far from the origin."""
    out = []
    for cells, offset in [(2, 0), (2, 1e3)] if quick else [(n, o) for n in (2, 4) for o in (0, 10, 1e3, 1e5)]:
        points, tets = testing.structured((cells,) * 3)
        model = dv.Model(dv.TetMesh(points + offset, tets), pinned=points[:, 0] < 1e-9)
        rng = testing.generator("float32")
        x = model.rest_points + 0.05 / cells * torch.from_numpy(rng.uniform(-1, 1, points.shape))
        exact = {
            "x": x,
            "v": torch.from_numpy(rng.uniform(-0.1, 0.1, points.shape)),
            "mu": torch.full((len(tets),), 1e4, dtype=torch.float64),
            "lam": torch.full((len(tets),), 2e4, dtype=torch.float64),
        }
        small = {k: t.float() for k, t in exact.items()}
        same = {k: t.double() for k, t in small.items()}
        local, truth = _float32_step(model.to(dtype=torch.float32), small), _float32_step(model, same)
        naive = testing.reference_result(model.to(dtype=torch.float32), small | {"time_step": 1 / 60}, 10)
        unrounded = _float32_step(model, exact)

        def worst(value: dict[str, Tensor], expected: dict[str, Tensor]) -> float:
            return max(testing.relative_error(value[k], expected[k]) for k in ARGUMENTS)

        versions = ((model, exact), (model.to(dtype=torch.float32), small))
        options = {"mu": 1e4, "lam": 2e4, "time_step": 1 / 60, "sweeps": 10, "save": "last"}
        ends = [dv.rollout(m, i["x"], i["v"], steps=100, **options).x[-1] for m, i in versions]
        row = {
            "offset": float(offset),
            "edge": 1 / cells,
            "resolution": torch.finfo(torch.float32).eps * max(offset, 1.0) * cells,
            "body_local": worst(local, truth),
            "global": worst(naive, truth),
            "body_local_and_input": worst(local, unrounded),
            "rollout_error_over_edge": float((ends[1].double() - ends[0]).norm(dim=-1).max()) * cells,
        }
        out.append(row)
    return out


def _float32_step(model: dv.Model, inputs: dict[str, Tensor]) -> dict[str, Tensor]:
    return testing.evaluate(lambda **o: dv.step(model, sweeps=10, **o), inputs | {"time_step": 1 / 60})


# --- conditioning of the gradient -------------------------------------------------------------------------------------


def conditioning(quick: bool) -> list[dict[str, Any]]:
    """Error of the compiled gradient and disagreement of two references, over the strain of one step."""
    out = []
    for strain in (1e-6, 1e2) if quick else (1e-9, 1e-6, 1e-3, 0.1, 1.0, 10.0, 1e2, 1e3, 1e4):
        case = replace(
            testing.CASES["plain"], speed=60 * strain, jitter=min(strain, 0.01), force=0.0, gravity=(0, 0, 0)
        )
        with mock.patch.dict(testing.CASES, {"strain": case}):
            scene = testing.build_scene("strain")
        model, inputs = scene.model(), scene.inputs()
        expected = testing.reference_result(model, inputs, 5)
        spread = testing.spread(model, inputs, 5, expected=expected)
        got = testing.evaluate(lambda m=model, **o: dv.step(m, sweeps=5, **o), inputs)
        errors = {k: testing.relative_error(got[k], expected[k]) for k in expected if k.startswith("grad_")}
        worst = max(errors, key=lambda k: errors[k])
        out.append(
            {
                "strain": strain,
                "error": errors[worst],
                "argument": worst.removeprefix("grad_"),
                "spread": max(spread[k] for k in errors),
                "error_x_v": max(errors["grad_x"], errors["grad_v"]),
            }
        )
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
        model = dv.Model(mesh, pinned=mesh.points[:, 0] < 1e-9, relaxation=omega)
        grown, total = 0, 0
        for h in (1 / 60, 0.2):
            x = torch.where(model.pinned[:, None], points, states)
            v, lost = torch.zeros_like(x), torch.zeros(len(x), dtype=torch.bool)
            for _ in range(50 if quick else 300):
                x, v = dv.step(model, x, v, mu=mu, lam=lam, time_step=h, sweeps=5, gravity=(0.0, 0.0, 0.0))
                # no start is longer than 3 m: at 30 m the sweeps have added energy
                lost |= (~torch.isfinite(x).all(-1) | (x.norm(dim=-1) > 30)).any(-1)
                x, v = torch.where(lost[:, None, None], points, x), torch.where(lost[:, None, None], 0.0, v)
            grown += int(lost.sum())
            total += len(lost)
        out.append({"relaxation": omega, "grown": grown, "rollouts": total})
    return out


# --- the paper's preset on bodies of other sizes ----------------------------------------------------------------------


def paper_preset(quick: bool) -> list[dict[str, Any]]:
    """Error of one step after 20 sweeps relative to the converged one, for the preset and for the default."""
    out = []
    for size in (3e-3, 1.0) if quick else (1e-3, 3e-3, 1e-2, 0.1, 1.0, 10.0, 100.0, 1e3):
        mesh = dv.mesh.cube(3, size=size, split="kuhn")
        pinned = mesh.points[:, 0] < 1e-9 * size
        models = {"paper": dv.Model.paper(mesh, pinned=pinned), "exact": dv.Model(mesh, pinned=pinned)}
        points = models["exact"].rest_points
        noise = torch.from_numpy(testing.generator("paper").uniform(-1, 1, (2, *points.shape)))
        x = torch.where(models["exact"].pinned[:, None], points, points + 0.1 * size * noise[0])
        # stiffness and speed follow the size and there is no gravity: without safeguards every size behaves alike
        options = {"mu": 1e5 * size**2, "lam": 1.5e5 * size**2, "time_step": 1 / 60, "gravity": (0.0, 0.0, 0.0)}
        v = size * noise[1]
        goal, _ = dv.step(models["exact"], x, v, sweeps=2000 if quick else 20_000, **options)
        light = float(models["exact"].mass[models["exact"].color_vertices].min())
        row = {"size": size, "regularization_over_mass": 1e-6 / light, "saturation_over_edge": 0.1 / (size / 2)}
        for name, model in models.items():
            got, _ = dv.step(model, x, v, sweeps=20, **options)
            row[f"error_{name}"] = float((got - goal).norm() / (goal - x).norm())
        out.append(row)
    return out


# --- momentum ---------------------------------------------------------------------------------------------------------


def momentum(quick: bool) -> list[dict[str, Any]]:
    """What unconverged sweeps of a free body add to its momentum in one step without the rigid correction. (Converged,
    or with it: nothing.)"""
    mesh = dv.mesh.cube(4, split="kuhn")
    model = dv.Model(mesh, rigid=False)
    noise = torch.from_numpy(testing.generator("momentum").uniform(-1, 1, (2, mesh.num_vertices, 3)))
    x, v = model.rest_points + 0.03 * noise[0], noise[1]
    mass, h, out = model.mass[:, None], 1 / 60, []
    for mu in (1e5, 1e7):
        for k in (5, 100) if quick else (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 5000):
            x1, v1 = dv.step(model, x, v, mu=mu, lam=1.5 * mu, time_step=h, sweeps=k, gravity=(0.0, 0.0, 0.0))
            turn = mass * (torch.linalg.cross(x1, v1) - torch.linalg.cross(x, v) - h * torch.linalg.cross(v1, v))
            out.append(
                {
                    "mu": mu,
                    "sweeps": k,
                    "linear": float((mass * (v1 - v)).sum(0).norm() / (mass * v.norm(dim=-1, keepdim=True)).sum()),
                    "angular": float(turn.sum(0).norm() / (mass * torch.linalg.cross(x, v)).norm(dim=-1).sum()),
                }
            )
    return out


def markdown(results: dict[str, Any]) -> str:
    titles = {
        "well": "The F = 0 well: uniform stretch; share of random tets with |F| = margin sqrt(3) s* that collapse",
        "float32": "float32: largest relative error of the gradients of one step (x, v, mu, lam), K = 10",
        "conditioning": "Conditioning of the gradient over the strain of one step, K = 5",
        "relaxation": "Rollouts of 300 steps that grow without bound, K = 5",
        "paper_preset": "The paper's preset on a cube of another size: error of one step after 20 sweeps",
        "momentum": "Momentum that one unconverged step adds without the rigid correction, relative",
    }
    return titled_tables(results, titles)
