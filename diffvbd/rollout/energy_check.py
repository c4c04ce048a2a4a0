"""What a rollout says of its energy: more than there can be."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from ..energies import Anchor
from ..mask import ELASTIC
from ..model.rest import rest_metric
from ..model.system import System
from ..said import is_silent, page, percent, warn
from ..scopes import looks_at, may_copy
from ..step.arguments import Prepared, acceleration_of
from ..step.met import outcomes
from ..step.predict import energy_data

GAIN = 0.05  # of the energy that a scene had and that gravity gave it, which a rollout may gain without a word
GAIN_PRESSED = 1.0  # the same where barriers push at the start: what they hold comes in
MANY = 100.0  # times as much as there was: then the gain is said in J, since there may have been next to nothing
LOOKS, LOOKS_ON_FLOOR, LOOKS_TOUCHING = 6, 12, 64  # at a rollout, unasked
LEAST_STEPS = 10  # of a rollout that is looked at unasked: its looks cost as much as some steps
CHUNKS, LEAST_CHUNK = 8, 256  # of the tets, one after another, so that a look needs little memory
ROUNDING = 64.0  # times the energy of strains that are rounding


# What of the tets, chunk by chunk, no look changes: mu, lam, rest scalars [7, 1 | B, t] and corners [4, t].
_Chunk = tuple[Tensor, Tensor, Tensor, Tensor]


def _elastic_of(model: System, prepared: Prepared) -> Iterator[_Chunk]:
    chunk = max(LEAST_CHUNK, -(-model.num_tets // CHUNKS))
    for first in range(0, model.num_tets, chunk):
        rows = slice(first, first + chunk)
        mu, lam = (m[:, rows].double() if m.shape[1] > 1 else m.double() for m in (prepared.mu, prepared.lam))
        rest = _rest_of(model, prepared, rows).double().movedim(-1, 0).contiguous()
        yield mu, lam, rest, model.tets[rows].T.contiguous()


@dataclass
class EnergyLook:
    """Energy of a rollout that nothing but gravity drives, at its start and after some of its steps, [B] each."""

    model: System
    prepared: Prepared
    gravity: Tensor
    start: Tensor
    had: Tensor  # at the start: kinetic and elastic energy, and what gravity does over the scene's length [J]
    at: frozenset[int]  # numbers of steps that are looked at, the first among them
    elastic: list[_Chunk] | None
    pressed: Tensor  # scenes in which barriers push at the start, bool [B]; of pairs known after a step
    found: dict[int, Tensor] = field(default_factory=dict)

    def see(self, step: int, x: Tensor, v: Tensor) -> None:
        """After a step; one that runs again is not seen twice."""
        if step in self.at and step not in self.found:
            with torch.no_grad(), torch.autocast(x.device.type, enabled=False):
                if not self.found and self.model.contact is not None and self.model.model in outcomes:
                    self.pressed = self.pressed | (outcomes[self.model.model].smallest[0] < self.model.contact.dhat)
                energy = mechanical_energy(self.model, self.prepared, x.detach(), v.detach(), self.elastic)
                way = (x.detach().double() - self.start.double()) * self.gravity.double()
                mass = _free_mass(self.model, self.prepared)
                fallen = (mass * way.sum(-1).reshape(-1, mass.shape[-1])).sum(-1)  # what gravity has done [J]
                self.found[step] = torch.stack([energy, fallen])

    def warn(self) -> None:
        """Warns (UserWarning) of a gain."""
        energy, fallen = torch.stack(list(self.found.values())).unbind(1)  # [looks, B]
        begun, room = self.had[:2]
        gain = (energy - begun - fallen) / (begun + room + fallen.abs().amax(0)).clamp(min=math.ulp(0.0))
        past = gain - torch.where(self.pressed, GAIN_PRESSED, GAIN)
        if not float(past.max()) > 0:
            return
        look, scene = divmod(int(past.argmax()), gain.shape[-1])
        most, all_of = float(gain[look, scene]), float((begun + room + fallen.abs().amax(0))[scene])
        size = f"{percent(most)} of the energy that it had and that gravity gave it"
        if most > MANY:
            size = f"{most * all_of:.3g} J, where it had and gravity gave it {all_of:.3g} J"
        of = f"scene {scene}" if gain.shape[-1] > 1 else "the scene"
        faster = "" if self.model.coarse is not None else ', subspace="coarse"'
        pressed = ""
        if bool(self.pressed[scene]):
            pressed = ", unless bodies were closer than dhat at the start, where barriers push them apart: start them "
            pressed += "farther apart, or take a smaller dhat"
        warn(
            f"sweeps: after step {list(self.found)[look]} {of} has gained {size}: the sweeps have not converged"
            f"{pressed}; take more sweeps{faster} or a smaller time_step; " + page("numerics.md"),
        )


def look_at_energy(asked: bool | None, model: System, x: Tensor, v: Tensor, steps: int, prepared: Prepared | None,
                   gravity: Any) -> EnergyLook | None:  # fmt: skip
    """A look at a rollout of so many steps that nothing but gravity drives, or None where nobody asks for one.

    prepared: Arguments that all steps share; None: there are none, and nothing is looked at.
    """
    if (
        asked is False
        or is_silent()
        or steps == 0
        or x.numel() == 0
        or prepared is None
        or not model.energy_mask & ELASTIC
    ):
        return None
    if any(isinstance(e, Anchor) for e in model.energies):  # springs
        return None
    if asked is None:
        if x.is_cuda or not looks_at(x) or steps < LEAST_STEPS:
            return None
    if not looks_at(x) and not may_copy(x):
        return None
    given = (x, v, prepared.mu, prepared.lam, prepared.mass)
    taped = torch.is_grad_enabled() and any(t.requires_grad for t in given)
    with torch.no_grad(), torch.autocast(x.device.type, enabled=False):
        start, pull = x.detach(), acceleration_of(gravity, x).detach()
        size = (start.amax(-2) - start.amin(-2)).double().norm(dim=-1).reshape(-1)  # [B]
        room = _free_mass(model, prepared).sum(-1) * pull.double().norm(dim=-1).amax() * size
        elastic = None if taped else list(_elastic_of(model, prepared))  # a tape should be all that a rollout keeps
        begun = mechanical_energy(model, prepared, start, v.detach(), elastic)
        had = torch.stack([begun, (room + _rounding(model, prepared, start)).expand_as(begun)])
        pressed = torch.zeros_like(begun, dtype=torch.bool)
        if model.floor is not None:
            planes = energy_data(model, prepared, None)[:, : model.floor.count()]
            gap, _, _, dhat = model.floor.gaps(start.reshape(-1, *start.shape[-2:]), planes, None)
            pressed = pressed | (gap < dhat).flatten(1).any(-1)
        return EnergyLook(model, prepared, pull, start, had, _looked_at(asked, model, steps), elastic, pressed)


def _looked_at(asked: bool | None, model: System, steps: int) -> frozenset[int]:
    """Which of so many steps: all where one asks; where bodies may hit something, whose gain may be over in a step, as
    many as cost little beside such steps; else most of them early, when what a start has too much of comes out."""
    meets = model.touches or model.floor is not None
    looks = LOOKS_TOUCHING if model.touches else LOOKS_ON_FLOOR if meets else LOOKS
    count, power = (steps, 1) if asked else (min(steps, looks), 1 if meets else 2)
    return frozenset(round(1 + (steps - 1) * (k / max(1, count - 1)) ** power) for k in range(count))


def _free_mass(model: System, prepared: Prepared) -> Tensor:
    """Mass of what can move [kg], float64 [1 | B, V]."""
    return torch.where(model._pinned, 0.0, prepared.mass.double())


def mechanical_energy(model: System, prepared: Prepared, x: Tensor, v: Tensor, elastic: list[_Chunk] | None = None
                      ) -> Tensor:  # fmt: skip
    """Kinetic and elastic energy of each scene [J], float64 [B]; the rest shape has none of the latter.

    With the rest scalars k_ab and c6 of docs/method.md, section 2, E = -mu/2 sum_ab k_ab |x_a - x_b|^2
    + V [(mu + lam)/2 (J - 1)^2 - mu (J - 1) - 3/2 mu], J = c6 det(x_1 - x_0, x_2 - x_0, x_3 - x_0), V = 1/(6 c6).
    """
    x, v = (t.reshape(-1, *t.shape[-2:]).double() for t in (x, v))
    moving = 0.5 * (_free_mass(model, prepared) * v.square().sum(-1)).sum(-1)
    total, rows = torch.zeros_like(moving), x.permute(2, 0, 1).contiguous()  # [3, B, V]
    for mu, lam, rest, tets in _elastic_of(model, prepared) if elastic is None else elastic:
        corners = rows[:, :, tets].transpose(1, 2)  # [3, 4, B, t]: long rows are quick
        edges = corners[:, 1:] - corners[:, :1]
        others = edges[:, [1, 2, 2]] - edges[:, [0, 0, 1]]  # from 1 and 2 to 2 and 3
        shear = -(rest[:6] * torch.cat([edges, others], 1).square_().sum(0)).sum(0)
        c6 = rest[6]
        change = c6 * (edges[:, 0] * torch.linalg.cross(edges[:, 1], edges[:, 2], dim=0)).sum(0) - 1
        volume = 1 / (6 * c6)
        density = 0.5 * mu * (shear - 3 * volume) + volume * (0.5 * (mu + lam) * change.square() - mu * change)
        total = total + density.sum(-1)
    return moving + total


def _rest_of(model: System, prepared: Prepared, rows: slice) -> Tensor:
    """Rest scalars of some tets, [1 | B, t, 7]. A Model that does not keep them is not made to."""
    if prepared.rest is not None:
        return prepared.rest[:, rows]
    if "rest" in model.model._derived:
        return model.rest_scalars[:, rows]
    return rest_metric(model._rest_points[None, model.tets[rows]])[0]


def _rounding(model: System, prepared: Prepared, x: Tensor) -> Tensor:
    """Elastic energy of strains that rounding of the positions makes [J], float64 [1 | B]."""
    volume = torch.tensor(model.mesh.volume, device=x.device)
    strain = torch.finfo(x.dtype).eps * x.abs().amax().double() / volume.pow(1 / 3)
    modulus = prepared.lam.double() + 2 * prepared.mu.double()
    return ROUNDING * (volume * modulus * (strain.square() + torch.finfo(torch.float64).eps)).sum(-1)
