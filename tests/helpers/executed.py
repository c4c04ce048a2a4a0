"""Gradients of some steps with respect to every input, held against autograd and against differences."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

import diffvbd as dv
from diffvbd.testing import evaluate, generator, relative_error, tolerance

SMALL_STEPS = ("x", "v", "rest_points", "force", "stress_free")  # what bends the result more than others do


def run_of(model: dv.Model, solver: dv.VBD, steps: int = 1, **options: Any) -> Callable[..., tuple[Tensor, Tensor]]:
    """The end of some steps as a function of the inputs."""

    def run(x: Tensor, v: Tensor, **inputs: Any) -> tuple[Tensor, Tensor]:
        for _ in range(steps):
            x, v = dv.step(model, x, v, solver, **inputs, **options)
        return x, v

    return run


def assert_executed(models: tuple[dv.Model, dv.Model], solver: dv.VBD, steps: int,
                    inputs_of: Callable[[dv.Model], dict[str, Tensor]]) -> None:  # fmt: skip
    """Steps of the second Model, and their gradients, equal autograd through the same sweeps of the first."""
    first, second = models
    h = solver.time_step
    expected = evaluate(run_of(first, solver, steps, adjoint=dv.Unrolled()), inputs_of(first), h)
    result = evaluate(run_of(second, solver, steps), inputs_of(second), h)
    assert relative_error(result["x"], expected["x"]) <= tolerance("coupled_forward")
    for name in (key for key in expected if key.startswith("grad_")):
        assert result[name].any(), name
        assert relative_error(result[name], expected[name]) <= tolerance("coupled_adjoint"), name


def assert_like_differences(run: Callable[..., tuple[Tensor, Tensor]], values: dict[str, Tensor], h: float) -> None:
    """The gradient of each input along a random direction equals a central difference."""
    found, rng = evaluate(run, values, h), generator("loss")
    weights = [torch.as_tensor(rng.standard_normal(values["x"].shape)) for _ in range(2)]

    def loss(name: str, change: Tensor) -> float:
        x, v = run(**{**values, name: values[name] + change})
        return float((weights[0] * x).sum() + h * (weights[1] * v).sum())

    for name, value in values.items():
        along = torch.from_numpy(generator("difference", name).standard_normal(value.shape)) * value.abs().mean()
        step = 1e-5 if name in SMALL_STEPS else 1e-4
        difference = (loss(name, step * along) - loss(name, -step * along)) / (2 * step)
        derivative = float((found[f"grad_{name}"] * along).sum())
        size = float((found[f"grad_{name}"].abs() * along.abs()).sum())
        assert abs(difference - derivative) <= tolerance("finite_difference") * size, name
