"""Contact between bodies, with oneself and with colliders: the barrier of pairs, and friction."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from .._common.checks import (
    check_bool,
    check_count,
    check_number,
    check_positive,
    fail,
    init_names_checked,
    real_array,
    refuse_gradients,
)
from .._common.constants import CONTACT
from ..mesh import TetMesh
from ..mesh.tet_mesh import signed_volume
from .colliders import mean_edges, unique_edges
from .faces import mean_area

MOST_REACH = 1e6  # [m]; its square must be a number in float32
# Defaults: dhat over the mean edge of the finest surface; and an impact that closes four fifths of it.
DHAT_OF_EDGE, IMPACT, CLOSED = 0.1, 3.0, 0.8  # -, [m/s], -
LEAST_VELOCITY = 1e-12  # [m/s]; its square times that of a time step must be a number in float32


def _scalars(energy: PairBarrier | Friction, like: Tensor) -> dict[str, Tensor]:
    return {k: torch.as_tensor(getattr(energy, k), dtype=like.dtype, device=like.device) for k in energy.parameters}


@init_names_checked
@dataclass(frozen=True, eq=False)
class PairBarrier:
    """IPC log barrier b(d) = -kappa (d - dhat)^2 log(d / dhat) between surfaces of a Model's bodies and its colliders.

    A point has the barrier of its distance d to the surface of another body, once, however many triangles are near;
    within a body every triangle that is near has one. Where edges cross
    without a vertex near, they have one, too, in full if both are sharp. From a start without intersections no executed
    sweep lets two surfaces cross, at any speed and any number of sweeps: each motion leaves a plane between the sides
    of every pair that could meet, and no vertex goes farther than pairs were looked for. What has been truncated is
    lost as velocity (see :func:`diffvbd.contact.status`). Two places of one body that coincide at rest (a crack,
    doubled vertices) are never a pair: they may pass through each other.

    Args:
        kappa: Barrier stiffness [N/m] of a vertex, and of two edges. None: so stiff that one side of the moving body
            that needs most stops it at 3 m/s within four fifths of dhat.
        dhat: Activation distance [m]. Pairs of one body that are closer at rest use 0.9 of their rest distance. None: a
            tenth of the mean surface edge of the body with the finest surface.
        self_contact: Pairs within a body.
        between_bodies: Pairs of different bodies. Pairs with colliders always count.
        damping: Damping of approaching motion of pairs that started the step closer than dhat [N s/m]. It fades in with
            their normal force N there, by N / (N + kappa dhat / 10), lest a motion jump where a pair comes to be that
            close one step sooner.
        detections: R >= 1: how often pairs are searched within a step. Sweeps, prescribed vertices and moving colliders
            advance in R substeps; what pairs have truncated goes on in the next substep. None: one, and as long as
            pairs truncate motion one more, with as many sweeps, up to eight in all (docs/contact.md). What is
            prescribed then moves in the first substep.
        reach: Distance up to which pairs are searched [m] > dhat; a vertex goes at most (reach - dhat) / 2 between two
            detections, relative to the motion that bodies near each other share. None: that is two mean edges of its
            body.
        capacity: Pairs that fit, per scene on average. None: as many as there are; on CUDA a step that found too little
            room runs again.
        kappa_per_area: Instead of kappa, the stiffness of the barrier over an area [N/m^3]. Each vertex then weighs by
            the area that it bears for, so that a body rests on a surface at the same gap however finely it is meshed
            itself. Vertices of that surface that are near push by their own area. Spheres, capsules and pairs of edges
            weigh as a vertex of mean area. ``kappa`` of the Model's barrier, and the input ``pair_kappa``, are those of
            such a vertex.
        fitted: Whether kappa follows from kappa_per_area, as in a Model.

    Inputs: ``pair_kappa`` and ``pair_damping`` (scalars).

    Raises:
        ValueError, TypeError: For numbers out of range.

    Source: Li et al. (2020) for the barrier, Li et al. (2023) for what counts; planes between sides after Chen et al.
    (2025) and planar division; docs/method.md, section 12.
    """

    name: ClassVar[str] = "pair"
    bit: ClassVar[int] = CONTACT
    parameters: ClassVar[dict[str, int]] = {"kappa": 0, "damping": 0}
    units: ClassVar[dict[str, str]] = {"kappa": "N/m", "damping": "N s/m"}

    kappa: Any = None  # a number in a Model
    dhat: Any = None
    self_contact: bool = True
    between_bodies: bool = True
    damping: float = 0.0
    detections: int | None = None
    reach: float | None = None
    capacity: int | None = None
    kappa_per_area: float | None = None
    fitted: bool = False

    def __post_init__(self) -> None:
        refuse_gradients(self)
        if self.kappa is not None:
            object.__setattr__(self, "kappa", check_number("kappa", self.kappa))
        if self.kappa_per_area is not None:
            object.__setattr__(self, "kappa_per_area", check_number("kappa_per_area", self.kappa_per_area))
            if self.kappa is not None and not self.fitted:
                fail("kappa_per_area", "None, or kappa None", f"{self.kappa_per_area:g} beside kappa = {self.kappa:g}")
        if self.dhat is not None:
            object.__setattr__(self, "dhat", check_positive("dhat", self.dhat, "m"))
        object.__setattr__(self, "damping", check_number("damping", self.damping))
        for name in ("self_contact", "between_bodies", "fitted"):
            check_bool(name, getattr(self, name))
        if self.detections is not None:
            object.__setattr__(self, "detections", check_count("detections", self.detections, 1, 1000))
        if self.reach is not None:
            object.__setattr__(self, "reach", check_positive("reach", self.reach, "m"))
            if self.dhat is not None and self.reach <= self.dhat:
                fail("reach", f"more than dhat = {self.dhat:g} m", self.reach)
        for name, length in (("dhat", self.dhat), ("reach", self.reach)):
            if length is not None and length > MOST_REACH:
                fail(name, f"at most {MOST_REACH:g} m", length)
        if self.capacity is not None:
            object.__setattr__(self, "capacity", check_count("capacity", self.capacity, 1, 2**26))

    def constants(self, like: Tensor) -> dict[str, Tensor]:
        return _scalars(self, like)

    def of_scene(self, mesh: TetMesh, density: np.ndarray, pinned: np.ndarray) -> PairBarrier:
        """The same with numbers for kappa and dhat.

        Args:
            density: Of each tet [T] [kg/m^3].  pinned: bool [V]; a body that is pinned as a whole hits nothing.
        """
        given = None if self.fitted else self.kappa
        if given is not None and self.dhat is not None:
            return self
        finest, load = 1.0, 1.0  # [m], [kg] for each vertex of a side; any will do where nothing can touch
        if mesh.num_tets:
            label, bodies = np.unique(mesh.body, return_inverse=True)[1].reshape(-1), mesh.num_bodies
            edge = mean_edges(mesh.points, unique_edges(mesh.surface), label, bodies)
            mass = np.bincount(label[mesh.tets[:, 0]], density * signed_volume(mesh.points, mesh.tets)[0], bodies)
            side = np.bincount(label[np.unique(mesh.surface)], minlength=bodies) / 6
            moves = np.bincount(label, ~pinned, bodies) > 0
            finest = float(edge[edge > 0].min())
            load = float((mass / np.maximum(side, 1 / 6))[moves if moves.any() else ...].max())
        dhat = self.dhat or min(DHAT_OF_EDGE * finest, (self.reach or np.inf) / 2)
        # m v^2 / 2 = n b of the gap that is left
        kappa = load * IMPACT**2 / 2 / (CLOSED**2 * np.log(1 / (1 - CLOSED)) * dhat**2)
        if self.kappa_per_area is not None:
            kappa = self.kappa_per_area * mean_area(mesh)
        return replace(self, kappa=kappa if given is None else given, dhat=dhat, fitted=self.kappa_per_area is not None)


@init_names_checked
@dataclass(frozen=True, eq=False)
class Friction:
    """Friction of everything that touches: floors (FloorBarrier), pairs and colliders (PairBarrier).

    The smooth friction potential of IPC: normal forces, normals and weights are those of the start of the step, all
    differentiated; below ``velocity`` [m/s] the force fades linearly to zero, so that a sticking contact creeps at a
    fraction of it.

    Args:
        coefficient: mu_f >= 0, one number or a matrix [n, n] of each two of: the bodies of the mesh, the colliders, the
            floor if there is one. It counts in either order, with the mean of both entries.
        velocity: eps_v > 0 [m/s].

    Input: ``friction``, the coefficient: scalar, or what broadcasts to [n, n] where the energy has a matrix.

    Raises:
        ValueError: A coefficient < 0 or not finite, a matrix of another size, a velocity below 1e-12 m/s.
        TypeError: What holds no real numbers, or a tensor that requires grad.

    Source: Li et al. (2020), section 5; docs/method.md, section 12.
    """

    name: ClassVar[str] = "friction"
    bit: ClassVar[int] = CONTACT
    parameters: ClassVar[dict[str, int]] = {"coefficient": 0}
    units: ClassVar[dict[str, str]] = {"coefficient": "-"}

    coefficient: Any = 0.5
    velocity: float = 1e-3

    def __post_init__(self) -> None:
        refuse_gradients(self)
        given = self.coefficient
        if not isinstance(given, (tuple, list)) and getattr(given, "ndim", 0) == 0:
            object.__setattr__(self, "coefficient", check_number("coefficient", given))
        else:
            # a copy: what is done to the caller's matrix later must not change the scene
            matrix = real_array("coefficient", given, "a number or a matrix [n, n]").clone().cpu()
            if matrix.dim() != 2 or matrix.shape[0] != matrix.shape[1]:
                fail("coefficient", "a number or a matrix [n, n]", f"shape {list(matrix.shape)}")
            if not bool((torch.isfinite(matrix) & (matrix >= 0)).all()):
                wrong = matrix[~((matrix >= 0) & matrix.isfinite())][0]
                fail("coefficient", "finite numbers >= 0", f"{float(wrong):g}")
            object.__setattr__(self, "coefficient", matrix)
            object.__setattr__(self, "parameters", {"coefficient": 2})
        object.__setattr__(self, "velocity", check_positive("velocity", self.velocity, "m/s"))
        if self.velocity < LEAST_VELOCITY:
            fail("velocity", f"at least {LEAST_VELOCITY:g} m/s", self.velocity)

    def constants(self, like: Tensor) -> dict[str, Tensor]:
        return _scalars(self, like)
