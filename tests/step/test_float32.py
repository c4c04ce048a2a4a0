"""float32: near float64, and no worse far from the origin, where positions are taken relative to each body."""

from typing import Any

import pytest
import torch
from helpers.results import evaluated
from helpers.values import STEP, uniform
from torch import Tensor

import diffvbd as dv
from diffvbd.testing import build_scene, relative_error, tolerance


def near_rest(mesh: dv.TetMesh, device: str) -> Tensor:
    return torch.from_numpy(mesh.points.copy()).to(device)


def cast(value: Any, dtype: torch.dtype) -> Any:
    """Every tensor of a nested dict in another dtype."""
    if isinstance(value, dict):
        return {k: cast(v, dtype) for k, v in value.items()}
    return value.to(dtype) if isinstance(value, Tensor) else value


@pytest.mark.parametrize("case", ["plain", "paper", "floor_damped", "floor_corner", "anchored", "batch"])
def test_float32_is_near_float64(device: str, case: str) -> None:
    scene = build_scene(case)
    model, inputs = scene.model(device), cast(scene.inputs(device=device), torch.float32)
    expected = evaluated(model, cast(inputs, torch.float64), scene.solver(3))
    actual = evaluated(model.to(dtype=torch.float32), inputs, scene.solver(3))
    for name, value in expected.items():
        assert actual[name].dtype == torch.float32
        limit = tolerance("float32_gradient" if name.startswith("grad_") else "float32_forward")
        if name == "v":  # a difference of positions over h: as exact as they are
            scale = float(expected["x"].abs().max()) / scene.case.time_step + float(value.abs().max())
            assert float((actual[name] - value).abs().max()) <= limit * scale
        else:
            assert relative_error(actual[name], value) <= limit, name


@pytest.mark.parametrize("distance", [10.0, 1000.0])
def test_float32_far_from_the_origin(device: str, distance: float) -> None:
    """Coordinates relative to each body: the step itself loses nothing, only the stored positions are coarse."""
    near = dv.mesh.box((3, 2, 2))
    offset = torch.tensor([distance, 0.0, -distance], device=device)
    moves, slopes = [], []
    for mesh, shift in ((near, torch.zeros(3, device=device)), (near.translate(offset.tolist()), offset)):
        model = dv.Model(mesh, pinned=[0, 1], dtype=torch.float32, device=device)
        # multiples of 2^-10: exact in float32 a kilometre away too
        x = torch.round((near_rest(near, device) + uniform(12, 3, low=-0.03, high=0.03).to(device)) * 1024) / 1024
        x = (x.float() + shift).requires_grad_()
        v = uniform(12, 3, low=-1.0, high=1.0).float().to(device)
        out = dv.step(model, x, v, mu=1e4, lam=2e4, **STEP)
        moves.append(out[1].detach())
        slopes += torch.autograd.grad((out[1] * uniform(12, 3).float().to(device)).sum(), x)
    assert relative_error(moves[1], moves[0]) <= tolerance("float32_forward")
    assert relative_error(slopes[1], slopes[0]) <= tolerance("float32_gradient")


def test_float32_of_joined_bodies_far_apart(device: str) -> None:
    near = dv.mesh.cube()
    pair = dv.mesh.join([near, near.translate([4096.0, 0.0, 0.0])])
    x = near_rest(pair, device).float()
    v = uniform(8, 3, low=-1.0, high=1.0).float().repeat(2, 1).to(device)
    model = dv.Model(pair, dtype=torch.float32, device=device)
    out = dv.step(model, x, v, mu=1e4, lam=2e4, **STEP)
    assert relative_error(out[1][8:], out[1][:8]) <= tolerance("float32_forward")
    exact = dv.step(dv.Model(near, device=device), near_rest(near, device), v[:8].double(), mu=1e4, lam=2e4, **STEP)
    assert relative_error(out[1][8:], exact[1]) <= tolerance("float32_forward")
