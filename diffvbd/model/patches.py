"""Patches of tets that share one volume ratio, against locking (mean dilatation; docs/method.md, section 23).

The energy lam / 2 V (J - 1)^2 of each tet gives way to lam / 2 V_P (J_P - 1)^2 of each patch P, with its volume V_P at
rest and J_P = sum V J / V_P. Of it sweeps see a bound that is separable over the tets. With the state x0 that a sweep
begins at and a = 1 + J(x0) - J_P(x0), by convexity

    V_P (J_P - 1)^2 <= sum V (J - a)^2,        equal, with its gradient, at x0

and the tet with lam / 2 V (J - a)^2 is again a stable Neo-Hookean tet, of another lam and another c6 (law_at).

Source: Nagtegaal, Parks, Rice (1974); de Souza Neto, Andrade Pires, Owen (2005).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from .. import ops
from .._common.checks import fail
from ..mesh import TetMesh
from ..mesh.tet_mesh import inner_faces
from ..ops.sums import Rows
from .bodies import connected
from .material import cross, dot

SIZE = 6  # tets of a patch: a mesh has five to six for each vertex, and a vertex three freedoms
LEAST = 4  # tets below which a patch joins a neighbour
LEAST_SHARE = 1e-3  # of mu + lam, which has to remain of it


class Patches(NamedTuple):
    """Patches of a mesh: constants of a Model."""

    label: Tensor  # int64 [T], patch of each tet, counted from 0
    of_tets: Rows  # T, by patch
    of_corners: Rows  # 4 T, by vertex of a patch
    of_vertices: Rows  # N vertices of patches, one row for each patch that a vertex is in, by vertex of the mesh
    members: Rows  # N, by patch

    @classmethod
    def of(cls, label: np.ndarray, tets: np.ndarray, num_vertices: int) -> Patches:
        count = int(label.max()) + 1 if len(label) else 0
        key, corner = np.unique(label[:, None] * num_vertices + tets, return_inverse=True)
        patch, vertex = np.divmod(key, max(num_vertices, 1))
        of, *others = (torch.from_numpy(a.reshape(-1)) for a in (label, corner, vertex, patch))
        groups = len(key), num_vertices, count
        return cls(of, Rows.of(of, count), *(Rows.of(a, n) for a, n in zip(others, groups, strict=True)))

    def to(self, device: torch.device) -> Patches:
        label, *rows = self
        return Patches(label.to(device), *(part.to(device) for part in rows))

    def sum(self, values: Tensor) -> Tensor:
        """Values of tets [B, T] -> sums of the patches [B, P]."""
        return self.of_tets.sum(values[..., None])[..., 0]

    def spread(self, values: Tensor) -> Tensor:
        """Values of patches [B, P] -> of their tets [B, T]."""
        return self.of_tets.gather(values[..., None])[..., 0]

    def mean(self, values: Tensor, c6: Tensor) -> Tensor:
        """Means of the values of tets [B, T] over each patch, by volume at rest, [B, P]."""
        shape = torch.broadcast_shapes(values.shape, c6.shape)
        volume = ops.broadcast(1 / c6, shape)
        return self.sum(volume * values) / self.sum(volume)


class Averaged(NamedTuple):
    """The law whose volumes patches average; [1 | B, 1 | T]."""

    lam: Tensor  # [Pa], alike in all tets of a patch
    c6: Tensor  # [1/m^3]


def uniform(patches: Patches, lam: Tensor, rest: Tensor) -> Averaged:
    """lam [1 | B, 1 | T], its mean by volume where it differs within a patch; rest [1 | B, T, 7]."""
    c6 = rest[..., 6]
    return Averaged(lam if lam.shape[-1] == 1 else patches.spread(patches.mean(lam, c6)), c6)


def law_at(model: Any, averaged: Averaged, mu: Tensor, lam: Tensor, rest: Tensor, x: Tensor
           ) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """mu, lam [B, T] and rest scalars [B, T, 7] of the law whose tets bound the energy of their patches about
    x [B, V, 3].

    mu, lam, rest: Of the law without averaging, viscosity included [1 | B, 1 | T], [1 | B, T, 7]. With det six times
    the volume of a tet its energy has the terms S c6 / 12 det^2 - (S + mu) / 6 det, S = mu + lam, and, of shear,
    mu k_ab. Averaging adds lam_0 (a - 1) to S + mu. The new moduli and scalars leave the other terms as they are: with
    the same mu, unless S were not to remain positive, as in a tet that is far inside out among others; there c6 stays.
    """
    return _law(*ops.distinct(x, *averaged, mu, lam, rest), model._topology, model.patches)


class _LawTerms(NamedTuple):
    """What makes a law; of tets [B, T], of patches [B, P]."""

    normals: list[tuple[Tensor, ...]]  # derivatives of det by the second, third and fourth corner, by components
    det: Tensor
    size: Tensor  # sum of 1 / c6 of each patch
    ratio: Tensor  # of each patch, J_P
    strain: Tensor  # a - 1
    added: Tensor  # lam_0 (a - 1)
    keeps_mu: Tensor  # bool
    total: Tensor  # S, 1 where it is 0


def _terms(x: Tensor, own: Tensor, c6: Tensor, mu: Tensor, lam: Tensor, topology: Any, patches: Patches,
           all_normals: bool = False) -> _LawTerms:  # fmt: skip
    corners = ops.tet_gather(x, *topology)
    e1, e2, e3 = (tuple(corners[..., a, i] - corners[..., 0, i] for i in range(3)) for a in (1, 2, 3))
    normals = [cross(e2, e3), *((cross(e3, e1), cross(e1, e2)) if all_normals else ())]
    det = dot(e1, normals[0])
    size = patches.sum((1 / c6).expand(len(c6), det.shape[1]))
    ratio = patches.sum(det) / size
    strain = c6 * det - patches.spread(ratio)
    added, total = own * strain, mu + lam
    keeps_mu = (added > (LEAST_SHARE - 1) * total) | (total == 0)
    return _LawTerms(normals, det, size, ratio, strain, added, keeps_mu, torch.where(total == 0, 1.0, total))


def _run_law(x: Tensor, own: Tensor, c6: Tensor, mu: Tensor, lam: Tensor, rest: Tensor, topology: Any,
             patches: Patches) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    t = _terms(x, own, c6, mu, lam, topology, patches)
    shear = torch.where(t.keeps_mu, mu, mu + t.added)
    share = torch.where(t.keeps_mu, 1.0, mu / torch.where(t.keeps_mu, 1.0, shear))
    sixth = torch.where(t.keeps_mu, t.total / (t.total + t.added), 1.0) * rest[..., 6]
    moduli = lam + torch.where(t.keeps_mu, t.added, -t.added)
    return shear, moduli, torch.cat([rest[..., :6] * share[..., None], sixth[..., None]], -1)


def _reverse_law(bars: Any, saved: Any, more: tuple, needs: Any) -> list[Tensor | None]:
    x, own, c6, mu, lam, rest = saved
    t = _terms(x, own, c6, mu, lam, *more, all_normals=bool(needs[0]))
    shape = t.det.shape
    of_mu, of_lam, of_rest = (t.det.new_zeros(s) if b is None else b for b, s in
                              zip(bars, (shape, shape, (*shape, rest.shape[-1])), strict=True))  # fmt: skip
    keeps, none = t.keeps_mu, t.det.new_zeros(())
    # where mu stays: c6' = c6 S / s
    s = torch.where(keeps, t.total + t.added, 1.0)
    along = torch.where(keeps, of_rest[..., 6] * rest[..., 6] / (s * s), none)
    # where it does not: k' = k mu / shear
    shear = torch.where(keeps, 1.0, mu + t.added)
    share = torch.where(keeps, 1.0, mu / shear)
    bent = torch.where(keeps, none, (of_rest[..., :6] * rest[..., :6]).sum(-1) / (shear * shear))
    added = torch.where(keeps, of_lam, of_mu - of_lam) - along * t.total - bent * mu
    mu_bar = of_mu + along * t.added + bent * t.added
    lam_bar = of_lam + along * t.added
    rest_bar = None
    if needs[5]:
        sixth = of_rest[..., 6] * torch.where(keeps, t.total / s, 1.0)
        rest_bar = torch.cat([of_rest[..., :6] * share[..., None], sixth[..., None]], -1)
    own_bar, strain = added * t.strain, added * own
    patches: Patches = more[1]
    of_ratio = -patches.sum(strain.expand(shape)) / t.size
    c6_bar = strain * t.det + patches.spread(of_ratio * t.ratio) / (c6 * c6) if needs[2] else None
    x_bar = None
    if needs[0]:
        of_det = strain * c6 + patches.spread(of_ratio)
        corners = [[of_det * n for n in normal] for normal in t.normals]
        first = [-(a + b + c) for a, b, c in zip(*corners, strict=True)]
        corners = torch.stack([row for corner in (first, *corners) for row in corner], -1)
        x_bar = ops.star_sum(corners.unflatten(-1, (4, 3)), *more[0])
    return [x_bar, own_bar, c6_bar, mu_bar, lam_bar, rest_bar]


def _vmap_law(apply: Any, info: Any, in_dims: tuple, *args: Any) -> tuple[tuple[Tensor, ...], tuple[int, ...]]:
    tensors, scenes = ops.folded(info.batch_size, args[:6], in_dims, 1)
    return tuple(t.unflatten(0, (-1, scenes)) for t in apply(*tensors, *args[6:])), (0, 0, 0)


# x, lam_0, c6, mu, lam, rest; topology, patches.
_law = ops.Differentiable(_run_law, _reverse_law, arguments=8, inputs=6, outputs=3, vmap=_vmap_law, batched=True)


# --- patches of a mesh ------------------------------------------------------------------------------------------------


def patches_of(mesh: TetMesh, given: Any) -> Patches | None:
    """Patches of a mesh, given as StableNeoHookean keeps them; raises ValueError where labels do not fit it."""
    if given is None:
        return None
    if isinstance(given, str):
        label = find_patches(mesh.tets)
    else:
        if len(given) != mesh.num_tets:
            fail("energies: StableNeoHookean: patches", f"shape [{mesh.num_tets}], a label of each tet",
                 f"shape {list(given.shape)}")  # fmt: skip
        label = np.unique(given.numpy(), return_inverse=True)[1].reshape(-1)
        tets = torch.from_numpy(mesh.tets.copy())
        parts = connected(tets, mesh.num_vertices)[tets[:, 0]].numpy()
        first = np.zeros(int(label.max(initial=-1)) + 1, dtype=np.int64)
        first[label] = parts
        if (wrong := np.flatnonzero(first[label] != parts)).size:
            tet = int(wrong[0])
            fail("energies: StableNeoHookean: patches", "patches within one connected body each",
                 f"tet {tet} in patch {int(given[tet])}, which has tets of another body")  # fmt: skip
    return Patches.of(label.astype(np.int64), mesh.tets, mesh.num_vertices)


def face_neighbors(tets: np.ndarray) -> np.ndarray:
    """Tets across the face opposite each corner [T, 4]; -1 where there is none."""
    one, two = inner_faces(tets)
    out = np.full(4 * len(tets), -1)
    out[one], out[two] = two // 4, one // 4
    return out.reshape(-1, 4)


def find_patches(tets: np.ndarray) -> np.ndarray:
    """Compact patches of SIZE tets or fewer, label of each tet [T]; deterministic.

    A patch grows from the tet with the fewest neighbours, by the neighbour that brings the fewest new vertices, then
    shares the most faces, then has the fewest free neighbours: around an edge, where the mesh lets it. Patches of fewer
    than LEAST tets join the neighbour with which they share the most faces.
    """
    across = face_neighbors(tets).tolist()
    vertices = [frozenset(t) for t in tets.tolist()]
    near = [[j for j in row if j >= 0] for row in across]
    label = [-1] * len(near)
    groups: list[list[int]] = []
    for seed in sorted(range(len(near)), key=lambda i: (len(near[i]), i)):
        if label[seed] >= 0:
            continue
        group, own, shared = [], set(), {seed: 0}
        while shared and len(group) < SIZE:
            best = min(shared, key=lambda t: (len(vertices[t] - own), -shared[t], sum(label[n] < 0 for n in near[t]),
                                              t))  # fmt: skip
            del shared[best]
            label[best] = len(groups)
            group.append(best)
            own |= vertices[best]
            for n in near[best]:
                if label[n] < 0:
                    shared[n] = shared.get(n, 0) + 1
        groups.append(group)
    for small in sorted((g for g in range(len(groups)) if len(groups[g]) < LEAST), key=lambda g: len(groups[g])):
        if len(groups[small]) >= LEAST:  # others have joined it
            continue
        faces: dict[int, int] = {}
        for t in groups[small]:
            for n in near[t]:
                if label[n] != small:
                    faces[label[n]] = faces.get(label[n], 0) + 1
        if faces:
            to = min(faces, key=lambda g: (-faces[g], len(groups[g]), g))
            groups[to] += groups[small]
            for t in groups[small]:
                label[t] = to
            groups[small] = []
    return np.unique(np.array(label, dtype=np.int64), return_inverse=True)[1].reshape(-1)
