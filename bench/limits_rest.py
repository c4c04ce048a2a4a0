"""Bodies at rest, sliding, falling and turning at few sweeps, with the rigid correction and without it."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

import diffvbd as dv
from bench.common import markdown_table

H, GROUND = 0.01, {"height": 0.0, "kappa": 1e3, "dhat": 1e-2}
SWEEPS = (0, 1, 2, 3, 5, 10)


def run(quick: bool, device: str = "cpu", only: str | None = None) -> dict[str, Any]:
    groups = {"rest": at_rest, "drift": drift, "momentum": momentum, "spin": spin}
    chosen = list(groups) if only is None else [name.strip() for name in only.split(",")]
    return {name: groups[name](quick, device) for name in chosen}


def _cube(device: str, lift: float, relaxation: float, rigid: bool) -> dv.Model:
    """27 vertices, 0.2 m, 3000 kg/m^3, above a floor without friction."""
    mesh = dv.mesh.cube(3, size=0.2, split="kuhn").translate((0.0, lift, 0.0))
    energies = (dv.StableNeoHookean(), dv.FloorBarrier(**GROUND))
    return dv.Model(mesh, density=3000.0, energies=energies, relaxation=relaxation, rigid=rigid, device=device)


@torch.no_grad()
def _watched(model: dv.Model, steps: int, sweeps: int, speed: float = 0.0) -> dict[str, Any]:
    """What became of a body that was let go, or thrown down."""
    x, v = model.rest_points.clone(), torch.zeros_like(model.rest_points)
    v[:, 1] -= speed
    low, mu = torch.full((), torch.inf, dtype=x.dtype, device=x.device), 2e5
    for _ in range(steps):
        try:
            x, v = dv.step(model, x, v, mu=mu, lam=2 * mu, time_step=H, sweeps=sweeps)
        except ValueError:  # the state before was no longer finite, or below the floor
            x, v, low = x * torch.nan, v * torch.nan, low * torch.nan
            break
        low = torch.minimum(low, x[:, 1].min())
    moved = (x - model.rest_points).mean(0)
    return {
        "lowest_gap": float(low),
        "gap": float(x[:, 1].min()),
        "speed": float(v.norm(dim=-1).max()),
        "drift": float(moved[[0, 2]].norm()),
    }


def at_rest(quick: bool, device: str) -> list[dict[str, Any]]:
    """A cube let go 2 mm above where its barrier begins, 1,500 steps."""
    out = []
    for rigid in (False, True):
        for sweeps in (1, 5) if quick else SWEEPS:
            for relaxation in (1.0,) if quick else (0.5, 1.0, 1.6):
                model = _cube(device, 0.012, relaxation, rigid)
                steps = 50 if quick else (1500 if device == "cpu" else 400)
                row = {"rigid": rigid, "sweeps": sweeps, "relaxation": relaxation, "steps": steps}
                out.append(row | _watched(model, steps, sweeps))
    return out


def drift(quick: bool, device: str) -> list[dict[str, Any]]:
    """The same cube thrown down at 3 m/s from 0.3 m, 300 steps."""
    return [
        {"rigid": rigid, "sweeps": k} | _watched(_cube(device, 0.3, 1.0, rigid), 20 if quick else 300, k, speed=3.0)
        for rigid in (False, True)
        for k in ((1,) if quick else (1, 5, 10))
    ]


def momenta(model: dv.Model, x: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
    mass = model.mass[:, None]
    center = (mass * x).sum(0) / mass.sum()
    return (mass * v).sum(0), torch.linalg.cross(x - center, mass * v).sum(0)


def _turning(quick: bool, device: str) -> list[dict[str, Any]]:
    """A free cube of 64 vertices with 1 m/s and 8 rad/s, 60 steps: momenta before and after."""
    out = []
    for mu in (1e5, 1e7):
        for sweeps in (2,) if quick else (2, 5, 20, 300):
            for rigid in (False, True):
                model = dv.Model(dv.mesh.cube(4, size=0.2, split="kuhn"), rigid=rigid, device=device)
                x = model.rest_points.clone()
                axis = torch.tensor([0.0, 0.0, 8.0], dtype=x.dtype, device=x.device)
                v = torch.linalg.cross(axis.expand_as(x), x - x.mean(0))
                v[:, 0] += 1.0
                before = momenta(model, x, v)
                with torch.no_grad():
                    for _ in range(60):
                        x, v = dv.step(model, x, v, mu=mu, lam=mu, time_step=H, sweeps=sweeps, gravity=(0.0, 0.0, 0.0))
                after = momenta(model, x, v)
                lost = float((after[0] - before[0]).norm() / before[0].norm())
                left = float(after[1][2] / before[1][2])
                out.append({"mu": mu, "sweeps": sweeps, "rigid": rigid, "lost": lost, "left": left})
    return out


def momentum(quick: bool, device: str) -> list[dict[str, Any]]:
    """Relative error of the linear momentum."""
    return [{k: row[k] for k in ("mu", "sweeps", "rigid", "lost")} for row in _turning(quick, device)]


def spin(quick: bool, device: str) -> list[dict[str, Any]]:
    """Share of the angular momentum that is left; converged steps of implicit Euler keep 0.7548."""
    return [{k: row[k] for k in ("mu", "sweeps", "rigid", "left")} for row in _turning(quick, device)]


def markdown(results: dict[str, Any]) -> str:
    titles = {
        "rest": "A cube at rest on a frictionless floor: gaps [m], speed [m/s], drift [m]",
        "drift": "The cube thrown down at 3 m/s, after 300 steps",
        "momentum": "A free spinning cube: relative error of its momentum after 60 steps",
        "spin": "The same: share of the angular momentum that is left (converged: 0.7548)",
    }
    parts = []
    for name, rows in results.items():
        header = [k.replace("_", " ") for k in rows[0]]
        parts.append(f"## {titles[name]}\n\n" + markdown_table(header, [list(r.values()) for r in rows]))
    return "\n".join(parts)
