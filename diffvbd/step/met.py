"""Records of a step with contact: the pairs of each search, what was decided, which vertices were truncated."""

from __future__ import annotations

import weakref
from typing import NamedTuple

import torch
from torch import Tensor

from ..adjoint.contact_lag import Pairs
from ..model.model import Model
from .contact_cycles import SweptPart


class Detection(NamedTuple):
    """One search for pairs, and what its part of the step has decided. Index data; the step differentiates the values
    anew. N corner points: vertices, then those of colliders.

    Attributes:
        listed: The pairs that may matter: ``pairs`` [capacity, 6], four corner points, kind (0 point and triangle, 1
            two edges, 2 point and plane) and scene, or -1; ``constants`` [capacity, 8]; those of each corner point by
            ``ptr`` [B N + 1] and ``entry`` [4 capacity].
        near_corners: Corner points and kind of the nearest pair of each corner point, int [B, N, 5]; -1: none.
        near_values: Its weights, normal and gap [m], [B, N, 8].
        counts: int64 [4]: pairs that the list needs, pairs that touch, key of one of those or -1, 0.
        smallest: Smallest gap of each scene, or how far was looked [m], [B].
        island: Smallest body of those that each body moves with, int [B, bodies]; -1: it stays, being held or near a
            collider.
        lowest: Lowest vertex of each body's island above each plane of the floor, int [B, bodies, planes]; else empty.
        room: How far the vertices of each body may go beside its island, and the largest [m], [B, bodies + 1].
        own_room: The same beside the rigid motion of the body [m].
        shares: How much of its two ways each vertex begins the part with, [B, V] each.
        corrections: Shares of the rigid corrections before and after the sweeps, [B, bodies] each.
        limits: By how often each update was halved, uint8 [B, K, V]; 8: it was not made.
        frames: Share of the rigid motion that each body begins the part with, [B, bodies].
        lengths: Of the coarse corrections, [corrections, B, bodies of the coarse space]; None: there are none.
        kept: Rows of the listed pairs that sweeps can reach; None where that would have to be read, as on CUDA.
        sweeps: How many sweeps the part has.
        going: Scenes that go on in a part beyond those that were planned, bool [B, 1, 1]; None: all, as planned.
        resting: Vertices of held bodies that begin without gravity's fall, bool [B, V]; None: none.
    """

    listed: Pairs
    near_corners: Tensor
    near_values: Tensor
    counts: Tensor
    smallest: Tensor
    island: Tensor
    lowest: Tensor
    room: Tensor
    own_room: Tensor
    # what the part has decided
    shares: tuple[Tensor, ...] | None = None
    corrections: tuple[Tensor, ...] | None = None
    limits: Tensor | None = None
    frames: Tensor | None = None
    lengths: Tensor | None = None
    kept: Tensor | None = None
    sweeps: int = 0
    going: Tensor | None = None
    resting: Tensor | None = None


class Outcome(NamedTuple):
    """Record of the latest step of a Model, on its device; read by diffvbd.contact.status."""

    counts: Tensor  # [R, 4] int64: pairs needed, touching pairs, key of one or -1, pairs that hinder what is prescribed
    capacity: int  # pairs of all scenes
    cut: Tensor  # [B, V] bool: limited in the last sweep; without any, held up at the start
    smallest: Tensor  # [R, B] [m]


class TooManyPairs(RuntimeError):
    """More pairs than fit; ``needed`` per scene."""

    def __init__(self, needed: int, message: str) -> None:
        super().__init__(message)
        self.needed = needed


class Met:
    """Records of the substeps, one after another."""

    def __init__(self) -> None:
        self.found: list[Detection] = []
        self.counts: list[Tensor] = []
        self.swept: list[SweptPart] = []
        self.cut: Tensor | None = None  # before the first part is over

    def outcome(self, capacity: int, x: Tensor) -> Outcome:
        """capacity: Pairs of all scenes that fit.  x: [B, V, 3] at the start of the step."""
        smallest, counts = _stack([d.smallest for d in self.found]), _stack(self.counts)
        cut = torch.zeros_like(x[..., 0], dtype=torch.bool) if self.cut is None else self.cut
        return Outcome(counts, capacity, cut, smallest)


def _stack(parts: list[Tensor]) -> Tensor:
    return parts[0][None] if len(parts) == 1 else torch.stack(parts)  # one is not copied: on CUDA that is a launch


outcomes: weakref.WeakKeyDictionary[Model, Outcome] = weakref.WeakKeyDictionary()
