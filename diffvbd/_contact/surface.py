"""The surfaces of a Model's bodies and colliders, as detection reads them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import torch
from torch import Tensor

from .._contact.barrier import PairBarrier
from .._contact.colliders import Capsule, Collider, Obstacle, Plane, Sphere, mean_edges, unique_edges
from .._contact.faces import faces_of, mean_area, sharp_edges, vertex_areas
from ..mesh import TetMesh

CAPACITY_PER_VERTEX, LEAST_CAPACITY = 16, 8192
# Bounds of the trust-region radius without a given reach, and of the deformation radius, in mean edges of the body:
# larger radii list more pairs.
MOST_EDGES, MOST_EDGES_OWN = 2.0, 0.75


@dataclass(frozen=True, eq=False)
class ContactSurface:
    """Corner points are the V vertices of the mesh, then the points of the colliders; N of them."""

    rest: Tensor  # [N, 3] [m]
    radius: Tensor  # [N] [m]
    triangles: (
        Tensor  # [F, 3] int32, of corner points: triangles, then edges (a, b, b) and vertices (a, a, a) that count
    )
    num_triangles: int  # of those
    edges: Tensor  # [E, 2] int32
    face_counts: Tensor  # [F + E] int32: how often each face counts, and which edges are sharp
    points: Tensor  # [P] int32
    point_weights: Tensor  # [P] of the barrier of each point
    planes: Tensor  # [L, 3] int32
    body: Tensor  # [N] int32: those of the mesh, then one for each collider
    pinned: Tensor  # [N] bool: pinned, or of a collider
    pinned_bodies: Tensor  # [bodies] bool: a vertex of it is pinned
    partly_pinned: Tensor | None  # [V] bool: of a body of which a vertex is pinned and another not; None: there is none
    plane_points: Tensor  # [N] bool: spans a plane
    body_order: Tensor  # [V] int32: vertices by body
    body_ptr: Tensor  # [bodies + 1] int32
    unit: Tensor  # [V] int32: the vertex whose step fraction each has, one for a free body; itself on a pinned one
    bodies: int  # of the mesh
    rows: tuple[slice, ...]  # of each collider in collider_points
    max_trust_radius: Tensor  # [bodies] [m]: bound of the trust-region radius
    max_deformation_radius: Tensor  # [bodies] [m]: bound of the deformation radius
    capacity: int  # pairs, per scene; all scenes together have room for LEAST_CAPACITY at least

    @property
    def searched(self) -> tuple[Tensor, ...]:
        """As ops.contact.contact_detect takes it."""
        return (self.rest, self.radius, self.triangles, self.edges, self.points, self.planes, self.body, self.pinned,
                self.face_counts, self.point_weights)  # fmt: skip

    @property
    def of_bodies(self) -> tuple[Tensor, ...]:
        """As ops.contact.contact_find takes it."""
        return (self.pinned_bodies, self.body_order, self.body_ptr, self.max_trust_radius, self.max_deformation_radius)

    @property
    def collider_points(self) -> Tensor:
        return self.rest[self.body_order.shape[0] :]

    def corners_of(self, key: int) -> tuple[int, list[int]]:
        """Scene and corner points of a pair by its key in contact_detect's counts."""
        count = 1 + max(t.shape[0] for t in (self.triangles, self.edges, self.points, self.planes))
        key, second = divmod(key, count)
        key, first = divmod(key, count)
        scene, kind = divmod(key, 3)
        sides = ((self.points, self.triangles), (self.edges, self.edges), (self.points, self.planes))[kind]
        corners = [side[row].reshape(-1).tolist() for side, row in zip(sides, (first, second), strict=True)]
        return scene, corners[0] + corners[1]

    def owners_of(self, first: int, second: int) -> str:
        """Owners of two corner points, for messages."""
        bodies = [int(self.body[corner]) for corner in (first, second)]
        named = [f"body {b}" if b < self.bodies else f"collider {b - self.bodies}" for b in bodies]
        return " and ".join(dict.fromkeys(named))

    def to(self, device: torch.device, dtype: torch.dtype) -> ContactSurface:
        changes: dict[str, Any] = {}
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, Tensor):
                value = value.to(device, dtype) if value.is_floating_point() else value.to(device)
            changes[field.name] = value
        return ContactSurface(**changes)


def build_surface(mesh: TetMesh, pinned: Tensor, barrier: PairBarrier, colliders: Sequence[Collider]) -> ContactSurface:
    """In float64 on the CPU."""
    count, bodies = mesh.num_vertices, mesh.num_bodies
    label = np.unique(mesh.body, return_inverse=True)[1].reshape(-1)
    surface = mesh.surface
    triangles, edges, points, planes = [surface], [unique_edges(surface)], [np.unique(surface)], []
    rest, body, radius, flat, rows = [mesh.points], [label], [np.zeros(count)], [np.zeros(count, bool)], []
    for index, collider in enumerate(colliders):
        part, first = collider.corners(), sum(map(len, rest))
        n = len(part.points)
        rest.append(part.points)
        body.append(np.full(n, bodies + index))
        radius.append(np.full(n, part.radius))
        flat.append(np.full(n, part.plane))
        rows.append(slice(first - count, first - count + n))
        triangles.append(part.triangles + first)
        edges.append(part.edges + first)
        points.append(part.lone + first)
        if part.plane:
            planes.append([first, first + 1, first + 2])
    # of each body: neither a large obstacle nor a coarse neighbour widens a search
    edge = torch.from_numpy(mean_edges(mesh.points, edges[0], label, bodies))
    pinned_vertices = np.bincount(label, weights=pinned.cpu().numpy(), minlength=bodies)
    pinned_bodies = torch.from_numpy(pinned_vertices > 0)
    moving_bodies = pinned_vertices < np.bincount(label, minlength=bodies)
    partly_pinned = torch.from_numpy(((pinned_vertices > 0) & moving_bodies)[label])
    max_trust_radius = MOST_EDGES * edge
    if barrier.reach is not None:
        max_trust_radius = torch.full_like(edge, (barrier.reach - barrier.dhat) / 2)

    surface_vertices = len(points[0])

    def index_tensor(parts: list[Any], width: int) -> Tensor:
        joined = np.concatenate([np.asarray(p, np.int64).reshape(-1, width) for p in parts] or [np.zeros((0, width))])
        return torch.from_numpy(joined.astype(np.int32))

    triangles, edges = index_tensor(triangles, 3), index_tensor(edges, 2)
    faces, counts = faces_of(triangles.numpy(), edges.numpy())
    sharp = sharp_edges(np.concatenate(rest), triangles.numpy(), edges.numpy())
    points = index_tensor(points, 1).reshape(-1)
    weights = np.ones(len(points))
    if barrier.kappa_per_area is not None:
        area = vertex_areas(np.concatenate(rest), triangles.numpy())[points.numpy()]
        weights = np.where(area > 0, area / mean_area(mesh), 1.0)
    pinned = torch.cat([pinned.cpu(), torch.ones(sum(map(len, rest)) - count, dtype=torch.bool)])
    order = np.argsort(label, kind="stable")
    return ContactSurface(
        rest=torch.from_numpy(np.concatenate(rest)),
        radius=torch.from_numpy(np.concatenate(radius)),
        triangles=torch.from_numpy(faces),
        num_triangles=len(triangles),
        edges=edges,
        face_counts=torch.from_numpy(np.concatenate([counts, sharp]).astype(np.int32)),
        points=points,
        point_weights=torch.from_numpy(weights),
        planes=index_tensor(planes, 3),
        body=torch.from_numpy(np.concatenate(body).astype(np.int32)),
        pinned=pinned,
        pinned_bodies=pinned_bodies,
        partly_pinned=partly_pinned if partly_pinned.any() else None,
        plane_points=torch.from_numpy(np.concatenate(flat)),
        body_order=torch.from_numpy(order.astype(np.int32)),
        body_ptr=torch.from_numpy(np.searchsorted(label[order], np.arange(bodies + 1)).astype(np.int32)),
        unit=units(torch.from_numpy(label), pinned_bodies),
        bodies=bodies,
        rows=tuple(rows),
        max_trust_radius=max_trust_radius,
        max_deformation_radius=MOST_EDGES_OWN * edge,
        capacity=barrier.capacity or CAPACITY_PER_VERTEX * surface_vertices,
    )


def units(body: Tensor, pinned_bodies: Tensor) -> Tensor:
    """The first vertex of each vertex's body where no vertex of that is pinned, else itself; int32 [V]."""
    own = torch.arange(len(body), device=body.device)
    first = torch.full((len(pinned_bodies),), len(body), device=body.device).scatter_reduce(0, body, own, "amin")
    return torch.where(pinned_bodies[body], own, first[body]).to(torch.int32)


def check_colliders(colliders: Any) -> tuple[Collider, ...]:
    kinds = (Plane, Sphere, Capsule, Obstacle)
    if isinstance(colliders, kinds):
        colliders = (colliders,)
    if not isinstance(colliders, (tuple, list)):
        raise TypeError(f"colliders: expected a sequence of colliders, got {type(colliders).__name__}")
    for collider in colliders:
        if not isinstance(collider, kinds):
            names = ", ".join(k.__name__ for k in kinds)
            raise TypeError(f"colliders: expected instances of {names}, got {type(collider).__name__}")
    return tuple(colliders)
