"""Tetrahedral meshes, checked once and immutable afterwards, and new meshes from old ones."""

from __future__ import annotations

from collections.abc import Iterable
from os import PathLike
from typing import Any

import numpy as np

from diffvbd.mesh.arrays import FloatArray, IntArray, check_flag, check_mesh, float_array, int_array, listed, to_numpy
from diffvbd.mesh.write import save

# Faces of a positively oriented tet, wound so that their normals point out of it.
TET_FACES = np.array([[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]])
EDGES = np.array([[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]])

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


def inner_faces(tets: IntArray) -> tuple[IntArray, IntArray]:
    """Faces that two tets share, [F] each: for either of them, four times the tet plus the corner opposite."""
    faces = np.sort(tets[:, TET_FACES].reshape(-1, 3), axis=1)
    order = np.lexsort(faces.T)
    same = (faces[order[1:]] == faces[order[:-1]]).all(axis=1)
    return order[:-1][same], order[1:][same]


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
    last, groups = int(block.max()), [np.arange(len(faces))]
    if last > 0:
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
            got = f"{tets[bad[0]].tolist()} (out of range in {listed(bad, 'tet')})"
            raise ValueError(f"tets: expected vertex indices from 0 to {count - 1}, got {got}")
        repeats = np.zeros(len(tets), dtype=bool)
        for i, j in EDGES:
            repeats |= tets[:, i] == tets[:, j]
        if repeats.any():
            bad = np.nonzero(repeats)[0]
            got = f"{tets[bad[0]].tolist()} (repeated vertices in {listed(bad, 'tet')})"
            raise ValueError(f"tets: expected four different vertices, got {got}")

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
            bad = listed(np.nonzero(flat)[0], "tet")
            raise ValueError(f"tets: expected positive volumes, got zero volume in {bad}")
        if (volume < 0).any() and not orient:
            bad = f"{listed(np.nonzero(volume < 0)[0], 'tet')} of {self.num_tets}"
            raise ValueError(f"tets: expected positive volumes, got inverted {bad} (orient=True flips them)")
        return volume

    def _check_body(self) -> None:
        of_tets = self._body[self._tets]
        bad = np.nonzero((of_tets != of_tets[:, :1]).any(axis=1))[0]
        if len(bad):
            got = f"{of_tets[bad[0]].tolist()} (mixed in {listed(bad, 'tet')})"
            raise ValueError(f"body: expected one label per tet, got {got}")

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
        for i, j in EDGES:
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
        counts = f"{self.num_vertices} vertices, {self.num_tets} tets, bodies: {self.num_bodies}"
        return f"TetMesh({counts}, extent {extent[0]:.4g} x {extent[1]:.4g} x {extent[2]:.4g} m)"

    def __reduce__(self) -> tuple[Any, ...]:
        # Rebuilding restores the write protection, which copies of bare arrays would lose.
        return TetMesh, (self._points, self._tets, self._body)


MOST_TETS = 10**9  # of a mesh that is refined
# The midpoint of edge k stands at slot 4 + k of a ten-node tet.
_CORNER_TETS = np.array([[0, 4, 5, 6], [4, 1, 7, 8], [5, 7, 2, 9], [6, 8, 9, 3]])
# The inner octahedron has three diagonals, between midpoints of opposite edges. Each row: the four tets around one.
_DIAGONALS = np.array([[4, 9], [5, 8], [6, 7]])
_INNER_TETS = np.array([[[4, 9, 5, 6], [4, 9, 6, 8], [4, 9, 8, 7], [4, 9, 7, 5]],
                        [[5, 8, 6, 4], [5, 8, 9, 6], [5, 8, 7, 9], [5, 8, 4, 7]],
                        [[6, 7, 4, 5], [6, 7, 5, 9], [6, 7, 9, 8], [6, 7, 8, 4]]])  # fmt: skip


def subdivide(mesh: TetMesh, levels: int = 1) -> TetMesh:
    """Regular refinement: every tet becomes eight, of one eighth of its volume each.

    The old vertices keep their indices; one midpoint per edge follows. Each inner octahedron is cut along its shortest
    diagonal, which bounds the decline of quality over repeated refinement (Zhang, "Successive subdivisions of
    tetrahedra", Houston J. Math. 21, 1995). Body labels are kept.

    Args:
        mesh: The mesh to refine; it stays as it is.
        levels: How often, 0 or more.

    Raises:
        TypeError, ValueError: no TetMesh; levels is not an integer or negative.
    """
    check_mesh(mesh)
    if isinstance(levels, bool) or not isinstance(levels, (int, np.integer)):
        raise TypeError(f"levels: expected an integer, got {levels!r}")
    if levels < 0:
        raise ValueError(f"levels: expected 0 or more, got {levels}")
    if mesh.num_tets * 8 ** min(levels, 11) > MOST_TETS:
        raise ValueError(f"levels: expected at most {MOST_TETS} tets, got {mesh.num_tets} times 8^{levels}")
    for _ in range(levels):
        mesh = _refined(mesh)
    return mesh


def _refined(mesh: TetMesh) -> TetMesh:
    ends = np.sort(mesh.tets[:, EDGES].reshape(-1, 2), axis=1)
    edges, edge_of = np.unique(ends[:, 0] * max(mesh.num_vertices, 1) + ends[:, 1], return_inverse=True)
    low, high = np.divmod(edges, max(mesh.num_vertices, 1))
    points = np.concatenate([mesh.points, (mesh.points[low] + mesh.points[high]) / 2])
    nodes = np.concatenate([mesh.tets, mesh.num_vertices + edge_of.reshape(-1, 6)], axis=1)
    spans = points[nodes[:, _DIAGONALS[:, 0]]] - points[nodes[:, _DIAGONALS[:, 1]]]
    shortest = np.einsum("nki,nki->nk", spans, spans).argmin(axis=1)
    inner = np.take_along_axis(nodes, _INNER_TETS[shortest].reshape(-1, 16), axis=1)
    tets = np.concatenate([nodes[:, _CORNER_TETS].reshape(-1, 16), inner], axis=1).reshape(-1, 4)
    return TetMesh(points, tets, np.concatenate([mesh.body, mesh.body[low]]))


def _ranked(mesh: TetMesh) -> tuple[IntArray, int]:
    """Body labels replaced by their rank, and how many there are."""
    labels, rank = np.unique(mesh.body, return_inverse=True)
    return rank, len(labels)


def join(meshes: Iterable[TetMesh]) -> TetMesh:
    """All meshes side by side in one, vertices and tets in the order given. Nothing is merged.

    Bodies stay apart: labels of the result count up from 0 through the bodies of the first mesh (in the order of its
    labels), then those of the second, and so on.

    Raises:
        TypeError: something that is not a TetMesh, or no sequence of them.
    """
    if not isinstance(meshes, Iterable):
        raise TypeError(f"meshes: expected TetMesh objects, as in a list, got {type(meshes).__name__}")
    meshes = list(meshes)
    for k, mesh in enumerate(meshes):
        if not isinstance(mesh, TetMesh):
            raise TypeError(f"meshes: expected TetMesh objects, got {type(mesh).__name__} at {k}")
    if not meshes:
        return TetMesh([], [])
    ranked = {id(mesh): _ranked(mesh) for mesh in {id(mesh): mesh for mesh in meshes}.values()}
    vertices = np.array([mesh.num_vertices for mesh in meshes])
    vertex_start = np.cumsum(vertices) - vertices
    bodies = np.array([ranked[id(mesh)][1] for mesh in meshes])
    body_start = np.cumsum(bodies) - bodies
    tets = np.concatenate([mesh.tets for mesh in meshes])
    tets += np.repeat(vertex_start, [mesh.num_tets for mesh in meshes])[:, None]
    body = np.concatenate([ranked[id(mesh)][0] for mesh in meshes]) + np.repeat(body_start, vertices)
    return TetMesh(np.concatenate([mesh.points for mesh in meshes]), tets, body)


def replicate(mesh: TetMesh, offsets: Any) -> TetMesh:
    """N translated copies of one mesh as N times as many bodies; a million cubes take seconds.

    Args:
        mesh: The mesh to copy.
        offsets: Translation of each copy [m], shape [N, 3].

    Raises:
        TypeError, ValueError: no TetMesh; offsets of wrong shape or dtype, NaN or Inf.
    """
    check_mesh(mesh)
    moves = float_array("offsets", offsets, (None, 3))
    copies = np.arange(len(moves))[:, None]
    rank, bodies = _ranked(mesh)
    return TetMesh(
        (mesh.points + moves[:, None]).reshape(-1, 3),
        (mesh.tets + (copies * mesh.num_vertices)[..., None]).reshape(-1, 4),
        (rank + copies * bodies).ravel(),
    )
