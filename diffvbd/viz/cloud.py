"""Very many small bodies as points."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffvbd.mesh.shapes import cube
from diffvbd.viz.drawing import INK, VIEW, as_array, bounds_of, new_figure, save_motion
from diffvbd.viz.motion import save_motions

SHOWN = 20_000  # points; of more, so many of them


def cloud(
    path: str | Path, frames: Any, time_step: float, history: Sequence[Mapping[str, float]], estimate: str
) -> None:
    """Save points at several times beside the course of an optimisation.

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
        axes.grid(alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
    charts[1].set_xlabel("iteration")
    right.subplots_adjust(left=0.2, right=0.96, bottom=0.1, top=0.95, hspace=0.12)
    figure.savefig(path)


def cloud_animation(path: str | Path, frames: Any, time_step: float) -> None:
    """Save moving points as a .gif in the time of `animation`, or as an .npz of small cubes; arguments and errors
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
