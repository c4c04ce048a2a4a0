"""VBD: how a Model is stepped."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, Literal

from .._common.checks import check_count, check_number, check_positive, fail, init_names_checked, is_word
from .coarse import CoarseSpace

PAPER_SATURATION = 0.1  # [m]
PAPER_REGULARIZATION = 1e-6  # [kg]
MAX_SWEEPS = 2**31 - 1


@dataclass(frozen=True)
class ImplicitEuler:
    """One solve over the whole step: first order, and damps what vibrates faster than about the step."""


@dataclass(frozen=True)
class SDIRK2:
    """Two solves over 0.29 of the step each: second order, exact in free fall, L-stable. Twice the work of a step.

    First order in the rotation of a body whose vibrations the step does not resolve: it loses half of the spin that
    implicit Euler does. :class:`BDF2` keeps its order there.

    A body that may touch a floor, a collider, another body or itself takes implicit Euler for a step that does not
    resolve the barrier, and wherever there is damping of contact. Friction is of first order.

    Source: Alexander (1977); docs/method.md, section 19.
    """


@dataclass(frozen=True)
class BDF2:
    """One solve over 2/3 of the step, from the last two states: second order, exact in free fall, L-stable.

    Rollouts keep its history; :func:`diffvbd.step` has none and refuses it. The first step is one of :class:`SDIRK2`. A
    body takes implicit Euler where it does with that, and for the next step.

    Source: Curtiss and Hirschfelder (1952); docs/method.md, section 19.
    """


Integrator = ImplicitEuler | SDIRK2 | BDF2


@init_names_checked
@dataclass(frozen=True)
class VBD:
    """Vertex Block Descent: time step, sweeps, and what a step does besides plain sweeps.

    Immutable; ``dataclasses.replace(solver, sweeps=30)`` makes another one. A Model is not changed by it.

    Args:
        time_step: h [s] > 0. A rollout over ``duration`` takes equal steps of at most this length.
        sweeps: K >= 0, the colored sweeps of each implicit solve, which are executed and differentiated.
        relaxation: omega, 0 < omega < 2, multiplies every update. Above 1 fewer sweeps are needed; use it with the
            exact block or with saturation (docs/numerics.md).
        subspace: Corrections of whole bodies. ``"rigid"``: each free body moves as a whole to where the step's
            potential is least, before and after the sweeps, so that it rests, falls and spins right at any number of
            sweeps (pairs and friction have a correction of their own). ``"coarse"`` or a :class:`diffvbd.CoarseSpace`:
            between the sweeps also smooth deformations of each body, for what is stiff, long, thin or finely meshed.
            None: plain sweeps, apart from the correction of pairs and friction.
        integrator: :class:`diffvbd.ImplicitEuler`, :class:`diffvbd.SDIRK2` or :class:`diffvbd.BDF2`.
        block: ``"exact"`` uses the exact 3x3 block of a vertex (lam + mu along dJ/dx_i): with it every update minimises
            the incremental potential in its vertex. ``"paper"`` uses lam there, which guarantees descent only where
            lam >= mu.
        start: Where the sweeps of bodies without rigid correction start: ``"predictor"`` (y, with gravity and forces),
            ``"inertia"`` (x + h v, right for stiff pinned bodies that few sweeps hardly move) or ``"auto"``: for each
            body and step the one of lower incremental potential; with a coarse subspace x + h v.
        tape: What a step keeps for its backward, per active vertex and sweep (float64): ``"full"`` 72 bytes (104 with a
            floor), ``"compact"`` 24 bytes (32 with a floor), ``"recompute"`` nothing, which runs the step again;
            ``"auto"`` is full while a step's full tape fits 256 MiB, or on CUDA 1/256 of the device's memory if that
            is more, and compact beyond.
        saturation: c [m]: every update d is shortened to c d / (|d| + c). None: off.
        regularization: tau [kg], added to the diagonal of every block. 0: off.

    Attributes:
        prediction: A :class:`diffvbd.results.Prediction` of solvers that :func:`diffvbd.advise` returns; else None.

    Raises:
        ValueError, TypeError: Naming the argument, what was expected and what came.

    Source: paper, sections 2 and 3; docs/method.md.
    """

    time_step: float
    sweeps: int
    relaxation: float = field(default=1.0, kw_only=True)
    subspace: CoarseSpace | Literal["rigid", "coarse"] | None = field(default="rigid", kw_only=True)
    integrator: Integrator = field(default=ImplicitEuler(), kw_only=True)
    block: Literal["exact", "paper"] = field(default="exact", kw_only=True)
    start: Literal["auto", "predictor", "inertia"] = field(default="auto", kw_only=True)
    tape: Literal["auto", "full", "compact", "recompute"] = field(default="auto", kw_only=True)
    saturation: float | None = field(default=None, kw_only=True)
    regularization: float = field(default=0.0, kw_only=True)
    prediction: Any = field(default=None, kw_only=True, compare=False, repr=False)
    key: str = field(default="", init=False, compare=False, repr=False)  # of what a System follows from

    def __post_init__(self) -> None:
        def keep(name: str, value: Any) -> None:
            object.__setattr__(self, name, value)

        keep("time_step", check_positive("time_step", self.time_step, "s"))
        keep("sweeps", check_count("sweeps", self.sweeps, maximum=MAX_SWEEPS))
        keep("relaxation", check_positive("relaxation", self.relaxation))
        if self.relaxation >= 2:
            fail("relaxation", "a number in (0, 2): from 2 on updates increase the potential", self.relaxation)
        if is_word(self.subspace, "coarse"):
            keep("subspace", CoarseSpace())
        if not (self.subspace is None or is_word(self.subspace, "rigid") or isinstance(self.subspace, CoarseSpace)):
            raise TypeError(
                f'subspace: expected "rigid", "coarse", a diffvbd.CoarseSpace or None, got {self.subspace!r}'
            )
        if isinstance(kind := self.integrator, type) and issubclass(kind, Integrator):
            fail("integrator", f"an object, {kind.__name__}()", "the class")
        if not isinstance(kind, Integrator):
            raise TypeError(f"integrator: expected ImplicitEuler(), SDIRK2() or BDF2(), got {type(kind).__name__}")
        for name, words in (("block", ("exact", "paper")), ("start", ("auto", "predictor", "inertia")),
                            ("tape", ("auto", "full", "compact", "recompute"))):  # fmt: skip
            if not is_word(getattr(self, name), *words):
                fail(name, " or ".join(f'"{word}"' for word in words), repr(getattr(self, name)))
        if self.saturation is not None:
            keep("saturation", check_positive("saturation", self.saturation, "m"))
        keep("regularization", check_number("regularization", self.regularization))
        if self.prediction is not None and not hasattr(self.prediction, "told"):
            raise TypeError(f"prediction: expected None, got {type(self.prediction).__name__}: dv.advise sets it")
        if self.coarse is not None and self.block != "exact":
            fail("subspace", 'no coarse space with block="paper"', repr(self.subspace))
        if self.coarse is not None and self.saturation is not None:
            fail(
                "subspace", "no coarse space with saturation, which its corrections would not obey", repr(self.subspace)
            )
        parts = (self.relaxation, self.subspace, self.block, self.start, self.saturation, self.regularization)
        keep("key", f"system {parts}")

    @classmethod
    def paper(cls, time_step: float, sweeps: int, **options: Any) -> VBD:
        """The paper's preset: block="paper", saturation 0.1 m, regularization 1e-6 kg.

        Both constants are absolute: 0.1 m is 33 edges of a 3 mm cube, and 1e-6 kg is 0.15-0.44 of the mass of such a
        cube's vertex, so the preset does not suit small bodies (docs/numerics.md).
        """
        own = {"block": "paper", "saturation": PAPER_SATURATION, "regularization": PAPER_REGULARIZATION}
        return cls(time_step, sweeps, **{**own, **options})

    @property
    def coarse(self) -> CoarseSpace | None:
        """The coarse space of the subspace; None where there is none."""
        return self.subspace if isinstance(self.subspace, CoarseSpace) else None

    def steps(self, duration: float) -> int:
        """Number of steps of a rollout over ``duration`` [s]; an excess over a whole number by rounding is none."""
        return max(1, math.ceil(check_positive("duration", duration, "s") / self.time_step - 1e-6))

    def __str__(self) -> str:
        parts = [f"h = {self.time_step:.3g} s", type(self.integrator).__name__, f"K = {self.sweeps}"]
        parts += [f"relaxation {self.relaxation:g}"] if self.relaxation != 1 else []
        parts += ["coarse"] if self.coarse is not None else []
        parts += ["plain"] if self.subspace is None else []
        parts += ['block="paper"'] if self.block == "paper" else []
        line = ", ".join(parts)
        return line if self.prediction is None else f"{line}\n{self.prediction.told(line)}"
