"""Checks: what a rollout looks at."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from .. import ops
from .._common.checks import check_bool, init_names_checked
from .._common.constants import ELASTIC
from .._common.context import is_captured, is_silent, looks_at, may_copy, replaced
from .._common.messages import page, percent, warn
from ..adjoint.contact import StepContact
from ..laws.tets import energy
from ..model.material import rest_metric
from ..model.model import Model
from ..model.solver import Integrator
from ..model.system import System
from ..ops import SweepSettings
from ..step.arguments import Prepared, acceleration_of, collider_state
from ..step.contact import TRUNCATED
from ..step.integrators import Solve
from ..step.predict import begin, energy_data
from ..step.residual import (
    UNBALANCED_FRICTION,
    Unsolved,
    check_estimable,
    contact_of_step,
    friction_left_over,
    potential_of_step,
    truncated_fraction,
    unsolved,
    what_helps,
)
from ..step.warnings import FAR, fault_of, reach_of, size_of, warn_of_bending


@init_names_checked
@dataclass(frozen=True)
class Checks:
    """Checks of a rollout. Each warns (UserWarning), every time, in one sentence that says what to do.

    A rollout that ends with what is not finite, or too far away, always warns.

    Args:
        start: With a PairBarrier, raise where surfaces intersect at the start: edges through triangles, or vertices
            behind a Plane. Contact keeps apart what is apart, and no step notices what is not. It costs a quarter of
            one detection or less on the CPU and, on CUDA, waits for the device once. Under torch.compile, and while a
            CUDA graph is captured, nothing is checked: run the rollout once before the capture. On the CPU it also
            warns where all tets of a body are inverted, and with a PairBarrier where a body goes by more than its own
            size in a step.
        energy: Whether to warn where a scene that only gravity drives has 5 % more energy than it began with and
            gravity gave it; where, without pairs, the sweeps leave the motion off by an estimated 2 %; where thin tets
            bend. True: energy after any step, which with pairs costs about a step. None: on the CPU, of ten steps or
            more, after six of them, most of them early (with a floor 12, with contact up to 64), and that of barriers
            only where the rest is largest.
        contact: Whether to warn where pairs truncated the motion of more than 1 % of vertices in a step, or one of up
            to four, the last among them, left more than 5 % of what friction can bear unbalanced. None: on the CPU,
            after ten steps or more. A look at friction costs about a step and on CUDA waits for the device; nothing
            that is compiled or captured is looked at.
        errors: Also return how far from converged each step ends (:class:`diffvbd.results.ErrorEstimate`). Each step is
            swept twice for it, the second time without a tape, once under every schedule; states and gradients are the
            same.

    Raises:
        TypeError: What is no bool (or, for energy and contact, None).
    """

    start: bool = True
    energy: bool | None = None
    contact: bool | None = None
    errors: bool = False

    def __post_init__(self) -> None:
        for name in ("start", "errors"):
            check_bool(name, getattr(self, name))
        for name in ("energy", "contact"):
            if not isinstance(getattr(self, name), bool | None):
                raise TypeError(f"{name}: expected a bool or None, got {type(getattr(self, name)).__name__}")


NONE = Checks(start=False, energy=False, contact=False)


def check_checks(checks: Any, model: Any) -> Checks:
    """The checks of a rollout; None stands for the default ones."""
    if checks is None:
        return Checks()
    if not isinstance(checks, Checks):
        raise TypeError(f"checks: expected a diffvbd.Checks or None, got {type(checks).__name__}")
    if checks.errors and isinstance(model, Model):
        check_estimable(model, "errors")
    return checks


# --- what every rollout says of its end -------------------------------------------------------------------------------

WRONG = 0.02  # of the motion: an estimate above it is warned of; impacts were off by two to five times as much
MADE_GOOD = 2.5  # with coarse corrections the next steps make good most of an error: it was 1 / 2.4 to 1 / 40 as large
UNSEEN = 1e-6  # of the Model's size: by less nothing is wrong
LEAST_STEPS = 10  # of a rollout that is looked at unasked: a look costs as much as some steps
EVERY, MOST = 75, 4  # steps between two looks, and looks at most, beside that at the hardest step
SMALLER = "take a smaller time_step, more sweeps, or float64"
ENDED = "ended"  # of a Model's _derived, on CUDA: how its latest rollouts ended, on the way to the host


@dataclass
class EndLook:
    """Looks at some steps of a rollout, the last among them, and the one in which forces did most.

    A share e of what forces do in a step is left out by its sweeps, or comes on top of it. Over a time T it moves the
    end by e a T^2 / 2, where a is the acceleration, and a vibration of frequency w out of its phase by e w T / 2; with
    w^2 = a over the way the two are the same estimate, of the motion's relative error.
    """

    model: System
    integrator: Integrator
    start: tuple[Tensor, ...]  # positions and velocities
    steps: int
    time_step: float
    asked: bool  # whether to look at more than whether the end is lost
    at: frozenset[int]  # steps whose sweeps are looked at
    kept: dict[int, tuple[Solve, Tensor]] = field(default_factory=dict)
    hardest: tuple[int, float] = (0, 0.0)  # a step, and by how much its velocities changed, root sum of squares
    forced: float = 0.0  # sum of the squares of that
    seen: int = 0
    last: tuple[Prepared, Tensor, Any] | None = None  # of the latest step: arguments, velocities before it, force

    def see(self, step: int, prepared: Prepared, force: Any, solve: Solve, before: Tensor, x: Tensor, v: Tensor
            ) -> None:  # fmt: skip
        """After a step from velocities ``before``; one that runs again is not seen twice."""
        if step <= self.seen:
            return
        self.seen, self.last = step, (prepared, before, force)
        if not self.at:
            return
        change = float(torch.dist(v.detach(), before.detach()))
        self.forced += change * change
        harder = change > self.hardest[1]
        if not harder and step not in self.at:
            return
        if harder:
            if self.hardest[0] not in self.at:
                self.kept.pop(self.hardest[0], None)
            self.hardest = (step, change)
        self.kept[step] = (_detached(solve), x.detach())

    def warn(self, x: Tensor, v: Tensor, gravity: Any) -> None:
        """Warns (UserWarning) of the end of a rollout."""
        model, duration = self.model, self.steps * self.time_step
        with torch.no_grad():
            reach = reach_of(model, self.start, x, gravity, duration)
            good = torch.stack([torch.isfinite(x).all() & torch.isfinite(v).all(), reach <= FAR])
        if not looks_at(x) and not self.asked:
            _say_later(model, good)
            return
        finite, near = good.tolist()
        if not (finite and near):
            _warn_of_loss("the rollout", finite, self.fault())
            return
        if self.at:
            self._warn_of_sweeps(duration)
        if self.asked:
            warn_of_bending(model, x)

    def forget(self) -> None:
        """Lets go of tensors, which a segment that runs again in a backward would keep."""
        self.kept, self.last, self.start = {}, None, ()

    def fault(self) -> str:
        """Cause of a lost state after the latest step."""
        if self.last is None or not looks_at(self.last[1]):
            return SMALLER
        return fault_of(self.model, self.last[0], self.integrator, *self.last[1:])

    def explain(self, error: Exception, x: Tensor, v: Tensor) -> str:
        """The end of a message of a step that refuses the state that earlier ones have left."""
        if self.last is None or not str(error).startswith(("x:", "v:", "x, v:")) or not looks_at(x):
            return ""
        largest = float(torch.stack([(x - self.start[0]).abs().amax(), v.abs().amax()]).amax())
        if largest <= FAR * size_of(self.model):
            return ""
        return f", which the steps before made; {self.fault()}"

    def _warn_of_sweeps(self, duration: float) -> None:
        known: dict[tuple[int, int], np.ndarray] = {}
        found: list[Unsolved] = []
        way = 0.0
        for solve, x in self.kept.values():
            if (one := unsolved(self.model, solve, x, known)) is not None:
                found.append(one)
            way = max(way, float(torch.dist(x, self.start[0].detach())))
        forced = math.fsum(u.forced**2 for u in found)
        left = math.fsum(u.error**2 for u in found)
        if not left > 0:
            return
        share = math.sqrt(left / forced) if forced > 0 else math.inf
        acceleration = math.sqrt(self.forced / self.steps) / self.time_step
        error = share * max(1.0, 0.5 * duration * math.sqrt(acceleration / way) if way > 0 else 1.0)
        error /= 1.0 if self.model.coarse is None else MADE_GOOD
        share_of_way = error * way / math.sqrt(self.start[0][..., 0].numel())
        distance = max(self.steps * math.sqrt(left / len(found)), share_of_way)
        if not (error > WRONG and distance > UNSEEN * size_of(self.model)):
            return
        worst = max(found, key=lambda u: u.error)
        of = f", worst in body {worst.body}" if int(self.model.body.max()) else ""
        of += f" of scene {worst.scene}" if worst.scene else ""
        faster = "" if self.model.coarse is not None else ', subspace="coarse"'
        warn(f"sweeps: they leave steps unsolved{of}, and the motion may be off by some {percent(min(error, 1.0))}; "
             f"take more sweeps{faster} or a smaller time_step, and compare; {page('numerics.md')}")  # fmt: skip


def _detached(solve: Solve) -> Solve:
    given = {k: t.detach() if isinstance(t, Tensor) else t for k, t in solve.given.items()}
    return replaced(solve, x=solve.x.detach(), v=solve.v.detach(), given=given)


def look_at_end(asked: bool | None, model: System, integrator: Integrator, x: Tensor, v: Tensor, steps: int,
                settings: SweepSettings) -> EndLook | None:  # fmt: skip
    """A look at a rollout; None where nothing may be looked at."""
    if steps == 0 or x.numel() == 0 or is_silent() or not (looks_at(x) or may_copy(x)):
        return None
    looked = asked is not False and (asked or (not x.is_cuda and steps >= LEAST_STEPS))
    looked = bool(looked and settings.sweeps and model.num_moving and model.energy_mask & ELASTIC)
    count = 0 if not looked or model.contact is not None else max(1, min(MOST, steps // EVERY))
    at = frozenset(round(steps * k / count) for k in range(1, count + 1))
    return EndLook(model, integrator, (x, v), steps, settings.numbers.time_step, looked, at)


# --- on CUDA, where looking waits for the device ----------------------------------------------------------------------


def _say_later(model: System, good: Tensor) -> None:
    """Copies an answer to the host meanwhile; the Model's next rollout that finds it there says what it was."""
    said = torch.empty(2, dtype=torch.bool, pin_memory=True)
    said.copy_(good, non_blocking=True)
    done = torch.cuda.Event()
    done.record(torch.cuda.current_stream(good.device))
    model._derived.setdefault(ENDED, []).append((said, done))


def warn_of_last_end(model: System, x: Tensor) -> None:
    """Warns of the Model's rollouts before this one, on CUDA, as far as they are done."""
    if not model._derived.get(ENDED) or not may_copy(x):
        return
    ends = [(said, done.query()) for said, done in model._derived[ENDED]]
    model._derived[ENDED] = [end for end, (_, there) in zip(model._derived[ENDED], ends, strict=True) if not there]
    for said, there in ends:
        if there and not bool(said.all()):
            _warn_of_loss("a rollout of this Model before this one", bool(said[0]), SMALLER)
            return


def _warn_of_loss(which: str, finite: bool, fault: str) -> None:
    how = f"vertices more than {FAR:g} body sizes from where motion and gravity would have taken them"
    if not finite:
        how = "positions or velocities that are not finite"
    warn(f"x: {which} ended with {how}: {fault}; diffvbd.testing.debug_checks() says in which step what is not finite "
         "began; " + page("numerics.md"))  # fmt: skip


# --- what a rollout says of its energy --------------------------------------------------------------------------------

GAIN = 0.05  # of the energy that a scene had and that gravity gave it, which a rollout may gain without a word
MANY = 100.0  # times as much as there was: then the gain is said in J, since there may have been next to nothing
LOOKS, LOOKS_ON_FLOOR, LOOKS_TOUCHING = 6, 12, 64  # at a rollout, unasked
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


class Gain(NamedTuple):
    """What scenes have most gained [B], and how."""

    energy: Tensor  # of what counts at each look, less what gravity has done [J]
    step: Tensor  # after which
    x: Tensor  # [B, V, 3]
    fallen: Tensor  # the most that gravity has done [J]


@dataclass
class EnergyLook:
    """Energy of a rollout that nothing but gravity drives, at its start and after some of its steps."""

    model: System
    prepared: Prepared
    gravity: Tensor  # [B, V, 3]
    start: Tensor
    had: Tensor  # at the start [B]: kinetic and elastic energy, and what gravity does over the scene's length [J]
    at: frozenset[int]  # numbers of steps that are looked at, the first among them
    elastic: list[_Chunk] | None
    each: bool  # whether barriers count at each look, not only where the rest of the energy is largest: it costs a step
    most: Gain | None = None
    seen: int = 0

    def see(self, step: int, x: Tensor, v: Tensor) -> None:
        """After a step; one that runs again is not seen twice."""
        if step not in self.at or step <= self.seen:
            return
        self.seen = step
        with torch.no_grad(), torch.autocast(x.device.type, enabled=False):
            x, v = (t.detach().reshape(self.start.shape) for t in (x, v))
            energy = mechanical_energy(self.model, self.prepared, x, v, self.elastic)
            if self.each:
                energy = energy + barrier_energy(self.model, self.prepared, x)
            way = (x.double() - self.start.double()) * self.gravity.double()
            fallen = (_free_mass(self.model, self.prepared) * way.sum(-1)).sum(-1)
            now = Gain(energy - self.had[0] - fallen, torch.full_like(energy, step), x, fallen.abs())
            if (old := self.most) is None:
                self.most = now
                return
            more = now.energy > old.energy
            x = torch.where(more[:, None, None], now.x, old.x)
            energy, step_of = (torch.where(more, *both) for both in zip(now[:2], old[:2], strict=True))
            self.most = Gain(energy, step_of, x, torch.maximum(now.fallen, old.fallen))

    def warn(self) -> None:
        """Warns (UserWarning) of a gain."""
        if (most := self.most) is None:
            return
        with torch.no_grad(), torch.autocast(most.x.device.type, enabled=False):
            first = barrier_energy(self.model, self.prepared, self.start)
            last = 0.0 if self.each else barrier_energy(self.model, self.prepared, most.x)
        given = self.had.sum(0) + first + most.fallen
        gain = (most.energy + last - first) / given.clamp(min=math.ulp(0.0))
        scene = int(gain.nan_to_num(nan=-math.inf).argmax())  # what is lost is said of the end
        largest, all_of, step = (float(t[scene]) for t in (gain, given, most.step))
        if not largest > GAIN:
            return
        size = f"{percent(largest)} of the energy that it had and that gravity gave it"
        if largest > MANY:
            size = f"{largest * all_of:.3g} J, where it had and gravity gave it {all_of:.3g} J"
        of = f"scene {scene}" if len(gain) > 1 else "the scene"
        faster = "" if self.model.coarse is not None else ', subspace="coarse"'
        warn(f"sweeps: after step {step:.0f} {of} has gained {size}: the sweeps have not converged; take more "
             f"sweeps{faster} or a smaller time_step; {page('numerics.md')}")  # fmt: skip


def look_at_energy(asked: bool | None, model: System, x: Tensor, v: Tensor, steps: int, prepared: Prepared | None,
                   gravity: Any, driving: list[str]) -> EnergyLook | None:  # fmt: skip
    """A look at a rollout of so many steps that nothing but gravity drives, or None where nobody asks for one.

    prepared: Arguments that all steps share; None: there are none.  driving: Names of other inputs that drive it. With
    either nothing is looked at, and where one asks a warning says so.
    """
    if asked is False or is_silent() or steps == 0 or x.numel() == 0 or not model.energy_mask & ELASTIC:
        return None
    # springs, and what a user adds, store energy, too
    driving = driving + [type(e).__name__ for e in model.vertex_energies if e is not model.floor]
    if driving or prepared is None:
        if asked:
            cause = ", ".join(driving) or "what changes from step to step"
            warn(f"checks: no look at the energy, to which {cause} may add; {page('numerics.md')}")
        return None
    if asked is None and (x.is_cuda or not looks_at(x) or steps < LEAST_STEPS) or not (looks_at(x) or may_copy(x)):
        return None
    given = (x, v, prepared.mu, prepared.lam, prepared.mass)
    taped = torch.is_grad_enabled() and any(t.requires_grad for t in given)
    with torch.no_grad(), torch.autocast(x.device.type, enabled=False):
        start = x.detach().reshape(-1, *x.shape[-2:])
        pull = ops.broadcast(acceleration_of(gravity, x).detach(), x.shape).reshape(start.shape)
        size = (start.amax(-2) - start.amin(-2)).double().norm(dim=-1)  # [B]
        room = _free_mass(model, prepared).sum(-1) * pull.double().norm(dim=-1).amax(-1) * size
        elastic = None if taped else list(_elastic_of(model, prepared))  # a tape should be all that a rollout keeps
        begun = mechanical_energy(model, prepared, start, v.detach(), elastic)
        had = torch.stack([begun, (room + _rounding(model, prepared, start)).expand_as(begun)])
        # all steps where one asks; where bodies may hit something, whose gain may be over in a step, as many as cost
        # little beside such steps; else most of them early, when what a start has too much of comes out
        meets = model.touches or model.floor is not None
        looks = LOOKS_TOUCHING if model.touches else LOOKS_ON_FLOOR if meets else LOOKS
        count, power = (steps, 1) if asked else (min(steps, looks), 1 if meets else 2)
        at = frozenset(round(1 + (steps - 1) * (k / max(1, count - 1)) ** power) for k in range(count))
        return EnergyLook(model, prepared, pull, start, had, at, elastic, bool(asked))


def _free_mass(model: System, prepared: Prepared) -> Tensor:
    """Mass of what can move [kg], float64 [1 | B, V]."""
    return torch.where(model._pinned, 0.0, prepared.mass.double())


def mechanical_energy(model: System, prepared: Prepared, x: Tensor, v: Tensor, elastic: list[_Chunk] | None = None
                      ) -> Tensor:  # fmt: skip
    """Kinetic and elastic energy of each scene [J], float64 [B]; the rest shape has none of the latter.

    With the rest scalars k_ab and c6 of docs/method.md, section 2, E = -mu/2 sum_ab k_ab |x_a - x_b|^2
    + V [(mu + lam)/2 (J - 1)^2 - mu (J - 1) - 3/2 mu], J = c6 det(x_1 - x_0, x_2 - x_0, x_3 - x_0), V = 1/(6 c6).
    Patches have lam / 2 V_P (J_P - 1)^2 in place of the sum of V lam / 2 (J - 1)^2.
    """
    x, v = (t.reshape(-1, *t.shape[-2:]).double() for t in (x, v))
    moving = 0.5 * (_free_mass(model, prepared) * v.square().sum(-1)).sum(-1)
    total, rows = torch.zeros_like(moving), x.permute(2, 0, 1).contiguous()  # [3, B, V]
    changes: list[Tensor] = []
    for mu, lam, rest, tets in _elastic_of(model, prepared) if elastic is None else elastic:
        corners = rows[:, :, tets].transpose(1, 2)  # [3, 4, B, t]: long rows are quick
        edges = corners[:, 1:] - corners[:, :1]
        others = edges[:, [1, 2, 2]] - edges[:, [0, 0, 1]]  # from 1 and 2 to 2 and 3
        shear = -(rest[:6] * torch.cat([edges, others], 1).square_().sum(0)).sum(0)
        c6 = rest[6]
        if model.law is not None:
            of_tets = energy(model.law.density, corners.permute(2, 3, 1, 0), rest.movedim(0, -1))
            total = total + of_tets.sum(-1)
            continue
        change = c6 * (edges[:, 0] * torch.linalg.cross(edges[:, 1], edges[:, 2], dim=0)).sum(0) - 1
        volume = 1 / (6 * c6)
        stiffness = mu + lam if model.patches is None else mu
        density = 0.5 * mu * (shear - 3 * volume) + volume * (0.5 * stiffness * change.square() - mu * change)
        total = total + density.sum(-1)
        changes.append(change)
    if model.patches is not None and prepared.averaged is not None:
        lam, c6 = (t.double() for t in prepared.averaged)
        change = torch.cat(changes, -1)
        weight = model.patches.sum((lam / (6 * c6)).expand(change.shape))
        total = total + 0.5 * (weight * model.patches.mean(change, c6).square()).sum(-1)
    return moving + total


def barrier_energy(model: System, prepared: Prepared, x: Tensor) -> Tensor:
    """Energy of the barriers of each scene, whose colliders rest, at x [B, V, 3] [J], float64 [B]; 0 where surfaces
    touch, which the next step refuses."""
    where = collider_state(model, x, None, None)
    points = x.new_zeros((len(x), 0, 3)) if where is None else where[1]
    data = energy_data(model, prepared, None)
    try:
        return StepContact(model, data, prepared.parameters, points, points, None, None, 1.0, 0.0).energy(x)
    except ValueError:
        return torch.zeros_like(x[:, 0, 0], dtype=torch.float64)


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


# --- what a rollout says of its contact -------------------------------------------------------------------------------


@dataclass
class ContactLook:
    """Looks at the motion that pairs truncate in the steps of a rollout, and at friction in some of them."""

    model: System
    at: frozenset[int]  # numbers of steps whose friction is looked at, the last among them
    truncated: list[Tensor] = field(default_factory=list)  # truncated_fraction() after each step
    kept: dict[int, tuple[Solve, Tensor]] = field(default_factory=dict)
    seen: int = 0

    def see(self, step: int, solve: Solve, x: Tensor) -> None:
        """After a step; one that runs again is not seen twice."""
        if step <= self.seen:
            return
        self.seen = step
        self.truncated.append(truncated_fraction(self.model))
        if step in self.at:
            self.kept[step] = (_detached(solve), x.detach())

    def warn(self) -> None:
        """Warns (UserWarning) of the steps that were seen."""
        shares = torch.stack(self.truncated).tolist()
        truncated = max(shares)
        if truncated > TRUNCATED:
            many = f"{sum(s > TRUNCATED for s in shares)} of {len(shares)} steps more than {percent(TRUNCATED)}"
            warn(f"contact: pairs truncated {percent(truncated)} of the vertices in step {shares.index(truncated)}, "
                 f"which went less far than they should (in {many}); {what_helps(self.model)}")  # fmt: skip
        left = {step: unbalanced_friction(self.model, *kept) for step, kept in self.kept.items()}
        for step in sorted(left, key=lambda step: -left[step]):
            if not left[step] > UNBALANCED_FRICTION:
                break
            # does what is left over move a body, beside what forces do in a step?
            found = unsolved(self.model, *self.kept[step], {})
            if found is not None and found.error > UNBALANCED_FRICTION * found.forced:
                faster = ' subspace="coarse",' if self.model.coarse is None else ""
                warn(f"friction: {percent(left[step])} of what it can bear is not balanced after step {step}: the "
                     "sweeps have not converged, and the motion may be far off; take more sweeps (100 are cheap in a "
                     f"small scene),{faster} a smaller time_step or a larger Friction(velocity=); "
                     + page("contact.md"))  # fmt: skip
                break
        self.kept = {}  # a segment that runs again keeps nothing


def look_at_contact(asked: bool | None, model: System, x: Tensor, steps: int) -> ContactLook | None:
    """A look at the contact of a rollout of so many steps; None: there is none. A look reads values: never in what is
    compiled, transformed or captured, and on CUDA, where it waits for the device, only where it is asked for."""
    if asked is False or not model.touches or steps == 0 or x.numel() == 0 or torch.compiler.is_compiling():
        return None
    if torch._C._functorch.peek_interpreter_stack() is not None:  # pyright: ignore[reportAttributeAccessIssue]
        return None
    if is_captured(x) if asked else x.is_cuda or not looks_at(x) or steps < LEAST_STEPS or is_silent():
        return None
    count = min(MOST, -(-steps // LEAST_STEPS))  # a look costs about a step
    return ContactLook(model, frozenset(round(steps * k / count) for k in range(1, count + 1)))


def unbalanced_friction(model: System, solve: Solve, x: Tensor) -> float:
    """What a step to x left unbalanced along the contact of a body, over the most that friction can bear there [-], the
    largest; 0 where it cannot be told."""
    if model.friction is None:
        return 0.0
    prepared, given = solve.prepared, solve.given
    with torch.no_grad(), torch.autocast(x.device.type, enabled=False):
        x0, v0, x = (t.detach() for t in (solve.x, solve.v, x))
        begun = begin(model, x0, v0, prepared, given["force"], acceleration_of(given["gravity"], x0),
                      given["prescribed"]).detached()  # fmt: skip
        where = collider_state(model, x0, given["colliders"], given.get("colliders_before"))
        end = x.reshape(begun.y.shape)
        end = end if begun.origin is None else end - begun.origin
        try:
            contact = contact_of_step(model, begun, prepared, where)
            return float(friction_left_over(potential_of_step(model, end, begun, prepared, contact)).max())
        except ValueError:  # a state that is lost; the next step says why
            return 0.0
