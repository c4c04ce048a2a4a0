"""The compiled operators of the rigid correction of bodies that touch, as in sweep.py."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from .fields import TouchingFields
from .functions import raw_backward, shapes_of
from .load import raw

UNKNOWNS = 6  # of a body: a turn and a shift
MOST_COUPLED = 64  # bodies that are solved for together; twin of kMostCoupled in csrc/contact/rigid.h
_FIELDS = len(TouchingFields._fields)


def rigid_system(fields: TouchingFields, data_count: Sequence[int], time_step: float, friction_eps: float
                 ) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """The Newton step over a turn and a shift of each body, float64: centers of mass [B, bodies, 3] [m], motion
    [B, bodies, 6], and Cholesky factor [B, 6 bodies, 6 bodies], or [B, bodies, 6, 6] of more than MOST_COUPLED
    bodies."""
    return raw.contact_rigid_system(*fields, data_count, time_step, friction_eps)


def rigid_solve(factor: Tensor, right: Tensor) -> Tensor:
    """Solutions for right [B, bodies, 6] with the factor of :func:`rigid_system`."""
    return raw.contact_rigid_solve(factor, right.contiguous())


def rigid_move(fields: TouchingFields, centers: Tensor, motion: Tensor, data_count: Sequence[int], time_step: float,
               friction_eps: float) -> tuple[Tensor, Tensor]:  # fmt: skip
    """The state after each body has taken what it may of its motion [B, bodies, 6], [B, V, 3], and that share,
    float64 [B, bodies]."""
    return raw.contact_rigid_move(*fields, centers, motion, data_count, time_step, friction_eps)


def rigid_backward(fields: TouchingFields, p: Tensor, q: Tensor, data_count: Sequence[int], time_step: float,
                   friction_eps: float) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
    """What pairs add to the derivatives of p . (gradient + matrix q) of the Newton step, p and q being motions of all
    corner points [B, N, 3]. For each listed pair: by the positions, p and q of its corners [pairs, 4, 9] and by kappa
    [pairs]; for each lagged pair likewise, and by its lag [pairs, 9]."""
    return raw.contact_rigid_backward(*fields, p.contiguous(), q.contiguous(), data_count, time_step, friction_eps)


@shapes_of("contact_rigid_system")
def _(*arguments):
    f = TouchingFields(*arguments[:_FIELDS])
    b, n = f.x.shape[0], f.free.shape[0]
    shape = (b, UNKNOWNS * n, UNKNOWNS * n) if n <= MOST_COUPLED else (b, n, UNKNOWNS, UNKNOWNS)
    return tuple(f.x.new_empty(size, dtype=torch.float64) for size in ((b, n, 3), (b, n, UNKNOWNS), shape))


@shapes_of("contact_rigid_solve")
def _(factor, right):
    return torch.empty_like(right)


@shapes_of("contact_rigid_move")
def _(*arguments):
    f = TouchingFields(*arguments[:_FIELDS])
    return torch.empty_like(f.x), f.x.new_empty((f.x.shape[0], f.free.shape[0]), dtype=torch.float64)


@shapes_of("contact_rigid_backward")
def _(*arguments):
    f = TouchingFields(*arguments[:_FIELDS])
    listed, lagged = f.pairs.shape[0], f.lag_pairs.shape[0] if f.lag.numel() else 0
    return tuple(f.x.new_empty(shape) for shape in ((listed, 4, 9), (listed,), (lagged, 4, 9), (lagged, 9)))


for _name in ("contact_rigid_system", "contact_rigid_solve", "contact_rigid_move", "contact_rigid_backward"):
    torch.library.register_autograd(f"diffvbd::{_name}", raw_backward)
