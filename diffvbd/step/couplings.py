"""Couplings in a step: their bound about a state, as data of the sweeps (couplings.py)."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from .. import ops
from .._common.checks import input_name
from ..couplings import load_of
from ..model.system import System


def parameters_at(model: System, given: dict[str, Tensor], scenes: int) -> list[dict[str, Tensor]]:
    """The parameters of each coupling by key, [B, ...]; given: as in Prepared."""
    return [
        {key: ops.broadcast(given.get(input_name(energy, key), own[None]), (scenes, *own.shape))
         for key, own in model.constants(energy).items()} for energy in model.couplings
    ]  # fmt: skip


def row_of(model: System, given: dict[str, Tensor], scenes: int) -> Tensor:
    """The parameters of all couplings in one row [B, n]; arguments as of parameters_at()."""
    values = parameters_at(model, given, scenes)
    flat = [value.flatten(1) for own in values for value in own.values()]
    return torch.cat(flat, 1) if flat else model._mass.new_zeros((1, 0))


class Coupled(NamedTuple):
    """The couplings of a step, at states x [B, V, 3] relative to its origin where there is one."""

    model: System
    values: list[dict[str, Tensor]]  # as of parameters_at()
    data: Tensor  # [B, n], of the other energies, the anchors last
    origin: Tensor | None

    def place(self, x: Tensor) -> Tensor:
        return x if self.origin is None else x + self.origin

    def load(self, x: Tensor) -> Tensor:
        """As of Coupling."""
        return load_of(self.model.couplings, self.values, self.place(x))

    def terms(self, x: Tensor) -> Tensor:
        """As of Coupling, of one coupling after the other."""
        at = self.place(x)
        return torch.cat([e.terms(at, own) for e, own in zip(self.model.couplings, self.values, strict=True)], 1)

    def bound(self, x: Tensor) -> Tensor:
        """The data with the couplings' bound about x."""
        load, data = self.load(x), self.data
        others = data.shape[1] - 4 * self.model.num_vertices
        stiffness, point = data[:, others:].unflatten(1, (-1, 4)).split((1, 3), -1)
        # two springs of a vertex are one, but for a constant
        total = stiffness + load[..., 3:]
        step = (stiffness * (point - x) - load[..., :3]) / torch.where(total > 0, total, 1.0)
        anchors = torch.cat([total, x + torch.where(total > 0, step, 0.0)], -1)
        return torch.cat([data[:, :others], anchors.flatten(1)], 1)


def coupled_of(model: System, given: dict[str, Tensor], data: Tensor, origin: Tensor | None, scenes: int) -> Coupled:
    """given: Parameters of energies, as in Prepared.  data: Of the other energies [1 | B, n], the anchors last."""
    return Coupled(model, parameters_at(model, given, scenes), ops.broadcast(data, (scenes, data.shape[1])), origin)
