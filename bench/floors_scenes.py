"""Scenes of `bench floors`: the two of a ball, and bodies that are thrown on a floor, drawn by a seed."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

import diffvbd as dv
from bench.floors_newton import Body
from diffvbd import mesh

SEED = 61
SLIVER = 0.1  # quality below which a tet is left out of a ball
HELD = 0.06  # height above its center from which the pressed ball is held [m]
PRESSED, PRESSING, STEPS = 0.02, 5, 10  # the way down [m], in so many steps of so many
Array = NDArray[np.float64]


@dataclass(frozen=True)
class Scene:
    """A body above the plane y = 0; ``body`` has all of its numbers [SI units]."""

    name: str
    mesh: dv.TetMesh
    body: Body
    v: Array  # [V, 3] [m/s]
    steps: int
    prescribed: Array | None = None  # [steps, V, 3] [m]

    @property
    def spacing(self) -> float:
        """Mean distance of vertices [m]."""
        return float(self.mesh.volume.sum() / self.mesh.num_vertices) ** (1 / 3)

    @property
    def stiffness(self) -> float:
        """How many vertices a wave passes in a step."""
        return self.body.time_step * (self.body.young / self.body.density) ** 0.5 / self.spacing

    def energies(self) -> tuple[Any, ...]:
        b = self.body
        rubs = (dv.Friction(b.friction, velocity=b.eps_v),) if b.friction else ()
        return (dv.StableNeoHookean(), dv.FloorBarrier(kappa=b.kappa, dhat=b.dhat), *rubs)

    def executed(self, sweeps: int, coarse: Any = None, **options: Any) -> tuple[dv.Trajectory, dv.Model, list[str]]:
        """Its rollout, the Model, and what was said of either."""
        b, held = self.body, self.prescribed
        with warnings.catch_warnings(record=True) as said, torch.no_grad():
            warnings.simplefilter("always")
            model = dv.Model(self.mesh, b.density, b.pinned, self.energies(), coarse=coarse, **options)
            motion = dv.rollout(model, model.rest_points, torch.from_numpy(self.v), steps=self.steps, young=b.young,
                                poisson=b.poisson, time_step=b.time_step, sweeps=sweeps, gravity=b.gravity,
                                prescribed=None if held is None else dv.per_step(torch.from_numpy(held)))  # fmt: skip
        return motion, model, [str(w.message) for w in said]


def ball(radius: float, spacing: float, seed: int = 0) -> dv.TetMesh:
    """Delaunay tets of points in a ball about the origin: even ones on its surface, random ones inside."""
    from scipy.spatial import Delaunay

    rng, golden = np.random.default_rng(seed), np.pi * (3 - 5**0.5)
    outside = round(4 * np.pi * (radius / spacing) ** 2 * 2 / 3**0.5)
    height = 1 - 2 * (np.arange(outside) + 0.5) / outside
    angle, ring = golden * np.arange(outside), np.sqrt(1 - height**2)
    points = radius * np.stack([ring * np.cos(angle), height, ring * np.sin(angle)], 1)
    for inner in rng.uniform(-radius, radius, (4000, 3)):
        far = np.linalg.norm(points - inner, axis=1).min() > 0.85 * spacing
        if far and np.linalg.norm(inner) < radius - 0.5 * spacing:
            points = np.vstack([points, inner])
    tets = Delaunay(points).simplices
    edges = points[tets[:, 1:]] - points[tets[:, :1]]
    flat = np.abs(np.linalg.det(edges)) < 1e-3 * np.linalg.norm(edges, axis=2).mean(1) ** 3
    whole = dv.TetMesh(points, tets[~flat], orient=True)
    return dv.TetMesh(points, whole.tets[whole.quality > SLIVER])


def falling_ball() -> Scene:
    """A ball of 0.1 m and 1e5 Pa that meets the floor at 2 m/s, without gravity."""
    shape = ball(0.1, 0.0325)
    shape = shape.translate((0.0, 0.01 - shape.points[:, 1].min(), 0.0))
    body = Body(shape.points, shape.tets, 1e5, 0.3, 2e-3, 2e5, 5e-3)
    v = np.zeros_like(shape.points)
    v[:, 1] = -2.0
    return Scene("falling ball", shape, body, v, 60)


def pressed_ball() -> Scene:
    """The ball held by its upper cap, which goes 20 mm down from where the barrier begins, and stays."""
    shape = ball(0.1, 0.0325)
    pinned = shape.points[:, 1] > HELD
    shape = shape.translate((0.0, 5e-3 - shape.points[:, 1].min(), 0.0))
    body = Body(shape.points, shape.tets, 1e5, 0.3, 2e-2, 2e5, 5e-3, pinned=pinned)
    way = PRESSED * np.minimum(1, np.arange(1, STEPS + 1) / PRESSING)
    prescribed = shape.points - way[:, None, None] * np.array([0.0, 1.0, 0.0])
    prescribed[:, ~pinned] = np.nan
    return Scene("pressed ball", shape, body, np.zeros_like(shape.points), STEPS, prescribed)


def _shape(rng: np.random.Generator) -> tuple[str, dv.TetMesh]:
    from scipy.spatial.transform import Rotation

    kind, size = ("ball", "cube", "taper")[rng.integers(3)], float(rng.uniform(0.05, 0.3))
    if kind == "ball":
        return kind, ball(size / 2, size * float(rng.uniform(0.19, 0.3)), int(rng.integers(1000)))
    if kind == "cube":
        shape = mesh.cube(int(rng.integers(4, 7)), size, split=("kuhn", "five")[rng.integers(2)])
    else:
        n = int(rng.integers(3, 5))
        shape = mesh.box((n, int(rng.integers(5, 10)), n), (0.5 * size, size, 0.5 * size))
        points, narrow = shape.points.copy(), float(rng.uniform(0.3, 0.8))
        points[:, ::2] *= 1 - narrow * points[:, 1:2] / size
        shape = dv.TetMesh(points, shape.tets)
    if rng.integers(2):  # on a corner or an edge; else flat, a taper on its wide end or its tip
        turn = Rotation.random(rng=rng)
    else:
        turn = Rotation.from_euler("x", float(180 * rng.integers(2)), degrees=True)
    return kind, dv.TetMesh(turn.apply(shape.points.copy()), shape.tets)


def drawn(number: int) -> Scene:
    """Scene `number` of the seed: half of them with gravity, every fourth with friction and some speed along the floor.

    A barrier is 0.3 to 100 times as stiff as the body is at a vertex, or as it takes to stop one.
    """
    rng = np.random.default_rng((SEED, number))
    kind, shape = _shape(rng)
    size = float(np.ptp(shape.points, axis=0).max())
    young, poisson, speed = (
        float(10 ** rng.uniform(4.477, 7)),
        float(rng.uniform(0.2, 0.45)),
        float(rng.uniform(0.5, 5)),
    )
    h, dhat = 1e-3 * float(rng.uniform(1, 5)), size * float(rng.uniform(0.01, 0.05))
    spacing = (float(np.abs(shape.volume).sum()) / shape.num_vertices) ** (1 / 3)
    least = max(young * spacing, 0.5 * 1000 * spacing**3 * speed**2 / dhat**2)
    kappa = least * float(10 ** rng.uniform(-0.5, 2))
    shape = shape.translate((0, dhat + speed * h * float(rng.uniform(0, 3)) - shape.points[:, 1].min(), 0))
    friction = float(rng.uniform(0.1, 0.8)) if number % 4 == 3 else 0.0
    gravity = (0.0, -9.81 if number % 2 else 0.0, 0.0)
    body = Body(shape.points, shape.tets, young, poisson, h, kappa, dhat, friction=friction, gravity=gravity)
    v = np.zeros_like(shape.points)
    v[:, 1] = -speed
    if friction:
        v[:, 0] = float(rng.uniform(-0.5, 0.5)) * speed
    name = f"{number}: {kind}, {shape.num_vertices} vertices"
    return Scene(name, shape, body, v, int(rng.integers(20, 61)))
