"""The sweeps of a part of a step with contact, with the coarse corrections that it has made."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from .coarse import Coarse
from .scene import Scene


def in_cycles(
    scene: Scene,
    energies: list[Any],
    forces: list[Any],
    swept: Callable[..., Tensor],
    state: Tensor,
    y: Tensor,
    x_prev: Tensor,
    number: int,
    part: Any,
) -> Tensor:
    """The state [..., 3, V] after so many sweeps.

    swept(state, x_prev, sweeps, limits, relaxation): the state after some of them. forces: terms of pairs, each with
    its `on_corners`. part: what has been decided, the Part of a detection.
    """
    lead, model = state.shape[:-2], scene.model
    limits = None if part.limits is None else part.limits.reshape(number, *lead, 1, -1).to(state)
    last = None if getattr(model, "coarse", None) is None else min(model.relaxation, 1.0)
    corrections = None if part.lengths is None else Corrections(scene, energies, forces, y, x_prev)
    every = 1 if corrections is None else model.coarse.every
    lengths: Any = part.lengths
    done, corrected = 0, 0
    while done < number:
        if corrections is not None and done:
            state = corrections(state, lengths[corrected].reshape(*lead, -1))
            corrected += 1
        alone = corrections is not None and done == 0  # a sweep before the first correction
        count = 1 if alone else min(every, number - done)
        for _ in range(count):
            own = None if limits is None else limits[done : done + 1]
            done += 1
            state = swept(state, x_prev, 1, own, last if done == number else None)
    return state


class Corrections:
    """Coarse corrections of all bodies of a scene together, against which pairs, friction and vertex energies press."""

    def __init__(self, scene: Scene, energies: list[Any], forces: list[Any], y: Tensor, x_prev: Tensor) -> None:
        self.coarse = Coarse(scene, energies, forces)
        self.forces, self.y, self.x_prev = forces, y, x_prev
        self.matrix = self.coarse.begin(x_prev)

    def __call__(self, state: Tensor, lengths: Tensor) -> Tensor:
        matrix = self.matrix + self._pressed(state)
        return self.coarse.correct(state, self.y, self.x_prev, matrix, lengths.to(state))[0]

    def _pressed(self, state: Tensor) -> Tensor:
        """Stiffness of pairs against the functions [..., 3F, 3F]."""
        weight = self.coarse.weight
        out = weight.new_zeros((state.shape[:-2].numel(), weight.shape[1], 3, weight.shape[1], 3))
        for force in self.forces:
            pairs, (_, stiffness) = force.pairs, force.on_corners(state)
            mesh = pairs.corners < len(weight)
            moved = torch.where(mesh[..., None], weight[torch.where(mesh, pairs.corners, 0)], 0.0)
            for n in range(len(out)):
                own = pairs.batch == n
                part = torch.einsum("qaf,qabij,qbg->figj", moved[own], stiffness[own], moved[own])
                out = out.index_add(0, torch.tensor([n]), part[None])
        return out.flatten(-4, -3).flatten(-2, -1).reshape(*state.shape[:-2], *self.matrix.shape[-2:])
