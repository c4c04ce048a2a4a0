"""The compiled operators of the rigid correction of bodies that touch, as in sweep.py."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from .fields import TouchingFields
from .functions import raw_backward, shapes_of
from .load import direct as raw
from .rigid import join_data, scalars_of_data

UNKNOWNS = 6  # of a body: a turn and a shift
# Twins of the constants in csrc/contact/groups.h
FEW = 3  # bodies of scenes that are one group
MOST_COUPLED = 64  # bodies of a group,
GROUP_MEMORY = 32 << 10  # of which there are at most so many over the bodies of the scene
_FIELDS = len(TouchingFields._fields)


def rigid_system(fields: TouchingFields, data_count: Sequence[int], time_step: float, friction_eps: float,
                 moving: Tensor | None = None, alone: bool = False
                 ) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
    """The turn and the shift of each body to where the step's potential is least, float64: centers of mass
    [B, bodies, 3] [m], motion [B, bodies, 6], Cholesky factors of groups that touch [B, bodies, 6, 6 most_grouped()],
    and groups int32 [B, 4, bodies], as csrc/contact/groups.h has them. Of no more than FEW bodies: one factor
    [B, 6 bodies, 6 bodies], and no groups. friction_eps: [m], 0 without friction. moving: bool [B, bodies]: only these
    move, and what is in a group with one; of scenes without groups, what touches one. alone: in scenes of more than FEW
    bodies only groups of one do; factors [B, bodies, 6, 6]."""
    moving = fields.free.new_empty((0,)) if moving is None else moving.contiguous()
    return raw.contact_rigid_system(*fields, data_count, time_step, friction_eps, moving, alone)


def left_alone(groups: Tensor) -> Tensor:
    """Which bodies [B, bodies] are left alone, because those that touch are too many; of groups that are not empty."""
    return groups[:, 3].gather(1, groups[:, 1].long()) < 0


class Moved(NamedTuple):
    """What :func:`rigid_move` returns."""

    x: Tensor  # [B, V, 3]
    share: Tensor  # float64 [B, bodies]: of its motion that each body took; beside `moving` zero where it has none
    moved: Tensor  # bool [B, bodies]: whether it has a motion
    held: Tensor  # bool [B, bodies]: whether it was held up, in a scene in which some of those that were have gone on
    left: Tensor  # [B, bodies]: how much of its shift it did not take [m]


def rigid_move(fields: TouchingFields, centers: Tensor, motion: Tensor, data_count: Sequence[int], time_step: float,
               friction_eps: float, moving: Tensor | None = None) -> Moved:  # fmt: skip
    """After each body has taken what it may of its motion [B, bodies, 6]. moving: As for :func:`rigid_system`."""
    moving = fields.free.new_empty((0,)) if moving is None else moving.contiguous()
    return Moved(*raw.contact_rigid_move(*fields, centers, motion, data_count, time_step, friction_eps, moving))


def most_grouped(bodies: int) -> int:
    """Bodies of a group at most."""
    return min(max(GROUP_MEMORY // max(bodies, 1), 1), MOST_COUPLED, bodies)


class PairWork(NamedTuple):
    """What :func:`rigid_backward` finds."""

    by_x: Tensor  # [B, N, 3]: by where corner points are,
    by_p: Tensor  # by p, without pairs of which no corner moves by p,
    by_q: Tensor  # and by q
    since: Tensor  # by_x of lagged pairs alone, which have it by how points have moved since the start; or empty
    by_kappa: Tensor  # [pairs], of each listed pair
    lag_bar: Tensor  # [lagged, 9]: less the derivatives by what is lagged


def rigid_backward(fields: TouchingFields, p: Tensor, q: Tensor, groups: Tensor, data_count: Sequence[int],
                   time_step: float, friction_eps: float) -> PairWork:  # fmt: skip
    """What pairs add to the derivatives of p . (gradient + matrix q) of the Newton step, p and q being motions of all
    corner points [B, N, 3], groups those of the step."""
    return PairWork(*raw.contact_rigid_backward(*fields, p.contiguous(), q.contiguous(), groups, data_count, time_step,
                                                friction_eps))  # fmt: skip


class Made(NamedTuple):
    """Corrections one after another, the first one first."""

    x: Sequence[Tensor]  # where each began [B, V, 3]
    motion: Sequence[Tensor]
    share: Sequence[Tensor]
    factor: Sequence[Tensor]
    groups: Sequence[Tensor]


class RigidAdjoints(NamedTuple):
    """What :func:`rigid_reverse` finds, of each scene and pair."""

    x: Tensor  # [B, V, 3], as are the next two
    x_prev: Tensor
    y: Tensor
    mass: Tensor  # [B, V]
    energy_data: Tensor  # [B, n], or empty
    floor_lag: Tensor  # [B, V, planes, 4], or empty
    collider: Tensor  # [B, Vc, 3]
    collider_prev: Tensor
    by_kappa: Tensor  # [pairs]: minus what each listed pair adds to the adjoint of kappa
    lag: Tensor  # [lagged, 9]


def rigid_reverse(fields: TouchingFields, made: Made, x_bar: Tensor, data_count: Sequence[int], time_step: float,
                  friction_eps: float, wants_data: bool) -> RigidAdjoints:  # fmt: skip
    """The adjoint of corrections, of that of where the last one led, x_bar [B, V, 3]: of their ways, and of
    -p . (gradient + matrix q), p and q being how points move by the adjoint of a motion and by the motion. fields: Of
    all of them, but for x."""
    x, x_prev, y, mass, shared, own, *rest = raw.contact_rigid_reverse(
        *fields, *(list(each) for each in made), x_bar.contiguous(), data_count, time_step, friction_eps, wants_data
    )
    data = join_data(shared, own, data_count) if wants_data else shared
    return RigidAdjoints(x, x_prev, y, mass, data, *rest)


@shapes_of("contact_rigid_system")
def _(*arguments):
    f = TouchingFields(*arguments[:_FIELDS])
    b, n = f.x.shape[0], f.free.shape[0]
    together = n <= FEW
    room = 1 if arguments[-1] else most_grouped(n)
    shape = (b, UNKNOWNS * n, UNKNOWNS * n) if together else (b, n, UNKNOWNS, UNKNOWNS * room)
    doubles = (f.x.new_empty(size, dtype=torch.float64) for size in ((b, n, 3), (b, n, UNKNOWNS), shape))
    return (*doubles, f.x.new_empty((0,) if together else (b, 4, n), dtype=torch.int32))


@shapes_of("contact_rigid_move")
def _(*arguments):
    f = TouchingFields(*arguments[:_FIELDS])
    of_bodies = (f.x.new_empty((f.x.shape[0], f.free.shape[0]), dtype=dtype)
                 for dtype in (torch.float64, torch.bool, torch.bool, f.x.dtype))  # fmt: skip
    return torch.empty_like(f.x), *of_bodies


@shapes_of("contact_rigid_backward")
def _(*arguments):
    f = TouchingFields(*arguments[:_FIELDS])
    listed, lagged = _rows(f)
    b, n = f.x.shape[0], f.body.shape[0]
    since = (b if lagged else 0, n, 3)
    return tuple(f.x.new_empty(shape) for shape in (*[(b, n, 3)] * 3, since, (listed,), (lagged, 9)))


def _rows(f: TouchingFields) -> tuple[int, int]:
    return f.pairs.shape[0], f.lag_pairs.shape[0] if f.lag.numel() else 0


@shapes_of("contact_rigid_reverse")
def _(*arguments):
    f, wants_data = TouchingFields(*arguments[:_FIELDS]), arguments[-1]
    b, v = f.x.shape[:2]
    planes = f.floor_lag.numel() // max(1, f.floor_lag.shape[0] * v * 4)
    listed, lagged = _rows(f)
    shared, own = scalars_of_data(arguments[-4])
    data = ((b, f.free.shape[0] if wants_data else 0, shared), (b, v if wants_data else 0, own))
    colliders = (b, f.body.shape[0] - v, 3)
    sizes = ((b, v), *data, (b if planes else 0, v, planes, 4), colliders, colliders, (listed,), (lagged, 9))
    return (*(torch.empty_like(f.x) for _ in range(3)), *(f.x.new_empty(size) for size in sizes))


for _name in ("contact_rigid_system", "contact_rigid_move", "contact_rigid_backward", "contact_rigid_reverse"):
    torch.library.register_autograd(f"diffvbd::{_name}", raw_backward)
