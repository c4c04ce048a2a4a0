"""Vertices that belong together: connected ones, and those in the same place."""

from __future__ import annotations

import itertools

import numpy as np

from diffvbd.mesh.arrays import FloatArray, IntArray


def connected(cells: IntArray, count: int) -> IntArray:
    """The lowest vertex of the connected cells [C, N] that each of `count` vertices is in, shape [count]."""
    label = np.arange(count)
    while True:  # each vertex takes the lowest label of its cells, and that label's own: paths halve each time
        lowest = label[cells].min(axis=1)
        new = label.copy()
        for corner in cells.T:
            np.minimum.at(new, corner, lowest)
        new = new[new]
        if np.array_equal(new, label):
            return label
        label = new


def together(points: FloatArray, distance: float) -> IntArray:
    """The lowest of the points [V, 3] that each is joined with, by steps of at most `distance` [m], shape [V]."""
    # along a direction that no plane of a mesh is likely to be normal to, few points are as close as that
    along = points @ np.array([0.5257311, 0.3090170, 0.7925580])
    order = np.argsort(along, kind="stable")
    pairs = [np.empty((0, 2), dtype=np.int64)]
    for step in itertools.count(1):
        near = np.flatnonzero(along[order[step:]] - along[order[:-step]] <= distance)
        if len(near) == 0:
            return connected(np.concatenate(pairs), len(points))
        found = np.stack([order[near], order[near + step]], axis=1)
        gap = points[found[:, 0]] - points[found[:, 1]]
        pairs.append(found[np.einsum("ni,ni->n", gap, gap) <= distance**2])
    raise AssertionError("unreachable")
