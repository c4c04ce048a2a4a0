"""Bodies, scenery, axes and colors: the parts of every picture."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from diffvbd.mesh.arrays import float_array, to_numpy

from .._common.checks import check_count, check_positive

COLORS = {"initial": "#4c78a8", "target": "#e4704f", "recovered": "#4f9d5b"}
OTHER = "#8c8c8c"
BODIES = ("#4c78a8", "#e4704f", "#4f9d5b")
INK = "#333333"
SCENERY = "#c8c8c8"
VIEW = (16.0, 32.0)  # elevation and azimuth of the eye [degrees]


class Scenery(NamedTuple):
    """Something that does not move, or another body: points [m] [P, 3], triangles [F, 3], a color."""

    points: NDArray[np.float64]
    triangles: NDArray[np.int64]
    color: str = SCENERY


def draw(
    axes: Any,
    points: Any,
    surface: NDArray[np.int64],
    color: Any,
    bounds: tuple[Any, Any] | None = None,
    scenery: Sequence[Scenery] = (),
    view: tuple[float, float] = VIEW,
) -> None:
    """One shape, drawn into a matplotlib 3D axes.

    Args:
        axes: Axes with projection "3d".
        points: Positions [m], shape [V, 3], array or tensor; y points up.
        surface: Boundary triangles, outward oriented, shape [F, 3].
        color: Any matplotlib color, or one RGB for each triangle, shape [F, 3].
        bounds: Lowest and highest corner [m] of the box to show; default: that of the points.
        scenery: What else is there.
        view: Elevation and azimuth of the eye [degrees].

    Raises:
        ValueError: no triangles of the points.
    """
    from matplotlib.colors import to_rgb
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    # matplotlib's up is its third axis: y goes there by a cyclic exchange, which keeps the handedness.
    cyclic = [2, 0, 1]
    vertices = as_array(points)
    check_surface(surface, len(vertices))
    body = vertices[surface][..., cyclic]
    parts, colors = [body], [np.broadcast_to(to_rgb(color) if isinstance(color, str) else color, (len(body), 3))]
    for thing in scenery:
        parts.append(as_array(thing.points)[thing.triangles][..., cyclic])
        colors.append(np.broadcast_to(to_rgb(thing.color), (len(parts[-1]), 3)))
    # One collection: matplotlib sorts the triangles of one by depth, but not those of several.
    triangles, rgb = np.concatenate(parts), np.concatenate(colors)
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    light = np.array([0.6, 0.3, 0.8])
    # Half-Lambert shading: faces turned away from the light stay readable.
    brightness = 0.35 + 0.65 * (0.5 + 0.5 * normals @ (light / np.linalg.norm(light)))
    faces = np.clip(brightness[:, None] * (0.25 + 0.85 * rgb), 0.0, 1.0)
    axes.add_collection3d(
        Poly3DCollection(triangles, facecolors=faces, edgecolors=0.8 * faces, linewidths=0.25, clip_on=False)
    )
    low, high = (as_array(corner)[cyclic] for corner in bounds) if bounds else (body.min((0, 1)), body.max((0, 1)))
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axes.set_box_aspect(np.maximum(high - low, 1e-9), zoom=1.15)
    axes.view_init(elev=view[0], azim=view[1])
    axes.set_axis_off()


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


def tidy(axes: Any) -> None:
    """A faint grid, and no frame at the top and on the right."""
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)


def course(figure: Any, history: Sequence[Mapping[str, float]], truth: Mapping[str, float]) -> None:
    """Charts of the loss and of relative errors over iterations."""
    iterations = np.arange(len(history))
    charts = figure.subplots(2 if truth else 1, 1, sharex=True, squeeze=False)[:, 0]
    charts[0].semilogy(iterations, [row["loss"] for row in history], color=INK)
    charts[0].set_ylabel("loss")
    charts[-1].set_xlabel("iteration")
    if truth:
        for name, true in truth.items():
            charts[1].semilogy(iterations, [abs(row[name] / true - 1) for row in history], label=name)
        charts[1].set_ylabel("relative error")
        charts[1].legend(frameon=False)
    for axes in charts:
        tidy(axes)
    figure.subplots_adjust(left=0.2, right=0.96, bottom=0.1, top=0.95, hspace=0.12)


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
    """Positions of each motion, shape [N, V, 3].

    Raises:
        ValueError: another shape, another N than there are times, or a surface of other vertices.
    """
    if not isinstance(motions, Mapping):
        raise TypeError(f"motions: expected positions by name, got {type(motions).__name__}")
    frames = {name: as_array(motion) for name, motion in motions.items()}
    for name, motion in frames.items():
        if motion.ndim != 3 or motion.shape[-1] != 3 or times not in (None, len(motion)):
            count = "N" if times is None else f"N = {times}"
            raise ValueError(f"motions[{name!r}]: expected shape [{count}, V, 3], got {list(motion.shape)}")
        check_surface(surface, motion.shape[1])
    return frames


def new_figure(width: float, height: float, dots: int = 130) -> Any:
    """A figure [inches]; an ImportError that says what is missing."""
    try:
        # Not pyplot: it would choose a window system, and pictures are only written to files.
        from matplotlib.figure import Figure
    except ImportError:
        raise ImportError("pictures need matplotlib: pip install 'diffvbd[viz]'") from None
    return Figure(figsize=(width, height), dpi=dots)


def save_motion(
    path: str | Path, figure: Any, show: Callable[[int], None], frames: Sequence[int], seconds: float
) -> None:
    """Write a .gif of `show(k)` for these k; it runs for the time given [s], or 2 s where that is less."""
    from matplotlib.animation import FuncAnimation, PillowWriter

    rate = max(1, round(len(frames) / max(2.0, seconds)))
    FuncAnimation(figure, show, frames=frames).save(path, PillowWriter(fps=rate))


def bounds_of(shapes: Sequence[Any]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Lowest and highest corner [m] of arrays of positions, shape [..., 3]."""
    everything = np.concatenate([as_array(shape).reshape(-1, 3) for shape in shapes])
    return everything.min(0), everything.max(0)
