"""The optimiser of a stage: Adam, and for rough losses one that goes back to where it has been best."""

import math
from collections.abc import Callable
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
        """A step; ``closure`` evaluates the loss, not negative, and leaves its gradient in the parameters.

        Raises:
            ValueError: The loss is negative: no multiple of it says what a rise is.
        """
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
