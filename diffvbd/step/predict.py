"""Start and end of a step: from inputs to the start of the sweeps, and from their end to the state."""

from __future__ import annotations

import math
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from .. import ops
from ..checks import input_name
from ..mask import ELASTIC
from ..model.system import System
from ..tuples import replaced
from .arguments import CHORD, Prepared, broadcastable
from .rigid import correct
from .start import begin as start_of


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
    lift: Tensor  # h^2 times the acceleration [m], [1 | B, 1 | V, 3]; y is x + h v and this

    def detached(self) -> Begun:
        origin = None if self.origin is None else self.origin.detach()
        return Begun(self.x_start.detach(), self.x_prev.detach(), self.y.detach(), self.data.detach(), origin,
                     self.lift.detach())  # fmt: skip

    def fields(self, model: System, prepared: Prepared) -> ops.SweepFields:
        """Fields of the sweeps, without contact."""
        fields = ops.SweepFields(self.x_start, self.x_prev, self.y, prepared.mu, prepared.lam, prepared.mass,
                                 prepared.rest, self.data, self.origin)  # fmt: skip
        if not ops.TET_READS_X_PREV:
            return fields
        corners = self.x_prev[:, model.tets].flatten(2).permute(2, 0, 1).contiguous()
        return replaced(fields, corners_prev=corners)

    def corrected(self, x: Tensor, model: System, prepared: Prepared) -> Tensor:
        """x [B, V, 3] after the rigid correction, where the Model has one."""
        return self._correct(x, model, prepared)[0] if model.corrects else x

    def _correct(self, x: Tensor, model: System, prepared: Prepared) -> tuple[Tensor, Tensor]:
        settings = prepared.settings
        return correct(x, self.x_prev, self.y, prepared.mass, self.data, self.origin, model._bodies,
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
    if gravity.shape == (3,) and force is None:
        acceleration = gravity[None, None]
    else:
        acceleration = ops.broadcast(gravity, shape).reshape(flat)
    if force is not None:
        total = ops.broadcast(broadcastable("force", force, x), shape).reshape(flat)
        # A pinned vertex is moved by no force, whatever stands there.
        total = torch.where(model._pinned[:, None], torch.zeros_like(total), total)
        weight = ops.broadcast(prepared.mass, (flat[0], flat[1]))[..., None]
        # A vertex without mass is isolated and pinned: no force moves it.
        acceleration = acceleration + total / torch.where(weight > 0, weight, torch.ones_like(weight))
    # float32 computes about a point of each body, where positions are small and their spacing fine
    origin = None
    if model.dtype == torch.float32 and model.num_vertices:
        origin = start.detach()[:, model._first_of_body]
        start = start - origin
    if prescribed is not None:
        prescribed = ops.broadcast(broadcastable("prescribed", prescribed, x), shape).reshape(flat)
        prescribed = prescribed if origin is None else prescribed - origin
    data = energy_data(model, prepared, origin)
    filters = model.floor is not None and model.contact is None
    # one sweep would not bring the vertices of a body together again
    sweeps = prepared.settings.sweeps * min(model.relaxation, 1.0)
    parts = filters and model.corrects and sweeps >= 2
    rest = None
    if (model.starts_from == "auto" or parts) and model.energy_mask & ELASTIC:
        rest = model.rest_scalars if prepared.rest is None else prepared.rest
    begins = partial(
        start_of, start, velocity, acceleration, prescribed, prepared.mass, data, origin, prepared.mu, prepared.lam,
        rest, model._pinned, model._bodies, model._other_bodies, prepared.settings.data_count, h,
        start=model.starts_from, filters=filters, parts=parts,
    )  # fmt: skip
    x_start, y = begins(chord=prepared.chord)
    if prepared.euler is not None:
        x_start = torch.where(prepared.euler[..., None], begins(chord=CHORD)[0], x_start)
    return Begun(x_start, start, y, data, origin, (h * h) * acceleration)
