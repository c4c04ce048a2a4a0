"""A body that flies past a target."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffvbd.viz.drawing import COLORS, INK, OTHER, Scenery, as_array, bounds_of, draw, floor, new_figure

EYE = (12.0, 10.0)  # elevation and azimuth [degrees]: x runs to the right


def paths(
    path: str | Path,
    surface: NDArray[np.int64],
    frames: Mapping[str, Any],
    centers: Mapping[str, Any],
    target: Scenery,
    history: Sequence[Mapping[str, float]],
) -> None:
    """Save a body at a few times of each motion, the paths of its center from the side and from above, and the distance
    from the target over the iterations of an optimisation.

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
        panel.grid(alpha=0.3)
        panel.spines[["top", "right"]].set_visible(False)
    below.subplots_adjust(left=0.06, right=0.98, bottom=0.17, top=0.9, wspace=0.28)
    figure.savefig(path)
