"""One step of a cube in which every argument counts, its gradients, and how two sets of them are compared."""

from typing import Any

import torch
from torch import Tensor

import diffvbd as dv
from diffvbd.testing import relative_error, tolerance

Arguments = dict[str, Tensor]
STEP = {"solver": dv.VBD(0.3, 2)}
PARAMETERS = ("floor_kappa", "floor_dhat", "floor_damping", "floor_height",
              "floor_normal", "anchor_stiffness", "anchor_points")  # fmt: skip
ARGUMENTS = ("x", "v", "mu", "lam", "force", "gravity", "prescribed", "rest_points", "density", *PARAMETERS)


def small_model(device: str, dtype: torch.dtype = torch.float64, **options: Any) -> dv.Model:
    """One cube of six tets in units where every quantity is near 1, so that no gradient hides below a tolerance."""
    mesh = dv.mesh.cube()
    floor = dv.FloorBarrier(height=-0.2, normal=(0.1, 1.0, 0.0), kappa=2.0, dhat=0.5, damping=0.5)
    options = {"energies": (dv.StableNeoHookean(), floor, dv.Anchor(0.7)), "pinned": [0, 1], **options}
    return dv.Model(mesh, density=2.0, dtype=dtype, device=device, **options)


def small_inputs(model: dv.Model, seed: int = 0) -> Arguments:
    generator = torch.Generator().manual_seed(seed)

    def noise(*shape: int, size: float) -> Tensor:
        return (size * (2 * torch.rand(*shape, dtype=torch.float64, generator=generator) - 1)).to(model.mass)

    def given(values: Any) -> Tensor:
        return torch.tensor(values, dtype=model.dtype, device=model.device)

    n, tets = model.num_vertices, model.num_tets
    x = model.rest_points + noise(n, 3, size=0.1)
    return {
        "x": x,
        "v": noise(n, 3, size=0.3) - given([0.0, 0.5, 0.0]),
        "mu": 3.0 + noise(tets, size=0.5),
        "lam": 2.0 + noise(tets, size=0.5),
        "force": noise(n, 3, size=0.3),
        "gravity": given([0.1, -1.0, 0.2]),
        "prescribed": torch.where(model.pinned[:, None].to(x.device), x + noise(n, 3, size=0.1), torch.nan),
        "rest_points": model.rest_points + noise(n, 3, size=0.05),
        "density": 2.0 + noise(tets, size=0.5),
        "floor_kappa": given(2.0),
        "floor_dhat": given(0.5),
        "floor_damping": given(0.5),
        "floor_height": given([-0.2]),
        "floor_normal": given([[0.1, 1.0, 0.0]]),
        "anchor_stiffness": 0.7 + noise(n, size=0.2),
        "anchor_points": model.rest_points + noise(n, 3, size=0.1),
    }


def run_step(model: dv.Model, arguments: Arguments, **options: Any) -> tuple[Tensor, Tensor]:
    return dv.step(model, **{**arguments, **STEP, **options})


def scalar(x: Tensor, v: Tensor) -> Tensor:
    weights = torch.linspace(0.5, 1.5, x.shape[-1] * x.shape[-2], dtype=x.dtype, device=x.device).reshape(x.shape[-2:])
    return (weights * (x * x + 0.3 * v * v)).sum()


def loss(model: dv.Model, arguments: Arguments, **options: Any) -> Tensor:
    return scalar(*run_step(model, arguments, **options))


def gradients(model: dv.Model, arguments: Arguments, **options: Any) -> Arguments:
    leaves = {k: t.clone().requires_grad_() for k, t in arguments.items()}
    return dict(zip(leaves, torch.autograd.grad(loss(model, leaves, **options), list(leaves.values())), strict=True))


def assert_same(actual: Arguments, expected: Arguments, limit: float = tolerance("sum")) -> None:
    assert actual.keys() == expected.keys()
    for name in expected:
        assert expected[name].abs().max() > 1e-6, f"{name}: the gradient is zero, so nothing is compared"
        assert relative_error(actual[name], expected[name]) <= limit, name
