"""Several motions of one body beside each other."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffvbd.viz.drawing import COLORS, OTHER, VIEW, Scenery, bounds_of, course, draw, motions_as_arrays, new_figure


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
    """Save a grid of shapes, one row per motion and one column per time, beside the course of an optimisation.

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
