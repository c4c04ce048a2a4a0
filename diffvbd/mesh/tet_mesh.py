"""The tetrahedral mesh every model starts from: validated once, immutable afterwards."""

from __future__ import annotations

from os import PathLike
from typing import Any

import numpy as np

from diffvbd.mesh.arrays import FloatArray, IntArray, check_flag, float_array, int_array, listed, to_numpy
from diffvbd.mesh.write import save

# Faces of a positively oriented tet, wound so that their normals point out of it.
TET_FACES = np.array([[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]])

# Below this fraction of the product of three edge lengths the sign of a volume is rounding noise.
FLAT = 16 * np.finfo(np.float64).eps

_CHUNK = 1 << 16


def signed_volume(points: FloatArray, tets: IntArray) -> tuple[FloatArray, FloatArray]:
    """Signed volume of each tet [m^3] and product of the edge lengths at its first vertex [m^3], shape [T] each."""
    volume = np.empty(len(tets))
    product = np.empty(len(tets))
    # Chunks keep the temporaries inside the cache; millions of tets at once are several times slower.
    for start in range(0, len(tets), _CHUNK):
        rows = slice(start, start + _CHUNK)
        corners = points[tets[rows]]
        a, b, c = (corners[:, k] - corners[:, 0] for k in (1, 2, 3))
        volume[rows] = np.einsum("ni,ni->n", a, np.cross(b, c)) / 6
        product[rows] = np.sqrt(np.einsum("ni,ni->n", a, a)) * np.sqrt(np.einsum("ni,ni->n", b, b))
        product[rows] *= np.sqrt(np.einsum("ni,ni->n", c, c))
    return volume, product


def oriented(points: FloatArray, tets: IntArray) -> IntArray:
    """`tets` with two vertices exchanged wherever the volume is negative."""
    volume, _ = signed_volume(points, tets)
    flipped = tets.copy()
    negative = volume < 0
    flipped[negative, 2], flipped[negative, 3] = tets[negative, 3], tets[negative, 2]
    return flipped


def boundary_faces(tets: IntArray, num_vertices: int) -> tuple[IntArray, IntArray]:
    """Triangles that belong to exactly one tet, wound outwards, shape [F, 3], and that tet, shape [F], ascending."""
    if len(tets) == 0:
        return np.empty((0, 3), dtype=np.int64), np.empty(0, dtype=np.int64)
    small = tets.astype(np.int32) if num_vertices < 2**31 else tets
    faces = small[:, TET_FACES].reshape(-1, 3)
    # Column by column: reductions along an axis of length 3 are ten times slower.
    a, b, c = faces.T
    low = np.minimum(np.minimum(a, b), c).astype(np.int64)
    high = np.maximum(np.maximum(a, b), c)
    middle = a.astype(np.int64) + b + c - low - high
    # One integer per triangle sorts far faster than three columns. Three indices into a large mesh do not
    # fit 63 bits, so triangles are sorted in blocks of their lowest vertex, and the key starts at the block.
    span = max(1, (2**63 - 1) // num_vertices**2)
    key = ((low % span) * num_vertices + middle) * num_vertices + high
    block = low // span
    last = int(block.max())
    if last == 0:
        groups = [np.arange(len(faces))]
    else:
        by_block = np.argsort(block.astype(np.uint16) if last < 2**16 else block, kind="stable")
        sizes = np.bincount(block)
        groups = np.split(by_block, np.cumsum(sizes[sizes > 0])[:-1])
    boundary = np.zeros(len(faces), dtype=bool)
    for group in groups:
        # A stable sort profits from the order that meshes usually have already.
        group = group[np.argsort(key[group], kind="stable")]
        ranked = key[group]
        differs = np.concatenate([[True], ranked[1:] != ranked[:-1], [True]])
        boundary[group[differs[:-1] & differs[1:]]] = True
    return faces[boundary].astype(np.int64), np.flatnonzero(boundary) // 4


class TetMesh:
    """Tetrahedral mesh: rest positions, tets and body labels. Immutable: its arrays cannot be written to.

    Args:
        points: Rest positions [m], shape [V, 3]; array, nested list or tensor. Copied to float64.
        tets: Vertex indices of each tet, shape [T, 4], integers. Positive volume:
            `(p1 - p0) . ((p2 - p0) x (p3 - p0)) > 0`.
        body: Body label of each vertex, shape [V], integers; default all 0. The vertices of a tet share one label.
        orient: Exchange two vertices of every tet of negative volume instead of raising.

    Raises:
        TypeError: points are not real numbers; tets or body are not integers.
        ValueError: wrong shape, NaN or Inf, index out of range, a tet that repeats a vertex, has zero volume (within
            rounding) or, without `orient`, negative volume, spans two bodies, or comes twice. The message names the
            first few.

    An empty mesh and vertices without tets are legal here. That different tets do not overlap is not checked.

    torch.compile makes an array writable that compiled code reads (steps and rollouts read none): read arrays outside.
    """

    def __init__(self, points: Any, tets: Any, body: Any = None, *, orient: bool = False) -> None:
        check_flag("orient", orient)
        points = points if to_numpy("points", points).size else np.empty((0, 3))
        tets = tets if to_numpy("tets", tets).size else np.empty((0, 4))
        self._points, self._tets = float_array("points", points, (None, 3)), int_array("tets", tets, (None, 4))
        self._check_indices()
        if orient:
            self._tets = oriented(self._points, self._tets)
        self._volume = self._checked_volume(orient)
        self._check_repeats()
        if body is None:
            self._body = np.zeros(self.num_vertices, dtype=np.int64)
        else:
            self._body = int_array("body", body, (self.num_vertices,))
            self._check_body()
        self._surface: IntArray | None = None
        for array in (self._points, self._tets, self._body, self._volume):
            array.flags.writeable = False

    def _check_indices(self) -> None:
        tets, count = self._tets, self.num_vertices
        if len(tets) and (tets.min() < 0 or tets.max() >= count):
            bad = np.nonzero(((tets < 0) | (tets >= count)).any(axis=1))[0]
            raise ValueError(
                f"tets: expected vertex indices from 0 to {count - 1}, got {tets[bad[0]].tolist()} "
                f"(out of range in {listed(bad, 'tet')})"
            )
        repeats = np.zeros(len(tets), dtype=bool)
        for i, j in ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)):
            repeats |= tets[:, i] == tets[:, j]
        if repeats.any():
            bad = np.nonzero(repeats)[0]
            raise ValueError(
                f"tets: expected four different vertices, got {tets[bad[0]].tolist()} "
                f"(repeated vertices in {listed(bad, 'tet')})"
            )

    def _check_repeats(self) -> None:
        """Raises where two tets have the same vertices: their mass would count twice, and no face would be outside."""
        # a sum of random numbers of the vertices, whatever their order: far quicker to sort than four columns
        mixed = np.random.default_rng(0).integers(0, 2**63, self.num_vertices, dtype=np.uint64)
        keys = mixed[self._tets[:, 0]]
        for k in (1, 2, 3):
            keys = keys + mixed[self._tets[:, k]]
        ranked = np.sort(keys)
        if not (ranked[1:] == ranked[:-1]).any():
            return
        _, first, found = np.unique(np.sort(self._tets, axis=1), axis=0, return_index=True, return_inverse=True)
        again = np.flatnonzero(first[found.reshape(-1)] != np.arange(self.num_tets))
        if len(again):
            row = self._tets[again[0]].tolist()
            raise ValueError(
                f"tets: expected each tet once, got the vertices {row} again in {listed(again, 'tet')}: leave them "
                "out (a Gmsh file may list a tet once for each of its groups)"
            )

    def _checked_volume(self, orient: bool) -> FloatArray:
        volume, product = signed_volume(self._points, self._tets)
        flat = np.abs(volume) <= FLAT * product
        if flat.any():
            raise ValueError(
                f"tets: expected positive volumes, got zero volume in {listed(np.nonzero(flat)[0], 'tet')}"
            )
        if (volume < 0).any() and not orient:
            bad = np.nonzero(volume < 0)[0]
            raise ValueError(
                f"tets: expected positive volumes, got inverted {listed(bad, 'tet')} of {self.num_tets} "
                "(orient=True flips them)"
            )
        return volume

    def _check_body(self) -> None:
        of_tets = self._body[self._tets]
        bad = np.nonzero((of_tets != of_tets[:, :1]).any(axis=1))[0]
        if len(bad):
            raise ValueError(
                f"body: expected one label per tet, got {of_tets[bad[0]].tolist()} (mixed in {listed(bad, 'tet')})"
            )

    @property
    def points(self) -> FloatArray:
        """Rest positions [m], shape [V, 3]."""
        return self._points

    @property
    def tets(self) -> IntArray:
        """Vertex indices of each tet, positively oriented, shape [T, 4]."""
        return self._tets

    @property
    def body(self) -> IntArray:
        """Body label of each vertex, shape [V]."""
        return self._body

    @property
    def volume(self) -> FloatArray:
        """Volume of each tet [m^3], shape [T]."""
        return self._volume

    @property
    def surface(self) -> IntArray:
        """Boundary triangles, shape [F, 3], normals outwards. They are the faces that belong to exactly one tet."""
        if self._surface is None:
            self._surface, _ = boundary_faces(self._tets, self.num_vertices)
            self._surface.flags.writeable = False
        return self._surface

    @property
    def quality(self) -> FloatArray:
        """Mean ratio of each tet, `12 (3 V)^(2/3) / sum of squared edges`, shape [T]: 1 is regular, 0 is flat.

        Source: Liu and Joe, "Relationship between tetrahedron shape measures", BIT 34, 1994.
        """
        squares = np.zeros(self.num_tets)
        for i, j in ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)):
            edge = self._points[self._tets[:, i]] - self._points[self._tets[:, j]]
            squares += np.einsum("ni,ni->n", edge, edge)
        return 12 * np.cbrt(3 * self._volume) ** 2 / squares

    @property
    def num_vertices(self) -> int:
        return len(self._points)

    @property
    def num_tets(self) -> int:
        return len(self._tets)

    @property
    def num_bodies(self) -> int:
        """Number of different body labels."""
        return len(np.unique(self._body))

    def translate(self, offset: Any) -> TetMesh:
        """A copy moved by `offset` [m], shape [3]."""
        return TetMesh(self._points + float_array("offset", offset, (3,)), self._tets, self._body)

    def transform(self, matrix: Any) -> TetMesh:
        """A copy with `matrix @ p` for every point p; `matrix` has shape [3, 3] and positive determinant.

        Rotations and stretches; a reflection would invert every tet and raises ValueError.
        """
        linear = float_array("matrix", matrix, (3, 3))
        determinant = np.linalg.det(linear)
        if determinant <= 0:
            raise ValueError(f"matrix: expected a positive determinant, got {determinant:.6g}")
        return TetMesh(self._points @ linear.T, self._tets, self._body)

    def save(self, path: str | PathLike[str]) -> None:
        """Write the mesh to a file; see `diffvbd.mesh.save`."""
        save(path, self)

    def __repr__(self) -> str:
        extent = np.ptp(self._points, axis=0) if self.num_vertices else np.zeros(3)
        return (
            f"TetMesh({self.num_vertices} vertices, {self.num_tets} tets, bodies: {self.num_bodies}, "
            f"extent {extent[0]:.4g} x {extent[1]:.4g} x {extent[2]:.4g} m)"
        )

    def __reduce__(self) -> tuple[Any, ...]:
        # Rebuilding restores the write protection, which copies of bare arrays would lose.
        return TetMesh, (self._points, self._tets, self._body)
