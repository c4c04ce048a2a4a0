"""A mesh as surfaces of single bodies, which is how USD and glTF take it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from diffvbd.mesh.arrays import IntArray
from diffvbd.mesh.tet_mesh import TetMesh


class Part(NamedTuple):
    """The surface of one body: its name, the vertices of the mesh on it [P], triangles [F, 3] that count those."""

    name: str
    vertices: IntArray
    triangles: IntArray


def parts_of(mesh: TetMesh) -> list[Part]:
    """The surface of each body, in the order of the labels: `body`, or `body_<label>` where there are several."""
    surface = mesh.surface
    labels = mesh.body[surface[:, 0]]
    order = np.argsort(labels, kind="stable")
    found, starts = np.unique(labels[order], return_index=True)
    parts = []
    for label, rows in zip(found.tolist(), np.split(order, starts[1:]), strict=True):
        vertices, triangles = np.unique(surface[rows], return_inverse=True)
        # names of USD have letters, digits and underscores
        name = "body" if len(found) == 1 else f"body_{label}".replace("-", "_")
        parts.append(Part(name, vertices, triangles.reshape(-1, 3)))
    return parts
