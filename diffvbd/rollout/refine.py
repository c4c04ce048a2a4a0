"""Whether what an optimisation found holds with smaller steps and more sweeps."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from ..checks import check_positive, fail, to_float
from ..scopes import refined


@dataclass(frozen=True)
class Refinement:
    """A loss as it was optimised and as finer settings see it, see :func:`refine`. As text: one line.

    Attributes:
        loss: With the settings that the loss has.
        more_sweeps: With twice the sweeps.
        smaller_steps: With half the time step.
        both: With both.
        before: The loss where the optimisation began, or None.
        tolerance: The share of the gain, or without ``before`` of the loss, that may be lost.
        survives: Whether none of the three loses more.
    """

    loss: float
    more_sweeps: float
    smaller_steps: float
    both: float
    before: float | None
    tolerance: float

    @property
    def survives(self) -> bool:
        return all(map(self._keeps, (self.more_sweeps, self.smaller_steps, self.both)))

    def _keeps(self, finer: float) -> bool:
        """Whether a loss with finer settings has lost no more than may be."""
        scale = abs(self.loss) if self.before is None else self.before - self.loss
        lost = finer - self.loss if self.before is not None else abs(finer - self.loss)
        return math.isfinite(lost) and lost <= self.tolerance * scale

    def __str__(self) -> str:
        began = "" if self.before is None else f" (it began at {self.before:.3g})"
        text = (
            f"{'survives' if self.survives else 'does not survive'} refinement: loss {self.loss:.3g}{began}; with 2 K "
            f"{self.more_sweeps:.3g}, with h/2 {self.smaller_steps:.3g}, with both {self.both:.3g}"
        )
        if self.survives:
            better = self.loss - min(self.more_sweeps, self.smaller_steps, self.both)
            if self.before is None or better <= self.tolerance * (self.before - self.loss):
                return text
            return f"{text}: what was gained is kept, but the settings are too coarse to say how much it is"
        if not math.isfinite(self.loss):
            return f"{text}: the loss itself is not finite"
        finer = {"more sweeps": self.more_sweeps, "smaller steps": self.smaller_steps}
        needed = [name for name, value in finer.items() if not self._keeps(value)] or list(finer)
        return f"{text}: optimise on with {' and '.join(needed)}"


@torch.no_grad()
def refine(
    loss: Callable[[], Tensor | float], *, before: Tensor | float | None = None, tolerance: float = 0.1
) -> Refinement:
    """Evaluates an optimised result once more with twice the sweeps and half the time step.

    An optimiser may find what only coarse settings reward. Such a result loses what it gained when its motion is
    simulated better: do not trust it, and optimise with smaller steps or more sweeps.

    ``loss`` is called four times, without gradients. Every :func:`diffvbd.rollout` in it runs over the same time and
    returns frames and observations of the same times, so that the loss itself need not change. What it gives per step,
    or by a callable, is asked at its own steps and held in between; prescribed vertices and colliders go in straight
    lines between their ends.

    Args:
        loss: A function without arguments that returns a scalar, such as the closure of an optimiser, with the
            optimised parameters in place.
        before: The loss where the optimisation began, a scalar: a number or a tensor of shape []. With it, the result
            survives if it keeps 1 - ``tolerance`` of what it gained; without it, if the loss changes by at most
            ``tolerance`` of itself.
        tolerance: See ``before``; in (0, 1).

    Raises:
        ValueError, TypeError: ``loss`` runs no rollout or does not return a scalar; ``before`` is not finite or not
            above the loss.
        NotImplementedError: ``loss`` calls step or solve, which are not refined, continues a BDF2 history that is not
            its own, asks for estimate_errors, or prescribes positions of stages.
    """
    if not callable(loss):
        raise TypeError(f"loss: expected a function without arguments, got {type(loss).__name__}")
    share = check_positive("tolerance", tolerance)
    if share >= 1:
        fail("tolerance", "a share in (0, 1)", repr(tolerance))
    began = None if before is None else _scalar("before", before)
    if began is not None and not math.isfinite(began):
        fail("before", "a finite loss", began)
    found = []
    for steps, sweeps in ((1, 1), (1, 2), (2, 1), (2, 2)):
        ran: list[int] = []
        # what is compiled runs as it is written, or it would be compiled for each of the four
        with torch.compiler.set_stance("force_eager"), refined((steps, sweeps, ran)):
            found.append(_scalar("loss", loss()))
        if not sum(ran):
            fail("loss", "a function that runs dv.rollout, which is what is refined", "one that ran no step of one")
        if began is not None and not began > found[0]:
            fail("before", f"a loss above that of the result, {found[0]:.3g}", f"{began:.3g}")
    once, more_sweeps, smaller_steps, both = found
    return Refinement(once, more_sweeps, smaller_steps, both, began, share)


def _scalar(name: str, value: Tensor | float) -> float:
    if isinstance(value, Tensor):
        if value.numel() != 1:
            fail(name, "a scalar", f"shape {list(value.shape)}")
        return float(value)
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise TypeError(f"{name}: expected a scalar, got {type(value).__name__}")
    return to_float(name, value)
