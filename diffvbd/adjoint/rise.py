"""By how much the incremental potential of each body rises from one state to another, without gradients."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from .. import ops
from ..model.anderson import MovingBodies
from ..model.model import Model
from ..ops.anderson import potential_rise
from ..ops.detect import segment_sum
from .potential import PAIRS

ROUNDINGS = 8  # ulps of the terms by which a sum may rise all the same; twin of kRounding in csrc/coarse/length.h
LEAST_SHARE = 0.1  # of its gap that a vertex keeps; twin of kLeastShare in csrc/rigid/body.h


class RiseParts(NamedTuple):
    """What comparisons of the potential in one step have in common."""

    model: Model
    fields: ops.SweepFields  # detached; where the sweeps start does not enter
    material: Tensor  # [1 | B, blocks, 2, 8], mu and lam of the tets by body [Pa]
    rest: Tensor  # [1 | B, blocks, 7, 8]
    time_step: float

    @property
    def bodies(self) -> MovingBodies:
        return self.model._moving

    def admits(self, x: Tensor, to: Tensor) -> Tensor:
        """Whether the potential of each body lets it go from x to ``to``, bool [B, bodies]."""
        return ~rises(self, x, to)


def rise_parts(model: Model, fields: ops.SweepFields, time_step: float) -> RiseParts:
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


def rises(parts: RiseParts, x: Tensor, to: Tensor) -> Tensor:
    """Whether each body's potential at ``to`` is above that at x by more than rounding, or no number, or ``to`` is
    too near a plane, bool [B, bodies]; x, to [B, V, 3]."""
    rise, size = rise_of_bodies(parts, x, to).unbind(-1)
    return ~(rise <= ROUNDINGS * torch.finfo(x.dtype).eps * size)  # true of what is no number


def rise_of_bodies(parts: RiseParts, x: Tensor, to: Tensor) -> Tensor:
    """By how much the potential of each body rises, and the sizes of its terms, float64 [B, bodies, 2]; infinite where
    a vertex comes too near a plane."""
    model, moving = parts.model, parts.model._moving
    if x.is_cuda:
        return _rise(parts, x, to)
    index = (moving.order, moving.ptr, model._other_bodies.of, moving.corner, moving.block_ptr)
    return potential_rise(parts.fields, x, to.contiguous(), parts.material, parts.rest, index, model._data_count,
                          parts.time_step)  # fmt: skip


def _rise(parts: RiseParts, x: Tensor, to: Tensor) -> Tensor:
    """ops.potential_rise in torch, for CUDA: decided by differences of terms, in the dtype of the positions."""
    moving, of_tets = parts.model._moving, _of_tets(parts, x, to)
    own = _of_vertices(parts, x, to)
    blocks = torch.arange(of_tets.shape[1], dtype=torch.int32, device=x.device)
    out = segment_sum(own, moving.order, moving.ptr) + segment_sum(of_tets, blocks, moving.block_ptr)
    return out.double()


def _of_vertices(parts: RiseParts, x: Tensor, to: Tensor) -> Tensor:
    """Rise and size of the terms of single vertices, [B, V, 2]; infinite where one is too near a plane."""
    f, step = parts.fields, to - x
    total = f.mass * (step * ((x + to) / 2 - f.y)).sum(-1)
    size = total.abs()
    energies: Any = parts.model.vertex_energies
    sizes = [e.count() * (x.shape[1] if e.per_vertex else 1) for e in energies]
    for energy, data in zip(energies, f.energy_data.split(sizes, -1) if energies else (), strict=True):
        before, after = (energy.value(at, f.x_prev, data, parts.time_step, f.origin) for at in (x, to))
        total, size = total + (after - before), size + before.abs() + after.abs()
        admitted = energy.admits(to, x, data, f.origin, LEAST_SHARE)
        if admitted is not None:
            total = torch.where(admitted, total, torch.inf)
    return torch.stack((total, size), -1)


def _of_tets(parts: RiseParts, x: Tensor, to: Tensor) -> Tensor:
    """Rise and size of the terms of each block of tets, [B, blocks, 2]: those of StableNeoHookean::line() at s = 1."""
    corner = (parts.model._moving.corner // 4).long()
    at, way = x[:, corner], (to - x)[:, corner]  # [B, blocks, 4, lanes, 3]
    e, f = at[:, :, 1:] - at[:, :, :1], way[:, :, 1:] - way[:, :, :1]
    mu, lam = parts.material.unbind(2)
    k, c6 = parts.rest[:, :, :6].unbind(2), parts.rest[:, :, 6]
    shear = torch.zeros_like(c6)
    for weight, (a, b) in zip(k, PAIRS, strict=True):
        one, two = at[:, :, b] - at[:, :, a], way[:, :, b] - way[:, :, a]
        shear = shear - weight * (two * (one + two / 2)).sum(-1)
    n, m, o = (_cross(e, e), _cross(f, e) + _cross(e, f), _cross(f, f))
    strain = c6 * (e[:, :, 0] * n).sum(-1) - 1
    more = c6 * ((f[:, :, 0] * (n + m + o)).sum(-1) + (e[:, :, 0] * (m + o)).sum(-1))
    volume = 1 / (6 * c6)
    bulk = volume * ((mu + lam) * more * (strain + more / 2) - mu * more)
    h2 = parts.time_step * parts.time_step
    terms = torch.stack((mu * shear, bulk), -1) * h2
    return torch.stack((terms.sum((-2, -1)), terms.abs().sum((-2, -1))), -1)


def _cross(a: Tensor, b: Tensor) -> Tensor:
    """Of the second edge of one and the third of the other."""
    return torch.linalg.cross(a[:, :, 1], b[:, :, 2])
