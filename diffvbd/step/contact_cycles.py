"""The sweeps of a part of a step with pairs or friction, in cycles, and what Model.coarse and Model.acceleration do
between these."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from .. import ops
from ..adjoint.anderson import _Combine, cycles_of, none_taken
from ..model.system import System
from ..ops import SweepSettings, broadcast
from ..scopes import recorders
from ..tuples import replaced
from .coarse_contact import Corrections
from .corrections import touching
from .rigid_terms import Scenes
from .trials import Trials

if TYPE_CHECKING:
    from ..adjoint.contact_lag import Pairs
    from ..contact.start import PartStart
    from .contact import ContactStep


# Of a step that nobody has given a number: by how far bodies want to go, and with more of them while pairs hold some up
MOST_PLANNED, MOST_DETECTIONS = 4, 8
CUT = 0.01  # share of the vertices that pairs may hold up, beside whole bodies, before it goes on, and a rollout warns


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
    lengths: Tensor | None = None  # of coarse corrections [corrections, B, bodies of the coarse space]


def sweeps_of_parts(sweeps: int, parts: int) -> list[int]:
    """How K sweeps are spread over R parts: evenly, the first ones taking what is left."""
    return [sweeps // parts + (1 if r < sweeps % parts else 0) for r in range(parts)]


def sweeps_of_part(sweeps: int, planned: int, part: int) -> int:
    """And how many a part has; one beyond those that were planned, as many as the last of these, or one."""
    shared = sweeps_of_parts(sweeps, planned)
    return shared[part] if part < planned else max(shared[-1], min(sweeps, 1))


def parts_of(over: Tensor) -> int:
    """How many parts a step takes that nobody has given a number: one, and one more each time that bodies want to go
    twice as far as the most room that they get. over: of RoomsOfBodies."""
    most = float(over.max()) if over.numel() else 0.0
    return min(MOST_PLANNED, 1 + math.ceil(math.log2(most))) if 1 < most < math.inf else 1


def swept_part(of: ContactStep, x: Tensor, start: PartStart, collider: Tensor, listed: Pairs, settings: SweepSettings,
               policy: int, debug_step: int) -> SweptPart:  # fmt: skip
    """Positions [B, V, 3] after the sweeps of a part that begin at x, in the rooms of its start."""
    model, mass = of.model, of.fields.mass

    def sweep(x: Tensor, settings: SweepSettings) -> tuple[Tensor, Tensor]:
        return of._sweep(x, start.center, start.room, collider, listed, settings, policy, debug_step)

    settings = replaced(settings, coarse=())  # which the operator would make, without pairs
    cycles = _cycles(model, settings.sweeps)
    if len(cycles) <= 1:
        return SweptPart(*sweep(x, settings))
    judge, corrections = _trials(of, start, collider, listed), None
    if of.coarse_matrix is not None:
        corrections = Corrections(judge, of.fields, of.coarse_matrix, _scenes(of, start, collider, listed))
    numbers = settings.numbers
    within = replaced(settings, numbers=replaced(numbers, last_relaxation=numbers.relaxation))
    iterates = _Iterates(model, judge, broadcast(mass, x.shape[:2]).reshape(1, -1), len(cycles))
    limits, lengths = [], []
    for n, count in enumerate(cycles):
        ends = n + 1 == len(cycles)
        before = x
        if corrections is not None and n:
            x, length = corrections.correct(x)
            lengths.append(length)
        x, limit = sweep(x, replaced(settings if ends else within, sweeps=count))
        limits.append(limit)
        if not ends and (corrections is None or n):  # the sweep before the first correction is no cycle
            x = iterates.next(before, x)
    return SweptPart(x, torch.cat(limits, 1), iterates.combined(), torch.stack(lengths) if lengths else None)


def _cycles(model: System, sweeps: int) -> list[int]:
    """Sweeps of each cycle of a part, with corrections the first sweep alone; [sweeps] where nothing is done between
    them."""
    if model.coarse is None or not model.coarse_geometry.bodies:
        return cycles_of(model, sweeps) if model.acceleration is not None else [sweeps]
    every, after = model.coarse.every, sweeps - 1
    return [1, *(min(every, after - begun) for begun in range(0, after, every))]


class _Iterates:
    """The last iterates of a part, and what was combined of them."""

    def __init__(self, model: System, judge: Trials, mass: Tensor, cycles: int) -> None:
        self.window = 0 if model.acceleration is None else model.acceleration.window
        self.judge, self.mass = judge, mass
        self.before: list[Tensor] = []
        self.after: list[Tensor] = []
        self.taken: list[Tensor] = []

    def next(self, before: Tensor, after: Tensor) -> Tensor:
        """Where the next cycle begins, after one from ``before`` to ``after`` [B, V, 3]."""
        if not self.window:
            return after
        whole = (1, after.shape[0] * after.shape[1], 3)
        self.before = [*self.before[-self.window :], before.reshape(whole)]
        self.after = [*self.after[-self.window :], after.reshape(whole)]
        if len(self.before) < 2:
            return after
        combine = _Combine.apply if torch.is_grad_enabled() else _Combine.forward
        to, kept, *_ = combine(self.mass, self.judge, len(self.before), *self.before, *self.after)
        self.taken.append(self.judge.of_bodies(kept))
        return to.reshape(after.shape)

    def combined(self) -> Combined | None:
        return Combined(self.judge.bodies.of_body[:, :-1], torch.stack(self.taken)) if self.taken else None


def _scenes(of: ContactStep, start: PartStart, collider: Tensor, listed: Pairs) -> Scenes:
    numbers = of.prepared.settings.numbers
    fields = touching(of, of.x_prev, collider, start, listed)
    return Scenes(of.model, fields, numbers.time_step, numbers.friction_eps)


def _trials(of: ContactStep, start: PartStart, collider: Tensor, listed: Pairs) -> Trials:
    s = _scenes(of, start, collider, listed)
    s = replaced(s, fields=ops.TouchingFields(*(t.detach() for t in s.fields)))
    return Trials(s, of.potential_parts)


def of_going(part: SweptPart, going: Tensor) -> SweptPart:
    """What a part has done in the scenes that go on, bool [B, 1, 1]; in others it is thrown away."""
    combined, lengths, going = part.combined, part.lengths, going[:, 0]
    return replaced(
        part,
        combined=None if combined is None else replaced(combined, taken=combined.taken & going),
        lengths=None if lengths is None else torch.where(going, lengths, 0.0),
    )


def record_parts(model: System, x: Tensor, parts: Sequence[SweptPart]) -> None:
    """For acceleration.record() and coarse.record(): what the parts of a step that ends at x have done."""
    if model.acceleration is not None:
        for found in recorders("anderson"):
            taken = [part.combined.taken for part in parts if part.combined is not None]
            found.append(torch.cat(taken).movedim(0, 1) if taken else none_taken(model, x))
    if model.coarse is not None:
        for found in recorders("coarse"):
            lengths = [part.lengths for part in parts if part.lengths is not None]
            empty = x.new_empty((0, len(x), model.coarse_geometry.bodies))
            found.append(torch.cat([empty, *lengths]).movedim(0, 1))
