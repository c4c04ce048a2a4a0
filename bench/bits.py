"""Hashes of outputs and gradients: what a change that must change no result is held against.

`python -m bench bits --out BEFORE`, the same after the change, and compare the two files: equal hashes are equal bits
on that machine. Scenes are those of the tests: all energies, contact, both dtypes, both tapes, batches, solvers; and
the rollouts of `bench.bits_rollouts`. A hash does not tell 0 from -0.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

import diffvbd as dv
from bench import bits_rollouts, generality
from diffvbd import testing
from diffvbd.solvers import XPBD, ProjectiveDynamics
from diffvbd.testing import contact_scenes
from diffvbd.testing.scenes import CASES

SWEEPS, STEPS = 4, 2
FLOAT32 = ("plain", "paper", "relaxed", "floor_damped", "floor_corner", "anchored", "free_corner", "batch")
COMPACT = ("plain", "saturated", "floor_filtered", "anchored", "free_batch")
SOLVERS: dict[str, Callable[..., Any]] = {"XPBD": XPBD.from_mesh, "projective dynamics": ProjectiveDynamics.from_mesh}


def run(quick: bool, *, device: str = "cpu") -> dict[str, Any]:
    cases = list(CASES)[:4] if quick else list(CASES)
    rows = {name: of_case(name, device) for name in cases}
    if not quick:
        rows["no tets' energy"] = of_vertices(device)
    rows |= {f"{name}, float32": of_case(name, device, torch.float32) for name in FLOAT32 if name in cases}
    rows |= {f"{name}, compact tape": of_case(name, device, tape="compact") for name in COMPACT if name in cases}
    for name, make in ({} if quick else contact_scenes.SCENES).items():
        for tape in ("full", "compact"):
            scene = make()
            found, _ = contact_scenes.compiled(scene, STEPS, scene.solver(SWEEPS, tape=tape), scene.model.to(device))
            rows[f"contact: {name}, {tape} tape"] = digest(found)
    rows |= {name: of_solver(make, device) for name, make in ({} if quick else SOLVERS).items()}
    rollouts = bits_rollouts.rows(device).items()
    rows |= {name: digest(work()) for name, work in list(rollouts)[: 4 if quick else None]}
    return {"sweeps": SWEEPS, "steps": STEPS, "hashes": rows}


def of_case(name: str, device: str, dtype: torch.dtype = torch.float64, tape: str = "full") -> str:
    """The hash of one case of `testing.CASES` on the mesh with shuffled vertices."""
    scene = testing.build_scene(name, "random", "small")
    model, solver = scene.model(device).to(dtype=dtype), scene.solver(SWEEPS, tape=tape)

    def rollout(x: Tensor, v: Tensor, **options: Any) -> tuple[Tensor, Tensor]:
        for _ in range(STEPS):
            x, v = dv.step(model, x, v, solver, **options)
        return x, v

    return digest(testing.evaluate(rollout, scene.inputs(dtype, device), solver.time_step))


def of_vertices(device: str) -> str:
    """The hash of one step of a box whose only energies are those of single vertices."""
    box = dv.mesh.box((3, 4, 3), (0.2, 0.3, 0.2), split="kuhn")
    near = dv.FloorBarrier(height=-0.01, kappa=2e4, dhat=0.05)
    model = dv.Model(box, energies=(near, dv.Anchor(50.0)), device=device)
    x = model.rest_points
    inputs, solver = {"x": x + 0.004 * torch.sin(9 * x.flip(-1)), "v": torch.cos(7 * x)}, dv.VBD(1 / 60, SWEEPS)
    return digest(testing.evaluate(lambda **given: dv.step(model, solver=solver, **given), inputs, solver.time_step))


def of_solver(make: Callable[..., Any], device: str) -> str:
    """The hash of one step of another block solver on a box, loaded as in `generality`."""
    mesh = dv.mesh.box((3, 4, 3), (0.2, 0.3, 0.2), split="kuhn")
    solver = make(mesh, pinned=mesh.points[:, 1] < 0.01, device=device)
    inputs = testing.on_device(generality.scene(mesh, make(mesh, pinned=mesh.points[:, 1] < 0.01)), device)
    return digest(testing.evaluate(lambda **given: solver.step(**given, sweeps=SWEEPS), inputs, inputs["time_step"]))


def digest(values: dict[str, Tensor]) -> str:
    """Of all tensors, in the order of their names; adding 0 makes -0 one."""
    out = hashlib.sha256()
    for name in sorted(values):
        out.update(name.encode())
        out.update((values[name].detach().cpu() + 0.0).contiguous().numpy().tobytes())
    return out.hexdigest()[:16]


def markdown(results: dict[str, Any]) -> str:
    rows = results["hashes"]
    return "\n".join(f"{value}  {name}" for name, value in rows.items())
