"""Energies of a scene: one dataclass for each header in csrc/energies.

A Model's tuple of energies selects the compiled variant; what is absent costs nothing. The numbers of an energy are
constants of the Model unless a step takes them as inputs, such as ``floor_kappa=tensor``, in which case they are
differentiable.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from ._common.checks import (
    check_number,
    check_positive,
    check_readable,
    fail,
    init_names_checked,
    mask_or_indices,
    refuse_gradients,
    vertex_mask,
)
from ._common.constants import EXACT_BLOCK, FIRST_VERTEX_BIT

MAX_PLANES = 8
INTEGERS = (torch.int64, torch.int32, torch.int16, torch.int8, torch.uint8)  # dtypes of labels
FADE = 0.1  # of kappa dhat: the normal force from which a contact has half of its damping; twins in csrc and reference


def numbers_of(name: str, value: Any) -> Tensor:
    """Finite numbers as a detached float64 tensor."""
    if isinstance(value, Tensor):
        check_readable(name, value)
    try:
        given = value if isinstance(value, Tensor) else torch.from_numpy(np.array(value, dtype=np.float64))
        if given.is_complex():  # whose real part is what .to() would take
            raise TypeError
        out = given.detach().to(torch.float64, copy=isinstance(value, Tensor))  # which may change later
    except OverflowError:
        fail(name, "numbers that a float can hold", "an integer beyond 1.8e308")
    except (TypeError, ValueError, RuntimeError):
        raise TypeError(f"{name}: expected numbers, got {value!r}") from None
    if given.dtype == torch.bool or not isinstance(value, Tensor) and np.asarray(value).dtype == bool:
        raise TypeError(f"{name}: expected numbers, got {value!r}")
    good = torch.isfinite(out)
    if not bool(good.all()):
        fail(name, "finite numbers", float(out[~good][0]) if isinstance(value, Tensor) else value)
    return out


@init_names_checked
@dataclass(frozen=True, eq=False)
class StableNeoHookean:
    """Stable Neo-Hookean tets, P = mu F + (lb (J - 1) - mu) cof F with lb = mu + lam.

    Args:
        patches: What the part of lam averages volumes over, against locking near nu = 0.5: None, each tet has its own;
            "auto", patches of about six neighbours; or a label of each tet, integers of shape [T]. The tets of a label
            lie in one connected body. lam that differs within a patch counts with its mean by volume.

    Inputs: ``mu`` and ``lam``, or ``young`` and ``poisson``.

    Raises:
        TypeError, ValueError: patches of another kind; in the Model, labels that do not fit its mesh.

    Source: Smith, de Goes, Kim (2018); paper, appendix on closed forms; docs/method.md, sections 2 and 23.
    """

    name: ClassVar[str] = "stable_neo_hookean"
    bit: ClassVar[int] = EXACT_BLOCK

    patches: str | Tensor | Sequence[int] | None = None

    def __post_init__(self) -> None:
        if self.patches is None or isinstance(self.patches, str) and self.patches == "auto":
            return
        if isinstance(self.patches, Tensor):
            check_readable("patches", self.patches)
        try:
            labels = None if isinstance(self.patches, str) else torch.as_tensor(self.patches).detach().cpu()
        except (TypeError, ValueError, RuntimeError):
            labels = None
        if labels is None or labels.dim() != 1 or labels.dtype not in INTEGERS:
            got = repr(self.patches) if labels is None else f"{labels.dtype}, shape {list(labels.shape)}"
            fail("patches", 'None, "auto" or integers of shape [T], a label of each tet', got)
        object.__setattr__(self, "patches", labels.to(torch.int64))

    def __repr__(self) -> str:
        labels = self.patches
        if labels is None:
            return "StableNeoHookean()"
        return f"StableNeoHookean(patches={repr(labels) if isinstance(labels, str) else f'<{len(labels)} labels>'})"


class VertexEnergy:
    """An energy of one vertex at a time. Subclasses are dataclasses; docs/guides/extend.md has the steps."""

    name: ClassVar[str]
    bit: ClassVar[int]  # in a scene's mask; follows from the position in VERTEX_ENERGIES
    per_vertex: ClassVar[bool]
    parameters: ClassVar[dict[str, int]]  # differentiable parameters and their number of own dimensions
    units: ClassVar[dict[str, str]] = {}  # of the parameters, as "N/m"

    def detached(self) -> VertexEnergy:
        """A copy whose tensors are detached constants."""
        changes = {k: v.detach().clone() for k, v in vars(self).items() if isinstance(v, Tensor)}
        return replace(self, **changes) if changes else self  # type: ignore[type-var]

    def count(self) -> int:
        """Scalars of data per scene, or per vertex."""
        raise NotImplementedError

    def check(self, num_vertices: int) -> None:
        """Raises ValueError where the energy does not fit a mesh."""

    def placed(self, num_vertices: int, device: torch.device) -> VertexEnergy:
        """A copy whose tensors lie on a device, so that a step copies nothing from the host."""
        return self

    def constants(self, rest_points: Tensor) -> dict[str, Tensor]:
        """The parameters as tensors of rest_points' dtype and device."""
        raise NotImplementedError

    def pack(self, values: dict[str, Tensor], origin: Tensor | None) -> Tensor:
        """Parameters with a leading scene dimension [1 | B, ...] -> data [1 | B, n] as the kernels read it."""
        raise NotImplementedError

    def gradient(self, x: Tensor, x_prev: Tensor, data: Tensor, h: float, origin: Tensor | None) -> Tensor:
        """h^2 dE/dx [kg m] of every vertex, from the packed ``data``; what GlobalAdjoint differentiates.

        Args:
            data: Of each vertex [1 | B, V n]. Of a scene [1 | B, n], or repeated for each vertex [B, V, n], so that it
                is differentiated in a fixed order. n is count().
            x, x_prev: State and start of the step [m], relative to origin where there is one, [B, V, 3].
        """
        raise NotImplementedError(f"{type(self).__name__} has no gradient() for GlobalAdjoint and solve")

    def blocks(self, x: Tensor, x_prev: Tensor, data: Tensor, h: float, origin: Tensor | None) -> Tensor:
        """Contribution to the block of each vertex [B, V, 3, 3] [kg]; arguments as of gradient(). Coarse corrections in
        contact solve with these. Here they are the derivative of gradient()."""
        differentiated = torch.is_grad_enabled()
        with torch.enable_grad():
            at = x.view_as(x) if x.requires_grad else x.detach().requires_grad_()
            force = self.gradient(at, x_prev, data, h, origin)
            columns = [torch.autograd.grad(force[..., c].sum(), at, retain_graph=True, create_graph=differentiated)[0]
                       for c in range(3)]  # fmt: skip
        return torch.stack(columns, -1)


def log_barrier(gap: Tensor, kappa: Tensor, dhat: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """b = -kappa (gap - dhat)^2 log(gap / dhat) [J], b' [N] and b'' [N/m]; 0 where a gap is not in (0, dhat)."""
    d = torch.where((gap > 0) & (gap < dhat), gap, dhat)
    log, past, part = torch.log(d / dhat), d - dhat, 1 - dhat / d
    return -kappa * past**2 * log, -kappa * (2 * past * log + past**2 / d), -kappa * (2 * log + 4 * part - part * part)


def damped_fraction(force: Tensor, kappa: Tensor, dhat: Tensor) -> Tensor:
    """Fraction of its damping, below 1, that a contact has by its normal force at the start of the step [N]."""
    whole = force + FADE * kappa * dhat
    some = whole > 0  # without a barrier there is no damping, and no derivative of a quotient of zeros
    return torch.where(some, force / torch.where(some, whole, 1.0), 0.0)


def _approach(normal: Tensor, x: Tensor, x_prev: Tensor) -> Tensor:
    """Motion toward planes [m], at most 0, of which one of none has no derivative, as in csrc."""
    travel = (normal * (x - x_prev)[:, :, None]).sum(-1)
    return torch.where(travel < 0, travel, 0.0)


def _share(before: Tensor, kappa: Tensor, dhat: Tensor) -> Tensor:
    """Of its damping that a vertex has which began the step at a gap ``before`` [m]."""
    return damped_fraction(-log_barrier(before, kappa, dhat)[1], kappa, dhat)


@init_names_checked
@dataclass(frozen=True, eq=False)
class FloorBarrier(VertexEnergy):
    """IPC log barrier above planes: b(d) = -kappa (d - dhat)^2 log(d / dhat) for a gap 0 < d < dhat.

    No executed sweep lets an unpinned vertex reach a plane: every update passes a step filter, and the start of a step
    approaches no plane within its dhat, so that what rests there keeps its gap at any number of sweeps.

    Args:
        height: Height of the plane along its normal [m], or one for each plane.
        normal: Normal (normalised), or a sequence of normals: several planes are one energy.
        kappa: Barrier stiffness [N/m].
        dhat: Activation distance [m].
        damping: Damping of approaching motion of a vertex that started the step closer than dhat [N s/m]. It fades in
            with the normal force N of the plane there, by N / (N + kappa dhat / 10), lest a motion jump where a vertex
            comes to be that close one step sooner.

    Inputs: ``floor_kappa``, ``floor_dhat``, ``floor_damping`` (scalars), ``floor_height`` [planes] and ``floor_normal``
    [planes, 3].

    Raises:
        ValueError: kappa or damping < 0, dhat <= 0, a normal of zeros or of another shape, other numbers of heights and
            normals, more than 8 planes, what is not finite.
        TypeError: What is no number, or a tensor that requires grad.

    Source: Li et al. (2020); paper, appendix on implementation details; docs/method.md, section 6.
    """

    name: ClassVar[str] = "floor"
    per_vertex: ClassVar[bool] = False
    parameters: ClassVar[dict[str, int]] = {"normal": 2, "height": 1, "kappa": 0, "dhat": 0, "damping": 0}
    units: ClassVar[dict[str, str]] = {"normal": "-", "height": "m", "kappa": "N/m", "dhat": "m", "damping": "N s/m"}

    height: float | Sequence[float] = 0.0
    normal: Sequence[float] | Sequence[Sequence[float]] = (0.0, 1.0, 0.0)
    kappa: float = 400.0
    dhat: float = 0.02
    damping: float = 0.0

    def __post_init__(self) -> None:
        refuse_gradients(self)
        normal, height = numbers_of("normal", self.normal), numbers_of("height", self.height).reshape(-1)
        normal = normal[None] if normal.dim() == 1 else normal
        if height.shape[0] == 0:
            fail("height", "at least one value", "none")
        if normal.dim() != 2 or normal.shape[-1] != 3 or normal.shape[0] == 0:
            fail("normal", "3 numbers, or a sequence of such triples", f"shape {tuple(normal.shape)}")
        if bool((normal == 0).all(-1).any()):
            fail("normal", "vectors that are not zero", self.normal)
        if height.shape[0] not in (1, normal.shape[0]):
            if normal.shape[0] != 1:
                fail("height", f"one value, or one for each of {normal.shape[0]} planes", f"{height.shape[0]} values")
            normal = normal.expand(height.shape[0], 3)
        if normal.shape[0] > MAX_PLANES:
            fail("normal", f"at most {MAX_PLANES} planes", f"{normal.shape[0]}")
        object.__setattr__(self, "normal", tuple(map(tuple, normal.tolist())))
        object.__setattr__(self, "height", tuple(height.expand(normal.shape[0]).tolist()))
        object.__setattr__(self, "kappa", check_number("kappa", self.kappa))
        object.__setattr__(self, "dhat", check_positive("dhat", self.dhat, "m"))
        object.__setattr__(self, "damping", check_number("damping", self.damping))

    @property
    def planes(self) -> int:
        return len(self.normal)

    def count(self) -> int:
        return 7 * self.planes

    def constants(self, rest_points: Tensor) -> dict[str, Tensor]:
        normal = torch.tensor(self.normal, dtype=torch.float64)
        values = {k: getattr(self, k) for k in self.parameters}
        values["normal"] = normal / normal.abs().amax(-1, keepdim=True)  # very long or short ones are out of range
        return {k: torch.as_tensor(v, dtype=rest_points.dtype, device=rest_points.device) for k, v in values.items()}

    def pack(self, values: dict[str, Tensor], origin: Tensor | None) -> Tensor:
        normal = values["normal"]
        normal = normal / normal.detach().abs().amax(-1, keepdim=True)  # as are their squares
        normal = normal / (normal * normal).sum(-1, keepdim=True).sqrt()
        scenes = max(v.shape[0] for v in values.values())
        shape = (scenes, self.planes)
        columns = [values["height"].expand(shape)]
        columns += [values[k][:, None].expand(shape) for k in ("kappa", "dhat", "damping")]
        return torch.cat([normal.expand(*shape, 3), torch.stack(columns, -1)], -1).reshape(scenes, -1)

    def gradient(self, x: Tensor, x_prev: Tensor, data: Tensor, h: float, origin: Tensor | None) -> Tensor:
        size, normal = self.slopes(x, x_prev, data, h, origin)
        return (size[..., None] * normal).sum(-2)

    def slopes(self, x: Tensor, x_prev: Tensor, data: Tensor, h: float, origin: Tensor | None) -> tuple[Tensor, Tensor]:
        """The gradient along each plane's normal, h^2 dE/dx.n [kg m], [B, V, P], and the normals
        [1 | B, 1 | V, P, 3]."""
        normal, kappa, dhat, damping = self._columns(data)
        gap, before = (self._gaps(at, data, origin) for at in (x, x_prev))
        damping = damping * _share(before, kappa, dhat)
        return h * h * log_barrier(gap, kappa, dhat)[1] + h * damping * _approach(normal, x, x_prev), normal

    def _columns(self, data: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Normal [1 | B, 1 | V, P, 3], kappa, dhat, damping [1 | B, 1 | V, P]."""
        planes = self._planes(data)
        kappa, dhat, damping = planes[..., 4:].unbind(-1)
        return planes[..., :3], kappa, dhat, damping

    def _planes(self, data: Tensor) -> Tensor:
        """[1 | B, 1 | V, P, 7], from data of a scene or of each vertex."""
        return (data if data.dim() == 3 else data[:, None]).unflatten(-1, (self.planes, 7))

    def _gaps(self, x: Tensor, data: Tensor, origin: Tensor | None) -> Tensor:
        """[B, V, P]"""
        planes = self._planes(data)
        normal, height = planes[..., :3], planes[..., 3]
        if origin is not None:
            height = height - (normal * origin[:, :, None]).sum(-1)
        return (normal * x[:, :, None]).sum(-1) - height

    def gaps(self, x: Tensor, data: Tensor, origin: Tensor | None) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Gaps [m], [B, V, P], normals [1 | B, 1 | V, P, 3], kappa [N/m] and dhat [m], [1 | B, 1 | V, P]."""
        normal, kappa, dhat, _ = self._columns(data)
        return self._gaps(x, data, origin), normal, kappa, dhat

    def blocks(self, x: Tensor, x_prev: Tensor, data: Tensor, h: float, origin: Tensor | None) -> Tensor:
        normal, kappa, dhat, damping = self._columns(data)
        gap, before = (self._gaps(at, data, origin) for at in (x, x_prev))
        size = h * h * log_barrier(gap, kappa, dhat)[2] + h * damping * _share(before, kappa, dhat)
        return (size[..., None, None] * normal[..., None] * normal[..., None, :]).sum(2)

    def normal_force(self, x: Tensor, data: Tensor, origin: Tensor | None) -> tuple[Tensor, Tensor]:
        """Force of each plane on each vertex [N], [B, V, planes], and the unit normals [1 | B, 1 | V, planes, 3]."""
        gap, normal, kappa, dhat = self.gaps(x, data, origin)
        return -log_barrier(gap, kappa, dhat)[1], normal


@init_names_checked
@dataclass(frozen=True, eq=False)
class Anchor(VertexEnergy):
    """A spring from vertices to points: k / 2 |x_i - a_i|^2.

    Args:
        stiffness: k [N/m], a number or one for each vertex, shape [V].
        points: a [m], shape [V, 3]; None anchors at the rest points.
        vertices: Which vertices, a bool mask [V] or indices; None anchors all.

    Inputs: ``anchor_stiffness`` (scalar or [V]) and ``anchor_points`` [V, 3].

    Raises:
        ValueError: A stiffness < 0, what is not finite; in the Model, shapes or indices that do not fit its mesh.
        TypeError: What is no number, a tensor that requires grad, vertices that are neither a mask nor indices.
    """

    name: ClassVar[str] = "anchor"
    per_vertex: ClassVar[bool] = True
    parameters: ClassVar[dict[str, int]] = {"stiffness": 1, "points": 2}
    units: ClassVar[dict[str, str]] = {"stiffness": "N/m", "points": "m"}

    stiffness: float | Tensor = 1.0
    points: Tensor | None = None
    vertices: Tensor | None = None

    def __post_init__(self) -> None:
        refuse_gradients(self)
        if self.vertices is not None:
            object.__setattr__(self, "vertices", mask_or_indices("vertices", self.vertices))
        object.__setattr__(self, "stiffness", numbers_of("stiffness", self.stiffness))
        if bool((self._spring < 0).any()):
            fail("stiffness", "numbers >= 0 N/m", self.stiffness)
        if self.points is not None:
            object.__setattr__(self, "points", numbers_of("points", self.points))

    def __repr__(self) -> str:
        """One line: tensors by their shapes."""
        shown = []
        for name, value in vars(self).items():
            if isinstance(value, Tensor):
                one = repr(value.item()) if value.dim() == 0 else str(list(value.shape))
                value = f"{int(value.sum())} of {value.numel()}" if value.dtype == torch.bool else one
            shown.append(f"{name}={value}")
        return f"Anchor({', '.join(shown)})"

    @property
    def _spring(self) -> Tensor:
        """stiffness, which is a tensor since it was checked."""
        assert isinstance(self.stiffness, Tensor)
        return self.stiffness

    def count(self) -> int:
        return 4

    def check(self, num_vertices: int) -> None:
        stiffness = self._spring
        if stiffness.dim() > 0 and stiffness.shape != (num_vertices,):
            fail("stiffness", f"a number or shape [{num_vertices}]", f"shape {list(stiffness.shape)}")
        if self.points is not None and self.points.shape != (num_vertices, 3):
            fail("points", f"shape [{num_vertices}, 3]", f"shape {list(self.points.shape)}")
        self._mask(num_vertices)

    def placed(self, num_vertices: int, device: torch.device) -> VertexEnergy:
        tensors = {k: v.to(device) for k, v in vars(self).items() if isinstance(v, Tensor)}
        return replace(self, **{**tensors, "vertices": self._mask(num_vertices).to(device)})

    def _mask(self, num_vertices: int) -> Tensor:
        if self.vertices is None:
            return torch.ones(num_vertices, dtype=torch.bool, device="cpu")
        if self.vertices.dtype == torch.bool and self.vertices.shape == (num_vertices,):
            return self.vertices  # where it lies: a step copies nothing from the host
        return vertex_mask(self.vertices, num_vertices, "vertices")

    def constants(self, rest_points: Tensor) -> dict[str, Tensor]:
        points = rest_points if self.points is None else self.points.to(rest_points)
        mask = self._mask(rest_points.shape[0]).to(rest_points)
        return {"stiffness": self._spring.to(rest_points).expand(len(mask)) * mask, "points": points}

    def pack(self, values: dict[str, Tensor], origin: Tensor | None) -> Tensor:
        points = values["points"] if origin is None else values["points"] - origin
        stiffness = values["stiffness"]
        scenes = max(points.shape[0], stiffness.shape[0])
        n = points.shape[1]
        stiffness = stiffness.expand(scenes, n) * self._mask(n).to(points)
        return torch.cat([stiffness[..., None], points.expand(scenes, n, 3)], -1).reshape(scenes, -1)

    def gradient(self, x: Tensor, x_prev: Tensor, data: Tensor, h: float, origin: Tensor | None) -> Tensor:
        stiffness, points = data.reshape(data.shape[0], -1, 4).split((1, 3), -1)
        return h * h * stiffness * (x - points)

    def blocks(self, x: Tensor, x_prev: Tensor, data: Tensor, h: float, origin: Tensor | None) -> Tensor:
        spring = data.reshape(data.shape[0], -1, 4)[..., 0]
        return h * h * spring[..., None, None] * torch.eye(3, dtype=x.dtype, device=x.device)


VERTEX_ENERGIES: tuple[type[VertexEnergy], ...] = (FloorBarrier, Anchor)  # order of csrc/energies/energies.h
for _position, _kind in enumerate(VERTEX_ENERGIES):
    _kind.bit = 1 << (FIRST_VERTEX_BIT + _position)
