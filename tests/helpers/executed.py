"""Gradients of some steps with respect to every input, held against autograd, differences and dense equations."""

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


def assert_converged(models: tuple[dv.Model, dv.Model], solver: dv.VBD,
                     inputs_of: Callable[[dv.Model], dict[str, Tensor]]) -> None:  # fmt: skip
    """Both forms of GlobalAdjoint, on the second Model, have the gradients of the executed sweeps of the first."""
    first, second = models
    h = solver.time_step
    expected = evaluate(run_of(first, solver), inputs_of(first), h)
    for assembled in (True, False):
        adjoint = dv.GlobalAdjoint(assembled, tolerance=tolerance("linear_residual"))
        result = evaluate(run_of(second, solver, adjoint=adjoint), inputs_of(second), h)
        assert second.device != first.device or torch.equal(result["x"], expected["x"])
        for name in (key for key in expected if key.startswith("grad_")):
            assert expected[name].any(), name
            assert relative_error(result[name], expected[name]) <= tolerance("global_converged"), name


def assert_of_equation(model: dv.Model, run: Callable[..., tuple[Tensor, Tensor]],
                       potential: Callable[..., Tensor], values: dict[str, Tensor]) -> None:  # fmt: skip
    """The gradient of a step's end, converged or not, is that of the equation there by a dense solve.

    potential: of the step, a function of its end and of the inputs.
    """
    values = {name: value.clone().requires_grad_() for name, value in values.items()}
    end, free = run(**values)[0], ~model.pinned
    weights = torch.as_tensor(generator("loss").standard_normal(end.shape))
    result = torch.autograd.grad((weights * end).sum(), [*values.values()])
    unknown = end.detach()[free].requires_grad_()
    at = values["x"].index_put((free,), unknown)
    (slope,) = torch.autograd.grad(potential(at, **values), unknown, create_graph=True)
    rows = [torch.autograd.grad(s, unknown, retain_graph=True)[0].flatten() for s in slope.flatten()]
    w = torch.linalg.solve(torch.stack(rows), weights[free].flatten()).reshape(slope.shape)
    expected = torch.autograd.grad((weights * at).sum() - (w * slope).sum(), [*values.values()])
    for name, ours, theirs in zip(values, result, expected, strict=True):
        assert theirs.any() and relative_error(ours, theirs) <= tolerance("global_converged"), name
