"""The compiled operators of contact: detection, intersections, islands, sums over segments. Raw and
functional, as in sweep.py.

Sizes: B scenes that never mix, V vertices, Vc collider points, N = V + Vc corner points (vertices first), F triangles,
E edges, P points, L planes, NB bodies of the mesh. Index tensors are int32; float tensors have the dtype of x; all are
contiguous and on one device.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from .functions import raw_backward, shapes_of
from .load import direct as raw

PAIR_ROW, CONSTANTS, NEAR_ROW, NEAR_VALUES, COUNTS = 6, 8, 5, 8, 4  # twins of those in csrc/contact/candidates.h
CROSSING_ROW = 3  # and in csrc/contact/intersect.h


class Detection(NamedTuple):
    """Pairs of primitives that are, or may come, closer than the barrier's reach."""

    pairs: Tensor  # [capacity, 6]  corner points, kind (0 point-triangle, 1 edge-edge, 2 point-plane), scene; or -1
    constants: Tensor  # [capacity, 8]  reach of the barrier [m], sum of the radii [m], mollifier threshold [m^4]; hints
    ptr: Tensor  # [B N + 1]  pairs of corner point i of scene b: entry[ptr[b N + i] : ptr[b N + i + 1]],
    entry: Tensor  # [4 capacity]  each 4 pair + local corner, in ascending order
    near_corners: Tensor  # [B, N, 5]  corner points and kind of the pair with the smallest gap; i four times, -1: none
    near_values: Tensor  # [B, N, 8]  its weights, normal and gap [m]; without one, zeros and how far was looked
    counts: Tensor  # [4] int64  pairs that the list needs, pairs that touch, smallest key of those or -1, 0
    smallest: Tensor  # [B]  smallest gap, or how far was looked [m]


def contact_detect(x: Tensor, origin: Tensor, collider: Tensor, collider_next: Tensor, rest: Tensor, radius: Tensor,
                   triangles: Tensor, edges: Tensor, points: Tensor, planes: Tensor, body: Tensor, held: Tensor,
                   room: Tensor, own_room: Tensor, mesh_bodies: int, self_contact: bool, between_bodies: bool,
                   dhat: float, capacity: int, trim: bool = False) -> Detection:  # fmt: skip
    """Near pair of every corner point, and the pairs that may come within reach of the barrier before the next call.

    The vertices of a body may go as far as its room beside what its island does, and as far as its own room beside a
    turn of at most a radian and a shift of the body; colliders have none. A pair is listed if its gap, less the rooms
    of its two sides, is below the barrier's reach, which is ``dhat`` or, for two sides of one body that are closer at
    rest, 0.9 times their distance at rest; two sides of one body if it is below 1.15 times reach and both own rooms.
    Two colliders make no pair, nor do four held corner points, nor two sides of one body that are one place at rest.

    A surface point that is not finite counts as touching. Where ``counts[0] > capacity``, the list holds some of the
    pairs that it needs. Not differentiable; results repeat to the bit.

    Args:
        x: [B, V, 3] positions [m], relative to ``origin`` [B, V, 3], one point for each body; or empty.
        collider, collider_next: [B, Vc, 3] [m] now, and during the sweeps that follow. Gaps of planes are those at the
            latter, or now where they end behind the point; what is near them now is listed, too.
        rest, radius: [N, 3] [m], [N] [m], the latter 0 for vertices.
        triangles, edges, points: [F, 3], [E, 2], [P] corner points of surfaces, unique.
        planes: [L, 3] collider points that span each plane, counterclockwise seen from the free side.
        body, held: [N]; labels from ``mesh_bodies`` on are colliders; held: bool, no sweep moves it.
        room, own_room: [B, mesh_bodies + 1] how far the vertices of each body may go [m], and the largest.
        self_contact, between_bodies: Which pairs of mesh bodies to consider.
        dhat: [m].
        capacity: Rows of the list.
        trim: On the CPU, only as many rows as pairs fill: rows that none fills may cost more than the search. CUDA,
            which would wait for their number, does not trim; torch.compile takes longer with sizes that it cannot know.

    Raises:
        ValueError: A tensor with the wrong shape, dtype or device; too large a scene.
    """
    return Detection(
        *raw.contact_detect(
            x, origin, collider, collider_next, rest, radius, triangles, edges, points, planes, body, held,
            room, own_room, mesh_bodies, self_contact, between_bodies, dhat, capacity, trim,
        )
    )  # fmt: skip


class Intersections(NamedTuple):
    """Edges of surfaces that pass through triangles, and points behind planes. Rows are those of the arguments."""

    pairs: Tensor  # [capacity, 3] int32  scene, edge, triangle in lexicographic order, then -1
    counts: Tensor  # [B, 2] int64  edges through triangles, points behind planes
    first: Tensor  # [B, 2, 2] int32  the first edge and its triangle, the first point and its plane; or -1


def contact_intersections(x: Tensor, origin: Tensor, collider: Tensor, rest: Tensor, radius: Tensor, triangles: Tensor,
                          edges: Tensor, points: Tensor, planes: Tensor, body: Tensor, held: Tensor, mesh_bodies: int,
                          self_contact: bool, between_bodies: bool, capacity: int) -> Intersections:  # fmt: skip
    """Crossings that contact cannot undo, because distances do not show them: a start must have none.

    An edge crosses a triangle, with which it shares no vertex, when its ends lie on both sides of the plane and it
    meets the closed triangle, border included. Signs are those of ``x + origin`` in double precision: an end that
    rounding could bring to the other side does not count, a border that it could counts as met. What is not finite
    crosses nothing. Pairs that :func:`contact_detect` does not consider do not count: two colliders, five held corner
    points, bodies whose contact is off, and an edge and a triangle of one body with features that are one place at
    rest. Not differentiable; results repeat to the bit.

    Args:
        x, origin, collider, rest, radius, triangles, edges, points, planes, body, held, mesh_bodies, self_contact,
            between_bodies: As for :func:`contact_detect`, collider points and planes at one time.
        capacity: Rows of ``pairs``. Where ``counts[:, 0].sum()`` is more, CUDA lists any of them.

    Raises:
        ValueError: A tensor with the wrong shape, dtype or device; too large a scene.

    Source: bounds of rounding after Shewchuk (1997).
    """
    return Intersections(
        *raw.contact_intersections(
            x, origin, collider, rest, radius, triangles, edges, points, planes, body, held, mesh_bodies, self_contact,
            between_bodies, capacity,
        )
    )  # fmt: skip


def contact_islands(x: Tensor, origin: Tensor, move: Tensor, mass: Tensor, collider: Tensor, collider_next: Tensor,
                    planes: Tensor, body: Tensor, body_order: Tensor, body_ptr: Tensor, held: Tensor, radius: Tensor,
                    room: Tensor, mesh_bodies: int, dhat: float, any_direction: bool = False) -> Tensor:  # fmt: skip
    """Smallest body of the island of bodies in contact that each body is in [B, NB] int32, or -1.

    An island moves by the mass-weighted mean of ``move`` over its vertices that are not held. Bodies whose boxes, swept
    by that and grown by room and dhat / 2, overlap are of one island. -1: the island holds a held vertex or may reach
    a collider, and must stay. Not differentiable; results repeat to the bit.

    Args:
        x, origin, collider, collider_next, planes, body, held, radius, room, dhat: As for :func:`contact_detect`.
        move, mass: [B, V, 3] where each vertex wants to go [m], [1 | B, V] [kg].
        any_direction: Whether a floor may turn a translation into any direction, by which it does not become longer.
        body_order, body_ptr: [V] vertices sorted by body, [NB + 1] the first of each body.

    Raises:
        ValueError: A tensor with the wrong shape, dtype or device.
    """
    return raw.contact_islands(x, origin, move, mass, collider, collider_next, planes, body, body_order, body_ptr,
                                held, radius, room, mesh_bodies, dhat, any_direction)  # fmt: skip


def segment_sum(values: Tensor, order: Tensor, ptr: Tensor) -> Tensor:
    """[B, V, C] -> [B, S, C]: sums of ``values[:, order[ptr[s] : ptr[s + 1]]]``, in an order that shapes alone decide.

    Args:
        values: [B, V, C], float64 or float32.
        order, ptr: Rows of ``values``, segment by segment, and the first of each segment [S + 1].

    Raises:
        ValueError: A tensor with the wrong shape, dtype or device.
    """
    return raw.segment_sum(values, order, ptr)


# --- shapes without execution, no autograd ----------------------------------------------------------------------------


@shapes_of("contact_detect")
def _(x, origin, collider, collider_next, rest, radius, triangles, edges, points, planes, body, held, room, own_room,
      mesh_bodies, self_contact, between_bodies, dhat, capacity, trim):  # fmt: skip
    b, n = x.shape[0], body.shape[0]
    rows = torch.library.get_ctx().new_dynamic_size() if trim and x.device.type == "cpu" else capacity

    def integers(*shape: int, dtype: torch.dtype = torch.int32) -> Tensor:
        return x.new_empty(shape, dtype=dtype)

    return (integers(rows, PAIR_ROW), x.new_empty((rows, CONSTANTS)), integers(b * n + 1), integers(4 * rows),
            integers(b, n, NEAR_ROW), x.new_empty((b, n, NEAR_VALUES)),
            integers(COUNTS, dtype=torch.int64), x.new_empty((b,)))  # fmt: skip


@shapes_of("contact_intersections")
def _(x, origin, collider, rest, radius, triangles, edges, points, planes, body, held, mesh_bodies, self_contact,
      between_bodies, capacity):  # fmt: skip
    b = x.shape[0]
    return (x.new_empty((capacity, CROSSING_ROW), dtype=torch.int32), x.new_empty((b, 2), dtype=torch.int64),
            x.new_empty((b, 2, 2), dtype=torch.int32))  # fmt: skip


@shapes_of("contact_islands")
def _(x, origin, move, mass, collider, collider_next, planes, body, body_order, body_ptr, held, radius, room,
      mesh_bodies, dhat, any_direction):  # fmt: skip
    return x.new_empty((x.shape[0], mesh_bodies), dtype=torch.int32)


@shapes_of("segment_sum")
def _(values, order, ptr):
    return values.new_empty((values.shape[0], ptr.shape[0] - 1, values.shape[2]))


for _name in ("contact_detect", "contact_intersections", "contact_islands", "segment_sum"):
    torch.library.register_autograd(f"diffvbd::{_name}", raw_backward)
