"""Checks: what a rollout looks at."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from ..checks import check_bool
from ..model.model import Model
from ..step.estimate import check_estimable


@dataclass(frozen=True)
class Checks:
    """What a rollout looks at and warns (UserWarning) of, each time, in one sentence that says what to do.

    A rollout that ends with what is not finite, or too far away, always warns.

    Args:
        start: With a PairBarrier, raise where surfaces intersect at the start: edges through triangles, or vertices
            behind a Plane. Contact keeps apart what is apart, and no step notices what is not. It costs a quarter of
            one detection or less on the CPU and, on CUDA, waits for the device once. Under torch.compile, and while a
            CUDA graph is captured, nothing is checked: run the rollout once before the capture. On the CPU it also
            warns where all tets of a body are inverted.
        energy: Whether to warn where a scene that only gravity drives has 5 % more energy (where barriers push at the
            start, twice as much) than it began with and gravity gave it; where, without pairs, the sweeps leave the
            motion off by an estimated 2 %; where thin tets bend. True: energy after any step. None: on the CPU, of ten
            steps or more, after six of them, most of them early (with a floor 12, with contact up to 64).
        contact: Whether to warn where pairs truncated the motion of more than 1 % of vertices in a step, or the last
            one left more than 5 % of what friction can bear unbalanced. None: on the CPU, after ten steps or more. A
            look costs about a step and on CUDA waits for the device; nothing that is compiled or captured is looked at.
        errors: Also return how far from converged each step ends (:class:`diffvbd.results.ErrorEstimate`). Each step is
            swept twice for it, the second time without a tape, once under every schedule; states and gradients are the
            same.

    Raises:
        TypeError: What is no bool (or, for energy and contact, None).
    """

    start: bool = True
    energy: bool | None = None
    contact: bool | None = None
    errors: bool = False

    def __post_init__(self) -> None:
        for name in ("start", "errors"):
            check_bool(name, getattr(self, name))
        for name in ("energy", "contact"):
            if not isinstance(getattr(self, name), bool | None):
                raise TypeError(f"{name}: expected a bool or None, got {type(getattr(self, name)).__name__}")


NONE = Checks(start=False, energy=False, contact=False)


def check_checks(checks: Any, model: Any) -> Checks:
    """The checks of a rollout; None stands for the default ones."""
    if checks is None:
        return Checks()
    if not isinstance(checks, Checks):
        raise TypeError(f"checks: expected a diffvbd.Checks or None, got {type(checks).__name__}")
    if checks.errors and isinstance(model, Model):
        check_estimable(model, "errors")
    return checks
