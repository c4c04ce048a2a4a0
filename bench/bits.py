"""Hashes of outputs and gradients: what a change that must change no result is held against.

`python -m bench bits --out BEFORE`, the same after the change, and compare the two files: equal hashes are equal bits
on that machine. Scenes are those of the tests: all energies, contact, both dtypes, both tapes, batches, solvers; and
rollouts with coarse corrections, integrators, checkpoints, piles of bodies, contact in float32, converged steps,
captured CUDA graphs. Outputs and gradients of each, by the public interface. A hash does not tell 0 from -0.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

import diffvbd as dv
from bench.measure import capture
from diffvbd import testing
from diffvbd._common.checks import input_name
from diffvbd.solvers import XPBD, ProjectiveDynamics
from diffvbd.testing import contact_scenes
from diffvbd.testing.contact_scenes import noise
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
    of_rollouts = rollouts(device).items()
    rows |= {name: digest(work()) for name, work in list(of_rollouts)[: 4 if quick else None]}
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
    """The hash of one step of another block solver on a box, loaded."""
    mesh = dv.mesh.box((3, 4, 3), (0.2, 0.3, 0.2), split="kuhn")
    solver = make(mesh, pinned=mesh.points[:, 1] < 0.01, device=device)
    inputs = testing.on_device(loaded(mesh, make(mesh, pinned=mesh.points[:, 1] < 0.01)), device)
    return digest(testing.evaluate(lambda **given: solver.step(**given, sweeps=SWEEPS), inputs, inputs["time_step"]))


# What inputs of energies were called when hashes were first kept; a name is part of its hash
FIRST_NAMES = {"floor_": "floor_barrier.", "pair_": "pair_barrier.", "anchor_": "anchor.",
               "friction": "friction.coefficient"}  # fmt: skip


def digest(values: dict[str, Tensor]) -> str:
    """Of all tensors, in the order of their names; adding 0 makes -0 one."""
    named = {}
    for name, value in values.items():
        own = name.removeprefix("grad_")
        first = next((old + own.removeprefix(new) for new, old in FIRST_NAMES.items() if own.startswith(new)), own)
        named[name.removesuffix(own) + first] = value
    out = hashlib.sha256()
    for name in sorted(named):
        out.update(name.encode())
        out.update((named[name].detach().cpu() + 0.0).contiguous().numpy().tobytes())
    return out.hexdigest()[:16]


Values = dict[str, Tensor]
STEP = 0.01  # [s]
SPACE = dv.CoarseSpace(functions=6, groups=2, every=2)
NEAR = dv.FloorBarrier(height=-0.012, kappa=3e4, dhat=0.02, damping=2.0)
TOUCHING = (NEAR, dv.PairBarrier(kappa=3e4, dhat=0.02, damping=2.0), dv.Friction(0.4, 0.05))
box_of = partial(dv.mesh.box, split="kuhn")


def rollouts(device: str) -> dict[str, Callable[[], Values]]:
    """What each row computes. On CUDA there are some more: of steps captured as a graph."""
    euler, sdirk2, bdf2 = dv.ImplicitEuler(), dv.SDIRK2(), dv.BDF2()
    bar, three = partial(beam, device), partial(bodies, device)
    corrected = {"subspace": "coarse", "relaxation": 1.5}
    low = {"dtype": torch.float32}
    out: dict[str, Callable[[], Values]] = {
        "coarse": lambda: end(bar(), **corrected),
        "coarse, one modulus": lambda: end(bar(), of_one=True, **corrected),
        "coarse, compact tape": lambda: end(bar(), tape="compact", **corrected),
        "coarse, float32": lambda: end(bar(**low), **corrected),
        "coarse, three bodies over a floor": lambda: end(three(energies=(NEAR,)), subspace=SPACE),
        "coarse, a batch": lambda: end(three(), batch=(2,), subspace=SPACE),
        "SDIRK2": lambda: end(bar(), sweeps=8, integrator=sdirk2),
        "SDIRK2, coarse": lambda: end(bar(), sweeps=12, integrator=sdirk2, **corrected),
        "SDIRK2, pairs": lambda: end(three(energies=TOUCHING), sweeps=8, integrator=sdirk2),
        "BDF2": lambda: end(bar(), steps=4, integrator=bdf2),
        "BDF2, coarse": lambda: end(bar(), steps=4, sweeps=8, integrator=bdf2, **corrected),
        "BDF2, pairs": lambda: end(three(energies=TOUCHING), steps=3, integrator=bdf2),
        "checkpoints": lambda: end(bar(), steps=5, checkpoint_every=2),
        "checkpoints, BDF2, coarse": lambda: end(
            bar(), steps=5, sweeps=8, integrator=bdf2, checkpoint_every=2, **corrected
        ),
        "checkpoints, pairs": lambda: end(three(energies=TOUCHING), steps=4, checkpoint_every=2),
        "binomial checkpoints": lambda: end(bar(), steps=6, checkpoint_every=dv.BinomialCheckpoints(2)),
        "inputs of each step": lambda: driven(bar()),
        "a pile of five": lambda: end(pile(device)),
        "a pile of five, coarse": lambda: end(pile(device), subspace=SPACE),
        "a pile of five, coarse, float32": lambda: end(pile(device, **low), subspace=SPACE),
        "two sheets, coarse": lambda: end(sheets(device), subspace="coarse"),
        "solve": lambda: solved(bar()),
        "solve, executed sweeps": lambda: solved(bar(), adjoint=dv.ReverseSweep()),
        "solve, coarse": lambda: solved(bar(), **corrected),
        "solve, SDIRK2": lambda: solved(bar(), integrator=sdirk2),
        "solve, pairs": lambda: solved(three(energies=TOUCHING), tolerance=1e-3, adjoint=dv.ReverseSweep()),
        "global adjoint": lambda: end(bar(), sweeps=60, integrator=euler, adjoint=dv.GlobalAdjoint()),
    }
    for name in ("stacked", "folded", "obstacles", "batched"):
        out[f"contact: {name}, float32"] = partial(of_contact, name, device, torch.float32)
    for name in ("stacked", "obstacles", "thrown", "batched"):
        out[f"contact: {name}, coarse"] = partial(of_contact, name, device, torch.float64, SPACE)
    on_cuda: dict[str, Callable[[], Values]] = {
        "captured": lambda: captured(bar()),
        "captured, coarse": lambda: captured(bar(), **corrected),
        "captured, pairs": lambda: captured(three(energies=TOUCHING)),
        "captured, pairs, coarse": lambda: captured(three(energies=TOUCHING), subspace=SPACE),
    }
    return out | on_cuda if torch.device(device).type == "cuda" else out


def beam(device: str, **options: Any) -> dv.Model:
    """Held at one end."""
    mesh = box_of((9, 4, 4), (0.6, 0.2, 0.2))
    return dv.Model(mesh, pinned=mesh.points[:, 0] < 1e-9, device=device, **options)


def bodies(device: str, *, energies: Sequence[Any] = (), **options: Any) -> dv.Model:
    """A bar with a pinned end that lies across two boxes on a floor."""
    bar = box_of((7, 3, 3), (0.5, 0.1, 0.1)).translate((0.0, 0.211, 0.03))
    box = box_of((3, 4, 3), (0.15, 0.2, 0.15))
    mesh = dv.mesh.join([bar, box, box.translate((0.3, 0.0, 0.01))])
    pinned = (mesh.body == 0) & (mesh.points[:, 0] < 1e-9)
    return dv.Model(mesh, pinned=pinned, energies=(dv.StableNeoHookean(), *energies), device=device, **options)


def pile(device: str, **options: Any) -> dv.Model:
    """Five boxes on a floor, one on the other, each a little to the side."""
    box = box_of(3, 0.1)
    mesh = dv.mesh.join([box.translate((0.007 * k, 0.111 * k, 0.013 * (k % 2))) for k in range(5)])
    return dv.Model(mesh, energies=(dv.StableNeoHookean(), *TOUCHING), device=device, **options)


def sheets(device: str, **options: Any) -> dv.Model:
    """Two sheets, one 10 mm over the other."""
    sheet = dv.mesh.sheet(16, 12, size=(0.4, 0.3), thickness=0.005)
    mesh = dv.mesh.join([sheet, sheet.translate((0.011, 0.015, 0.007))])
    barrier = dv.PairBarrier(kappa=1e4, dhat=0.012, self_contact=False)
    return dv.Model(mesh, energies=(dv.StableNeoHookean(), barrier), device=device, **options)


def inputs_of(model: dv.Model, batch: tuple[int, ...] = (), *, of_one: bool = False) -> dict[str, Any]:
    """Of a step, all differentiable; ``of_one``: of one material, with the Model's own density and rest shape."""
    shape, per_tet = (*batch, model.num_vertices, 3), (*batch, model.num_tets)
    rest = model.rest_points.double().cpu()
    ranged = {name: size * torch.exp(noise("bits", name, shape=per_tet, size=0.2))
              for name, size in (("mu", 1e5), ("lam", 2e5))}  # fmt: skip
    x = rest + noise("bits", "x", shape=shape, size=5e-4)
    values: dict[str, Any] = {
        "x": x,
        "v": noise("bits", "v", shape=shape, size=0.1) - torch.tensor([0.0, 0.3, 0.0], dtype=torch.float64),
        "force": noise("bits", "force", shape=shape, size=0.3),
    }
    if model.pinned.any():
        held = x + noise("bits", "prescribed", shape=shape, size=2e-4)
        values["prescribed"] = torch.where(model.pinned.cpu()[:, None], held, torch.nan)
    if of_one:
        values |= {"mu": torch.tensor(1e5), "lam": torch.tensor(2e5)}
    else:
        density = 1000 * torch.exp(noise("bits", "density", shape=per_tet[-1:], size=0.1))
        values |= {**ranged, "density": density, "rest_points": rest}
    constants = {input_name(e, k): t for e in model.parametric_energies for k, t in model.constants(e).items()}
    values |= {k: t for k, t in constants.items() if k == "friction" or k.endswith(("_kappa", "_damping"))}
    return {name: value.to(model.device, model.dtype) for name, value in values.items()}


def end(model: dv.Model, *, steps: int = 2, sweeps: int = 5, batch: tuple[int, ...] = (), of_one: bool = False,
        adjoint: Any = None, checkpoint_every: Any = "auto", **options: Any) -> Values:  # fmt: skip
    """Of a rollout; options are those of the solver."""

    def rolled(**given: Any) -> tuple[Tensor, Tensor]:
        motion = dv.rollout(model, solver=dv.VBD(STEP, sweeps, **options), steps=steps, save="last", adjoint=adjoint,
                            checkpoint_every=checkpoint_every, checks=dv.Checks(start=False), **given)  # fmt: skip
        return motion.x[-1], motion.v[-1]

    return testing.evaluate(rolled, inputs_of(model, batch, of_one=of_one), STEP)


def driven(model: dv.Model, steps: int = 4) -> Values:
    """Of a rollout whose material, force and pins change from step to step, under checkpoints."""
    inputs = inputs_of(model)
    factors = torch.linspace(0.5, 1.5, steps, dtype=model.dtype, device=model.device)
    inputs["mu"], inputs["force"] = (factors.reshape(-1, *[1] * inputs[k].dim()) * inputs[k] for k in ("mu", "force"))

    def rolled(*, mu: Tensor, force: Tensor, prescribed: Tensor, **given: Any) -> tuple[Tensor, Tensor]:
        motion = dv.rollout(model, solver=dv.VBD(STEP, 4), steps=steps, checkpoint_every=2, mu=dv.per_step(mu),
                            force=dv.per_step(force), prescribed=lambda step, x, v: prescribed + 1e-4 * step,
                            **given)  # fmt: skip
        return motion.x[-1], motion.v[-1]

    return testing.evaluate(rolled, inputs, STEP)


def solved(model: dv.Model, *, adjoint: Any = None, tolerance: float = 1e-8, **options: Any) -> Values:
    """Of a converged step."""

    def run(**given: Any) -> tuple[Tensor, Tensor]:
        found = dv.solve(model, solver=dv.VBD(STEP, 1, **options), tolerance=tolerance, adjoint=adjoint, **given)
        return found.x, found.v

    return testing.evaluate(run, inputs_of(model), STEP)


def of_contact(name: str, device: str, dtype: torch.dtype, subspace: Any = "rigid") -> Values:
    """Of a scene of the tests."""
    scene = contact_scenes.SCENES[name]()
    m = scene.model
    model = dv.Model(m.mesh, energies=m.energies, pinned=m.pinned, colliders=m.colliders)
    solver = scene.solver(6, tape="full", subspace=subspace)
    return contact_scenes.compiled(replace(scene, model=model), 2, solver, model.to(device, dtype))[0]


def captured(model: dv.Model, **options: Any) -> Values:
    """Of two steps whose forward and backward are one CUDA graph, replayed twice."""
    leaves = {name: t.clone().requires_grad_() for name, t in inputs_of(model).items()}
    weights = torch.cos(torch.arange(leaves["x"].numel(), device=model.device, dtype=model.dtype))
    weights = weights.reshape(leaves["x"].shape)

    def run() -> tuple[Tensor, ...]:
        given = dict(leaves)
        x, v = given.pop("x"), given.pop("v")
        for _ in range(2):
            x, v = dv.step(model, x, v, dv.VBD(STEP, 5, **options), **given)  # type: ignore[arg-type]
        return x, v, *torch.autograd.grad((weights * (x + 0.01 * v)).sum(), list(leaves.values()))

    graph, found = capture(run)
    for _ in range(2):
        graph.replay()
    return dict(zip(("x", "v", *(f"grad_{name}" for name in leaves)), found, strict=True))


def loaded(mesh: dv.TetMesh, solver: Any) -> dict[str, Any]:
    """Everything that a step of another block solver takes, differentiable, on the CPU."""
    rng = testing.generator("generality", mesh.num_vertices)
    waves, phases = rng.uniform(-1.5, 1.5, (2, 3, 3)), rng.uniform(0, 6, (2, 3))
    bend, motion = (np.sin(mesh.points @ waves[k] + phases[k]) for k in (0, 1))
    x, v = mesh.points + 0.1 * bend, 2 * motion
    given = {"x": x, "v": v, "prescribed": x + (1 / 60) * v, "mass": solver.mass, "gravity": [0.0, -9.81, 0.0],
             "force": rng.uniform(-1, 1, x.shape)}  # fmt: skip
    if count := len(solver.edges):
        given["stiffness"] = 10 ** rng.uniform(3.5, 4.5, count)
        given["rest_length"] = solver.rest_length.numpy() * rng.uniform(0.8, 1.2, count)
    else:
        given["tet_stiffness"] = 10 ** rng.uniform(4.5, 5.5, mesh.num_tets)
    tensors = {name: torch.as_tensor(value, dtype=torch.float64) for name, value in given.items()}
    return tensors | {"time_step": 1 / 60}
