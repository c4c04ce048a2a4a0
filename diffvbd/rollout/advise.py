"""Settings that keep an error: dv.advise, and what dv.rollout does with settings."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ..checks import check_positive, fail
from ..model.model import Model
from ..step.arguments import check_state
from .pilots import Quantity, converted, pilots_of
from .rollout import rollout
from .search import ERROR, PATIENCE, found
from .settings import Settings


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
    patience: float = PATIENCE,
    **given: Any,
) -> Settings:
    """Finds settings whose error is at most ``error`` and that take the least time, by pilot runs of the scene itself.

    Time step, integrator, sweeps, relaxation, coarse corrections and acceleration are chosen; mesh, energies, dtype and
    tapes stay as they are. Pass the result on: ``dv.rollout(model, x, v, duration=..., settings=s, ...)``. Print it:
    it says what it promises, what the runners-up take and what the advice has cost: in the benchmark mostly about ten
    of the rollouts that it advises, and more than a hundred where a quick pilot run turned out to do.

    The error is one of time: of the motion of this mesh with these energies, contact included, against the limit of
    small steps and many sweeps. That of the mesh is not in it (:func:`diffvbd.error_budget` has it). What chaos leaves
    no limit of, as piles that topple, has no settings: ``predicted.reached`` is False then and ``predicted.why`` says
    why; the settings are the best that were run.

    Args:
        model, x, v: As in :func:`diffvbd.rollout`. relaxation, coarse and acceleration of the Model play no part.
        duration: Of the motion [s].
        error: Wanted relative error, in (0, 1): of positions, root mean square over vertices and four times, over that
            of the way from the start.
        quantity: A function of the last x and v, [..., V, 3], that returns a scalar whose error shall be kept, too.
        gradient: Whether that of the gradient of ``quantity`` shall be kept, and its time counted: with respect to
            each modulus and to a velocity that is added to all vertices. Without a quantity it is the mean squared way.
        device: Where the pilots run; None: the Model's.
        patience: How long pilots may run [s]; the search ends with the one that exceeds it.
        given: mu and lam or young and poisson, force, gravity, prescribed, colliders, rest_points, density, parameters,
            as in rollout, constant or a function of the time [s], of parameters each of them: loads at the middle of
            each step, all else at its end, and what is marked by :func:`diffvbd.step_average` over all of it. What
            swings within steps has these made shorter; a single push that is shorter than they are may go unseen
            unless it is averaged.

    Returns:
        Settings with a :class:`diffvbd.Prediction`.

    Raises:
        ValueError, TypeError: As rollout; an error outside (0, 1), per_step values, a quantity that is no finite scalar
            or, beside ``gradient``, has no derivative.
    """
    check_state(model, x, v)
    error = check_positive("error", error)
    if error >= 1:
        fail("error", "a share of the motion in (0, 1)", repr(error))
    patience = check_positive("patience", patience, "s")
    if device is not None:
        model = model.to(device)
        x, v, given = (converted(value, device=model.device) for value in (x, v, given))
    return found(pilots_of(rollout, model, x, v, duration, quantity, gradient, given), error, patience)
