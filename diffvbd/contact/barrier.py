"""Contact between bodies, with oneself and with colliders: the barrier of pairs, and friction."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from ..checks import check_count, check_number, check_positive, fail
from ..mask import CONTACT

MOST_REACH = 1e6  # [m]; its square must be a number in float32
GAMMA = 0.45  # share of its smallest gap that a vertex may move between two detections; two sides leave a tenth


def _scalars(energy: PairBarrier | Friction, like: Tensor) -> dict[str, Tensor]:
    return {k: torch.as_tensor(getattr(energy, k), dtype=like.dtype, device=like.device) for k in energy.parameters}


@dataclass(frozen=True, eq=False)
class PairBarrier:
    """IPC log barrier b(d) = -kappa (d - dhat)^2 log(d / dhat) between surfaces of a Model's bodies and its colliders.

    Every pair of a point and a triangle and of two edges counts once, with d their distance, whatever features are
    closest; edges that become parallel are mollified. From a start without intersections no executed sweep lets two
    surfaces cross, at any speed and any number of sweeps: between two detections a vertex moves by at most ``gamma``
    times its smallest gap, relative to a common translation of the bodies that are near each other. What a bound cuts
    off is lost as velocity (see :func:`diffvbd.contact.status`). Two places of one body that coincide at rest (a crack,
    doubled vertices) are never a pair: they may pass through each other.

    Args:
        kappa: Barrier stiffness [N/m].
        dhat: Activation distance [m]. Pairs of one body that are closer at rest use 0.9 of their rest distance.
        self_contact: Pairs within a body.
        between_bodies: Pairs of different bodies. Pairs with colliders always count.
        damping: Damping of approaching motion of pairs that started the step closer than dhat [N s/m].
        detections: R >= 1: how often pairs are searched and bounds renewed within a step. Sweeps, prescribed vertices
            and moving colliders advance in R parts.
        reach: Distance up to which pairs are searched [m] > dhat; it caps the motion between two detections at
            min(gamma reach, (reach - dhat) / 2). None: the larger of 2 dhat and half the mean edge of the surface.
        gamma: In (0, 0.5).
        capacity: Pairs that fit, per scene on average. None: 16 for each vertex of the surface, at least 8192 in all.

    Differentiable as ``pair_barrier.kappa`` and ``pair_barrier.damping`` (scalars).

    Raises:
        ValueError, TypeError: For numbers out of range.

    Source: Li et al. (2020) for the barrier; bounds after the idea of offset geometric contact (Chen et al. 2025);
    docs/method.md, section 12.
    """

    name: ClassVar[str] = "pair_barrier"
    bit: ClassVar[int] = CONTACT
    parameters: ClassVar[dict[str, int]] = {"kappa": 0, "damping": 0}

    kappa: float = 400.0
    dhat: float = 0.02
    self_contact: bool = True
    between_bodies: bool = True
    damping: float = 0.0
    detections: int = 2
    reach: float | None = None
    gamma: float = GAMMA
    capacity: int | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "kappa", check_number("kappa", self.kappa))
        object.__setattr__(self, "dhat", check_positive("dhat", self.dhat, "m"))
        object.__setattr__(self, "damping", check_number("damping", self.damping))
        for name in ("self_contact", "between_bodies"):
            if not isinstance(getattr(self, name), bool):
                raise TypeError(f"{name}: expected a bool, got {type(getattr(self, name)).__name__}")
        check_count("detections", self.detections, 1, 1000)
        if self.reach is not None and check_positive("reach", self.reach, "m") <= self.dhat:
            fail("reach", f"more than dhat = {self.dhat:g} m", self.reach)
        for name, length in (("dhat", self.dhat), ("reach", self.reach or 0.0)):
            if length > MOST_REACH:
                fail(name, f"at most {MOST_REACH:g} m", length)
        if check_positive("gamma", self.gamma) >= 0.5:
            fail("gamma", "a number in (0, 0.5): two sides may both move", self.gamma)
        if self.capacity is not None:
            check_count("capacity", self.capacity, 1, 2**26)

    def constants(self, like: Tensor) -> dict[str, Tensor]:
        return _scalars(self, like)


@dataclass(frozen=True, eq=False)
class Friction:
    """Friction of everything that touches: floors (FloorBarrier), pairs and colliders (PairBarrier).

    The smooth friction potential of IPC: normal forces, normals and weights are those of the start of the step, all
    differentiated; below ``velocity`` [m/s] the force fades linearly to zero, so that a sticking contact creeps at a
    fraction of it.

    Args:
        coefficient: mu_f >= 0.
        velocity: eps_v > 0 [m/s].

    Differentiable as ``friction.coefficient`` (scalar).

    Source: Li et al. (2020), section 5; docs/method.md, section 12.
    """

    name: ClassVar[str] = "friction"
    bit: ClassVar[int] = CONTACT
    parameters: ClassVar[dict[str, int]] = {"coefficient": 0}

    coefficient: float = 0.5
    velocity: float = 1e-3

    def __post_init__(self) -> None:
        object.__setattr__(self, "coefficient", check_number("coefficient", self.coefficient))
        object.__setattr__(self, "velocity", check_positive("velocity", self.velocity, "m/s"))

    def constants(self, like: Tensor) -> dict[str, Tensor]:
        return _scalars(self, like)
