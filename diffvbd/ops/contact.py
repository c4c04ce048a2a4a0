"""The compiled operators of contact: searches, motions and rooms of bodies, the start of a part, what sweeps keep of
the start of a step, the rigid correction; and the search for neighboring points.

Sizes: B scenes that never mix, V vertices, Vc collider points, N = V + Vc corner points (vertices first), F triangles,
E edges, P points, L planes, NB bodies of the mesh. Index tensors are int32; float tensors have the dtype of x; all are
contiguous and on one device. What is wrong with a tensor raises ValueError. Rows of Differentiable are at the end.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from .._common.constants import FILTER_ETA
from .._common.context import is_captured
from ..energies import VERTEX_ENERGIES
from .autograd import Bars, Differentiable, sum_to
from .autograd import direct as raw
from .fields import TouchingFields
from .sums import segment_sum

# --- searches ---------------------------------------------------------------------------------------------------------


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
    """
    return raw.contact_islands(x, origin, move, mass, collider, collider_next, planes, body, body_order, body_ptr,
                                held, radius, room, mesh_bodies, dhat, any_direction)  # fmt: skip


# --- motions and rooms of bodies --------------------------------------------------------------------------------------


class Ways(NamedTuple):
    """How the vertices of each body want to go."""

    rigid: Tensor  # [B, V, 3] [m]  the rigid motion with the body's momentum, as a way; zero where a vertex is held
    longest: Tensor  # [5, B, NB] [m]  the longest ways of a vertex, of the kinds of WAYS
    sums: Tensor  # [B, NB, 4]  momentum times the time [kg m] and mass [kg] of the vertices that are free


def contact_motion(x: Tensor, origin: Tensor, mass: Tensor, move: Tensor, fall: Tensor, held: Tensor,
                   held_bodies: Tensor, order: Tensor, ptr: Tensor) -> Ways:  # fmt: skip
    """The rigid motion that has each body's linear and angular momentum, and the longest ways.

    Longest ways of a body are, of the vertices that are free, beside their mean way (bends), beside the rigid motion
    (apart) and by ``fall`` (falls); of those that are held (driven); and how far the straight way of a turn ends from
    the turned body (stretched). NaN where one is NaN. They are not differentiated; results repeat to the bit.

    Args:
        x, origin: As for :func:`contact_detect`.  mass: [1 | B, V] [kg].
        move, fall: [B, V, 3] [m]; fall may be empty.
        held, held_bodies: [V] or more, [NB] bool: what something else moves, and which bodies have such a vertex.
        order, ptr: Vertices by body [V], and the first of each body [NB + 1].
    """
    return Ways(*raw.contact_motion(x, origin, mass, move, fall, held, held_bodies, order, ptr))


def contact_motion_backward(bar: Tensor, x: Tensor, origin: Tensor, mass: Tensor, move: Tensor, held: Tensor,
                            held_bodies: Tensor, order: Tensor, ptr: Tensor
                            ) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """Adjoints of x [B, V, 3], of mass [B, V] and of move [B, V, 3], from that of the rigid motion."""
    return raw.contact_motion_backward(bar, x, origin, mass, move, held, held_bodies, order, ptr)


def contact_coast(x: Tensor, mass: Tensor, move: Tensor, held: Tensor, held_bodies: Tensor, order: Tensor, ptr: Tensor,
                  chord: float) -> Tensor:  # fmt: skip
    """``move`` [B, V, 3] [m], of free bodies without the stretch of straight lines: their shape goes on by what is not
    a turn, and the turn is one of the whole body.

    Args:
        x: [B, V, 3] [m].  mass: [1 | B, V] [kg].  move, held, held_bodies, order, ptr: As for :func:`contact_motion`.
        chord: How far back along its way a vertex is taken to have been, over that way.
    """
    return raw.contact_coast(x, mass, move, held, held_bodies, order, ptr, chord)


def contact_coast_backward(bar: Tensor, x: Tensor, mass: Tensor, move: Tensor, held: Tensor, held_bodies: Tensor,
                           order: Tensor, ptr: Tensor, chord: float) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """Adjoints of x [B, V, 3], of mass [B, V] and of move [B, V, 3]."""
    return raw.contact_coast_backward(bar, x, mass, move, held, held_bodies, order, ptr, chord)


class RoomsOfBodies(NamedTuple):
    """How far the vertices of bodies may go until pairs are found again. Index data."""

    island: Tensor  # of each body [B, NB] int32, see contact_islands
    room: Tensor  # beside the island's translation, and the largest of the scene [B, NB + 1] [m]
    own_room: Tensor  # beside the rigid motion of their own body, [B, NB + 1] [m]
    over: Tensor  # how far they want to go, or up to 2 what they ask for, over the most room they get [B, NB]


def contact_rooms(x: Tensor, origin: Tensor, mass: Tensor, move: Tensor, held: Tensor, order: Tensor, ptr: Tensor,
                  ways: Ways, floor: Tensor, collider: Tensor, collider_next: Tensor, planes: Tensor, body: Tensor,
                  radius: Tensor, most: Tensor, most_alone: Tensor, most_own: Tensor, least_own: Tensor, dhat: float,
                  share: float, least: float, any_direction: bool, self_contact: bool) -> RoomsOfBodies:  # fmt: skip
    """Rooms follow from where a body wants to go: pairs that could meet within them are listed, and what does not want
    to move relative to its neighbours lists few. Not differentiable; results repeat to the bit.

    Args:
        x, origin, mass, move, held, order, ptr: As for :func:`contact_motion`, held [N].  ways: What that returned.
        floor: Data of the FloorBarrier [1 | B, 7 planes], or empty.
        collider, collider_next, planes, body, radius, any_direction: As for contact_islands.
        most, most_alone, most_own, least_own: Bounds of the rooms of each body [NB] [m], see ContactSurface.
        dhat: [m].  share, least: What a room is over a body's way beside its island, and beside that [m].
        self_contact: Whether bodies have pairs, and so rooms, of their own.
    """
    return RoomsOfBodies(
        *raw.contact_rooms(
            x, origin, mass, move, held, order, ptr, *ways, floor, collider, collider_next, planes, body, radius, most,
            most_alone, most_own, least_own, dhat, share, least, any_direction, self_contact,
        )
    )  # fmt: skip


def sweep_rooms(x: Tensor, start: Tensor, begin: Tensor, move: Tensor, fall: Tensor, apart: Tensor, stretched: Tensor,
                center: Tensor, room: Tensor, own_center: Tensor, own_room: Tensor, held: Tensor, body_order: Tensor,
                body_ptr: Tensor, more: float, least: float) -> Tensor:  # fmt: skip
    """How far sweeps may carry each vertex from x, [B, V] [m]; 0 where one is held, NaN where what it follows from is.

    A body wants as far as its vertices fall and go apart, a correction has moved them, and ``more`` times what pairs
    have held up and it was stretched. A vertex has ``least`` and the most that a body of its scene wants, but no more
    than what is left of its rooms. Not differentiable; results repeat to the bit.

    Args:
        x, start: [B, V, 3] [m], where sweeps begin, and where the start of the part led.
        begin, move, fall: [B, V, 3] [m], where the part began, and what of its way each vertex wanted.
        apart, stretched: [B, bodies] [m], longest way beside the rigid motion, and what straight ways stretch it by.
        center, room, own_center, own_room: [B, V, 3] and [B, V] [m], how far from where a vertex may go, and the same
            beside the rigid motion of its body; the latter empty where bodies have no pairs of their own.
        held: [V] or more, bool.  body_order, body_ptr: Vertices by body [V], and the first of each [bodies + 1].
    """
    return raw.contact_sweep_rooms(x, start, begin, move, fall, apart, stretched, center, room, own_center, own_room,
                                   held, body_order, body_ptr, more, least)  # fmt: skip


# --- the start of a part ----------------------------------------------------------------------------------------------


def advance(x: Tensor, move: Tensor, u: Tensor, center: Tensor, origin: Tensor, collider: Tensor, collider_next: Tensor,
            held: Tensor, body: Tensor, room: Tensor, listed: Sequence[Tensor], careful: bool = True,
            whole: bool = False, own: Sequence[Tensor] = ()) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Share of ``move - u`` that each vertex may go at once with all others [B, V], or each body [B, bodies]; how many
    pairs hinder what is prescribed, int64 [1]. Not differentiable.

    Args:
        x, move: [B, V, 3], state and wanted motion [m].  u: Translation of each body's island [B, bodies, 3] [m].
        center, room: [B, V, 3] and [B, V]: how far from where a vertex may go [m].
        listed: pairs, constants, ptr, entry of :func:`contact_detect`.
        careful: Whether the motion does not minimise the barrier.
        whole: Whether all vertices of a body go the same share.
        own: As center and room, beside the rigid motion of the vertex's body; empty where bodies have no own pairs.
    """
    none = x.new_empty((0,))
    return raw.contact_advance(
        x, move, u, center, origin, collider, collider_next, held, body, room, *(own or (none, none)), *listed, careful,
        whole,
    )  # fmt: skip


def narrow(x: Tensor, origin: Tensor, collider: Tensor, room: Tensor, pairs: Tensor, constants: Tensor, ptr: Tensor
           ) -> Tensor:  # fmt: skip
    """``constants`` of listed pairs with their gaps at x in the last column, infinite where sides cannot come within
    reach as long as no vertex goes farther than its room [B, V] [m]. Not differentiable."""
    return raw.contact_narrow(x, origin, collider, room, pairs, constants, ptr)


def gaps(x: Tensor, origin: Tensor, collider: Tensor, pairs: Tensor, constants: Tensor, ptr: Tensor) -> Tensor:
    """Gaps of listed pairs with vertices at x and colliders at ``collider`` [pairs] [m]. Detection's own gaps of planes
    are those at the end of the step. Not differentiable."""
    room = torch.full_like(x[..., 0], torch.inf)  # all can come within reach
    return narrow(x.detach(), origin, collider.detach(), room, pairs, constants, ptr)[:, -1]


def keep(rows: Tensor, listed: Sequence[Tensor], exact: bool) -> tuple[Tensor, ...]:
    """The pairs of a list (pairs, constants, ptr, entry of :func:`contact_detect`) that ``rows`` names, bool [pairs]:
    their indices, int64, and their list. exact: as long as they are many, which the CPU alone can say; else in room for
    all, with -1 where there is none."""
    return raw.contact_keep(rows, *listed, exact)


class PartBodies(NamedTuple):
    """The bodies of a scene, as these operators take them."""

    held: Tensor  # [V] bool, and perhaps of colliders
    held_bodies: Tensor  # [bodies] bool: a vertex of it is held
    body: Tensor  # [V] int32, and perhaps of colliders
    order: Tensor  # [V] int32, vertices by body
    ptr: Tensor  # [bodies + 1] int32


class Whole(NamedTuple):
    """Where bodies go as wholes, and what a floor takes from all ways."""

    x: Tensor  # [B, V, 3] [m]
    move: Tensor  # [B, V, 3] [m], where each vertex wants to go from there
    u: Tensor  # [B, bodies, 3] [m], translation of its island
    left: Tensor  # [B, V, 3] [m], what a floor leaves of the way of its body beside that
    frames: Tensor  # [B, bodies], share of that way
    planes: Tensor  # [1 | B, 7 planes] data of a FloorBarrier, or empty
    origin: Tensor  # [B, V, 3] [m], or empty
    bodies: PartBodies


def above_floor(x: Tensor, u: Tensor, way: Tensor, planes: Tensor, origin: Tensor, held: Tensor, order: Tensor,
                ptr: Tensor) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Displacements of whole bodies as a floor limits them, less u [B, V, 3] [m], and which bodies it stops [B,
    bodies].

    Args:
        x, way: [B, V, 3] [m].  u: [B, bodies, 3] [m], part of the way, which the floor lets pass; or empty.
        planes, origin: As of Whole.  held: [V] bool, whether something else moves a vertex.
        order, ptr: Vertices by body [V], and the first of each [bodies + 1], int32.
    """
    return raw.contact_above_floor(x, u, way, planes, origin, held, order, ptr)


def frames(x: Tensor, move: Tensor, u: Tensor, way: Tensor, left: Tensor, stretch: Tensor, room: Tensor,
           own_room: Tensor, bodies: PartBodies) -> tuple[Tensor, ...]:  # fmt: skip
    """As far as rooms let bodies go as wholes. Not differentiable.

    Args:
        x, move, u, left: As of Whole.  way: Rigid motions of bodies [B, V, 3] [m].
        stretch: By how much the straight ways of that stretch each body [B, bodies] [m].
        room, own_room: Of bodies, and of all [B, bodies + 1] [m]; own_room may be empty.

    Returns:
        limit [B, bodies], share of ``left``; the ways that vertices go with it, and from where they have their rooms
        [B, V, 3] [m]; rooms and own rooms of vertices [B, V] [m].
    """
    return raw.contact_frames(x, move, u, way, left, stretch, room, own_room, *bodies)


def bends(at: Whole, limit: Tensor, stopped: Tensor, own_room: Tensor) -> tuple[Tensor, ...]:
    """Where bodies have come as wholes, where vertices want to be, their ways there [B, V, 3] [m], and their state
    [B, V] uint8: 0 goes, 1 rests, ASKS. Not differentiable.

    limit [B, bodies], stopped [B, bodies] bool: of frames() and above_floor().  own_room: [B, bodies + 1] [m] or empty.
    """
    return raw.contact_bends(*at[:5], limit, stopped, own_room, *at[5:7], *at.bodies, FILTER_ETA)


def hold(way: Tensor, state: Tensor, rises: Tensor) -> tuple[Tensor, Tensor]:
    """Ways and state once those that ask are told whether their potential ``rises`` [B, V] bool: then they rest, and
    their state remains. Not differentiable."""
    return raw.contact_hold(way, state, rises)


def held_up(base: Tensor, way: Tensor, share: Tensor, state: Tensor, bodies: PartBodies) -> tuple[Tensor, Tensor]:
    """Where vertices come by shares [B, V] of their ways [B, V, 3], and their state: those ask of whose body pairs hold
    some up. Not differentiable."""
    return raw.contact_held_up(base, way, share, state, *bodies)


def falls(at: Whole, fall: Tensor, share: Tensor, state: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Shares [B, V], 0 of those that rest, where vertices come by them, and their ways from there by ``fall``
    [B, V, 3] [m], of which a floor takes what would come too close. Not differentiable."""
    return raw.contact_falls(*at[:2], fall, *at[2:5], share, state, *at[5:7], *at.bodies, FILTER_ETA)


def start(at: Whole, fall: Tensor, share: Tensor, last_share: Tensor, stopped: Tensor) -> tuple[Tensor, Tensor]:
    """Where the part starts [B, V, 3] [m], by shares [B, V] of the way toward the wish and of the fall; and of which
    vertices that are not stopped pairs have held up more than a hundredth of a way [B, V] bool."""
    return raw.contact_start(*at[:2], fall, *at[2:5], share, last_share, stopped, *at[5:7], *at.bodies, FILTER_ETA)


# --- what sweeps keep of the start of a step --------------------------------------------------------------------------


def lowest(x: Tensor, origin: Tensor, planes: Tensor, body_order: Tensor, body_ptr: Tensor, island: Tensor
           ) -> Tensor:  # fmt: skip
    """Lowest vertex above each plane, of the island that each body is in, [B, bodies, planes] int32."""
    return raw.contact_lowest(x, origin, planes, body_order, body_ptr, island)


# --- the rigid correction of bodies that touch ------------------------------------------------------------------------


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


# --- neighboring points -----------------------------------------------------------------------------------------------


def neighbor_pairs(points: Tensor, radius: float, max_pairs: int, *, name: str = "points") -> tuple[Tensor, Tensor]:
    """Pairs of points of one scene that are closer than a radius.

    The squared distance is compared as it rounds, (dx^2 + dy^2) + dz^2 < radius^2 in the dtype of the points, alike on
    every device. There is no gradient through indices.

    Args:
        points: Positions [m], shape [B, N, 3], float64 or float32, B scenes.
        radius: Distance below which two points are neighbors [m].
        max_pairs: The most pairs of all scenes together that there is room for.
        name: What an error calls the points.

    Returns:
        pairs: (scene, i, j) with i < j, int32, in lexicographic order. All rows are found pairs, but where the host may
            not wait for the device (capture of a CUDA graph, torch.compile): there the shape is [max_pairs, 3], and
            unused rows are -1.
        count: The number of pairs, int64, shape [1]. Where it was not read, the caller must: above ``max_pairs``, or
            -1 for points that are not finite, ``pairs`` is empty of pairs.

    Raises:
        ValueError: More pairs than ``max_pairs`` (the message says how many), points that are not finite, or a radius
            whose square is no normal number of the dtype.

    Source: uniform grid with cells as wide as the radius, as in the paper's appendix on implementation.
    """
    points = points.detach().contiguous()
    pairs, count = raw.neighbor_pairs(points, radius, max_pairs)
    if unread(points):
        return pairs, count
    found = int(count)
    if found < 0:
        where = (~torch.isfinite(points)).nonzero()[0].tolist()
        raise ValueError(f"{name}: expected finite values, got {float(points[tuple(where)]):g} at {where}")
    if found > max_pairs:
        raise ValueError(f"max_pairs: expected room for {found} pairs within {radius:g} m, got {max_pairs}")
    return pairs[:found], count


def unread(points: Tensor) -> bool:
    """Whether results on the points' device must not be looked at now."""
    return torch.compiler.is_compiling() or is_captured(points)


def join_data(shared: Tensor, own: Tensor, data_count: Sequence[int]) -> Tensor:
    """Adjoints by body [B, bodies, scalars of a scene] and by vertex [B, V, scalars of a vertex] -> of data [B, n]."""
    total = sum_to(shared, (shared.shape[0], 1, shared.shape[2]))[:, 0]
    parts, at = [], {False: 0, True: 0}
    for energy, count in zip(VERTEX_ENERGIES, data_count, strict=True):
        rows, start = (own if energy.per_vertex else total), at[energy.per_vertex]
        part = rows.narrow(-1, start, count)  # not rows[...] nor flatten(), which is_grads_batched cannot do
        parts.append(part.reshape(part.shape[0], -1) if energy.per_vertex else part)
        at[energy.per_vertex] += count
    return torch.cat(parts, -1)


# --- what is differentiable -------------------------------------------------------------------------------------------


def _of_planes(own: Tensor, planes: Tensor) -> Tensor | None:
    """Adjoints of planes [1 | B, 7 planes] from what each body or vertex adds, ``own`` [B, n, 7 planes]."""
    return sum_to(own, (own.shape[0], 1, own.shape[2]))[:, 0] if planes.numel() else None


def _split(points: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
    """The adjoints of vertices and of colliders, from those of corner points."""
    return points[:, : x.shape[1]], points[:, x.shape[1] :]


def _translation_reverse(bars: Bars, saved: Sequence[Any], rest: tuple, needs: Sequence[bool]) -> Bars:
    move, mass, x, planes, origin = saved
    return raw.contact_translation_backward(bars[0], move, mass, x, origin, planes, *rest)


# Translation of each body's island [B, bodies, 3] [m], of move, mass, x, planes, origin; held, body, body_order,
# body_ptr, island, lowest. Without a floor planes and lowest are empty.
island_translation = Differentiable(
    lambda move, mass, x, planes, origin, *index: raw.contact_translation(move, mass, x, origin, planes, *index),
    _translation_reverse, arguments=11, inputs=4, tensors=5,
)  # fmt: skip


def _above_floor_reverse(bars: Bars, saved: Sequence[Any], rest: tuple, needs: Sequence[bool]) -> Bars:
    planes = saved[3]
    x, u, way, own = raw.contact_above_floor_backward(bars[0], *saved, needs[3] and planes.numel() > 0)
    return x, u, way, _of_planes(own, planes)


# above_floor(), differentiable in x, u, way and planes.
ways_above_floor = Differentiable(above_floor, _above_floor_reverse, arguments=8, inputs=4, tensors=8)


class Decided(NamedTuple):
    """What is decided at the start of a part, not differentiated."""

    frames: Tensor  # [B, bodies]
    shares: tuple[Tensor, Tensor]  # [B, V]
    stopped: Tensor  # [B, bodies] bool
    origin: Tensor  # [B, V, 3] [m], or empty
    bodies: PartBodies


def _start(x: Tensor, move: Tensor, fall: Tensor, u: Tensor, left: Tensor, planes: Tensor, decided: Decided
           ) -> tuple[Tensor, Tensor]:  # fmt: skip
    at = Whole(x, move, u, left, decided.frames, planes, decided.origin, decided.bodies)
    return start(at, fall, *decided.shares, decided.stopped)


def _start_reverse(bars: Bars, saved: Sequence[Any], rest: tuple, needs: Sequence[bool]) -> Bars:
    (x, move, fall, u, left, planes), (decided,) = saved, rest
    x, move, fall, u, left, own = raw.contact_start_backward(
        bars[0], x, move, fall, u, left, decided.frames, *decided.shares, planes, decided.origin, *decided.bodies,
        FILTER_ETA, needs[5] and planes.numel() > 0,
    )  # fmt: skip
    u = segment_sum(u, decided.bodies.order, decided.bodies.ptr)
    return x, move, fall, u, left, _of_planes(own, planes)


# start(), of x, move, fall, u, left, planes; Decided.
part_start = Differentiable(_start, _start_reverse, arguments=7, inputs=6)


def _motion_reverse(bars: Bars, saved: Sequence[Any], rest: tuple, needs: Sequence[bool]) -> Bars:
    x, mass, move, origin = saved
    return raw.contact_motion_backward(bars[0], x, origin, mass, move, *rest)


# x, mass, move, origin; held, held_bodies, body_order, body_ptr, fall: Ways, differentiable in the rigid motion.
rigid_motion = Differentiable(
    lambda x, mass, move, origin, *index: raw.contact_motion(x, origin, mass, move, index[-1], *index[:-1]),
    _motion_reverse, arguments=9, inputs=3, tensors=4, rest=lambda inputs: inputs[4:-1],
)  # fmt: skip

# contact_coast(), of x, mass, move; held, held_bodies, body_order, body_ptr, chord.
coasting = Differentiable(
    raw.contact_coast, lambda bars, saved, rest, needs: raw.contact_coast_backward(bars[0], *saved, *rest),
    arguments=8, inputs=3,
)  # fmt: skip


def _unsupported_reverse(bars: Bars, saved: Sequence[Any], rest: tuple, needs: Sequence[bool]) -> Bars:
    x, lift, force, mass, planes, origin = saved
    *out, own = raw.contact_unsupported_backward(bars[0], x, origin, lift, force, mass, planes, *rest, needs[4])
    return (*out, _of_planes(own, planes) if needs[4] else None)


# What is left of lift [B, V, 3] [m] once forces have borne their part of each body's acceleration, of x, lift, force,
# mass, planes, origin; held_bodies, body_order, body_ptr, time_step. Sums over a body make its own acceleration a and
# that of the forces f. Contact takes the share s of f, between 0 and 1, that leaves least of a + s f, and none of a
# body that is held. lift [1 | B, V, 3]: h^2 times the acceleration [m]; force [B, N, 3]: of pairs at corner points;
# planes may be empty.
lift_left = Differentiable(
    lambda x, lift, force, mass, planes, origin, *rest: raw.contact_unsupported(x, origin, lift, force, mass, planes,
                                                                                *rest),
    _unsupported_reverse, arguments=10, inputs=5, tensors=6,
)  # fmt: skip


def _lag_reverse(bars: Bars, saved: Sequence[Any], rest: tuple, needs: Sequence[bool]) -> Bars:
    x, collider, kappa, origin = saved
    points, by_kappa = raw.contact_lag_backward(bars[0], x, origin, collider, kappa, *rest)
    return *_split(points, x), by_kappa


# Normal force, activity, normal and weights of each pair [pairs, 9], of x, collider, kappa, origin; pairs, constants,
# ptr, entry.
pair_lag = Differentiable(
    lambda x, collider, kappa, origin, *listed: raw.contact_lag(x, origin, collider, kappa, *listed), _lag_reverse,
    arguments=8, inputs=3, tensors=4,
)  # fmt: skip


def _rubbing_reverse(bars: Bars, saved: Sequence[Any], rest: tuple, needs: Sequence[bool]) -> Bars:
    x, collider, kappa, friction, damping, origin = saved
    given = (x.new_empty((0,)) if bar is None else bar for bar in bars)
    points, *others = raw.contact_rubbing_backward(*given, x, origin, collider, kappa, friction, damping, *rest)
    return *_split(points, x), *others


# Friction coefficient times normal force [N], damping [N s/m], normal and weights of each pair [pairs, 9], and the
# forces of pairs on corner points [B, N, 3] [N], of x, collider, kappa, friction, damping, origin; pairs, constants,
# ptr, entry. friction, damping: [1 | B], or empty without.
pair_rubbing = Differentiable(
    lambda x, collider, kappa, friction, damping, origin, *listed: raw.contact_rubbing(x, origin, collider, kappa,
                                                                                       friction, damping, *listed),
    _rubbing_reverse, arguments=10, inputs=5, outputs=2, tensors=6,
)  # fmt: skip
