"""Near pairs at a state, and intersections."""

from __future__ import annotations

import torch
from torch import Tensor

from .._contact.barrier import PairBarrier
from .._contact.surface import ContactSurface
from ..ops import contact as ops_contact


def detect(x: Tensor, origin: Tensor, was: Tensor, now: Tensor, surface: ContactSurface, barrier: PairBarrier,
           capacity: int, trust_radius: Tensor, deformation_radius: Tensor) -> tuple[Tensor, ...]:  # fmt: skip
    """Pairs that may come closer than dhat before the next detection, and the nearest pair of each corner point.

    Args:
        x: [B, V, 3] [m], relative to origin [B, V, 3] or empty.  was, now: Collider points [B, Vc, 3] [m].
        capacity: Pairs of all scenes that fit.
        trust_radius, deformation_radius: Of each body, relative to its island and to its rigid motion, and the largest
            [B, bodies + 1] [m].

    Returns, with ``capacity`` rows, or on the CPU without torch.compile as many as there are pairs:
        pairs [capacity, 6] int32 (four corner points, kind, scene), constants [capacity, 8] (dhat, offset, measure,
        hints), ptr [B N + 1] int32 and entry [4 capacity] int32 (4 pair + corner of each corner point);
        near_corners [B, N, 5] int32 (corners, kind), near_values [B, N, 8] (weights, normal, gap); counts [3] int64
        (pairs needed, pairs without a gap, key of one); smallest gap [B], at most 0 where pairs have none.
    """
    s = surface
    return ops_contact.contact_detect(
        x, origin, was, now, trust_radius, deformation_radius, s.searched, s.bodies, barrier.self_contact,
        barrier.between_bodies, barrier.dhat, capacity, not torch.compiler.is_compiling(),
    )  # fmt: skip


def intersections(x: Tensor, origin: Tensor, colliders: Tensor, surface: ContactSurface, self_contact: bool,
                  between_bodies: bool, capacity: int = 0) -> ops_contact.Intersections:  # fmt: skip
    """Edges that pass through triangles and points behind planes: :func:`diffvbd.ops.contact.contact_intersections`.

    Args:
        x: [B, V, 3] [m], relative to origin [B, V, 3] or empty.  colliders: Their points [B, Vc, 3] [m].
        self_contact, between_bodies: Whether bodies may not cross themselves, and each other.
        capacity: Crossings to list; their number and the first of each scene cost nothing.
    """
    s = surface
    with torch.no_grad():
        return ops_contact.contact_intersections(
            x.detach().contiguous(), origin, colliders.detach().contiguous(), s.rest, s.radius,
            s.triangles[: s.num_triangles], s.edges, s.points, s.planes, s.body, s.pinned, s.bodies, self_contact,
            between_bodies, capacity,
        )  # fmt: skip
