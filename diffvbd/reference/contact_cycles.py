"""The sweeps of a part of a step with contact, with the combinations of iterates that it has taken."""

from collections.abc import Callable
from typing import Any

from torch import Tensor

from .anderson import Anderson
from .scene import Scene


def in_cycles(
    scene: Scene,
    energies: list[Any],
    swept: Callable[..., Tensor],
    state: Tensor,
    y: Tensor,
    x_prev: Tensor,
    number: int,
    limits: Tensor | None,
    combined: tuple[Tensor, Tensor] | None,
) -> Tensor:
    """The state [..., 3, V] after so many sweeps.

    swept(state, x_prev, sweeps, limits): the state after some of them. limits, combined: of the Part.
    """
    lead = state.shape[:-2]
    limits = None if limits is None else limits.reshape(number, *lead, 1, -1).to(state)
    if combined is None:
        return swept(state, x_prev, number, limits)
    anderson, before, after = Anderson(scene, energies), [], []
    sets, taken = (t.reshape(*t.shape[:-2], *lead, -1) for t in combined)
    for n in range(number):
        before.append(state)
        state = swept(state, x_prev, 1, None if limits is None else limits[n : n + 1])
        after.append(state)
        if 0 < n < number - 1:
            state = anderson.combine(before, after, y, x_prev, taken[n - 1], sets)
    return state
