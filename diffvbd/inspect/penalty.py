"""Penalty forces between whole bodies: the distance of their centers of mass decides, not their shape."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import softplus

from .. import ops
from .._common.checks import check_count, check_dense, check_positive, check_tensor, fail
from .._common.context import lasting_tensors, looks_at
from ..model.model import Model
from ..ops.contact import neighbor_pairs, unread
from ..ops.sums import Rows

PAIRS_PER_BODY = 16  # room for pairs where max_pairs is not given; equal balls in contact have 6 (12 neighbors each)
EXACT_SOFTPLUS = 50.0  # from there on softplus(t) = t in either dtype


class Bodies:
    """Bodies of the vertices, and the masses; made once, for many calls.

    Args:
        body: Label of each vertex, shape [V], integers. The bodies are numbered by ascending label.
        mass: Masses of the vertices [kg], shape [V], float64 or float32, >= 0. Constants: they have no gradient.

    Attributes:
        count: Number of bodies N.
        mass: Masses of the bodies [kg], shape [N].

    Raises:
        TypeError, ValueError: Wrong dtypes or shapes, masses that are negative or not finite, a body without mass.
    """

    @lasting_tensors()
    def __init__(self, body: Tensor, mass: Tensor) -> None:
        if not isinstance(mass, Tensor) or mass.dtype not in (torch.float64, torch.float32):
            raise TypeError(f"mass: expected a float64 or float32 tensor, got {_kind(mass)}")
        if not isinstance(body, Tensor) or body.is_floating_point() or body.dtype == torch.bool:
            raise TypeError(f"body: expected a tensor of integers, got {_kind(body)}")
        if mass.dim() != 1:
            fail("mass", "shape [V]", f"shape {list(mass.shape)}")
        if body.shape != mass.shape:
            fail("body", f"a label for each mass, shape {list(mass.shape)}", f"shape {list(body.shape)}")
        mass = mass.detach()
        wrong = ~((mass >= 0) & torch.isfinite(mass))
        if bool(wrong.any()):
            where = int(wrong.nonzero()[0])
            fail("mass", "finite numbers >= 0 kg", f"{float(mass[where]):g} at vertex {where}")
        labels, group = torch.unique(body.to(mass.device, torch.int64), return_inverse=True)
        self.count, vertices = labels.shape[0], mass.shape[0]
        size = vertices // max(self.count, 1)
        # as many copies of one body are numbered: no index is needed
        contiguous = self.count * size == vertices and torch.equal(
            group, torch.arange(self.count, device=group.device).repeat_interleave(size)
        )
        self._size = size if contiguous else None
        self._rows = None if contiguous else Rows.of(group, self.count)
        self.mass = self._sum(mass[None, :, None])[0, :, 0]
        if not bool((self.mass > 0).all()):
            empty = int(labels[(~(self.mass > 0)).nonzero()[0, 0]])
            fail("mass", "every body to have mass", f"0 kg for the body with label {empty}")
        self._share = mass / self._spread(self.mass[None, :, None])[0, :, 0]  # of the body's mass

    @property
    def num_vertices(self) -> int:
        return self._share.shape[0]

    def centers(self, x: Tensor) -> Tensor:
        """Positions of the vertices [m], shape [B, V, 3] -> centers of mass [m], shape [B, N, 3]."""
        return self._sum(self._share[:, None] * x)

    def forces(self, total: Tensor) -> Tensor:
        """Forces on the bodies [N], shape [B, N, 3] -> on their vertices, by mass, shape [B, V, 3]."""
        return self._share[:, None] * self._spread(total)

    def _sum(self, values: Tensor) -> Tensor:
        if self._rows is not None:
            return self._rows.sum(values)
        return values.reshape(values.shape[0], self.count, self._size or 0, values.shape[-1]).sum(2)

    def _spread(self, values: Tensor) -> Tensor:
        if self._rows is not None:
            return self._rows.gather(values)
        return values[:, :, None].expand(-1, -1, self._size or 0, -1).reshape(values.shape[0], -1, values.shape[-1])


def center_of_mass_penalty(
    x: Tensor,
    model_or_bodies: Model | Bodies | tuple[Tensor, Tensor] | None,
    radius: float,
    stiffness: float | Tensor,
    sharpness: float | None = None,
    *,
    max_pairs: int | None = None,
) -> Tensor:
    """Repulsion of bodies whose centers of mass are closer than a radius, as forces on their vertices.

    With the overlap o_ij = radius - |c_i - c_j| of two bodies (the paper does not write it out), body i is pushed with

        f_ij = stiffness max(0, o_ij) (c_i - c_j) / |c_i - c_j|,

    the force of the energy stiffness max(0, o_ij)^2 / 2, and body j with -f_ij. A sharpness a replaces max(0, o) by
    softplus(a o) / a, smooth and never zero; it is cut off where it has fallen to the machine epsilon times 1 / a, at a
    distance of radius + ln(1 / epsilon) / a, 36 / a beyond the radius in float64 and 16 / a in float32. The force on a
    body is spread over its vertices in proportion to their masses: all get the same acceleration.

    Differentiable (also twice) in x and stiffness by ordinary autograd; which pairs there are has no derivative. Bodies
    whose centers coincide have no direction to part in: they exert no force on each other, and no gradient passes.
    Pass the force to `diffvbd.step(..., force=...)`: it is that of the positions it was given, constant over a step.

    Args:
        x: Positions of the vertices [m], shape [..., V, 3]; leading dimensions are scenes, which do not see each other.
        model_or_bodies: A Model, whose bodies are ``model.mesh.body``; or :class:`Bodies`; or what those are made of
            (labels [V], masses [V] [kg]), which costs a sort at each call and does not work inside a CUDA graph. None
            if x are the centers of mass themselves: each row is a body, and gets the force on it.
        radius: Distance of the centers below which bodies overlap [m]: of balls, the sum of two radii.
        stiffness: [N/m], a number >= 0 or a tensor with one element.
        sharpness: a [1/m], or None for max(0, o).
        max_pairs: Room for pairs of all scenes together; default 16 for each body of each scene. In a CUDA graph and
            under torch.compile every force is NaN where it is too small, or positions are not finite.

    Returns:
        Forces on the vertices [N], shape [..., V, 3].

    Raises:
        TypeError, ValueError: naming the argument; more pairs than ``max_pairs``, with their number.

    Source: the paper's center-of-mass penalty between bodies (section on implementation and its appendix).
    """
    bodies = _bodies_of(model_or_bodies)
    lead = _check_positions(x, bodies)
    radius = check_positive("radius", radius, "m")
    stiffness = _check_stiffness(stiffness, x)
    reach = radius
    if sharpness is not None:
        sharpness = check_positive("sharpness", sharpness, "1/m")
        reach = radius - math.log(torch.finfo(x.dtype).eps) / sharpness
    scenes = math.prod(lead)
    if max_pairs is None:
        max_pairs = PAIRS_PER_BODY * (x.shape[-2] if bodies is None else bodies.count) * scenes
    max_pairs = check_count("max_pairs", max_pairs, maximum=2**62)
    centers = x.reshape(scenes, x.shape[-2], 3)
    if bodies is not None:
        centers = bodies.centers(centers)
    pairs, count = neighbor_pairs(centers, reach, max_pairs, name="x (centers of mass)")
    unit = _unit_forces(centers, pairs, radius, sharpness)
    if unread(x):  # NaN in the forces and, as the centers are in the product, in the gradient too: no silent zeros
        bad = (count < 0) | (count > max_pairs)
        unit = unit + centers * torch.where(bad, math.nan, 0.0).to(unit.dtype)
    force = ops.broadcast(stiffness.reshape(1, 1, 1), unit.shape) * unit
    return (force if bodies is None else bodies.forces(force)).reshape(x.shape)


def _unit_forces(centers: Tensor, pairs: Tensor, radius: float, sharpness: float | None) -> Tensor:
    """Sums of the forces of the pairs on each body for a stiffness of 1 N/m, shape [B, N, 3]."""
    scenes, bodies, _ = centers.shape
    group = (pairs[:, :1].to(torch.int64) * bodies + pairs[:, 1:]).reshape(-1)
    rows = Rows.of(torch.where(group < 0, scenes * bodies, group), scenes * bodies)
    ends = rows.gather(centers.reshape(1, -1, 3)).reshape(-1, 2, 3)
    apart = ends[:, 0] - ends[:, 1]
    squared = apart.square().sum(-1)
    distinct = squared > 0  # not so for unused pairs, whose ends are one body
    distance = torch.where(distinct, squared, 1.0).sqrt()
    overlap = radius - distance
    if sharpness is None:
        size = overlap.relu()
    else:
        size = softplus(overlap, beta=sharpness, threshold=EXACT_SOFTPLUS)
    force = torch.where(distinct, size / distance, 0.0)[:, None] * apart
    return rows.sum(torch.stack([force, -force], 1).reshape(1, -1, 3)).reshape(scenes, bodies, 3)


def _bodies_of(given: Any) -> Bodies | None:
    if given is None or isinstance(given, Bodies):
        return given
    if isinstance(given, Model):
        return given.derived("bodies", lambda: Bodies(torch.from_numpy(given.mesh.body.copy()), given.mass))
    if isinstance(given, tuple) and len(given) == 2:
        return Bodies(*given)
    expected = "a Model, Bodies or (labels, masses), or None for centers of mass"
    raise TypeError(f"model_or_bodies: expected {expected}, got {type(given).__name__}")


def _check_positions(x: Any, bodies: Bodies | None) -> tuple[int, ...]:
    """The leading shape of x; without bodies each of its rows is one."""
    shape = f"[..., {'N' if bodies is None else bodies.num_vertices}, 3]"
    if not isinstance(x, Tensor) or (bodies is None and x.dtype not in (torch.float64, torch.float32)):
        kind = "a tensor" if bodies is not None else "a float64 or float32 tensor"
        raise TypeError(f"x: expected {kind} of shape {shape}, got {_kind(x)}")
    check_dense("x", x)
    if bodies is not None:
        check_tensor("x", x, bodies.mass, owner="the masses'")
    if x.dim() < 2 or x.shape[-1] != 3 or (bodies is not None and x.shape[-2] != bodies.num_vertices):
        fail("x", f"shape {shape}", f"shape {list(x.shape)}")
    return tuple(x.shape[:-2])


def _check_stiffness(stiffness: Any, x: Tensor) -> Tensor:
    stiffness = check_tensor("stiffness", stiffness, x, "a number or a tensor with one element", "that of x")
    if stiffness.numel() != 1:
        fail("stiffness", "a number or a tensor with one element", f"shape {list(stiffness.shape)}")
    if looks_at(stiffness) and not 0 <= float(stiffness.detach()) < math.inf:
        fail("stiffness", "a finite number >= 0 N/m", float(stiffness.detach()))
    return stiffness


def _kind(value: Any) -> str:
    return f"dtype {value.dtype}" if isinstance(value, Tensor) else type(value).__name__
