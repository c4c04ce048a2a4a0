"""Start of a substep with contact: translations of islands, displacements limited by a floor, step fractions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from .._contact.surface import ContactSurface
from ..ops import contact as ops_contact
from ..ops.contact import Decided, SubstepBodies, Whole, displacements_above_floor
from ..ops.fields import PENDING


class SubstepStart(NamedTuple):
    """Start of the sweeps of a substep."""

    x: Tensor  # [B, V, 3] [m]
    center: Tensor  # [B, V, 3] [m]  center of the trust region; a constant, not a function of the start
    trust_radius: Tensor  # [B, V] [m]  radius about it
    own: tuple  # the same relative to the body's rigid motion; empty without pairs within bodies
    rigid_fraction: Tensor | None  # [B, bodies]: step fraction of the rigid motion above the floor
    truncated: Tensor  # [B, V] bool: lost more than a hundredth of a displacement to pairs
    infeasible: Tensor  # [1] int64: pairs that make the prescribed motion infeasible
    fractions: tuple[Tensor, Tensor]  # step fractions of the two displacements, [B, V] each


def start_between_planes(x: Tensor, move: Tensor, gravity_move: Tensor, mass: Tensor, was: Tensor, now: Tensor,
                         planes: Tensor | None, origin: Tensor, detection: Any, surface: ContactSurface, rigid: Tensor,
                         stretch: Tensor, increases_potential: Callable[[Tensor, Tensor], Tensor], own_pairs: bool,
                         has_gravity_move: bool) -> SubstepStart:  # fmt: skip
    """Start of the sweeps: the admissible fraction of three displacements, each for all vertices at once. First each
    body moves as a whole by ``rigid``, then its vertices toward ``move``, then by ``gravity_move``.

    The second displacement deforms a body. A free body that a floor stops does not make it. A body that pairs block in
    part makes it only if its potential does not increase; with self-contact, so does one whose deformation takes much
    of its deformation radius.

    Args:
        x, move, gravity_move: [B, V, 3] [m].  mass: [1 | B, V] [kg].
        was, now: Collider points before and during the sweeps, [B, Vc, 3] [m].
        planes: Data of the FloorBarrier [1 | B, 7 planes], or None. Differentiable, as are x, move, gravity_move, mass.
        origin: [B, V, 3] or empty.  detection: Detection of the substep.
        rigid: Displacements by the rigid motions of bodies [B, V, 3] [m], differentiable.
        stretch: Stretch of each body by the straight paths of that motion, times the radius factor of the sweeps
            [B, bodies] [m].
        increases_potential: Of two states [B, V, 3], vertices of a body whose potential is higher in the second [B, V].
        own_pairs: Whether bodies have pairs of their own, and deformation radii.
        has_gravity_move: Whether ``gravity_move`` may be other than zero.
    """
    none = x.new_empty((0,))
    floor = none if planes is None else planes.contiguous()
    order, ptr = surface.body_order, surface.body_ptr
    x, move, gravity_move, rigid = (t.contiguous() for t in (x, move, gravity_move, rigid))
    was, now = was.detach(), now.detach()
    u = ops_contact.island_translation(move, mass.contiguous(), x, floor, origin, surface.pinned, surface.body, order,
                                       ptr, detection.island, detection.support_vertex)  # fmt: skip
    body_move, stopped = ops_contact.displacements_above_floor(x, u, rigid, floor, origin, surface.pinned, order, ptr)
    bodies = SubstepBodies(surface.pinned, surface.pinned_bodies, surface.body, order, ptr)
    listed = detection.listed
    listed = (listed.pairs, listed.constants, listed.ptr, listed.entry)
    deformation_radius = detection.deformation_radius if own_pairs else none
    infeasible: list[Tensor] = []

    def advance(at: Tensor, displacement: Tensor, by: Tensor, center: Tensor, **options: Any) -> Tensor:
        """Step fractions; colliders and prescribed vertices move with the first displacement."""
        before = now if infeasible else was
        fraction, count = ops_contact.advance(at, displacement, by, center, origin, before, now, surface.pinned,
                                              surface.body, trust_radius, listed, **options)  # fmt: skip
        infeasible.append(count)
        return fraction

    def any_pending(state: Tensor) -> bool:
        return state.is_cuda or (state.numel() > 0 and int(state.max()) == PENDING)  # CUDA would have to wait

    with torch.no_grad():
        # bodies first, each as a whole
        limit, displacements, center, trust_radius, deformation_radii = ops_contact.rigid_moves(
            x, move, u, rigid, body_move, stretch, detection.trust_radius, deformation_radius, bodies
        )
        rigid_fraction, still = limit * advance(x, displacements, u, x, whole=True), torch.zeros_like(u)
        whole = Whole(x, move, u, body_move, rigid_fraction, floor, origin, bodies)
        # then vertices toward their targets
        base, target, displacement, state = ops_contact.deformations(whole, limit, stopped, deformation_radius)
        own = (base, deformation_radii) if own_pairs else ()
        if own_pairs and any_pending(state):
            displacement, state = ops_contact.freeze(displacement, state, increases_potential(base, target))
        fraction = advance(base, displacement, still, center, own=own)
        to, state = ops_contact.blocked(base, displacement, fraction, state, bodies)
        if any_pending(state):
            displacement, state = ops_contact.freeze(displacement, state, increases_potential(base, to))
            if any_pending(state):
                infeasible.pop()  # again without the frozen ones, whose motion may have let others pass
                fraction = advance(base, displacement, still, center, own=own)
        # then all by gravity
        fraction, at, displacement = ops_contact.gravity_moves(whole, gravity_move, fraction, state)
        fractions = (
            fraction,
            advance(at, displacement, still, center, own=own) if has_gravity_move else torch.ones_like(fraction),
        )
    decided = Decided(rigid_fraction, fractions, stopped, origin, bodies)
    start, truncated = ops_contact.substep_start(x, move, gravity_move, u, body_move, floor, decided)
    return SubstepStart(start, center, trust_radius, own, rigid_fraction, truncated, sum(infeasible[1:], infeasible[0]),
                        fractions)  # fmt: skip


# --- displacements of whole bodies as floors limit them, differentiable -----------------------------------------------


def above_floor(x: Tensor, u: Tensor, displacement: Tensor, planes: Tensor, origin: Tensor, pinned: Tensor,
                order: Tensor, ptr: Tensor) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Displacements of whole bodies relative to u, limited by a floor [B, V, 3] [m]; and stopped bodies [B, bodies].

    A body is shifted along the floor's normals until no vertex closes more than a fraction of its gap. Sliding and
    turning stay as they are. Differentiable; vertices that decide together share the adjoint evenly. docs/method.md,
    section 12.

    Args:
        x, displacement: [B, V, 3] [m].  u: [B, bodies, 3] [m], the translation in it, which is not limited; or empty.
        planes: Data of a FloorBarrier [1 | B, 7 planes], or empty.  origin: [B, V, 3] [m] or empty.
        pinned: [V] bool, pinned or prescribed vertices.
        order, ptr: Vertices by body [V], and the first of each [bodies + 1], int32.
    """
    return displacements_above_floor(x.contiguous(), u, displacement.contiguous(), planes.contiguous(), origin, pinned,
                                     order, ptr)  # fmt: skip
