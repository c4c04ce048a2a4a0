"""Optimisers of a stage: Adam, one that goes back on rough losses, Newton for one number, and L-BFGS."""

import math
from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor

from diffvbd.tasks.problem import Stage

RISE = 2.0  # times the lowest loss: a loss above this is a step back
PATIENCE = 5  # evaluations from one step back until the next
SLOWER = 0.8  # the learning rate is multiplied by this at each step back


def optimizer_of(
    stage: Stage, parameters: list[Tensor]
) -> tuple[torch.optim.Optimizer, torch.optim.lr_scheduler.LRScheduler | None]:
    """The optimiser of a stage and, unless the stage makes its own, the schedule of its learning rate."""
    if stage.optimizer:
        return stage.optimizer(parameters), None
    # Losses in m^2 can be tiny: the default eps would exceed their gradients.
    optimizer: torch.optim.Optimizer
    if stage.rough:
        optimizer = RetreatingAdam(parameters, stage.learning_rate, eps=1e-20)
    else:
        # a few parameters and gradients without noise need no long average, and overshoot less without it
        optimizer = torch.optim.Adam(parameters, stage.learning_rate, betas=(0.7, 0.9), eps=1e-20)
    return optimizer, torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, stage.iterations)


class RetreatingAdam(torch.optim.Adam):
    """Adam that goes back to the parameters of the lowest loss so far once a loss is more than RISE times that one.

    From there it goes on without momentum, at SLOWER times the learning rate; what the loss is there now is then the
    lowest. Where a small change of a throw decides whether a body bounces off another, the loss has cliffs that no
    gradient shows, and Adam alone does not come back over one that it has passed.
    """

    def __init__(self, params: list[Tensor], lr: float, **given: Any) -> None:
        super().__init__(params, lr, **given)
        self.param_groups[0].update(lowest=math.inf, waited=0, best=[])

    @torch.no_grad()
    def step(self, closure: Callable[[], float]) -> float:  # type: ignore[override]
        """A step; ``closure`` evaluates the loss and leaves its gradient in the parameters. ValueError for a negative
        loss: no multiple of it says what a rise is."""
        with torch.enable_grad():
            loss = float(closure())
        if loss < 0:
            raise ValueError(f"rough: expected a loss that is not negative, got {loss:g}")
        group = self.param_groups[0]
        if loss <= group["lowest"] or group["waited"] == 0:
            group.update(lowest=loss, best=[p.clone() for p in group["params"]])
        group["waited"] += 1
        if loss > RISE * group["lowest"] and group["waited"] >= PATIENCE:
            self._retreat()
        else:
            super().step()
        return loss

    def _retreat(self) -> None:
        group = self.param_groups[0]
        for p, best in zip(group["params"], group["best"], strict=True):
            p.copy_(best)
            if "exp_avg" in self.state[p]:  # what never had a gradient has none
                self.state[p]["exp_avg"].zero_()
        group.update(waited=0, lr=SLOWER * group["lr"])


class Newton(torch.optim.Optimizer):
    """Damped Newton steps for a parameter of one number whose second derivative comes from two gradients.

    A step evaluates at p and at p + probe, takes f'' from the difference of f', goes to p - f' / |f''|, by at most
    `limit`, and goes by `limit` where f'' says nothing. The absolute value makes it go downhill where f bends down.
    Raises ValueError for anything but one parameter of one element.
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
    """L-BFGS with steps of five line searches, after each of which the runner can save; `history`: how many earlier
    changes of the gradient it remembers."""
    # torch's own max_eval, 6 here, can leave a search too few evaluations: it ends where it began, as do all others.
    return torch.optim.LBFGS(parameters, max_iter=5, max_eval=30, tolerance_grad=0, tolerance_change=0,
                             history_size=history, line_search_fn="strong_wolfe")  # fmt: skip
