"""A step of a Model: its arguments, and the solves that its integrator takes."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, overload

from torch import Tensor

from ..adjoint.routes import Adjoint, check_adjoint
from ..model.model import Model
from ..scopes import refuse_refinement
from .advance import advance
from .arguments import GRAVITY, check_prescribed, check_state, prepare
from .growth import warn_of_sweeps
from .held_up import notice_step
from .integrators import (
    BDF2,
    SDIRK2,
    History,
    ImplicitEuler,
    Integrator,
    check_history,
    check_integrator,
    check_staged,
    take,
)
from .lost import notice_loss


@overload
def step(
    model: Model,
    x: Tensor,
    v: Tensor,
    *,
    mu: float | Tensor | None = None,
    lam: float | Tensor | None = None,
    young: float | Tensor | None = None,
    poisson: float | Tensor | None = None,
    time_step: float,
    sweeps: int,
    force: Tensor | None = None,
    gravity: Sequence[float] | Tensor = GRAVITY,
    prescribed: Tensor | tuple[Tensor, Tensor] | None = None,
    colliders: Tensor | tuple[Tensor, Tensor] | None = None,
    colliders_before: Tensor | None = None,
    rest_points: Tensor | None = None,
    density: float | Tensor | None = None,
    parameters: dict[str, Any] | None = None,
    adjoint: Adjoint | None = None,
    integrator: ImplicitEuler | SDIRK2 | None = None,
) -> tuple[Tensor, Tensor]: ...
@overload
def step(
    model: Model,
    x: Tensor,
    v: Tensor,
    *,
    mu: float | Tensor | None = None,
    lam: float | Tensor | None = None,
    young: float | Tensor | None = None,
    poisson: float | Tensor | None = None,
    time_step: float,
    sweeps: int,
    force: Tensor | None = None,
    gravity: Sequence[float] | Tensor = GRAVITY,
    prescribed: Tensor | None = None,
    colliders: Tensor | None = None,
    colliders_before: Tensor | None = None,
    rest_points: Tensor | None = None,
    density: float | Tensor | None = None,
    parameters: dict[str, Any] | None = None,
    adjoint: Adjoint | None = None,
    integrator: BDF2,
    history: History | None = None,
) -> tuple[Tensor, Tensor, History]: ...
def step(
    model: Model,
    x: Tensor,
    v: Tensor,
    *,
    mu: float | Tensor | None = None,
    lam: float | Tensor | None = None,
    young: float | Tensor | None = None,
    poisson: float | Tensor | None = None,
    time_step: float,
    sweeps: int,
    force: Tensor | None = None,
    gravity: Sequence[float] | Tensor = GRAVITY,
    prescribed: Tensor | tuple[Tensor, Tensor] | None = None,
    colliders: Tensor | tuple[Tensor, Tensor] | None = None,
    colliders_before: Tensor | None = None,
    rest_points: Tensor | None = None,
    density: float | Tensor | None = None,
    parameters: dict[str, Any] | None = None,
    adjoint: Adjoint | None = None,
    integrator: Integrator | None = None,
    history: History | None = None,
) -> tuple[Tensor, Tensor] | tuple[Tensor, Tensor, History]:
    """One implicit step by Vertex Block Descent, differentiable, by default by the exact reverse sweep.

    Args:
        model: The scene; x, v and the other tensors must have its dtype and device.
        x: Positions [m], shape [..., V, 3]; leading dimensions are scenes over one mesh, which do not mix. (A
            PairBarrier without a number of detections has the same number for all scenes of a step.)
        v: Velocities [m/s], shape of x.
        mu: Shear modulus [Pa], broadcasts to x.shape[:-2] + (T,); a value per scene is [B, 1].
        lam: First Lame parameter [Pa], likewise. mu >= 0 and mu + lam >= 0 (lam >= 0 with block="paper").
        young, poisson: Young's modulus [Pa] and Poisson's ratio [-] in place of mu and lam, likewise
            (:func:`diffvbd.lame`).
        time_step: h [s] > 0.
        sweeps: K >= 0, the number of colored sweeps that are executed (and differentiated).
        force: External forces [N], broadcasts to x.shape.
        gravity: Acceleration [m/s^2], 3 numbers, or a tensor that broadcasts to x.shape.
        prescribed: Positions of pinned vertices at the end of the step [m], broadcasts to x.shape; None holds
            them where x has them. Where a vertex is not pinned it must have x, the Model's rest_points or NaN.
        colliders: Corner points of the Model's colliders at the end of the step [m], broadcasts to
            x.shape[:-2] + (Vc, 3). None: the Model's collider_points.
        colliders_before: The same at the start of the step, where they move. None: they rest.
        rest_points: Rest positions [m], broadcasts to x.shape; None: the Model's. Enter through rest metric and mass.
        density: [kg/m^3], broadcasts to x.shape[:-2] + (T,); None: the Model's.
        parameters: Energy parameters by name, as {"floor_barrier.kappa": tensor}; each broadcasts to
            x.shape[:-2] + its own shape.
        adjoint: How the backward is computed: ReverseSweep(), which None stands for, Unrolled() or GlobalAdjoint().
        integrator: ImplicitEuler(), which None stands for, SDIRK2() or BDF2(). SDIRK2 solves twice, the first time up
            to 0.29 of the step: ``prescribed`` and ``colliders`` move evenly to where they end, or are a tuple of two,
            at the end of each solve.
        history: With BDF2(), what it returned of the step before; None: there is none, as after a jump of the state.

    Returns:
        Positions and velocities after the step, shape of x; with BDF2() also the history that the next step takes.
        Inputs are untouched.

    Raises:
        ValueError, TypeError: Naming the argument, what was expected and what came, before any work. With contact also
            for surfaces that touch at the start, and for prescribed motion that leaves bodies no way.
        RuntimeError: Where more pairs are near than the PairBarrier has capacity for.
        NotImplementedError: For forward mode; with GlobalAdjoint inside torch.func transforms; in the backward for
            second derivatives (which Unrolled has).

    Source: paper, eqs. 1-3 and section 3; docs/method.md.
    """
    refuse_refinement("dv.step")
    lead, adjoint = check_state(model, x, v), check_adjoint(adjoint)
    scheme = check_integrator(integrator)
    check_history(scheme, history, x, time_step)
    given = {"force": force, "gravity": gravity, "prescribed": prescribed, "colliders": colliders,
             "colliders_before": colliders_before}  # fmt: skip
    check_staged(scheme, given)
    prepared = prepare(model, lead, mu=mu, lam=lam, young=young, poisson=poisson, time_step=time_step, sweeps=sweeps,
                       rest_points=rest_points, density=density, parameters=parameters, adjoint=adjoint)  # fmt: skip
    for value in prescribed if isinstance(prescribed, tuple) else (prescribed,):
        check_prescribed(model, value, x)
    warn_of_sweeps(model, prepared, scheme)
    taken = take(scheme, model, x, v, history, prepared, given, partial(advance, adjoint=adjoint))
    notice_step(model, taken.x)
    notice_loss(model, prepared, scheme, v, force, taken.x)
    return (taken.x, taken.v) if taken.history is None else (taken.x, taken.v, taken.history)
