"""The compiled operators of contact: searches, the start of a substep, near pairs, values lagged from the start of a
step, the rigid correction; and the search for neighboring points.

Sizes: B scenes that never mix, V vertices, Vc collider points, N = V + Vc corner points (vertices first), F triangles,
E edges, P points, L planes, NB bodies of the mesh. Index tensors are int32; float tensors have the dtype of x; all are
contiguous and on one device. A wrong tensor raises ValueError. The differentiable operators stand at the end.
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

# --- searches ---------------------------------------------------------------------------------------------------------


class Detection(NamedTuple):
    """Pairs of primitives that are closer than the barrier's reach, or may come that close."""

    pairs: Tensor  # [capacity, 6]  corner points, kind (0 point-triangle, 1 edge-edge, 2 point-plane), scene; or -1
    constants: Tensor  # [capacity, 8]  reach of the barrier [m], sum of the radii [m], measure (csrc/contact); hints
    ptr: Tensor  # [B N + 1]  pairs of corner point i of scene b: entry[ptr[b N + i] : ptr[b N + i + 1]],
    entry: Tensor  # [4 capacity]  each 4 pair + local corner, in ascending order
    near_corners: Tensor  # [B, N, 5]  corner points and kind of the pair with the smallest gap; i four times, -1: none
    near_values: Tensor  # [B, N, 8]  its weights, normal and gap [m]; without one, zeros and how far was looked
    counts: Tensor  # [3] int64  pairs that the list needs, pairs that touch, smallest key of those or -1
    smallest: Tensor  # [B]  smallest gap, at most 0 where pairs touch, or how far was looked [m]


def contact_detect(x: Tensor, origin: Tensor, collider: Tensor, collider_next: Tensor, trust_radius: Tensor,
                   deformation_radius: Tensor, surface: Sequence[Tensor], mesh_bodies: int, self_contact: bool,
                   between_bodies: bool, dhat: float, capacity: int, trim: bool = False) -> Detection:  # fmt: skip
    """Nearest pair of every corner point, and the pairs that may come within the barrier's reach before the next call.

    ``trust_radius`` bounds the displacement of a vertex relative to its island. ``deformation_radius`` bounds it
    relative to the rigid motion of its body, of at most a radian. Colliders have neither. The barrier's reach is
    ``dhat``; for two sides of one body that are closer at rest, it is 0.9 of their distance at rest. A pair of two
    bodies is listed if its gap is below the reach and both trust-region radii. A pair of one body is listed if its gap
    is below 1.15 times the reach and both deformation radii. Two colliders make no pair, nor do four pinned corner
    points, nor two sides of one body that coincide at rest.

    A surface point that is not finite counts as touching. Where ``counts[0] > capacity``, the list is incomplete. Not
    differentiable; results repeat to the bit.

    Args:
        x: [B, V, 3] positions [m], relative to ``origin`` [B, V, 3], one point for each body; or empty.
        collider, collider_next: [B, Vc, 3] [m] now, and during the sweeps that follow. Gaps of planes are taken at the
            latter, or now where a plane would pass the point. What is near a plane now is listed, too.
        trust_radius, deformation_radius: [B, mesh_bodies + 1] [m] of each body, and the largest.
        surface: The ten tensors that follow, from rest to point_weights.
        rest, radius: [N, 3] [m], [N] [m], the latter 0 for vertices.
        triangles, edges, points: [F, 3], [E, 2], [P] corner points of surfaces, unique. Edges and vertices of surfaces
            may be faces, too, with points of other bodies: (a, b, b) and (a, a, a).
        planes: [L, 3] collider points that span each plane, counterclockwise seen from the free side.
        body, pinned: [N]; labels from ``mesh_bodies`` on are colliders; pinned: bool, no sweep moves the point.
        face_counts: [F + E] how often the barrier of each of ``triangles`` counts; whether each edge is sharp (1 or 0).
            The barrier of two edges of different bodies that are not both sharp reaches ``dhat / 4``.
        point_weights: [P] what the barrier of each of ``points`` is multiplied by.
        self_contact, between_bodies: Pairs of mesh bodies to consider.
        dhat: [m].
        capacity: Rows of the list.
        trim: On the CPU, return only rows with a pair: empty rows may cost more than the search. CUDA does not trim, as
            it would have to wait for their number; torch.compile takes longer with unknown sizes.
    """
    return Detection(
        *raw.contact_detect(
            x, origin, collider, collider_next, trust_radius, deformation_radius, *surface, mesh_bodies, self_contact,
            between_bodies, dhat, capacity, trim,
        )
    )  # fmt: skip


class Found(NamedTuple):
    """Result of :func:`contact_find`; all is index data."""

    pairs: Tensor  # these eight as in Detection
    constants: Tensor
    ptr: Tensor
    entry: Tensor
    near_corners: Tensor
    near_values: Tensor
    counts: Tensor
    smallest: Tensor
    rigid: Tensor  # [B, V, 3] [m]  the rigid motion with the body's momentum; zero where a vertex of it is pinned
    longest: Tensor  # [5, B, NB] [m]  the longest displacements of a vertex, of the kinds of DISPLACEMENTS
    sums: Tensor  # [B, NB, 4]  momentum times the time [kg m] and mass [kg] of the free vertices
    island: Tensor  # [B, NB] int32  of each body, as its smallest body; -1: a pinned vertex or a collider stops it
    u: Tensor  # [B, NB, 3] [m]  translation of each body's island, rounded to a grid
    trust_radius: Tensor  # [B, NB + 1] [m]  relative to the island's translation, and the largest of the scene
    deformation_radius: Tensor  # [B, NB + 1] [m]  relative to the body's rigid motion


def contact_find(x: Tensor, origin: Tensor, collider: Tensor, collider_next: Tensor, mass: Tensor, move: Tensor,
                 gravity_move: Tensor, floor: Tensor, surface: Sequence[Tensor], bodies: Sequence[Tensor],
                 self_contact: bool, between_bodies: bool, dhat: float, factor: float, least: float, capacity: int,
                 trim: bool = False) -> Found:  # fmt: skip
    """Pairs that can matter in a substep: of :func:`contact_detect`, within the trust-region radii that follow from the
    wanted displacements.

    A body's rigid motion has its linear and angular momentum. The longest displacements of a body: of a free vertex
    relative to their mean (bends), relative to the rigid motion (apart) and by ``gravity_move`` (gravity); of a pinned
    vertex (driven); and from the end of a straight path to the turned body (stretched). NaN where one is NaN.

    A body that does not move relative to its neighbours gets a small radius and lists few pairs. An island translates
    by the mean of ``move`` over the mass of its free vertices: bodies whose boxes, swept by that translation and grown
    by radius and dhat / 2, overlap are of one island. Not differentiable; results repeat to the bit.

    Args:
        x, origin, collider, collider_next: As for :func:`contact_detect`.  mass: [1 | B, V] [kg].
        move, gravity_move: Wanted displacements [B, V, 3] [m], and what corrections and sweeps add to them, or empty.
        floor: Data of the FloorBarrier [1 | B, 7 planes], or empty.
        surface: As for :func:`contact_detect`.
        bodies: Whether a vertex of a body is pinned [NB], vertices by body [V] and the first of each body [NB + 1],
            bounds of its trust-region radius and of its deformation radius [NB] [m].
        self_contact, between_bodies, dhat, capacity, trim: As for :func:`contact_detect`; a body has a deformation
            radius only with self-contact.
        factor, least: Radius over a body's displacement relative to its island, and what is added [m].
    """
    with torch.no_grad():
        return Found(*raw.contact_find(x, origin, collider, collider_next, mass, move, gravity_move, floor, *surface,
                                       *bodies, self_contact, between_bodies, dhat, factor, least, capacity,
                                       trim))  # fmt: skip


class Intersections(NamedTuple):
    """Edges of surfaces that pass through triangles, and points behind planes. Rows are those of the arguments."""

    pairs: Tensor  # [capacity, 3] int32  scene, edge, triangle in lexicographic order, then -1
    counts: Tensor  # [B, 2] int64  edges through triangles, points behind planes
    first: Tensor  # [B, 2, 2] int32  the first edge and its triangle, the first point and its plane; or -1


def contact_intersections(x: Tensor, origin: Tensor, collider: Tensor, rest: Tensor, radius: Tensor, triangles: Tensor,
                          edges: Tensor, points: Tensor, planes: Tensor, body: Tensor, pinned: Tensor, mesh_bodies: int,
                          self_contact: bool, between_bodies: bool, capacity: int) -> Intersections:  # fmt: skip
    """Crossings of surfaces. A start must have none: distances do not show them, so contact cannot undo them.

    An edge crosses a triangle, with which it shares no vertex, if its ends lie on both sides of the plane and it meets
    the closed triangle. Signs are those of ``x + origin`` in double precision. An end within rounding of the plane does
    not count as beyond it; a border within rounding counts as met. Points that are not finite cross nothing. Pairs
    that :func:`contact_detect` leaves out do not count: two colliders, five pinned corner points, bodies without
    contact, and features of one body that coincide at rest. Not differentiable; results repeat to the bit.

    Args:
        x, origin, collider, rest, radius, triangles, edges, points, planes, body, pinned, mesh_bodies, self_contact,
            between_bodies: As for :func:`contact_detect`, collider points and planes at one time.
        capacity: Rows of ``pairs``. Where ``counts[:, 0].sum()`` is more, CUDA lists any of them.

    Source: bounds of rounding after Shewchuk (1997).
    """
    return Intersections(
        *raw.contact_intersections(
            x, origin, collider, rest, radius, triangles, edges, points, planes, body, pinned, mesh_bodies,
            self_contact, between_bodies, capacity,
        )
    )  # fmt: skip


# --- the start of a substep -------------------------------------------------------------------------------------------


class SubstepStart(NamedTuple):
    """Start of the sweeps of a substep; all but x is index data."""

    x: Tensor  # [B, V, 3] [m]
    center: Tensor  # [B, V, 3]  center of the trust region of each vertex [m]
    own_center: Tensor  # [B, V, 3]  center of the deformation; empty where bodies have no pairs of their own
    trust_radius: Tensor  # [B, V] [m]
    own_radius: Tensor  # [B, V]  of the deformation [m], or empty
    fractions: Tensor  # [B, V]  fraction of its displacement that each vertex went
    truncated: Tensor  # [B, V] bool: pairs or radii have truncated the displacement
    infeasible: Tensor  # [B] int64: pairs that hinder what is prescribed


def start_substep(x: Tensor, move: Tensor, u: Tensor, rigid: Tensor, trust_radius: Tensor, deformation_radius: Tensor,
                  floor: Tensor, origin: Tensor, collider: Tensor, collider_next: Tensor, pinned: Tensor, body: Tensor,
                  unit: Tensor, listed: Sequence[Tensor]) -> SubstepStart:  # fmt: skip
    """``x + u + f (move - u)``, differentiable in x and move. The fraction f is the largest of 1, 1/2, ..., 1/64 and 0
    that keeps radii and gaps to floors, times the fraction that keeps pairs apart: one for each free body, one for each
    vertex of a body that is pinned.

    Args:
        x, move: [B, V, 3], state and wanted displacement [m].  u: Translation of each body's island [B, NB, 3] [m].
        rigid: Rigid motion of each body, a displacement [B, V, 3] [m]; empty where bodies have no pairs of their own.
        trust_radius, deformation_radius: As of :func:`contact_find`.
        floor: Data of the FloorBarrier [1 | B, 7 planes], or empty.
        collider, collider_next: [B, Vc, 3] [m], before and during the sweeps.
        unit: [V] int32, the vertex whose fraction each vertex has.
        listed: pairs, constants, ptr, entry of :func:`contact_find`, gaps taken at x.
    """
    return SubstepStart(*_start(x.contiguous(), move.contiguous(), u, rigid, trust_radius, deformation_radius, floor,
                                origin, collider, collider_next, pinned, body, unit, *listed))  # fmt: skip


class Near(NamedTuple):
    """Result of :func:`contact_near`; all is index data."""

    radius: Tensor  # [B, V] [m]  what is left of the radii about x; 0 where pinned
    rows: Tensor  # int64  which pair of the list each is, or -1
    pairs: Tensor  # these four as in Detection, with gaps at x in the last column of the constants
    constants: Tensor
    ptr: Tensor
    entry: Tensor


def contact_near(x: Tensor, origin: Tensor, collider: Tensor, center: Tensor, own_center: Tensor, trust_radius: Tensor,
                 own_radius: Tensor, pinned: Tensor, listed: Sequence[Tensor]) -> Near:  # fmt: skip
    """The listed pairs whose sides can come within reach of their barriers while vertices stay within their trust
    regions, with gaps at x. Where values must not decide sizes, on CUDA and compiled, the list is as long as the whole
    one, with -1 in empty rows. Not differentiable.

    Args:
        x, origin, collider: [B, V, 3], [B, V, 3] or empty, [B, Vc, 3] [m].
        center, trust_radius, own_center, own_radius: Trust regions as of :class:`SubstepStart`.
        pinned: [V] or more, bool.  listed: pairs, constants, ptr, entry of :func:`contact_detect`.
    """
    exact = not x.is_cuda and not torch.compiler.is_compiling()
    with torch.no_grad():
        return Near(*raw.contact_near(x, origin, collider, center, own_center, trust_radius, own_radius, pinned,
                                      *listed, exact))  # fmt: skip


def within(radius: float, x: Tensor, origin: Tensor, collider: Tensor, pinned: Tensor,
           listed: Sequence[Tensor]) -> Near:  # fmt: skip
    """:func:`contact_near` within one radius [m] of all vertices about x [B, V, 3]."""
    x, none = x.detach(), x.new_empty((0,))
    radii = torch.full_like(x[..., 0], radius)
    return contact_near(x, origin, collider.detach(), x, none, radii, none, pinned, listed)


# --- the rigid correction of bodies that touch ------------------------------------------------------------------------


class Corrected(NamedTuple):
    """Result of :func:`rigid_correct`."""

    x: Tensor  # [B, V, 3]
    # float64 [B, bodies, 2]: step fraction of each motion, zero where none was found; a number of the island whose
    # common shift it took whole, or -1
    taken: Tensor
    remaining: Tensor  # [B, bodies]: translation that was not taken [m]


def rigid_correct(fields: TouchingFields, data_count: Sequence[int], time_step: float, friction_eps: float,
                  majorizes: bool) -> Corrected:  # fmt: skip
    """State after the admissible fraction of one Newton step of the step's potential over a turn and a shift of every
    body (csrc/subspace/rigid_step.h). An island on which nothing else acts takes its common shift whole.

    friction_eps: [m], 0 without friction.  majorizes: Whether friction has the stiffness of a vertex's block.
    """
    return Corrected(*raw.contact_rigid_correct(*fields, data_count, time_step, friction_eps, majorizes))


class RigidAdjoints(NamedTuple):
    """Result of :func:`rigid_reverse`, of each scene and pair."""

    x: Tensor  # [B, V, 3], as are the next two
    x_prev: Tensor
    y: Tensor
    mass: Tensor  # [B, V]
    energy_data: Tensor  # [B, n], or empty
    floor_lag: Tensor  # [B, V, planes, 4], or empty
    collider: Tensor  # [B, Vc, 3]
    collider_prev: Tensor
    by_kappa: Tensor  # [pairs]: minus the contribution of each listed pair to the adjoint of kappa
    lag: Tensor  # [lagged, 9]


def rigid_reverse(fields: TouchingFields, taken: Tensor, x_bar: Tensor, data_count: Sequence[int], time_step: float,
                  friction_eps: float, majorizes: bool, wants_data: bool) -> RigidAdjoints:  # fmt: skip
    """Adjoint of a correction; x_bar [B, V, 3]: of the state after it."""
    out = raw.contact_rigid_reverse(*fields, taken, x_bar.contiguous(), data_count, time_step, friction_eps, majorizes,
                                    wants_data)  # fmt: skip
    return adjoints_of(out, data_count, wants_data)


def adjoints_of(out: Sequence[Tensor], data_count: Sequence[int], wants_data: bool) -> RigidAdjoints:
    """What an operator of a correction returns, with the adjoints of the data as one."""
    x, x_prev, y, mass, shared, own, *rest = out
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
    """Whether the host must not read results on the points' device now."""
    return torch.compiler.is_compiling() or is_captured(points)


def join_data(shared: Tensor, own: Tensor, data_count: Sequence[int]) -> Tensor:
    """Adjoints by body [B, bodies, scalars of a scene] and by vertex [B, V, scalars of a vertex] -> of data [B, n]."""
    total = sum_to(shared, (shared.shape[0], 1, shared.shape[2]))[:, 0]
    blocks, at = [], {False: 0, True: 0}
    for energy, count in zip(VERTEX_ENERGIES, data_count, strict=True):
        rows, start = (own if energy.per_vertex else total), at[energy.per_vertex]
        block = rows.narrow(-1, start, count)  # not rows[...] nor flatten(), which is_grads_batched cannot do
        blocks.append(block.reshape(block.shape[0], -1) if energy.per_vertex else block)
        at[energy.per_vertex] += count
    return torch.cat(blocks, -1)


# --- differentiable operators -----------------------------------------------------------------------------------------


def _start_reverse(bars: Bars, saved: Sequence[Any], rest: tuple, needs: Sequence[bool]) -> Bars:
    (bar, *_), (*_, fraction, pinned) = bars, saved
    assert bar is not None
    went = torch.where(pinned[: fraction.shape[1]], 1.0, fraction)
    return bar, went[..., None] * bar


# Of the arguments of start_substep(); what is saved first has the shapes of x and move.
_start = Differentiable(
    lambda *args: raw.contact_start(*args, FILTER_ETA), _start_reverse, arguments=17, inputs=2,
    saved=lambda inputs, made: (inputs[0], inputs[0], made[5], inputs[10]), rest=lambda inputs: (),
)  # fmt: skip
