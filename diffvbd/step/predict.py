"""Start and end of a step: from inputs to the start of the sweeps, and from their end to the state."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from .. import ops
from .._common.checks import input_name
from .._common.constants import ELASTIC, FILTER_ETA
from .._common.context import replaced
from ..model.bodies import Bodies, OtherBodies
from ..model.patches import law_at
from ..model.system import System
from ..ops import STARTS, distinct
from ..ops.contact import join_data
from .arguments import LOOKBACK, Prepared, broadcastable
from .couplings import Coupled, coupled_of

Law = Callable[[Tensor], tuple[Tensor, Tensor, Tensor]]  # of a state: mu, lam [B, T], rest scalars [B, T, 7]


def energy_data(model: System, prepared: Prepared, origin: Tensor | None) -> Tensor:
    """The energies' data [1 | B, n]: the Model's constants unless a parameter or an origin changes them."""
    if not prepared.parameters and origin is None:
        return model._energy_data
    packed = []
    for energy in model.vertex_energies:
        values = {k: v[None] for k, v in model.constants(energy).items()}
        for key in values:
            values[key] = prepared.parameters.get(input_name(energy, key), values[key])
        packed.append(energy.pack(values, origin))
    if not packed:
        return model._energy_data
    scenes = max([p.shape[0] for p in packed])
    return torch.cat([ops.broadcast(p, (scenes, p.shape[1])) for p in packed], -1)


class Begun(NamedTuple):
    """Start of the sweeps of a step; positions [B, V, 3], relative to ``origin`` where there is one."""

    x_start: Tensor  # as far as planes let it go
    x_prev: Tensor  # the state before the step
    y: Tensor  # the predictor
    data: Tensor  # [1 | B, n], of the energies
    origin: Tensor | None
    h2a: Tensor  # h^2 times the acceleration [m], [1 | B, 1 | V, 3]; y is x + h v and this
    coupled: Coupled | None = None  # of a Model with couplings
    law: Law | None = None  # of a Model with patches: the bound of their energy about a state

    def detached(self) -> Begun:
        origin = None if self.origin is None else self.origin.detach()
        return Begun(self.x_start.detach(), self.x_prev.detach(), self.y.detach(), self.data.detach(), origin,
                     self.h2a.detach(), self.coupled, self.law)  # fmt: skip

    def at(self, x: Tensor) -> Begun:
        """The same with the bound of couplings about a state x [B, V, 3]."""
        return self if self.coupled is None else replaced(self, data=self.coupled.bound(x))

    @property
    def renews(self) -> bool:
        return self.coupled is not None or self.law is not None

    def renewed(self, x: Tensor) -> dict[str, Tensor]:
        """Fields of the sweeps that are bounds about a state x [B, V, 3]."""
        out = {} if self.coupled is None else {"energy_data": self.coupled.bound(x)}
        return out | self.renewed_law(x)

    def renewed_law(self, x: Tensor) -> dict[str, Tensor]:
        """The same of patches alone."""
        return {} if self.law is None else dict(zip(("mu", "lam", "rest"), self.law(x), strict=True))

    def fields(self, model: System, prepared: Prepared) -> ops.SweepFields:
        """Fields of the sweeps, without contact."""
        return ops.SweepFields(self.x_start, self.x_prev, self.y, prepared.mu, prepared.lam, prepared.mass,
                               prepared.rest, self.data, self.origin)  # fmt: skip

    def corrected(self, x: Tensor, model: System, prepared: Prepared) -> Tensor:
        """x [B, V, 3] after the rigid correction, where the Model has one."""
        return self._correct(x, model, prepared)[0] if model.corrects else x

    def _correct(self, x: Tensor, model: System, prepared: Prepared) -> tuple[Tensor, Tensor]:
        settings = prepared.settings
        return correct(x, self.x_prev, self.y, prepared.mass, self.at(x).data, self.origin, model._bodies,
                       model._other_bodies, settings.data_count, settings.numbers.time_step)  # fmt: skip

    def finish(self, end: Tensor, model: System, prepared: Prepared, corrects: bool = True) -> tuple[Tensor, Tensor]:
        """Positions and velocities after the step whose sweeps ended at ``end``."""
        if corrects and model.corrects:
            end, velocity = self._correct(end, model, prepared)
        else:
            velocity = (end - self.x_prev) / prepared.settings.numbers.time_step
        return end if self.origin is None else end + self.origin, velocity


def begin(
    model: System, x: Tensor, v: Tensor, prepared: Prepared, force: Any, gravity: Tensor, prescribed: Any
) -> Begun:
    """Predictor, local origin, data of the energies and start of the sweeps."""
    h = prepared.settings.numbers.time_step
    shape, flat = x.shape, (math.prod(x.shape[:-2]), *x.shape[-2:])
    start, velocity = x.reshape(flat), v.reshape(flat)
    if (drag := prepared.drag) is not None:
        velocity = drag.factor * velocity if drag.shift is None else drag.factor * velocity + drag.shift
        gravity = ops.broadcast(gravity, shape).reshape(flat) * drag.factor
    if gravity.shape == (3,) and force is None:
        acceleration = gravity[None, None]
    else:
        acceleration = ops.broadcast(gravity, shape).reshape(flat) if drag is None else gravity
    if force is not None:
        total = ops.broadcast(broadcastable("force", force, x), shape).reshape(flat)
        # A pinned vertex is moved by no force, whatever stands there.
        total = torch.where(model._pinned[:, None], torch.zeros_like(total), total)
        weight = ops.broadcast(prepared.mass, (flat[0], flat[1]))[..., None]
        # A vertex without mass is isolated and pinned: no force moves it. Those of a rigid body may be negative.
        acceleration = acceleration + total / torch.where(weight != 0, weight, torch.ones_like(weight))
    # float32 computes about a point of each body, where positions are small and their spacing fine
    origin = None
    if model.dtype == torch.float32 and model.num_vertices:
        origin = start.detach()[:, model._first_of_body]
        start = start - origin
    if prescribed is not None:
        prescribed = ops.broadcast(broadcastable("prescribed", prescribed, x), shape).reshape(flat)
        prescribed = prescribed if origin is None else prescribed - origin
    data = energy_data(model, prepared, origin)
    coupled = coupled_of(model, prepared.parameters, data, origin, flat[0]) if model.couplings else None
    law, moduli, at = None, (prepared.mu, prepared.lam, prepared.rest), start
    if prepared.averaged is not None:
        rest = model.rest_scalars if prepared.rest is None else prepared.rest
        law = partial(law_at, model, prepared.averaged, prepared.mu, prepared.lam, rest)
    if coupled is not None or law is not None:
        # at the predictor a body that flies or falls as a whole has the right forces
        held = start if prescribed is None else prescribed
        at = torch.where(model._pinned[:, None], held, start + h * velocity + (h * h) * acceleration)
    if coupled is not None:
        data = coupled.bound(at)
    filters = model.floor is not None and model.contact is None
    # one sweep would not bring the vertices of a body together again
    sweeps = prepared.settings.sweeps * min(model.relaxation, 1.0)
    parts = filters and model.corrects and sweeps >= 2
    rest = None
    if (model.starts_from == "auto" or parts) and model.energy_mask & ELASTIC:
        moduli = moduli if law is None else law(at.detach())
        rest = model.rest_scalars if moduli[2] is None else moduli[2]
    begins = partial(
        start_of, start, velocity, acceleration, prescribed, prepared.mass, data, origin, *moduli[:2],
        rest, model._pinned, model._bodies, model._other_bodies, prepared.settings.data_count, h,
        start=model.starts_from, filters=filters, parts=parts, energies=prepared.settings.energies,
    )  # fmt: skip
    x_start, y = begins(lookback=prepared.lookback)
    if prepared.euler is not None:
        x_start = torch.where(prepared.euler[..., None], begins(lookback=LOOKBACK)[0], x_start)
    begun = Begun(x_start, start, y, data, origin, (h * h) * acceleration, coupled, law)
    if (rigid := model.rigid_bodies) is None or not model.corrects:
        return begun
    # from the shape that they have: a fraction of an extrapolation would change it
    whole = replaced(begun, coupled=None).corrected(start, model, prepared)
    return replaced(begun, x_start=torch.where(rigid.mask[:, None], whole, x_start))


# --- start of a step --------------------------------------------------------------------------------------------------

_START_TENSORS = 6  # differentiable fields: x, v, acceleration, prescribed, mass, energy_data
_SCENES = 10  # and origin, mu, lam, rest: what has a scene dimension
_START_FIELDS = len(ops.BeginFields._fields)


def _run_start(*args: Any) -> tuple[Tensor, ...]:
    groups, other_groups, (*options, energies) = args[_START_FIELDS:]
    return ops.library_of(energies).begin(
        *ops.as_list(ops.BeginFields(*args[:_START_FIELDS]), args[0]), groups, other_groups, *options
    )


def _reverse_start(
    bars: Sequence[Tensor | None], saved: Sequence[Any], rest: tuple, needs: Sequence[bool]
) -> list[Any]:
    fields, (from_predictor, alone), (groups, options) = (
        ops.BeginFields(*saved[:_START_FIELDS]),
        saved[_START_FIELDS:],
        rest,
    )
    x_start_bar, y_bar = (torch.zeros_like(fields.x) if bar is None else bar for bar in bars)
    wants = (needs[2], needs[3], needs[5])
    *out, shared, own, planes = ops.direct.begin_backward(
        *ops.as_list(fields, fields.x), x_start_bar, y_bar, from_predictor, alone, groups, *options[:-2], wants
    )
    data_out = None
    if needs[5]:
        data_out = join_data(shared, own, options[0])
        if planes.numel():  # the first energy's data
            of_planes = ops.sum_to(planes, (planes.shape[0], 1, planes.shape[2]))[:, 0]
            count = planes.shape[2]
            first, others_out = data_out.narrow(1, 0, count), data_out.narrow(1, count, data_out.shape[1] - count)
            data_out = torch.cat([first + of_planes, others_out], 1)
    return [*out, data_out]


def _vmap_start(apply: Any, info: Any, in_dims: tuple, *args: Any) -> tuple[tuple[Tensor, ...], tuple[int, ...]]:
    tensors, _ = ops.folded(info.batch_size, args[:_SCENES], in_dims, 2)
    out = apply(*tensors, *args[_SCENES:])
    shapes = [(info.batch_size, t.shape[0] // info.batch_size) for t in out]  # decisions may have no scene
    return tuple(t.unflatten(0, shape) for t, shape in zip(out, shapes, strict=True)), (0,) * len(out)


def _saved(inputs: tuple, made: tuple) -> tuple:
    read = replaced(ops.BeginFields(*inputs[:_START_FIELDS]), mu=None, lam=None, rest=None)  # by the reverse
    return *read, *made[2:]


# Fields; groups, other_groups, (data_count, time_step, filter_eta, lookback, start, filters, parts, energies).
_begin = ops.Differentiable(
    _run_start, _reverse_start, arguments=_START_FIELDS + 3, inputs=_START_TENSORS, outputs=2, saved=_saved,
    rest=lambda inputs: (inputs[_START_FIELDS], inputs[-1]), vmap=_vmap_start, batched=True,
)  # fmt: skip


def start_of(
    x: Tensor, v: Tensor, acceleration: Tensor, prescribed: Tensor | None, mass: Tensor, energy_data: Tensor,
    origin: Tensor | None, mu: Tensor, lam: Tensor, rest: Tensor | None, pinned: Tensor, bodies: Bodies,
    others: OtherBodies, data_count: tuple[int, ...], time_step: float, lookback: float, *, start: str, filters: bool,
    parts: bool, energies: int = 0,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Start of the sweeps and predictor [m], both [B, V, 3]; differentiable in the first six tensors.

    Args:
        x, v: State [m, m/s], [B, V, 3].  acceleration: [1 | B, 1 | V, 3] [m/s^2].
        prescribed: Where pinned vertices go [m], [1 | B, V, 3]; None: they stay.
        mass, energy_data, origin, mu, lam: As in ops.SweepFields.  pinned: bool [V].
        rest: [1 | B, T, 7], or None where tets have no energy; like mu and lam looked at by choices alone.
        lookback: Distance back along h v at which a vertex counts as having been, over h v: 1 where v = (x - x_prev) /
        h. start: "auto", "predictor" or "inertia", of the bodies that are not corrected. filters: Whether the planes of
        a floor hold back a start. parts: Whether bodies that are held back may start vertex by vertex, for which there
        must be filters. energies: The scene's mask.
    """
    # what choices look at must not seem to want a gradient: there is none, and compiled autograd adds it up
    looked_at = mu.detach(), lam.detach(), rest if rest is None else rest.detach()
    tensors = distinct(x, v, acceleration, prescribed, mass, energy_data, origin, *looked_at)
    *listed, groups = bodies
    *listed_others, other_groups = others
    options = (data_count, time_step, FILTER_ETA, lookback, STARTS[start], filters)
    x_start, y, *_ = _begin(*tensors, pinned, *listed, *listed_others, groups, other_groups,
                           (*options, parts, energies))  # fmt: skip
    return x_start, y


# --- the rigid correction of a step -----------------------------------------------------------------------------------

_RIGID_TENSORS = 5  # differentiable fields: x, x_prev, y, mass, energy_data, all [1 | B, ...]
_RIGID_FIELDS = len(ops.RigidFields._fields)


def _run_correction(*args: Any) -> tuple[Tensor, Tensor]:
    return ops.direct.rigid(*ops.as_list(ops.RigidFields(*args[:_RIGID_FIELDS]), args[0]), *args[_RIGID_FIELDS:])


def _reverse_correction(
    bars: Sequence[Tensor | None], saved: Sequence[Any], rest: tuple, needs: Sequence[bool]
) -> list[Any]:
    x, data_count = saved[0], rest[1]
    x_bar = torch.zeros_like(x) if bars[0] is None else bars[0]
    v_bar = x.new_empty((0,)) if bars[1] is None else bars[1]
    *out, shared, own = ops.direct.rigid_backward(
        *ops.as_list(ops.RigidFields(*saved), x), x_bar, v_bar, *rest, needs[4]
    )
    return [*out, join_data(shared, own, data_count) if needs[4] else None]


def _vmap_correction(
    apply: Any, info: Any, in_dims: tuple, *args: Any
) -> tuple[tuple[Tensor, Tensor], tuple[int, int]]:
    tensors, scenes = ops.folded(info.batch_size, args[: _RIGID_TENSORS + 1], in_dims, 3)
    x, v = apply(*tensors, *args[_RIGID_TENSORS + 1 :])
    return (x.unflatten(0, (-1, scenes)), v.unflatten(0, (-1, scenes))), (0, 0)


# Fields; groups, data_count, time_step.
_correct = ops.Differentiable(_run_correction, _reverse_correction, arguments=_RIGID_FIELDS + 3, inputs=_RIGID_TENSORS,
                              outputs=2, tensors=_RIGID_FIELDS, vmap=_vmap_correction, batched=True)  # fmt: skip


def correct(
    x: Tensor, x_prev: Tensor, y: Tensor, mass: Tensor, energy_data: Tensor, origin: Tensor | None, bodies: Bodies,
    others: OtherBodies, data_count: tuple[int, ...], time_step: float,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Positions after every listed body was moved rigidly to the least potential, and the velocities (x - x_prev) / h,
    [B, V, 3]; differentiable in the first five tensors, whose shapes are those of ops.SweepFields."""
    tensors = distinct(x, x_prev, y, mass, energy_data, origin)
    listed = (bodies.order, bodies.ptr, bodies.spread, others.of)
    return _correct(*tensors, *listed, bodies.groups, data_count, time_step)
