"""The compiled operators of what contact leaves of an acceleration, as in sweep.py."""

from __future__ import annotations

import torch
from torch import Tensor

from .functions import raw_backward, shapes_of
from .load import direct as raw


def unsupported(x: Tensor, origin: Tensor, lift: Tensor, force: Tensor, mass: Tensor, planes: Tensor,
                held_bodies: Tensor, body_order: Tensor, body_ptr: Tensor, time_step: float) -> Tensor:  # fmt: skip
    """What is left of ``lift`` [B, V, 3] [m] once forces have borne their part of each body's acceleration.

    Sums over a body make its own acceleration a and that of the forces f. Contact takes the share s of f, between 0 and
    1, that leaves least of a + s f; it takes none of a body that is held. Results repeat to the bit.

    Args:
        x, origin: [B, V, 3] [m], the latter may be empty.
        lift: [1 | B, V, 3], h^2 times the acceleration of each vertex [m].
        force: [B, N, 3] of pairs at corner points [N], the vertices first; what follows them is not read.
        mass: [1 | B, V] [kg].
        planes: Data of a FloorBarrier [1 | B, 7 planes], whose forces count as well; or empty.
        held_bodies: [bodies] bool.  body_order, body_ptr: Vertices by body [V], and the first of each [bodies + 1].
        time_step: [s].

    Raises:
        ValueError: A tensor with the wrong shape, dtype or device.
    """
    return raw.contact_unsupported(x, origin, lift, force, mass, planes, held_bodies, body_order, body_ptr, time_step)


def unsupported_backward(bar: Tensor, x: Tensor, origin: Tensor, lift: Tensor, force: Tensor, mass: Tensor,
                         planes: Tensor, held_bodies: Tensor, body_order: Tensor, body_ptr: Tensor, time_step: float,
                         wants_planes: bool) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
    """Adjoints of x [B, V, 3], or none without a floor, lift [B, V, 3], force [B, N, 3], mass [B, V], and of planes by
    body [B, bodies, 7 planes], or none."""
    return raw.contact_unsupported_backward(bar, x, origin, lift, force, mass, planes, held_bodies, body_order,
                                            body_ptr, time_step, wants_planes)  # fmt: skip


@shapes_of("contact_unsupported")
def _(x, origin, lift, force, mass, planes, held_bodies, body_order, body_ptr, time_step):
    return torch.empty_like(x)


@shapes_of("contact_unsupported_backward")
def _(bar, x, origin, lift, force, mass, planes, held_bodies, body_order, body_ptr, time_step, wants_planes):
    scenes, vertices = x.shape[:2]
    scalars = planes.numel() // planes.shape[0] if planes.numel() else 0
    return (x.new_empty((scenes if scalars else 0, vertices, 3)), torch.empty_like(x), torch.empty_like(force),
            x.new_empty((scenes, vertices)),
            x.new_empty((scenes if wants_planes else 0, held_bodies.shape[0], scalars)))  # fmt: skip


for _name in ("contact_unsupported", "contact_unsupported_backward"):
    torch.library.register_autograd(f"diffvbd::{_name}", raw_backward)
