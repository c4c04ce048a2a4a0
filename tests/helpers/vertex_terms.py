"""Gradient and blocks of inertia, vertex energies and friction on a floor, by torch: the oracle of tests of the
corrections of bodies that touch."""

from typing import Any, NamedTuple

import torch
from torch import Tensor

from diffvbd import ops
from diffvbd.adjoint.potential import of_vertices
from diffvbd.ops import broadcast
from diffvbd.reference.energies import RESTING


class Scenes(NamedTuple):
    """Fields of a correction."""

    model: Any
    fields: ops.TouchingFields
    time_step: float
    friction_eps: float  # [m]


def outer(n: Tensor) -> Tensor:
    return n[..., None] * n[..., None, :]


def _slip(u: Tensor, eps: float) -> tuple[Tensor, Tensor]:
    """f1(|u|) / |u| of friction and the derivative of this quotient over |u|, of tangential motions u [..., 3]."""
    square = (u * u).sum(-1)
    moves = square > (RESTING * eps) ** 2
    length = torch.where(moves, torch.where(moves, square, torch.ones_like(square)).sqrt(), square.detach().sqrt())
    sticks = length < eps
    rate = torch.where(sticks, (2 - length / eps) / eps, 1 / torch.where(sticks, torch.ones_like(length), length))
    slope = torch.where(sticks, -1 / eps**2, -rate * rate)
    return rate, torch.where(moves, slope / torch.where(moves, length, torch.ones_like(length)), 0.0)


def _slip_stiffness(rate: Tensor, bend: Tensor, n: Tensor, u: Tensor) -> Tensor:
    """Exact derivative of friction by the tangential motion [..., 3, 3]; rate, bend: results of _slip times the
    load."""
    eye = torch.eye(3, dtype=n.dtype, device=n.device)
    return rate[..., None, None] * (eye - outer(n)) + bend[..., None, None] * outer(u)


def _vertex_energies(s: Scenes) -> list[tuple[Any, tuple[Tensor, float, Tensor | None]]]:
    """Vertex energies, each with its data, the time step and the origin."""
    f = s.fields
    out, first, origin = [], 0, f.origin if f.origin.numel() else None
    for energy in s.model.vertex_energies:
        size = energy.count() * (s.model.num_vertices if energy.per_vertex else 1)
        own = f.energy_data[:, first : first + size]
        own = broadcast(own, (len(f.x), size)) if energy.per_vertex else of_vertices(own, f.x)
        out.append((energy, (own, s.time_step, origin)))
        first += size
    return out


def _floor_slip(s: Scenes) -> tuple[Tensor, Tensor, Tensor]:
    """Floor friction: tangential motion along each plane, and the results of _slip times the load [N]."""
    load, n = s.fields.floor_lag[..., 0], s.fields.floor_lag[..., 1:]
    travel = (s.fields.x - s.fields.x_prev)[:, :, None]
    u = travel - n * (n * travel).sum(-1, keepdim=True)
    rate, bend = _slip(u, s.friction_eps)
    return u, load * rate, load * bend


def vertex_gradient(s: Scenes) -> Tensor:
    """Gradient of inertia, vertex energies and floor friction [B, V, 3]; without inertia at pinned vertices."""
    f = s.fields
    off = torch.where(s.model._pinned[:, None], torch.zeros_like(f.x), f.x - f.y)
    force = broadcast(f.mass, f.x.shape[:2])[..., None] * off
    for energy, rest in _vertex_energies(s):
        force = force + energy.gradient(f.x, f.x_prev, *rest)
    if f.floor_lag.numel():
        u, rate, _ = _floor_slip(s)
        force = force + s.time_step**2 * (rate[..., None] * u).sum(2)
    return force


def vertex_blocks(s: Scenes) -> Tensor | None:
    """Blocks [B, V, 3, 3] of its derivative without inertia; None: there are none."""
    f = s.fields
    parts = [energy.blocks(f.x, f.x_prev, *rest) for energy, rest in _vertex_energies(s)]
    if f.floor_lag.numel():
        u, rate, bend = _floor_slip(s)
        parts.append(s.time_step**2 * _slip_stiffness(rate, bend, f.floor_lag[..., 1:], u).sum(2))
    out = None
    for part in parts:
        out = part if out is None else out + part
    return None if out is None else broadcast(out, (*f.x.shape, 3))
