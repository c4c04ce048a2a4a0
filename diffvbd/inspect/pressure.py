"""Pressure of contact on a part of a body's surface."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from .._common.checks import check_kind, fail
from ..mesh.arrays import int_array
from ..ops.sums import Rows
from .forces import Forces

LEAST = 1e-9  # of the squares of two sides: a third of an area that is none


class PressureMap(NamedTuple):
    """Pressure on the vertices of a patch of a surface, n of them."""

    vertices: Tensor  # [n] int64, ascending
    pressure: Tensor  # [..., n] [Pa]: normal forces into the patch, over area
    shear: Tensor  # [..., n, 3] [Pa]: the rest of the forces on it, over area
    area: Tensor  # [..., n] [m^2]: a third of each triangle of the patch at a vertex

    def total(self) -> Tensor:
        """The force that presses on the patch [N], [...]."""
        return (self.pressure * self.area).sum(-1)


def pressure(forces: Forces, x: Tensor, triangles: Any) -> PressureMap:
    """Pressure and shear of contact at each vertex of a patch of a surface, as tactile skin measures them.

    The force on a vertex is divided by the part of the patch around it. On a flat patch the pressures times their areas
    sum up to the force that presses on it. A vertex at the border of a patch has forces of triangles outside, too, but
    only the area inside: end a patch where nothing touches, or at an edge of the body. Differentiable in x and forces.

    Args:
        forces: Of :func:`diffvbd.contact.forces` at x.
        x: Positions [m], shape [..., V, 3].
        triangles: The patch, vertices [F, 3] counterclockwise seen from outside, as rows of ``mesh.surface``.

    Raises:
        ValueError, TypeError: Naming the argument: other shapes, indices that are not there, a triangle without area.
    """
    check_kind("forces", forces, Forces)
    if not isinstance(x, Tensor) or x.shape != forces.vertices.normal.shape:
        got = list(x.shape) if isinstance(x, Tensor) else type(x).__name__
        fail("x", f"shape {list(forces.vertices.normal.shape)} of the forces", got)
    given = triangles.cpu().numpy() if isinstance(triangles, Tensor) else triangles
    index = int_array("triangles", given, (None, 3))
    if not index.size or index.min() < 0 or index.max() >= x.shape[-2]:
        fail("triangles", f"at least one, of vertices 0 to {x.shape[-2] - 1}", given)
    vertices, local = np.unique(index, return_inverse=True)
    rows = Rows.of(torch.from_numpy(local.reshape(-1)).to(x.device), len(vertices))
    corners = x[..., torch.from_numpy(index).to(x.device), :]
    sides = corners[..., 1:, :] - corners[..., :1, :]
    third = torch.linalg.cross(sides[..., 0, :], sides[..., 1, :]) / 6  # of the area vector of each triangle
    size = third.norm(dim=-1, keepdim=True)
    least = LEAST * sides.detach().square().sum((-2, -1))[..., None]
    if not torch.compiler.is_compiling() and not bool((size.detach() > least).all()):
        fail("triangles", "triangles with an area at x", "one without")
    at_corners = torch.cat([third, size], -1)[..., None, :].expand(*third.shape[:-1], 3, 4)
    summed = rows.sum(at_corners.reshape(-1, 3 * len(index), 4)).reshape(*x.shape[:-2], len(vertices), 4)
    normal = summed[..., :3] / summed[..., :3].norm(dim=-1, keepdim=True)
    area, kept = summed[..., 3], torch.from_numpy(vertices).to(x.device)
    force = forces.vertices.total[..., kept, :]
    into = -(force * normal).sum(-1)
    return PressureMap(kept, into / area, (force + into[..., None] * normal) / area[..., None], area)
