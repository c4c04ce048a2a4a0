"""Claim: the coarse spaces of many bodies, which are built together, are those of each body alone, and copies of a body
have the same functions; bad numbers are refused."""

from typing import Any

import numpy as np
import pytest

import diffvbd as dv
from diffvbd.model.coarse import CoarseGeometry, CoarseSpace, build_coarse
from diffvbd.testing import generator, tolerance


def built(points: np.ndarray, tets: np.ndarray, space: CoarseSpace, body: np.ndarray) -> CoarseGeometry:
    pinned = points[:, 2] < 1e-3
    return build_coarse(points, tets, pinned, body, space)


def parts(whole: CoarseGeometry, body: np.ndarray, tet_body: np.ndarray) -> dict[int, CoarseGeometry]:
    """The same of each body, numbered as if it were alone."""
    out, entry_body = {}, body[whole.vertex]
    order = [np.argsort(a, kind="stable") for a in (entry_body, tet_body)]
    entries, tets = (np.split(o, np.flatnonzero(np.diff(a[o])) + 1)
                     for o, a in zip(order, (entry_body, tet_body), strict=True))  # fmt: skip
    vertices = np.searchsorted(body, np.arange(body.max() + 1))
    of_tets = {int(tet_body[t[0]]): t for t in tets}
    for own in entries:
        b = int(entry_body[own[0]])
        group = whole.tet_group[of_tets[b]]
        rank = int(whole.group_body[group[0]])
        ptr = whole.function_ptr[rank : rank + 2]
        functions = whole.group_functions[group.min() : group.max() + 1]
        out[b] = CoarseGeometry(
            ptr - ptr[0], whole.vertex[own] - vertices[b], whole.function[own] - ptr[0], whole.weight[own],
            group - group.min(), np.zeros(len(functions), dtype=np.int64),
            np.where(functions >= 0, functions - ptr[0], -1), whole.filling[ptr[0] : ptr[1]],
        )  # fmt: skip
    return out


def assert_same(one: CoarseGeometry, other: CoarseGeometry) -> None:
    for name, a, b in zip(one._fields, one, other, strict=True):
        if name == "group_functions":  # as wide as the widest of all bodies
            assert (a[:, b.shape[1] :] == -1).all() and np.array_equal(a[:, : b.shape[1]], b)
        elif name == "weight":
            assert a.shape == b.shape and np.abs(a - b).max() <= tolerance("ulps"), name
        else:
            assert np.array_equal(a, b), name


def joined(meshes: list[dv.TetMesh]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    count = [mesh.num_vertices for mesh in meshes]
    first = np.cumsum(count) - count
    tets = np.concatenate([mesh.tets + k for mesh, k in zip(meshes, first, strict=True)])
    return np.concatenate([mesh.points for mesh in meshes]), tets, np.repeat(np.arange(len(meshes)), count)


@pytest.mark.parametrize(
    "space", [CoarseSpace(), CoarseSpace(functions=8, groups=3), CoarseSpace(functions=12, degree=2)]
)
def test_bodies_together_and_alone(space: CoarseSpace) -> None:
    rng = generator("bodies")
    kinds = [dv.mesh.box((4, 3, 3), (0.3, 0.2, 0.2)), dv.mesh.box((3, 3, 2), (0.2, 0.2, 0.005)), dv.mesh.box(2, 0.1)]
    meshes = []
    for k in range(2000):
        kind = kinds[k % 3]
        stretch = 1 + 0.5 * rng.random(3)
        moved = kind.points * stretch + 1e-4 * rng.standard_normal(kind.points.shape)
        meshes.append(dv.TetMesh(moved, kind.tets))
    points, tets, body = joined(meshes)
    found = parts(built(points, tets, space, body), body, body[tets[:, 0]])
    assert len(found) == 2000
    for b in range(0, 2000, 7):
        mesh = meshes[b]
        assert_same(found[b], built(mesh.points, mesh.tets, space, np.zeros(mesh.num_vertices, dtype=np.int64)))


@pytest.mark.parametrize(
    ("options", "name", "got"),
    [
        ({"functions": 0}, "functions", "0"),
        ({"functions": 4097}, "functions", "4097"),
        ({"functions": 2.5}, "functions", "2.5"),
        ({"degree": 4}, "degree", "4"),
        ({"groups": -1}, "groups", "-1"),
        ({"every": 0}, "every", "0"),
    ],
)
def test_a_space_refuses(options: dict[str, Any], name: str, got: str) -> None:
    with pytest.raises((ValueError, TypeError), match=f"^{name}: expected an integer.* {got}"):
        CoarseSpace(**options)
