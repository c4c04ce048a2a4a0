"""Scenery around bodies, and arrays of positions: what every kind of picture shares."""

import importlib
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from diffvbd.mesh.arrays import float_array, to_numpy

from .._common.checks import check_count, check_positive

SCENERY = "#c8c8c8"


class Scenery(NamedTuple):
    """Something that does not move, or another body: points [m] [P, 3], triangles [F, 3], a color."""

    points: NDArray[np.float64]
    triangles: NDArray[np.int64]
    color: str = SCENERY


def floor(low: Sequence[float], high: Sequence[float], height: float = 0.0, cells: int = 8) -> Scenery:
    """A floor: the rectangle from (low x, low z) to (high x, high z) [m] at a height [m]."""
    cells = check_count("cells", cells, 1, 10_000)
    first, last = (float_array(name, value, (None,)) for name, value in (("low", low), ("high", high)))
    x, z = (np.linspace(first[k], last[k], cells + 1) for k in (0, -1))
    points = np.stack(np.meshgrid(x, float_array("height", height, ()), z, indexing="ij"), -1).reshape(-1, 3)
    i, j = (k.ravel() for k in np.meshgrid(np.arange(cells), np.arange(cells), indexing="ij"))
    a = i * (cells + 1) + j
    b, c, d = a + 1, a + cells + 2, a + cells + 1
    return Scenery(points, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]), "#e6e6e6")


def box(low: Sequence[float], high: Sequence[float], color: str = SCENERY) -> Scenery:
    """A box between two corners [m], open above."""
    ends = float_array("low", low, (3,)), float_array("high", high, (3,))
    corners = np.stack(np.meshgrid(*zip(*ends, strict=True), indexing="ij"), -1).reshape(-1, 3)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (0, 2, 6, 4), (1, 5, 7, 3)]
    triangles = [t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))]
    return Scenery(corners, np.array(triangles), color)


def capsule(a: Sequence[float], b: Sequence[float], radius: float, color: str = SCENERY) -> Scenery:
    """All points within a radius [m] of the segment from a to b [m]; a ball if a = b."""
    start, end, radius = float_array("a", a, (3,)), float_array("b", b, (3,)), check_positive("radius", radius, "m")
    along = end - start
    length = np.linalg.norm(along)
    axis = along / length if length > 0 else np.array([0.0, 1.0, 0.0])
    side = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    side /= np.linalg.norm(side)
    around, half = 20, 6
    rise = np.linspace(-np.pi / 2, 0, half)
    rings = [(start, t) for t in rise] + [(end, -t) for t in rise[::-1]][int(length == 0) :]  # a ball has one equator
    angle = 2 * np.pi * np.arange(around) / around
    circle = np.outer(np.cos(angle), side) + np.outer(np.sin(angle), np.cross(axis, side))
    points = np.concatenate([c + radius * (np.sin(t) * axis + np.cos(t) * circle) for c, t in rings])
    i, j = (k.ravel() for k in np.meshgrid(np.arange(len(rings) - 1), np.arange(around), indexing="ij"))
    p, q = i * around + j, i * around + (j + 1) % around
    triangles = np.concatenate([np.stack([p, q, q + around], 1), np.stack([p, q + around, p + around], 1)])
    return Scenery(points, triangles, color)


def optional(module: str, what: str) -> Any:
    """A module of a package of the extra [viz]; an ImportError says what needs it."""
    try:
        return importlib.import_module(module)
    except ImportError:
        raise ImportError(f"{what} {module.partition('.')[0]}: pip install 'diffvbd[viz]'") from None


def as_array(values: Any) -> NDArray[np.float64]:
    """An array or tensor of any device, as float64."""
    values = values.detach().cpu().numpy() if hasattr(values, "detach") else values
    return np.asarray(values, dtype=np.float64)


def check_surface(surface: Any, vertices: int) -> None:
    """Raises ValueError for what is not a list of triangles of so many vertices."""
    surface = to_numpy("surface", surface)
    if surface.size and surface.dtype.kind not in "iu":
        raise TypeError(f"surface: expected integers, got dtype {surface.dtype}")
    shape, last = list(surface.shape), surface.max(initial=-1)
    if len(shape) != 2 or shape[1] != 3 or last >= vertices:
        raise ValueError(
            f"surface: expected triangles [F, 3] of {vertices} vertices, got shape {shape} with indices up to {last}"
        )


def motions_as_arrays(
    motions: Mapping[str, Any], surface: Any, times: int | None = None
) -> dict[str, NDArray[np.float64]]:
    """Positions of each motion, shape [N, V, 3]; ValueError for another shape, another N than there are times, or a
    surface of other vertices."""
    if not isinstance(motions, Mapping):
        raise TypeError(f"motions: expected positions by name, got {type(motions).__name__}")
    frames = {name: as_array(motion) for name, motion in motions.items()}
    for name, motion in frames.items():
        if motion.ndim != 3 or motion.shape[-1] != 3 or times not in (None, len(motion)):
            count = "N" if times is None else f"N = {times}"
            raise ValueError(f"motions[{name!r}]: expected shape [{count}, V, 3], got {list(motion.shape)}")
        check_surface(surface, motion.shape[1])
    return frames
