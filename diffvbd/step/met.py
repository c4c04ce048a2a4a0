"""What the parts of a step with contact have met: the pairs of each search, what was decided, what was cut."""

from __future__ import annotations

import weakref
from typing import NamedTuple

import torch
from torch import Tensor

from ..adjoint.contact_lag import Pairs
from ..model.model import Model
from .contact_cycles import Combined, SweptPart


class Detection(NamedTuple):
    """One search: which pairs are listed (``listed.pairs`` [capacity, 6]: four corner points, kind, scene), the nearest
    pair of each corner point (``near_corners`` [B, N, 5], ``near_values`` [B, N, 8]: weights, normal, gap [m]), which
    bodies move together (``island`` [B, bodies]). Index data; the step differentiates the values anew."""

    listed: Pairs
    near_corners: Tensor
    near_values: Tensor
    counts: Tensor
    smallest: Tensor
    island: Tensor
    lowest: Tensor  # of a Model with a floor, else empty
    room: Tensor  # [B, bodies + 1] [m]: how far the vertices of each body may go beside its island, and the largest
    own_room: Tensor  # [B, bodies + 1] [m]: and beside the rigid motion of the body
    # what the part has decided: the shares of the two ways of its start [2, B, V], of the corrections before and after
    # its sweeps [1 to 3, B, bodies], and the exponents of limits [B, K, V]
    shares: Tensor | None = None
    corrections: Tensor | None = None
    limits: Tensor | None = None
    frames: Tensor | None = None  # and of the rigid motions of its start [B, bodies]
    combined: Combined | None = None  # which combinations of its iterates were taken; None where there are none
    lengths: Tensor | None = None  # of its coarse corrections [corrections, B, bodies of the coarse space]
    kept: Tensor | None = None  # rows of listed pairs that its sweeps can reach; all where that would have to be read
    sweeps: int = 0
    going: Tensor | None = None  # bool [B, 1, 1]: scenes that go on in a part beyond those that were planned
    resting: Tensor | None = None  # bool [B, V]: vertices of held bodies that begin without gravity's fall; None: none


class Outcome(NamedTuple):
    """What the latest step of a Model has met, on its device; read by diffvbd.contact.status."""

    counts: Tensor  # [R, 4] int64: pairs needed, touching pairs, key of one or -1, pairs that hinder what is prescribed
    capacity: int  # pairs of all scenes
    cut: Tensor  # [B, V] bool: limited in the last sweep; without any, held up at the start
    smallest: Tensor  # [R, B] [m]


class Met:
    """What the parts of a step meet one after another."""

    def __init__(self, x: Tensor) -> None:
        self.found: list[Detection] = []
        self.counts: list[Tensor] = []
        self.swept: list[SweptPart] = []
        self.cut = torch.zeros_like(x[..., 0], dtype=torch.bool)


outcomes: weakref.WeakKeyDictionary[Model, Outcome] = weakref.WeakKeyDictionary()
