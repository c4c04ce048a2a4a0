"""How far from converged a step ends, estimated from the changes of its last iterates (docs/method.md, section 17)."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from .. import ops
from ..adjoint.sweep import sweep
from ..model.model import Model
from ..model.moving import moving_vertices
from ..model.system import System
from ..ops.detect import segment_sum
from ..tuples import replaced
from .arguments import Prepared, acceleration_of
from .coarse import lengths_of, with_corrections
from .predict import Begun, begin

LARGEST_RATIO = 0.98  # of two changes: what shrinks more slowly cannot be told from what does not shrink
COARSE_FIELDS = ("coarse_factor", "coarse_mass", "coarse_plan", "coarse_weights", "coarse_rest")


class ErrorEstimate(NamedTuple):
    """How far from converged steps end, of each connected body with a vertex to move, in the order of the bodies' first
    vertices. Detached; NaN where a step has too few sweeps to tell.

    An iterate of a step is a coarse correction with its sweeps, after the first sweep; without coarse corrections one
    sweep; each with the rigid correction that would end the step there. Norms are root mean squares over the vertices
    of the body that move.

    Attributes:
        change: d, between the last two iterates [m], shape [..., bodies].
        ratio: rho, d over the change before it, at most 0.98 [-], shape [..., bodies].
        error: d rho / (1 - rho): the estimated distance to the converged step [m], shape
            [..., bodies]. Often two thirds too small: take three times as much to be safe. Far too small for
            motions that sweeps hardly change.
        relative: ``error`` over the motion of the body in the step [-], shape [..., bodies].
        lengths: Of the coarse corrections of the step, 1 is a whole one and 0 one that was refused; shape
            [..., corrections, bodies], empty without them.

    Source: the remainder of a geometric series; docs/numerics.md, "How wrong a step is", where it fails.
    """

    change: Tensor
    ratio: Tensor
    error: Tensor
    relative: Tensor
    lengths: Tensor


def check_estimable(model: Model, name: str) -> None:
    """Raises where steps of the Model have no estimate; ``name``: of the argument that asks for one."""
    if model.touches:
        raise NotImplementedError(f"{name}: the error of a step with contact or friction is not estimated")


def error_of(model: System, x: Tensor, v: Tensor, prepared: Prepared, *, force: Any, gravity: Any, prescribed: Any
             ) -> ErrorEstimate:  # fmt: skip
    """Sweeps the step once more, without gradients. Arguments as of advance()."""
    lead = x.shape[:-2]
    with torch.no_grad(), torch.autocast(x.device.type, enabled=False):
        x, v = x.detach(), v.detach()
        begun = begin(model, x, v, prepared, force, acceleration_of(gravity, x), prescribed).detached()
        states, corrections = _iterates(model, begun, prepared)
        states = [begun.corrected(s, model, prepared) for s in states]
        bodies = _bodies_of(model)
        shape = len(begun.x_prev), bodies.size.shape[0]
        unknown = x.new_full(shape, torch.nan)
        changes = [bodies.rms(b - a) for a, b in zip(states[:-1], states[1:], strict=True)]
        change = changes[-1] if changes else unknown
        ratio = _quotient(change, changes[-2]).clamp(max=LARGEST_RATIO) if len(changes) > 1 else unknown
        error = change * ratio / (1 - ratio)
        relative = _quotient(error, bodies.rms(states[-1] - begun.x_prev))
        lengths = x.new_empty((shape[0], 0, shape[1]))
        if corrections:
            lengths = lengths_of(model, torch.cat(corrections, 1))[..., bodies.corrected]
        return ErrorEstimate(*(t.reshape(*lead, *t.shape[1:]) for t in (change, ratio, error, relative, lengths)))


def of_steps(estimates: list[ErrorEstimate], model: System, x: Tensor, sweeps: int) -> ErrorEstimate:
    """Those of several steps, [steps, ...]; x: the state [..., V, 3] before the first."""
    if estimates:
        return ErrorEstimate(*(torch.stack(tensors) for tensors in zip(*estimates, strict=True)))
    lead, bodies = x.shape[:-2], _bodies_of(model).size.shape[0]
    corrections = model.coarse.corrections(sweeps) if model.coarse is not None and model.coarse_geometry.bodies else 0
    none = x.new_empty((0, *lead, bodies))
    return ErrorEstimate(none, none, none, none, x.new_empty((0, *lead, corrections, bodies)))


def _quotient(a: Tensor, b: Tensor) -> Tensor:
    """a / b, and 0 / 0 = 0: what rests has no error."""
    return torch.where((a == 0) & (b == 0), 0, a / b)


def _iterates(model: System, begun: Begun, prepared: Prepared) -> tuple[list[Tensor], list[Tensor]]:
    """The last iterates of the step [B, V, 3], at most three, the end of the sweeps last; and what coarse corrections
    did, as sweep() returns it."""
    fields, settings = begun.fields(model, prepared), prepared.settings
    if prepared.coarse is not None:
        fields = with_corrections(model, prepared.coarse, fields, settings.numbers.time_step)
    coarse = settings.coarse if prepared.coarse is not None else ()
    before, parts = _parts(settings.sweeps, coarse.every if coarse else None)
    over = replaced(settings, numbers=replaced(settings.numbers, last_relaxation=settings.numbers.relaxation))
    x, corrections, states = fields.x_start, [], []

    def run(fields: ops.SweepFields, settings: ops.SweepSettings) -> Tensor:
        # values are looked at once
        end, _, done = sweep(fields, model._packed_rest, model._plan, settings, tape_policy=ops.NO_TAPE,
                             checked=fields.x_start is begun.x_start)  # fmt: skip
        corrections.extend([done] if done.numel() else [])
        return end

    if before == 1 and parts and coarse:  # a sweep alone would be corrected
        x = run(replaced(fields, **dict.fromkeys(COARSE_FIELDS)), replaced(over, sweeps=1, coarse=()))
    elif before or not parts:
        x = run(fields, replaced(over if parts else settings, sweeps=before))
    if coarse:
        on = replaced(coarse, begun=1)
        settings, over = replaced(settings, coarse=on), replaced(over, coarse=on)
    states.append(x)
    for n, count in enumerate(parts):
        # the relaxation of the step's last sweep is its own
        now = settings if n + 1 == len(parts) else over
        x = run(replaced(fields, x_start=x), replaced(now, sweeps=count))
        states.append(x)
    return states, corrections


def _parts(sweeps: int, every: int | None) -> tuple[int, list[int]]:
    """Sweeps before the last iterates, and those of each of these, at most two."""
    if every is None:
        last = [1] * min(sweeps, 2)
    else:
        last = [min(every, sweeps - 1 - begun) for begun in range(0, sweeps - 1, every)][-2:]
    return sweeps - sum(last), last


class _Bodies(NamedTuple):
    """The connected bodies with a vertex to move."""

    order: Tensor  # int32 [active], their vertices that move
    ptr: Tensor  # int32 [bodies + 1]
    size: Tensor  # [bodies], how many
    corrected: Tensor  # int64 [bodies], which body of the coarse space each is

    def rms(self, way: Tensor) -> Tensor:
        """[B, V, 3] -> [B, bodies]"""
        squares = way.square().sum(-1, keepdim=True)
        return (segment_sum(squares, self.order, self.ptr)[..., 0] / self.size).sqrt()


def _bodies_of(model: System) -> _Bodies:
    return model.derived("bodies_that_move", lambda: _find_bodies(model))


def _find_bodies(model: System) -> _Bodies:
    of = moving_vertices(model.tets.cpu(), model._pinned.cpu())
    count = of.ptr.diff()
    corrected = torch.arange(len(count))
    if model.coarse is not None and model.coarse_geometry.bodies:
        space = model.coarse_geometry
        first = torch.from_numpy(space.function_ptr)
        body = torch.searchsorted(first, torch.from_numpy(space.function), right=True) - 1
        corrected[of.of[torch.from_numpy(space.vertex)]] = body
    device = model.device
    return _Bodies(of.order.int().to(device), of.ptr.int().to(device), count.to(device, model.dtype),
                   corrected.to(device))  # fmt: skip
