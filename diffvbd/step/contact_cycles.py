"""The sweeps of a part of a step with pairs or friction, in cycles, with the coarse corrections between these."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from .. import ops
from ..model.system import System
from ..ops import SweepSettings
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


class SweptPart(NamedTuple):
    """Result of the sweeps of a substep."""

    x: Tensor  # [B, V, 3]
    limits: Tensor  # uint8 [B, K, V]
    lengths: Tensor | None = None  # of coarse corrections [corrections, B, bodies of the coarse space]


def sweeps_of_parts(sweeps: int, parts: int) -> list[int]:
    """Numbers of sweeps of R substeps: K spread evenly, the first ones taking the remainder."""
    return [sweeps // parts + (1 if r < sweeps % parts else 0) for r in range(parts)]


def sweeps_of_part(sweeps: int, planned: int, part: int) -> int:
    """And how many a part has; one beyond those that were planned, as many as the last of these, or one."""
    shared = sweeps_of_parts(sweeps, planned)
    return shared[part] if part < planned else max(shared[-1], min(sweeps, 1))


def parts_of(over: Tensor) -> int:
    """Number of substeps of a step without a given number: one, and one more each time that bodies want to go
    twice as far as the most room that they get. over: of RoomsOfBodies."""
    most = float(over.max()) if over.numel() else 0.0
    return min(MOST_PLANNED, 1 + math.ceil(math.log2(most))) if 1 < most < math.inf else 1


def swept_part(of: ContactStep, x: Tensor, start: PartStart, collider: Tensor, listed: Pairs, settings: SweepSettings,
               policy: int, debug_step: int) -> SweptPart:  # fmt: skip
    """Positions [B, V, 3] after the sweeps of a part that begin at x, in the rooms of its start."""

    def sweep(x: Tensor, settings: SweepSettings) -> tuple[Tensor, Tensor]:
        return of._sweep(x, start.center, start.room, collider, listed, settings, policy, debug_step)

    settings = replaced(settings, coarse=())  # which the operator would make, without pairs
    cycles = _cycles(of.model, settings.sweeps)
    if len(cycles) <= 1:
        return SweptPart(*sweep(x, settings))
    corrections = None
    if of.coarse_matrix is not None:
        judge = _trials(of, start, collider, listed)
        corrections = Corrections(judge, of.fields, of.coarse_matrix, _scenes(of, start, collider, listed))
    numbers = settings.numbers
    within = replaced(settings, numbers=replaced(numbers, last_relaxation=numbers.relaxation))
    limits, lengths = [], []
    for n, count in enumerate(cycles):
        ends = n + 1 == len(cycles)
        if corrections is not None and n:
            x, length = corrections.correct(x)
            lengths.append(length)
        x, limit = sweep(x, replaced(settings if ends else within, sweeps=count))
        limits.append(limit)
    return SweptPart(x, torch.cat(limits, 1), torch.stack(lengths) if lengths else None)


def _cycles(model: System, sweeps: int) -> list[int]:
    """Sweeps of each cycle of a part, with corrections the first sweep alone; [sweeps] where nothing is done between
    them."""
    if model.coarse is None or not model.coarse_geometry.bodies:
        return [sweeps]
    every, after = model.coarse.every, sweeps - 1
    return [1, *(min(every, after - begun) for begun in range(0, after, every))]


def _scenes(of: ContactStep, start: PartStart, collider: Tensor, listed: Pairs) -> Scenes:
    numbers = of.prepared.settings.numbers
    fields = touching(of, of.x_prev, collider, start, listed)
    return Scenes(of.model, fields, numbers.time_step, numbers.friction_eps)


def _trials(of: ContactStep, start: PartStart, collider: Tensor, listed: Pairs) -> Trials:
    s = _scenes(of, start, collider, listed)
    s = replaced(s, fields=ops.TouchingFields(*(t.detach() for t in s.fields)))
    return Trials(s, of.potential_parts)


def of_going(part: SweptPart, going: Tensor) -> SweptPart:
    """Result of a substep in the scenes that go on, bool [B, 1, 1]; in others it is discarded."""
    return part if part.lengths is None else replaced(part, lengths=torch.where(going[:, 0], part.lengths, 0.0))


def record_parts(model: System, x: Tensor, parts: Sequence[SweptPart]) -> None:
    """For coarse.record(): what the parts of a step that ends at x have done."""
    if model.coarse is not None:
        for found in recorders("subspace"):
            lengths = [part.lengths for part in parts if part.lengths is not None]
            empty = x.new_empty((0, len(x), model.coarse_geometry.bodies))
            found.append(torch.cat([empty, *lengths]).movedim(0, 1))
