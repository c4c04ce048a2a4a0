"""What tasks use where Adam is slow: Newton's method for one number, and L-BFGS; first derivatives are enough."""

import math
from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor


class Newton(torch.optim.Optimizer):
    """Damped Newton steps for a parameter of one number whose second derivative comes from two gradients.

    A step evaluates at p and at p + probe, takes f'' from the difference of f', goes to p - f' / |f''|, by at most
    `limit`, and goes by `limit` where f'' says nothing. The absolute value makes it go downhill where f bends down.

    Args:
        parameters: One tensor with one element.
        probe: Distance to the second gradient.
        limit: Longest step.

    Raises:
        ValueError: not one parameter of one element.
    """

    def __init__(self, parameters: Iterable[Tensor], probe: float, limit: float) -> None:
        super().__init__(parameters, {"probe": probe, "limit": limit})
        self.parameters = [p for group in self.param_groups for p in group["params"]]
        if len(self.parameters) != 1 or self.parameters[0].numel() != 1:
            raise ValueError(f"parameters: expected one of one element, got {[list(p.shape) for p in self.parameters]}")

    @torch.no_grad()
    def step(self, closure: Callable[[], float]) -> Any:  # type: ignore[override]
        """closure evaluates the loss and leaves its gradient; it is called twice. Returns the loss before the step."""
        (parameter,), chosen = self.parameters, self.param_groups[0]
        start = parameter.clone()

        def slope() -> tuple[float, float]:
            with torch.enable_grad():
                loss = closure()
            return loss, 0.0 if parameter.grad is None else parameter.grad.item()

        loss, first = slope()
        parameter.add_(chosen["probe"])
        bend = (slope()[1] - first) / chosen["probe"]
        newton = first / abs(bend) if bend else math.copysign(math.inf, first)
        limited = max(-chosen["limit"], min(chosen["limit"], newton)) if first else 0.0
        parameter.copy_(start - limited)
        return loss


def lbfgs(parameters: Iterable[Tensor], history: int = 100) -> torch.optim.Optimizer:
    """L-BFGS with steps of five line searches, after each of which the runner can save.

    Args:
        parameters: Tensors that it moves.
        history: How many earlier changes of the gradient it remembers.
    """
    # torch's own max_eval, 6 here, can leave a search too few evaluations: it ends where it began, as do all others.
    return torch.optim.LBFGS(
        parameters,
        max_iter=5,
        max_eval=30,
        tolerance_grad=0,
        tolerance_change=0,
        history_size=history,
        line_search_fn="strong_wolfe",
    )
