"""Pictures of results, drawn by matplotlib: motions, clouds of bodies, fields, landings, learning, paths."""

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffvbd.mesh.arrays import to_path
from diffvbd.mesh.shapes import cube
from diffvbd.mesh.tet_mesh import boundary_faces
from diffvbd.viz.drawing import (
    BODIES,
    COLORS,
    INK,
    OTHER,
    VIEW,
    Scenery,
    as_array,
    bounds_of,
    course,
    draw,
    floor,
    motions_as_arrays,
    new_figure,
    save_motion,
    tidy,
)
from diffvbd.viz.motion import save_motions

from .._common.checks import check_positive

FRAMES = 40  # of a longer motion so many are shown


def animation(
    path: str | Path,
    surface: NDArray[np.int64],
    motions: Mapping[str, Any],
    time_step: float,
    scenery: Sequence[Scenery] = (),
    view: tuple[float, float] = VIEW,
    color: Any = None,
) -> None:
    """Motions side by side, saved as a .gif that runs in real time, or slower where it would last less than 2 s; or
    as an .npz, which :func:`live` shows.

    Args:
        path: The .gif or .npz to write.
        surface: Boundary triangles, shape [F, 3], as `TetMesh.surface`.
        motions: Positions [m] of each motion by name, shape [N, V, 3], array or tensor; y points up.
        time_step: Between frames [s].
        scenery: What else stands in every picture, for example `floor(...)`.
        view: Elevation and azimuth of the eye [degrees].
        color: Of the body, as in `draw`; default: one for each motion.

    Raises:
        ImportError: matplotlib is not installed, for a .gif.
        ValueError: motions or triangles of another shape.
    """
    path, time_step = to_path("path", path), check_positive("time_step", time_step, "s")
    if path.suffix == ".npz":
        save_motions(path, surface, motions_as_arrays(motions, surface), time_step, scenery)
        return
    figure = new_figure(3.4 * len(motions), 3.2, dots=70)
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    FigureCanvasAgg(figure)
    frames = motions_as_arrays(motions, surface)
    count = min(len(motion) for motion in frames.values())
    shown = np.unique(np.linspace(0, count - 1, min(count, FRAMES)).round().astype(int))
    bounds = bounds_of([*frames.values(), *(thing.points for thing in scenery)])
    panels = [figure.add_subplot(1, len(frames), k + 1, projection="3d") for k in range(len(frames))]
    figure.subplots_adjust(left=0.0, right=1.0, bottom=0.0, top=0.92, wspace=0.0)

    def show(k: int) -> None:
        for axes, (name, motion) in zip(panels, frames.items(), strict=True):
            axes.clear()
            paint = COLORS.get(name, OTHER) if color is None else color
            draw(axes, motion[k], surface, paint, bounds, scenery, view)
            axes.set_title(f"{name}, {1e3 * k * time_step:.0f} ms", fontsize=10, y=1.0)

    save_motion(path, figure, show, shown.tolist(), (count - 1) * time_step)


def comparison(
    path: str | Path,
    surface: NDArray[np.int64],
    motions: Mapping[str, Any],
    times: Sequence[float],
    history: Sequence[Mapping[str, float]] = (),
    truth: Mapping[str, float] | None = None,
    scenery: Sequence[Scenery] = (),
    view: tuple[float, float] = VIEW,
) -> None:
    """Picture of shapes in a grid, one row per motion and one column per time, with the course of an optimisation.

    Args:
        path: The picture to write; the suffix chooses the format.
        surface: Boundary triangles, shape [F, 3], as `TetMesh.surface`.
        motions: Positions [m] to show of each motion by name, shape [N, V, 3], array or tensor; y points up.
        times: Their times [s], length N.
        history: Rows with "loss" and the estimates named in truth, as the task runner keeps them.
        truth: True values of estimates; their relative error is drawn.
        scenery: What else stands in every picture, for example `floor(...)`.
        view: Elevation and azimuth of the eye [degrees].

    Raises:
        ImportError: matplotlib is not installed.
        ValueError: motions or triangles of another shape.
    """
    frames = motions_as_arrays(motions, surface, len(times))
    low, high = bounds_of([*frames.values(), *(thing.points for thing in scenery)])

    columns = len(times)
    figure = new_figure(3.0 * columns + (4.2 if history else 0.0), 2.3 * len(frames))
    shapes, charts = figure, None
    if history:
        shapes, charts = figure.subfigures(1, 2, width_ratios=(3.0 * columns, 4.2))
    for row, (name, shown) in enumerate(frames.items()):
        for column, points in enumerate(shown):
            axes = shapes.add_subplot(len(frames), columns, row * columns + column + 1, projection="3d")
            draw(axes, points, surface, COLORS.get(name, OTHER), (low, high), scenery, view)
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
        course(charts, history, truth or {})
    figure.savefig(path)


def learning(
    path: str | Path,
    surface: NDArray[np.int64],
    motions: Mapping[str, Any],
    times: Sequence[float],
    curves: Mapping[str, Sequence[tuple[float, float]]],
    scenery: Sequence[Scenery] = (),
    view: tuple[float, float] = VIEW,
) -> None:
    """Picture of shapes, one row per motion and one column per time, with losses over the seconds that they took.

    Args:
        path: The picture to write; the suffix chooses the format.
        surface: Boundary triangles, shape [F, 3], as `TetMesh.surface`.
        motions: Positions [m] to show of each motion by name, shape [N, V, 3], array or tensor; y points up.
        times: Their times [s], length N.
        curves: (seconds, loss) of each method by name; the lowest loss so far is drawn.
        scenery: What else stands in every picture.
        view: Elevation and azimuth of the eye [degrees].

    Raises:
        ImportError: matplotlib is not installed.
        ValueError: motions or triangles of another shape.
    """
    frames = motions_as_arrays(motions, surface, len(times))
    bounds = bounds_of([*frames.values(), *(thing.points for thing in scenery)])
    figure = new_figure(3.0 * len(times) + 4.2, 2.6 * len(frames))
    shapes, chart = figure.subfigures(1, 2, width_ratios=(3.0 * len(times), 4.2))
    for row, (name, shown) in enumerate(frames.items()):
        for column, points in enumerate(shown):
            axes = shapes.add_subplot(len(frames), len(times), row * len(times) + column + 1, projection="3d")
            draw(axes, points, surface, BODIES[0] if row + 1 == len(frames) else OTHER, bounds, scenery, view)
            axes.set_title(f"{name}, {1e3 * times[column]:.0f} ms", fontsize=11, y=0.95)
    shapes.subplots_adjust(left=0.0, right=1.0, bottom=0.0, top=0.95, wspace=0.0, hspace=0.05)

    axes = chart.subplots()
    for color, (name, curve) in zip(itertools.cycle(BODIES), curves.items()):
        seconds, losses = zip(*curve, strict=True)
        axes.semilogy(seconds, np.minimum.accumulate(losses), label=name, color=color)
    axes.set(xlabel="seconds", ylabel="lowest loss so far")
    axes.legend(frameon=False)
    tidy(axes)
    chart.subplots_adjust(left=0.2, right=0.96, bottom=0.12, top=0.95)
    figure.savefig(path)


EYE = (12.0, 10.0)  # elevation and azimuth [degrees]: x runs to the right


def paths(
    path: str | Path,
    surface: NDArray[np.int64],
    frames: Mapping[str, Any],
    centers: Mapping[str, Any],
    target: Scenery,
    history: Sequence[Mapping[str, float]],
) -> None:
    """Picture of a body at a few times of each motion, of the paths of its center from the side and from above, and of
    the distance from the target over the iterations of an optimisation.

    Args:
        path: The picture to write; the suffix chooses the format.
        surface: Boundary triangles, shape [F, 3], as `TetMesh.surface`.
        frames: Positions [m] to show of each motion by name, shape [N, V, 3], array or tensor; y points up, and the
            floor is at y = 0.
        centers: Path of the center [m] in each of these motions, shape [frames, 3], array or tensor.
        target: What the center shall meet.
        history: Rows with "distance" [m].

    Raises:
        ImportError: matplotlib is not installed.
    """
    figure = new_figure(13.0, 8.0)
    shapes, courses = ({name: as_array(values) for name, values in each.items()} for each in (frames, centers))
    low, high = bounds_of([*shapes.values(), *courses.values(), target.points])
    low, high = np.minimum(low, [np.inf, 0.0, np.inf]) - [0.05, 0.0, 0.05], high + [0.05, 0.0, 0.05]
    ground = floor((low[0], low[2]), (high[0], high[2]))
    above, below = figure.subfigures(2, 1, height_ratios=(1.4, 1.0))

    for column, (name, bodies) in enumerate(shapes.items()):
        color, course = COLORS.get(name, OTHER), courses[name]
        axes = above.add_subplot(1, len(shapes), column + 1, projection="3d", computed_zorder=False)
        # in this order: the ground's triangles would be sorted in front of small ones, the body would hide the target
        draw(axes, ground.points, ground.triangles, ground.color, (low, high), view=EYE)
        draw(axes, bodies[0], surface, color, (low, high), [Scenery(body, surface, color) for body in bodies[1:]], EYE)
        axes.plot(course[:, 2], course[:, 0], course[:, 1], color=INK, linewidth=1.5, clip_on=False)
        draw(axes, target.points, target.triangles, target.color, (low, high), view=EYE)
        axes.set_title(name, color=color, fontsize=13, y=0.95)
    above.subplots_adjust(left=0.0, right=1.0, bottom=0.0, top=1.0, wspace=0.0)

    side, top, chart = below.subplots(1, 3)
    middle = 0.5 * (target.points.min(0) + target.points.max(0))
    for panel, (across, up) in ((side, (0, 1)), (top, (0, 2))):
        for name, course in courses.items():
            panel.plot(course[:, across], course[:, up], color=COLORS.get(name, OTHER), label=name)
        panel.plot(middle[across], middle[up], "s", color=target.color, label="target")
        panel.set(xlabel=f"{'xyz'[across]} [m]", ylabel=f"{'xyz'[up]} [m]", aspect="equal", adjustable="datalim")
    side.axhline(0.0, color=INK, linewidth=1.0)
    side.set_title("side", fontsize=10)
    top.set_title("above", fontsize=10)
    top.invert_yaxis()  # z comes towards the viewer
    side.legend(frameon=False, fontsize=9)
    chart.semilogy([row["distance"] for row in history], color=INK)
    chart.set(xlabel="iteration", ylabel="distance from the target [m]")
    for panel in (side, top, chart):
        tidy(panel)
    below.subplots_adjust(left=0.06, right=0.98, bottom=0.17, top=0.9, wspace=0.28)
    figure.savefig(path)


def landing(
    path: str | Path,
    surfaces: Sequence[NDArray[np.int64]],
    frames: Any,
    times: Sequence[float],
    radius: float,
    history: Sequence[Mapping[str, float]],
) -> None:
    """Picture of bodies and the round target they land on: the last frame from above, the course of the optimisation,
    and every frame from the side.

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
    shown = as_array(frames)
    figure = new_figure(3.3 * len(times), 8.0)
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
        axes.plot([scale * row[key] for row in history], color=INK)
        axes.set_ylabel(label)
        tidy(axes)
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


COLORMAP = "viridis"


def field(
    path: str | Path,
    points: Any,
    tets: NDArray[np.int64],
    values: Mapping[str, Any],
    label: str = "",
    cut: tuple[Sequence[float], Sequence[float]] | None = None,
    history: Sequence[Mapping[str, float]] = (),
    truth: Mapping[str, float] | None = None,
    view: tuple[float, float] = VIEW,
) -> None:
    """Maps of fields side by side, on the surface and on a cut, with one colorbar of logarithmic scale.

    Args:
        path: The picture to write; the suffix chooses the format.
        points: Positions [m], shape [V, 3], array or tensor; y points up.
        tets: Vertex indices of each tet, positively oriented, shape [T, 4].
        values: Positive values of each field by name, shape [T] each; colors span their 1st to 99th percentile.
        label: Of the colorbar, with the unit.
        cut: A point [m] and the normal of a plane; a second row shows the tets with centroids behind it.
        history: Rows with "loss" and the estimates named in truth; draws the course of an optimisation.
        truth: True values of estimates; their relative error is drawn.
        view: Elevation and azimuth of the eye [degrees].

    Raises:
        ValueError: values are not one positive number for each tet, or no tet lies behind the cut.
        ImportError: matplotlib is not installed.
    """
    corners, maps = as_array(points), {name: as_array(value) for name, value in values.items()}
    for name, value in maps.items():
        if value.shape != (len(tets),) or not (value > 0).all():
            raise ValueError(f"values: expected {len(tets)} positive numbers in {name!r}, got shape {value.shape}")
    rows = {"surface": np.arange(len(tets))}
    if cut is not None:
        rows["cut"] = behind(corners, tets, *cut)
    width = 3.4 * len(maps) + 1.2
    figure = new_figure(width + (4.2 if history else 0.0), 3.0 * len(rows))
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import LogNorm

    everything = np.concatenate(list(maps.values()))
    low, high = np.percentile(everything, [1, 99])
    # a logarithmic scale needs some extent
    paint = ScalarMappable(LogNorm(low, max(high, 1.01 * low)), COLORMAP)
    shapes, charts = figure, None
    if history:
        shapes, charts = figure.subfigures(1, 2, width_ratios=(width, 4.2))
    left, right, top = 0.06, 1.0 - 1.3 / width, 0.93
    bounds = bounds_of([corners])
    for row, (kind, kept) in enumerate(rows.items()):
        triangles, owner = boundary_faces(tets[kept], len(corners))
        for column, value in enumerate(maps.values()):
            axes = shapes.add_subplot(len(rows), len(maps), row * len(maps) + column + 1, projection="3d")
            draw(axes, corners, triangles, paint.to_rgba(value[kept][owner])[:, :3], bounds, view=view)
        height = top * (1.0 - (row + 0.5) / len(rows))
        shapes.text(0.5 * left, height, kind, rotation=90, ha="center", va="center", fontsize=13)
    shapes.subplots_adjust(left=left, right=right, bottom=0.0, top=top, wspace=0.0, hspace=0.0)
    for column, name in enumerate(maps):
        middle = left + (right - left) * (column + 0.5) / len(maps)
        shapes.text(middle, 0.96, name, ha="center", va="center", fontsize=13)
    place = shapes.add_axes((right + 0.02, 0.15, 0.025, 0.65))
    shapes.colorbar(paint, cax=place, extend="both").set_label(label)
    if charts is not None:
        course(charts, history, truth or {})
    figure.savefig(path)


def behind(
    points: NDArray[np.float64], tets: NDArray[np.int64], origin: Sequence[float], normal: Sequence[float]
) -> NDArray[np.int64]:
    """Tets whose centroids lie on the side of a plane that its normal points away from.

    Raises:
        ValueError: there are none.
    """
    height = (points[tets].mean(1) - np.asarray(origin)) @ np.asarray(normal)
    kept = np.flatnonzero(height <= 0)
    if len(kept) == 0:
        raise ValueError(f"cut: expected tets behind the plane through {list(origin)}, got none")
    return kept


SHOWN = 20_000  # points; of more, so many of them


def cloud(
    path: str | Path, frames: Any, time_step: float, history: Sequence[Mapping[str, float]], estimate: str
) -> None:
    """Picture of points at several times with the course of an optimisation.

    Args:
        path: The picture to write; the suffix chooses the format.
        frames: Positions [m], shape [N, bodies, 3], array or tensor; y points up.
        time_step: Between frames [s].
        history: Rows with "loss" and the estimate.
        estimate: Key of the history that is drawn below the loss.

    Raises:
        ImportError: matplotlib is not installed.
    """
    shown = _chosen(frames)
    bounds, columns = bounds_of([shown]), (len(shown) + 1) // 2
    figure = new_figure(3.0 * columns + 4.2, 6.0)
    left, right = figure.subfigures(1, 2, width_ratios=(3.0 * columns, 4.2))
    for k, points in enumerate(shown):
        axes = left.add_subplot(2, columns, k + 1, projection="3d")
        _points(axes, points, shown[0], bounds)
        axes.set_title(f"t = {1e3 * k * time_step:.0f} ms", fontsize=12, y=0.95)
    left.subplots_adjust(left=0.0, right=1.0, bottom=0.0, top=0.97, wspace=0.0, hspace=0.0)
    charts = right.subplots(2, 1, sharex=True)
    for axes, key in zip(charts, ("loss", estimate), strict=True):
        axes.semilogy([row[key] for row in history], color=INK)
        axes.set_ylabel(key.replace("_", " ") + (" [m]" if key != "loss" else ""))
        tidy(axes)
    charts[1].set_xlabel("iteration")
    right.subplots_adjust(left=0.2, right=0.96, bottom=0.1, top=0.95, hspace=0.12)
    figure.savefig(path)


def cloud_animation(path: str | Path, frames: Any, time_step: float) -> None:
    """Moving points, saved as a .gif in the time of `animation`, or as an .npz of small cubes; arguments and errors
    as for `cloud`."""
    if Path(path).suffix == ".npz":
        save_motions(path, *_cubes(_chosen(frames)), time_step)
        return
    figure = new_figure(4.5, 4.5, dots=80)
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    FigureCanvasAgg(figure)
    shown = _chosen(frames)
    bounds = bounds_of([shown])
    axes = figure.add_subplot(projection="3d")
    figure.subplots_adjust(left=0.0, right=1.0, bottom=0.0, top=0.95)

    def show(k: int) -> None:
        axes.clear()
        _points(axes, shown[k], shown[0], bounds)
        axes.set_title(f"{1e3 * k * time_step:.0f} ms", fontsize=10, y=1.0)

    save_motion(path, figure, show, range(len(shown)), (len(shown) - 1) * time_step)


def _cubes(centers: NDArray[np.float64]) -> tuple[NDArray[np.int64], dict[str, NDArray[np.float64]]]:
    """Triangles and motion of a cube around each point [N, bodies, 3], as wide as a third of their spacing."""
    count, one = centers.shape[1], cube(2)
    edge = np.ptp(centers[0], axis=0).max() / max(1.0, np.sqrt(count)) / 3 or 1.0
    corners = edge * (one.points - one.points.mean(0)) / np.ptp(one.points)
    triangles = (one.surface + one.num_vertices * np.arange(count)[:, None, None]).reshape(-1, 3)
    return triangles, {"bodies": (centers[:, :, None] + corners).reshape(len(centers), -1, 3)}


def _chosen(frames: Any) -> NDArray[np.float64]:
    # at random: every n-th of bodies in rows would draw lines that are not there
    order = np.random.default_rng(0).permutation(frames.shape[1])[:SHOWN]
    return as_array(frames[:, order])


def _points(axes: Any, points: NDArray[np.float64], first: NDArray[np.float64], bounds: tuple[Any, Any]) -> None:
    from matplotlib import colormaps

    # colored by where they started, so that one sees who goes where
    low, high = first.min(0), first.max(0)
    colors = colormaps["viridis"](((first - low) / np.maximum(high - low, 1e-9))[:, 0])
    z, x, y = points[:, 2], points[:, 0], points[:, 1]
    axes.scatter(z, x, y, s=4e3 / max(len(points), 1000), c=colors, linewidths=0, depthshade=False)
    lower, upper = (corner[[2, 0, 1]] for corner in bounds)
    axes.set(xlim=(lower[0], upper[0]), ylim=(lower[1], upper[1]), zlim=(lower[2], upper[2]))
    axes.set_box_aspect(np.maximum(upper - lower, 1e-9), zoom=1.2)
    axes.view_init(elev=VIEW[0], azim=VIEW[1])
    axes.set_axis_off()
