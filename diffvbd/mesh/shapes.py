"""Procedural bodies on structured grids, thin shells made by thickening a triangle surface, and smooth bodies.

Lengths are in metres and y points up. Boxes start at the origin; round shapes are centred on the y axis.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce
from typing import Any, Literal

import numpy as np

from diffvbd.mesh.arrays import FloatArray, IntArray, count, float_array, int_array, positive
from diffvbd.mesh.implicit import fill
from diffvbd.mesh.tet_mesh import TetMesh

Split = Literal["kuhn", "five"]

# Corner k of a cell lies at ((k >> 2) & 1, (k >> 1) & 1, k & 1). Kuhn: one tet per order of walking the axes from
# corner 0 to corner 7. Five: one regular tet and four corners; odd cells are mirrored so that faces match.
_KUHN = np.array([[0, 4, 6, 7], [0, 6, 2, 7], [0, 2, 3, 7], [0, 3, 1, 7], [0, 1, 5, 7], [0, 5, 4, 7]])
_FIVE_EVEN = np.array([[0, 6, 5, 3], [4, 0, 6, 5], [2, 0, 6, 3], [1, 0, 5, 3], [7, 6, 5, 3]])
_FIVE_ODD = 7 - _FIVE_EVEN


def _lengths(name: str, values: Any, dimensions: int) -> FloatArray:
    numbers = float_array(name, values, (dimensions,))
    if (numbers <= 0).any():
        raise ValueError(f"{name}: expected positive lengths, got {numbers.tolist()}")
    return numbers


def box(n: int | Sequence[int] = 2, size: float | Sequence[float] = 1.0, split: Split = "five") -> TetMesh:
    """Box with one corner at the origin.

    Args:
        n: Vertices (not cells) per axis, at least 2: one number or (nx, ny, nz). Vertex (i, j, k) has index
            (i ny + j) nz + k.
        size: Edge lengths [m]: one number or (x, y, z).
        split: "five" cuts each cell into 5 tets, mirrored from cell to cell; "kuhn" into 6 equal ones, all cells alike,
            whose diagonals point one way: a bar bends sideways by 11, 3 and 1 % of its sag with 3, 5 and 7 vertices
            across, with "five" by none where cells across are even in number and by less than 0.1 % from 3 cells on.

    Raises:
        TypeError, ValueError: a count that is no integer or below 2, a size that is not positive, an unknown split.
    """
    counts = [count("n", k, 2, "vertices") for k in (n if isinstance(n, (Sequence, np.ndarray)) else (n, n, n))]
    if len(counts) != 3:
        raise ValueError(f"n: expected one number or three, got {len(counts)}")
    lengths = _lengths("size", size if np.ndim(size) else [size] * 3, 3)
    if not isinstance(split, str) or split not in ("kuhn", "five"):
        raise ValueError(f'split: expected "kuhn" or "five", got {split!r}')
    axes = [np.linspace(0.0, extent, k) for extent, k in zip(lengths, counts, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    cells = np.stack(np.meshgrid(*(np.arange(k - 1) for k in counts), indexing="ij"), axis=-1).reshape(-1, 3)
    strides = np.array([counts[1] * counts[2], counts[2], 1])
    corner = np.arange(8)
    offsets = np.stack([(corner >> 2) & 1, (corner >> 1) & 1, corner & 1], axis=1) @ strides
    corners = (cells @ strides)[:, None] + offsets
    if split == "kuhn":
        tets = corners[:, _KUHN]
    else:
        odd = (cells.sum(axis=1) % 2 == 1)[:, None, None]
        tets = np.where(odd, corners[:, _FIVE_ODD], corners[:, _FIVE_EVEN])
    return TetMesh(points, tets.reshape(-1, 4), orient=True)


def beam(nx: int = 21, ny: int = 7, nz: int = 7, size: Sequence[float] = (0.5, 0.2, 0.2), split: Split = "five"
         ) -> TetMesh:  # fmt: skip
    """Beam along x: a box of nx, ny, nz vertices per axis. Arguments and errors as for `box`."""
    counts = [count(name, n, 2, "vertices") for name, n in (("nx", nx), ("ny", ny), ("nz", nz))]
    return box(counts, size, split)


def cube(n: int = 2, size: float = 1.0, split: Split = "five") -> TetMesh:
    """Cube with n vertices per axis; `cube()` has 8 vertices and 5 tets. Arguments and errors as for `box`."""
    return box(count("n", n, 2, "vertices"), positive("size", size), split)


def shell(points: Any, triangles: Any, thickness: float) -> TetMesh:
    """Thin shell: a triangle surface thickened by half of `thickness` to either side, each prism cut into 3 tets.

    The vertices of the negative side keep their index; those of the positive side follow, in the same order.

    Args:
        points: Middle surface [m], shape [P, 3].
        triangles: Vertex indices, shape [F, 3], wound alike. Prisms follow the averaged vertex normals.
        thickness: Distance between the two layers [m], small against the radius of curvature.

    Raises:
        TypeError, ValueError: bad shape, dtype or index, or a thickness that inverts prisms.
    """
    middle = float_array("points", points, (None, 3))
    faces = int_array("triangles", triangles, (None, 3))
    half = positive("thickness", thickness) / 2
    if len(faces) and (faces.min() < 0 or faces.max() >= len(middle)):
        got = f"{faces.min()}..{faces.max()}"
        raise ValueError(f"triangles: expected vertex indices from 0 to {len(middle) - 1}, got {got}")
    a, b, c = (middle[faces[:, k]] for k in range(3))
    normals = np.zeros_like(middle)
    face_normals = np.cross(b - a, c - a)
    for k in range(3):
        np.add.at(normals, faces[:, k], face_normals)
    norms = np.linalg.norm(normals, axis=1, keepdims=True)
    if (norms == 0).any():
        raise ValueError("triangles: expected a normal at every vertex, got vertices without triangles or folded ones")
    offset = half * normals / norms
    layers = np.concatenate([middle - offset, middle + offset])
    # Sorting each triangle makes the diagonal of a side wall depend on its two vertices alone, so that both
    # prisms at a wall agree, and rules out the cyclic arrangement that no three tets can fill.
    low = np.sort(faces, axis=1)
    high = low + len(middle)
    tets = np.concatenate([low, high], axis=1)[:, [[0, 1, 2, 5], [0, 1, 5, 4], [0, 3, 4, 5]]]
    # An odd permutation mirrors its prism. Undoing that here, not by the sign of the volume, lets TetMesh see
    # prisms that the thickness has turned inside out.
    rotated = low[:, None] == np.stack([faces, np.roll(faces, 1, axis=1), np.roll(faces, 2, axis=1)], axis=1)
    odd = ~rotated.all(axis=2).any(axis=1)
    tets[odd] = tets[odd][:, :, [0, 1, 3, 2]]
    return TetMesh(layers, tets.reshape(-1, 4))


def _grid_triangles(rows: int, columns: int, wrap: bool = False) -> IntArray:
    """Two triangles per cell of a rows x columns vertex grid, diagonals alternating; `wrap` closes the columns."""
    i, j = (k.ravel() for k in np.meshgrid(np.arange(rows - 1), np.arange(columns - (not wrap)), indexing="ij"))
    a, b = i * columns + j, (i + 1) * columns + j
    d, c = i * columns + (j + 1) % columns, (i + 1) * columns + (j + 1) % columns
    even = ((i + j) % 2 == 0)[:, None, None]
    one = np.stack([np.stack([a, b, c], 1), np.stack([a, c, d], 1)], axis=1)
    other = np.stack([np.stack([a, b, d], 1), np.stack([b, c, d], 1)], axis=1)
    return np.where(even, one, other).reshape(-1, 3)


def sheet(nx: int = 22, ny: int = 11, size: Sequence[float] = (0.6, 0.6), thickness: float = 0.01) -> TetMesh:
    """Flat cloth or flag: a thin 3-tet shell of 2 nx ny vertices in the xz plane, normal along y.

    The lower layer comes first; vertex (i, j) of a layer has index i ny + j.

    Args:
        nx, ny: Vertices along x and along z, at least 2.
        size: Extent along x and z [m]; one corner is at the origin.
        thickness: Extent along y [m], from -thickness/2 to +thickness/2.

    Raises:
        TypeError, ValueError: a count below 2, a size or thickness that is not positive.
    """
    columns, rows = count("nx", nx, 2), count("ny", ny, 2)
    extent = _lengths("size", size, 2)
    x, z = np.meshgrid(np.linspace(0, extent[0], columns), np.linspace(0, extent[1], rows), indexing="ij")
    points = np.stack([x.ravel(), np.zeros(x.size), z.ravel()], axis=1)
    # x cross z is -y: exchange two vertices so that the positive side is up.
    return shell(points, _grid_triangles(columns, rows)[:, [0, 2, 1]], thickness)


def disk(radius: float = 0.42, thickness: float = 0.06, resolution: int = 6) -> TetMesh:
    """Flat round disk, normal along y, centred at the origin: a 3-tet shell of concentric rings.

    Args:
        radius: [m].  thickness: Extent along y [m].
        resolution: Number of rings, at least 1; a layer has 1 + 3 r (r + 1) vertices.

    Raises:
        TypeError, ValueError: lengths that are not positive, resolution below 1.
    """
    radius, rings = positive("radius", radius), count("resolution", resolution, 1)
    ring = np.repeat(np.arange(1, rings + 1), 6 * np.arange(1, rings + 1))
    first = 1 + 3 * np.arange(rings + 1) * (np.arange(rings + 1) - 1)  # index of the first vertex of ring k
    first[0] = 0
    angle = 2 * np.pi * (np.arange(len(ring)) + 1 - first[ring]) / (6 * ring)
    ring_radius = radius * ring / rings
    points = np.zeros((1 + len(ring), 3))
    points[1:, 0], points[1:, 2] = ring_radius * np.cos(angle), -ring_radius * np.sin(angle)
    triangles = []
    for k in range(1, rings + 1):
        sector, step = (m.ravel() for m in np.meshgrid(np.arange(6), np.arange(k), indexing="ij"))

        def outer(s: IntArray, j: IntArray, k: int = k) -> IntArray:
            return first[k] + (s * k + j) % (6 * k)

        def inner(s: IntArray, j: IntArray, k: int = k) -> IntArray:
            return first[k - 1] + (s * (k - 1) + j) % max(6 * (k - 1), 1)

        triangles.append(np.stack([inner(sector, step), outer(sector, step), outer(sector, step + 1)], axis=1))
        s, j = sector[step < k - 1], step[step < k - 1]
        triangles.append(np.stack([inner(s, j), outer(s, j + 1), inner(s, j + 1)], axis=1))
    return shell(points, np.concatenate(triangles), thickness)


def dress(
    segments: int = 20,
    rings: int = 15,
    thickness: float = 0.01,
    neck_height: float = 1.45,
    hem_height: float = 0.65,
    scale: float = 1.0,
) -> TetMesh:
    """Sleeveless A-line dress about the y axis, open at neck and hem: a 3-tet shell of 2 segments rings vertices.

    The default has 600 vertices; `dress(22, 21)` has 924. Vertex (i, j) of a layer, ring i counted from the neck, has
    index i segments + j; the inner layer comes first.

    Args:
        segments: Vertices around, at least 4.  rings: Vertices from neck to hem, at least 4.
        thickness: Distance between the layers [m].
        neck_height, hem_height: Height of the openings [m].
        scale: Factor on all radii; at 1 the neck has radius 0.11 m, the waist 0.16 m, the hem 0.36 m.

    Raises:
        TypeError, ValueError: counts below 4, lengths that are not positive, the hem not below the neck.
    """
    around, down = count("segments", segments, 4), count("rings", rings, 4)
    neck, hem = float(float_array("neck_height", neck_height, ())), float(float_array("hem_height", hem_height, ()))
    if hem >= neck:
        raise ValueError(f"hem_height: expected less than neck_height = {neck:.6g}, got {hem:.6g}")
    # (radius, height) from the neck over the shoulders to the waist and the hem, in fractions of the drop.
    outline_radius = positive("scale", scale) * np.array([0.11, 0.19, 0.2, 0.16, 0.2, 0.36])
    outline_height = neck - (neck - hem) * np.array([0.0, 0.05, 0.16, 0.42, 0.56, 1.0])
    travelled = np.concatenate([[0], np.cumsum(np.hypot(np.diff(outline_radius), np.diff(outline_height)))])
    at = np.linspace(0, travelled[-1], down)
    radius, height = np.interp(at, travelled, outline_radius), np.interp(at, travelled, outline_height)
    angle = 2 * np.pi * np.arange(around) / around
    x, z = np.outer(radius, np.cos(angle)), np.outer(radius, np.sin(angle))
    y = np.repeat(height[:, None], around, axis=1)
    points = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    return shell(points, _grid_triangles(down, around, wrap=True)[:, [0, 2, 1]], thickness)


def capsule(radius: float = 0.1, length: float = 0.3, resolution: int = 6) -> TetMesh:
    """Cylinder with round ends, axis along y, centred at the origin.

    Args:
        radius: [m].  length: Of the cylindrical part [m]; 0 gives a ball.
        resolution: Lattice cells across the diameter, at least 3.

    Raises:
        TypeError, ValueError: radius not positive, length negative, resolution below 3.
    """
    radius, cells = positive("radius", radius), count("resolution", resolution, 3)
    half = float(float_array("length", length, ())) / 2
    if half < 0:
        raise ValueError(f"length: expected 0 or more, got {2 * half:.6g}")

    def body(points: FloatArray) -> FloatArray:
        to_axis = points.copy()
        to_axis[:, 1] -= np.clip(points[:, 1], -half, half)
        return np.linalg.norm(to_axis, axis=1) - radius

    corner = np.array([radius, half + radius, radius])
    return fill(body, -corner, corner, 2 * radius / cells)


def blob(resolution: int = 7, seed: int = 0, radius: float = 0.15) -> TetMesh:
    """Smooth random body around the origin: a ball whose radius varies with direction by at most a quarter.

    Args:
        resolution: Lattice cells across the mean diameter, at least 4.
        seed: Equal seeds give equal bodies.
        radius: Mean radius [m], about.

    Raises:
        TypeError, ValueError: resolution below 4, a seed that is negative or no integer, radius not positive.
    """
    radius, cells = positive("radius", radius), count("resolution", resolution, 4)
    random = np.random.default_rng(count("seed", seed, 0))
    waves, phases = random.normal(scale=2.0, size=(6, 3)), random.uniform(0, 2 * np.pi, size=6)
    weights = random.dirichlet(np.ones(6)) * 0.25

    def body(points: FloatArray) -> FloatArray:
        distance = np.linalg.norm(points, axis=1)
        direction = points / np.maximum(distance, 1e-12 * radius)[:, None]
        return distance - radius * (1 + np.cos(direction @ waves.T + phases) @ weights)

    corner = np.full(3, 1.25 * radius)
    return fill(body, -corner, corner, 2 * radius / cells)


def bunny(resolution: int = 9, height: float = 0.3) -> TetMesh:
    """Rabbit made of five blended ellipsoids (body, head, two ears, tail), sitting on y = 0 and looking along x.

    Args:
        resolution: Lattice cells over the height, at least 8. The default, 9, has 341 vertices and 1,155 tets.
        height: From the floor to the tips of the ears [m], about.

    Raises:
        TypeError, ValueError: resolution below 8, height not positive.
    """
    cells, scale = count("resolution", resolution, 8), positive("height", height) / 1.15

    def body(points: FloatArray) -> FloatArray:
        unit = points / scale
        parts = [
            _ellipsoid(unit, (0.0, 0.28, 0.0), (0.4, 0.28, 0.26)),
            _ellipsoid(unit, (0.3, 0.58, 0.0), (0.21, 0.19, 0.18)),
            _ellipsoid(unit, (0.2, 0.9, 0.11), (0.1, 0.27, 0.08), tilt=0.2),
            _ellipsoid(unit, (0.2, 0.9, -0.11), (0.1, 0.27, 0.08), tilt=0.2),
            _ellipsoid(unit, (-0.4, 0.3, 0.0), (0.12, 0.12, 0.12)),
        ]
        return reduce(_blend, parts)

    low, high = np.array([-0.56, -0.03, -0.3]), np.array([0.56, 1.17, 0.3])
    return fill(body, scale * low, scale * high, scale * 1.15 / cells)


def _ellipsoid(points: FloatArray, centre: tuple[float, float, float], radii: tuple[float, float, float],
               tilt: float = 0.0) -> FloatArray:  # fmt: skip
    """Implicit ellipsoid, turned about z by `tilt` [rad]; near its surface about a distance."""
    cos, sin = np.cos(tilt), np.sin(tilt)
    local = (points - np.array(centre)) @ np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    return (np.linalg.norm(local / np.array(radii), axis=1) - 1) * min(radii)


def _blend(a: FloatArray, b: FloatArray, width: float = 0.06) -> FloatArray:
    """Union of two bodies whose seam is rounded over `width`: a smooth minimum."""
    overlap = np.maximum(width - np.abs(a - b), 0) / width
    return np.minimum(a, b) - width / 4 * overlap**2
