"""A solver that stays within an error: dv.advise."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ..checks import check_positive, fail
from ..model.model import Model
from ..model.solver import VBD
from ..step.arguments import check_state
from .pilots import Quantity, converted, pilots_of
from .rollout import rollout
from .search import ERROR, TIME_BUDGET, found


@torch.no_grad()
def advise(
    model: Model,
    x: Tensor,
    v: Tensor,
    *,
    duration: float,
    error: float = ERROR,
    quantity: Quantity | None = None,
    gradient: bool = False,
    device: torch.device | str | None = None,
    time_budget: float = TIME_BUDGET,
    progress: bool = False,
    **inputs: Any,
) -> VBD:
    """The solver that takes the least time with an error of at most ``error``, found by trial runs of the scene itself.

    Time step, integrator, sweeps, relaxation and subspace are chosen. Pass the result on:
    ``dv.rollout(model, x, v, solver, duration=..., ...)``. Print it: it says what it promises, what the runners-up take
    and what the advice has cost: in the benchmark mostly about ten of the rollouts that it advises, and more than a
    hundred where a quick trial run turned out to do.

    The error is one of time: of the motion of this mesh with these energies, contact included, against the limit of
    small steps and many sweeps. That of the mesh is not in it (:func:`diffvbd.error_budget` has it). Chaotic motion,
    as of piles that topple, has no such limit: ``prediction.reached`` is False then and ``prediction.why`` says why;
    the solver is the best that was run.

    Args:
        model, x, v: As in :func:`diffvbd.rollout`.
        duration: Of the motion [s].
        error: Wanted relative error, in (0, 1): of positions, root mean square over vertices and four times, over that
            of the way from the start.
        quantity: A function of the last x and v, [..., V, 3], that returns a scalar, which shall stay within the error.
        gradient: Whether the gradient of ``quantity`` shall stay within it, and its time be counted: with respect to
            each modulus and to a velocity that is added to all vertices. Without a quantity it is the mean squared way.
        device: Where the trials run; None: the Model's.
        time_budget: How long trials may run [s]; the search ends with the one that exceeds it.
        progress: Log each trial run (logger "diffvbd", level INFO).
        inputs: As in rollout, constant or a function of the time [s]: loads at the middle of each step, all else at its
            end, and what is marked by :func:`diffvbd.step_average` over all of it. What swings within steps has these
            made shorter; a single push that is shorter than they are may go unseen unless it is averaged.

    Returns:
        A solver with a ``prediction`` (:class:`diffvbd.results.Prediction`).

    Raises:
        ValueError, TypeError: As rollout; an error outside (0, 1), per_step values, a quantity that is no finite scalar
            or, beside ``gradient``, has no derivative.
    """
    check_state(model, x, v)
    error = check_positive("error", error)
    if error >= 1:
        fail("error", "a share of the motion in (0, 1)", repr(error))
    time_budget = check_positive("time_budget", time_budget, "s")
    if device is not None:
        model = model.to(device)
        x, v, inputs = (converted(value, device=model.device) for value in (x, v, inputs))
    return found(pilots_of(rollout, model, x, v, duration, quantity, gradient, inputs, progress), error, time_budget)
