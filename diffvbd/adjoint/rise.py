"""Increase of the incremental potential of each body from one state to another, without gradients."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from .. import ops
from ..model.moving import MovingBodies
from ..model.system import System
from ..ops.fields import ROUNDINGS
from ..ops.sweep import potential_rise


class RiseParts(NamedTuple):
    """Common data of the comparisons of the potential in one step."""

    model: System
    fields: ops.SweepFields  # detached; where the sweeps start does not enter
    material: Tensor  # [1 | B, blocks, 2, 8], mu and lam of the tets by body [Pa]
    rest: Tensor  # [1 | B, blocks, 7, 8]
    time_step: float

    @property
    def bodies(self) -> MovingBodies:
        return self.model._moving

    def admits(self, x: Tensor, to: Tensor) -> Tensor:
        """Whether the potential of each body lets it go from x to ``to`` [B, V, 3]: it does not rise by more than
        rounding, is a number, and ``to`` is not too near a plane; bool [B, bodies]."""
        rise, size = rise_of_bodies(self, x, to).unbind(-1)
        return rise <= ROUNDINGS * torch.finfo(x.dtype).eps * size  # False where it is not a number

    def raises(self, x: Tensor, to: Tensor) -> Tensor:
        """Vertices of bodies whose potential does not let them go from x to ``to``, bool [B, V]."""
        admitted, bodies = self.admits(x, to), self.bodies
        if bodies.number == 0:
            return admitted.new_zeros(x.shape[:2])
        moves, of = self.model.derived("moving_body", lambda: (bodies.of < bodies.number, bodies.of % bodies.number))
        return moves > admitted[:, of]  # moves and not admitted, in one launch


def rise_parts(model: System, fields: ops.SweepFields, time_step: float) -> RiseParts:
    """fields: of the step's sweeps."""
    # contiguous: a state may be expanded over scenes
    fields = ops.SweepFields(*(t if t is None else t.detach().contiguous() for t in fields))  # pyright: ignore
    moving: MovingBodies = model._moving
    blocks, lanes = moving.tet.shape
    counts = fields.mu.shape[0], fields.lam.shape[0]
    scenes = max(counts) if min(counts) else 0  # a modulus of no scenes leaves none
    material = fields.mu.new_empty((scenes, blocks, 2, lanes))
    for i, modulus in enumerate((fields.mu, fields.lam)):
        material[:, :, i] = modulus[..., None] if modulus.shape[1] == 1 else modulus[:, moving.tet]
    rest = moving.rest if fields.rest is None else fields.rest[:, moving.tet].transpose(-1, -2).contiguous()
    return RiseParts(model, fields, material, rest, time_step)


def rise_of_bodies(parts: RiseParts, x: Tensor, to: Tensor) -> Tensor:
    """Increase of the potential of each body, and the sizes of its terms, float64 [B, bodies, 2]; infinite where
    a vertex comes too near a plane."""
    model, moving = parts.model, parts.model._moving
    index = (moving.order, moving.ptr, model._other_bodies.of, moving.corner, moving.block_ptr)
    return potential_rise(parts.fields, x, to.contiguous(), parts.material, parts.rest, index, model._data_count,
                          parts.time_step)  # fmt: skip
