"""Pictures of results, drawn by matplotlib: motions, clouds of bodies, fields, landings, learning, paths."""

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffvbd.mesh.arrays import to_path
from diffvbd.mesh.shapes import cube
from diffvbd.mesh.tet_mesh import boundary_faces

from .._common.checks import check_positive
from .motion import save_motions
from .scenery import Scenery, as_array, check_surface, floor, motions_as_arrays, optional

COLORS = {"initial": "#4c78a8", "target": "#e4704f", "recovered": "#4f9d5b"}
OTHER = "#8c8c8c"
BODIES = ("#4c78a8", "#e4704f", "#4f9d5b")
INK = "#333333"
# matplotlib's up is its third axis: y goes there by a cyclic exchange, which keeps the handedness.
CYCLIC = [2, 0, 1]
VIEW = (16.0, 32.0)  # elevation and azimuth of the eye [degrees]
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
        surface, motions, scenery, view: As in :func:`comparison`, which also says what raises.
        time_step: Between frames [s].
        color: Of the body, as in `draw`; default: one for each motion.
    """
    path, time_step = to_path("path", path), check_positive("time_step", time_step, "s")
    if path.suffix == ".npz":
        save_motions(path, surface, motions_as_arrays(motions, surface), time_step, scenery)
        return
    figure = new_figure(3.4 * len(motions), 3.2, dots=70)
    frames = motions_as_arrays(motions, surface)
    count = min(len(motion) for motion in frames.values())
    shown = np.unique(np.linspace(0, count - 1, min(count, FRAMES)).round().astype(int))
    bounds = bounds_of(frames.values(), scenery)
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
    bounds, width = bounds_of(frames.values(), scenery), 3.0 * len(times)
    figure = new_figure(width + (4.2 if history else 0.0), 2.3 * len(frames))
    colors = {name: COLORS.get(name, OTHER) for name in frames}
    _, panels = grid(figure, width, colors, [f"t = {1e3 * time:.0f} ms" for time in times], history, truth)
    for row, (name, shown) in zip(panels, frames.items(), strict=True):
        for axes, points in zip(row, shown, strict=True):
            draw(axes, points, surface, colors[name], bounds, scenery, view)
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
        path, surface, motions, times, scenery, view: As in :func:`comparison`, which also says what raises.
        curves: (seconds, loss) of each method by name; the lowest loss so far is drawn.
    """
    frames = motions_as_arrays(motions, surface, len(times))
    bounds = bounds_of(frames.values(), scenery)
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
        path, surface: As in :func:`comparison`.
        frames: Its motions; the floor is at y = 0.
        centers: Path of the center [m] in each of these motions, shape [frames, 3], array or tensor.
        target: What the center shall meet.
        history: Rows with "distance" [m].
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
        path: As in :func:`comparison`.
        surfaces: Boundary triangles of each body, shape [F, 3], as rows of the frames.
        frames: Positions [m], shape [N, V, 3], array or tensor; y points up, and the floor is at y = 0.
        times: Their times [s], length N.
        radius: Of the target about the y axis [m].
        history: Rows with "loss" and "uncovered", a share.
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
        path, truth, view: As in :func:`comparison`, with which it shares what raises.
        points: Positions [m], shape [V, 3], array or tensor; y points up.
        tets: Vertex indices of each tet, positively oriented, shape [T, 4].
        values: Positive values of each field by name, shape [T] each; colors span their 1st to 99th percentile.
        label: Of the colorbar, with the unit.
        cut: A point [m] and the normal of a plane; a second row shows the tets with centroids behind it.
        history: Rows with "loss" and the estimates named in truth; draws the course of an optimisation.

    Raises:
        ValueError: values are not one positive number for each tet, or no tet lies behind the cut.
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
    right = 1.0 - 1.3 / width
    shapes, panels = grid(figure, width, dict.fromkeys(rows, "black"), [*maps], history, truth, right)
    bounds = bounds_of([corners])
    for row, kept in zip(panels, rows.values(), strict=True):
        triangles, owner = boundary_faces(tets[kept], len(corners))
        for axes, value in zip(row, maps.values(), strict=True):
            draw(axes, corners, triangles, paint.to_rgba(value[kept][owner])[:, :3], bounds, view=view)
    place = shapes.add_axes((right + 0.02, 0.15, 0.025, 0.65))
    shapes.colorbar(paint, cax=place, extend="both").set_label(label)
    figure.savefig(path)


def behind(
    points: NDArray[np.float64], tets: NDArray[np.int64], origin: Sequence[float], normal: Sequence[float]
) -> NDArray[np.int64]:
    """Tets whose centroids lie on the side of a plane that its normal points away from; ValueError for none."""
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
        path: As in :func:`comparison`.
        frames: Positions [m], shape [N, bodies, 3], array or tensor; y points up.
        time_step: Between frames [s].
        history: Rows with "loss" and the estimate.
        estimate: Key of the history that is drawn below the loss.
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
    course(right, history, estimate=estimate)
    figure.savefig(path)


def cloud_animation(path: str | Path, frames: Any, time_step: float) -> None:
    """Moving points, saved as a .gif in the time of `animation`, or as an .npz of small cubes; arguments and errors
    as for `cloud`."""
    if Path(path).suffix == ".npz":
        save_motions(path, *_cubes(_chosen(frames)), time_step)
        return
    figure = new_figure(4.5, 4.5, dots=80)
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
    axes.scatter(*points.T[CYCLIC], s=4e3 / max(len(points), 1000), c=colors, linewidths=0, depthshade=False)
    frame(axes, *bounds, VIEW, zoom=1.2)


# --- parts of pictures ------------------------------------------------------------------------------------------------


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

    vertices = as_array(points)
    check_surface(surface, len(vertices))
    body = vertices[surface][..., CYCLIC]
    parts, colors = [body], [np.broadcast_to(to_rgb(color) if isinstance(color, str) else color, (len(body), 3))]
    for thing in scenery:
        parts.append(as_array(thing.points)[thing.triangles][..., CYCLIC])
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
    frame(axes, *(bounds or bounds_of([vertices[surface]])), view, zoom=1.15)


def frame(axes: Any, low: Any, high: Any, view: tuple[float, float], zoom: float) -> None:
    """3D axes that show the box between two corners [m], and nothing else."""
    low, high = as_array(low)[CYCLIC], as_array(high)[CYCLIC]
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axes.set_box_aspect(np.maximum(high - low, 1e-9), zoom=zoom)
    axes.view_init(elev=view[0], azim=view[1])
    axes.set_axis_off()


def tidy(axes: Any) -> None:
    """A faint grid, and no frame at the top and on the right."""
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)


def course(
    figure: Any, history: Sequence[Mapping[str, float]], truth: Mapping[str, float] | None = None, estimate: str = ""
) -> None:
    """Charts of the loss over iterations and, below it, of relative errors or of an estimate [m]."""
    charts = figure.subplots(2 if truth or estimate else 1, 1, sharex=True, squeeze=False)[:, 0]
    charts[0].semilogy([row["loss"] for row in history], color=INK)
    charts[0].set_ylabel("loss")
    charts[-1].set_xlabel("iteration")
    if truth:
        for name, true in truth.items():
            charts[1].semilogy([abs(row[name] / true - 1) for row in history], label=name)
        charts[1].set_ylabel("relative error")
        charts[1].legend(frameon=False)
    elif estimate:
        charts[1].semilogy([row[estimate] for row in history], color=INK)
        charts[1].set_ylabel(estimate.replace("_", " ") + " [m]")
    for axes in charts:
        tidy(axes)
    figure.subplots_adjust(left=0.2, right=0.96, bottom=0.1, top=0.95, hspace=0.12)


def grid(
    figure: Any,
    width: float,
    rows: Mapping[str, str],
    columns: Sequence[str],
    history: Sequence[Mapping[str, float]],
    truth: Mapping[str, float] | None,
    right: float = 1.0,
) -> tuple[Any, list[list[Any]]]:
    """3D axes [rows, columns] with names at the left, each in a color, and titles above, up to ``right`` of a part
    ``width`` inches wide; with a history the course of an optimisation stands beside it. Returns that part and axes."""
    shapes = figure
    if history:
        shapes, charts = figure.subfigures(1, 2, width_ratios=(width, 4.2))
        course(charts, history, truth)
    left, top = 0.06, 0.93
    axes = [
        [shapes.add_subplot(len(rows), len(columns), row * len(columns) + column + 1, projection="3d")
         for column in range(len(columns))]
        for row in range(len(rows))
    ]  # fmt: skip
    shapes.subplots_adjust(left=left, right=right, bottom=0.0, top=top, wspace=0.0, hspace=0.0)
    style = {"ha": "center", "va": "center", "fontsize": 13}
    for row, (name, color) in enumerate(rows.items()):
        shapes.text(0.5 * left, top * (1.0 - (row + 0.5) / len(rows)), name, rotation=90, color=color, **style)
    for column, title in enumerate(columns):
        shapes.text(left + (right - left) * (column + 0.5) / len(columns), 0.96, title, **style)
    return shapes, axes


def new_figure(width: float, height: float, dots: int = 130) -> Any:
    """A figure [inches]; an ImportError that says what is missing."""
    # Not pyplot: it would choose a window system, and pictures are only written to files.
    return optional("matplotlib.figure", "pictures need").Figure(figsize=(width, height), dpi=dots)


def save_motion(
    path: str | Path, figure: Any, show: Callable[[int], None], frames: Sequence[int], seconds: float
) -> None:
    """Write a .gif of `show(k)` for these k; it runs for the time given [s], or 2 s where that is less."""
    from matplotlib.animation import FuncAnimation, PillowWriter
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    FigureCanvasAgg(figure)
    rate = max(1, round(len(frames) / max(2.0, seconds)))
    FuncAnimation(figure, show, frames=frames).save(path, PillowWriter(fps=rate))


def bounds_of(
    shapes: Iterable[Any], scenery: Sequence[Scenery] = ()
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Lowest and highest corner [m] of arrays of positions, shape [..., 3], and of scenery."""
    points = [*shapes, *(thing.points for thing in scenery)]
    everything = np.concatenate([as_array(shape).reshape(-1, 3) for shape in points])
    return everything.min(0), everything.max(0)
