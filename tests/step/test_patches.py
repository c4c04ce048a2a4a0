"""Claim: steps whose tets average volumes over patches, and their gradients, equal autograd through an independent
execution of the same bounds and sweeps; the gradients are those of differences; and no sweep raises the potential."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from helpers.marks import slow
from helpers.spreads import assert_near_contact
from torch import Tensor

import diffvbd as dv
from diffvbd.testing import contact_scenes, evaluate, generator, relative_error, tolerance

STEP = 0.01
LAW = dv.StableNeoHookean(patches="auto")
FLOOR = dv.FloorBarrier(height=-0.01, kappa=1e4, dhat=0.03)
CASES: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "plain": ({}, {}),
    "free": ({"pinned": False}, {}),
    "floor": ({"pinned": False, "extra": (FLOOR,)}, {}),
    "anchor": ({"extra": (dv.Anchor(20.0),)}, {}),
    "springs": ({"springs": True, "pinned": False}, {}),
    "viscous": ({"viscous": True}, {}),
    "grown": ({"grown": True}, {}),
    "coarse": ({}, {"subspace": "coarse"}),
    "free_coarse": ({"pinned": False, "extra": (FLOOR,)}, {"subspace": "coarse"}),
    "relaxed": ({}, {"relaxation": 1.5}),
    "sdirk2": ({}, {"integrator": dv.SDIRK2()}),
}
RUNS = [("plain", 1, 1), ("plain", 8, 1), ("plain", 2, 3), *((name, 2, 1) for name in CASES if name != "plain")]
LONG = [(name, sweeps, steps) for name in CASES for sweeps, steps in ((1, 3), (8, 1)) if name != "plain"]


def built(*, pinned: bool = True, extra: tuple[Any, ...] = (), springs: bool = False, device: Any = "cpu",
          law: Any = LAW, **_: Any) -> dv.Model:  # fmt: skip
    mesh = dv.mesh.join([dv.mesh.beam(4, 3, 3, size=(0.3, 0.15, 0.15), split="kuhn"),
                         dv.mesh.cube(3, 0.1).translate((0.4, 0.1, 0.1))])  # fmt: skip
    if springs:
        ends = [dv.Embedding.of_points(mesh, [[x, 0.12, 0.12]]) for x in (0.3, 0.42)]
        extra = (*extra, dv.Springs(*ends, 300.0))
    pins = mesh.points[:, 0] < 1e-9 if pinned else None
    return dv.Model(mesh, pinned=pins, energies=(law, *extra), device=device)


def inputs_of(model: dv.Model, batch: tuple[int, ...] = (), *, viscous: bool = False, grown: bool = False,
              **_: Any) -> dict[str, Tensor]:  # fmt: skip
    rng = generator("patches", batch)

    def noise(*shape: int) -> Tensor:
        return torch.from_numpy(rng.standard_normal(shape))

    rest, state, tets = model.rest_points.cpu(), (*batch, model.num_vertices, 3), (*batch, model.num_tets)
    values = {
        "x": rest + 2e-3 * noise(*state),
        "v": 0.2 * noise(*state),
        "mu": 2e4 * torch.exp(0.2 * noise(*tets)),
        "lam": 4e5 * torch.exp(0.2 * noise(*tets)),
        "force": 0.3 * noise(*state),
        "rest_points": rest + 1e-3 * noise(model.num_vertices, 3),
        "density": model.density.cpu() * torch.exp(0.1 * noise(model.num_tets)),
    }
    if viscous:
        values |= {"viscosity": 30 * torch.exp(0.2 * noise(*tets)), "volume_viscosity": 20 * torch.exp(0.2 * noise(*tets)),
                   "drag": torch.exp(0.2 * noise(model.num_vertices))}  # fmt: skip
    if grown:
        values["stress_free"] = torch.eye(3) + 0.05 * noise(model.num_tets, 3, 3)
    if "spring_stiffness" in model.inputs:
        values["spring_stiffness"] = torch.tensor([300.0])
    if "anchor_stiffness" in model.inputs:
        values["anchor_stiffness"] = torch.from_numpy(rng.uniform(10, 30, model.num_vertices))
    return {name: value.double().to(model.device) for name, value in values.items()}


def run_of(model: dv.Model, solver: dv.VBD, steps: int = 1, **options: Any) -> Callable[..., tuple[Tensor, Tensor]]:
    def run(x: Tensor, v: Tensor, **inputs: Any) -> tuple[Tensor, Tensor]:
        for _ in range(steps):
            x, v = dv.step(model, x, v, solver, **inputs, **options)
        return x, v

    return run


@pytest.mark.parametrize(("case", "sweeps", "steps"), [*RUNS, *(slow(*run) for run in LONG)])
def test_gradients_are_those_of_the_executed_sweeps(device: str, case: str, sweeps: int, steps: int) -> None:
    scene, options = CASES[case]
    model, solver = built(**scene), dv.VBD(STEP, sweeps, **options)
    there = built(**scene, device=device)
    expected = evaluate(run_of(model, solver, steps, adjoint=dv.Unrolled()), inputs_of(model, **scene), STEP)
    result = evaluate(run_of(there, solver, steps), inputs_of(there, **scene), STEP)
    assert relative_error(result["x"], expected["x"]) <= tolerance("coupled_forward")
    for name in (key for key in expected if key.startswith("grad_")):
        assert result[name].any(), name
        assert relative_error(result[name], expected[name]) <= tolerance("coupled_adjoint"), name
