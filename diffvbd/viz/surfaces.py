"""Parts of surfaces: what is connected, and what is shaded as one."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

SHARP = np.cos(np.radians(40.0))  # cosine between two triangles from which on their edge is drawn as one


def connected(pairs: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    """Labels [count] of what is connected by pairs [n, 2]: the lowest member of each."""
    label = np.arange(count)
    while True:
        before = label.copy()
        np.minimum.at(label, pairs, label[pairs].min(1, keepdims=True))
        label = label[label]
        if np.array_equal(label, before):
            return label


def bodies(triangles: NDArray[np.int64], vertices: int) -> NDArray[np.int64]:
    """Labels [V] of the connected parts of a surface [F, 3]."""
    return connected(np.concatenate([triangles[:, :2], triangles[:, 1:]]), vertices)


def smooth_parts(points: NDArray[np.float64], triangles: NDArray[np.int64]) -> NDArray[np.int64]:
    """Labels [F] of the parts of a surface that sharp edges bound, for points [m] of shape [V, 3]."""
    corners = points[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    edges = np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), 1)
    key = edges[:, 0] * len(points) + edges[:, 1]
    order = np.argsort(key, kind="stable")
    same = key[order][1:] == key[order][:-1]
    pairs = np.stack([order[:-1][same] // 3, order[1:][same] // 3], 1)
    smooth = (normals[pairs[:, 0]] * normals[pairs[:, 1]]).sum(1) > SHARP
    return connected(pairs[smooth], len(triangles))
