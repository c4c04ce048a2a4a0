"""Scenes of `bench.twolevel`: stiff, thin, of mixed stiffness; and bars that begin far from where they would rest."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

import diffvbd as dv
from bench import sweeps

RELAXATION = 1.5  # with corrections


@dataclass(frozen=True)
class Scene:
    name: str
    mesh: dv.TetMesh
    pinned: np.ndarray
    material: dict[str, Any]  # mu, lam [Pa]
    time_step: float = 1 / 60
    x: Tensor | None = None  # None: at rest
    v: Tensor | None = None
    targets: tuple[float | None, float | None] = (None, None)  # plain sweeps that 1 % and 0.01 % may take

    def state(self) -> tuple[Tensor, Tensor]:
        x = torch.from_numpy(self.mesh.points.copy()) if self.x is None else self.x
        return x, torch.zeros_like(x) if self.v is None else self.v

    def model(self, coarse: Any = "auto", relaxation: float = RELAXATION, start: Any = "auto", window: int = 0
              ) -> dv.Model:  # fmt: skip
        """window: of Anderson's method; 0: without."""
        return dv.Model(self.mesh, pinned=torch.from_numpy(self.pinned), relaxation=relaxation, start=start,
                        coarse=coarse, acceleration=dv.Anderson(window) if window else None)  # fmt: skip

    def end(self, model: dv.Model, sweeps: int, steps: int) -> Tensor:
        return self.rolled(model, sweeps, steps, "last").x[-1]

    def rolled(self, model: dv.Model, sweeps: int, steps: int, save: Any = "all") -> dv.Trajectory:
        options = {"steps": steps, "time_step": self.time_step, "sweeps": sweeps, "save": save, **self.material}
        with torch.no_grad():
            return dv.rollout(model, *self.state(), **options)

    def seconds(self, model: dv.Model, sweeps: int) -> float:
        """Of a step, over ten."""
        begun = time.perf_counter()
        self.rolled(model, sweeps, 10, "last")
        return (time.perf_counter() - begun) / 10


def scenes(quick: bool) -> list[Scene]:
    if quick:
        return [cantilever((5, 3, 3)), sheet(0.25, 45, cells=4), blob(1e3, count=60)]
    sizes = ((13, 5, 5), (21, 7, 7), (41, 13, 13))
    return [*map(cantilever, sizes), hanging_bar(), sheet(0.25, 45), sheet(0.05, 70), blob(1e3), blob(1e6)]


def cantilever(counts: tuple[int, int, int]) -> Scene:
    mesh = dv.mesh.beam(*counts, size=(1.0, 0.2, 0.2), split="kuhn")
    name = f"cantilever, {mesh.num_vertices} vertices"
    return Scene(name, mesh, mesh.points[:, 0] < 1e-9, {"mu": 1e7, "lam": 1e7}, targets=(16, 30))


def hanging_bar() -> Scene:
    model = sweeps.bar()
    return Scene("hanging bar", model.mesh, model.pinned.numpy(), dict(sweeps.MATERIAL))


def sheet(ratio: float, target: float, cells: int = 20) -> Scene:
    """1 m square of one layer, held at one edge; ratio: thickness over the width of a cell."""
    mesh = dv.mesh.beam(cells + 1, 2, cells + 1, size=(1.0, ratio / cells, 1.0), split="kuhn")
    name = f"sheet, thickness 1/{round(1 / ratio)} cell"
    return Scene(name, mesh, mesh.points[:, 0] < 1e-9, {"mu": 1e6, "lam": 1.5e6}, targets=(target, None))


def blob(contrast: float, count: int = 1000) -> Scene:
    """A soft ellipsoid with eight stiff balls in it, held at one end; an unstructured mesh."""
    from scipy.spatial import Delaunay

    rng = np.random.default_rng(0)
    half = np.array([0.5, 0.35, 0.35])
    apart = 0.85 * (4 / 3 * np.pi * half.prod() / count) ** (1 / 3)
    kept = np.full((count, 3), np.inf)
    n = 0
    for point in rng.uniform(-1, 1, (60 * count, 3)):
        at = half * point
        if n < count and point @ point < 1 and np.square(kept[:n] - at).sum(1).min(initial=np.inf) > apart**2:
            kept[n], n = at, n + 1
    tets = Delaunay(kept[:n]).simplices
    corners = kept[tets]
    edges = corners[:, 1:] - corners[:, :1]
    longest = np.linalg.norm(edges, axis=2).max(1)
    tets = tets[np.abs(np.linalg.det(edges)) / 6 > 3e-3 * longest**3]
    used, renumbered = np.unique(tets, return_inverse=True)
    mesh = dv.TetMesh(kept[used], renumbered.reshape(-1, 4), orient=True)
    centers = mesh.points[mesh.tets].mean(1)
    balls = rng.uniform(-1, 1, (8, 3)) * [0.35, 0.2, 0.2]
    stiff = (np.linalg.norm(centers[:, None] - balls, axis=-1) < 0.12).any(1)
    mu = torch.from_numpy(np.where(stiff, 1e4 * contrast, 1e4))
    return Scene(f"contrast {contrast:.0e}", mesh, mesh.points[:, 0] < -0.38, {"mu": mu, "lam": 1.5 * mu},
                 targets=(40, None))  # fmt: skip


def violent_scenes(quick: bool) -> list[Scene]:
    """A bar of 0.5 m, held at x = 0, that begins far from where it would rest."""
    mesh = dv.mesh.beam(*((5, 3, 3) if quick else (21, 7, 7)), size=(0.5, 0.2, 0.2), split="kuhn")
    points = torch.from_numpy(mesh.points.copy())
    pinned = mesh.points[:, 0] < 1e-9
    cell = 0.5 / (4 if quick else 20)

    def twisted(degrees: float) -> Tensor:
        angle = np.deg2rad(degrees) * points[:, 0] / 0.5
        middle = points[:, 1:].mean(0)
        y, z = (points[:, 1:] - middle).unbind(1)
        sin, cos = torch.sin(angle), torch.cos(angle)
        return torch.stack((points[:, 0], middle[0] + cos * y - sin * z, middle[1] + sin * y + cos * z), 1)

    def along(factor: float) -> Tensor:
        return points * torch.tensor([factor, 1.0, 1.0], dtype=torch.float64)

    noise = torch.from_numpy(np.random.default_rng(0).uniform(-0.5, 0.5, points.shape))
    noise[torch.from_numpy(pinned)] = 0
    speed = torch.zeros_like(points)
    speed[:, 1] = 300 * points[:, 0] / 0.5
    states = {"twist 60 degrees": twisted(60), "twist 180 degrees": twisted(180), "stretched 3x": along(3),
              "mirrored": along(-1), "squashed to 0.05": along(0.05), "noise of half a cell": points + cell * noise,
              "tip at 300 m/s": points}  # fmt: skip
    if quick:
        states = {"twist 60 degrees": twisted(60), "mirrored": along(-1)}
    material = {"mu": 1e6, "lam": 1.5e6}
    return [
        Scene(name, mesh, pinned, material, 0.01, x, speed if name.startswith("tip") else None)
        for name, x in states.items()
    ]


def functions(model: dv.Model) -> int:
    return int((~model.coarse_geometry.filling).sum())
