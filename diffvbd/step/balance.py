"""What a step leaves unbalanced: the residual of the potential that it executed, contact included."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from .. import ops
from ..adjoint.contact_potential import ContactPotential, StepContact
from ..adjoint.potential import IncrementalPotential
from ..model.system import System
from .arguments import Prepared, acceleration_of, collider_state
from .predict import Begun, begin

ROUNDINGS = 0.25  # of block times position, below which a residual counts as zero: sweeps stall at 0.03 to 0.08, a
# corrected start in free fall at 0.15
UNBALANCED = 0.01  # left-over force over the forces of the step; at 0.014 a hanging bar rests 1.5 to 11 % off
UNBALANCED_FRICTION = 0.05  # of the most that friction can bear

Norm = Callable[[Tensor], Tensor]  # [B, V, n] -> [B, groups]


def contact_of_step(
    model: System, begun: Begun, prepared: Prepared, where: tuple[Tensor, Tensor] | None
) -> StepContact | None:
    """Contact of a step that has begun; where: collider points at its start and at its end, None without contact."""
    if where is None:
        return None
    before, colliders = where
    return StepContact(model, begun.data, prepared.parameters, colliders, before, begun.x_prev, begun.origin,
                       prepared.settings.numbers.time_step)  # fmt: skip


def potential_of_step(
    model: System, x: Tensor, begun: Begun, prepared: Prepared, contact: StepContact | None
) -> IncrementalPotential:
    """The potential of a step that has begun, at x [B, V, 3], relative to the step's origin where there is one."""
    fields = begun.fields(model, prepared)
    if contact is None:
        return IncrementalPotential(model, x, fields, prepared.settings.numbers.time_step)
    return ContactPotential(model, x, fields, contact)


def of_scenes(values: Tensor) -> Tensor:
    """2-norms over a scene, [B, V, n] -> [B, 1]."""
    return ops.sum_to(values.square(), (len(values), 1, 1))[..., 0].sqrt()


def of_bodies(model: System) -> Norm:
    """2-norms over each body, [B, V, n] -> [B, bodies], bodies as in ``model.body``."""
    labels = model.derived("labels", lambda: model.body)
    count = model.derived("labelled", lambda: int(labels.max()) + 1 if labels.numel() else 0)

    def norm(values: Tensor) -> Tensor:
        squares = values.square().sum(-1)
        return squares.new_zeros(len(squares), count).index_add(1, labels, squares).sqrt()

    return norm


def left_over(at: IncrementalPotential, norm: Norm) -> tuple[Tensor, Tensor]:
    """What is not balanced, |M (x - y) + h^2 dE/dx|, and what it is a part of, |M (x - y)| + |h^2 dE/dx| [kg m], over
    the vertices that are not pinned; both [B, groups]."""
    inertia, forces = at.free * at.inertia(), at.free * at.forces()
    return norm(inertia + forces), norm(inertia) + norm(forces)


def left_of_solve(model: System, before: tuple[Tensor, Tensor], end: Tensor, prepared: Prepared, given: dict[str, Any]
                  ) -> tuple[Tensor, Tensor]:  # fmt: skip
    """The same of a solve that was executed, 0 left where that is no more than rounding leaves: of each scene, with
    contact of each body.

    Args:
        before: State (x, v) [..., V, 3] before it.  end: Positions after it.  given: Its arguments, as of advance().
    """
    with torch.no_grad(), torch.autocast(end.device.type, enabled=False):
        x, v = (t.detach() for t in before)
        acceleration = acceleration_of(given["gravity"], x)
        begun = begin(model, x, v, prepared, given["force"], acceleration, given["prescribed"]).detached()
        where = collider_state(model, x, given["colliders"], given["colliders_before"])
        end = end.detach().reshape(begun.y.shape)
        end = end if begun.origin is None else end - begun.origin
        at = potential_of_step(model, end, begun, prepared, contact_of_step(model, begun, prepared, where))
        norm = of_scenes if where is None else of_bodies(model)
        left, whole = left_over(at, norm)
        return torch.where(left <= rounding(at, norm), 0, left), whole


def rounding(at: IncrementalPotential, norm: Norm, eps: float | None = None) -> Tensor:
    """What rounding alone may leave of it [kg m], [B, groups]: a block times what rounds a position."""
    eps = torch.finfo(at.x.dtype).eps if eps is None else eps
    largest = at.x.abs().amax((-2, -1)) if at.x.shape[-2] else at.x.new_zeros(len(at.x))
    return ROUNDINGS * eps * largest[:, None] * norm(at.free * at.stiffness())


def share(part: Tensor, whole: Tensor) -> Tensor:
    """part / whole, 0 where there is no whole."""
    return part / torch.where(whole > 0, whole, torch.ones_like(whole))


def friction_left_over(at: IncrementalPotential) -> Tensor:
    """What the step left unbalanced along the contact of each body, over the most that friction can bear there [-],
    [B, bodies]; 0 where it can bear nothing.

    Of forces summed over the vertices on which friction acts: what they leave to one another moves no body.
    """
    labels, count = at.model.body, at.model.derived("labelled", lambda: int(at.model.body.max()) + 1)
    sums = at.x.new_zeros((len(at.x), count, 3), dtype=torch.float64)
    if not isinstance(at, ContactPotential):
        return sums[..., 0]
    normal, friction = at.contact.on_vertices()
    acts = ((friction != 0).any(-1, keepdim=True) * at.free).double()
    left = acts * (at.inertia() + at.forces()).double() / at.h**2
    size = normal.norm(dim=-1, keepdim=True)
    along = (left * normal).sum(-1, keepdim=True) / torch.where(size > 0, size.square(), 1.0)
    force = sums.index_add(1, labels, left - along * normal).norm(dim=-1)
    most = at.step_contact._number("friction")[:, None] * (acts * size)[..., 0]
    return share(force, torch.zeros_like(force).index_add(1, labels, most))
