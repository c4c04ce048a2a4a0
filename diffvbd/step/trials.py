"""Whether bodies may move together: nothing crosses, and no set of bodies that pairs join gains potential
(docs/method.md, sections 15 and 16).

A pair's energy belongs to two bodies, so that one of them may gain what the other loses. Bodies are therefore judged in
sets: those that listed pairs, or friction and damping, join. No pair acts across sets, wherever their bodies go within
their rooms, so each set decides for itself.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from ..adjoint.contact_lag import Pairs
from ..adjoint.rise import RiseParts, rise_of_bodies
from ..ops import contact as ops_start
from ..ops.fields import DECREASE, FRACTIONS, ROUNDINGS
from ..ops.sums import sum_by
from .pair_values import barrier_values, floor_friction_values, lagged_values
from .rigid_terms import Scenes, corners_of

EDGES = 1  # the kind of a pair of two edges


class Sets(NamedTuple):
    """The sets of bodies of all scenes, as the bodies of one large scene [1, B V, 3]; as MovingBodies."""

    order: Tensor  # int32, rows of vertices that move, by set
    ptr: Tensor  # int32 [sets + 1]; on CUDA, which must not look, many sets are empty
    of: Tensor  # int64 [B V], the set of each row; `number` where it does not move
    of_body: Tensor  # int64 [B, bodies + 1], and of each body that moves, and of what does not

    @property
    def number(self) -> int:
        return self.ptr.shape[0] - 1


class Trials:
    """Common data of all trials in one substep.

    Args:
        scenes: The part; its pairs are those that sweeps can reach, its rooms those of the sweeps.
        parts: Of the bodies' own potentials.
    """

    def __init__(self, scenes: Scenes, parts: RiseParts) -> None:
        self.scenes, self.parts = scenes, parts
        moving = parts.model._moving
        self.count = moving.number + 1  # what does not move is a body too
        self.of = moving.of
        self.of_corner = torch.cat([self.of, self.of.new_full((scenes.fields.collider.shape[1],), moving.number)])
        self.bodies = self._sets()
        # the set of each pair, and the potentials of all of a kind
        self._of_pairs = [(self._set_of_pairs(listed), values) for listed, values in
                          ((scenes.listed, barrier_values), (scenes.lagged, lagged_values)) if listed.pairs.shape[0]
                          ]  # fmt: skip

    @torch.no_grad()
    def _sets(self) -> Sets:
        s, scenes, moves = self.scenes, self.scenes.fields.x_prev.shape[0], self.count - 1
        near = self._sides(s.listed, s.fields.constants[:, -1] < torch.inf)
        acts = (s.fields.lag[:, :2] != 0).any(-1) if s.fields.lag.numel() else s.lagged.pairs[:, 0] < 0
        one, two = torch.cat([near, self._sides(s.lagged, acts)]).unbind(1)
        least = connected_rows(one, two, scenes * self.count)
        # where rounds have not been enough, all bodies of a scene are one set
        apart = sum_by((least[one] != least[two]).to(s.fields.room.dtype)[:, None], one // self.count, scenes) > 0
        first = self.count * torch.arange(scenes, device=least.device)[:, None]
        least = torch.where(apart, first, least.reshape(scenes, self.count)[:, :moves])
        number, of_body = scenes * self.count, least
        if not least.is_cuda:
            used, of_body = torch.unique(least, return_inverse=True)
            number = len(used)
        of_body = torch.cat([of_body, of_body.new_full((scenes, 1), number)], 1)
        of = of_body[:, self.of].reshape(-1)
        ordered, order = torch.sort(of, stable=True)
        active = scenes * len(self.parts.model._moving.order)
        ptr = torch.searchsorted(ordered, torch.arange(number + 1, device=of.device))
        return Sets(order[:active].int(), ptr.int(), of, of_body)

    def _sides(self, listed: Pairs, counts: Tensor) -> Tensor:
        """Rows of the bodies of both sides of pairs [n, 2]; one twice where only one side moves or the pair does not
        count."""
        scene, corners = corners_of(listed)
        body, kind = self.of_corner[corners], listed.pairs[:, 4]
        first = torch.where(kind == EDGES, body[:, :2].amin(1), body[:, 0])
        second = torch.where(kind == EDGES, body[:, 2:].amin(1), body[:, 1:].amin(1))
        least, largest = torch.minimum(first, second), torch.maximum(first, second)
        joins = counts & (largest < self.count - 1) & (kind >= 0)
        return self.count * scene + torch.stack([least, torch.where(joins, largest, least)], 1)

    def _set_of_pairs(self, listed: Pairs) -> Tensor:
        scene, corners = corners_of(listed)
        return self.bodies.of_body[scene[:, 0], self.of_corner[corners].amin(1)]

    @torch.no_grad()
    def admits(self, x: Tensor, to: Tensor) -> Tensor:
        """Whether each set may go from x to ``to`` [1, B V, 3], bool [1, sets]. What does not move must stay."""
        x, to = (t.reshape(self.scenes.fields.x_prev.shape) for t in (x, to))
        return self._admits(x, to, 0.0)[None, :-1]

    @torch.no_grad()
    def lengths(self, x: Tensor, way: Tensor, slope: Tensor) -> Tensor:
        """Fraction of a displacement [B, V, 3] that each set takes: the first of 1, 1/2, ..., 1/128 that lowers its
        potential by enough of what the slope [sets] promises, else 0; [1, sets]."""
        found = torch.zeros_like(slope, dtype=x.dtype)
        for trial in range(FRACTIONS):
            share = 0.5**trial
            enough = torch.cat([DECREASE * share * slope, slope.new_zeros(1)])
            good = self._admits(x, x + share * way, enough)[:-1] & (slope <= 0)
            found = torch.where((found == 0) & good, share, found)
            if not x.is_cuda and bool((found > 0).all()):
                break
        return found[None]

    def _admits(self, x: Tensor, to: Tensor, most: Tensor | float) -> Tensor:
        """Whether the potential of each set rises at most so much, and nothing crosses, bool [sets + 1]."""
        rise, size = self.rise(x, to).unbind(-1)
        fits = torch.ones_like(rise, dtype=x.dtype)
        fits = fits.scatter_reduce(0, self.bodies.of, self._fits(x, to).reshape(-1), "amin")
        # never of what is no number
        return (rise <= most + ROUNDINGS * torch.finfo(x.dtype).eps * size) & (fits >= 1)

    def of_bodies(self, values: Tensor) -> Tensor:
        """Values of sets [1, sets] of each body that moves [B, bodies]."""
        return values[0][self.bodies.of_body[:, :-1]]

    def rise(self, x: Tensor, to: Tensor) -> Tensor:
        """Increase of the potential of each set from x to ``to`` [B, V, 3], and the sizes of its terms
        [sets + 1, 2], last of what does not move."""
        rows = self.bodies.number + 1
        own = rise_of_bodies(self.parts, x, to)
        total = sum_by(own.flatten(0, 1), self.bodies.of_body[:, :-1].reshape(-1), rows)
        if self.scenes.fields.floor_lag.numel():
            total = total + _summed(floor_friction_values, self.scenes, x, to, self.bodies.of, rows)
        for of_pair, values in self._of_pairs:
            total = total + _summed(values, self.scenes, x, to, of_pair, rows)
        return total

    def _fits(self, x: Tensor, to: Tensor) -> Tensor:
        """1 where a vertex may go there as all others go [B, V], less elsewhere; floors count in the potential."""
        f, surface = self.scenes.fields, self.scenes.model.surface_of_contact
        if surface is None:
            return torch.ones_like(x[..., 0])
        none, collider = x.new_zeros((x.shape[0], surface.bodies, 3)), f.collider.detach()
        way = torch.nan_to_num(to - x, 0.0, 0.0, 0.0)  # what is no number is found by the potential
        share, _ = ops_start.advance(x.contiguous(), way, none, f.center, f.origin, collider, collider, f.held, f.body,
                                     f.room, self.scenes.listed, careful=False)  # fmt: skip
        return share


def _summed(
    values: Callable[[Scenes, Tensor], Tensor], scenes: Scenes, x: Tensor, to: Tensor, index: Tensor, rows: int
) -> Tensor:
    """Differences of values between two states, and their sizes, summed by an index, float64 [rows, 2]."""
    before, after = (values(scenes, at).reshape(-1).double() for at in (x, to))
    return sum_by(torch.stack([after - before, before.abs() + after.abs()], 1), index, rows)


def connected_rows(one: Tensor, two: Tensor, count: int) -> Tensor:
    """The least of the rows that pairs (one, two) [n] join, directly or by others, of each of so many [count]; on CUDA,
    which must not look, after rounds that are enough for any but strange graphs."""
    least = torch.arange(count, device=one.device)
    for _ in range(2 * count.bit_length()):
        low = torch.minimum(least[one], least[two])
        after = least
        for row in (one, two, least[one], least[two]):  # ends of pairs, and the least that they have known
            after = after.scatter_reduce(0, row, low, "amin")
        after = after[after]
        if not one.is_cuda and torch.equal(after, least):
            break
        least = after
    return least
