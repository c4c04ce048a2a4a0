"""Violent scenes, drawn by a seed: no edge may pass through a triangle, and nothing may become non-finite.

Bodies of a mesh start at random turns, thrown at each other at up to 60 m/s, with vertices that move on their own, on a
floor, among colliders that move, with anything between one sweep and eight; every fifth batch in single precision,
every fourth with coarse corrections, every seventh with SDIRK2 and another with BDF2. Every step of every scene is
looked at by the exact test of `dv.contact.intersections`.
"""

from __future__ import annotations

import sys
import time
from typing import Any

import numpy as np
import torch

import diffvbd as dv
from bench.common import markdown_table
from diffvbd import mesh

SCENES, BATCH, STEPS = 2000, 40, 6
SPEEDS = (2.0, 10.0, 60.0)  # [m/s]
DHAT = 2e-3  # [m]
INTEGRATORS = {1: dv.SDIRK2(), 4: dv.BDF2()}  # by seed modulo 7


def _bodies(rng: np.random.Generator) -> list[dv.TetMesh]:
    kinds = (
        lambda: mesh.box(int(rng.integers(2, 4)), 0.1, split="kuhn"),
        lambda: mesh.sheet(5, 5, (0.14, 0.14), float(rng.uniform(0.01, 0.03))),
        lambda: mesh.blob(4, int(rng.integers(100)), 0.06),
    )
    places = [np.array([i, j, 0.0]) for j in range(2) for i in range(2)]
    chosen = [kinds[rng.integers(3)]() for _ in range(int(rng.integers(2, 5)))]
    return [
        _turned(body, rng).translate(0.24 * place + [0, 0.15, 0]) for body, place in zip(chosen, places, strict=False)
    ]


def _turned(body: dv.TetMesh, rng: np.random.Generator) -> dv.TetMesh:
    q, _ = np.linalg.qr(rng.standard_normal((3, 3)))
    q[:, 0] *= np.sign(np.linalg.det(q))
    return dv.TetMesh((body.points - body.points.mean(0)) @ q.T, body.tets)


def _scenes(seed: int, device: str, batch: int) -> dict[str, Any]:
    """Scenes of one mesh."""
    rng = np.random.default_rng(seed)
    tets, speed = mesh.join(_bodies(rng)), SPEEDS[seed % len(SPEEDS)]
    energies: tuple[Any, ...] = (
        dv.StableNeoHookean(),
        dv.PairBarrier(kappa=float(10 ** rng.uniform(2, 5)), dhat=DHAT, damping=float(rng.choice([0.0, 5.0])),
                       detections=(None, 1, 2)[rng.integers(3)]),
    )  # fmt: skip
    energies += (dv.Friction(float(rng.uniform(0, 0.8))),) if rng.random() < 0.6 else ()
    energies += (dv.FloorBarrier(kappa=1e4, dhat=DHAT),) if rng.random() < 0.6 else ()
    ball = dv.colliders.Sphere(center=(0.1, 0.62, 0.0), radius=0.05)
    colliders = (ball,) if rng.random() < 0.5 else ()
    dtype, coarse = torch.float32 if seed % 5 == 2 else torch.float64, "auto" if seed % 4 == 3 else None
    model = dv.Model(tets, energies=energies, colliders=colliders, coarse=coarse, dtype=dtype, device=device)
    toward = rng.standard_normal((batch, tets.num_bodies, 1, 3))
    v = speed * toward / np.linalg.norm(toward, axis=-1, keepdims=True)
    v = v[:, tets.body, 0] + 0.2 * speed * rng.standard_normal((batch, tets.num_vertices, 3))
    x = model.rest_points.expand(batch, -1, -1).clone()
    return {"model": model, "x": x, "v": torch.from_numpy(v).to(x), "sweeps": int(rng.integers(1, 9)),
            "modulus": float(10 ** rng.uniform(3, 7)), "time_step": float(10 ** rng.uniform(-2.7, -1.3))}  # fmt: skip


def _crossings(seed: int, device: str, batch: int) -> tuple[int, int, int, float]:
    """Of all steps: crossings, numbers that are not finite, steps, and the mean share of cut vertices."""
    s = _scenes(seed, device, batch)
    model, x, v = s["model"], s["x"], s["v"]
    crossings = lost = 0
    cut, points = [], model.collider_points
    integrator, history = INTEGRATORS.get(seed % 7, dv.ImplicitEuler()), None
    for step in range(STEPS):
        given: dict[str, Any] = {}
        if len(points):  # it comes down on them
            before, points = points, points - points.new_tensor([0.0, 0.01 * (step % 3), 0.0])
            given = {"colliders": points, "colliders_before": before}
        try:
            x, v, *past = dv.step(model, x, v, mu=s["modulus"], lam=s["modulus"], time_step=s["time_step"],
                                  sweeps=s["sweeps"], integrator=integrator, history=history, **given)  # fmt: skip
            history = past[0] if past else None
        except ValueError as error:  # what is prescribed leaves bodies no way: said, not done
            if "leaves bodies a way" not in str(error):
                raise
            return crossings, lost, step, float(np.mean(cut or [0.0]))
        crossings += len(dv.contact.intersections(model, x))
        lost += int((~torch.isfinite(x)).sum() + (~torch.isfinite(v)).sum())
        cut.append(float(np.mean(dv.contact.status(model).cut)) / model.num_vertices)
    return crossings, lost, STEPS, float(np.mean(cut))


def run(quick: bool, device: str = "cpu") -> dict[str, Any]:
    began, rows, batch = time.perf_counter(), {speed: [0, 0, 0, 0, 0.0] for speed in SPEEDS}, 10 if quick else BATCH
    for seed in range(3 if quick else SCENES // BATCH):
        found = _crossings(seed, device, batch)
        row = rows[SPEEDS[seed % len(SPEEDS)]]
        row[0] += batch
        for k in range(3):
            row[1 + k] += found[k] * (batch if k == 2 else 1)
        row[4] += batch * found[3]
        print(f"{seed}: {found}", file=sys.stderr, flush=True)
    keys = ("scenes", "crossings", "nonfinite", "scene_steps", "cut")
    out = [{"speed": speed, **dict(zip(keys, row, strict=True))} for speed, row in rows.items()]
    for row in out:
        row["cut"] /= max(row["scenes"], 1)
    return {"rows": out, "seconds": time.perf_counter() - began}


def markdown(results: dict[str, Any]) -> str:
    keys = ("speed", "scenes", "scene_steps", "crossings", "nonfinite", "cut")
    header = ("up to [m/s]", "scenes", "steps of a scene", "crossings", "not finite", "cut")
    return "## Violent scenes\n\n" + markdown_table(header, ([row[k] for k in keys] for row in results["rows"]))
