"""Comparison of a scene's gradients with central differences, for users who want to see it on their own scene."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from .._common.checks import check_bool, check_count, check_number, check_positive, fail


@dataclass(frozen=True)
class GradientCheck:
    """Result of :func:`diffvbd.check_gradients`: a row (name, |gradient|, adjoint, difference, error) an argument."""

    rows: list[tuple[str, float, float, float, float]]
    tolerance: float

    @property
    def ok(self) -> bool:
        return all(row[4] <= self.tolerance for row in self.rows)

    def __str__(self) -> str:
        lines = [f"{'argument':<24}{'|gradient|':>12}{'adjoint . u':>20}{'difference . u':>20}{'error':>10}"]
        for name, size, adjoint, difference, error in self.rows:
            mark = "" if error <= self.tolerance else "  <-- above tolerance"
            lines.append(f"{name:<24}{size:>12.4g}{adjoint:>20.12g}{difference:>20.12g}{error:>10.1e}{mark}")
        return "\n".join(lines)


def check_gradients(
    loss: Callable[..., Tensor],
    arguments: dict[str, Tensor],
    *,
    relative_steps: Sequence[float] = (1e-3, 1e-4, 1e-5, 1e-6, 1e-7),
    tolerance: float = 1e-6,
    seed: int = 0,
    verbose: bool = True,
) -> GradientCheck:
    """Comparison of the gradient of ``loss(**arguments)`` with central differences along random directions.

    For each argument the difference quotient is taken at several steps and the one nearest the adjoint counts: large
    steps truncate, small ones round, and where a contact or filter switches there may be no good step at all.

    Args:
        loss: Any scalar function of tensors, typically a few steps and a sum. It gets them by name.
        arguments: float64 tensors by name, of any shape.
        relative_steps: Steps relative to the size of the argument (1 where it is zero).
        tolerance: Largest error |adjoint - difference| / max(|adjoint|, |difference|) that counts as agreement.
        seed: Of the directions.
        verbose: Print the table.

    Returns:
        A :class:`diffvbd.results.GradientCheck`; ``ok`` says whether every argument agrees within the tolerance.

    Raises:
        ValueError: If an argument is not float64, or the loss is not a scalar or has no graph.
        TypeError: If the loss does not take the arguments by these names, or returns no tensor.
    """
    if not isinstance(arguments, dict):
        raise TypeError(f"arguments: expected a dict of tensors by name, got {type(arguments).__name__}")
    if not all(isinstance(name, str) for name in arguments):
        raise TypeError(f"arguments: expected a dict of tensors by name, got the keys {[*arguments]}")
    if not callable(loss):
        raise TypeError(f"loss: expected a function of {', '.join(arguments)}, got {type(loss).__name__}")
    if isinstance(relative_steps, str) or not isinstance(relative_steps, Sequence) or not relative_steps:
        raise TypeError(f"relative_steps: expected a sequence of numbers > 0, got {relative_steps!r}")
    relative_steps = [check_positive("relative_steps", step) for step in relative_steps]
    check_bool("verbose", verbose)
    tolerance, seed = check_number("tolerance", tolerance), check_count("seed", seed, maximum=2**63 - 1)
    for name, value in arguments.items():
        if not isinstance(value, Tensor) or value.dtype != torch.float64:
            fail(name, "a float64 tensor", getattr(value, "dtype", type(value).__name__))
    leaves = {k: t.detach().clone().requires_grad_() for k, t in arguments.items()}
    check_names("loss", loss, arguments)
    value = loss(**leaves)
    if not isinstance(value, Tensor):
        raise TypeError(f"loss: expected a function that returns a scalar tensor, got {type(value).__name__}")
    if value.numel() != 1:
        fail("loss", "a scalar", f"shape {list(value.shape)}")
    if not value.requires_grad:
        fail("loss", "a scalar with the graph of its arguments", "one that depends on none, or is detached")
    grads = torch.autograd.grad(value, list(leaves.values()), allow_unused=True, materialize_grads=True)
    generator = torch.Generator("cpu").manual_seed(seed)
    rows = []
    for (name, leaf), grad in zip(leaves.items(), grads, strict=True):
        fixed = {k: t.detach() for k, t in leaves.items()}
        direction = torch.randn(leaf.shape, dtype=leaf.dtype, generator=generator, device="cpu").to(leaf.device)
        adjoint = float((grad * direction).sum())
        scale = float(leaf.detach().nan_to_num(nan=0.0).abs().max()) if leaf.numel() else 0.0
        best = (float("inf"), 0.0)
        for relative in relative_steps:
            eps = relative * (scale or 1.0)
            with torch.no_grad():
                ahead = loss(**{**fixed, name: leaf + eps * direction})
                behind = loss(**{**fixed, name: leaf - eps * direction})
            difference = float(ahead - behind) / (2 * eps)
            size = max(abs(adjoint), abs(difference))
            error = abs(adjoint - difference) / size if size > 0 else 0.0
            if not (math.isfinite(adjoint) and math.isfinite(difference)):  # of which comparisons say nothing
                error = math.inf
            best = min(best, (error, difference))
        rows.append((name, float(grad.norm()), adjoint, best[1], best[0]))
    result = GradientCheck(rows, tolerance)
    if verbose:
        print(result)
    return result


def check_names(name: str, function: Callable[..., Any], arguments: Iterable[str]) -> None:
    """Raises TypeError for a function that does not take arguments of these names."""
    try:
        signature = inspect.signature(function, follow_wrapped=False)
    except (TypeError, ValueError):  # of a builtin, or no function: calling it will tell
        return
    try:
        signature.bind(**dict.fromkeys(arguments))
    except TypeError as error:
        raise TypeError(f"{name}: expected a function of {', '.join(arguments)}: {error}") from None
