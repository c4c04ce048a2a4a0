"""Pilot runs: the same motion with other settings, and how far apart two of them are."""

from __future__ import annotations

import functools
import inspect
import logging
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from ..checks import check_positive, fail
from ..model.inputs import MODULI, sorted_inputs
from ..model.model import Model
from ..model.solver import VBD
from ..model.system import system_of
from ..said import silence
from ..scopes import record_to, refined, refuse_transforms
from ..step.arguments import GRAVITY, Prepared, material_of, prepare
from .between import SWINGS, unseen
from .checks import NONE
from .energy_check import mechanical_energy
from .prediction import on
from .reference import unbalanced
from .trajectory import PerStep, StepAverage, Trajectory, refuse_average

LOGGER = logging.getLogger("diffvbd")
SHORTEST = 1e-3  # of the duration: the step that is taken to see whether arguments are good
FRAMES = 4  # at which two runs are compared, equally spaced over the duration
STILL = 1e-4  # of the size of the scene: a motion below it counts as one of this size
NO_PART = 1e-8  # of quantity over modulus: a gradient below it counts as one of this size
LOADS = ("force", "gravity")
MOVING = ("prescribed", "colliders")
Quantity = Callable[[Tensor, Tensor], Tensor]


@dataclass
class Pilot:
    """A run: its frames, and what it took."""

    settings: VBD
    steps: int
    x: Tensor | None  # [FRAMES + 1, ..., V, 3], the first is the start; None: it failed
    v: Tensor | None
    seconds: float
    quantity: Tensor | None = None
    gradient: tuple[Tensor, ...] = ()
    failure: str = ""


@dataclass
class Pilots:
    """Runs of one scene. ``rollout`` is diffvbd.rollout.

    What changes in time is a function of the time [s]: it is asked for loads at the middle of each step, for prescribed
    vertices and colliders at its end.
    """

    rollout: Callable[..., Trajectory]
    model: Model
    x: Tensor
    v: Tensor
    duration: float
    given: dict[str, Any]
    quantity: Quantity | None = None
    wrt: Sequence[str] | None = None  # of the material: gradients with respect to them and a velocity of the whole
    spent: float = 0.0  # [s]
    runs: int = 0
    progress: bool = False  # whether each run is logged
    _ready: set[str] = field(default_factory=set)
    _solves: list[Any] = field(default_factory=list)  # of the last run

    def __post_init__(self) -> None:
        self.duration = check_positive("duration", self.duration, "s")
        limits, h = torch.finfo(self.model.dtype), SHORTEST * self.duration
        if not limits.tiny <= h * h <= limits.max:
            fail("duration", f"a number of seconds of which {SHORTEST:g} is a time step", self.duration)
        for name, value in self.given.items():
            if name in MOVING:
                refuse_average(name, value)
            if isinstance(value, PerStep):
                fail(name, "a value or a function of the time [s], since time steps vary", "per_step")
            if of_time(value) and not _takes(value, 1):
                raise TypeError(
                    f"{name}: expected a function of the time [s] alone, since time steps vary, got one of other "
                    "arguments, such as a rollout takes: lambda t: ... can replace one of the step, not of the state"
                )

    # --- running ------------------------------------------------------------------------------------------------------

    def execute(self, *arguments: Any, **options: Any) -> Trajectory:
        """A rollout as it stands, also inside dv.refine."""
        with refined(None):
            return self.rollout(*arguments, **options)

    def check(self) -> None:
        """One short step: raises what rollout raises of the arguments."""
        h = SHORTEST * self.duration
        given = self.at_steps(dict(self.given), h, 1, 0.0)
        with silence():
            end = self.execute(self.model, self.x, self.v, VBD(h, 1), steps=1, save="last", **given)
        if self.quantity is None:
            return
        leaves = [t[-1].detach().requires_grad_(self.wrt is not None) for t in (end.x, end.v)]
        with torch.set_grad_enabled(self.wrt is not None):
            value = self.quantity(*leaves)
        if not (isinstance(value, Tensor) and value.numel() == 1):
            got = f"shape {list(value.shape)}" if isinstance(value, Tensor) else type(value).__name__
            fail("quantity", "a function that returns a scalar tensor", got)
        if not value.is_floating_point():
            fail("quantity", "a function that returns a floating scalar", f"{value.dtype}")
        if not bool(torch.isfinite(value)):
            fail("quantity", "a finite value after the first step", float(value))
        if self.wrt is None:
            return
        found = torch.autograd.grad(value, leaves, allow_unused=True) if value.requires_grad else (None, None)
        if all(gradient is None for gradient in found):
            fail("quantity", "a function that torch can differentiate, beside gradient=True", "one without a graph")

    def run(self, settings: VBD, steps: int, quarter: int | None = None, start: Pilot | None = None) -> Pilot:
        """``steps`` steps over the whole duration, or a quarter of them from frame ``quarter`` of ``start``."""
        settings = on(settings, steps, self.duration)
        part, first = (steps, 0) if quarter is None else (steps // FRAMES, quarter)
        x, v = (self.x, self.v) if start is None or quarter is None else (start.x[quarter], start.v[quarter])  # type: ignore[index]
        began = first * self.duration / FRAMES
        differentiate = self.wrt is not None and quarter is None
        with silence():
            try:
                self._warm(settings, x, v, began)
                clock = time.perf_counter()
                out = self._rollout(settings, x, v, part, began, FRAMES if quarter is None else 1, differentiate)
                self._wait()
            except (RuntimeError, ValueError, torch.OutOfMemoryError) as error:
                return Pilot(settings, steps, None, None, math.inf, failure=f"{settings}: {error}")
        seconds = time.perf_counter() - clock
        self.spent += seconds
        self.runs += 1
        if self.progress:
            LOGGER.info("trial run %d: %s, %.2g s", self.runs, settings, seconds)
        traj, value, gradient = out
        x, v = traj.x.detach(), traj.v.detach()
        if not bool(torch.isfinite(x[-1]).all()):
            return Pilot(settings, steps, None, None, seconds, failure=f"{settings}: positions that are not finite")
        if value is not None and not bool(torch.isfinite(value)):
            failure = f"{settings}: quantity is {float(value)} after {part} steps"
            return Pilot(settings, steps, None, None, seconds, failure=failure)
        return Pilot(settings, steps, x, v, seconds * steps / part, value, gradient)

    def _rollout(self, settings: VBD, x: Tensor, v: Tensor, steps: int, began: float, frames: int, differentiate: bool
                 ) -> tuple[Trajectory, Tensor | None, tuple[Tensor, ...]]:  # fmt: skip
        model, given, leaves = self.model, dict(self.given), []
        if differentiate:
            # one velocity for all: those of single vertices excite what no time step resolves
            leaves = [torch.zeros(3, dtype=model.dtype, device=model.device, requires_grad=True)]
            for name in self.wrt or ():
                leaf = torch.as_tensor(given[name], dtype=model.dtype, device=model.device).detach().clone()
                leaves.append(leaf.requires_grad_())
                given[name] = leaf
            with torch.enable_grad():
                v = torch.where(model.pinned[:, None], v, v + leaves[0])
        given = self.at_steps(given, settings.time_step, steps, began)
        self._solves = []
        with torch.set_grad_enabled(differentiate), record_to(self._solves, "solve"):
            out = self.execute(model, x, v, settings, steps=steps, save=max(1, steps // frames), checks=NONE, **given)
            value = None if self.quantity is None else self.quantity(out.x[-1], out.v[-1])
            gradient = torch.autograd.grad(value, leaves) if leaves else ()  # type: ignore[arg-type]
        return out, None if value is None else value.detach(), gradient

    def _warm(self, settings: VBD, x: Tensor, v: Tensor, began: float) -> None:
        """The first step of a solver arranges what later ones find: it is not timed."""
        key = f"{settings.key} {settings.integrator}"
        if key not in self._ready:
            self._ready.add(key)
            with torch.no_grad():
                self._rollout(settings, x, v, 1, began, 1, False)
            self._wait()

    def _wait(self) -> None:
        if self.x.is_cuda:
            torch.cuda.synchronize(self.x.device)

    def at_steps(self, given: dict[str, Any], h: float, steps: int, began: float) -> dict[str, Any]:
        """Functions of time as the rollout takes them."""

        def timed(function: Callable[[float], Any], share: float) -> Callable[[int, Tensor, Tensor], Any]:
            if isinstance(function, StepAverage):
                return function.over(h, began)
            return lambda step, x, v: function(began + (step + share) * h)

        out = {name: value for name, value in given.items() if value is not None}
        for name, value in given.items():
            if not of_time(value):
                continue
            function: Callable[[float], Any] = value
            if name == "colliders":
                out[name] = PerStep(torch.stack([function(began + (k + 1) * h) for k in range(steps)]))
                out["colliders_before"] = function(began)
            else:
                out[name] = timed(function, 0.5 if name in LOADS else 1.0)
        return out

    def swinging(self, steps: int) -> str:
        """The name of what swings within steps, so that they do not see it; "" if nothing does."""
        for name, value in self.given.items():
            share = 0.5 if name in LOADS else 1.0
            if not of_time(value):
                continue
            clock = time.perf_counter()
            apart = unseen(value, share, steps, self.duration, name in MOVING)
            self.spent += time.perf_counter() - clock
            if apart > SWINGS:
                return name
        return ""

    def left(self) -> float:
        """The force that the last run left over, over its forces [-]."""
        return unbalanced(self._solves)

    # --- comparing ----------------------------------------------------------------------------------------------------

    @cached_property
    def size(self) -> float:
        """Extent of the scene at its start [m]."""
        flat = self.x.detach().reshape(-1, 3)
        return float((flat.amax(0) - flat.amin(0)).norm())

    def motion(self, frames: Tensor) -> Tensor:
        """Root mean square way from the start of each scene [...] [m], over vertices and frames."""
        way = (frames[1:] - self.x.detach()).square().sum(-1).mean((0, -1)).sqrt()
        return way.clamp(min=STILL * self.size)

    def apart(self, a: Tensor, b: Tensor) -> float:
        """Root mean square distance of two runs over the motion of the second, in the worst scene."""
        distance = (a[1:] - b[1:]).square().sum(-1).mean((0, -1)).sqrt()
        worst = float((distance / self.motion(b)).max())
        return worst if math.isfinite(worst) else math.inf

    def gradients_apart(self, a: Pilot, b: Pilot) -> list[float]:
        """Relative distances of the gradients of two runs. With respect to moduli that have no part in the motion, as
        of a body in free fall, they are rounding: what is below a tiny part of quantity over modulus counts as that."""
        out = []
        for name, u, w in zip((None, *(self.wrt or ())), a.gradient, b.gradient, strict=False):
            least = 0.0
            if name is not None and b.quantity is not None:
                modulus = float(torch.as_tensor(self.given[name]).double().norm())
                least = NO_PART * abs(float(b.quantity)) / modulus if modulus > 0 else 0.0
            out.append(relative(u, w, least))
        return out

    def hardest(self, a: Tensor, b: Tensor) -> int:
        """The quarter of the duration in which two runs part most."""
        distance = (a - b).square().sum(-1).flatten(1).mean(1).sqrt()
        return int(distance.diff().argmax())

    @property
    def gravity(self) -> Any:
        return GRAVITY if self.given.get("gravity") is None else self.given["gravity"]

    # --- energy -------------------------------------------------------------------------------------------------------

    @cached_property
    def conserves(self) -> bool:
        """Whether the exact motion keeps its energy, so that what a run loses is what it damps."""
        changing = changes(self.given)
        other = any(self.given.get(name) is not None for name in ("rest_points", "density", "prescribed", "colliders"))
        damped = self.model.friction is not None or any(
            bool((torch.as_tensor(getattr(e, "damping", 0.0)) > 0).any()) for e in self.model.energies
        )
        return not (changing or other or damped)

    @property
    def material_changes(self) -> bool:
        return any(of_time(self.given.get(name)) for name in MODULI)

    @cached_property
    def prepared(self) -> Prepared:
        """The material of the scene, at the start where it changes."""
        return self.prepared_at(0.0)

    def prepared_at(self, time: float) -> Prepared:
        """The material of the scene at a time [s]."""
        given = self.at_steps({name: self.given.get(name) for name in MODULI}, 0.0, 0, time)
        values = {name: value(0, self.x, self.v) if of_time(value) else value for name, value in given.items()}
        system = system_of(self.model, VBD(1.0, 1))
        return prepare(system, tuple(self.x.shape[:-2]), material_of(**values), time_step=1.0, sweeps=1)

    def energy(self, x: Tensor, v: Tensor) -> Tensor:
        """Kinetic, elastic and of loads [...] [J] of each scene; contact, which is short, counts as none."""
        load = self.model.mass.double()[:, None] * torch.as_tensor(self.gravity, device=x.device).double()
        if self.given.get("force") is not None:
            load = load + torch.as_tensor(self.given["force"]).to(load)
        stored = mechanical_energy(system_of(self.model, VBD(1.0, 1)), self.prepared, x, v).reshape(x.shape[:-2])
        return stored - (load * x.double()).sum((-1, -2))

    def lost(self, run: Pilot, seconds: float) -> float:
        """How far the energy E that a run has lost would carry the scene in some seconds, sqrt(2 E / m) t, over its
        motion. Zero where energy says nothing."""
        if not self.conserves or run.x is None or run.v is None:
            return 0.0
        lost = (self.energy(run.x[0], run.v[0]) - self.energy(run.x[-1], run.v[-1])).clamp(min=0)
        mass = float(self.model.mass[~self.model.pinned].sum())
        way = (2 * lost / max(mass, 1e-300)).sqrt() * seconds
        return float((way / self.motion(run.x)).max())


def pilots_of(rollout: Callable[..., Trajectory], model: Model, x: Tensor, v: Tensor, duration: float,
              quantity: Quantity | None, gradient: bool, given: dict[str, Any], progress: bool = False
              ) -> Pilots:  # fmt: skip
    """Pilot runs of a scene, with the gradients that are asked for. A first short step has raised what rollout raises
    of the arguments."""
    refuse_transforms("dv.advise and dv.error_budget, which look at values")
    sorted_inputs(model, given)
    if not isinstance(gradient, bool):
        raise TypeError(f"gradient: expected a bool, got {type(gradient).__name__}")
    if gradient and torch.is_inference_mode_enabled():
        fail("gradient", "False inside torch.inference_mode(), which records nothing", "True")
    if quantity is not None and not callable(quantity):
        raise TypeError(f"quantity: expected a function of x and v, got {type(quantity).__name__}")
    if quantity is not None and not _takes(quantity, 2):
        raise TypeError("quantity: expected a function of the last state, lambda x, v: ..., got one of other arguments")
    if x.numel() == 0:
        fail("x", "a scene with a vertex, whose motion can be judged", f"shape {list(x.shape)}")
    x, v = x.detach(), v.detach()
    if gradient and quantity is None:
        quantity = _mean_squared_way(x)
    material = [name for name in MODULI if given.get(name) is not None]
    wrt = [name for name in material if not of_time(given[name])]
    given = {name: value.detach() if isinstance(value, Tensor) else value for name, value in given.items()}
    pilots = Pilots(rollout, model, x, v, duration, given, quantity, wrt if gradient else None, progress=progress)
    pilots.check()
    return pilots


def of_time(value: Any) -> bool:
    return callable(value) and not isinstance(value, Tensor)


def _takes(function: Callable[..., Any], count: int) -> bool:
    """Whether a function can be called with so many arguments; True where Python does not know."""
    try:
        inspect.signature(function).bind(*range(count))
    except TypeError:
        return False
    except ValueError:
        pass
    return True


def changes(given: dict[str, Any]) -> bool:
    """Whether anything that is given changes in time."""
    return any(map(of_time, given.values()))


def _mean_squared_way(start: Tensor) -> Quantity:
    return lambda x, v: (x - start).square().sum(-1).mean()


def converted(value: Any, **to: Any) -> Any:
    """Tensors, those in a dict and what functions of time return, on another device or of another floating dtype."""
    if isinstance(value, Tensor):
        floats = value.is_floating_point()
        return value.to(**{name: kind for name, kind in to.items() if floats or name != "dtype"})
    if isinstance(value, dict):
        return {name: converted(part, **to) for name, part in value.items()}
    if isinstance(value, StepAverage):
        return value.then(lambda found: converted(found, **to))
    if not callable(value):
        return value

    @functools.wraps(value)  # with its arguments, by which policies are told from functions of time
    def made(*at: Any) -> Any:
        return converted(value(*at), **to)

    return made


def relative(a: Tensor, b: Tensor, least: float = 0.0) -> float:
    """|a - b| / |b|, of which |b| counts as ``least`` at least."""
    size = max(float(b.norm()), least)
    apart = float((a - b).norm())
    return 0.0 if apart == 0 else apart / size if size > 0 else math.inf
