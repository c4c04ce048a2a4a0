"""Pictures of soft bodies. Needs matplotlib (extra [viz]), imported only when something is drawn."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

COLORS = {"initial": "#4c78a8", "target": "#e4704f", "recovered": "#4f9d5b"}
OTHER = "#8c8c8c"
BODIES = ("#4c78a8", "#e4704f", "#4f9d5b")


def comparison(
    path: str | Path,
    surface: NDArray[np.int64],
    motions: Mapping[str, Any],
    times: Sequence[float],
    history: Sequence[Mapping[str, float]] = (),
    truth: Mapping[str, float] | None = None,
) -> None:
    """Save a grid of shapes, one row per motion and one column per time, beside the course of an optimisation.

    Args:
        path: The picture to write; the suffix chooses the format.
        surface: Boundary triangles, shape [F, 3], as `TetMesh.surface`.
        motions: Positions [m] to show of each motion by name, shape [N, V, 3], array or tensor; y points up.
        times: Their times [s], length N.
        history: Rows with "loss" and the estimates named in truth, as the task runner keeps them.
        truth: True values of estimates; their relative error is drawn.

    Raises:
        ImportError: matplotlib is not installed.
    """
    frames = {name: _array(motion) for name, motion in motions.items()}
    everything = np.concatenate([shape.reshape(-1, 3) for shape in frames.values()])
    low, high = everything.min(0), everything.max(0)

    columns = len(times)
    figure = _figure(3.0 * columns + (4.2 if history else 0.0), 2.3 * len(frames))
    shapes, charts = figure, None
    if history:
        shapes, charts = figure.subfigures(1, 2, width_ratios=(3.0 * columns, 4.2))
    for row, (name, shown) in enumerate(frames.items()):
        for column, points in enumerate(shown):
            axes = shapes.add_subplot(len(frames), columns, row * columns + column + 1, projection="3d")
            draw(axes, points, surface, COLORS.get(name, OTHER), (low, high))
    left, top = 0.06, 0.93
    shapes.subplots_adjust(left=left, right=1.0, bottom=0.0, top=top, wspace=0.0, hspace=0.0)
    for row, name in enumerate(frames):
        height = top * (1.0 - (row + 0.5) / len(frames))
        style = {"rotation": 90, "ha": "center", "va": "center", "fontsize": 13, "color": COLORS.get(name, OTHER)}
        shapes.text(0.5 * left, height, name, **style)
    for column, time in enumerate(times):
        middle = left + (1.0 - left) * (column + 0.5) / columns
        shapes.text(middle, 0.96, f"t = {1e3 * time:.0f} ms", ha="center", va="center", fontsize=13)
    if charts is not None:
        _course(charts, history, truth or {})
    figure.savefig(path)


def landing(
    path: str | Path,
    surfaces: Sequence[NDArray[np.int64]],
    frames: Any,
    times: Sequence[float],
    radius: float,
    history: Sequence[Mapping[str, float]],
) -> None:
    """Save bodies and the round target they land on: the last frame from above, the course of the optimisation, and
    every frame from the side.

    Args:
        path: The picture to write; the suffix chooses the format.
        surfaces: Boundary triangles of each body, shape [F, 3], as rows of the frames.
        frames: Positions [m], shape [N, V, 3], array or tensor; y points up, and the floor is at y = 0.
        times: Their times [s], length N.
        radius: Of the target about the y axis [m].
        history: Rows with "loss" and "uncovered", a share.

    Raises:
        ImportError: matplotlib is not installed.
    """
    shown = _array(frames)
    figure = _figure(3.3 * len(times), 8.0)
    from matplotlib.collections import PolyCollection
    from matplotlib.patches import Circle

    colors = [BODIES[k % len(BODIES)] for k in range(len(surfaces))]
    above, below = figure.subfigures(2, 1, height_ratios=(1.0, 1.3))
    left, right = above.subfigures(1, 2, width_ratios=(1.0, 1.5))
    view = left.add_subplot()
    view.add_patch(Circle((0.0, 0.0), radius, color="#cccccc"))
    for surface, color in zip(surfaces, colors, strict=True):
        triangles = shown[-1][surface][..., ::2]
        edges = np.diff(triangles, axis=1)
        # those that face up: one transparent layer for each body
        up = edges[:, 0, 1] * edges[:, 1, 0] > edges[:, 0, 0] * edges[:, 1, 1]
        view.add_collection(PolyCollection(triangles[up], facecolors=color, edgecolors=color, lw=0.5, alpha=0.4))
    view.add_patch(Circle((0.0, 0.0), radius, fill=False, color="black", linewidth=1.5))
    view.set(aspect="equal", xlabel="x [m]", ylabel="z [m]")
    view.autoscale_view()
    view.invert_yaxis()
    left.subplots_adjust(left=0.2, right=0.98, bottom=0.16, top=0.96)

    charts = right.subplots(2, 1, sharex=True)
    for axes, key, scale, label in zip(charts, ("loss", "uncovered"), (1, 100), ("loss", "uncovered [%]"), strict=True):
        axes.plot([scale * row[key] for row in history], color="#333333")
        axes.set_ylabel(label)
        axes.grid(alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
    charts[0].set_yscale("log")
    charts[0].tick_params(which="minor", labelleft=False)
    charts[1].set_xlabel("iteration")
    right.subplots_adjust(left=0.14, right=0.97, bottom=0.16, top=0.96, hspace=0.12)

    corners = shown.reshape(-1, 3)
    bounds = np.minimum(corners.min(0), [-radius, 0.0, -radius]), np.maximum(corners.max(0), [radius, 0.0, radius])
    angle = np.linspace(0, 2 * np.pi, 73)
    for column, (points, time) in enumerate(zip(shown, times, strict=True)):
        axes = below.add_subplot(1, len(times), column + 1, projection="3d", computed_zorder=False)
        axes.plot(radius * np.sin(angle), radius * np.cos(angle), 0.0, color="black", linewidth=1.0, clip_on=False)
        # upper bodies hide lower ones: matplotlib sorts whole bodies by their distance, which fails in a stack
        for surface, color in sorted(zip(surfaces, colors, strict=True), key=lambda body: points[body[0], 1].mean()):
            draw(axes, points, surface, color, bounds)
        below.text((column + 0.5) / len(times), 0.96, f"t = {time:.2f} s", ha="center", va="center", fontsize=12)
    below.subplots_adjust(left=0.0, right=1.0, bottom=0.06, top=0.86, wspace=0.0)
    figure.savefig(path)


def draw(axes: Any, points: Any, surface: NDArray[np.int64], color: str, bounds: tuple[Any, Any] | None = None) -> None:
    """Draw one shape into a matplotlib 3D axes.

    Args:
        axes: Axes with projection "3d".
        points: Positions [m], shape [V, 3], array or tensor; y points up.
        surface: Boundary triangles, outward oriented, shape [F, 3].
        color: Any matplotlib color.
        bounds: Lowest and highest corner [m] of the box to show; default: that of the points.
    """
    from matplotlib.colors import to_rgb
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    # matplotlib's up is its third axis: y goes there by a cyclic exchange, which keeps the handedness.
    cyclic = [2, 0, 1]
    triangles = _array(points)[surface][..., cyclic]
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    light = np.array([0.6, 0.3, 0.8])
    # Half-Lambert shading: faces turned away from the light stay readable.
    brightness = 0.35 + 0.65 * (0.5 + 0.5 * normals @ (light / np.linalg.norm(light)))
    faces = np.clip(brightness[:, None] * (0.25 + 0.85 * np.array(to_rgb(color))), 0.0, 1.0)
    edges = 0.8 * faces
    body = Poly3DCollection(triangles, facecolors=faces, edgecolors=edges, linewidths=0.25, clip_on=False)
    axes.add_collection3d(body)
    low, high = (corner[cyclic] for corner in bounds) if bounds else (triangles.min((0, 1)), triangles.max((0, 1)))
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axes.set_box_aspect(np.maximum(high - low, 1e-9), zoom=1.25)
    axes.view_init(elev=16, azim=32)
    axes.set_axis_off()


def _course(figure: Any, history: Sequence[Mapping[str, float]], truth: Mapping[str, float]) -> None:
    iterations = np.arange(len(history))
    charts = figure.subplots(2 if truth else 1, 1, sharex=True, squeeze=False)[:, 0]
    charts[0].semilogy(iterations, [row["loss"] for row in history], color="#333333")
    charts[0].set_ylabel("loss")
    charts[-1].set_xlabel("iteration")
    if truth:
        for name, true in truth.items():
            charts[1].semilogy(iterations, [abs(row[name] / true - 1) for row in history], label=name)
        charts[1].set_ylabel("relative error")
        charts[1].legend(frameon=False)
    for axes in charts:
        axes.grid(alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
    figure.subplots_adjust(left=0.2, right=0.96, bottom=0.1, top=0.95, hspace=0.12)


def _array(values: Any) -> NDArray[np.float64]:
    values = values.detach().cpu().numpy() if hasattr(values, "detach") else values
    return np.asarray(values, dtype=np.float64)


def _figure(width: float, height: float) -> Any:
    try:
        # Not pyplot: it would choose a window system, and pictures are only written to files.
        from matplotlib.figure import Figure
    except ImportError:
        raise ImportError("pictures need matplotlib: pip install 'diffvbd[viz]'") from None
    return Figure(figsize=(width, height), dpi=130)
