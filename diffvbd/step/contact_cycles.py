"""The sweeps of a part of a step with pairs or friction, in cycles, and what Model.acceleration does between these."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from .. import ops
from ..adjoint.anderson import _Combine, cycles_of, none_taken
from ..adjoint.rise import rise_parts
from ..model.model import Model
from ..ops import SweepSettings, broadcast
from ..scopes import recorders
from .rigid_terms import Scenes
from .trials import Trials

if TYPE_CHECKING:
    from ..adjoint.contact_lag import Pairs
    from ..contact.start import PartStart
    from .contact import ContactStep


class Combined(NamedTuple):
    """What was combined in a part: the set of each body that moves [B, bodies], and which bodies took each combination,
    bool [combinations, B, bodies]. Index data."""

    sets: Tensor
    taken: Tensor


class SweptPart(NamedTuple):
    """What the sweeps of a part return."""

    x: Tensor  # [B, V, 3]
    limits: Tensor  # uint8 [B, K, V]
    combined: Combined | None = None


def swept_part(of: ContactStep, x: Tensor, start: PartStart, collider: Tensor, listed: Pairs, settings: SweepSettings,
               policy: int, debug_step: int) -> SweptPart:  # fmt: skip
    """Positions [B, V, 3] after the sweeps of a part that begin at x, in the rooms of its start."""
    model, mass = of.model, of.fields.mass

    def sweep(x: Tensor, settings: SweepSettings) -> tuple[Tensor, Tensor]:
        return of._sweep(x, start.center, start.room, collider, listed, settings, policy, debug_step)

    cycles = cycles_of(model, settings.sweeps) if model.acceleration is not None else [settings.sweeps]
    if len(cycles) <= 1:
        return SweptPart(*sweep(x, settings))
    if torch.compiler.is_compiling():
        raise NotImplementedError("diffvbd: torch.compile of a step with Anderson acceleration is not supported")
    assert model.acceleration is not None
    judge, window = _trials(of, start, collider, listed), model.acceleration.window
    combine = _Combine.apply if torch.is_grad_enabled() else _Combine.forward
    whole, mass = (1, x.shape[0] * x.shape[1], 3), broadcast(mass, x.shape[:2]).reshape(1, -1)
    before, after, limits, taken = [], [], [], []
    for n, count in enumerate(cycles):
        ends = n + 1 == len(cycles)
        before.append(x.reshape(whole))
        x, limit = sweep(x, settings._replace(sweeps=count))
        limits.append(limit)
        after.append(x.reshape(whole))
        if n and not ends:
            before, after = before[-window - 1 :], after[-window - 1 :]
            to, kept, *_ = combine(mass, judge, len(before), *before, *after)
            x = to.reshape(x.shape)
            taken.append(judge.of_bodies(kept))
    return SweptPart(x, torch.cat(limits, 1), Combined(judge.bodies.of_body[:, :-1], torch.stack(taken)))


def _trials(of: ContactStep, start: PartStart, collider: Tensor, listed: Pairs) -> Trials:
    numbers = of.prepared.settings.numbers
    fields = of.touching(of.x_prev, collider, start, listed)
    scenes = Scenes(of.model, ops.TouchingFields(*(t.detach() for t in fields)), numbers.time_step,
                    numbers.friction_eps)  # fmt: skip
    return Trials(scenes, rise_parts(of.model, of.fields, numbers.time_step))


def record_combined(model: Model, x: Tensor, parts: Sequence[Combined | None]) -> None:
    """For acceleration.record(): what the parts of a step that ends at x have combined."""
    if model.acceleration is None:
        return
    for found in recorders("anderson"):
        taken = [part.taken for part in parts if part is not None]
        found.append(torch.cat(taken).movedim(0, 1) if taken else none_taken(model, x))
