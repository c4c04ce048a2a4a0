"""The compiled operators of sweeps with contact, as in sweep.py."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from .fields import SweepSettings, tape_shape
from .functions import raw_backward
from .load import raw
from .sweep import sweep_adjoints

PLANE_SCALARS = 7  # twin of kPlaneScalars in csrc/contact/lowest.h
LAG_SCALARS = 9  # twin of kLagScalars in csrc/contact/pairs.h


def sweep(tensors: Sequence[Tensor], contact: Sequence[Tensor], friction_eps: float, plan: Tensor,
          settings: SweepSettings, tape_policy: int, debug_step: int, checked: bool
          ) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """x [B, V, 3], tape, and where a bound has held back, uint8 [B, V]; arguments in the schema's order."""
    return raw.contact_sweep(*tensors, *contact, friction_eps, plan, *settings, tape_policy, debug_step, checked)


def sweep_backward(x_bar: Tensor, tensors: Sequence[Tensor], contact: Sequence[Tensor], friction_eps: float,
                   tape: Tensor, plan: Tensor, settings: SweepSettings, tape_policy: int, wants: Sequence[bool]
                   ) -> tuple[Tensor, ...]:  # fmt: skip
    """Adjoints of x_start, x_prev, y, mu, lam, mass, rest, energy_data, bounds, collider, collider_prev, kappa, lag,
    floor_lag."""
    return raw.contact_sweep_backward(
        x_bar, *tensors, *contact, friction_eps, tape, plan, *settings, tape_policy, list(wants)
    )


def lag(x: Tensor, origin: Tensor, collider: Tensor, kappa: Tensor, pairs: Tensor, constants: Tensor, ptr: Tensor,
        entry: Tensor) -> Tensor:  # fmt: skip
    """Normal force, activity, normal and weights of each pair, [pairs, 9]."""
    return raw.contact_lag(x, origin, collider, kappa, pairs, constants, ptr, entry)


def lag_backward(bar: Tensor, x: Tensor, origin: Tensor, collider: Tensor, kappa: Tensor, pairs: Tensor,
                 constants: Tensor, ptr: Tensor, entry: Tensor) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """Adjoints of x [B, V, 3], collider [B, Vc, 3] and kappa [B]."""
    return raw.contact_lag_backward(bar, x, origin, collider, kappa, pairs, constants, ptr, entry)


def lowest(x: Tensor, origin: Tensor, planes: Tensor, body_order: Tensor, body_ptr: Tensor, island: Tensor
           ) -> Tensor:  # fmt: skip
    """Lowest vertex above each plane, of the island that each body is in, [B, bodies, planes] int32."""
    return raw.contact_lowest(x, origin, planes, body_order, body_ptr, island)


@torch.library.register_fake("diffvbd::contact_sweep")
def _(x_start, x_prev, y, mu, lam, mass, rest, energy_data, origin, bounds, collider, collider_prev, kappa, pairs,
      constants, ptr, entry, lag, lag_pairs, lag_ptr, lag_entry, floor_lag, friction_eps, plan, sizes, energies,
      data_count, numbers, sweeps, launch, tape_policy, debug_step, checked):  # fmt: skip
    tape = x_start.new_empty(tape_shape(x_start, sizes, energies, sweeps, launch, tape_policy))
    return torch.empty_like(x_start), tape, x_start.new_empty(x_start.shape[:2], dtype=torch.uint8)


@torch.library.register_fake("diffvbd::contact_sweep_backward")
def _(x_bar, x, x_prev, y, mu, lam, mass, rest, energy_data, origin, bounds, collider, collider_prev, kappa, pairs,
      constants, ptr, entry, lag, lag_pairs, lag_ptr, lag_entry, floor_lag, friction_eps, tape, plan, sizes, energies,
      data_count, numbers, sweeps, launch, tape_policy, wants):  # fmt: skip
    (b, v), planes = x.shape[:2], floor_lag.numel() // max(1, floor_lag.shape[0] * 4 * x.shape[1])
    colliders = collider.shape[1] if collider.dim() == 3 else 0
    shapes = [
        (b, v, 4),
        (b, colliders, 3),
        (b, colliders, 3),
        (b,),
        (lag_pairs.shape[0], LAG_SCALARS),
        (b, v, planes, 4),
    ]
    return (*sweep_adjoints(x, mu, lam, energy_data, sizes, wants), *(x.new_empty(s) for s in shapes))


@torch.library.register_fake("diffvbd::contact_lag")
def _(x, origin, collider, kappa, pairs, constants, ptr, entry):
    return x.new_empty((pairs.shape[0], LAG_SCALARS))


@torch.library.register_fake("diffvbd::contact_lag_backward")
def _(bar, x, origin, collider, kappa, pairs, constants, ptr, entry):
    colliders = collider.shape[1] if collider.dim() == 3 else 0
    return torch.empty_like(x), x.new_empty((x.shape[0], colliders, 3)), x.new_empty((x.shape[0],))


@torch.library.register_fake("diffvbd::contact_lowest")
def _(x, origin, planes, body_order, body_ptr, island):
    return x.new_empty((*island.shape, planes.shape[-1] // PLANE_SCALARS), dtype=torch.int32)


for _name in ("contact_sweep", "contact_sweep_backward", "contact_lag", "contact_lag_backward", "contact_lowest"):
    torch.library.register_autograd(f"diffvbd::{_name}", raw_backward)
