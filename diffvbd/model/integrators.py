"""Time integrators, as a user names them; step/integrators.py executes them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from ..checks import fail


@dataclass(frozen=True)
class ImplicitEuler:
    """One solve over the whole step: first order, and damps what vibrates faster than about the step."""


@dataclass(frozen=True)
class SDIRK2:
    """Two solves over 0.29 of the step each: second order, exact in free fall, L-stable. Twice the work of a step.

    First order in the rotation of a body whose vibrations the step does not resolve: it loses half of the spin that
    implicit Euler does. :class:`BDF2` keeps its order there.

    A body that may touch a floor, a collider, another body or itself takes implicit Euler for a step that does not
    resolve the barrier, and wherever there is friction or damping of contact.

    Source: Alexander (1977); docs/method.md, section 19.
    """


@dataclass(frozen=True)
class BDF2:
    """One solve over 2/3 of the step, from the last two states: second order, exact in free fall, L-stable.

    Rollouts keep its history; :func:`diffvbd.step` has none and refuses it. The first step is one of :class:`SDIRK2`. A
    body takes implicit Euler where it does with that, and for the next step.

    Source: Curtiss and Hirschfelder (1952); docs/method.md, section 19.
    """


Integrator = ImplicitEuler | SDIRK2 | BDF2


def check_integrator(integrator: Any) -> Integrator:
    if isinstance(integrator, type) and issubclass(integrator, Integrator):
        fail("integrator", f"an object, {integrator.__name__}()", "the class")
    if not isinstance(integrator, Integrator):
        raise TypeError(f"integrator: expected ImplicitEuler(), SDIRK2() or BDF2(), got {type(integrator).__name__}")
    return integrator
