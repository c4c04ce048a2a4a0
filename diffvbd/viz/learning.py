"""What was learnt, and how soon."""

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffvbd.viz.drawing import BODIES, OTHER, VIEW, Scenery, bounds_of, draw, motions_as_arrays, new_figure


def learning(
    path: str | Path,
    surface: NDArray[np.int64],
    motions: Mapping[str, Any],
    times: Sequence[float],
    curves: Mapping[str, Sequence[tuple[float, float]]],
    scenery: Sequence[Scenery] = (),
    view: tuple[float, float] = VIEW,
) -> None:
    """Save shapes, one row per motion and one column per time, beside losses over the seconds that they took.

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
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)
    chart.subplots_adjust(left=0.2, right=0.96, bottom=0.12, top=0.95)
    figure.savefig(path)
